"""Where to stand so that something is within reach: places on the free floor round a point, with the heading to take there."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Humanoid, Robot, solve_ik
from h3data.bodies.people.reach import Hand, reacher
from h3data.geometry import Array, ground_pose, quat_from_matrix
from h3data.scene import FreeSpace, Scene
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.contact.clearance import clear_of_furniture
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.motion.step import least_clearance

BEARINGS = 24
"""Directions from which a point is approached."""
PERSON_DISTANCES_M = tuple(0.25 + 0.05 * k for k in range(13))
ROBOT_DISTANCES_M = tuple(0.45 + 0.05 * k for k in range(15))
"""One counts when the hand reaches the point from its two neighbours too: a base does not stand to the millimetre."""
HAND_SIDE_RAD = 0.25
"""A person stands so that the point is this far to the side of the hand that takes it."""
HAND_PITCH_RAD = -0.6
"""A robot's hand points this far below the horizon when it picks and places, always the same: so what it took standing
stands again where it is put."""
SWAY_M = 0.015
"""A person's distances count when the point is reached from this much nearer and farther as well."""
CROWDED_M = 100.0
"""A way this much longer is taken rather than standing where the other one stands."""
ROOM_M = 0.02
"""Free way that a robot's base has round it where it stands and turns."""


def person_stands(free: FreeSpace, body: Humanoid, point: ArrayLike, hand: Hand = "right") -> Array:
    """Stands ``(x, z, heading)`` [N, 3] from which ``hand`` reaches a world point [3] [m], on the largest island."""
    point = np.asarray(point, np.float64)
    side = HAND_SIDE_RAD if hand == "right" else -HAND_SIDE_RAD
    distances = np.array(PERSON_DISTANCES_M)
    height = point[1] - free.floor_y
    fine = np.ones(len(distances), np.bool_)
    for sway in (-SWAY_M, 0.0, SWAY_M):
        d = distances + sway
        fine &= reacher(body, hand).reachable(
            np.stack([d * np.cos(side), np.full_like(d, height), d * np.sin(side)], axis=1)
        )
    return _on_island(free, _ring(point, distances[fine], side))


def robot_fits(robot: Robot, rules: BaseSpec, scene: Scene, free: FreeSpace) -> Callable[[Array, float], bool]:
    """Returns a test whether a resting robot fits at a floor point [2] with a heading: the discs of its base are clear of
    obstacles, the rest of it of furniture, and its floor leads on from there."""
    base = base_of(robot, rules)
    floor, clear = floor_of(robot, base, scene, free), clear_of_furniture(scene, robot)

    def fits(xz: Array, heading: float) -> bool:
        leads_on = floor is free or int(floor.island(xz)) == 0
        return leads_on and discs_fit(free, base, xz, heading) and clear(ground_pose(xz, heading, free.floor_y))

    return fits


def discs_fit(free: FreeSpace, base: BaseSpec, xz: Array, heading: float) -> bool:
    """Whether the discs of a base at a floor point [2] are clear of obstacles."""
    offsets = np.asarray(base.disc_offsets_m)
    room = least_clearance(free.sdf, free.origin, free.cell_m, xz[0], xz[1], heading, offsets)
    return room >= base.disc_radius_m


def robot_stands(free: FreeSpace, robot: Robot, base: BaseSpec, point: ArrayLike) -> Array:
    """Stands ``(x, z, heading)`` [N, 3] from which a robot's hand, pitched by `HAND_PITCH_RAD`, reaches a world point [3]
    [m], and where its base can turn all the way round."""
    point = np.asarray(point, np.float64)
    stands = _on_island(free, _ring(point, _robot_distances(robot, float(point[1] - free.floor_y)), 0.0))
    reach = max(abs(offset) for offset in base.disc_offsets_m) + base.disc_radius_m + ROOM_M
    return stands[free.signed_distance(stands[:, :2]) >= reach]


@lru_cache(maxsize=1024)
def _robot_distances(robot: Robot, height: float) -> Array:
    """From how far away [D] [m] a robot's hand reaches what is ``height`` [m] above the floor: things lie on few heights."""
    distances = np.array(ROBOT_DISTANCES_M)
    targets = np.zeros((len(distances), 7))
    targets[:, 0], targets[:, 1], targets[:, 3:] = distances, height, hand_turn(robot)
    answer = solve_ik(robot, robot.links[robot.hand_link].name, targets, offset=robot.hand_position)
    reached = answer.reached[1:-1] & answer.reached[:-2] & answer.reached[2:]
    return distances[1:-1][reached]


def hand_turn(robot: Robot) -> Array:
    """Rotation (quaternion) of the hand's link in the agent root frame when it picks and places: pitched, not rolled."""
    c, s = np.cos(HAND_PITCH_RAD), np.sin(HAND_PITCH_RAD)
    ahead, up = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
    return quat_from_matrix(np.stack([ahead, np.cross(up, ahead), up], axis=1))


def nearest_stand(
    free: FreeSpace, stands: Array, start_xz: ArrayLike, crowded: NDArray[np.bool_] | NDArray[np.integer] | None = None,
    is_clear: Callable[[Array], bool] | None = None,
) -> tuple[int, float]:  # fmt: skip
    """The stand with the shortest way from ``start_xz`` [2], and its length [m]; infinite when none can be got to.

    Those that are ``crowded`` [N] are taken only if all are, the less crowded first, and only one that ``is_clear``.
    """
    if not len(stands):
        return -1, np.inf
    ways = free.geodesic(np.broadcast_to(np.asarray(start_xz, np.float64), (len(stands), 2)), stands[:, :2])
    order = np.argsort(ways if crowded is None else ways + CROWDED_M * crowded, kind="stable")
    for k in order[np.isfinite(ways[order])].tolist():
        if is_clear is None or is_clear(stands[k]):
            return k, float(ways[k])
    return -1, np.inf


def _ring(point: Array, distances: Array, side: float) -> Array:
    """Places [D * BEARINGS, 3] round a point; the heading looks ``side`` [rad] to the left of it."""
    angle, distance = np.meshgrid(np.arange(BEARINGS) * (2 * np.pi / BEARINGS), distances)
    angle, distance = angle.ravel(), distance.ravel()
    x, z = point[0] - distance * np.cos(angle), point[2] + distance * np.sin(angle)
    return np.stack([x, z, angle + side], axis=1)


def _on_island(free: FreeSpace, stands: Array) -> Array:
    island: NDArray[np.int32] = free.island(stands[:, :2])
    return stands[island == 0]
