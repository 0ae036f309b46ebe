"""What bases in W worlds know of the floor without pictures: `sim_kinematic.sensing.sensor` as tensor operations."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from h3data_training.torch.state import RobotTensors
from h3data_training.torch.step import Grids, heading_direction, sample_sdf, wrap_angle
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.sensing.sensor import FAR_M, RANGE_M, RANGE_STRIDES, RANGES


def polar(seen: Tensor) -> Tensor:
    """Distance, and angle positive to the right, of what is ``seen`` forward and left, [W, 2]."""
    return torch.stack([torch.hypot(seen[:, 0], seen[:, 1]), -torch.atan2(seen[:, 1], seen[:, 0])], -1)


def in_base_frame(xz: Tensor, heading: Tensor, point: Tensor) -> Tensor:
    """Points [W, 2] as seen from bases: forward and left, [W, 2]."""
    gap, forward = point - xz, heading_direction(heading)
    left = gap[:, 0] * forward[:, 1] - gap[:, 1] * forward[:, 0]
    return torch.stack([(gap * forward).sum(-1), left], -1)


def way(robot: RobotTensors, length: Tensor, towards: Tensor) -> Tensor:
    """Length of a path [W] [m] and the angle to the directions (x, z) [W, 2] in which it begins, [W, 2]."""
    angle = polar(in_base_frame(robot.xz, robot.heading, robot.xz + towards))[:, 1]
    return torch.stack([length.clamp_max(FAR_M), torch.where(length.isinf(), 0.0, angle)], -1)


def egomotion(before_xz: Tensor, before_heading: Tensor, robot: RobotTensors) -> Tensor:
    """Velocity of bases in their frames before the step, forward, left [m/s] and turn [rad/s], [W, 3]."""
    moved = in_base_frame(before_xz, before_heading, robot.xz)
    return torch.cat([moved, wrap_angle(robot.heading - before_heading)[:, None]], 1) / STEP_S


def range_scan(grids: Grids, robot: RobotTensors) -> Tensor:
    """Free way in `RANGES` directions, [W, RANGES] [m]."""
    turns = (2 * math.pi / RANGES) * torch.arange(RANGES, device=robot.heading.device)[:, None]
    direction = heading_direction(robot.heading + turns)  # [RANGES, W, 2]
    reach = torch.zeros(direction.shape[:-1], dtype=robot.heading.dtype, device=robot.heading.device)
    for _ in range(RANGE_STRIDES):
        left = sample_sdf(grids, torch.addcmul(robot.xz, direction, reach[..., None])).distance
        reach = (reach + left.clamp_min(0.0)).clamp_max(RANGE_M)
    return reach.T
