"""Room for a robot's arm: tests whether its hand gets from a stand to a point without walls or furniture in between.

FCL makes two tests against the static scene. `ArmClearance.is_open` tests that nothing stands between the shoulder and
the point, at the height of the hand. `ArmClearance.is_clear` tests that the arm itself touches nothing on its path to
the point and back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from h3data.bodies import Robot
from h3data.geometry import IDENTITY_POSE, Array, ground_pose, pose_to_matrix
from h3data.scene import Scene
from h3data.scene.articulation import joints_of
from h3data.scene.floor_heights import floor_heights, room_heights
from h3data.scene.records import Capsule
from sim_kinematic.agents.robots.hand_reach import hand_target, is_beyond_reach, reach_posture
from sim_kinematic.contact import MovingShapes, capsule_transforms, collide, shapes_from_capsules
from sim_kinematic.contact.clearance import scenery_of, supports


@dataclass(frozen=True)
class ArmClearanceSpec:
    """Constants of the test that decides if a robot's arm is clear of obstacles."""

    approach_m: float = 0.1
    """Height above an object from which a robot's hand approaches it, and to which the hand lifts it [m]."""
    line_radius_m: float = 0.01
    """Radius of the line along which the hand approaches [m]."""
    frames: int = 8
    """Number of postures that are checked between the resting posture and the one over the point."""
    held_m: float = 0.05
    """Radius of the ball that represents the object in the hand [m]."""
    ways_kept: int = 1000
    """Number of cached paths of a robot's arm, 12 kB each; a home has about 450."""
    answers_kept: int = 10_000
    """Number of cached results, 300 bytes each."""


CLEARANCE = ArmClearanceSpec()


class _Part(NamedTuple):
    """Some of the shapes, and the links that move them."""

    shapes: MovingShapes
    links: list[int]


class ArmClearance:
    """Test of the room that a reaching arm needs, for one scene and one robot."""

    def __init__(self, scene: Scene, robot: Robot, floor_y: float) -> None:
        self._scenery, self._robot = scenery_of(scene), robot
        self._floor_y, self._heights = floor_y, room_heights(scene.rooms)
        links, hand = arm_links(robot), robot.hand_link
        rest = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0]
        self._shoulder = np.asarray(rest[links[0], :3, 3], np.float64)
        at = np.asarray(robot.hand_position, np.float64)
        # a capsule of no length is a ball
        held = Capsule(start=at, end=at, radius=CLEARANCE.held_m)
        in_hand = [
            (k, shape) for k in links if k == hand or robot.links[k].parent == hand for shape in robot.links[k].shapes
        ]
        behind = [
            (k, shape) for k in links if k != hand and robot.links[k].parent != hand for shape in robot.links[k].shapes
        ]
        self._hand, self._arm = (
            _Part(MovingShapes([shape for _, shape in part]), [k for k, _ in part])
            for part in ([*in_hand, (hand, held)], behind)
        )
        joints = joints_of(scene)
        self._drawers = {name for name, k in joints.owner.items() if joints.parts[k][1].joint.kind == "prismatic"}
        """Drawers of the scene, whose rim the hand may pass to take an object from inside."""
        self._ways = _arm_paths(robot)
        self._open: dict[tuple[bytes, bytes], bool] = {}
        self._clear: dict[tuple[bytes, bytes], bool] = {}

    def is_open(self, stand: Array, point: Array) -> bool:
        """Return whether no obstacle lies between a robot's shoulder and a world point [3].

        The robot stands at ``(x, z, heading)`` [3]. The line checked goes up or down to `CLEARANCE.approach_m` above the point,
        then level to it.
        """
        return _remembered(self._open, self._is_open, stand, point)

    def _is_open(self, stand: Array, point: Array) -> bool:
        base = pose_to_matrix(ground_pose(stand[:2], float(stand[2]), self._floor_at(stand)))
        shoulder = base[:3, :3] @ self._shoulder + base[:3, 3]
        over = np.asarray(point, np.float64) + np.array([0.0, CLEARANCE.approach_m, 0.0])
        raised = np.array([shoulder[0], over[1], shoulder[2]])
        start, end = np.stack([shoulder, raised]), np.stack([raised, over])
        if not self._scenery.is_near(start, end, CLEARANCE.line_radius_m):
            return True
        line = MovingShapes(shapes_from_capsules(start, end, CLEARANCE.line_radius_m))
        frames = capsule_transforms(start, end)
        if self._drawers and (inside := self._drawer_of(point)):
            return not line.touches_along(self._scenery, frames[None], except_for=inside)
        line.set_transforms(frames)
        return not collide(self._scenery, line)

    def _floor_at(self, stand: Array) -> float:
        return float(floor_heights(self._heights, self._floor_y, stand[:2]))

    def _drawer_of(self, point: Array) -> set[str]:
        """Return the drawer in which a world point [3] lies, if there is one."""
        return supports(self._scenery, point) & self._drawers if self._drawers else set()

    def is_clear(self, stand: Array, point: Array) -> bool:
        """Return whether the line to the point is open, and the arm touches nothing while the robot reaches for it.

        The arm moves from its resting posture to the point; the hand, with what it may hold, to the point above it.
        """
        return _remembered(self._clear, self._is_clear, stand, point)

    def _is_clear(self, stand: Array, point: Array) -> bool:
        if not self.is_open(stand, point):
            return False
        base = pose_to_matrix(ground_pose(stand[:2], float(stand[2]), self._floor_at(stand)))
        distance = float(np.hypot(*(np.asarray(point, np.float64)[[0, 2]] - stand[:2])))
        way = self._way(round(distance, 3), round(float(point[1]) - self._floor_at(stand), 3))
        if way is None:
            return False
        inside = self._drawer_of(point)
        return not any(
            part.shapes.touches_along(self._scenery, base @ frames, except_for=inside)
            for part, frames in zip((self._hand, self._arm), way, strict=True)
        )

    def _way(self, distance: float, height: float) -> tuple[Array, Array] | None:
        """Return frames of the shapes of hand [T, H, 4, 4] and arm [T + 1, S, 4, 4] in a reach, in the root frame.

        The target is ``distance`` ahead and ``height`` above the floor [m], so that stands on one ring around a point
        share the frames. Returns None if the arm does not reach it.
        """
        seen = distance, height
        if seen not in self._ways:
            if len(self._ways) >= CLEARANCE.ways_kept:
                self._ways.pop(next(iter(self._ways)))
            line = reach_line(self._robot, hand_target(self._robot, distance, height))
            self._ways[seen] = None if line is None else self._frames(*line)
        return self._ways[seen]

    def _frames(self, over: Array, at: Array) -> tuple[Array, Array]:
        share = np.linspace(0.0, 1.0, CLEARANCE.frames)[:, None]
        postures = np.vstack([self._robot.rest + share * (over - self._robot.rest), at])
        links = self._robot.link_matrices(np.tile(IDENTITY_POSE, (len(postures), 1)), postures)
        # the hand's last posture is left out: there it is in touch with what the object lies on
        return links[:-1, self._hand.links], links[:, self._arm.links]


