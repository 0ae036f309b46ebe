"""Other agents as observed by an agent that moves, and the rules by which people let each other pass."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.scene import FreeSpace
from sim_kinematic.avoidance.routes import FloorRoutes
from sim_kinematic.avoidance.spec import AVOIDANCE, Footprint
from sim_kinematic.avoidance.velocity import ObstacleDisc

NO_PATH = np.zeros((0, 2))
"""Path of an agent without a destination."""


class ObservedAgent(NamedTuple):
    """State of another agent, as observed by an agent that moves."""

    number: int
    xz: NDArray[np.float64]
    velocity: NDArray[np.float64]
    """Mean velocity over the last steps [2] [m/s]."""
    settled: bool
    """True if the agent has stood for long (`AvoidanceSpec.still_steps`)."""
    is_robot: bool
    heading: float = 0.0
    steps_aside: bool = False
    """True if the agent has no destination and steps aside when asked (`sim_kinematic.avoidance.right_of_way`)."""
    footprint: Footprint = AVOIDANCE.person


class Body(Protocol):
    """An agent on the floor."""

    @property
    def is_robot(self) -> bool:
        """Return whether the agent is a robot; otherwise it is a person."""
        ...

    @property
    def xz(self) -> NDArray[np.float64]:
        """Position on the floor [2] [m]."""
        ...

    @property
    def heading(self) -> float:
        """Heading of the body [rad]."""
        ...

    @property
    def footprint(self) -> Footprint:
        """Space that other agents leave for this one."""
        ...


def discs_of(body: Body) -> NDArray[np.float64]:
    """Return the discs ``(x, z, radius)`` [N, 3] of an agent's footprint in the world."""
    return np.array(_discs_of(body))


def _discs_of(body: Body) -> list[tuple[float, float, float]]:
    """Return the same as `discs_of` in plain numbers, which loops over few agents read faster."""
    (x, z), (offsets, radius) = body.xz.tolist(), body.footprint
    if len(offsets) == 1 and not offsets[0]:
        return [(x, z, radius)]
    c, s = float(np.cos(body.heading)), float(np.sin(body.heading))
    return [(x + c * offset, z - s * offset, radius) for offset in offsets]


def avoided(others: Sequence[ObservedAgent], *, agreed: bool = False) -> list[ObstacleDisc]:
    """Return all discs of the others that a robot's base keeps clear of.

    With ``agreed``, agents step aside for each other when asked, so those that stand may be passed more closely.
    """
    discs = []
    for other in others:
        radius = other.footprint.radius_m if other.is_robot else AVOIDANCE.person_radius_m
        margin = AVOIDANCE.standing_margin_m if agreed and stands(other) else AVOIDANCE.margin_m
        velocity = other.velocity.tolist()
        discs += [ObstacleDisc((x, z), velocity, other.settled, radius, margin) for x, z, _ in _discs_of(other)]
    return discs


def stands(other: ObservedAgent) -> bool:
    """Return whether an agent stands still."""
    return math.hypot(*other.velocity.tolist()) <= AVOIDANCE.stands_mps


def waits(number: int, other: ObservedAgent) -> bool:
    """Return whether a person waits for an agent that blocks them, which moves and has a smaller number."""
    # an order of all people: if two waited for each other, neither would ever walk on
    return other.number < number and not stands(other)


def in_the_way(xz: NDArray, towards: NDArray, others: Sequence[ObservedAgent]) -> ObservedAgent | None:
    """Return the nearest agent that blocks a person at ``xz`` [2] who walks straight ``towards`` [2]."""
    here = xz.tolist()
    # most agents are too far away to block anybody, whatever they do
    # Distance beyond which, added to twice the size of their own body, nobody is in a person's path [m].
    in_the_way_m = AVOIDANCE.ahead_m + 2 * (AVOIDANCE.person.radius_m + AVOIDANCE.moving_m)
    others = [o for o in others if math.dist(here, o.xz.tolist()) <= in_the_way_m + 2 * o.footprint.extent_m]
    if not others:
        return None
    leg_x, leg_z = (towards - xz).tolist()
    length = math.hypot(leg_x, leg_z)
    ahead_x, ahead_z = leg_x / max(length, 1e-9), leg_z / max(length, 1e-9)
    blocker: ObservedAgent | None = None
    nearest = math.inf
    for other in others:
        # an agent that moves may turn towards the person in the next step
        moving = 0.0 if stands(other) else AVOIDANCE.moving_m
        for x, z, radius in _discs_of(other):
            gap_x, gap_z = x - here[0], z - here[1]
            room = AVOIDANCE.person.radius_m + radius + moving
            along, aside = gap_x * ahead_x + gap_z * ahead_z, abs(gap_x * ahead_z - gap_z * ahead_x)
            distance = math.hypot(gap_x, gap_z)
            # people who walk side by side hardly get nearer to each other, and must not wait for each other
            nears = distance - aside > AVOIDANCE.beside_nearer_m if along > 0 else False
            if nears and along < min(AVOIDANCE.ahead_m, length) + room and aside < room and distance < nearest:
                blocker, nearest = other, distance
    return blocker


