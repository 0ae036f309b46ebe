"""The oracle of SPS and F: the fewest steps in which a robot that knows the person's future could find her."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.spec import STEP_S, SocialNavSpec


def steps_to_find(path: NDArray[np.float64], heading: float, spec: SocialNavSpec) -> float:
    """Steps of a robot that turns on the spot at every corner of ``path`` [K, 2] and drives in between, until it is
    ``spec.far_m`` from the end and faces it (paper appendix, "Oracle for the Minimum Steps")."""
    legs = np.diff(path, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    legs, lengths = legs[lengths > 1e-9], lengths[lengths > 1e-9]
    remaining = lengths.sum() - spec.far_m
    turn = drive = 0.0
    for leg, length in zip(legs, lengths, strict=True):
        wanted = np.arctan2(-leg[1], leg[0])
        turn += abs(float(wrap_angle(wanted - heading)))
        heading = float(wanted)
        step = min(max(remaining, 0.0), length)
        drive, remaining = drive + step, remaining - step
        if remaining <= 0:
            break
    robot = spec.robot
    return float(np.ceil(turn / (robot.max_turn_rad_s * STEP_S)) + np.ceil(drive / (robot.max_speed_mps * STEP_S)))


def oracle_min_steps(
    free: FreeSpace, robot_xz: NDArray[np.float64], heading: float, track: NDArray[np.float64], spec: SocialNavSpec
) -> int | None:
    """``l = min { i : r_i < i }`` over equally spaced way points of the human's ``track`` [E, 2] (paper appendix).

    ``track[k]`` is where she is after step ``k + 1``. None if she cannot be found within the track.
    """
    for i in range(spec.oracle_waypoint_steps, len(track) + 1, spec.oracle_waypoint_steps):
        path = free.path(robot_xz, track[i - 1])
        if len(path) and steps_to_find(path, heading, spec) < i:
            return i
    return None
