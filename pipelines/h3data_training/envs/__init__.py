"""Environments whose worlds are tensors on a torch device: what `h3data.make(task, device=...)` returns.

The functions are entry points of `h3data.device_envs`, by the name of the task; ``any`` makes those of tasks that have none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from h3data.errors import InputError
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.social_nav import SocialNav
from sim_kinematic.tasks.sources import Scenes
from sim_kinematic.tasks.task import Task

if TYPE_CHECKING:
    from h3data_training.envs.rearrange_torch_env import RearrangeTorchEnv
    from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv
    from h3data_training.envs.task_torch_env import TaskTorchEnv


def make_social_nav(
    worlds: int, scenes: Scenes, *, device: Any, agents: Sequence[str], **options: Any
) -> SocialNavTorchEnv:
    """Make the environment of social navigation of the robot; ``options`` are those of `SocialNavTorchEnv`.

    Raises:
        InputError: others than the robot are asked to act, or an option is wrong.
    """
    _require_robot(SocialNav.name, agents)
    from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv
    from h3data_training.envs.torch_env import enough_memory

    with enough_memory(device, worlds, SocialNav.name):
        return SocialNavTorchEnv(worlds, scenes, device=device, **options)


def make_rearrange(
    worlds: int, scenes: Scenes, *, device: Any, agents: Sequence[str], task: Rearrange | None = None, **options: Any
) -> RearrangeTorchEnv:
    """Make the environment of rearrangement, or of a ``task`` derived from it, with oracle skills.

    ``options`` are those of `RearrangeTorchEnv`.

    Raises:
        InputError: an option is wrong.
    """
    from h3data_training.envs.rearrange_torch_env import RearrangeTorchEnv
    from h3data_training.envs.torch_env import enough_memory

    with enough_memory(device, worlds, (task or Rearrange).name):
        return RearrangeTorchEnv(worlds, scenes, device=device, agents=agents, task=task, **options)


def make_any(
    worlds: int, scenes: Scenes, *, task: Task, device: Any, agents: Sequence[str], **options: Any
) -> TaskTorchEnv | RearrangeTorchEnv:
    """Return a task of one robot and one person; ``options`` are those of `TaskTorchEnv` or, with objects, `RearrangeTorchEnv`.

    Raises:
        InputError: the task has another person, its functions are not for tensors, or an option is wrong.
    """
    if isinstance(task, Rearrange):
        return make_rearrange(worlds, scenes, task=task, device=device, agents=agents, **options)
    if task.control.has_skills:
        raise InputError(
            f"On a torch device, tasks with skills derive from h3data.tasks.Rearrange, and {task.name} does not. Hint: "
            "derive from it, or leave out device.",
            code="H3-ENV-035",
        )
    _require_robot(task.name, agents)
    script = options.pop("partner", None) or task.defaults["human"]
    if script != "waypoints":
        raise InputError(
            f"On a torch device the person of {task.name} walks by 'waypoints', not {script!r}. Hint: partner='waypoints'.",
            code="H3-ENV-036",
        )
    from h3data_training.envs.task_torch_env import TaskTorchEnv
    from h3data_training.envs.torch_env import enough_memory

    with enough_memory(device, worlds, task.name):
        return TaskTorchEnv(task, worlds, scenes, device=device, **options)


def _require_robot(task: str, agents: Sequence[str]) -> None:
    if tuple(agents) != ("robot",):
        raise InputError(
            f"On a torch device only the robot acts in {task}. Hint: leave out agents or device.", code="H3-ENV-001"
        )
