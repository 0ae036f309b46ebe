"""Contact of a posed person with a robot, and of agents with furniture, decided by FCL on the exact shapes."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.gestures import lead_hands
from h3data.bodies.people.sitting import take_seats
from h3data.geometry import IDENTITY_POSE, Array, pose_to_matrix
from h3data.scene import Scene
from h3data.scene.shape_bounds import bounding_capsule, bounding_sphere
from sim_kinematic.contact import (
    AgentContacts,
    FclScene,
    MovingShapes,
    collide,
    contacts,
    shapes_from_capsules,
)
from sim_kinematic.contact.frames import body_shapes, shape_frames
from sim_kinematic.motion.spec import PersonContact

SUPPORT_M, SUPPORT_RADIUS_M = 0.12, 0.02
"""Length and radius of a capsule that extends downwards from a point [m]; things that it overlaps support an object
that lies at the point."""
FLOOR_M = 0.02
"""Height up to which agents may stand on things that lie on the floor, such as a rug [m]."""
LYING_M = 0.7
"""Largest distance by which the head or feet of a person who lies, or the hands of a person who reaches, are farther
from the root than any part of the body in a clip [m]."""
HOMES_KEPT = 64
"""Largest number of homes whose furniture stays loaded in FCL; scene sets have fewer."""


class RobotHumanContact:
    """Contact between a robot in a fixed posture and a person who is posed by motion clips.

    The collision shapes of the robot are those of its links, and those of the person are the ones that
    ``person_contact`` names.
    """

    def __init__(
        self,
        robot: Robot,
        human: Humanoid,
        posture: ArrayLike | None = None,
        *,
        person_contact: PersonContact = "body",
    ) -> None:
        """Pose the robot by joint positions [J]; without a ``posture``, it is at rest."""
        self._human = human
        self._person_contact: PersonContact = person_contact
        joints = np.asarray(robot.rest if posture is None else posture, np.float64)
        links = robot.link_matrices(IDENTITY_POSE[None], joints[None])[0]
        # the posture never changes, so the robot's shapes move with its base as one rigid body
        self._shapes_at = shape_frames(robot, links)
        self._pair = AgentContacts(body_shapes(robot), body_shapes(human, person_contact))
        self.gate_m = robot_reach(robot, joints) + clip_reach(human, person_contact)
        """Distance of the two bases on the floor above which robot and person cannot touch [m]."""

    def touching(
        self,
        robot_base: NDArray[np.floating],
        human_base: NDArray[np.floating],
        clip: NDArray,
        phase: NDArray,
        blend: NDArray,
        arms: NDArray | None = None,
        seats: NDArray | None = None,
        hands: NDArray | None = None,
    ) -> NDArray[np.bool_]:
        """Return whether robot and person touch in each of N cases, as bool [N], with all people posed together.

        Args:
            robot_base: poses of the robot's root [N, 7].
            human_base: poses of the person's root [N, 7].
            clip: numbers of the motion clips [N].
            phase: positions within the clips [N].
            blend: weights of the clips [N].
            arms: how far each arm is folded in, left and right [N, 2].
            seats: heights of seats [m] and shares of the path to them (`h3data.bodies.people.sitting.take_seats`) [N, 2].
            hands: places of the hands (`h3data.bodies.people.gestures.lead_hands`) [N, 4, 4].
        """
        gap = robot_base[:, [0, 2]] - human_base[:, [0, 2]]
        # the gate holds for every posture but lying and reaching, so people farther away need not be posed
        wider = 0.0 if seats is None else LYING_M * (seats[:, 1] > 1)
        wider = wider if hands is None else np.maximum(wider, LYING_M * hands[..., 3].any(1))
        near = np.flatnonzero(np.hypot(gap[:, 0], gap[:, 1]) <= self.gate_m + wider)
        result = np.zeros(len(gap), np.bool_)
        if not len(near):
            return result
        posture = self._human.clip_pose(clip[near], phase[near], blend[near], arms=None if arms is None else arms[near])
        if seats is not None:
            take_seats(self._human, *posture, seats[near])
        if hands is not None:
            lead_hands(self._human, *posture, hands[near])
        joints = self._human.joint_matrices(human_base[near], *posture)
        people = shape_frames(self._human, joints, self._person_contact)
        bases = pose_to_matrix(robot_base[near].astype(np.float64))
        for n, base, person in zip(near, bases, people, strict=True):
            self._pair.update(0, base @ self._shapes_at)
            self._pair.update(1, person)
            result[n] = self._pair.collides()
        return result


@lru_cache(maxsize=HOMES_KEPT)
def clear_of_furniture(scene: Scene, robot: Robot) -> Callable[[Array], bool]:
    """Return a test of whether the whole resting robot at a base pose (pose7) is clear of a scene's static things.

    Its feet may stand on anything up to `FLOOR_M`. FCL decides, because the discs of the base cover neither its rear
    nor its arm.
    """
    scenery = scenery_of(scene)
    shapes = MovingShapes(body_shapes(robot))
    links = robot.link_matrices(IDENTITY_POSE[None], np.asarray(robot.rest, np.float64)[None])[0]
    shapes_at = shape_frames(robot, links)

    def is_clear(base: Array) -> bool:
        # lifted: feet that touch the floor, or a rug, are no contact with furniture
        raised = base + np.array([0, FLOOR_M, 0, 0, 0, 0, 0])
        shapes.set_transforms(pose_to_matrix(raised) @ shapes_at)
        return not collide(scenery, shapes)

    return is_clear


@lru_cache(maxsize=HOMES_KEPT)
def scenery_of(scene: Scene) -> FclScene:
    """Return the static instances of a scene in FCL, which are loaded once per scene."""
    return FclScene(scene)


def robot_reach(robot: Robot, joints: Array) -> float:
    """Return an upper bound of the floor distance of the robot's shapes from its root in a posture [J] [m]."""
    links = robot.link_matrices(IDENTITY_POSE[None], joints[None])[0]
    reach = 0.0
    for matrix, link in zip(links, robot.links, strict=True):
        for shape in link.shapes:
            center, radius = bounding_sphere(shape)
            reach = max(reach, float(np.hypot(*(matrix[:3, :3] @ center + matrix[:3, 3])[[0, 2]])) + radius)
    return reach


