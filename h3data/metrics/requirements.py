"""Requirements of metrics: the agents, columns, keys of info and events of a recording, and errors that name missing ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from h3data.errors import InputError
from h3data.metrics.episode import Notes
from h3data.metrics.metric import Metric
from h3data.recording.records import Recording

OR = " or "
"""Separator between columns of which one is enough."""


class UnmeasurableError(InputError):
    """Error about a recording that lacks agents or data that metrics need."""

    def __init__(self, message: str, reason: str, *, code: str = "") -> None:
        self.reason = reason
        """Reason of the error, which is the same for all recordings with the same gap, so that they can be counted."""
        super().__init__(message, code=code)


class MissingColumnsError(UnmeasurableError):
    """Error about a recording that lacks the data of every requested metric.

    The message lists the data that each metric needs.
    """

    def __init__(self, episode_id: str, needs: Mapping[str, Sequence[str]]) -> None:
        self.needs = {name: tuple(columns) for name, columns in needs.items()}
        """Missing columns by metric name."""
        each = "; ".join(f"{name} needs {', '.join(columns)}" for name, columns in self.needs.items())
        missing = sorted({column for columns in self.needs.values() for column in columns})
        super().__init__(
            f"Episode {episode_id!r} has nothing to measure: {each}.",
            f"nothing to measure: lacks {', '.join(missing)}",
            code="H3-METRIC-026",
        )


def require_whole(recording: Recording) -> None:
    """Raise an error for an episode of a LeRobot export (`h3data_exporters.lerobot`).

    Such exports omit the last row, in which an episode succeeds or ends in contact, so their metrics would be wrong.

    Raises:
        UnmeasurableError: the recording is such an export.
    """
    if recording.episode.is_lerobot_export:
        raise UnmeasurableError(
            "Demonstrations exported to LeRobot lack the last row of each episode, where it succeeds or fails. "
            "Hint: measure the dataset that they were exported from.",
            "LeRobot exports lack the last row: measure the dataset that they were exported from",
            code="H3-METRIC-028",
        )


def find_agents(recording: Recording) -> tuple[int, int]:
    """Return the indices of the first robot and the first human; raise an `UnmeasurableError` if one is missing."""
    agents = recording.agents
    chosen = [next((i for i, a in enumerate(agents) if a.kind == kind), None) for kind in ("robot", "human")]
    robot, human = chosen
    if robot is not None and human is not None:
        return robot, human
    missing = " and ".join(f"no {kind}" for kind, i in zip(("robot", "human"), chosen, strict=True) if i is None)
    present = ", ".join(f"{a.name} ({a.kind})" for a in agents) or "no agents at all"
    hint = " Hint: the profile field measures any two agents." if len(agents) > 1 else ""
    raise UnmeasurableError(
        f"These metrics need a robot and a human; recording {recording.episode.episode_id!r} has {missing} "
        f"(found: {present}).{hint}",
        "needs a robot and a human",
        code="H3-METRIC-027",
    )


def lacks(recording: Recording, entry: str) -> bool:
    """Return whether a recording lacks an entry of `Metric.columns`."""
    return not any(_has(recording, name) for name in entry.split(OR))


def note_missing(metrics: Sequence[Metric], recording: Recording, notes: Notes) -> set[str]:
    """Return the names of the metrics that lack something, each with a note; raise a `MissingColumnsError` if all do."""
    # most metrics need the same few columns: each is looked up once
    lacking = {entry for entry in {entry for m in metrics for entry in m.columns} if lacks(recording, entry)}
    needs = {m.name: missing for m in metrics if (missing := tuple(e for e in m.columns if e in lacking))}
    if len(needs) == len(metrics):
        raise MissingColumnsError(recording.episode.episode_id, needs)
    for name, missing in needs.items():
        notes.add([name], f"needs {', '.join(missing)}, which this recording does not have")
    return set(needs)


def stored_columns(metrics: Iterable[Metric], agents: int) -> list[str]:
    """Return the names of the columns that these metrics may read in recordings of up to ``agents`` agents."""
    names: dict[str, None] = {}
    for metric in metrics:
        for name in (alternative for entry in (*metric.columns, *metric.optional) for alternative in entry.split(OR)):
            # info and events are no columns
            if ":" in name:
                continue
            head, _, rest = name.partition(">.")
            # whose number <robot> is depends on the recording, so the column is read of every agent
            each = [f"agent_{i}.{rest}" for i in range(agents)] if head.startswith("agent_<") else [name]
            names.update(dict.fromkeys(each))
    return list(names)


def _has(recording: Recording, name: str) -> bool:
    # info:KEY, events:KIND, agent_<robot>.COLUMN or the name of a column
    kind, colon, key = name.partition(":")
    if colon and kind == "info":
        return recording.episode.info.get(key) is not None
    if colon:
        return any(event.kind == key for event in recording.events)
    head, _, rest = name.partition(">.")
    if head.startswith("agent_<"):
        return any(f"agent_{i}.{rest}" in recording.columns for i in range(len(recording.agents)))
    return name in recording.columns
