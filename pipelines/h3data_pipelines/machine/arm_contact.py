"""Contacts by FCL of a robot's arm and held things with the home, which are counted but do not stop the arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Robot
from h3data.geometry import pose_to_matrix
from h3data.recording import Event
from h3data.scene import Scene, Shape
from sim_kinematic.agents.robots.arm_clearance import arm_links
from sim_kinematic.contact import FclScene, MovingShapes, contacts

TOUCH_M = 1e-3
"""Depth of contact up to which things rest on each other without collision, e.g. an object on a table [m]."""


class ArmTouch(NamedTuple):
    """Contact of a part of the arm with a thing."""

    part: str
    """Name of a link of the robot, or of the held object."""
    thing: str
    """Name of the instance in the scene."""
    depth_m: float
    """Depth [m] of the deepest contact between the two (see `Contact.depth_m` for its accuracy)."""
    point: NDArray[np.float64]
    """A point in the overlap, world, shape [3] [m]."""


class ArmContact:
    """Contact detection between one robot's moving arm, the object it holds, and the static things of a scene."""

    def __init__(self, scene: Scene, robot: Robot, *, scenery: FclScene | None = None) -> None:
        """Build the collision worlds; an existing ``scenery`` avoids building that of the scene again."""
        self._robot = robot
        self._scenery = scenery or FclScene(scene)
        self._links = arm_links(robot)
        self._arm = MovingShapes([shape for k in self._links for shape in robot.links[k].shapes])
        self._link_of = [k for k in self._links for _ in robot.links[k].shapes]
        self._held: dict[tuple[int, ...], MovingShapes] = {}

    def touches(
        self,
        base_pose: ArrayLike,
        joints: ArrayLike,
        *,
        held: str = "",
        shapes: Sequence[Shape] = (),
        held_pose: ArrayLike | None = None,
    ) -> list[ArmTouch]:
        """Return the current contacts, deepest first, at most one for each part and thing.

        Args:
            base_pose: World pose of the robot's root (pose7) [7].
            joints: Positions of all joints of the robot [J] [rad or m].
            held: Name of the object in the robot's hand.
            shapes: Collision shapes of that object; empty if nothing is held.
            held_pose: World pose (pose7) of the held object [7].
        """
        frames = self._robot.link_matrices(np.asarray(base_pose)[None], np.asarray(joints)[None])[0]
        self._arm.set_transforms(frames[self._link_of])
        found = [
            ArmTouch(
                self._robot.links[self._link_of[c.index_b]].name, self._scenery.names[c.index_a], c.depth_m, c.point
            )
            for c in contacts(self._scenery, self._arm)
        ]
        if len(shapes) and held_pose is not None:
            key = tuple(map(id, shapes))
            if key not in self._held:
                self._held[key] = MovingShapes(shapes)  # keeps the shapes, so that the ids stay theirs
            object_shapes = self._held[key]
            matrix = pose_to_matrix(np.asarray(held_pose, np.float64))
            object_shapes.set_transforms(np.tile(matrix, (len(shapes), 1, 1)))
            found += [
                ArmTouch(held, self._scenery.names[c.index_a], c.depth_m, c.point)
                for c in contacts(self._scenery, object_shapes)
            ]
        deepest: dict[tuple[str, str], ArmTouch] = {}
        for touch in sorted(found, key=lambda t: -t.depth_m):
            if touch.depth_m > TOUCH_M:
                deepest.setdefault((touch.part, touch.thing), touch)
        return list(deepest.values())


def touch_events(touches: Sequence[ArmTouch], before: Sequence[ArmTouch], *, step: int, agent: int) -> list[Event]:
    """Return an event ``contact`` with depth for each pair that touches now and did not in the step ``before``."""
    known = {(t.part, t.thing) for t in before}
    return [
        Event(step=step, agent=agent, kind="contact", target=t.thing, detail=f"{t.part}, {t.depth_m:.3f} m")
        for t in touches
        if (t.part, t.thing) not in known
    ]
