"""Batched worlds of crowd navigation for training, and their episodes."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from h3data.errors import SceneError
from h3data_training.crowds.settings import CrowdSettings
from h3data_training.episodes import by_home, listed_scenes
from h3data_training.torch.crowd.bank import CrowdBank
from h3data_training.torch.crowd.worlds import CrowdWorlds
from h3data_training.torch.graph import can_fuse, fused, overwrite
from h3data_training.torch.step import refuse_stairs
from h3data_training.worlds import ActionRepeatGoal
from sim_kinematic.crowd.crowd import CrowdModel
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.tasks.registry import find_task


class ActionRepeatCrowd(ActionRepeatGoal):
    """`CrowdWorlds` in which an action is repeated for ``hold`` steps, as `h3data_training.ppo.Worlds`."""

    def __init__(
        self,
        settings: CrowdSettings,
        bank: CrowdBank,
        *,
        device: str,
        compile: bool | None = None,
        hold: int | None = None,
        count: int | None = None,
    ) -> None:
        """Create ``count`` worlds (default: the number in the settings), a share of those of several processes.

        A step has thousands of operations, so it is compiled only if ``compile`` is True.
        """
        super().__init__(hold or settings.hold, count or settings.worlds, device)
        self.limit = settings.limit
        task, model = find_task(settings.task), cast(CrowdModel, settings.model)
        self.sim = CrowdWorlds(bank, model=model, task=task, spec=task.Spec(), device=device, dtype=torch.float32)
        self._names = tuple(dict.fromkeys((*settings.observations, *settings.critic)))
        nothing = torch.full((self.num_envs,), -1, dtype=torch.int64, device=self.device)
        self.play = self.sim.before_the_first(nothing)
        self._action = torch.zeros(self.num_envs, self.sim.action_width, device=self.device)
        self._shown: dict[str, Tensor] = {}
        self._move = fused(self._moved) if compile and can_fuse() else self._moved

    def _eager(self) -> None:
        self._hold_action()
        shown = self.sim.observations(self._names, self.play)
        self._show(shown)

    def _step_held(self, k: int) -> None:
        self._move()

    def _moved(self) -> None:
        """Make a step of all worlds, in place."""
        overwrite(self.play.tensors(), self.sim.step(self.play, self._action).tensors())

    def _counted(self, before: None, live: Tensor, ends: Tensor) -> list[Tensor]:
        return self._results(self.play.memory["success"], live, ends)


def make_crowd_bank(settings: CrowdSettings, *, seed: int, workers: int | None = None) -> CrowdBank:
    """Return the episodes of a run, the same number in each home that has room for them.

    Call it before CUDA is initialised, since the processes are forked.

    Args:
        settings: homes, bodies and number of people.
        seed: seed that, with the number of their home, determines the episodes.
        workers: number of processes; None is one for each core, 1 uses this process.

    Raises:
        InputError: there are no such homes, or one has stairs.
        SceneError: no home has room for an episode.
    """
    names = [named.name for named in listed_scenes(settings.scenes)]
    tasks = [(settings, name, episode_seed(seed, k)) for k, name in enumerate(names)]
    banks = [bank for bank in by_home(_home_bank, tasks, workers=workers) if bank is not None]
    if not banks:
        raise SceneError(f"No home of {settings.scenes} has room for an episode.", code="H3-TRAIN-027")
    return CrowdBank.merged(banks)


def _home_bank(task: tuple[CrowdSettings, str, int]) -> CrowdBank | None:
    settings, name, seed = task
    crowd = find_task(settings.task)
    try:
        bank = CrowdBank.draw(
            name,
            settings.episodes_per_home,
            seed=seed,
            task=crowd,
            spec=crowd.Spec(),
            agents=("robot", *["human"] * settings.people),
            robot=settings.robot,
            human=settings.human,
        )
    except SceneError:  # the home may be too small
        return None
    refuse_stairs(bank.floors, home=name)
    for floor in bank.floors:
        _ = floor.lattice  # built at first use, and needed on the device
    return bank
