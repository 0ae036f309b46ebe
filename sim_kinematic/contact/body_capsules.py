"""Capsules around an agent in any posture, as a first test before FCL at a tenth of the cost of posing its shapes.

A step of rearrangement asks up to five times whether agents touch, and they almost never do. Posing both bodies for
`AgentContacts` took a sixth of the step.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.kernels.clips import joint_frames, write_frame
from h3data.bodies.people.skeleton import PARENT_ARRAY
from h3data.bodies.robots.kinematics import link_frames
from h3data.geometry import IDENTITY_POSE, Array
from h3data.kernels import kernel
from h3data.kernels.entries import Entries
from h3data.scene.shape_bounds import bounding_capsule
from sim_kinematic.contact.agent_contact import NEAR_M, any_near

_CALL = Entries()


class AgentCapsules:
    """Capsules around a robot's links, or around a person's bones, in the frame of the agent root."""

    def __init__(self, body: Humanoid | Robot) -> None:
        self._kernel, self._args, self.radii, self._call = _capsules_of(body)
        # frames and ends are filled in place, so that posing allocates nothing
        self._frames, self.ends = np.empty((1, len(self._args[2]), 4, 4)), np.empty_like(self._args[1])
        """Positions of the capsules' ends in the last posture, [n, 2, 3] [m]."""

    def pose(self, *posture: Array) -> None:
        """Pose the capsules.

        A robot is posed by its joint positions [J], and a person by local rotations [55, 4] and the pelvis [3] [m].
        """
        self._call(self._kernel, IDENTITY_POSE, *(part[None] for part in posture), *self._args, self._frames, self.ends)


def may_touch(a: AgentCapsules, base_a: Array, b: AgentCapsules, base_b: Array) -> bool:
    """Return whether two agents at pose7 [7] are close enough that `AgentContacts` has to test them.

    This is so if two of their capsules are within twice `NEAR_M`.
    """
    # distance of capsules from which `AgentContacts` decides: more than its own `NEAR_M`, as it gets poses
    # rounded to float32
    return bool(_CALL(_near_at, a.ends, a.radii, base_a, b.ends, b.radii, base_b, 2 * NEAR_M))


@kernel(error_model="numpy")
def _near_at(ends_a, radii_a, base_a, ends_b, radii_b, base_b, margin):
    """Return the result of `any_near` for two agents whose roots are at pose7 [7]."""
    # upright they reach no farther than in their own frames; on stairs robots tilt
    if base_a[3] == 0.0 and base_a[5] == 0.0 and base_b[3] == 0.0 and base_b[5] == 0.0:
        reach = margin + 1e-9
        for ends, radii in ((ends_a, radii_a), (ends_b, radii_b)):
            most = 0.0
            for n in range(len(radii)):
                for k in range(2):
                    most = max(most, math.hypot(ends[n, k, 0], ends[n, k, 2]) + radii[n])
            reach += most
        if math.hypot(base_a[0] - base_b[0], base_a[2] - base_b[2]) > reach:
            return False
    return any_near(_moved(ends_a, base_a), radii_a, _moved(ends_b, base_b), radii_b, margin)


@kernel(error_model="numpy")
def _moved(ends, base):
    """Return ends [n, 2, 3] in the frame of an agent root at a pose7 [7] in the world."""
    frame, out = np.eye(4), np.empty_like(ends)
    write_frame(np.eye(4), (base[3], base[4], base[5], base[6]), base[0], base[1], base[2], frame)
    _move(frame.reshape(1, 4, 4), np.zeros(len(ends), np.int64), ends, out)
    return out


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
