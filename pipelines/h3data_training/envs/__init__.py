"""Environments whose worlds are tensors on a torch device, which `h3data.make(task, device=...)` returns.

The functions are entry points of `h3data.device_envs` with the name of a task; ``any`` is used for tasks without an
entry point.
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
    from h3data_training.envs.crowd_torch_env import CrowdTorchEnv
    from h3data_training.envs.rearrange_torch_env import RearrangeTorchEnv
    from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv
    from h3data_training.envs.task_torch_env import TaskTorchEnv


def make_social_nav(
    worlds: int, scenes: Scenes, *, device: Any, agents: Sequence[str], **options: Any
) -> SocialNavTorchEnv:
    """Make the environment of social navigation of the robot; ``options`` are those of `SocialNavTorchEnv`.

    Raises:
        InputError: an agent other than the robot is to act, or an option is invalid.
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
        InputError: an option is invalid.
    """
    from h3data_training.envs.rearrange_torch_env import RearrangeTorchEnv
    from h3data_training.envs.torch_env import enough_memory

    with enough_memory(device, worlds, (task or Rearrange).name):
        return RearrangeTorchEnv(worlds, scenes, device=device, agents=agents, task=task, **options)


def make_any(
    worlds: int, scenes: Scenes, *, task: Task, device: Any, agents: Sequence[str], **options: Any
) -> TaskTorchEnv | RearrangeTorchEnv | CrowdTorchEnv:
    """Make the environment of a task of one robot and one person, or of one robot and the people of a crowd.

    ``options`` are those of `TaskTorchEnv`, for crowds of `CrowdTorchEnv`, and for tasks with objects of `RearrangeTorchEnv`.

    Raises:
        InputError: the task has another roster, its functions do not support tensors, or an option is invalid.
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
    from h3data_training.envs.crowd_torch_env import MODELS, CrowdTorchEnv
    from h3data_training.envs.task_torch_env import TaskTorchEnv
    from h3data_training.envs.torch_env import enough_memory

    script = options.pop("partner", None) or task.defaults["human"]
    if script in MODELS:
        with enough_memory(device, worlds, task.name):
            return CrowdTorchEnv(task, worlds, scenes, model=MODELS[MODELS.index(script)], device=device, **options)
    if script != "waypoints":
        raise InputError(
            f"On a torch device people of {task.name} walk by 'waypoints' or, without reactions, groups and routines, by "
            f"{' or '.join(map(repr, MODELS))}; not {script!r}. Hint: partner='{MODELS[0]}'.",
            code="H3-ENV-036",
        )
    with enough_memory(device, worlds, task.name):
        return TaskTorchEnv(task, worlds, scenes, device=device, **options)


def _require_robot(task: str, agents: Sequence[str]) -> None:
    if tuple(agents) != ("robot",):
        raise InputError(
            f"On a torch device only the robot acts in {task}. Hint: leave out agents or device.", code="H3-ENV-001"
        )
