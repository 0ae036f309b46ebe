"""Social navigation metrics of one recording, by the paper's formulas: S, SPS, F, CR, BYR, TD, FD.

Formulas, sources and readings of unclear points: `h3data.metrics.paper.social_nav_records`. Whatever a recording cannot tell
is NaN, and a note says why; nothing is guessed and nothing undefined becomes 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import heading_direction, heading_from_quat, normalized
from h3data.metrics.metric import NAN, EpisodeMetrics, Metric, Notes, Series, episode_metrics, find_agents
from h3data.metrics.paper.social_nav_records import PAPER_SOCIAL_NAV
from h3data.recording.records import Recording

if TYPE_CHECKING:
    from h3data.metrics.paper.kernels import Counts


def social_nav_metrics() -> tuple[Metric, ...]:
    """The paper's metrics of social navigation."""
    return PAPER_SOCIAL_NAV


def measure_social_nav(recording: Recording) -> EpisodeMetrics:
    """S, SPS, F, CR, BYR, TD and FD of one recording, between its first robot and its first human."""
    from h3data.metrics.paper.kernels import count

    robot, human = find_agents(recording)
    columns = recording.columns
    rows = len(recording)
    notes = Notes()
    reach = reach_distance(recording, robot, human)
    if "metrics.geodesic_agents" not in columns:
        text = "no column metrics.geodesic_agents: 'found' uses the L2 distance, which sees through walls"
        notes.add(("S", "SPS", "F", "FD"), text)
    elif unknown := int(np.isnan(reach).sum()):
        notes.add(("S", "SPS", "F", "FD"), f"{unknown} of {rows} rows have no geodesic distance: not found there")
    has_collision = "metrics.collision" in columns
    counts = count(
        robot_pose=columns[f"agent_{robot}.base_pose"],
        human_pose=columns[f"agent_{human}.base_pose"],
        reach_m=reach,
        time_ns=columns["time_ns"],
        collision=columns["metrics.collision"] if has_collision else np.zeros(rows, np.bool_),
        offsets=np.array([0, rows]),
    )
    values = _values(recording, counts, has_collision, notes)
    return episode_metrics(
        recording,
        PAPER_SOCIAL_NAV,
        values,
        notes,
        robot=robot,
        human=human,
        encounter_row=int(counts.first_found[0]),
        contact_row=int(counts.first_contact[0]),
    )


def social_nav_series(recording: Recording) -> Series:
    """Distances, facing, and the flags that the paper's metrics count, row by row [T].

    ``dist_m`` L2, ``reach_m`` what finding goes by, ``facing_dot``, ``speed_m_s`` (NaN in row 0); flags ``in_reach``,
    ``facing``, ``found``, ``near`` (below 1.5 m), ``backs_up``, ``yields`` and, if recorded, ``collision``.
    """
    from h3data.metrics.paper.kernels import PAPER

    robot, human = find_agents(recording)
    pose = recording.agent_column(robot, "base_pose").astype(np.float64)
    towards = recording.agent_column(human, "base_pose")[:, :3].astype(np.float64) - pose[:, :3]
    forward = heading_direction(heading_from_quat(pose[:, 3:])).reshape(-1, 2)
    dist = np.linalg.norm(towards, axis=1)
    reach = np.where(np.isnan(dist), np.nan, reach_distance(recording, robot, human))
    dot = np.sum(forward * normalized(towards[:, [0, 2]]), axis=1)
    in_reach = (reach >= PAPER.near_m) & (reach <= PAPER.far_m)
    along, speed = _motion(pose, forward, recording.columns["time_ns"])
    near = dist < PAPER.avoid_m
    series: dict[str, NDArray] = {
        "dist_m": dist,
        "reach_m": reach,
        "facing_dot": dot,
        "speed_m_s": speed,
        "in_reach": in_reach,
        "facing": dot > PAPER.facing,
        "found": in_reach & (dot > PAPER.facing),
        "near": near,
        "backs_up": near & (along < -PAPER.still_m_s),
        "yields": near & ~(along < -PAPER.still_m_s) & (speed < PAPER.yield_m_s),
    }
    if "metrics.collision" in recording.columns:
        series["collision"] = recording.columns["metrics.collision"].astype(np.bool_)
    return series


