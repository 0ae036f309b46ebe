"""Places to stand from which something is within reach, on the free floor around a point, with the heading there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.reach import Hand, reacher
from h3data.geometry import Array
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.robots.hand_reach import HAND_REACH, aimed, reach_bearing, reach_distances
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.contact.clearance import clear_of_furniture
from sim_kinematic.contact.frames import root_pose
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.motion.step import least_clearance


@dataclass(frozen=True)
class StandSpec:
    """Constants for the places to stand that are tried, and for the room that agents need there."""

    bearings: int = 24
    """Number of directions from which a point is approached."""
    person_distances_m: tuple[float, ...] = tuple(0.25 + 0.05 * k for k in range(13))
    """Distances from which a person reaches for a point [m]."""
    hand_side_rad: float = 0.25
    """Angle by which the point is to the side of the hand that takes it [rad]."""
    sway_m: float = 0.015
    """Difference of distance at which a point must be reachable as well, nearer and farther, for a person's distance to
    count [m]."""
    crowded_m: float = 100.0
    """Additional length of a path that is preferred to a stand near another agent [m]."""
    room_m: float = 0.02
    """Free space that a robot's base needs around it where it stands and turns [m]."""
    approach_m: float = 0.3
    """Length of the straight approach to a stand on which the base must fit as well [m]."""
    level_m: float = 0.01
    """Difference in height below which two places are on the same floor [m]."""


STANDS = StandSpec()


def person_stands(free: FreeSpace, body: Humanoid, point: ArrayLike, hand: Hand = "right", *, island: int = 0) -> Array:
    """Return stands ``(x, z, heading)`` [N, 3] on an island from which ``hand`` reaches a world point [3] [m]."""
    point = np.asarray(point, np.float64)
    side = STANDS.hand_side_rad if hand == "right" else -STANDS.hand_side_rad
    distances = np.array(STANDS.person_distances_m)
    height = point[1] - float(free.height_at(point[[0, 2]]))
    d = np.concatenate([distances - STANDS.sway_m, distances, distances + STANDS.sway_m])
    # as the person sees it: the point is as far to the right as they turn left of it in `_ring`
    points = np.stack([d * np.cos(side), np.full_like(d, height), d * np.sin(side)], axis=1)
    fine = reacher(body, hand).reachable(points).reshape(3, -1).all(0)
    return _on_island(free, point, _ring(point, distances[fine], side), island)


def robot_fits(robot: Robot, rules: BaseSpec, scene: Scene, free: FreeSpace) -> Callable[[Array, float], bool]:
    """Return a function that tests whether a resting robot fits at a floor point [2] with a heading.

    The discs of its base must be clear of obstacles and the rest of it of furniture, and there must be free floor
    around it to drive on.
    """
    base = base_of(robot, rules)
    floor, clear = floor_of(robot, base, scene, free), clear_of_furniture(scene, robot)

    def fits(xz: Array, heading: float) -> bool:
        # the floor of a wider base may fall apart: island 0 is its largest
        leads_on = floor is free or int(floor.island(xz)) == 0
        return (
            leads_on and discs_fit(free, base, xz, heading) and clear(root_pose(robot, np.asarray(xz), heading, free))
        )

    return fits


def discs_fit(free: FreeSpace, base: BaseSpec, xz: Array, heading: float) -> bool:
    """Return whether the discs of a base at a floor point [2] are clear of obstacles."""
    offsets = np.asarray(base.disc_offsets_m)
    room = least_clearance(free.sdf, free.origin, free.cell_m, xz[0], xz[1], heading, offsets)
    return room >= base.disc_radius_m


def robot_stands(free: FreeSpace, robot: Robot, base: BaseSpec, point: ArrayLike, *, island: int = 0) -> Array:
    """Return poses ``(x, z, heading)`` [N, 3] from which a robot's hand reaches a world point [3] [m].

    All poses are on one island of the floor, and the base has room there for a full turn
    (`sim_kinematic.agents.robots.hand_reach`).
    """
    point = np.asarray(point, np.float64)
    distances = reach_distances(robot, float(point[1] - free.height_at(point[[0, 2]])))
    stands = _on_island(free, point, _ring(point, distances, -reach_bearing(robot)), island)
    # the circle that the base sweeps in a whole turn
    radius = max(abs(offset) for offset in base.disc_offsets_m) + base.disc_radius_m + STANDS.room_m
    return stands[free.signed_distance(stands[:, :2]) >= radius]


