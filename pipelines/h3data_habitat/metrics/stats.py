"""Habitat-lab's ``SocialNavStats`` at every step, bug for bug, from arrays.

Row 0 is the reset, which Habitat counts as step 1. The arithmetic is float32 where Habitat's is: sums of distances, and the
robot's motion in its own previous frame, whose sign decides between backing up and yielding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.metrics.habitat_settings import StatsConfig

_SENTINEL = 1500
"""Value of ``has_found_human_step`` before the human is found, whatever the configuration."""
_HZ = 120.0


@dataclass(frozen=True, kw_only=True, eq=False)
class HabitatTrack:
    """Positions of one episode in Habitat's data types."""

    robot_pos: NDArray[np.float32]
    """Positions of the base [T, 3] [m]."""
    human_pos: NDArray[np.float32]
    robot_transform: NDArray[np.float32]
    """Matrix from the robot's root frame (x forward, y up) to the world, shape [T, 4, 4], translation in the last
    column."""
    geodesic: NDArray[np.floating]
    """Shortest path from robot to human [m], inf if there is none, shape [T]."""

    def distance(self) -> NDArray[np.float32]:
        """Return the L2 distance in space [m], shape [T]."""
        gap = self.robot_pos - self.human_pos
        return np.sqrt(np.sum(gap * gap, axis=1))

    def facing(self) -> NDArray[np.float32]:
        """Return the cosine between forward and the direction to the human on the floor, NaN if they coincide; shape [T]."""
        towards = (self.human_pos - self.robot_pos)[:, [0, 2]]
        return np.sum(unit_vectors(self.robot_transform[:, [0, 2], 0]) * unit_vectors(towards), axis=1)

    def found(self, config: StatsConfig) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the rows with the human in reach and the rows with the robot facing them, each [T]."""
        with np.errstate(invalid="ignore"):
            in_reach = (self.geodesic >= config.min_dis_human) & (self.geodesic <= config.max_dis_human)
            return in_reach, self.facing() > config.robot_face_human_threshold


def social_nav_stats(
    track: HabitatTrack,
    config: StatsConfig,
    *,
    found: NDArray[np.bool_],
    min_steps: float,
    backs_up: NDArray[np.bool_],
    yields: NDArray[np.bool_],
) -> dict[str, NDArray[np.float64]]:
    """Compute every key of ``SocialNavStats``, in its spelling, at every step [T].

    Args:
        track: The episode.
        config: Settings.
        found: Rows in which the human is in reach and faced, see `HabitatTrack.found`.
        min_steps: The oracle's l, the step at which Habitat finds it; inf if shortest paths are switched off or it never
            finds one.
        backs_up: From `backup_and_yield`.
        yields: From `backup_and_yield`.
    """
    steps = np.arange(1, len(track.geodesic) + 1)
    distance = track.distance()
    has_found = np.logical_or.accumulate(found)
    times = np.cumsum(found)
    after = np.maximum(np.cumsum(has_found), 1)
    found_step = _found_step(has_found, steps)
    # the oracle has found it from this step on, and before that it is infinite
    shortest = np.where(steps >= min_steps, min_steps, np.inf)
    with np.errstate(invalid="ignore", divide="ignore"):
        spl = has_found * shortest / np.maximum(shortest, found_step)
        left = config.total_steps - shortest
        followed = np.where(left == 0, np.nan, times / np.where(left == 0, 1, left))  # Python: ZeroDivisionError
    stats = {
        "has_found_human": has_found,
        "found_human_rate_over_epi": times / steps,
        "found_human_rate_after_encounter_over_epi": times / after,
        # sums in float32, as Habitat adds them up step by step
        "avg_robot_to_human_dis_over_epi": np.cumsum(distance) / steps.astype(np.float32),
        "avg_robot_to_human_after_encounter_dis_over_epi": np.cumsum(np.where(has_found, distance, np.float32(0)))
        / after.astype(np.float32),
        "first_encounter_spl": np.where(np.isnan(spl), 0.0, spl),
        "frist_ecnounter_steps": found_step,
        "frist_ecnounter_steps_ratio": found_step / shortest,
        "follow_human_steps_after_frist_encounter": times,
        "follow_human_steps_ratio_after_frist_encounter": followed,
        "backup_ratio": np.cumsum(backs_up) / steps,
        "yield_ratio": np.cumsum(yields) / steps,
    }
    return {name: np.asarray(values, np.float64) for name, values in stats.items()}


def _found_step(has_found: NDArray[np.bool_], steps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Step of the first encounter as known at each step; 1500 exactly is mistaken for "not yet" and moves on to 1501."""
    first = int(np.argmax(has_found)) + 1 if has_found.any() else _SENTINEL
    found_step = np.where(has_found, first, _SENTINEL)
    if first == _SENTINEL and has_found.any():
        found_step[steps > _SENTINEL] = _SENTINEL + 1
    return found_step


