"""Batched worlds for training: an action is held for some steps and a picture taken after the last, all in one CUDA graph."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from h3data.errors import InputError
from h3data_training.cpu_cameras import CpuCameras
from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv
from h3data_training.envs.task_torch_env import arm_cameras
from h3data_training.episodes import rules
from h3data_training.held import ActionRepeat
from h3data_training.settings import CRITIC, Settings
from h3data_training.torch.episodes import EpisodeBank

COUNTS = ("reward", "follows", "collided", "ended", "steps", "contact", "met", "distance")
"""Names of the sums over worlds and steps in `ActionRepeatEnv.totals`."""


class ActionRepeatEnv(ActionRepeat, SocialNavTorchEnv):
    """Version of `SocialNavTorchEnv` in which an action moves all worlds ``hold`` steps."""

    counts = COUNTS

    def __init__(
        self,
        settings: Settings,
        bank: EpisodeBank,
        *,
        device: str,
        compile: bool | None = None,
        hold: int | None = None,
        count: int | None = None,
    ) -> None:
        """``count`` worlds, by default those of the settings; of several processes, each has its share of them."""
        self.hold, self.follow_steps = hold or settings.hold, settings.follow_steps
        shown: Any = tuple(dict.fromkeys((*settings.observations, *CRITIC)))
        super().__init__(
            count or settings.worlds,
            device=device,
            dtype=torch.float32,
            observations=shown,
            spec=rules(settings),
            episodes=bank,
            depth_size=settings.picture_size,
            light=settings.light,
            robot=settings.robot,
            human=settings.human,
            compile=compile,
        )
        self._make_totals(self.num_envs, self.device)

    def _make_cameras(self, size: tuple[int, int] | None, *, compile: bool, robot: str, human: str) -> Any:
        if self.device.type == "cuda":
            return super()._make_cameras(size, compile=compile, robot=robot, human=human)
        assert size is not None
        floors = [floor.floor_y for floor in self.bank.floors]
        return CpuCameras(
            self.bank.scenes,
            robot,
            human,
            self.sim.spec.human,
            floors=floors,
            views=arm_cameras(self._names),
            size=size,
            light=self._light or "flat",
        )

    def _eager(self) -> None:
        self._hold_action()
        if self._cameras is not None:
            self._shown |= self._pictures(self._cameras)
        self._shown = {name: self._shown[name] for name in self._names}

    def _step_held(self, k: int) -> Tensor:
        followed = self.play.memory["followed"].clone()
        self._shown = self._move()
        return followed

    def _long_enough(self) -> Tensor | None:
        return self.play.memory["followed"] >= self.follow_steps if self.follow_steps else None

    def _counted(self, before: Tensor, live: Tensor, ends: Tensor) -> list[Tensor]:
        play = self.play
        return [
            (live & (play.memory["followed"] > before)).sum(),
            (live & play.terminated).sum(),
            ends.sum(),
            live.sum(),
            (live & play.robot.contact).sum(),
            (ends & (play.memory["followed"] > 0)).sum(),
            torch.where(live, (play.robot.xz - play.human.xz).square().sum(-1).sqrt(), 0.0).sum(),
        ]

    def figures(self, total: dict[str, float]) -> dict[str, float]:
        """Return columns of the learning curve that follow from the totals by name."""
        steps, ended = max(total["steps"], 1.0), max(total["ended"], 1.0)
        return {
            "reward": total["reward"] / steps,
            "distance_m": total["distance"] / steps,
            "follows": total["follows"] / steps,
            "collided": total["collided"] / ended,
            "met": total["met"] / ended,
            "contact": total["contact"] / steps,
            "steps_per_episode": steps / ended,
        }

    def taught(self) -> Tensor:
        """Return None, because social navigation has no teacher."""
        raise InputError("There is no teacher of social navigation. Hint: teacher=0.", code="H3-TRAIN-078")
