"""Other agents as observed by an agent that moves, and the rules by which people let each other pass."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.kernels.entries import Entries
from h3data.scene import FreeSpace
from sim_kinematic.avoidance.routes import FloorRoutes
from sim_kinematic.avoidance.spec import AVOIDANCE, Footprint

NO_PATH = np.zeros((0, 2))
"""Path of an agent without a destination."""


_CALL = Entries()
RULES = (
    AVOIDANCE.range_m,
    AVOIDANCE.person_radius_m,
    AVOIDANCE.standing_margin_m,
    AVOIDANCE.margin_m,
    AVOIDANCE.stands_mps,
    AVOIDANCE.person.radius_m,
    AVOIDANCE.moving_m,
    AVOIDANCE.ahead_m,
    AVOIDANCE.beside_nearer_m,
)
"""Constants of `blocker` and `discs_to_avoid`."""
AGENT = np.dtype(
    [
        *((name, "f8") for name in ("x", "z", "heading", "cos", "sin", "velocity_x", "velocity_z")),
        *((name, "f8") for name in ("start_x", "start_z", "radius", "extent")),
        *((name, "i8") for name in ("number", "discs")),
        *((name, "?") for name in ("is_robot", "settled", "yields", "hindered")),
    ]
)
"""Type of an agent as others observe it: place [m], heading [rad] with its cosine and sine, mean velocity over the last
steps [m/s], first point of its path or NaN, radius of the discs of its footprint and its extent [m]; its number, and the
number of its discs; whether it is a robot, has stood still for a long time (`AvoidanceSpec.still_steps`), can step aside
now, and was stopped by others in its last step."""


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


class Neighbours(NamedTuple):
    """Agents of one world as arrays, which kernels read, and which of them one agent gives way to."""

    agents: NDArray[Any]
    """Agents as they were after their last turns, `AGENT` [A]."""
    offsets: NDArray[np.float64]
    """Offsets of the discs of their footprints along the heading [A, D] [m], of which the first ``discs`` count."""
    heeded: NDArray[np.bool_]
    """True for the agents to which the observing agent gives way, [A]."""
    agreed: bool = False
    """True if all agents step aside for each other when they are asked."""

    @classmethod
    def of(cls, bodies: Sequence[Body]) -> Neighbours:
        """Return the arrays of some agents, numbered in this order, who are all heeded and not yet placed."""
        prints = [body.footprint for body in bodies]
        most = max((len(footprint.offsets_m) for footprint in prints), default=1)
        found = cls(np.zeros(len(prints), AGENT), np.zeros((len(prints), most)), np.ones(len(prints), np.bool_))
        for k, (body, footprint) in enumerate(zip(bodies, prints, strict=True)):
            found.offsets[k, : len(footprint.offsets_m)] = footprint.offsets_m
            found.agents["number"][k], found.agents["discs"][k] = k, len(footprint.offsets_m)
            found.agents["radius"][k], found.agents["extent"][k] = footprint.radius_m, footprint.extent_m
            found.agents["is_robot"][k] = body.is_robot
        return found

    @property
    def standing(self) -> NDArray[np.bool_]:
        """Which of the heeded agents stand still, [A]."""
        speed = np.hypot(self.agents["velocity_x"], self.agents["velocity_z"])
        return self.heeded & (speed <= AVOIDANCE.stands_mps)

    @property
    def leaving(self) -> NDArray[np.bool_]:
        """Which of the agents step aside when they are asked, so that they take no place away, [A]."""
        return self.agents["yields"] & np.isnan(self.agents["start_x"]) & self.agreed

    @property
    def places(self) -> NDArray[np.float64]:
        """Places (x, z) of the agents [A, 2] [m]."""
        return np.stack([self.agents["x"], self.agents["z"]], axis=-1)

    def near(self, xz: NDArray) -> NDArray[np.bool_]:
        """Return which of the heeded agents a robot at ``xz`` [2] considers, [A]."""
        return self.heeded & (np.hypot(*(self.places - xz).T) <= AVOIDANCE.range_m + self.agents["extent"])

    def discs(self, which: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the discs ``(x, z, radius)`` [N, 3] [m] of the agents that ``which`` [A] selects."""
        rows, offsets = self.agents[which][:, None], self.offsets[which]
        x, z = rows["x"] + rows["cos"] * offsets, rows["z"] - rows["sin"] * offsets
        discs = np.stack([x, z, np.broadcast_to(rows["radius"], x.shape)], axis=-1)
        return discs[np.arange(offsets.shape[1]) < rows["discs"]]

    def beside(self, xz: NDArray, reach_m: float) -> NDArray[np.float64]:
        """Return the rows of `discs_to_avoid` of agents at any distance from ``xz`` [2] that do not step aside."""
        told = self.agents, self.offsets, self.heeded & ~self.leaving, np.zeros(0, np.int64), False
        return _CALL(discs_to_avoid, *xz.tolist(), *told, reach_m, (math.inf, *RULES[1:]))


