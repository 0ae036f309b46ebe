"""Social navigation in W worlds on a device, with the paper's reward of `sim_kinematic.tasks.social_nav`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from h3data_training.torch.episodes import EpisodeBank
from h3data_training.torch.geodesic import ShortestPath
from h3data_training.torch.task_worlds import Play, TaskTensors
from sim_kinematic.sensing.sensor import facing
from sim_kinematic.sensing.table import FOLLOWER, LIDARS
from sim_kinematic.tasks.episode import StepOutcome
from sim_kinematic.tasks.rules.predicates import is_found
from sim_kinematic.tasks.rules.rewards import PaperReward
from sim_kinematic.tasks.social_nav import SocialNav

ON_DEVICES = (*FOLLOWER, *LIDARS)
"""Observations of the robot that social navigation on a device supports."""


class SocialNavTensors(TaskTensors):
    """W worlds of social navigation.

    The memory has five entries: ``found`` (whether the robot has found the person in this episode), ``followed`` (the
    number of steps in which it followed them), ``geodesic`` (the distance along the path [W] [m], infinite if there is
    no path), ``towards`` (its initial direction (x, z) [W, 2]), and ``distance`` (the distance that the reward counts
    [W] [m]).
    """

    def __init__(self, bank: EpisodeBank, **options: Any) -> None:
        """Create worlds with the options of `TaskTensors` and the paper's reward."""
        super().__init__(bank, task=SocialNav(), **options)
        self.paper = PaperReward()

    def _begun(self, play: Play) -> dict[str, Tensor]:
        way, steps = super().path_to_person(play), torch.zeros_like(play.steps)
        distance = torch.full_like(way.length, torch.nan)
        return {
            "found": steps > 0,
            "followed": steps,
            "geodesic": way.length,
            "towards": way.towards,
            "distance": distance,
        }

    def _judged(self, now: Play, fresh: Tensor) -> tuple[StepOutcome, dict[str, Tensor]]:
        """Return the outcome by the paper's reward (`sim_kinematic.tasks.rules.rewards.SocialNavReward`)."""
        rules, before, memory = self.spec, now.memory, self._begun(now)
        faces, length = facing(now.robot.xz, now.robot.heading, now.human.xz, xp=torch), memory["geodesic"]
        gap = now.human.xz - now.robot.xz
        reward, followed, success, distance = self.paper.of(
            length, torch.hypot(gap[:, 0], gap[:, 1]), before["distance"], faces, before["followed"], rules, xp=torch
        )
        ends = now.collides if rules.end_on_collision else torch.zeros_like(now.collides)
        found = ~fresh & (before["found"] | is_found(length, faces, rules))
        memory |= {"found": found, "followed": torch.where(fresh, 0, followed), "distance": distance}
        return StepOutcome(reward=reward, terminated=ends, success=success), memory  # type: ignore[arg-type]

    def succeeded(self, play: Play) -> Tensor:
        """Return whether the robot of each world has followed long enough, bool [W]."""
        return play.memory["followed"] >= self.paper.follow_steps

    def path_to_person(self, play: Play) -> ShortestPath:
        """Return the known shortest paths from robots to people."""
        return ShortestPath(play.memory["geodesic"], play.memory["towards"])
