"""Helper that creates definitions of metrics with common parts."""

from __future__ import annotations

from h3data.metrics.metric import INF, Direction, Metric

ROBOT_POSE, HUMAN_POSE = "agent_<robot>.base_pose", "agent_<human>.base_pose"


def define_metric(
    profile: str,
    group: str,
    name: str,
    title: str,
    formula: str,
    *,
    source: str,
    columns: tuple[str, ...],
    undefined: str,
    unit: str = "1",
    high: float = INF,
    direction: Direction = "lower",
    series: tuple[str, ...] = (),
    optional: tuple[str, ...] = (),
    reading: str = "",
    notation: str = "",
    binary: bool = False,
    version: int = 1,
) -> Metric:
    """Return the definition of a metric that is at least 0, and at most 1 if it is ``binary``.

    ``notation`` precedes the description of a metric that uses the poses of people.
    """
    return Metric(
        id=f"{profile}/{group}/{name}@{version}",
        name=name,
        title=title,
        formula=formula,
        unit=unit,
        range=(0.0, 1.0 if binary else high),
        direction=direction,
        source=source,
        columns=columns,
        optional=optional,
        undefined=undefined,
        series=series,
        reading=(notation + reading).rstrip() if notation and HUMAN_POSE in columns else reading,
        binary=binary,
    )
