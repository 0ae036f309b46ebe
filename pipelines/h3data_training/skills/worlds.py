"""Batched worlds of a skill for training: an action is held for some steps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from h3data.errors import InputError
from h3data_training.skills.settings import SkillSettings
from sim_kinematic.torch.graph import can_fuse, captured, fused
from sim_kinematic.torch.random import keys, random
from sim_kinematic.torch.skills.bank import SkillBank
from sim_kinematic.torch.skills.teacher import taught
from sim_kinematic.torch.skills.worlds import SkillTensors

COUNTS = ("reward", "succeeded", "failed", "ended", "steps", "contact", "holding")
"""Sums over worlds and steps that `HeldSkills.totals` keeps."""


class HeldSkills:
    """`SkillTensors` in which an action moves all worlds ``hold`` steps: a `h3data_training.ppo.Worlds`.

    A world whose episode ends on the way begins the next one at once; what it gains after that is not counted.
    """

    counts = COUNTS

    def __init__(
        self, settings: SkillSettings, bank: SkillBank, *, device: str, compile: bool | None = None, hold: int | None = None,
        count: int | None = None,
    ) -> None:  # fmt: skip
        """``count`` worlds, by default those of the settings; of several processes, each has its share of them."""
        if "arm_depth" in settings.observations:
            raise InputError(
                "Skills are learned without pictures so far, got arm_depth. Hint: --observations without it."
            )
        self.hold, self.num_envs, self.device = hold or settings.hold, count or settings.worlds, torch.device(device)
        self.limit = settings.limit
        starts = bank.with_near(settings.near_share)
        self.sim = SkillTensors(settings.skill, starts, device=device, dtype=torch.float32, robot=settings.robot)
        self._names = tuple(dict.fromkeys((*settings.observations, *settings.critic)))
        worlds, where = self.num_envs, self.device
        self.play = self.sim.before_the_first(torch.full((worlds,), -1, dtype=torch.int64, device=where))
        self.gain = torch.zeros(worlds, device=where)
        self.over, self.timed_out, self.idle = (torch.zeros(worlds, dtype=torch.bool, device=where) for _ in range(3))
        self.totals = torch.zeros(len(COUNTS), device=where)
        self._action = torch.zeros(worlds, self.sim.action_width, device=where)
        self._shown: dict[str, Tensor] = {}
        compiles = self.device.type == "cuda" and can_fuse() if compile is None else compile
        self._step = fused(self.sim.step) if compiles else self.sim.step
        self._advance = self._eager

    def reset(self, *, seed: Sequence[int]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Begins an episode in all worlds, each at the place in the bank that follows from its seed."""
        with torch.no_grad():
            if self.device.type == "cuda" and self._advance == self._eager:
                self._advance = captured(self._eager, list(self.play.tensors()))
            drawn = random(keys(seed, "bank", device="cpu"), torch.zeros(len(seed), dtype=torch.int64), 1)[:, 0]
            self.play.episode.copy_((drawn * len(self.sim.bank)).long().to(self.device) - 1)
            self.play.ended.fill_(True)
            self._action.zero_()
            hold, self.hold = self.hold, 1
            self._eager()
            self.hold = hold
        return self._result(), {}

    def _eager(self) -> None:
        play = self.play
        idle, timed_out = play.ended.clone(), play.ended & play.truncated
        live, inside = ~idle, torch.zeros_like(idle)
        gain, sums = torch.zeros_like(self.gain), torch.zeros_like(self.totals)
        for k in range(self.hold):
            after = self._step(play, self._action, looks=k == self.hold - 1)
            for tensor, value in zip(play.tensors(), after.tensors(), strict=True):
                tensor.copy_(value)
            enough = ~play.ended & (play.steps >= self.limit)
            play.truncated.logical_or_(enough)
            play.ended.logical_or_(enough)
            ends = live & play.ended
            gain = gain + torch.where(live, play.reward, 0.0)
            sums = sums + torch.stack([
                torch.where(live, play.reward, 0.0).sum(), (live & play.success).sum(),
                (live & play.terminated & ~play.success).sum(), ends.sum(), live.sum(), (live & play.robot.contact).sum(),
                (live & (play.held >= 0)).sum(),
            ]).float()  # fmt: skip
            live = live & ~ends
            if k < self.hold - 1:
                inside, timed_out = inside | ends, timed_out | (ends & play.truncated)
        self._shown = self.sim.observations(self._names, play)
        self.gain.copy_(gain)
        self.over.copy_(idle | inside)
        self.timed_out.copy_(timed_out)
        self.idle.copy_(idle)
        self.totals.add_(sums)

    def held(self, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, Tensor]:
        """As of `h3data_training.ppo.Worlds`."""
        with torch.no_grad():
            self._action.copy_(action)
            self._advance()
        return self._result(), self.gain.clone(), self.over.clone(), self.timed_out.clone(), self.idle.clone()

    def taught(self) -> Tensor:
        """As of `h3data_training.ppo.Worlds`."""
        with torch.no_grad():
            return taught(self.sim, self.play, self.hold)

    def _result(self) -> dict[str, Tensor]:
        return {name: tensor.clone() for name, tensor in self._shown.items()}

    def figures(self, total: dict[str, float]) -> dict[str, float]:
        """As of `h3data_training.ppo.Worlds`."""
        steps, ended = max(total["steps"], 1.0), max(total["ended"], 1.0)
        return {
            "reward": total["reward"] / steps, "succeeded": total["succeeded"] / ended, "failed": total["failed"] / ended,
            "holding": total["holding"] / steps, "contact": total["contact"] / steps, "steps_per_episode": steps / ended,
        }  # fmt: skip
