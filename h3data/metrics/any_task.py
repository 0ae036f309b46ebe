"""Profile ``task``: success, reward, time and contacts of any task, from the columns that its recorder writes.

It measures every recording, including those of tasks that no other profile names: metrics whose data a recording lacks
are undefined.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.metrics.metric import INF, Metric, Series
from h3data.metrics.profile import Profile
from h3data.metrics.report_layout import Milestone, ReportLayout
from h3data.recording.records import Recording

SUCCESS, REWARD, COLLISION = "metrics.success", "metrics.reward", "metrics.collision"
_SOURCE = "h3data"


def any_task_series(recording: Recording) -> Series:
    """Compute the flags ``success`` and ``collision`` and the quantity ``reward``, each [T], if they are recorded."""
    columns = recording.columns
    series: dict[str, NDArray] = {
        name.removeprefix("metrics."): _flags(columns[name]) for name in (SUCCESS, COLLISION) if name in columns
    }
    if REWARD in columns:
        series["reward"] = columns[REWARD].astype(np.float64)
    return series


def _flags(column: NDArray) -> NDArray[np.bool_]:
    # Not astype(bool): imported columns are floats with NaN where nothing was logged.
    return np.asarray((column.reshape(len(column), -1) > 0).any(axis=1))


def _collisions(recording: Recording) -> float:
    # a contact that lasts many steps counts once
    touches = _flags(recording.columns[COLLISION])
    return float(np.count_nonzero(touches & ~np.concatenate([[False], touches[:-1]])))


PROFILE = Profile(
    name="task",
    title="any task: success, reward, time, contacts",
    metrics=(
        Metric(
            id="task/any/success@1",
            name="success",
            title="Success",
            formula="1 if metrics.success holds in any row, else 0",
            range=(0.0, 1.0),
            direction="higher",
            source=_SOURCE,
            columns=(SUCCESS,),
            undefined="No column metrics.success.",
            series=("success",),
            binary=True,
            value=lambda recording: float(_flags(recording.columns[SUCCESS]).any()),
        ),
        Metric(
            id="task/any/reward@1",
            name="reward",
            title="Total reward",
            formula="sum of metrics.reward",
            direction="higher",
            source=_SOURCE,
            columns=(REWARD,),
            undefined="No column metrics.reward.",
            series=("reward",),
            reading="Rows without a reward (NaN) count as 0.",
            # in float64: a sum of thousands of float32 rewards would lose digits
            value=lambda recording: float(np.nansum(recording.columns[REWARD].astype(np.float64))),
        ),
        Metric(
            id="task/any/steps@1",
            name="steps",
            title="Steps",
            formula="number of rows",
            unit="steps",
            range=(0.0, INF),
            source=_SOURCE,
            columns=("time_ns",),
            undefined="The recording has no rows.",
            value=lambda recording: float(len(recording)),
        ),
        Metric(
            id="task/any/time@1",
            name="time",
            title="Duration",
            formula="time_ns of the last row * 1e-9",
            unit="s",
            range=(0.0, INF),
            source=_SOURCE,
            columns=("time_ns",),
            undefined="The recording has no rows.",
            value=lambda recording: float(recording.columns["time_ns"][-1]) * 1e-9,
        ),
        Metric(
            id="task/any/terminated@1",
            name="terminated",
            title="Ended by the task",
            formula="0 if info:ended is max_steps or track_end, else 1",
            range=(0.0, 1.0),
            source=_SOURCE,
            columns=("info:ended",),
            undefined="No info:ended.",
            binary=True,
            reading="Success and failure both count as ended by the task, as Gymnasium's terminated does.",
            value=lambda recording: float(str(recording.episode.info["ended"]) not in ("max_steps", "track_end")),
        ),
        Metric(
            id="task/any/collisions@1",
            name="collisions",
            title="Collisions",
            formula="times that metrics.collision becomes true",
            unit="times",
            range=(0.0, INF),
            direction="lower",
            source=_SOURCE,
            columns=(COLLISION,),
            undefined="No column metrics.collision.",
            series=("collision",),
            value=_collisions,
        ),
    ),
    series=any_task_series,
    report=ReportLayout(
        findings={"success": "succeeds in", "reward": "collects a reward of", "collisions": "collides this often:"},
        ranking=("success", "reward", "collisions"),
        milestones=(
            Milestone(flag="success", title="Solved by then", label="solves the task", metric="success"),
            Milestone(flag="collision", title="Collided by then", label="first contact", metric="collisions"),
        ),
    ),
)
