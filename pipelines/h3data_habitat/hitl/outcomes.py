"""Outcomes that HITL logs record, in the columns that the metrics of social rearrangement read.

===================== ==================================================================================================
``metrics.success``   bool [T], the goal of the task holds: ``pddl_success`` of the paper's logs (all objects at their
                      goals, nothing held), ``task_percent_complete`` of ``rearrange_v2`` above `COMPLETE`
``metrics.collision`` bool [T], robot and person touch: ``did_collide``, else an increase of ``num_agents_collide``
``metrics.at_goal``   bool [T, K], which of the K target objects is within `AT_GOAL_M` of its goal
===================== ==================================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

AT_GOAL_M = 0.3
"""Distance in space of Habitat's predicate ``object_at`` (spec/habitat.md 2.2); logs do not repeat it."""
COMPLETE = 0.99
"""Share of the task above which PARTNR's analysis counts an episode as solved (spec/habitat.md 5.6)."""

Columns = Mapping[str, NDArray[Any]]


def logged_outcomes(columns: Columns) -> dict[str, NDArray[np.bool_]]:
    """Return ``metrics.success`` and ``metrics.collision`` [T], where the logged columns contain them.

    They are False at steps that were not logged.
    """
    outcomes: dict[str, NDArray[np.bool_]] = {}
    if "metrics.pddl_success" in columns:
        outcomes["metrics.success"] = columns["metrics.pddl_success"] > 0
    elif "metrics.task_percent_complete" in columns and np.isfinite(columns["metrics.task_percent_complete"]).any():
        outcomes["metrics.success"] = columns["metrics.task_percent_complete"] > COMPLETE
    if "metrics.did_collide" in columns:
        outcomes["metrics.collision"] = columns["metrics.did_collide"] > 0
    elif "metrics.num_agents_collide" in columns:
        # a running count: steps without a log keep the last one, and an increase is a contact
        contacts = np.nan_to_num(columns["metrics.num_agents_collide"].astype(np.float64))
        outcomes["metrics.collision"] = np.diff(np.maximum.accumulate(contacts), prepend=0.0) > 0
    return outcomes


def at_goal(goals: Any, tracks: Sequence[NDArray[np.float64]]) -> tuple[NDArray[np.bool_] | None, list[str]]:
    """Return ``metrics.at_goal`` [T, K] of K objects with tracks [T, 7] and logged ``goal_positions``, and warnings.

    The result is None without goals, or if they are not K points. An object without a position is not at its goal.
    """
    if goals is None:
        return None, []
    points = _points(goals)
    if points is None or len(points) != len(tracks) or not len(tracks):
        return None, [f"goal_positions are not a point for each of {len(tracks)} target objects: they are not used"]
    # NaN, an object without a position, is not nearer than anything
    with np.errstate(invalid="ignore"):
        return np.stack(
            [np.linalg.norm(t[:, :3] - goal, axis=1) < AT_GOAL_M for t, goal in zip(tracks, points, strict=True)],
            axis=1,
        ), []


def max_steps(config: Any) -> dict[str, int]:
    """Return ``{"max_steps": E}`` if a session's configuration limits episodes (``habitat.environment``), else {}."""
    for key in ("habitat", "environment", "max_episode_steps"):
        config = config.get(key) if isinstance(config, dict) else None
    return {"max_steps": config} if type(config) is int and 0 < config < 10**9 else {}


def _points(goals: Any) -> NDArray[np.float64] | None:
    """Return the logged points [K, 3]: lists, or the dictionaries {"0": ...} into which omegaconf turns lists."""
    rows = list(goals.values()) if isinstance(goals, dict) else goals
    if not isinstance(rows, list):
        return None
    rows = [list(row.values()) if isinstance(row, dict) else row for row in rows]
    for row in rows:
        if not isinstance(row, list) or len(row) != 3 or not all(type(v) in (int, float) and abs(v) < 1e9 for v in row):
            return None
    return np.array(rows, np.float64).reshape(-1, 3)
