"""The profile ``field``: proxemics, efficiency and smoothness of a robot near a person.

Definitions and sources: `h3data.metrics.field.definitions`. Distances are centre to centre on the floor unless stated
otherwise; rows without a pose are left out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import heading_from_quat, wrap_angle
from h3data.metrics.episode import Notes
from h3data.metrics.field.definitions import (
    COMPLIANT_M,
    FIELD_METRICS,
    FULL_SPEED_M_S,
    GOAL_M,
    HUMAN_RADIUS_M,
    INTIMATE_M,
    PERSONAL_M,
    ROBOT_RADIUS_M,
    SOCIAL_M,
    STALLED_M_S,
    STALLED_RAD_S,
)
from h3data.metrics.metric import INF, NAN, Series
from h3data.metrics.paper.encounter import found_series
from h3data.metrics.profile import Computed, Profile
from h3data.metrics.report_layout import Milestone, ReportLayout
from h3data.metrics.requirements import find_pair, note_missing
from h3data.recording.records import Recording

if TYPE_CHECKING:
    from h3data.scene import FreeSpace

CLEARANCE, GEODESIC = "metrics.robot_clearance", "metrics.geodesic_agents"
NEAR = tuple(metric.name for metric in FIELD_METRICS if "/proxemics/" in metric.id)
"""Metrics of the distance to the one person."""
GOAL = ("SPL", "STL", "T_goal")
"""Metrics of reaching the person."""
PERSON_IS_GOAL = "social_nav"
"""The task whose goal is the person."""


def with_clearance(recording: Recording, free: FreeSpace) -> Recording:
    """Returns the recording with a column ``metrics.robot_clearance``, which C_min and C_mean read.

    It is the distance from the robot's centre to the nearest obstacle [m], 0 inside one, NaN where the robot has no pose.
    """
    robot, _ = find_pair(recording)
    at = recording.agent_column(robot, "base_pose")[:, [0, 2]].astype(np.float64)
    present = ~np.isnan(at).any(axis=1)
    clearance = np.full(len(at), np.nan)
    clearance[present] = np.maximum(free.signed_distance(at[present]), 0.0)
    return replace(recording, columns={**recording.columns, CLEARANCE: clearance.astype(np.float32)})


def compute_field(recording: Recording, notes: Notes) -> Computed:
    """Computes all metrics of the first robot near the first human.

    Without a robot and a human, the first agent is measured near the second, and a note names them.
    """
    robot, human = find_pair(recording)
    names = [metric.name for metric in FIELD_METRICS]
    note_missing(FIELD_METRICS, recording, notes)
    first, second = recording.agents[robot], recording.agents[human]
    if first.kind == second.kind:
        notes.add(names, f"'robot' is {first.name} ({first.kind}), 'human' is {second.name} ({second.kind})")
    several, no_goal = _several(recording), _no_person_as_goal(recording)
    if several:
        notes.add(NEAR, several)
    if several or no_goal:
        notes.add(GOAL, no_goal or several)
    if not len(recording):
        notes.add(names, "the recording has no rows")
        return Computed(values={}, robot=robot, human=human)
    series = field_series(recording)
    values = _proxemics(series) | _motion(series, recording)
    if not (several or no_goal):
        values |= _goal(series, recording, notes)
    for metric in FIELD_METRICS:
        if np.isnan(values.get(metric.name, NAN)) and metric.name not in notes.lines:
            notes.add([metric.name], metric.undefined[:1].lower() + metric.undefined[1:].rstrip("."))
    reached = int(np.argmax(series["goal"])) if series["goal"].any() else None
    moments = {} if reached is None else {"goal": reached, "found": reached}
    return Computed(values=values, robot=robot, human=human, moments=moments)


def _several(recording: Recording) -> str:
    """Why no other agent is the one that the robot is near; empty if there is one."""
    robot, human = find_pair(recording)
    kind = recording.agents[human].kind
    count = sum(agent.kind == kind for number, agent in enumerate(recording.agents) if number != robot)
    what = "people" if kind == "human" else "others"
    return f"undefined with several {what} ({count}): it is defined for one" if count > 1 else ""


def _no_person_as_goal(recording: Recording) -> str:
    """Why the person is not the robot's goal; empty if they are."""
    task = recording.episode.task
    return "" if task == PERSON_IS_GOAL else f"undefined in the task {task!r}: its goal is not the person"


