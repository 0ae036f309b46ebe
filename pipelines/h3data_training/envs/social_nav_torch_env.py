"""Training environment of social navigation on a device."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from h3data.errors import InputError
from h3data_training.envs.task_torch_env import PICTURED, TaskTorchEnv
from h3data_training.envs.torch_env import Tensors
from h3data_training.torch.social_nav import ON_DEVICES, SocialNavTensors
from sim_kinematic.sensing.table import TABLE, Sensor
from sim_kinematic.tasks.social_nav import SocialNav
from sim_kinematic.tasks.sources import Scenes
from sim_kinematic.tasks.task import Task

OBSERVATIONS = (*PICTURED, *ON_DEVICES)
"""Names of the observations that a device can compute, as in `sim_kinematic.sensing.table`."""


class SocialNavTorchEnv(TaskTorchEnv):
    """W worlds of social navigation on one device (h3data docs gpu)."""

    sim: SocialNavTensors

    def __init__(
        self, num_envs: int = 1, scenes: Scenes = "h3-homes/train", *, reward: str = "paper", **options: Any
    ) -> None:
        """Create the environment with the options of `TaskTorchEnv` and by default the paper's training rules.

        Raises:
            InputError: the rules have a different reward than the paper's, or an option is invalid.
        """
        if reward != "paper":
            raise InputError(
                f"On a device the reward is the paper's, not {reward!r}. Hint: leave out device.", code="H3-ENV-009"
            )
        super().__init__(SocialNav(), num_envs, scenes, **options)

    @staticmethod
    def _sensors(task: Task) -> Mapping[str, Sensor]:
        return {name: TABLE[name] for name in ON_DEVICES}

    def _make_worlds(self, **options: Any) -> SocialNavTensors:
        return SocialNavTensors(self.bank, **options)

    def info(self) -> Tensors:
        """Return data in addition to the observations, [W] each; ``episode`` is a number in the bank."""
        memory = self.play.memory
        known = {name: memory[name].clone() for name in ("found", "followed")}
        return super().info() | known | {"geodesic_m": memory["geodesic"].clone()}
