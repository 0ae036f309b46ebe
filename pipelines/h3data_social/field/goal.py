"""Goal of a robot's episode, which is a floor point or an agent, and the rows in which it is reached."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.metrics.any_task import SUCCESS
from h3data.metrics.paper.encounter import PAPER, found_series
from h3data.metrics.paper.profiles import SOCIAL_NAV_PROFILE
from h3data.recording.records import Recording
from h3data_social.others import find_others

GEODESIC, GOAL_DISTANCE = "metrics.geodesic_agents", "metrics.goal_distance"
REACHED_M = 0.5
"""Distance within which a point counts as reached, for recordings without a column `metrics.success` [m]."""
PERSON_IS_GOAL = SOCIAL_NAV_PROFILE.tasks[0]
"""Name of the task whose goal is the person."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Goal of the measured agent, with its distance in each row."""

    distance: NDArray[np.float64]
    """Length of the shortest path to the goal if it is recorded, else the straight distance on the floor [m], shape
    [T]; NaN if unknown."""
    straight: NDArray[np.float64]
    """Straight distance to the goal on the floor [m], shape [T]; NaN if unknown."""
    reached: NDArray[np.bool_]
    """Mask of the rows in which the goal is reached, shape [T]."""
    agent: int = -1
    """Index of the agent that is the goal; -1 for a point."""
    within_m: float = 0.0
    """Distance from which the goal counts as reached [m]; this last part of a path need not be driven."""
    missing: str = ""
    """Reason why there is no goal, in which case it is never reached and all distances are NaN."""
    notes: tuple[str, ...] = ()
    """Notes on the data that were used in place of missing data."""

    @property
    def first(self) -> int:
        """Return the first row in which the robot and a goal agent have a pose; -1 if there is none."""
        known = ~np.isnan(self.straight)
        return int(np.argmax(known)) if known.any() else -1

    @property
    def row(self) -> int:
        """Return the first row in which the goal is reached; -1 if it never is."""
        return int(np.argmax(self.reached)) if self.reached.any() else -1

    @property
    def shortest(self) -> float:
        """Length of the shortest path from the position in row `first` to the goal [m]; NaN or inf if unknown."""
        return max(float(self.distance[self.first]) - self.within_m, 0.0) if self.first >= 0 else np.nan


def find_goal(recording: Recording) -> Goal:
    """Find the goal of the first robot in an episode.

    The goal is ``info["goal"]``, or ``goal`` in ``info["extra"]``, where `Episode.extra` is recorded. It is ``[x, z]``
    or ``[x, y, z]`` in the world [m], or the number or the name of an agent. Without it, the goal of `social_nav` is
    the only person.

    A point is reached in rows with ``metrics.success``, or within `REACHED_M` if this column is missing. Its distance
    is the column ``metrics.goal_distance``, or else the straight distance. An agent is reached in the paper's found
    rows: 1 to 2 m (geodesic, if recorded) and facing them.
    """
    robot, others = find_others(recording)
    stored, rows = _stored(recording.episode.info), len(recording)
    if (point := _point(stored)) is not None:
        return _point_goal(recording, robot, point)
    names = {agent.name: number for number, agent in enumerate(recording.agents)}
    agent = names.get(stored) if isinstance(stored, str) else stored
    if stored is not None:
        if type(agent) is int and 0 <= agent < len(names) and agent != robot:
            return _agent_goal(recording, robot, agent, others)
        missing = f"info goal must be [x, z], or the number or name of another agent; it is {stored!r}"
    elif recording.episode.task != PERSON_IS_GOAL:
        missing = f"undefined in the task {recording.episode.task!r}: no goal is recorded (info goal)"
    elif len(others) == 1:
        return _agent_goal(recording, robot, others[0], others)
    else:
        missing = f"undefined with several people ({len(others)}): info goal does not say which of them is the goal"
    unknown = np.full(rows, np.nan)
    return Goal(distance=unknown, straight=unknown, reached=np.zeros(rows, np.bool_), missing=missing)


def dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the scalar products [...] of vectors [..., 2]."""
    # a quarter of the time of `np.sum` over an axis of two, with the same bits
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def lengths(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths [...] of vectors [..., 2], with the bits of `np.linalg.norm`."""
    return np.sqrt(dot(vectors, vectors))


def _stored(info: Mapping[str, Any]) -> Any:
    extra = info.get("extra")
    return info.get("goal", extra.get("goal") if isinstance(extra, Mapping) else None)


def _point(stored: Any) -> NDArray[np.float64] | None:
    if not isinstance(stored, list | tuple) or len(stored) not in (2, 3):
        return None
    if not all(type(value) in (int, float) and np.isfinite(value) for value in stored):
        return None
    return np.array([stored[0], stored[-1]], np.float64)


def _point_goal(recording: Recording, robot: int, point: NDArray[np.float64]) -> Goal:
    at = recording.agent_column(robot, "base_pose")[:, [0, 2]].astype(np.float64)
    straight = lengths(at - point)
    distance = recording.columns.get(GOAL_DISTANCE, straight).astype(np.float64)
    notes = [] if GOAL_DISTANCE in recording.columns else [_straight(GOAL_DISTANCE)]
    if SUCCESS in recording.columns:
        reached = np.asarray((recording.columns[SUCCESS].reshape(len(at), -1) > 0).any(axis=1))
    else:
        reached = distance <= REACHED_M
        notes.append(f"no column {SUCCESS}: the goal is reached from {REACHED_M} m")
    return Goal(distance=distance, straight=straight, reached=reached, notes=tuple(notes))


def _agent_goal(recording: Recording, robot: int, agent: int, others: tuple[int, ...]) -> Goal:
    ours, theirs = (recording.agent_column(number, "base_pose") for number in (robot, agent))
    straight = lengths(theirs[:, [0, 2]].astype(np.float64) - ours[:, [0, 2]])
    distance, notes = straight, [_straight(GEODESIC)]
    if others == (agent,) and GEODESIC in recording.columns:  # with several it does not say to whom the path is
        distance, notes = recording.columns[GEODESIC].astype(np.float64), []
    reached = found_series(ours, theirs, distance)["found"]
    return Goal(
        distance=distance,
        straight=straight,
        reached=reached,
        agent=agent,
        within_m=PAPER.far_m,
        notes=tuple(notes),
    )


def _straight(column: str) -> str:
    return f"no column {column}: paths are taken as straight lines"
