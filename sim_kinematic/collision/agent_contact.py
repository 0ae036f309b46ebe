"""Contact between a robot and a person: bounding circles on the floor first, then FCL on the exact shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.geometry import transform_points
from h3data.scene.records import Shape
from sim_kinematic.collision.fcl_world import Contact, MovingShapes, collide, contacts, distance
from sim_kinematic.collision.shapes import bounding_sphere, capsule_transforms, shapes_from_capsules


class AgentContact:
    """Whether a robot and a person touch, step after step.

    The robot is its collision shapes, one world transform each; the person is capsules of constant length (bones), given by
    their ends. Poses are only stored by `update`: FCL is touched when somebody asks and the two are near each other. The
    gate is conservative: the circles hold every shape, so it never hides a contact.
    """

    def __init__(
        self, robot_shapes: Sequence[Shape], human_start: ArrayLike, human_end: ArrayLike, human_radius: ArrayLike
    ) -> None:
        """Shapes of the robot in their link frames, and the person's capsules in any pose: ends [m, 3], radii [m]."""
        self._robot = MovingShapes(robot_shapes)
        self._human = MovingShapes(shapes_from_capsules(human_start, human_end, human_radius))
        spheres = [bounding_sphere(s) for s in robot_shapes]
        self._robot_center = np.stack([c for c, _ in spheres])
        self._robot_radius = np.array([r for _, r in spheres])
        start, end = np.asarray(human_start, np.float64), np.asarray(human_end, np.float64)
        self._human_radius = np.broadcast_to(np.asarray(human_radius, np.float64), start.shape[:1]) + (
            np.linalg.norm(end - start, axis=-1) / 2
        )
        self._robot_pose = np.tile(np.eye(4), (len(spheres), 1, 1))
        self._human_ends = start, end
        self._stale = True

    def update(self, robot_transforms: ArrayLike, human_start: ArrayLike, human_end: ArrayLike) -> None:
        """New world poses: transforms of the robot's shapes [n, 4, 4], ends of the person's capsules [m, 3]."""
        self._robot_pose = np.asarray(robot_transforms, np.float64)
        self._human_ends = np.asarray(human_start, np.float64), np.asarray(human_end, np.float64)
        self._stale = True

    def collides(self) -> bool:
        """Whether the two touch."""
        return self._near() and collide(*self._posed())

    def contacts(self) -> list[Contact]:
        """Where they touch, deepest first; a is the robot, b the person."""
        return contacts(*self._posed()) if self._near() else []

    def distance(self) -> float:
        """Distance between the bodies [m], negative when they overlap. Always exact: not gated."""
        return distance(*self._posed())

    def _near(self) -> bool:
        """Whether the circles around the two bodies, seen from above, touch."""
        robot = transform_points(self._robot_pose, self._robot_center[:, None])[:, 0]
        first, reach_a = _circle(robot, self._robot_radius)
        second, reach_b = _circle((self._human_ends[0] + self._human_ends[1]) / 2, self._human_radius)
        return float(np.hypot(*(first - second))) <= reach_a + reach_b

    def _posed(self) -> tuple[MovingShapes, MovingShapes]:
        if self._stale:
            self._robot.set_transforms(self._robot_pose)
            self._human.set_transforms(capsule_transforms(*self._human_ends))
            self._stale = False
        return self._robot, self._human


def _circle(centers: NDArray[np.floating], radii: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Centre (x, z) [2] and radius [m] of a circle around balls [n, 3], as seen from above."""
    floor = np.asarray(centers, np.float64)[:, [0, 2]]
    center = (floor.min(0) + floor.max(0)) / 2
    return center, float((np.linalg.norm(floor - center, axis=1) + radii).max())