def robot_span(robot: Robot) -> float:
    """Return an upper bound of the distance between the root and any shape of the robot in any posture [m].

    The bound is the sum of the lengths of all links up to the shape, as if they were stretched out.
    """
    # joints may turn in any direction, so lengths of links add up whatever their directions
    stretched, span = np.zeros(len(robot.links)), 0.0
    for k, link in enumerate(robot.links):
        if link.parent >= 0:
            stretched[k] = stretched[link.parent] + np.linalg.norm(robot.origins[k][:3, 3])
        # kind 2 is prismatic: a telescope reaches farther by its longest stroke
        if robot.kinds[k] == 2:
            column = robot.columns[k]
            ends = robot.gains[k] * np.array([robot.lower[column], robot.upper[column]]) + robot.offsets[k]
            stretched[k] += float(np.abs(ends).max())
        for shape in link.shapes:
            center, radius = bounding_sphere(shape)
            span = max(span, float(stretched[k] + np.linalg.norm(center)) + radius)
    return span


@lru_cache(maxsize=32)
def clip_reach(human: Humanoid, person_contact: PersonContact = "body") -> float:
    """Return the largest distance of the person's collision shapes from the root along the floor in any of the clips [m]."""
    clip, phase, blend = (
        grid.ravel()
        for grid in np.meshgrid(np.arange(len(human.clips)), np.arange(32) / 32, [0.0, 0.5, 1.0], indexing="ij")
    )
    joints = human.joint_matrices(IDENTITY_POSE[None], *human.clip_pose(clip, phase, blend))
    frames = shape_frames(human, joints, person_contact)
    capsules = [bounding_capsule(shape) for shape in body_shapes(human, person_contact)]
    ends = np.array([[start, end] for start, end, _ in capsules])
    floor = np.einsum("tnij,nkj->tnki", frames[..., :3, :3], ends) + frames[..., None, :3, 3]
    reach = np.hypot(floor[..., 0], floor[..., 2]) + np.array([radius for *_, radius in capsules])[:, None]
    # the margin covers phases and blends between those that were sampled
    return float(reach.max()) + 0.05


def supports(scenery: FclScene, point: Array) -> set[str]:
    """Return the names of the things on or in which an object at a world point [3] lies."""
    upright = np.eye(4)
    upright[:3, 3] = np.asarray(point, np.float64) - np.array([0.0, SUPPORT_M / 2, 0.0])
    below = _below()
    below.set_transforms(upright[None])
    return {scenery.names[contact.index_a] for contact in contacts(scenery, below)}


@lru_cache(maxsize=1)
def _below() -> MovingShapes:
    """Return the capsule of `supports`, made once."""
    end = np.array([[0.0, SUPPORT_M, 0.0]])
    return MovingShapes(shapes_from_capsules(np.zeros((1, 3)), end, SUPPORT_RADIUS_M))