NO_NEIGHBOURS = Neighbours.of(())
"""Neighbours of an agent that is alone."""


@kernel(error_model="numpy")
def discs_to_avoid(x, z, agents, offsets, heeded, held_by, agreed, reach, rules):
    """Return rows ``(x, z, velocity x, velocity z, sum of both radii, margin, settled)`` [N, 7] of the discs near a base.

    Args:
        x: place of the base.
        z: place of the base.
        agents: `Neighbours.agents`.
        offsets: `Neighbours.offsets`.
        heeded: `Neighbours.heeded`.
        held_by: number of the agent that holds each object [K]; one that holds something counts as moving, however long it
            has been standing.
        agreed: whether agents that stand may be passed more closely, because they step aside when asked.
        reach: radius of the discs of the base [m].
        rules: constants of the rules.
    """
    rows, count, range_m = np.empty((offsets.size, 7)), 0, rules[0]
    for n in range(len(agents)):
        other = agents[n]
        if not heeded[n] or math.hypot(other["x"] - x, other["z"] - z) > range_m + other["extent"]:
            continue
        settled = other["settled"]
        for holder in held_by:
            settled = settled and holder != other["number"]
        stands = math.hypot(other["velocity_x"], other["velocity_z"]) <= rules[4]
        for disc in range(other["discs"]):
            at_x, at_z = other["x"] + other["cos"] * offsets[n, disc], other["z"] - other["sin"] * offsets[n, disc]
            # an agent that is far away cannot matter within the horizon, and most steps end here
            if math.hypot(at_x - x, at_z - z) <= range_m:
                row = rows[count]
                row[0], row[1], row[2], row[3] = at_x, at_z, other["velocity_x"], other["velocity_z"]
                row[4] = reach + (other["radius"] if other["is_robot"] else rules[1])
                row[5], row[6] = rules[2] if agreed and stands else rules[3], settled
                count += 1
    return rows[:count]


def discs_of(body: Body) -> NDArray[np.float64]:
    """Return the discs ``(x, z, radius)`` [N, 3] of an agent's footprint in the world."""
    (x, z), (offsets, radius) = body.xz.tolist(), body.footprint
    c, s = (float(np.cos(body.heading)), float(np.sin(body.heading))) if any(offsets) else (1.0, 0.0)
    return np.array([(x + c * offset, z - s * offset, radius) for offset in offsets])


def waits(number: int, others: Neighbours, k: int) -> bool:
    """Return whether a person waits for the agent in row ``k`` that blocks them, which moves and has a smaller number."""
    # an order of all people: if two waited for each other, neither would ever walk on
    return bool(others.agents["number"][k] < number and not others.standing[k])


def in_the_way(xz: NDArray, towards: NDArray, others: Neighbours) -> int:
    """Return the row of the nearest agent that blocks a person at ``xz`` [2] who walks straight ``towards`` [2], or -1."""
    return _CALL(blocker, *xz.tolist(), *towards.tolist(), *others[:3], RULES)