def field_series(recording: Recording) -> Series:
    """Computes the per-row quantities and flags [T]. The motion of row k is that since row k - 1, NaN in row 0.

    Beside several people distances to one of them are NaN, and no row has a flag of a zone. ``goal`` holds nowhere where
    the person is not the goal.
    """
    robot, human = find_pair(recording)
    pose = recording.agent_column(robot, "base_pose").astype(np.float64)
    at = pose[:, [0, 2]]
    other = recording.agent_column(human, "base_pose")
    several = bool(_several(recording))
    if several:
        other = np.full_like(other, np.nan)
    towards = other[:, [0, 2]].astype(np.float64) - at
    seconds = recording.columns["time_ns"] * 1e-9
    distance = np.linalg.norm(towards, axis=1)
    velocity = _rate(at, seconds)
    acceleration = _rate(velocity, seconds)
    speed = np.linalg.norm(velocity, axis=1)
    heading = heading_from_quat(pose[:, 3:]).reshape(-1)
    turn = np.full(len(at), np.nan)
    turn[1:] = wrap_angle(np.diff(heading))
    with np.errstate(invalid="ignore", divide="ignore"):
        turning = np.abs(turn) / np.diff(seconds, prepend=np.nan)
    reach = distance if several else recording.columns.get(GEODESIC, distance).astype(np.float64)
    series = {
        "dist_m": distance,
        "reach_m": reach,
        "speed_m_s": speed,
        "acceleration_m_s2": np.linalg.norm(acceleration, axis=1),
        "jerk_m_s3": np.linalg.norm(_rate(acceleration, seconds), axis=1),
        "turn_rad": np.abs(turn),
        "ttc_s": time_to_collision(towards, _rate(towards, seconds), ROBOT_RADIUS_M + HUMAN_RADIUS_M),
        "personal_space": distance >= COMPLIANT_M,
        "intimate": distance < INTIMATE_M,
        "personal": (distance >= INTIMATE_M) & (distance < PERSONAL_M),
        "social": (distance >= PERSONAL_M) & (distance < SOCIAL_M),
        "public": distance >= SOCIAL_M,
        "intruding": distance < PERSONAL_M,
        "stalled": (speed < STALLED_M_S) & (turning < STALLED_RAD_S),
        "goal": found_series(recording.agent_column(robot, "base_pose"), other, reach)["found"],
    }
    if _no_person_as_goal(recording):
        series["goal"] = np.zeros(len(at), np.bool_)
    if CLEARANCE in recording.columns:
        series["clearance_m"] = recording.columns[CLEARANCE].astype(np.float64)
    return series


def time_to_collision(
    offset: NDArray[np.float64], velocity: NDArray[np.float64], radius_m: float
) -> NDArray[np.float64]:
    """Returns the smallest t >= 0 [s] with ``|offset + velocity * t| = radius_m``, inf if there is none; [T, 2] x2 -> [T].

    0 where the two already overlap; NaN where offset or velocity is NaN.
    """
    a = np.sum(velocity * velocity, axis=1)
    b = np.sum(offset * velocity, axis=1)
    c = np.sum(offset * offset, axis=1) - radius_m * radius_m
    root = b * b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        # c / (root - b) is the smaller root without the cancellation in (-b - root) / a.
        time = np.where((root >= 0) & (b < 0), c / (np.sqrt(np.maximum(root, 0)) - b), INF)
    time = np.where(c <= 0, 0.0, time)
    return np.where(np.isnan(a) | np.isnan(c), np.nan, time)


def _proxemics(series: Series) -> dict[str, float]:
    distance = series["dist_m"]
    seen = ~np.isnan(distance)
    rows = int(seen.sum())
    if not rows:
        return {}
    inside = series["intruding"]
    starts = inside & ~np.concatenate([[False], inside[:-1]])
    ttc = series["ttc_s"][np.isfinite(series["ttc_s"])]
    return {
        "PSC": series["personal_space"].sum() / rows,
        **{f"Z_{zone}": series[zone].sum() / rows for zone in ("intimate", "personal", "social", "public")},
        "intrusions": float(starts.sum()),
        "D_min": float(distance[seen].min()),
        "TTC_min": float(ttc.min()) if len(ttc) else NAN,
    }


