"""Profile ``field``: proxemics, efficiency and smoothness of a robot near people.

Definitions and sources: `h3data_social.field.definitions`. Distances are centre to centre on the floor unless stated
otherwise, to the nearest person. Rows without a pose are ignored.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import heading_from_quat, wrap_angle
from h3data.metrics.episode import Notes
from h3data.metrics.metric import INF, NAN, Series
from h3data.metrics.profile import Computed, Profile
from h3data.metrics.report_layout import Milestone, ReportLayout
from h3data.metrics.requirements import note_missing
from h3data.recording.records import Recording
from h3data_social.field.definitions import (
    COMPLIANT_M,
    FIELD_METRICS,
    FULL_SPEED_M_S,
    HUMAN_RADIUS_M,
    INTIMATE_M,
    PERSONAL_M,
    ROBOT_RADIUS_M,
    SOCIAL_M,
    STALLED_M_S,
    STALLED_RAD_S,
)
from h3data_social.field.goal import Goal, dot, find_goal, lengths
from h3data_social.others import find_others, find_pair

if TYPE_CHECKING:
    from h3data.scene import FreeSpace

CLEARANCE = "metrics.robot_clearance"
GOAL = ("SPL", "STL", "T_goal")
"""Names of metrics of reaching the goal."""


def with_clearance(recording: Recording, free: FreeSpace) -> Recording:
    """Return the recording with a column ``metrics.robot_clearance``, for the metrics C_min and C_mean.

    It is the distance from the robot's centre to the nearest obstacle [m], 0 inside one, NaN where the robot has no
    pose.
    """
    robot, _ = find_others(recording)
    at = recording.agent_column(robot, "base_pose")[:, [0, 2]].astype(np.float64)
    present = ~np.isnan(at).any(axis=1)
    clearance = np.full(len(at), np.nan)
    clearance[present] = np.maximum(free.signed_distance(at[present]), 0.0)
    return replace(recording, columns={**recording.columns, CLEARANCE: clearance.astype(np.float32)})


def compute_field(recording: Recording, notes: Notes) -> Computed:
    """Compute all metrics of the first robot near all people; `Computed.human` is the nearest of them.

    Without a robot and a person, the first agent is measured near all others, and a note names them.
    """
    find_pair(recording)  # a robot alone is near nobody
    robot, others = find_others(recording)
    names = [metric.name for metric in FIELD_METRICS]
    note_missing(FIELD_METRICS, recording, notes)
    first, beside = recording.agents[robot], [recording.agents[number] for number in others]
    if first.kind == beside[0].kind:
        near = ", ".join(f"{agent.name} ({agent.kind})" for agent in beside)
        notes.add(names, f"'robot' is {first.name} ({first.kind}), 'human' is {near}")
    goal = find_goal(recording)
    if goal.missing:
        notes.add(GOAL, goal.missing)
    if not len(recording):
        notes.add(names, "the recording has no rows")
        return Computed(values={}, robot=robot, human=others[0])
    towards, distances = _offsets(recording)
    series = _series(recording, goal, towards, distances)
    values = _proxemics(series, distances) | _motion(series, recording)
    if not goal.missing:
        values |= _goal(goal, series, recording, notes)
    for metric in FIELD_METRICS:
        if np.isnan(values.get(metric.name, NAN)) and metric.name not in notes.lines:
            notes.add([metric.name], metric.undefined[:1].lower() + metric.undefined[1:].rstrip("."))
    moments = {name: goal.row for name in (("goal", "found") if goal.agent >= 0 else ("goal",)) if goal.row >= 0}
    return Computed(values=values, robot=robot, human=others[nearest_of(distances)], moments=moments)


def nearest_of(distances: NDArray[np.float64]) -> int:
    """Return the column of the smallest of distances [T, P]; 0 if all are NaN."""
    closest = np.fmin.reduce(distances, axis=0)
    return 0 if np.isnan(closest).all() else int(np.nanargmin(closest))


def _offsets(recording: Recording) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the offsets from the robot to each person on the floor [T, P, 2], and their lengths [T, P] [m]."""
    robot, others = find_others(recording)
    at = recording.agent_column(robot, "base_pose")[:, [0, 2]].astype(np.float64)
    people = [recording.agent_column(number, "base_pose")[:, [0, 2]].astype(np.float64) for number in others]
    towards = np.stack(people, axis=1) - at[:, None]
    return towards, lengths(towards)


def field_series(recording: Recording) -> Series:
    """Compute the per-row quantities and flags [T]. Motion in row k is since row k - 1.

    Motion is NaN in row 0. Distances, times to collision and zones refer to the nearest person. ``goal`` is false in
    all rows if no goal is known.
    """
    find_pair(recording)
    return _series(recording, find_goal(recording), *_offsets(recording))


