"""Predicates on states, as pure functions on arrays with any leading axes.

They are Habitat's PDDL predicates and those of social navigation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.motion.state import NOBODY, ROBOT
from sim_kinematic.sensing.sensor import facing

Flags = NDArray[np.bool_]

OBJECT_AT_M = 0.3
"""Distance from its goal below which an object is there [m]."""
ROBOT_AT_M = 2.0
"""Largest distance of a robot that is at a thing, the value of Habitat's domain; 3.0 in its task file is never read [m]."""


def is_object_at(position: Any, goal: Any, *, distance_m: float = OBJECT_AT_M, xp: Any = np) -> Any:
    """Return ``object_at``: whether objects [..., 3] are nearer to goals [..., 3] than a distance, as arrays or tensors."""
    if xp is np:
        position, goal = np.asarray(position, np.float64), np.asarray(goal, np.float64)
    gap = position - goal
    # strictly nearer, in three dimensions, as Habitat's object_at
    return xp.sqrt((gap * gap).sum(-1)) < distance_m


def is_robot_at_position(
    robot_xz: ArrayLike,
    heading: ArrayLike,
    position: ArrayLike,
    *,
    distance_m: float = ROBOT_AT_M,
    angle_rad: float | None = None,
) -> Flags:
    """Return Habitat's predicate ``robot_at``: whether bases [..., 2] are near positions [..., 3] on the floor.

    With ``angle_rad``, they must also face the positions to within that angle.
    """
    xz = np.asarray(robot_xz, np.float64)
    target = np.asarray(position, np.float64)[..., [0, 2]]
    # on the floor plane, with the bound itself, as Habitat's robot_at
    near = np.hypot(*np.moveaxis(target - xz, -1, 0)) <= distance_m
    if angle_rad is None:
        return near
    # clipped, as rounding may put a cosine beyond 1
    return near & (np.arccos(np.clip(facing(xz, heading, target), -1, 1)) <= angle_rad)


def is_holding(held_by: ArrayLike, agent: int = ROBOT, item: int | None = None) -> Flags:
    """Return ``holding``: whether an agent holds object ``item``, or anything if it is None, by holders [..., O]."""
    held = np.asarray(held_by) == agent
    return held.any(axis=-1) if item is None else held[..., item]


def not_holding(held_by: ArrayLike, agent: int = ROBOT) -> Flags:
    """Return ``not_holding``: whether an agent holds nothing, by holders [..., O]."""
    return ~is_holding(held_by, agent)


def is_free(held_by: ArrayLike) -> Flags:
    """Return which objects nobody holds, [..., O]."""
    return np.asarray(held_by) == NOBODY


def is_found(geodesic_m: Any, facing_dot: Any, spec: SocialNavSpec) -> Any:
    """Return whether the robot faces the person at the right distance (paper section 4.1), arrays or tensors [...]."""
    # both bounds are in, as in Habitat's statistics; its reward and success leave out the upper one
    return (geodesic_m >= spec.near_m) & (geodesic_m <= spec.far_m) & (facing_dot > spec.facing_dot)
