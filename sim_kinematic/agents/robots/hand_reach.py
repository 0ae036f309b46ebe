"""Postures that bring a robot's hand to an object for picking and placing, pitched but not rolled.

An arm of six joints or more reaches the whole orientation. An arm with fewer joints, such as a lift with a sliding arm
and a wrist, leaves out the yaw: the held object turns about the vertical but stays upright.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Robot, RobotLink, solve_ik
from h3data.bodies.robots.kinematics import FIXED, SLIDES, TURNS
from h3data.geometry import IDENTITY_POSE, Array, quat_from_matrix, quat_rotate


@dataclass(frozen=True)
class HandReachSpec:
    """Directions, distances and heights at which the reach of arms is tested."""

    hand_pitch_rad: float = -0.6
    """Angle by which a robot's hand points below the horizon when it picks and places [rad]. The angle is constant, so
    an object that was upright is upright again where it is placed."""
    all_directions: int = 6
    """Number of joints that an arm needs to reach any position and orientation."""
    free_yaw_rad: float = 0.7
    """Largest angle by which the hand of an arm with fewer than `all_directions` joints may turn from the reach
    direction [rad]; a larger one would reach around things."""
    bearings_rad: tuple[float, ...] = (0.0, -np.pi / 2, np.pi / 2, np.pi)
    """Directions in which an arm is tried: ahead, right, left, behind [rad]."""
    distances_m: tuple[float, ...] = tuple(0.45 + 0.05 * k for k in range(15))
    """Distances from the robot's root at which reaching is tested [m]."""
    heights_m: tuple[float, ...] = (0.45, 0.75, 0.95)
    """Heights of tables and counters for which the direction is chosen [m]."""
    aside_rad: tuple[float, ...] = (0.0, np.pi / 4, -np.pi / 4, np.pi / 2, -np.pi / 2)
    """Directions, relative to the reaching direction, in which a robot takes a handle that its base cannot turn towards
    [rad]."""
    reach_slack_m: float = 0.01
    """Largest distance of a hand from its target at which the target counts as reached [m], far above the search's
    tolerances."""


HAND_REACH = HandReachSpec()


class ReachPostures(NamedTuple):
    """Postures of a robot for targets [*batch]."""

    joint_pos: NDArray[np.float64]
    """Positions of all joints of the robot, [*batch, J] [rad or m]."""
    reached: NDArray[np.bool_]
    """True if the hand reaches its target, [*batch]."""


def reach_posture(robot: Robot, target: ArrayLike, q0: Array | None = None, *, restarts: int = 32) -> ReachPostures:
    """Find postures for pose7 targets [*batch, 7] of the hand in the agent root frame, by `solve_ik`'s options."""
    if len(robot.require_arm()) >= HAND_REACH.all_directions:
        answer = solve_ik(robot, robot.hand_name, target, q0, offset=robot.hand_position, restarts=restarts)
        return ReachPostures(answer.joint_pos, answer.reached)
    free = _with_free_yaw(robot)
    # for the joint that `_with_free_yaw` adds; the answer is returned without it
    start = None if q0 is None else np.append(q0, 0.0)
    answer = solve_ik(free, free.hand_name, target, start, offset=free.hand_position, restarts=restarts)
    return ReachPostures(answer.joint_pos[..., :-1], answer.reached)


def is_beyond_reach(robot: Robot, hand: Array) -> bool:
    """Return whether a pose7 [7] of the hand in the agent root frame is out of reach because it is too far away.

    That is so if it is farther from the shoulder than the length of the stretched arm. `reach_posture` takes 2 ms to
    find this out, because it tries every starting posture, and policies in training ask very often.
    """
    arm = _stretched_arm(robot)
    x, y, z = (quat_rotate(hand[3:], arm.wrist) + hand[:3] - arm.shoulder).tolist()
    return math.sqrt(x * x + y * y + z * z) > arm.length_m


class _StretchedArm(NamedTuple):
    """Reach of a stretched arm."""

    shoulder: Array
    """Position of the arm's first joint in the agent root frame [3] [m]."""
    wrist: Array
    """Position of the last point whose place follows from the pose of the hand, from there, in the frame of the hand's link [3]
    [m]."""
    length_m: float
    """Largest distance from the shoulder to the wrist [m]."""


@lru_cache(maxsize=32)
def _stretched_arm(robot: Robot) -> _StretchedArm:
    chain = [robot.hand_link]
    while robot.links[chain[-1]].parent >= 0:
        chain.append(robot.links[chain[-1]].parent)
    shoulder = [link for link in chain if robot.kinds[link] != FIXED][-1]
    wrist, length = -np.asarray(robot.hand_position, np.float64), HAND_REACH.reach_slack_m
    for link in chain[: chain.index(shoulder) + 1]:
        origin = robot.origins[link]
        # distances are measured from the origin of the first joint, which adds nothing
        offset = np.linalg.norm(origin[:3, 3]) if link != shoulder else 0.0
        if (
            link == robot.hand_link
            and len(robot.require_arm()) >= HAND_REACH.all_directions
            and robot.kinds[link] == TURNS
        ):
            local = origin[:3, :3].T @ origin[:3, 3]
            if np.abs(np.cross(local, robot.axes[link])).max() < 1e-9:  # a roll: it turns the hand, and moves no joint
                wrist, offset = wrist - local, 0.0
        length += offset + _travel(robot, link)
    if (
        len(robot.require_arm()) < HAND_REACH.all_directions
    ):  # the yaw is free: only the point at which the hand holds is known
        length, wrist = length + float(np.linalg.norm(wrist)), np.zeros(3)
    rest = robot.link_matrices(IDENTITY_POSE[None], np.asarray(robot.rest, np.float64)[None])[0]
    length += _travel(robot, shoulder)  # a first joint that slides has moved already in the resting posture
    return _StretchedArm(rest[shoulder, :3, 3].copy(), wrist, float(length))


