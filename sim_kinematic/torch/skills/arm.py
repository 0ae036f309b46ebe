"""A robot's arm as tensors: joints that move by small steps, and where they bring the hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from h3data.bodies import Robot
from h3data.bodies.robots.kinematics import FIXED, SLIDES, TURNS
from h3data.errors import InputError
from sim_kinematic.motion.spec import ArmSpec


class Hand(NamedTuple):
    """Hands of W worlds in some frame."""

    point: Tensor
    """Where they hold things, [W, 3] [m]."""
    axes: Tensor
    """The axes of the hand's link as columns, [W, 3, 3]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Joint:
    """One link of the chain from the base to the hand, as products with a constant matrix [3, 10]: where its joint is, and the
    three parts of its rotation."""

    column: int
    """Of the arm's joint that moves it; -1: none."""
    gain: float
    offset: float
    parts: Tensor
    slides: Tensor | None
    """Its axis [3], where it slides."""


class Arm:
    """The chain of links from a robot's base to its hand."""

    def __init__(self, robot: Robot, device: torch.device | str, dtype: torch.dtype) -> None:
        """
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
        self._joints = []
        for link in reversed(chain):
            origin, axis, kind = robot.origins[link], robot.axes[link], int(robot.kinds[link])
            if kind not in (FIXED, TURNS, SLIDES):
                raise InputError(f"Arms with ball joints are simulated on the CPU only, {robot.name} has one.")
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
            self._joints.append(
                _Joint(
                    column=own, gain=gain, offset=offset, parts=constant(np.column_stack([*moved, place])),
                    slides=constant(turn @ axis) if kind == SLIDES and own >= 0 else None,
                )
            )  # fmt: skip

    def moved(self, joints: Tensor, action: Tensor, spec: ArmSpec) -> Tensor:
        """Joints [W, n] after a step by ``action`` [W, n], as `sim_kinematic.agents.manipulation.move_arms`."""
        most = spec.joint_step
        return torch.minimum(torch.maximum(joints + action.clamp(-1.0, 1.0) * most, self.lower), self.upper)

    def hand(self, joints: Tensor) -> Hand:
        """The hand in the agent root frame at joint positions [W, n]."""
        axes = self._start[:3, :3].expand(len(joints), 3, 3)
        point = self._start[:3, 3].expand(len(joints), 3)
        for joint in self._joints:
            # on a GPU without a matrix product, which it might do with 10 bits
            parts = (axes[..., None] * joint.parts).sum(-2) if axes.is_cuda else axes @ joint.parts
            point = point + parts[..., 9]
            if joint.column < 0:
                axes = parts[..., :3]
                continue
            way = joints[:, joint.column] * joint.gain + joint.offset
            if joint.slides is not None:
                point = point + (axes * joint.slides).sum(-1) * way[:, None]
                axes = parts[..., :3]
                continue
            s, c = way.sin()[:, None, None], (1.0 - way.cos())[:, None, None]
            axes = parts[..., :3] + s * parts[..., 3:6] + c * parts[..., 6:9]
        return Hand(point + (axes * self._at).sum(-1), axes)


def placed(hand: Hand, xz: Tensor, heading: Tensor, floor_y: Tensor) -> Hand:
    """Hands in the frames of agents at floor points [W, 2] with headings [W] and heights [W], in the world."""
    c, s = heading.cos(), heading.sin()
    x, y, z = hand.point.unbind(-1)
    point = torch.stack([xz[:, 0] + c * x + s * z, floor_y + y, xz[:, 1] + c * z - s * x], -1)
    c, s = c[:, None], s[:, None]
    ahead, up, right = hand.axes.unbind(-2)
    return Hand(point, torch.stack([c * ahead + s * right, up, c * right - s * ahead], -2))


def seen_by(hand: Hand, points: Tensor) -> Tensor:
    """World points [W, 3] in the frames of hands in the world, [W, 3]."""
    return ((points - hand.point)[:, :, None] * hand.axes).sum(-2)
