"""Arm of a robot as tensors, with joints that move by small steps, and the poses of the hand and other links."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from h3data.bodies import Robot
from h3data.bodies.robots.kinematics import FIXED, SLIDES, TURNS
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE
from sim_kinematic.motion.spec import ArmSpec


class Hand(NamedTuple):
    """Poses of hands or other links in W worlds, in a common frame."""

    point: Tensor
    """Points at which hands hold things, or origins of links, [W, 3] [m]."""
    axes: Tensor
    """Axes of the link as columns, [W, 3, 3]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Joint:
    """The joint of one link, as products with a constant matrix [3, 10]: where it is, and the three parts of its rotation."""

    column: int
    """Column of the arm's joint that moves this joint; -1 if none does."""
    gain: float
    offset: float
    parts: Tensor
    slides: Tensor | None
    """Axis of the joint [3], if it slides."""


class Arm:
    """Kinematics of the links that a robot's arm joints move, including the chain from its base to its hand."""

    def __init__(self, robot: Robot, device: torch.device | str, dtype: torch.dtype) -> None:
        """Copy the kinematics of a robot's arm to the device.

        Raises:
            InputError: the robot has no arm.
        """
        columns = robot.require_arm()
        self.robot, self.count = robot, len(columns)

        def constant(array: object) -> Tensor:
            return torch.as_tensor(np.asarray(array, np.float64), dtype=dtype, device=device)

        self.lower, self.upper = constant(robot.lower[list(columns)]), constant(robot.upper[list(columns)])
        self.rest = constant(robot.rest[list(columns)])
        chain = [robot.hand_link]
        while robot.links[chain[-1]].parent >= 0:
            chain.append(robot.links[chain[-1]].parent)
        self._start = constant(robot.to_base)
        self._at = constant(robot.hand_position)
        self._chain = chain[::-1]
        self._movable = _movable(robot, columns)
        self._joints = {link: self._joint(link, columns, constant) for link in {*chain, *self._movable}}
        self._rest = constant(robot.link_matrices(IDENTITY_POSE[None], np.asarray(robot.rest, np.float64)[None])[0])

    def _joint(self, link: int, columns: Sequence[int], constant: Callable[[object], Tensor]) -> _Joint:
        robot = self.robot
        origin, axis, kind = robot.origins[link], robot.axes[link], int(robot.kinds[link])
        if kind not in (FIXED, TURNS, SLIDES):
            raise InputError(
                f"Arms with ball joints are simulated on the CPU only, {robot.name} has one.", code="H3-TRAIN-069"
            )
        own, gain, offset = -1, float(robot.gains[link]), float(robot.offsets[link])
        if kind != FIXED and int(robot.columns[link]) in columns:
            own = columns.index(int(robot.columns[link]))
        elif kind != FIXED:  # a joint that is none of the arm's stays at rest
            offset, gain = gain * float(robot.rest[robot.columns[link]]) + offset, 0.0
        cross = np.cross(np.eye(3), axis)  # the matrix of the cross product with the axis
        turn = origin[:3, :3]
        moved = (turn, turn @ cross, turn @ cross @ cross)
        if kind == TURNS and own < 0:
            moved = (turn @ (np.eye(3) + np.sin(offset) * cross + (1 - np.cos(offset)) * cross @ cross), *moved[1:])
        place = origin[:3, 3] + (turn @ axis * offset if kind == SLIDES and own < 0 else 0.0)
        return _Joint(
            column=own,
            gain=gain,
            offset=offset,
            parts=constant(np.column_stack([*moved, place])),
            slides=constant(turn @ axis) if kind == SLIDES and own >= 0 else None,
        )

    def moved(self, joints: Tensor, action: Tensor, spec: ArmSpec) -> Tensor:
        """Return joints [W, n] [rad or m] after ``action`` [W, n] (`sim_kinematic.agents.manipulation.move_arms`)."""
        most = spec.joint_step
        return torch.minimum(torch.maximum(joints + action.clamp(-1.0, 1.0) * most, self.lower), self.upper)

    def hand(self, joints: Tensor) -> Hand:
        """Return the hand in the agent root frame at joint positions [W, n] [rad or m]."""
        link = self._followed(joints, self._chain)[self.robot.hand_link]
        return Hand(link.point + (link.axes * self._at).sum(-1), link.axes)

    def frames(self, joints: Tensor, links: Sequence[int]) -> Tensor:
        """Return matrices [W, L, 3, 4] of some links in the agent root frame, with the arm at joint positions [W, n].

        All joints that are not in the arm are at rest.
        """
        found = self._followed(joints, self._movable)
        still = self._rest[:, :3].expand(len(joints), -1, 3, 4)
        moved = {link: torch.cat([frame.axes, frame.point[..., None]], -1) for link, frame in found.items()}
        return torch.stack([moved[link] if link in self._movable else still[:, link] for link in links], 1)

    def _followed(self, joints: Tensor, links: Sequence[int]) -> dict[int, Hand]:
        """Return frames of links, each listed after its parent, and of the base."""
        count = len(joints)
        found = {-1: Hand(self._start[:3, 3].expand(count, 3), self._start[:3, :3].expand(count, 3, 3))}
        for link in links:
            joint, parent = self._joints[link], self.robot.links[link].parent
            found[link] = _after(joint, found[parent] if parent in found else self._resting(parent, count), joints)
        return found

    def _resting(self, link: int, count: int) -> Hand:
        return Hand(self._rest[link, :3, 3].expand(count, 3), self._rest[link, :3, :3].expand(count, 3, 3))


