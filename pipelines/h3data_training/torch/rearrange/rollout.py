"""Rollout on a device of tasks with objects, whose `begin` and `judge` are called with tensors."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from h3data_training.torch.rearrange.state import Play
from sim_kinematic.sensing.table import Pose


class Things(NamedTuple):
    """Agents of all worlds at one step, and the holders of objects."""

    agents: tuple[Any, Any]
    """State of robots and people; each has ``xz`` and ``heading``."""
    held_by: Tensor
    """Holder of each object: 0 is the robot, 1 the person, -1 nobody, int64 [W, K]."""


class SkillWorld(NamedTuple):
    """Part of a `sim_kinematic.world.World` that tasks of agents with skills read on a device."""

    worlds: int
    state: Things
    before: Things
    """Agents one step ago; the holders of objects at that time are not known."""
    touching: Tensor
    """True if robot and person touch, bool [W, 1]."""


class SkillTensorRollout:
    """Part of a `sim_kinematic.tasks.play.WorldRollout` with skills that tasks read on a device."""

    xp = torch

    def __init__(self, spec: Any, now: Play, at_goal: Tensor, memory: Any) -> None:
        """Create a rollout; ``memory`` has the values that the task stores between steps, [W, ...] each."""
        self.spec, self.steps, self.memory = spec, now.steps, memory
        self.at_goal, self.open_parts = at_goal, now.opened
        was = tuple(Pose(now.before[:, who, :2], now.before[:, who, 2]) for who in range(2))
        self.world = SkillWorld(
            len(now.steps),
            Things((now.robot, now.human), now.held_by),
            Things((was[0], was[1]), now.held_by),
            now.collides[:, None],
        )

    def events_where(self, flags: Tensor, kind: str, *, agent: int = -1, target: str = "") -> tuple[()]:
        """Return no events, because nothing is recorded on a device."""
        return ()
