"""Batched worlds of a skill for training.

An action is repeated for several steps, and pictures are rendered after the last, all in one CUDA graph.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from h3data.bodies import load_robot
from h3data_training.skills.settings import SkillSettings
from h3data_training.torch.graph import can_fuse, fused, overwrite
from h3data_training.torch.skills.bank import SkillBank
from h3data_training.torch.skills.teacher import taught
from h3data_training.torch.skills.worlds import SkillTensors
from h3data_training.worlds import ActionRepeatGoal
from sim_kinematic.agents.robots.hand_reach import reach_bearing
from sim_kinematic.sensing.sensor import scaled_depth


class ActionRepeatSkills(ActionRepeatGoal):
    """`SkillTensors` in which an action is repeated for ``hold`` steps, as `h3data_training.ppo.Worlds` for skills."""

    counts = (*ActionRepeatGoal.counts, "holding")

    def __init__(
        self,
        settings: SkillSettings,
        bank: SkillBank,
        *,
        device: str,
        compile: bool | None = None,
        hold: int | None = None,
        count: int | None = None,
    ) -> None:
        """Create ``count`` worlds (default: the number in the settings), a share of those of several processes."""
        super().__init__(hold or settings.hold, count or settings.worlds, device)
        self.limit, self._by_sight = settings.limit, "way" not in settings.observations
        starts = bank.with_near(settings.near_share)
        if settings.reaching_share:
            bearing = reach_bearing(load_robot(settings.robot))
            starts = starts.with_reaching(settings.reaching_share, bearing, np.random.default_rng(0))
        self.sim = SkillTensors(settings.skill, starts, device=device, dtype=torch.float32, robot=settings.robot)
        told = dict.fromkeys((*settings.observations, *settings.critic))
        self._names = tuple(name for name in told if name != "arm_depth")
        worlds, where = self.num_envs, self.device
        self.play = self.sim.before_the_first(torch.full((worlds,), -1, dtype=torch.int64, device=where))
        self.shown = torch.arange(worlds, device=where) < round(settings.demonstrations * worlds)
        self._action = torch.zeros(worlds, self.sim.action_width, device=where)
        self._shown: dict[str, Tensor] = {}
        compiles = self.device.type == "cuda" and can_fuse() if compile is None else compile
        self._move = fused(self._moved) if compiles else self._moved
        self._cameras = (
            self._make_cameras(settings.picture_size, compile=compiles)
            if "arm_depth" in settings.observations
            else None
        )

    def _make_cameras(self, size: tuple[int, int], *, compile: bool) -> Any:
        if self.device.type == "cuda":
            from h3data_training.torch.skills.cameras import SkillCameras

            return SkillCameras(self.sim, worlds=self.num_envs, size=size, compile=compile)
        from h3data_training.skills.cpu_cameras import CpuSkillCameras

        return CpuSkillCameras(self.sim, size=size)

    def _eager(self) -> None:
        self._hold_action()
        shown = self.sim.observations(self._names, self.play)
        if self._cameras is not None:
            shown["arm_depth"] = scaled_depth(self._cameras.observe(self.play)["depth"])[..., None]
        self._show(shown)

    def _step_held(self, k: int) -> None:
        self._move(k == self.hold - 1)

    def _moved(self, looks: bool) -> None:
        """Make a step of all worlds, in place: of a state that fused code returns, PyTorch 2.11 loses parts."""
        overwrite(self.play.tensors(), self.sim.step(self.play, self._action, looks=looks).tensors())

    def _counted(self, before: None, live: Tensor, ends: Tensor) -> list[Tensor]:
        return [*self._results(self.play.success, live, ends), (live & (self.play.held >= 0)).sum()]

    def taught(self) -> Tensor:
        """Return the actions of the scripted teacher in the current states, [W, A]."""
        with torch.no_grad():
            return taught(self.sim, self.play, self.hold, by_sight=self._by_sight)