def path_around(
    free: FreeSpace,
    xz: NDArray,
    goal: NDArray,
    others: Sequence[ObservedAgent],
    *,
    radius_m: float = AVOIDANCE.person.radius_m,
    passing_m: Sequence[float] = AVOIDANCE.passing_m,
) -> NDArray | None:
    """Return floor points [N, 2] from ``xz`` [2] to ``goal`` [2] around all agents that stand; None if there is no path.

    ``radius_m`` is the radius of the agent that moves. ``passing_m`` are gaps to leave beside the others [m], of which
    the first that works is used.
    """
    standing = [discs_of(other) for other in others if stands(other)]
    discs = np.concatenate(standing) if standing else np.zeros((0, 3))
    # a narrow path is taken only where there is no other
    for gap in passing_m:
        wide = discs + np.array([0.0, 0.0, radius_m + gap])
        path = FloorRoutes.of(free).flood(xz, wide, goal=goal).path_to(goal)
        if path is not None:
            return path[1:]
    return None


def shut_off(
    free: FreeSpace,
    xz: NDArray,
    places: NDArray,
    others: Sequence[ObservedAgent],
    *,
    radius_m: float = AVOIDANCE.person.radius_m,
) -> NDArray[np.bool_]:
    """Return which floor points [N, 2] cannot be reached from ``xz`` [2] because standing agents block all paths, [N].

    ``radius_m`` is the radius of the agent that moves.
    """
    if not len(places):
        return np.zeros(0, np.bool_)
    discs = np.concatenate([np.zeros((0, 3)), *(discs_of(other) for other in others if stands(other))])
    wide = discs + np.array([0.0, 0.0, radius_m + AVOIDANCE.passing_m[0]])
    return ~FloorRoutes.of(free).flood(xz, wide).reaches(places)


def retreat_place(
    free: FreeSpace, xz: NDArray, others: Sequence[ObservedAgent], *, wider_m: float = 0.0
) -> NDArray[np.float64] | None:
    """Return the place [2] nearest to a robot at ``xz`` [2] from which a person nearby has room to pass.

    Returns None if no person is near, or if there is no such place. ``wider_m`` is the difference in width between the
    robot and ``quad_arm`` [m].
    """
    spec = AVOIDANCE
    near = [other for other in others if not other.is_robot and np.hypot(*(other.xz - xz)) < spec.retreat_m]
    if not near:
        return None
    angles = np.arange(16) * (np.pi / 8)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = np.concatenate([xz + radius * ring for radius in spec.retreat_rings_m])
    places = places[free.signed_distance(places) >= spec.retreat_room_m + wider_m]
    if not len(places):
        return None
    lengths = free.geodesic(np.broadcast_to(xz, places.shape), places, max_snap_m=1.0)
    of_person = free.geodesic(np.broadcast_to(near[0].xz, places.shape), places, max_snap_m=1.0)
    # the robot has to be there before the person could be, or it would drive in front of them
    fits = np.isfinite(lengths) & (of_person >= spec.retreat_m) & (lengths < of_person)
    return places[fits][np.argmin(lengths[fits])] if fits.any() else None


def crowds(places: NDArray, others: Sequence[ObservedAgent]) -> NDArray[np.bool_]:
    """Return whether a person at places ``(x, z, heading)`` [N, 3] would be too close to agents that stay, [N]."""
    apart = AVOIDANCE.apart_m
    gaps = [np.hypot(*(places[:, :2] - other.xz).T) < apart for other in others if not other.steps_aside]
    return np.any(gaps, axis=0) if gaps else np.zeros(len(places), np.bool_)
