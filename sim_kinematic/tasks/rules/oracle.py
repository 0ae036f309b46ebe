"""Oracle for the metrics SPS and F: the fewest steps in which a robot that knows a person's future can find them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec


def steps_to_find(path: NDArray[np.float64], heading: float, spec: SocialNavSpec) -> float:
    """Return a lower bound of the steps along ``path`` [K, 2] until the robot has found the person.

    The person is found when the robot is ``spec.far_m`` from the end of the path and faces along it (paper appendix,
    "Oracle for the Minimum Steps"). The robot turns while it drives, so the larger of the two numbers of steps counts.
    No policy needs fewer steps.
    """
    legs = np.diff(path, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    # points that coincide give no direction
    legs, lengths = legs[lengths > 1e-9], lengths[lengths > 1e-9]
    drive = max(float(lengths.sum()) - spec.far_m, 0.0)
    # only legs on which the robot drives: it need not turn at corners beyond its place
    driven = int(np.searchsorted(np.cumsum(lengths), drive)) + 1
    # forward is (cos, -sin) of the heading in (x, z)
    headings = np.concatenate([[heading], np.arctan2(-legs[:driven, 1], legs[:driven, 0])])
    turn = float(np.abs(wrap_angle(np.diff(headings))).sum())
    robot = spec.robot
    return float(np.ceil(max(drive / robot.max_speed_mps, turn / robot.max_turn_rad_s) / STEP_S))


def oracle_min_steps(
    free: FreeSpace, robot_xz: NDArray[np.float64], heading: float, track: NDArray[np.float64], spec: SocialNavSpec
) -> int | None:
    """Return ``l``, the first i with ``r_i < i`` along the person's ``track`` [E, 2], tested at every step (paper appendix).

    ``track[k]`` is the position of the person after step ``k + 1``. Returns None if they cannot be found within the
    track.
    """
    for i, place in enumerate(track, start=1):
        path = free.path(robot_xz, place)
        # an empty path leads nowhere: the person is out of reach there
        if len(path) and steps_to_find(path, heading, spec) < i:
            return i
    return None
