"""Computes the paper's social navigation metrics of one recording: S, SPS, F, CR, BYR, TD, FD.

Formulas, sources and interpretations: `h3data.metrics.paper.social_nav_definitions`. What a recording cannot tell is NaN,
and a note says why; nothing is guessed, and nothing undefined becomes 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.metrics.episode import Notes, first_moments
from h3data.metrics.metric import NAN, Series
from h3data.metrics.paper.encounter import encounter_series, found_series
from h3data.metrics.paper.protocol import protocol_deviations
from h3data.metrics.profile import Computed
from h3data.metrics.requirements import find_agents
from h3data.recording.records import Recording

GEODESIC, COLLISION = "metrics.geodesic_agents", "metrics.collision"


def compute_social_nav(recording: Recording, notes: Notes) -> Computed:
    """Computes S, SPS, F, CR, BYR, TD and FD between the first robot and the first human."""
    robot, human = find_agents(recording)
    rows = len(recording)
    series = social_nav_series(recording)
    if GEODESIC not in recording.columns:
        text = f"no column {GEODESIC}: 'found' uses the L2 distance, which sees through walls"
        notes.add(("S", "SPS", "F", "FD"), text)
    elif unknown := int(np.isnan(recording.columns[GEODESIC]).sum()):
        notes.add(("S", "SPS", "F", "FD"), f"{unknown} of {rows} rows have no geodesic distance: not found there")
    moments = first_moments(series, ("found", "collision"))
    values = {"CR": _collision(series, rows, notes)}
    values |= _distances(series, rows, notes)
    if "S" in values:
        found = int(series["found"].sum())
        values |= (
            {"SPS": 0.0, "F": 0.0} if not found else _against_oracle(recording, moments["found"] + 1, found, notes)
        )
        if recording.episode.task == "gfx_replay":
            notes.add(("BYR",), "a gfx-replay has no time stamps: speeds assume its nominal frame rate")
    return Computed(
        values=values,
        robot=robot,
        human=human,
        moments=moments,
        protocol_deviations=protocol_deviations(recording),
    )


def social_nav_series(recording: Recording) -> Series:
    """Computes `encounter_series` between the first robot and the first human, and ``collision`` if recorded, each [T]."""
    robot, human = find_agents(recording)
    series = encounter_series(
        recording.agent_column(robot, "base_pose"),
        recording.agent_column(human, "base_pose"),
        reach_distance(recording, robot, human),
        recording.columns["time_ns"],
    )
    if COLLISION in recording.columns:
        series["collision"] = recording.columns[COLLISION].astype(np.bool_)
    return series


def reach_distance(recording: Recording, robot: int, human: int) -> NDArray[np.float32]:
    """Returns the distance that decides about finding and following [m], shape [T]: geodesic if recorded, else L2."""
    stored = recording.columns.get(GEODESIC)
    if stored is not None:
        return stored.astype(np.float32, copy=False)
    return l2_distance(recording, robot, human)


def l2_distance(recording: Recording, robot: int, human: int) -> NDArray[np.float32]:
    """Returns the straight distance between the base positions of two agents [m], shape [T]; NaN where one is absent."""
    a = recording.agent_column(robot, "base_pose")[:, :3].astype(np.float64)
    b = recording.agent_column(human, "base_pose")[:, :3].astype(np.float64)
    return np.linalg.norm(a - b, axis=1).astype(np.float32)


def following_rows(recording: Recording, robot: int, human: int) -> NDArray[np.bool_]:
    """Returns the rows in which the robot is within 1-2 m of the human and faces them, shape [T]: the rows ``w`` counts."""
    robot_pose, human_pose = (recording.agent_column(agent, "base_pose") for agent in (robot, human))
    return found_series(robot_pose, human_pose, reach_distance(recording, robot, human))["found"]


def _collision(series: Series, rows: int, notes: Notes) -> float:
    if "collision" not in series or rows == 0:
        notes.add(("CR",), f"no column {COLLISION}" if rows else "the recording has no rows")
        return NAN
    if not series["collision"].any():
        return 0.0
    first = int(np.argmax(series["collision"]))
    if first < rows - 1:
        notes.add(("CR",), f"the recording goes on after the first contact in row {first}")
    return 1.0


def _distances(series: Series, rows: int, notes: Notes) -> dict[str, float]:
    """S, BYR, TD and FD; nothing if no row has both poses."""
    distance = series["dist_m"]
    seen = ~np.isnan(distance)
    count = int(seen.sum())
    if count == 0:
        why = "the recording has no rows" if rows == 0 else "no row has a pose of both agents"
        notes.add(("S", "SPS", "F", "BYR", "TD", "FD"), why)
        return {}
    if count < rows:
        notes.add(("S", "BYR", "TD", "FD"), f"{rows - count} of {rows} rows lack a pose and are left out")
    found = bool(series["found"].any())
    values = {
        "S": float(found),
        "BYR": int((series["backs_up"] | series["yields"]).sum()) / count,
        "TD": _sum(distance[seen]) / count,
    }
    if found:
        after = distance[int(np.argmax(series["found"])) :]
        after = after[~np.isnan(after)]
        values["FD"] = _sum(after) / len(after)
    else:
        notes.add(("FD",), "the robot never finds the human")
    return values


def _sum(values: NDArray[np.float64]) -> float:
    # One after the other: np.sum adds pairwise, whose last bit depends on the number of rows and on NumPy's blocks.
    return float(np.add.accumulate(values)[-1])


def _against_oracle(recording: Recording, steps: int, following: int, notes: Notes) -> dict[str, float]:
    """SPS and F of an episode in which the human was found after ``steps`` (paper section 4.1)."""
    info = recording.episode.info
    oracle = info.get("oracle_min_steps")
    if "oracle_min_steps" not in info:
        notes.add(("SPS", "F"), "the oracle's minimum steps l are not recorded (info oracle_min_steps)")
        return {}
    if oracle is None:
        notes.add(("SPS", "F"), "the simulator's oracle never reached the human, so l is undefined")
        return {}
    if not _is_count(oracle):
        notes.add(("SPS", "F"), f"info oracle_min_steps must be a whole number >= 1, is {oracle!r}")
        return {}
    limit: Any = info.get("max_steps")
    if not _is_count(limit):
        limit = len(recording)
        notes.add(("F",), f"the longest duration E is not recorded (info max_steps): {limit} rows taken")
    return {"SPS": oracle / max(oracle, steps), "F": following / max(limit - oracle, following)}


def _is_count(value: object) -> bool:
    """Whether ``value`` is a whole number of at least 1. JSON readers may return 120.0 for 120."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return value >= 1 and float(value).is_integer()
