"""Training environment on a device for a task of one robot among the people of a crowd, with tensors in and out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from h3data.errors import InputError, suggest
from h3data_training.envs.task_torch_env import TaskTorchEnv
from h3data_training.torch.crowd.bank import CrowdBank
from h3data_training.torch.crowd.worlds import CrowdWorlds
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.crowd.crowd import CrowdModel
from sim_kinematic.sensing.table import STATE_OBSERVATIONS, Sensor, sensors_of
from sim_kinematic.tasks.sources import Scenes, in_words
from sim_kinematic.tasks.task import Task

MODELS: tuple[CrowdModel, ...] = ("orca", "social_force")
"""Models that people of crowds follow on a device."""
OPTIONS = ("spec", "episodes", "episodes_seed", "robot", "human", "dtype", "graph", "end_on_success")
"""Options of `TaskTorchEnv` that worlds with crowds have too."""


class CrowdTorchEnv(TaskTorchEnv):
    """W worlds of a task with a crowd of P people each on one device (h3data docs crowds)."""

    sim: CrowdWorlds
    model: CrowdModel
    pictured = ()

    def __init__(
        self,
        task: Task,
        num_envs: int = 1,
        scenes: Scenes = "h3-homes/train",
        *,
        model: CrowdModel = "orca",
        roster: str | Sequence[str] | None = None,
        observations: Sequence[str] | None = None,
        compile: bool = False,
        **options: Any,
    ) -> None:
        """Sample the episodes, or take a bank of them, and copy it to the device.

        Args:
            task: as of `TaskTorchEnv`.
            num_envs: number of worlds W.
            scenes: homes, as of `TaskTorchEnv`.
            model: how people choose, ``orca`` or ``social_force``.
            roster: one robot and any number of people (default: the task's).
            observations: names of sensors, no pictures (default: the state of the robot and, if there are people, of the
                first one).
            compile: whether the operations are fused; a step with people has some thousands, so this takes minutes.
            **options: ``device`` and `OPTIONS`, as of `TaskTorchEnv`.

        Raises:
            InputError: an argument or option is not supported on devices, or there is no such device.
        """
        known = ("device", "roster", "observations", "compile", *OPTIONS)
        for name in options:
            if name not in known:
                raise InputError(
                    f"On a device, {task.name} has no option {name!r}.{suggest(name, known, lead='Expected some of')}",
                    code="H3-ENV-060",
                )
        bank, self.model = options.get("episodes"), model
        bodies = {name: options[name] for name in ("robot", "human") if name in options}
        self._roster = task.agents if roster is None else roster
        self._agents = bank.roster if isinstance(bank, CrowdBank) else make_roster(self._roster, **bodies)
        if observations is None:
            observations = [name for name in STATE_OBSERVATIONS if name in self._sensors(task)]
        super().__init__(task, num_envs, scenes, observations=observations, compile=compile, **options)

    def _sensors(self, task: Task) -> Mapping[str, Sensor]:  # type: ignore[override]
        alone = len(self._agents) == 1
        return {
            name: sensor
            for name, sensor in sensors_of("robot", task.sensors).items()
            if not (alone and sensor.of_other)
        }

    def _drawn(self, scenes: Scenes, episodes: Any, **options: Any) -> Any:
        if isinstance(episodes, CrowdBank):
            return episodes
        return CrowdBank.draw(scenes, episodes, agents=self._roster, **options)

    def _make_worlds(self, **options: Any) -> CrowdWorlds:
        worlds = CrowdWorlds(self.bank, model=self.model, task=self.task, **options)
        worlds.check_functions(self._names)
        return worlds

    def __repr__(self) -> str:
        models = [member.model for member in self._agents]
        people = {"people": f"{len(models) - 1} x {models[1]} by {self.model}"} if models[1:] else None
        what = in_words(
            self.task.name,
            self.bank.scenes,
            len(self.bank.scenes),
            {"robot": models[0]},
            beside=people,
            worlds=self.num_envs,
        )
        return f"{type(self).__name__}({what}, {len(self.bank)} episodes, {self.device}, {self.sim.dtype})"