def _movable(robot: Robot, columns: Sequence[int]) -> list[int]:
    """Return the links that these joints move, each after its parent."""
    found: list[int] = []
    for k, link in enumerate(robot.links):
        own = int(robot.kinds[k]) != FIXED and int(robot.columns[k]) in columns
        if own or link.parent in found:
            found.append(k)
    return found


def _after(joint: _Joint, parent: Hand, joints: Tensor) -> Hand:
    """Return the frame of a link, from its parent's."""
    # on a GPU without a matrix product, which it might do with 10 bits
    axes = parent.axes
    parts = (axes[..., None] * joint.parts).sum(-2) if axes.is_cuda else axes @ joint.parts
    point = parent.point + parts[..., 9]
    if joint.column < 0:
        return Hand(point, parts[..., :3])
    way = joints[:, joint.column] * joint.gain + joint.offset
    if joint.slides is not None:
        return Hand(point + (axes * joint.slides).sum(-1) * way[:, None], parts[..., :3])
    s, c = way.sin()[:, None, None], (1.0 - way.cos())[:, None, None]
    return Hand(point, parts[..., :3] + s * parts[..., 3:6] + c * parts[..., 6:9])


def place_hand(hand: Hand, xz: Tensor, heading: Tensor, floor_y: Tensor) -> Hand:
    """Return hands in the world frame, for agents at floor points [W, 2] with headings [W] and heights [W]."""
    c, s = heading.cos(), heading.sin()
    x, y, z = hand.point.unbind(-1)
    point = torch.stack([xz[:, 0] + c * x + s * z, floor_y + y, xz[:, 1] + c * z - s * x], -1)
    c, s = c[:, None], s[:, None]
    ahead, up, right = hand.axes.unbind(-2)
    return Hand(point, torch.stack([c * ahead + s * right, up, c * right - s * ahead], -2))


def seen_by(hand: Hand, points: Tensor) -> Tensor:
    """Transform world points [..., 3] into the frames of hands in the world, [..., 3]."""
    return ((points - hand.point)[..., None] * hand.axes).sum(-2)


def turned(axes: Tensor, by: Tensor) -> Tensor:
    """Multiply rotations [..., 3, 3] with the same bits on every device.

    In matrix products, a GPU might use a precision of 10 bits.
    """
    return (axes[..., None] * by[..., None, :, :]).sum(-2)
