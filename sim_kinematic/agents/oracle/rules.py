"""Rules of oracle skills for numbers, arrays and tensors, shared by agents on the CPU and worlds on a device."""

from __future__ import annotations

from typing import Any

from sim_kinematic.agents.robots.driving import ARRIVED_M, NEARLY_M
from sim_kinematic.motion.spec import OracleSpec

VIA_M = 0.125
"""Distance from a corner of its path at which a robot continues to the next one [m]."""
AIMED_RAD = 1e-3
"""Angle within which a person faces a point [rad]."""


def is_there(away: Any, is_end: Any, best: Any, since: Any) -> Any:
    """Return whether a robot has come to the end of its path.

    Args:
        away: distance to the point that the robot drives to [m].
        is_end: whether that point is the end of the path.
        best: least remainder so far (`left_to_do`), which is below 0 once the robot has started to turn.
        since: number of steps since that least remainder.
    """
    # `|` and `&`, because tensors have no `or` and `and`
    # 10: a robot that has not got on for this long is content with a place from `NEARLY_M`
    content = (since > 10) | (best < 0.0)
    return is_end & ((away <= ARRIVED_M) | ((away <= NEARLY_M) & content))


def left_to_do(away: Any, error_rad: Any) -> tuple[Any, Any]:
    """Return a robot's remaining distance [m], and a negative measure of its remaining turn at the end of its path."""
    # below 0 for every angle, so that turning at the end is nearer than any distance
    return away, 0.1 * abs(error_rad) - 1.0


def gets_on(left: Any, best: Any) -> Any:
    """Return whether the remainder (`left_to_do`) is at least 1 mm (or 0.01 rad) below the least one so far."""
    return left < best - 1e-3


def reaches(oracle: OracleSpec, gaps: Any, error_rad: Any) -> Any:
    """Return whether agents face their target at one of the places at offsets ``gaps`` [..., S, 2] [m] from them."""
    there = (gaps[..., 0] ** 2 + gaps[..., 1] ** 2 <= oracle.reach_m**2).any(-1)
    return there & (abs(error_rad) <= oracle.reach_rad)
