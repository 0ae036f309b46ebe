"""Capsules around an agent in any posture, as a first test before FCL at a tenth of the cost of posing its shapes.

A step of rearrangement asks up to five times whether agents touch, and they almost never do. Posing both bodies for
`AgentContacts` took a sixth of the step.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.kernels.clips import joint_frames, write_frame
from h3data.bodies.people.skeleton import PARENT_ARRAY
from h3data.bodies.robots.kinematics import link_frames
from h3data.geometry import Array
from h3data.kernels import kernel
from h3data.kernels.entries import Entries
from h3data.scene.shape_bounds import bounding_capsule
from sim_kinematic.contact.agent_contact import NEAR_M, any_near


class AgentCapsules:
    """Capsules around a robot's links, or around a person's bones."""

    def __init__(self, body: Humanoid | Robot) -> None:
        self._kernel, self._args, self.radii, self._call = _capsules_of(body)
        # frames and ends are filled in place, so that posing allocates nothing
        self._frames, self.ends = np.empty((1, len(self._args[2]), 4, 4)), np.empty_like(self._args[1])
        """World positions of the capsules' ends in the last posture, [n, 2, 3] [m]."""

    def pose(self, base: Array, *posture: Array) -> None:
        """Pose the capsules of an agent whose root is at a pose7 [7] in the world.

        A robot is posed by its joint positions [J], and a person by local rotations [55, 4] and the pelvis [3] [m].
        """
        self._call(self._kernel, base, *(part[None] for part in posture), *self._args, self._frames, self.ends)


def may_touch(a: AgentCapsules, b: AgentCapsules, spare_m: float = 0.0) -> bool:
    """Return whether two agents are close enough that `AgentContacts` has to test them.

    This is so if two of their capsules are within twice `NEAR_M` and ``spare_m`` [m].
    """
    # distance of capsules from which `AgentContacts` decides: more than its own `NEAR_M`, as it gets poses
    # rounded to float32
    margin_m = 2 * NEAR_M + spare_m
    return bool(any_near(a.ends, a.radii, b.ends, b.radii, margin_m))


@lru_cache(maxsize=64)
def _capsules_of(body: Humanoid | Robot) -> tuple[Any, tuple[Any, ...], Array, Entries]:
    """Return the kernel that poses a body's capsules and its arguments, the radii [n] [m], and what calls the kernel.

    The first arguments are the links or joints [n] of the capsules, their ends [n, 2, 3] in the frames of these [m], and an
    array with a row for each link or joint.
    """
    found: list[tuple[Any, ...]]
    rest: tuple[Any, ...]
    if isinstance(body, Robot):
        found = [(k, *bounding_capsule(shape)) for k, link in enumerate(body.links) for shape in link.shapes]
        kernel, rest = _pose_robot, (*body.joint_tree, np.ascontiguousarray(body.to_base, np.float64))
    else:
        found = [(one.joint, one.start, one.end, one.radius) for one in body.capsules]
        kernel, rest = _pose_person, (body.joint_offsets, PARENT_ARRAY)
    of, ends = np.array([k for k, *_ in found], np.int64), np.array([[start, end] for _, start, end, _ in found])
    args = of, ends.astype(np.float64).reshape(-1, 2, 3), *rest
    return kernel, args, np.array([radius for *_, radius in found], np.float64), Entries()


@kernel(error_model="numpy")
def _pose_robot(
    pose, joints, links, ends, parents, origins, kinds, axes, columns, gains, offsets, to_base, frames, out
):
    base, root = np.zeros((1, 4, 4)), np.eye(4)
    write_frame(np.eye(4), (pose[3], pose[4], pose[5], pose[6]), pose[0], pose[1], pose[2], root)
    for i in range(4):
        for j in range(4):
            for k in range(4):
                base[0, i, j] += root[i, k] * to_base[k, j]
    link_frames(base, joints, parents, origins, kinds, axes, columns, gains, offsets, frames)
    _move(frames[0], links, ends, out)


@kernel(error_model="numpy")
def _pose_person(pose, quats, pelvis, joints, ends, offsets, parents, frames, out):
    joint_frames(pose.reshape(1, 7), quats, pelvis, offsets, parents, frames)
    _move(frames[0], joints, ends, out)


@kernel(error_model="numpy")
def _move(frames, of, ends, out):
    """Write ends [n, 2, 3], given in the frames ``of`` [n], to ``out`` in the world."""
    for n in range(len(of)):
        frame = frames[of[n]]
        for k in range(2):
            x, y, z = ends[n, k, 0], ends[n, k, 1], ends[n, k, 2]
            for i in range(3):
                out[n, k, i] = frame[i, 0] * x + frame[i, 1] * y + frame[i, 2] * z + frame[i, 3]