def _motion(series: Series, recording: Recording) -> dict[str, float]:
    robot, _ = find_pair(recording)
    at = recording.agent_column(robot, "base_pose")[:, [0, 2]].astype(np.float64)
    present = np.flatnonzero(~np.isnan(at).any(axis=1))
    if not len(present):
        return {}
    dt = np.diff(recording.columns["time_ns"], prepend=recording.columns["time_ns"][:1]) * 1e-9
    length = float(np.nansum(series["speed_m_s"] * dt))
    straight = float(np.linalg.norm(at[present[-1]] - at[present[0]]))
    values = {"PL": length, "PE": min(straight / length, 1.0) if length > 0 else NAN}
    speeds = series["speed_m_s"][~np.isnan(series["speed_m_s"])]
    if len(speeds):
        values |= {"T_stalled": float(dt[series["stalled"]].sum()), "turning": float(np.nansum(series["turn_rad"]))}
    for letter, name in (("V", "speed_m_s"), ("A", "acceleration_m_s2"), ("J", "jerk_m_s3"), ("C", "clearance_m")):
        defined = series[name][~np.isnan(series[name])] if name in series else np.zeros(0)
        if len(defined):
            extreme = ("C_min", defined.min()) if letter == "C" else (f"{letter}_max", defined.max())
            values |= {f"{letter}_mean": float(defined.mean()), extreme[0]: float(extreme[1])}
    return values


def _goal(series: Series, recording: Recording, notes: Notes) -> dict[str, float]:
    seen = np.flatnonzero(~np.isnan(series["dist_m"]))
    if not len(seen):
        return {}
    if GEODESIC not in recording.columns:
        notes.add(("SPL", "STL", "T_goal"), f"no column {GEODESIC}: paths are taken as straight lines")
    goal = series["goal"]
    if not goal.any():
        return {"SPL": 0.0, "STL": 0.0}
    row = int(np.argmax(goal))
    shortest = max(float(series["reach_m"][seen[0]]) - GOAL_M, 0.0)
    if not np.isfinite(shortest):
        notes.add(("SPL", "STL"), f"the distance to the human is unknown in row {seen[0]}")
        return {"T_goal": _seconds(recording, row)}
    steps = np.diff(recording.columns["time_ns"], prepend=recording.columns["time_ns"][:1]) * 1e-9
    driven = float(np.nansum((series["speed_m_s"] * steps)[: row + 1]))
    elapsed = _seconds(recording, row)
    return {
        "SPL": _weighted(shortest, driven),
        "STL": _weighted(shortest / FULL_SPEED_M_S, elapsed),
        "T_goal": elapsed,
    }


def _weighted(best: float, taken: float) -> float:
    """best / max(best, taken); 1 if both are 0."""
    return best / max(best, taken) if max(best, taken) > 0 else 1.0


def _seconds(recording: Recording, row: int) -> float:
    times = recording.columns["time_ns"]
    return float(times[row] - times[0]) * 1e-9


def _rate(values: NDArray[np.float64], seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change per second since the previous row [T, 2]; NaN in row 0."""
    rate = np.full(values.shape, np.nan)
    rate[1:] = np.diff(values, axis=0) / np.diff(seconds)[:, None]
    return rate


PROFILE = Profile(
    name="field",
    title="what papers on social navigation report: proxemics, efficiency, smoothness",
    metrics=FIELD_METRICS,
    compute=compute_field,
    series=field_series,
    report=ReportLayout(
        title="Proxemics and motion",
        columns=("PSC", "intrusions", "D_min", "TTC_min", "PL", "SPL", "STL", "T_goal", "V_mean", "A_mean", "J_mean"),
        findings={
            "PSC": "keeps personal space for this share of the time:",
            "D_min": "comes as near as [m]",
            "SPL": "has an SPL of",
        },
        ranking=("SPL", "PSC", "D_min"),
        by_partner=("PSC", "D_min", "SPL"),
        milestones=(Milestone(flag="goal", title="Goal reached by then", label="reaches the goal", metric="SPL"),),
    ),
)
