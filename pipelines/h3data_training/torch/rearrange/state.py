"""State of W worlds of rearrangement as tensors that are replaced instead of changed in place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from h3data_training.torch.state import HumanTensors, RobotTensors, tensors_of
from sim_kinematic.tasks.skills.household import TRACK

RUNNING, DONE, FAILED, ABORTED = 0, 1, 2, 3
"""Outcomes of the last choice of an agent."""
NOBODY = -1
FREE = -1
"""Number for no choice, with which an agent has to choose; as an action, it means to continue or to wait."""


class SubGoal(NamedTuple):
    """Sub-goal of one agent in each world."""

    skill: Tensor
    """Number of the agent's current choice, int64 [W]; `FREE` if the agent chooses in its next turn."""
    field: Tensor
    """Number of the table of paths that the agent follows (`RearrangeBank`), int64 [W]."""
    way: Tensor
    """Number of the path point to which the agent moves, int64 [W]."""
    best: Tensor
    """Smallest distance to the sub-goal so far [W] [m]; negative if the agent has arrived and started to turn."""
    since: Tensor
    """Number of steps since the start of the sub-goal, int64 [W]."""
    timer: Tensor
    """Number of steps of the current skill so far, int64 [W]."""
    last: Tensor
    """Number of the last choice, int64 [W]."""
    outcome: Tensor
    """Outcome of the last choice, int64 [W]."""
    order: Tensor
    """Objects that a planner brings to their goals, one after the other, int64 [W, K]; -1 after the last."""
    passed: Tensor
    """Number of objects in that order that are done or skipped, int64 [W]."""
    tries: Tensor
    """Number of failed attempts at the current object, int64 [W]."""

    @classmethod
    def none(cls, worlds: int, objects: int, device: torch.device, dtype: torch.dtype) -> SubGoal:
        """Return sub-goals of agents that choose in their next turn."""

        def whole(value: int, *axes: int) -> Tensor:
            return torch.full((worlds, *axes), value, dtype=torch.int64, device=device)

        return cls(
            skill=whole(FREE),
            field=whole(0),
            way=whole(0),
            best=torch.full((worlds,), torch.inf, dtype=dtype, device=device),
            since=whole(0),
            timer=whole(0),
            last=whole(-1),
            outcome=whole(RUNNING),
            order=whole(-1, objects),
            passed=whole(0),
            tries=whole(0),
        )


class Hands(NamedTuple):
    """Objects with their holders, and open parts, in W worlds (`Play`)."""

    objects: Tensor
    held_by: Tensor
    moved: Tensor
    placed_by: Tensor
    opened: Tensor


class Play(NamedTuple):
    """State of W worlds, each with a robot and a person who rearrange objects."""

    robot: RobotTensors
    human: HumanTensors
    robot_does: SubGoal
    human_does: SubGoal
    objects: Tensor
    """Positions of the objects, [W, K, 3] [m]."""
    held_by: Tensor
    """Holder of each object: 0 for the robot, 1 for the person, -1 for none, int64 [W, K]."""
    moved: Tensor
    """True if each object has been put down at its goal, bool [W, K]."""
    placed_by: Tensor
    """Number of the agent that last put each object down, -1 for none, int64 [W, K]."""
    paid: Tensor
    """Sub-goals that have been rewarded (each object picked, then each object at its goal), bool [W, 2 K]."""
    opened: Tensor
    """True for the doors and drawers of the task that are open, bool [W, M]."""
    memory: Mapping[str, Tensor]
    """Values that a custom task stores between steps, [W, ...] each."""
    track: Tensor
    """Positions of robot and person after the last steps, in a ring buffer by step number, [W, 31, 2, 2] [m]."""
    before: Tensor
    """Place ``(x, z, heading)`` of both agents one step ago, [W, 2, 3] [m, m, rad]."""
    episode: Tensor
    """Number of the episode in the bank, int64 [W]."""
    steps: Tensor
    """Number of steps of the episode so far, int64 [W]."""
    ended: Tensor
    """True if the episode is over, so that the next step starts another, bool [W]."""
    success: Tensor
    collides: Tensor
    """True if both agents touch, bool [W]."""
    reward: Tensor
    """Reward of the last step, [W]."""
    terminated: Tensor
    """True if the rules ended the episode in the last step, bool [W]."""
    truncated: Tensor
    """True if the episode reached its time limit, bool [W]."""

    @classmethod
    def before_the_first(cls, episode: Tensor, objects: int, dtype: torch.dtype, parts: int = 0) -> Play:
        """Return worlds whose first step starts the episodes after ``episode`` [W]; a task's memory is empty."""
        worlds, device = len(episode), episode.device

        def numbers(*axes: int) -> Tensor:
            return torch.zeros((worlds, *axes), dtype=dtype, device=device)

        def flags(*axes: int) -> Tensor:
            return torch.zeros((worlds, *axes), dtype=torch.bool, device=device)

        nobody = torch.full((worlds, objects), NOBODY, dtype=torch.int64, device=device)
        return cls(
            robot=RobotTensors(numbers(2), numbers(), flags()),
            human=HumanTensors(numbers(2), numbers(), numbers(), numbers(), numbers()),
            robot_does=SubGoal.none(worlds, objects, device, dtype),
            human_does=SubGoal.none(worlds, objects, device, dtype),
            objects=numbers(objects, 3),
            held_by=nobody,
            moved=flags(objects),
            placed_by=nobody.clone(),
            paid=flags(2 * objects),
            opened=flags(parts),
            memory={},
            track=numbers(TRACK, 2, 2),
            before=numbers(2, 3),
            episode=episode.clone(),
            steps=torch.zeros_like(episode),
            ended=~flags(),
            success=flags(),
            collides=flags(),
            reward=numbers(),
            terminated=flags(),
            truncated=flags(),
        )

    @property
    def hands(self) -> Hands:
        """Objects with their holders, the agents that moved or placed them, and open parts."""
        return Hands(self.objects, self.held_by, self.moved, self.placed_by, self.opened)

    def tensors(self) -> Iterator[Tensor]:
        """Return all tensors, in a fixed order."""
        return tensors_of(self)
