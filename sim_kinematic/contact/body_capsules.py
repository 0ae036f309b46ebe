"""Capsules around an agent in any posture, as a first test before FCL at a tenth of the cost of posing its shapes.

A step of rearrangement asks up to five times whether agents touch, and they almost never do. Posing both bodies for
`AgentContacts` took a sixth of the step.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.kernels.clips import joint_frames
from h3data.bodies.people.skeleton import PARENT_ARRAY
from h3data.bodies.robots.kinematics import link_frames
from h3data.geometry import Array, pose_to_matrix
from h3data.kernels import kernel
from h3data.scene.shape_bounds import bounding_capsule
from sim_kinematic.contact.agent_contact import NEAR_M, any_near


class RobotCapsules:
    """The capsules of a robot's links."""

    def __init__(self, robot: Robot) -> None:
        links, ends, self.radii = _robot_capsules(robot)
        # frames and ends are filled in place, so that posing allocates nothing
        self._args = (links, ends, np.ascontiguousarray(robot.to_base, np.float64), *robot.joint_tree)
        self._frames = np.empty((1, len(robot.links), 4, 4))
        self.ends = np.empty_like(ends)
        """In the world, as last posed, [n, 2, 3] [m]."""

    def pose(self, base: Array, joints: Array) -> None:
        """Pose the robot with its root at a pose7 [7] in the world and joint positions [J]."""
        _pose_robot(pose_to_matrix(base), joints[None], *self._args, self._frames, self.ends)


class PersonCapsules:
    """The capsules of a person's bones."""

    def __init__(self, body: Humanoid) -> None:
        joints, ends, self.radii = _person_capsules(body)
        self._args = joints, ends, body.joint_offsets, PARENT_ARRAY
        self._frames = np.empty((1, len(PARENT_ARRAY), 4, 4))
        self.ends = np.empty_like(ends)
        """In the world, as last posed, [n, 2, 3] [m]."""

    def pose(self, base: Array, quats: Array, pelvis: Array) -> None:
        """Pose the person with their root at a pose7 [7] in the world, local rotations [55, 4] and the pelvis [3]."""
        _pose_person(base[None], quats[None], pelvis[None], *self._args, self._frames, self.ends)


def may_touch(a: RobotCapsules | PersonCapsules, b: RobotCapsules | PersonCapsules) -> bool:
    """Return whether `AgentContacts` must be asked: two capsules are within twice `NEAR_M`."""
    # distance of capsules from which `AgentContacts` decides: more than its own `NEAR_M`, as it gets poses
    # rounded to float32
    margin_m = 2 * NEAR_M
    return bool(any_near(a.ends, a.radii, b.ends, b.radii, margin_m))


@lru_cache(maxsize=32)
def _robot_capsules(robot: Robot) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the links [n] of a robot's capsules, their ends [n, 2, 3] in the frames of the links and radii [n] [m]."""
    capsules = [(k, *bounding_capsule(shape)) for k, link in enumerate(robot.links) for shape in link.shapes]
    links = np.array([k for k, *_ in capsules], np.int64)
    ends = np.array([[start, end] for _, start, end, _ in capsules], np.float64).reshape(-1, 2, 3)
    return links, ends, np.array([radius for *_, radius in capsules], np.float64)


@lru_cache(maxsize=32)
def _person_capsules(body: Humanoid) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the joints [n] of a person's capsules, their ends [n, 2, 3] in the frames of the joints and radii [n] [m]."""
    joints = np.array([capsule.joint for capsule in body.capsules], np.int64)
    ends = np.array([[capsule.start, capsule.end] for capsule in body.capsules], np.float64)
    return joints, ends, np.array([capsule.radius for capsule in body.capsules], np.float64)


@kernel(error_model="numpy")
def _pose_robot(
    root, joints, links, ends, to_base, parents, origins, kinds, axes, columns, gains, offsets, frames, out
):
    base = np.zeros((1, 4, 4))
    for i in range(4):
        for j in range(4):
            for k in range(4):
                base[0, i, j] += root[i, k] * to_base[k, j]
    link_frames(base, joints, parents, origins, kinds, axes, columns, gains, offsets, frames)
    _move(frames[0], links, ends, out)


@kernel(error_model="numpy")
def _pose_person(base, quats, pelvis, joints, ends, offsets, parents, frames, out):
    joint_frames(base, quats, pelvis, offsets, parents, frames)
    _move(frames[0], joints, ends, out)


@kernel(error_model="numpy")
def _move(frames, of, ends, out):
    """End [n, 2, 3] given in the frames ``of`` [n], in the world."""
    for n in range(len(of)):
        frame = frames[of[n]]
        for k in range(2):
            x, y, z = ends[n, k, 0], ends[n, k, 1], ends[n, k, 2]
            for i in range(3):
                out[n, k, i] = frame[i, 0] * x + frame[i, 1] * y + frame[i, 2] * z + frame[i, 3]