def handle_stands(free: FreeSpace, robot: Robot, base: BaseSpec, point: ArrayLike, *, island: int = 0) -> Array:
    """Return poses ``(x, z, heading)`` [N, 3] from which a robot's hand reaches a handle at a world point [3] [m].

    Unlike for `robot_stands`, the base need not have room to turn around there, and the hand may also reach to the
    side. The base fits at the pose and on the last `STANDS.approach_m` straight before or behind it.
    """
    point = np.asarray(point, np.float64)
    height, found = float(point[1] - free.height_at(point[[0, 2]])), list[Array]()
    for aside in HAND_REACH.aside_rad:
        turned = aimed(robot, aside)
        found.append(
            _on_island(free, point, _ring(point, reach_distances(turned, height), -reach_bearing(turned)), island)
        )
    stands = np.concatenate(found)
    way = np.stack([np.cos(stands[:, 2]), -np.sin(stands[:, 2])], axis=1)
    room = [np.full(len(stands), np.inf)] * 3
    for offset in base.disc_offsets_m:
        for k, moved in enumerate((0.0, -STANDS.approach_m, STANDS.approach_m)):
            room[k] = np.minimum(room[k], free.signed_distance(stands[:, :2] + (offset + moved) * way))
    there, back, ahead = (least >= base.disc_radius_m + STANDS.room_m for least in room)
    return stands[there & (back | ahead)]


def nearest_stand(
    free: FreeSpace,
    stands: Array,
    start_xz: ArrayLike,
    crowded: NDArray[np.bool_] | NDArray[np.integer] | None = None,
    is_clear: Callable[[Array], bool] | None = None,
) -> tuple[int, float]:
    """Return the index of the stand with the shortest path from ``start_xz`` [2], and the path's length [m].

    Stands that are ``crowded`` [N] are used only if all are, the less crowded first; only stands for which ``is_clear``
    is true count. Returns -1 and infinity if no stand can be reached.
    """
    if not len(stands):
        return -1, np.inf
    # not `broadcast_to`, which takes a third as long as the search
    lengths = free.geodesic(np.full((len(stands), 2), start_xz, np.float64), stands[:, :2])
    order = (lengths if crowded is None else lengths + STANDS.crowded_m * crowded).argsort(kind="stable")
    # one at a time, because a test of room costs a posed arm or body, and the first success ends it
    for k in order[np.isfinite(lengths[order])].tolist():
        if is_clear is None or is_clear(stands[k]):
            return k, float(lengths[k])
    return -1, np.inf


def _ring(point: Array, distances: Array, side: float) -> Array:
    """Return the places [D * STANDS.bearings, 3] around a point, each heading ``side`` [rad] to the left of it."""
    angle, distance = np.meshgrid(np.arange(STANDS.bearings) * (2 * np.pi / STANDS.bearings), distances)
    angle, distance = angle.ravel(), distance.ravel()
    # back from the point against the heading, whose forward is (cos h, -sin h) in (x, z)
    x, z = point[0] - distance * np.cos(angle), point[2] + distance * np.sin(angle)
    return np.stack([x, z, angle + side], axis=1)


def island_of(free: FreeSpace, xz: Array) -> int:
    """Return the island of the floor on which a point [2] lies; the largest one for points a little off the floor."""
    return max(int(free.island(xz)), 0)


def _on_island(free: FreeSpace, point: Array, stands: Array, island: int) -> Array:
    """Return the stands around a world point that are on an island and on the point's storey, and not on stairs."""
    there = free.island(stands[:, :2]) == island
    if len(free.heights):
        level = np.abs(free.height_at(stands[:, :2]) - free.height_at(point[[0, 2]])) < STANDS.level_m
        return stands[there & level]
    return stands[there]
