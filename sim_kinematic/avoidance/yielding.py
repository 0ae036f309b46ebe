"""What agents see of each other while they move, and how people let each other pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.scene import FreeSpace
from sim_kinematic.avoidance.routes import FloorRoutes
from sim_kinematic.avoidance.velocity import AVOIDANCE, Avoided

BODY_M = 0.3
"""Radius of a person on the floor, and of each of the discs"""
ROBOT_DISCS_M = (-0.3, 0.0, 0.4)
"""along a robot's x axis."""
ROBOT_DISC = replace(AVOIDANCE, person_radius_m=BODY_M)
STANDING_MARGIN_M = 0.15
"""A robot leaves this much to those who stand and will step aside for it if they must."""
AHEAD_M = 1.2
"""Somebody this far along a person's way is in the way if both would touch,"""
MOVING_M = 0.1
"""or come this near to it, where the other one moves."""
PASSING_M = (0.1, 0.0)
"""Room that a person leaves beside those who stand when she goes round them, the less where there is no more."""
ASIDE_FROM_M, ASIDE_CLEAR_M = 2.0, 0.45
"""A robot that waits goes this far away from a person, to a place with so much free floor round it,"""
ASIDE_RINGS_M = (0.75, 1.5, 2.5, 3.5)
"""so far from where it is."""
PATIENCE_STEPS = 90
"""So long somebody waits for others to get out of the way."""
ROOM_M = 0.75
"""People do not stand nearer to each other than this."""
STANDS_MPS = 0.05
NO_WAY = np.zeros((0, 2))
"""Of who goes nowhere."""


class Seen(NamedTuple):
    """Another agent, as seen by one that moves."""

    number: int
    xz: NDArray[np.float64]
    velocity: NDArray[np.float64]
    """[2] [m/s], over the last steps."""
    settled: bool
    """It has been standing for long (`AvoidanceSpec.still_steps`)."""
    is_robot: bool
    heading: float = 0.0
    steps_aside: bool = False
    """It goes nowhere and gets out of the way of who asks it (`sim_kinematic.avoidance.right_of_way`)."""


def avoided(others: Sequence[Seen], *, agreed: bool = False) -> list[Avoided]:
    """The others as a robot's base keeps clear of them; ``agreed``: all step aside for each other, so they stand closer."""
    return [
        Avoided(
            disc[:2], o.velocity, o.settled,
            replace(spec, margin_m=STANDING_MARGIN_M) if agreed and stands(o) else spec,
        )
        for o in others
        for spec in [ROBOT_DISC if o.is_robot else AVOIDANCE]
        for disc in discs_of(o)
    ]  # fmt: skip


class Body(Protocol):
    """Somebody who stands on the floor."""

    @property
    def is_robot(self) -> bool: ...

    @property
    def xz(self) -> NDArray[np.float64]: ...

    @property
    def heading(self) -> float: ...


def discs_of(other: Body) -> NDArray[np.float64]:
    """Discs ``(x, z, radius)`` [N, 3] in which somebody stands."""
    offsets = np.array(ROBOT_DISCS_M if other.is_robot else (0.0,))
    x = other.xz[0] + np.cos(other.heading) * offsets
    z = other.xz[1] - np.sin(other.heading) * offsets
    return np.stack([x, z, np.full(len(offsets), BODY_M)], axis=1)


def in_the_way(xz: NDArray, towards: NDArray, others: Sequence[Seen]) -> Seen | None:
    """The nearest of the others who is in the way of a person at ``xz`` [2] that walks straight ``towards`` [2]."""
    way = towards - xz
    length = float(np.hypot(*way))
    ahead = way / max(length, 1e-9)
    found: Seen | None = None
    nearest = np.inf
    for other in others:
        for x, z, radius in discs_of(other):
            gap = np.array([x, z]) - xz
            room = BODY_M + radius + (0.0 if stands(other) else MOVING_M)
            along, aside = float(gap @ ahead), float(abs(gap[0] * ahead[1] - gap[1] * ahead[0]))
            distance = float(np.hypot(*gap))
            if 0 < along < min(AHEAD_M, length) + room and aside < room and distance < nearest:
                found, nearest = other, distance
    return found


def stands(other: Seen) -> bool:
    """Whether somebody stands."""
    return float(np.hypot(*other.velocity)) <= STANDS_MPS


def waits(number: int, other: Seen) -> bool:
    """Whether a person lets another pass who is in her way: one with a smaller number who walks."""
    return other.number < number and not stands(other)


def round_others(
    free: FreeSpace, xz: NDArray, goal: NDArray, others: Sequence[Seen], radius_m: float = BODY_M,
    passing_m: Sequence[float] = PASSING_M,
) -> NDArray | None:  # fmt: skip
    """Floor points [N, 2] that lead from ``xz`` [2] to ``goal`` [2] past all who stand; None if there is no such way.

    ``radius_m`` is one's own, ``passing_m`` the room that is left beside them, the first of these with which there is a way.
    """
    standing = [discs_of(other) for other in others if stands(other)]
    discs = np.concatenate(standing) if standing else np.zeros((0, 3))
    for room in passing_m:
        wide = discs + np.array([0.0, 0.0, radius_m + room])
        way = FloorRoutes.of(free).flood(xz, wide).way_to(goal)
        if way is not None:
            return way[1:]
    return None


def room_to_pass(free: FreeSpace, xz: NDArray, others: Sequence[Seen]) -> NDArray[np.float64] | None:
    """The place [2] nearest to ``xz`` [2] in which a person who is near has room to pass; None: nobody is, or there is none."""
    near = [other for other in others if not other.is_robot and np.hypot(*(other.xz - xz)) < ASIDE_FROM_M]
    if not near:
        return None
    angles = np.arange(16) * (np.pi / 8)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = np.concatenate([xz + radius * ring for radius in ASIDE_RINGS_M])
    places = places[free.signed_distance(places) >= ASIDE_CLEAR_M]
    if not len(places):
        return None
    ways = free.geodesic(np.broadcast_to(xz, places.shape), places, max_snap_m=1.0)
    hers = free.geodesic(np.broadcast_to(near[0].xz, places.shape), places, max_snap_m=1.0)
    fits = np.isfinite(ways) & (hers >= ASIDE_FROM_M) & (ways < hers)
    return places[fits][np.argmin(ways[fits])] if fits.any() else None


def crowds(places: NDArray, others: Sequence[Seen]) -> NDArray[np.bool_]:
    """At which places ``(x, z, heading)`` [N, 3] a person would be too near to somebody who stays, [N]."""
    gaps = [np.hypot(*(places[:, :2] - other.xz).T) < ROOM_M for other in others if not other.steps_aside]
    return np.any(gaps, axis=0) if gaps else np.zeros(len(places), np.bool_)
