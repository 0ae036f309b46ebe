"""Social navigation metrics of one recording, by the paper's formulas: S, SPS, F, CR, BYR, TD, FD.

Formulas, sources and readings of unclear points: `h3data.metrics.registry`. Whatever a recording cannot tell is NaN,
and a note says why; nothing is guessed and nothing undefined becomes 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import heading_direction, heading_from_quat, normalized
from h3data.metrics.registry import metrics_of
from h3data.recording.records import Recording

if TYPE_CHECKING:
    from h3data.metrics.kernels import Counts

NAN = float("nan")


@dataclass(frozen=True, kw_only=True)
class EpisodeMetrics:
    """The metrics of one episode."""

    episode_id: str
    uid: str
    profile: str
    values: Mapping[str, float]
    """By metric name; NaN = this recording cannot tell, see ``notes``."""
    notes: Mapping[str, str]
    """By metric name: why it is undefined, or what was used in place of missing data."""
    robot: int
    """Index of the robot that was measured."""
    human: int
    """Index of the human that was measured."""
    encounter_row: int
    """Row in which the robot first found the human; -1 = never."""
    contact_row: int
    """Row of the first robot-human contact; -1 = none known."""
    rows: int

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON types; NaN becomes None."""
        return {
            "episode_id": self.episode_id,
            "uid": self.uid,
            "profile": self.profile,
            "steps": self.rows,
            "robot": self.robot,
            "human": self.human,
            "encounter_row": self.encounter_row,
            "contact_row": self.contact_row,
            "values": {k: None if np.isnan(v) else v for k, v in self.values.items()},
            "notes": dict(self.notes),
        }


def measure(recording: Recording, profile: str = "paper") -> EpisodeMetrics:
    """Metrics of one recording, between its first robot and its first human. Reads only columns, never a simulator."""
    from h3data.metrics.kernels import count

    names = [m.name for m in metrics_of(profile)]
    robot, human = find_agents(recording)
    columns = recording.columns
    rows = len(recording)
    notes = _Notes()
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
    return EpisodeMetrics(
        episode_id=recording.episode.episode_id,
        uid=recording.episode.uid,
        profile=profile,
        values={name: values[name] for name in names},
        notes=notes.joined(names),
        robot=robot,
        human=human,
        encounter_row=int(counts.first_found[0]),
        contact_row=int(counts.first_contact[0]),
        rows=rows,
    )


def find_agents(recording: Recording) -> tuple[int, int]:
    """Indices of the first robot and the first human; an `InputError` says who was found instead."""
    agents = recording.agents
    chosen = [next((i for i, a in enumerate(agents) if a.kind == kind), None) for kind in ("robot", "human")]
    robot, human = chosen
    if robot is not None and human is not None:
        return robot, human
    missing = " and ".join(f"no {kind}" for kind, i in zip(("robot", "human"), chosen, strict=True) if i is None)
    there = ", ".join(f"{a.name} ({a.kind})" for a in agents) or "no agents at all"
    raise InputError(
        f"Social navigation metrics need a robot and a human; recording {recording.episode.episode_id!r} has {missing} "
        f"(found: {there})."
    )


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
    from h3data.metrics.kernels import PAPER

    pose = recording.agent_column(robot, "base_pose").astype(np.float64)
    towards = recording.agent_column(human, "base_pose")[:, :3].astype(np.float64) - pose[:, :3]
    forward = heading_direction(heading_from_quat(pose[:, 3:]))
    facing = np.sum(forward * normalized(towards[:, [0, 2]]), axis=1) > PAPER.facing
    reach = reach_distance(recording, robot, human)
    return facing & (reach >= PAPER.near_m) & (reach <= PAPER.far_m)


def _values(recording: Recording, counts: Counts, has_collision: bool, notes: _Notes) -> dict[str, float]:
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


def _collision(counts: Counts, has_collision: bool, rows: int, notes: _Notes) -> float:
    if not has_collision or rows == 0:
        notes.add(("CR",), "no column metrics.collision" if rows else "the recording has no rows")
        return NAN
    first = int(counts.first_contact[0])
    if 0 <= first < rows - 1:
        notes.add(("CR",), f"the recording goes on after the first contact in row {first}")
    return float(first >= 0)


def _against_oracle(recording: Recording, counts: Counts, notes: _Notes) -> tuple[float, float]:
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


class _Notes:
    """Collects notes per metric, in order."""

    def __init__(self) -> None:
        self._lines: dict[str, list[str]] = {}

    def add(self, names: tuple[str, ...], text: str) -> None:
        for name in names:
            self._lines.setdefault(name, []).append(text)

    def joined(self, names: list[str]) -> dict[str, str]:
        return {name: "; ".join(self._lines[name]) for name in names if name in self._lines}