def _motion(pose: NDArray, forward: NDArray, time_ns: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Speed since the row before along the heading in that row, and on the floor [m/s]; NaN in row 0. Shapes [T]."""
    along, speed = np.full(len(pose), np.nan), np.full(len(pose), np.nan)
    step = np.diff(pose[:, [0, 2]], axis=0)
    dt = np.diff(time_ns) * 1e-9
    along[1:], speed[1:] = np.sum(step * forward[:-1], axis=1) / dt, np.linalg.norm(step, axis=1) / dt
    return along, speed


def reach_distance(recording: Recording, robot: int, human: int) -> NDArray[np.float32]:
    """Distance that decides about finding and following [m], shape [T]: geodesic if recorded, else L2."""
    stored = recording.columns.get("metrics.geodesic_agents")
    if stored is not None:
        return stored.astype(np.float32, copy=False)
    return l2_distance(recording, robot, human)


def l2_distance(recording: Recording, robot: int, human: int) -> NDArray[np.float32]:
    """Straight distance between the base positions of two agents [m], shape [T]; NaN where one is absent."""
    a = recording.agent_column(robot, "base_pose")[:, :3].astype(np.float64)
    b = recording.agent_column(human, "base_pose")[:, :3].astype(np.float64)
    return np.linalg.norm(a - b, axis=1).astype(np.float32)


def following_rows(recording: Recording, robot: int, human: int) -> NDArray[np.bool_]:
    """Rows in which the robot is within 1-2 m of the human and faces it, shape [T]: what ``w`` counts."""
    from h3data.metrics.paper.kernels import PAPER

    pose = recording.agent_column(robot, "base_pose").astype(np.float64)
    towards = recording.agent_column(human, "base_pose")[:, :3].astype(np.float64) - pose[:, :3]
    forward = heading_direction(heading_from_quat(pose[:, 3:]))
    facing = np.sum(forward * normalized(towards[:, [0, 2]]), axis=1) > PAPER.facing
    reach = reach_distance(recording, robot, human)
    return facing & (reach >= PAPER.near_m) & (reach <= PAPER.far_m)


def _values(recording: Recording, counts: Counts, has_collision: bool, notes: Notes) -> dict[str, float]:
    rows, seen = int(counts.rows[0]), int(counts.seen[0])
    values: dict[str, float] = dict.fromkeys(("S", "SPS", "F", "CR", "BYR", "TD", "FD"), NAN)
    values["CR"] = _collision(counts, has_collision, rows, notes)
    if seen == 0:
        why = "the recording has no rows" if rows == 0 else "no row has a pose of both agents"
        notes.add(("S", "SPS", "F", "BYR", "TD", "FD"), why)
        return values
    if seen < rows:
        notes.add(("S", "BYR", "TD", "FD"), f"{rows - seen} of {rows} rows lack a pose and are left out")
    found = counts.first_found[0] >= 0
    values["S"] = float(found)
    values["BYR"] = float(counts.avoiding[0] / seen)
    values["TD"] = float(counts.distance_sum_m[0] / seen)
    if recording.episode.task == "gfx_replay":
        notes.add(("BYR",), "a gfx-replay has no time stamps: speeds assume its nominal frame rate")
    if found:
        values["FD"] = float(counts.distance_sum_after_m[0] / counts.seen_after[0])
        values["SPS"], values["F"] = _against_oracle(recording, counts, notes)
    else:
        values["SPS"] = values["F"] = 0.0
        notes.add(("FD",), "the robot never finds the human")
    return values


def _collision(counts: Counts, has_collision: bool, rows: int, notes: Notes) -> float:
    if not has_collision or rows == 0:
        notes.add(("CR",), "no column metrics.collision" if rows else "the recording has no rows")
        return NAN
    first = int(counts.first_contact[0])
    if 0 <= first < rows - 1:
        notes.add(("CR",), f"the recording goes on after the first contact in row {first}")
    return float(first >= 0)


def _against_oracle(recording: Recording, counts: Counts, notes: Notes) -> tuple[float, float]:
    """SPS and F of an episode in which the human was found (paper section 4.1)."""
    info = recording.episode.info
    oracle = info.get("oracle_min_steps")
    if "oracle_min_steps" not in info:
        notes.add(("SPS", "F"), "the oracle's minimum steps l are not recorded (info oracle_min_steps)")
        return NAN, NAN
    if oracle is None:
        notes.add(("SPS", "F"), "the simulator's oracle never reached the human, so l is undefined")
        return NAN, NAN
    if not _is_count(oracle):
        notes.add(("SPS", "F"), f"info oracle_min_steps must be a whole number >= 1, is {oracle!r}")
        return NAN, NAN
    limit = info.get("max_steps")
    if not _is_count(limit):
        limit = int(counts.rows[0])
        notes.add(("F",), f"the longest duration E is not recorded (info max_steps): {limit} rows taken")
    steps, following = int(counts.first_found[0]) + 1, int(counts.following[0])
    return oracle / max(oracle, steps), following / max(limit - oracle, following)


def _is_count(value: object) -> bool:
    """Whether ``value`` is a whole number of at least 1. JSON readers may hand out 120.0 for 120."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return value >= 1 and float(value).is_integer()