@kernel(error_model="numpy")
def blocker(x, z, to_x, to_z, agents, offsets, heeded, rules):
    """Return the result of `in_the_way`."""
    leg_x, leg_z, found, nearest = to_x - x, to_z - z, -1, math.inf
    length = math.hypot(leg_x, leg_z)
    ahead_x, ahead_z = leg_x / max(length, 1e-9), leg_z / max(length, 1e-9)
    for n in range(len(agents)):
        other = agents[n]
        # an agent that moves may turn towards the person in the next step
        moving = rules[6] if math.hypot(other["velocity_x"], other["velocity_z"]) > rules[4] else 0.0
        room = rules[5] + other["radius"] + moving
        for disc in range(other["discs"] if heeded[n] else 0):
            gap_x = other["x"] + other["cos"] * offsets[n, disc] - x
            gap_z = other["z"] - other["sin"] * offsets[n, disc] - z
            along, aside = gap_x * ahead_x + gap_z * ahead_z, abs(gap_x * ahead_z - gap_z * ahead_x)
            distance = math.hypot(gap_x, gap_z)
            # people who walk side by side hardly get nearer to each other, and must not wait for each other
            nears = along > 0.0 and distance - aside > rules[8]
            if nears and along < min(rules[7], length) + room and aside < room and distance < nearest:
                found, nearest = n, distance
    return found


def path_around(
    free: FreeSpace,
    xz: NDArray,
    goal: NDArray,
    others: Neighbours,
    *,
    radius_m: float = AVOIDANCE.person.radius_m,
    passing_m: Sequence[float] = AVOIDANCE.passing_m,
) -> NDArray | None:
    """Return floor points [N, 2] from ``xz`` [2] to ``goal`` [2] around all agents that stand; None if there is no path.

    ``radius_m`` is the radius of the agent that moves. ``passing_m`` are gaps to leave beside the others [m], of which
    the first that works is used.
    """
    discs = others.discs(others.standing)
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
    others: Neighbours,
    *,
    radius_m: float = AVOIDANCE.person.radius_m,
) -> NDArray[np.bool_]:
    """Return which floor points [N, 2] cannot be reached from ``xz`` [2] because standing agents block all paths, [N].

    ``radius_m`` is the radius of the agent that moves.
    """
    if not len(places):
        return np.zeros(0, np.bool_)
    wide = others.discs(others.standing) + np.array([0.0, 0.0, radius_m + AVOIDANCE.passing_m[0]])
    return ~FloorRoutes.of(free).flood(xz, wide).reaches(places)


def retreat_place(
    free: FreeSpace, xz: NDArray, others: Neighbours, *, wider_m: float = 0.0
) -> NDArray[np.float64] | None:
    """Return the place [2] nearest to a robot at ``xz`` [2] from which a person nearby has room to pass.

    Returns None if no person is near, or if there is no such place. ``wider_m`` is the difference in width between the
    robot and ``quad_arm`` [m].
    """
    spec = AVOIDANCE
    gaps = np.where(others.heeded & ~others.agents["is_robot"], np.hypot(*(others.places - xz).T), np.inf)
    if not (gaps < spec.retreat_m).any():
        return None
    person = others.places[gaps.argmin()]
    angles = np.arange(16) * (np.pi / 8)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = np.concatenate([xz + radius * ring for radius in spec.retreat_rings_m])
    places = places[free.signed_distance(places) >= spec.retreat_room_m + wider_m]
    if not len(places):
        return None
    lengths = free.geodesic(np.broadcast_to(xz, places.shape), places, max_snap_m=1.0)
    of_person = free.geodesic(np.broadcast_to(person, places.shape), places, max_snap_m=1.0)
    # the robot has to be there before the person could be, or it would drive in front of them
    fits = np.isfinite(lengths) & (of_person >= spec.retreat_m) & (lengths < of_person)
    return places[fits][np.argmin(lengths[fits])] if fits.any() else None


def crowds(places: NDArray, others: Neighbours) -> NDArray[np.bool_]:
    """Return whether a person at places ``(x, z, heading)`` [N, 3] would be too close to agents that stay, [N]."""
    gaps = places[:, None, :2] - others.places[others.heeded & ~others.leaving]
    return np.any(np.hypot(gaps[..., 0], gaps[..., 1]) < AVOIDANCE.apart_m, axis=1)
