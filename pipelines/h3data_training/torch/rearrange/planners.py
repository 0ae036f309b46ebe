"""Partners that follow a plan, as tensors: `sim_kinematic.policies.rearrange.Planner`, line by line."""

from __future__ import annotations

import torch
from torch import Tensor

from h3data_training.torch.rearrange.skills import Choices, Hands, of_object
from h3data_training.torch.rearrange.state import DONE, FAILED, FREE, NOBODY, SubGoal

TRIES = 3
"""So often a planner fails at an object before it goes on to the next."""


def planned(choices: Choices, does: SubGoal, hands: Hands, at_goal: Tensor) -> tuple[Tensor, SubGoal]:
    """The choice [W] of planners that are free, and what they remember of it."""
    count = (does.order >= 0).sum(1)
    objects, asked = does.order.shape[1], does.skill == FREE
    failed, done = does.outcome == FAILED, does.outcome == DONE
    passed, tries = does.passed, does.tries
    number = torch.full_like(passed, 4 * objects)  # wait
    looks = asked
    for _ in range(objects):
        looks = looks & (passed < count)
        k = of_object(does.order, passed.clamp_max(objects - 1)).clamp_min(0)
        tries = tries + (looks & failed)
        holder = of_object(hands.held_by, k)
        mine = holder == choices.who
        left = ~of_object(at_goal, k) & (mine | (holder == NOBODY))
        goes = looks & (mine | (left & (tries < TRIES)))
        came = torch.where(mine, objects + k, k)
        there = done & (does.last == came)
        number = torch.where(goes, torch.where(there, came + 2 * objects, came), number)
        looks = looks & ~goes
        passed, tries = passed + looks, torch.where(looks, 0, tries)
    return number, does._replace(passed=passed, tries=tries)
