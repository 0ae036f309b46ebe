"""One pass over ragged columns of many episodes: everything that the social navigation metrics need to know.

Episodes lie end to end in one array per column; ``offsets`` [E + 1] says where each begins and ends. One sweep counts,
the formulas come afterwards (`h3data.metrics.paper.social_nav`). Measured rows per second: ``benchmarks/metrics.py``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel

NEVER = -1
"""Row of an encounter or a contact that did not happen."""


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Numbers of the task that decide what counts. Defaults: the paper."""

    near_m: float = 1.0
    """Smallest distance of finding and following [m], inclusive."""
    far_m: float = 2.0
    """Largest distance of finding and following [m], inclusive."""
    facing: float = 0.5
    """The robot faces the human if forward . unit(robot -> human) on the floor is greater."""
    avoid_m: float = 1.5
    """Backing up and yielding count below this L2 distance [m]."""
    yield_m_s: float = 0.1
    """The robot yields below this speed [m/s]."""
    still_m_s: float = 1e-3
    """Forward speeds within +- this are not a motion [m/s]: float32 positions at 30 Hz make up to 3e-4 of noise."""


PAPER = Thresholds()


@dataclass(frozen=True, kw_only=True, eq=False)
class Counts:
    """What one sweep finds, one entry per episode."""

    rows: NDArray[np.int64]
    """Steps of the episode, shape [E]."""
    first_found: NDArray[np.int64]
    """Row of the first encounter, `NEVER` if there is none, shape [E]."""
    following: NDArray[np.int64]
    """Rows with the robot within 1-2 m and facing the human, shape [E]."""
    avoiding: NDArray[np.int64]
    """Rows in which the robot backs up or yields near the human, shape [E]."""
    seen: NDArray[np.int64]
    """Rows in which both agents have a pose, shape [E]."""
    distance_sum_m: NDArray[np.float64]
    """Sum of the L2 distance over ``seen`` [m], shape [E]."""
    seen_after: NDArray[np.int64]
    """``seen`` from the first encounter on, that row included, shape [E]."""
    distance_sum_after_m: NDArray[np.float64]
    """Sum of the L2 distance over ``seen_after`` [m], shape [E]."""
    first_contact: NDArray[np.int64]
    """Row of the first robot-human contact, `NEVER` if there is none, shape [E]."""


def count(
    *,
    robot_pose: NDArray[np.float32],
    human_pose: NDArray[np.float32],
    reach_m: NDArray[np.float32],
    time_ns: NDArray[np.int64],
    collision: NDArray[np.bool_],
    offsets: NDArray[np.int64],
    thresholds: Thresholds = PAPER,
) -> Counts:
    """Counts of every episode in ragged columns.

    ``robot_pose`` and ``human_pose`` are pose7 [N, 7]; ``reach_m`` [N] is the distance that decides about finding and
    following (geodesic; where it is NaN nothing is found); ``collision`` [N]; ``offsets`` [E + 1].
    """
    t = thresholds
    sweep = _sweep(
        np.ascontiguousarray(robot_pose, np.float32),
        np.ascontiguousarray(human_pose, np.float32),
        np.ascontiguousarray(reach_m, np.float32),
        np.ascontiguousarray(time_ns, np.int64),
        np.ascontiguousarray(collision, np.bool_),
        np.ascontiguousarray(offsets, np.int64),
        np.array([t.near_m, t.far_m, t.facing, t.avoid_m, t.yield_m_s, t.still_m_s]),
    )
    whole, sums = sweep
    return Counts(
        rows=np.diff(offsets),
        first_found=whole[:, 0],
        following=whole[:, 1],
        avoiding=whole[:, 2],
        seen=whole[:, 3],
        distance_sum_m=sums[:, 0],
        seen_after=whole[:, 4],
        distance_sum_after_m=sums[:, 1],
        first_contact=whole[:, 5],
    )


@kernel(inline="always")
def _forward_xz(pose):
    """Horizontal part (x, z) of the x axis of a pose7, unit; zero if it points straight up."""
    qx, qy, qz, qw = np.float64(pose[3]), np.float64(pose[4]), np.float64(pose[5]), np.float64(pose[6])
    x, z = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qz - qy * qw)
    length = np.sqrt(x * x + z * z)
    if length > 0:
        return x / length, z / length
    return 0.0, 0.0


@kernel()
def _sweep(robot, human, reach, time_ns, collision, offsets, limits):
    near, far, facing, avoid, slow, still = limits
    episodes = len(offsets) - 1
    whole = np.zeros((episodes, 6), np.int64)
    sums = np.zeros((episodes, 2), np.float64)
    for e in range(episodes):
        start, stop = offsets[e], offsets[e + 1]
        found_row, contact_row = NEVER, NEVER
        following, avoiding, seen, seen_after = 0, 0, 0, 0
        total, after = 0.0, 0.0
        for k in range(start, stop):
            if collision[k] and contact_row == NEVER:
                contact_row = k - start
            dx = np.float64(human[k, 0]) - np.float64(robot[k, 0])
            dy = np.float64(human[k, 1]) - np.float64(robot[k, 1])
            dz = np.float64(human[k, 2]) - np.float64(robot[k, 2])
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            if np.isnan(distance):
                continue
            seen += 1
            total += distance
            if near <= reach[k] <= far:  # the facing test costs a rotation: only where it can matter
                fx, fz = _forward_xz(robot[k])
                if fx * dx + fz * dz > facing * np.sqrt(dx * dx + dz * dz):
                    following += 1
                    if found_row == NEVER:
                        found_row = k - start
            if found_row != NEVER:
                seen_after += 1
                after += distance
            if distance < avoid and k > start:  # row 0 has no row before it, so no velocity
                mx = np.float64(robot[k, 0]) - np.float64(robot[k - 1, 0])
                mz = np.float64(robot[k, 2]) - np.float64(robot[k - 1, 2])
                dt = np.float64(time_ns[k] - time_ns[k - 1]) * 1e-9
                fx, fz = _forward_xz(robot[k - 1])
                if mx * fx + mz * fz < -still * dt or np.sqrt(mx * mx + mz * mz) < slow * dt:
                    avoiding += 1
        whole[e] = found_row, following, avoiding, seen, seen_after, contact_row
        sums[e] = total, after
    return whole, sums