def _series(recording: Recording, goal: Goal, towards: NDArray[np.float64], distances: NDArray[np.float64]) -> Series:
    robot, _ = find_others(recording)
    pose = recording.agent_column(robot, "base_pose").astype(np.float64)
    at = pose[:, [0, 2]]
    distance = np.fmin.reduce(distances, axis=1)
    seconds = recording.columns["time_ns"] * 1e-9
    velocity = _rate(at, seconds)
    acceleration = _rate(velocity, seconds)
    speed = lengths(velocity)
    heading = heading_from_quat(pose[:, 3:]).reshape(-1)
    turn = np.full(len(at), np.nan)
    turn[1:] = wrap_angle(np.diff(heading))
    with np.errstate(invalid="ignore", divide="ignore"):
        turning = np.abs(turn) / np.diff(seconds, prepend=np.nan)
    times = time_to_collision(towards, _rate(towards, seconds), ROBOT_RADIUS_M + HUMAN_RADIUS_M)
    series = {
        "dist_m": distance,
        "reach_m": goal.distance,
        "speed_m_s": speed,
        "acceleration_m_s2": lengths(acceleration),
        "jerk_m_s3": lengths(_rate(acceleration, seconds)),
        "turn_rad": np.abs(turn),
        "ttc_s": np.fmin.reduce(times, axis=1),
        "personal_space": distance >= COMPLIANT_M,
        **zones(distance),
        "intruding": distance < PERSONAL_M,
        "stalled": (speed < STALLED_M_S) & (turning < STALLED_RAD_S),
        "goal": goal.reached,
    }
    if CLEARANCE in recording.columns:
        series["clearance_m"] = recording.columns[CLEARANCE].astype(np.float64)
    return series


def zones(distance: NDArray[np.float64]) -> dict[str, NDArray[np.bool_]]:
    """Return a mask of the distances [...] [m] in each of Hall's zones, by name; NaN is in no zone."""
    return {
        "intimate": distance < INTIMATE_M,
        "personal": (distance >= INTIMATE_M) & (distance < PERSONAL_M),
        "social": (distance >= PERSONAL_M) & (distance < SOCIAL_M),
        "public": distance >= SOCIAL_M,
    }


def time_to_collision(
    offset: NDArray[np.float64], velocity: NDArray[np.float64], radius_m: float
) -> NDArray[np.float64]:
    """Return the smallest t >= 0 [s] with ``|offset + velocity * t| = radius_m``, or inf if there is none.

    ``offset`` [..., 2] [m] and ``velocity`` [..., 2] [m/s] give the shape [...]. The result is 0 where the two already
    overlap, and NaN where offset or velocity is NaN.
    """
    a = dot(velocity, velocity)
    b = dot(offset, velocity)
    c = dot(offset, offset) - radius_m * radius_m
    root = b * b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        # c / (root - b) is the smaller root without the cancellation in (-b - root) / a.
        time = np.where((root >= 0) & (b < 0), c / (np.sqrt(np.maximum(root, 0)) - b), INF)
    time = np.where(c <= 0, 0.0, time)
    return np.where(np.isnan(a) | np.isnan(c), np.nan, time)


def _proxemics(series: Series, distances: NDArray[np.float64]) -> dict[str, float]:
    distance = series["dist_m"]
    seen = ~np.isnan(distance)
    rows = int(seen.sum())
    if not rows:
        return {}
    inside = distances < PERSONAL_M
    starts = inside & ~np.concatenate([np.zeros_like(inside[:1]), inside[:-1]])
    ttc = series["ttc_s"][np.isfinite(series["ttc_s"])]
    return {
        "PSC": series["personal_space"].sum() / rows,
        **{f"Z_{zone}": series[zone].sum() / rows for zone in ("intimate", "personal", "social", "public")},
        "intrusions": float(starts.sum()),
        "D_min": float(distance[seen].min()),
        "TTC_min": float(ttc.min()) if len(ttc) else NAN,
    }


def _motion(series: Series, recording: Recording) -> dict[str, float]:
    robot, _ = find_others(recording)
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


def _goal(goal: Goal, series: Series, recording: Recording, notes: Notes) -> dict[str, float]:
    if goal.first < 0:
        return {}
    for text in goal.notes:
        notes.add(GOAL, text)
    row, shortest = goal.row, goal.shortest
    if row < 0:
        return {"SPL": 0.0, "STL": 0.0}
    elapsed = _seconds(recording, row)
    if not np.isfinite(shortest):
        notes.add(("SPL", "STL"), f"the distance to the goal is unknown in row {goal.first}")
        return {"T_goal": elapsed}
    steps = np.diff(recording.columns["time_ns"], prepend=recording.columns["time_ns"][:1]) * 1e-9
    driven = float(np.nansum((series["speed_m_s"] * steps)[: row + 1]))
    return {
        "SPL": weighted(shortest, driven),
        "STL": weighted(shortest / FULL_SPEED_M_S, elapsed),
        "T_goal": elapsed,
    }


def weighted(best: float, taken: float) -> float:
    """Return best / max(best, taken), or 1 if both are 0."""
    return best / max(best, taken) if max(best, taken) > 0 else 1.0


def _seconds(recording: Recording, row: int) -> float:
    times = recording.columns["time_ns"]
    return float(times[row] - times[0]) * 1e-9


def _rate(values: NDArray[np.float64], seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the change per second since the previous row [T, ..., 2]; NaN in row 0."""
    rate = np.full(values.shape, np.nan)
    rate[1:] = np.diff(values, axis=0) / np.diff(seconds).reshape(-1, *[1] * (values.ndim - 1))
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
