"""What agents see of each other while they move, and how people let each other pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.scene import FreeSpace
from sim_kinematic.avoidance import AVOIDANCE, Avoided, way_round
from sim_kinematic.waypoint_human import sharp_corners

ROBOTS = replace(AVOIDANCE, person_radius_m=0.6)
"""A robot is longer than a person is wide."""
AHEAD_M, ASIDE_M = 1.2, 0.7
"""Somebody this far along a person's way, and this near to it, is in the way."""
PATIENCE_STEPS = 90
"""So long somebody waits for others to get out of the way."""
ROOM_M = 0.75
"""People do not stand nearer to each other than this."""
STANDS_MPS = 0.05


class Seen(NamedTuple):
    """Another agent, as seen by one that moves."""

    number: int
    xz: NDArray[np.float64]
    velocity: NDArray[np.float64]
    """[2] [m/s], over the last steps."""
    settled: bool
    """It has been standing for long (`AvoidanceSpec.still_steps`)."""
    is_robot: bool


def avoided(others: Sequence[Seen]) -> list[Avoided]:
    """The others as a robot's base keeps clear of them."""
    return [Avoided(o.xz, o.velocity, o.settled, ROBOTS if o.is_robot else AVOIDANCE) for o in others]


def in_the_way(xz: NDArray, towards: NDArray, others: Sequence[Seen]) -> Seen | None:
    """The nearest of the others who is in the way of a person at ``xz`` [2] that walks straight ``towards`` [2]."""
    way = towards - xz
    length = float(np.hypot(*way))
    ahead = way / max(length, 1e-9)
    found: Seen | None = None
    nearest = AHEAD_M + ASIDE_M
    for other in others:
        gap = other.xz - xz
        along, aside = float(gap @ ahead), float(abs(gap[0] * ahead[1] - gap[1] * ahead[0]))
        distance = float(np.hypot(*gap))
        if 0 < along < min(AHEAD_M, length) + ASIDE_M and aside < ASIDE_M and distance < nearest:
            found, nearest = other, distance
    return found


def waits(number: int, other: Seen) -> bool:
    """Whether a person lets another pass who is in her way: one with a smaller number who walks."""
    return other.number < number and float(np.hypot(*other.velocity)) > STANDS_MPS


def round_somebody(free: FreeSpace, xz: NDArray, goal: NDArray, other: Seen) -> NDArray | None:
    """Floor points [N, 2] that lead to ``goal`` past somebody who stands in the way; None if there is no such way."""
    via = way_round(free, xz, goal, other.xz)
    if via is None:
        return None
    legs = free.path(xz, via, max_snap_m=1.0), free.path(via, goal, max_snap_m=1.0)
    return np.concatenate([sharp_corners(free, leg)[1:] for leg in legs])


def crowds(stands: NDArray, others: Sequence[Seen]) -> NDArray[np.bool_]:
    """At which stands ``(x, z, heading)`` [N, 3] a person would be too near to somebody, [N]."""
    gaps = [np.hypot(*(stands[:, :2] - other.xz).T) < ROOM_M for other in others]
    return np.any(gaps, axis=0) if gaps else np.zeros(len(stands), np.bool_)