def backup_and_yield(
    track: HabitatTrack, config: StatsConfig, *, dead_zone_m: float = 0.0
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the rows in which the robot backs up, and those in which it yields, each [T].

    For a robot that stands or turns on the spot, float32 rounding decides between the two; with its exact transforms the
    rows are Habitat's. The sum of both does not depend on rounding. Motions of ``dead_zone_m`` per step or less do not
    count as backing up (0 = as Habitat).
    """
    backs_up, yields = (np.zeros(len(track.geodesic), np.bool_) for _ in range(2))
    near = np.flatnonzero(track.distance() <= config.dis_threshold_for_backup_yield)
    # the first row is compared with itself, as after a reset
    moved = _transform_points(_inverse(track.robot_transform[np.maximum(near - 1, 0)]), track.robot_pos[near])[
        :, [0, 2]
    ]
    length = np.sqrt(np.sum(moved * moved, axis=1))
    # by the rate of the physics, although a step of the task is 1/30 s: Habitat does
    velocity = length / np.float32(1 / _HZ) * np.sign(moved[:, 0])
    backs_up[near] = (velocity < 0) & (length > dead_zone_m)
    yields[near] = ~backs_up[near] & (np.abs(velocity) < config.min_abs_vel_for_yield)
    return backs_up, yields


# --- float32 algebra in the order of Magnum's, on which Habitat's rounding rests --------------------------------------
_OTHERS = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))


def _inverse(matrices: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the inverses [T, 4, 4] by the adjugate, operation by operation in float32."""
    # Magnum's matrices are column by column, and its order of operations decides the last bit
    m = np.ascontiguousarray(matrices.transpose(2, 1, 0))  # [column, row, T]
    signs = (1 - 2 * (np.indices((4, 4)).sum(0) % 2)).astype(np.float32)
    determinant = np.zeros(m.shape[2], np.float32)
    for column in range(4):
        determinant = determinant + signs[column, 0] * m[column, 0] * _minor(m, column, 0)
    inverse = np.empty_like(m)
    with np.errstate(divide="ignore", invalid="ignore"):
        for column in range(4):
            for row in range(4):
                inverse[column, row] = signs[column, row] * _minor(m, row, column) / determinant
    return inverse.transpose(2, 1, 0)


def _minor(m: NDArray[np.float32], i: int, j: int) -> NDArray[np.float32]:
    """Return the determinant of the 3 x 3 without column i and row j."""
    (a, b, c), (d, e, f), (g, h, k) = [[m[column, row] for row in _OTHERS[j]] for column in _OTHERS[i]]
    return a * (e * k - h * f) - b * (d * k - g * f) + c * (d * h - g * e)


def _transform_points(matrices: NDArray[np.float32], points: NDArray[np.float32]) -> NDArray[np.float32]:
    moved: NDArray[Any] = matrices[:, :3, 0] * points[:, :1]
    for k in (1, 2):
        moved = moved + matrices[:, :3, k] * points[:, k : k + 1]
    return moved + matrices[:, :3, 3]


def unit_vectors(vectors: NDArray[Any]) -> NDArray[Any]:
    """Return vectors [T, 2] scaled to length 1 in their own precision; NaN for zero vectors."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.divide(vectors, np.sqrt(np.sum(vectors * vectors, axis=1, keepdims=True)), dtype=vectors.dtype)