def _remembered(
    answers: dict[tuple[bytes, bytes], bool], ask: Callable[[Array, Array], bool], stand: Array, point: Array
) -> bool:
    """Return the cached answer for a stand and a point, because objects and goals are approached repeatedly."""
    asked = np.asarray(stand, np.float64).tobytes(), np.asarray(point, np.float64).tobytes()
    if asked not in answers:
        if len(answers) >= CLEARANCE.answers_kept:
            answers.clear()
        answers[asked] = ask(stand, point)
    return answers[asked]


def reach_line(robot: Robot, hand: Array) -> tuple[Array, Array] | None:
    """Return joint positions [J] with the hand `CLEARANCE.approach_m` above a pose7 [7] in the root frame, and at it.

    None: the arm does not reach it.
    """
    if is_beyond_reach(robot, hand):
        return None
    at = reach_posture(robot, hand)
    if not at.reached:
        return None
    raised = hand + np.array([0, CLEARANCE.approach_m, 0, 0, 0, 0, 0])
    # no restarts: from the posture at the target, so that the arm moves little between the two
    return reach_posture(robot, raised, at.joint_pos, restarts=0).joint_pos, at.joint_pos


@lru_cache(maxsize=8)
def _arm_paths(robot: Robot) -> dict[tuple[float, float], tuple[Array, Array] | None]:
    """Return the paths of a robot's arm that `ArmClearance._way` has computed, shared between homes."""
    # only the key of the cache
    return {}


@lru_cache(maxsize=8)
def arm_clearance(scene: Scene, robot: Robot, floor_y: float) -> ArmClearance:
    """Return the clearance of a robot's arm in a scene, built once for each scene and robot."""
    return ArmClearance(scene, robot, floor_y)


def arm_links(robot: Robot) -> list[int]:
    """Return the links that an arm joint moves, and the links attached to them."""
    moved = {int(robot.joint_links[c]) for c in robot.require_arm()}
    links: list[int] = []
    # links come parents first, so one pass finds all that hang on the arm
    for k, link in enumerate(robot.links):
        if k in moved or link.parent in links:
            links.append(k)
    return links