def _travel(robot: Robot, link: int) -> float:
    """Return the farthest that a joint slides from the modelled origin of its link [m]."""
    if robot.kinds[link] != SLIDES:
        return 0.0
    column = robot.columns[link]
    ends = robot.gains[link] * np.array([robot.lower[column], robot.upper[column]]) + robot.offsets[link]
    return float(np.abs(ends).max())


@lru_cache(maxsize=256)
def hand_turn(robot: Robot) -> Array:
    """Return the rotation (quaternion) of the hand in the agent root frame for a target in the reach direction."""
    c, s = np.cos(HAND_REACH.hand_pitch_rad), np.sin(HAND_REACH.hand_pitch_rad)
    ahead, up = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
    # columns are the axes of the hand, ahead, left and up, in the agent root frame
    level = np.stack([ahead, np.cross(up, ahead), up], axis=1)
    return quat_from_matrix(_turned_left(reach_bearing(robot)) @ level @ robot.hand_axes.T)


def reach_bearing(robot: Robot) -> float:
    """Return the direction in which a robot reaches for objects [rad], to the left of its forward axis.

    The direction is the robot's own setting, else the first of `HAND_REACH.bearings_rad` in which the arm reaches a
    target, else 0.
    """
    return _found_bearing(robot) if robot.reach_bearing is None else robot.reach_bearing


@lru_cache(maxsize=32)
def _found_bearing(robot: Robot) -> float:
    for bearing in HAND_REACH.bearings_rad:
        aimed = replace(robot, reach_bearing=bearing)
        if any(len(reach_distances(aimed, height)) for height in HAND_REACH.heights_m):
            return bearing
    return 0.0


@lru_cache(maxsize=256)
def aimed(robot: Robot, aside_rad: float) -> Robot:
    """Return the robot with its reach direction turned to the left by an angle [rad]."""
    return replace(robot, reach_bearing=reach_bearing(robot) + aside_rad) if aside_rad else robot


@lru_cache(maxsize=1024)
def reach_distances(robot: Robot, height_m: float) -> Array:
    """Return the distances [D] [m] from the robot's root at which its hand reaches points ``height_m`` above the floor.

    The distances are measured along the robot's reach direction. A distance counts only if both its neighbours are
    reachable too, since a base does not stop with millimetre precision. Results are cached, as objects lie on few
    different heights.
    """
    distances = np.array(HAND_REACH.distances_m)
    targets = np.stack([hand_target(robot, d, height_m) for d in distances])
    reached = reach_posture(robot, targets).reached
    return distances[1:-1][reached[1:-1] & reached[:-2] & reached[2:]]


def hand_target(robot: Robot, distance_m: float, height_m: float) -> Array:
    """Return the pose7 of the hand, in the agent root frame, for a point at a distance [m] in the reach direction."""
    bearing = reach_bearing(robot)
    x, z = (distance_m, 0.0) if bearing == 0 else (distance_m * np.cos(bearing), -distance_m * np.sin(bearing))
    return np.array([x, height_m, z, *hand_turn(robot)])


def _turned_left(angle: float) -> NDArray[np.float64]:
    """Return the rotation about the upward axis."""
    if angle == 0:
        return np.eye(3)
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


@lru_cache(maxsize=32)
def _with_free_yaw(robot: Robot) -> Robot:
    """Return a robot whose hand turns freely about the vertical axis at the grip when it picks: with one more joint."""
    c, s = np.cos(HAND_REACH.hand_pitch_rad), np.sin(HAND_REACH.hand_pitch_rad)
    # of a hand that is pitched by p, up is sin p times ahead plus cos p times its own up
    vertical = robot.hand_axes @ np.array([s, 0.0, c])
    origin = np.eye(4)
    # about the point at which the hand holds things, so that the added joint does not move it
    origin[:3, 3] = robot.hand_position
    hand = robot.links[robot.hand_link]
    wrist = RobotLink(name="free_yaw", parent=robot.hand_link, mesh=None, shapes=(), inertial=hand.inertial)
    return replace(
        robot,
        links=(*robot.links, wrist),
        joint_names=(*robot.joint_names, "free_yaw"),
        rest=np.append(robot.rest, 0.0),
        lower=np.append(robot.lower, -HAND_REACH.free_yaw_rad),
        upper=np.append(robot.upper, HAND_REACH.free_yaw_rad),
        joint_links=np.append(robot.joint_links, len(robot.links)),
        hand_link=len(robot.links),
        hand_position=np.zeros(3),
        origins=np.concatenate([robot.origins, origin[None]]),
        axes=np.concatenate([robot.axes, vertical[None]]),
        kinds=np.append(robot.kinds, 1),
        columns=np.append(robot.columns, len(robot.joint_names)),
        gains=np.append(robot.gains, 1.0),
        offsets=np.append(robot.offsets, 0.0),
    )
