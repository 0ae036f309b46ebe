"""Scripted teacher that carries out the skills in W worlds, and which learning policies imitate at first.

The teacher knows the path, and a posture that reaches the target.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from h3data_training.torch.skills.arm import place_hand
from h3data_training.torch.skills.worlds import SkillPlay, SkillTensors
from h3data_training.torch.state import RobotTensors
from h3data_training.torch.step import wrap_angle
from sim_kinematic.agents.robots.hand_reach import reach_bearing
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.sensing.sensor import in_base_frame

ARRIVED_M, NEARLY_M = 0.1, 0.4
"""Distance from the stand at which a robot turns to the target, and that distance for an extended arm [m]."""
REACHES_M = 0.3
"""Distance from the stand at which the arm starts to move [m]."""
ALIGNED_RAD = 0.6
"""Angle to the path up to which the robot drives; above it, the robot turns in place [rad]."""
IN_REACH_M, AROUND_M = 0.2, 2.0
"""Limits within which a robot that sees its target reaches out [m]: the difference of its distance to the target from
that at the stand, and the length of the path to the stand, which excludes targets behind a wall.
"""
PUTS_M = 0.1
"""Distance from the goal at which the robot releases the object [m]."""
SURE = 1.5
"""Command of a hand that keeps holding, far enough from 0 for the noise of exploration."""


def taught(sim: SkillTensors, play: SkillPlay, hold: int, *, by_sight: bool = False) -> Tensor:
    """Return the teacher's current actions for ``hold`` steps, [W, A], in -1..1 except for the hand's command.

    ``by_sight`` is for robots that do not observe the path to the stand. They cannot know whether they have arrived,
    and in states that they cannot distinguish they imitate the mean action, which is never to reach out. Without
    ``by_sight``, no robot learned to pick in 0.5 M decisions; with it, 90% of episodes succeeded after 0.14 M.
    """
    robot, base = play.robot, sim.drive.base
    point = sim.points(play)
    turn_most, drive_most = (limit * STEP_S * hold for limit in (base.max_turn_rad_s, base.max_speed_mps))
    along = _bearing(_seen(robot, robot.xz + play.towards))
    back = (play.way < 2 * NEARLY_M) & (along.abs() > math.pi / 2)
    error = wrap_angle(torch.where(back, along + math.pi, along))
    speed = torch.where(error.abs() < ALIGNED_RAD, error.cos() * (play.way / drive_most).clamp_max(1.0), 0.0)
    forward, turn = torch.where(back, -speed, speed), error
    target = _seen(robot, point[:, 0:3:2])
    aside = wrap_angle(_bearing(target) - reach_bearing(sim.arm.robot))
    if sim.skill == "nav":  # it has arrived before its stand, facing the target
        near = play.way < 1.0
        forward, turn = torch.where(near, 0.2 * forward, forward), torch.where(near, aside, turn)
        return torch.stack([forward, (turn / turn_most).clamp(-1.0, 1.0)], -1).float()
    posture = sim.reaching(play)
    unfolded = 1.0 - sim.off(play, posture)
    left, arrived = play.way, ARRIVED_M
    if by_sight:
        off = (torch.hypot(target[:, 0], target[:, 1]) - sim.reach(play)).abs()
        left, arrived = torch.where(left < AROUND_M, torch.minimum(left, off), left), IN_REACH_M
    near = (left < arrived) | ((unfolded > 0.5) & (left < NEARLY_M))
    hand = place_hand(sim.arm.hand(play.joints), robot.xz, robot.heading, sim.floors(play)).point
    reached = _seen(robot, hand[:, 0:3:2])
    short = ((target - reached)[:, 0] / drive_most).clamp(-0.5, 0.5) * (unfolded > 0.8)
    forward, turn = torch.where(near, short, forward), torch.where(near, aside, turn)
    holds = play.held == sim.targets(play)
    finished = holds if sim.skill == "pick" else ~holds
    reaches = (near | (left < REACHES_M)) & ~finished
    wanted = torch.where(reaches[:, None], posture, sim.arm.rest)
    joints = (wanted - play.joints) / (sim.arm_rules.joint_step * hold)
    grips = torch.full_like(forward, SURE)
    if sim.skill == "place":
        grips = torch.where(finished | (play.apart < PUTS_M), -SURE, SURE).to(forward)
    still = (~finished).to(forward)
    base_action = torch.stack([forward * still, (turn / turn_most).clamp(-1.0, 1.0) * still], -1)
    return torch.cat([base_action, joints.clamp(-1.0, 1.0), grips[:, None]], 1).float()


def _seen(robot: RobotTensors, points: Tensor) -> Tensor:
    """Return the floor points [W, 2] as robots see them: forward and left [W, 2] [m]."""
    return in_base_frame(robot.xz, robot.heading, points, xp=torch)  # type: ignore[arg-type]


def _bearing(seen_from: Tensor) -> Tensor:
    """Return the angle to the left of what is ``seen_from`` bases, forward and left [W, 2], [W]."""
    return torch.atan2(seen_from[:, 1], seen_from[:, 0])
