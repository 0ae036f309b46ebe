"""Per-row quantities of robot and person by the paper's rules: distance, facing, found, backing up and yielding.

This module holds the definition of "found" for the paper's metrics; habitat-lab's own definition is in
`h3data_habitat.metrics.stats`.
"""

# NumPy, so that a command over a few episodes does not import numba (0.25 s); a kernel (`encounter_kernel`), a tenth of the
# time, where numba is there anyway or so many rows are measured that it is worth its import. Values are the same to the
# last bit.

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Limits of finding and following, by default those of the paper."""

    near_m: float = 1.0
    """Smallest distance of finding and following [m], inclusive."""
    far_m: float = 2.0
    """Largest distance of finding and following [m], inclusive."""
    facing: float = 0.5
    """Cosine on the floor between the robot's forward axis and the direction to the human, above which the robot faces
    them."""
    avoid_m: float = 1.5
    """Distance (L2) below which backing up and yielding count [m]."""
    yield_m_s: float = 0.1
    """Speed below which the robot yields [m/s]."""
    still_m_s: float = 1e-3
    """Forward speed up to which a robot counts as standing [m/s]; float32 positions at 30 Hz have noise of up to 3e-4
    m/s."""


PAPER = Thresholds()

MANY_ROWS = 3_000_000
"""Number of rows in one process above which importing numba saves time (2,000 episodes of the paper's length)."""
_measured_rows = 0


def found_series(
    robot_pose: NDArray[np.float32],
    human_pose: NDArray[np.float32],
    reach_m: NDArray[np.floating],
    *,
    thresholds: Thresholds = PAPER,
) -> dict[str, NDArray]:
    """Compute in which rows the robot has found, or follows, the human.

    Args:
        robot_pose: pose7 [T, 7].
        human_pose: pose7 [T, 7].
        reach_m: Distance by which finding is decided, shape [T] [m], geodesic if known. Rows with NaN do not count as
            found.
        thresholds: Limits of finding and following.

    Returns:
        Quantities [T] ``dist_m`` (L2 in space), ``reach_m`` (NaN without both poses) and ``facing_dot``; flags [T]
        ``in_reach``, ``facing`` and ``found`` (both ``in_reach`` and ``facing``).
    """
    return _found(_components(robot_pose), _components(human_pose), reach_m.astype(np.float64), thresholds)[0]


def encounter_series(
    robot_pose: NDArray[np.float32],
    human_pose: NDArray[np.float32],
    reach_m: NDArray[np.floating],
    time_ns: NDArray[np.int64],
    *,
    starts: NDArray[np.int64] | int = 0,
    thresholds: Thresholds = PAPER,
) -> dict[str, NDArray]:
    """Compute `found_series`, and in which rows the robot backs up or yields to the human.

    The rows may belong to several consecutive episodes, which start in the rows ``starts``.

    The additional quantity is ``speed_m_s`` [T], which is NaN in the first row of an episode. The additional flags [T]
    are ``near`` (L2 distance below ``avoid_m``), ``backs_up`` and ``yields``. The last two exclude each other, and are
    false in the first row, which has no velocity.
    """
    global _measured_rows
    _measured_rows += len(robot_pose)
    # other types would compile another version of the kernel, which takes eight rows at a time
    if (
        len(robot_pose) >= 8
        and ("numba" in sys.modules or _measured_rows > MANY_ROWS)
        and robot_pose.dtype == human_pose.dtype == np.float32
    ):
        return _compiled_series(robot_pose, human_pose, reach_m, time_ns, starts, thresholds)
    robot = _components(robot_pose)
    series, (forward_x, forward_z) = _found(robot, _components(human_pose), reach_m.astype(np.float64), thresholds)
    rows = len(robot_pose)
    along, step, dt = (np.full(rows, np.nan) for _ in range(3))
    step_x, step_z = np.diff(robot[0]), np.diff(robot[2])
    along[1:] = step_x * forward_x[:-1] + step_z * forward_z[:-1]  # backwards is against the heading before the step
    step[1:] = np.sqrt(step_x * step_x + step_z * step_z)
    dt[1:] = np.diff(time_ns) * 1e-9
    if rows:
        # the difference to the last row of the episode before is no velocity
        along[starts] = step[starts] = np.nan
    near = series["dist_m"] < thresholds.avoid_m
    # lengths of steps, not speeds: rows at one time would divide by 0
    backs_up = near & (along < -thresholds.still_m_s * dt)
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = step / dt
    flags = {name: series.pop(name) for name in ("in_reach", "facing", "found")}  # quantities come first in files
    yields = near & ~backs_up & (step < thresholds.yield_m_s * dt)
    return {**series, "speed_m_s": speed, **flags, "near": near, "backs_up": backs_up, "yields": yields}


def _compiled_series(
    robot_pose: NDArray[np.float32],
    human_pose: NDArray[np.float32],
    reach_m: NDArray[np.floating],
    time_ns: NDArray[np.int64],
    starts: NDArray[np.int64] | int,
    limits: Thresholds,
) -> dict[str, NDArray]:
    rows = len(robot_pose)
    measured, flags = np.empty((4, rows)), np.empty((6, rows), np.bool_)
    _kernel()(
        np.ascontiguousarray(robot_pose),
        np.ascontiguousarray(human_pose),
        np.ascontiguousarray(reach_m, None if reach_m.dtype == np.float32 else np.float64),
        np.ascontiguousarray(time_ns, np.int64),
        np.array(starts, np.int64, ndmin=1),
        (limits.near_m, limits.far_m, limits.facing, limits.avoid_m, limits.yield_m_s, limits.still_m_s),
        measured,
        flags,
    )
    # one by one: going through the rows of an array takes three times as long, a tenth of a call of one episode
    return {
        "dist_m": measured[0],
        "reach_m": measured[1],
        "facing_dot": measured[2],
        "speed_m_s": measured[3],
        "in_reach": flags[0],
        "facing": flags[1],
        "found": flags[2],
        "near": flags[3],
        "backs_up": flags[4],
        "yields": flags[5],
    }


@cache
def _kernel() -> Callable[..., None]:
    """Return the kernel, looked up once: the import statement takes a microsecond at each call."""
    from h3data.metrics.paper.encounter_kernel import fill_series

    return fill_series


def _components(pose: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.ascontiguousarray(pose.T, np.float64)


def _found(
    robot: NDArray[np.float64], human: NDArray[np.float64], reach_m: NDArray[np.floating], limits: Thresholds
) -> tuple[dict[str, NDArray], tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return `found_series` of components [7, T], and the robot's forward direction (x, z), zero where vertical."""
    dx, dy, dz = human[:3] - robot[:3]
    dist = np.sqrt(dx * dx + dy * dy + dz * dz)
    floor_dist = np.sqrt(dx * dx + dz * dz)
    qx, qy, qz, qw = robot[3:]
    # x and z of the first column of the rotation matrix: agents face along their x axis
    x, z = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qz - qy * qw)
    length = np.sqrt(x * x + z * z)
    # a robot that points straight up faces nobody: its direction on the floor is zero
    length[length == 0] = np.inf
    forward_x, forward_z = x / length, z / length
    along = forward_x * dx + forward_z * dz
    # a stored geodesic distance of a person who has left counts for nothing
    reach = np.where(np.isnan(dist), np.nan, reach_m)
    in_reach = (reach >= limits.near_m) & (reach <= limits.far_m)
    # as a product, so that nothing is divided by a distance of 0
    facing = along > limits.facing * floor_dist
    series = {
        "dist_m": dist,
        "reach_m": reach,
        # two agents in one place: 0, not NaN
        "facing_dot": along / np.where(floor_dist > 0, floor_dist, 1),
        "in_reach": in_reach,
        "facing": facing,
        "found": in_reach & facing,
    }
    return series, (forward_x, forward_z)
