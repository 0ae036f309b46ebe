"""`h3data.make`: any task as a training environment."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

from h3data.errors import InputError, suggest
from h3data.plugins import Registry
from sim_kinematic.envs.recipe import EnvRecipe
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.sources import Scenes
from sim_kinematic.tasks.task import Task

DEVICE_ENVS: Registry[Callable[..., Any]] = Registry("h3data.device_envs", {}, what="task on a torch device")
"""By name of the task, what makes W worlds of it on a torch device: ``(worlds, scenes, *, device, agents, **options)``."""


def make(
    task: str | Task,
    scenes: Scenes = "h3-homes/train",
    *,
    num_envs: int | None = None,
    device: Any = None,
    agents: Sequence[str] = ("robot",),
    render_mode: str | None = None,
    flatten: bool = False,
    **options: Any,
) -> Any:
    """A training environment of a task.

    Args:
        task: By name, ``module:Class``, or a `Task`.
        scenes: Where to play (`sim_kinematic.tasks.sources.EpisodeSource`).
        num_envs: W worlds as a Gymnasium vector environment; None is one world as a Gymnasium environment.
        device: A torch device: worlds as tensors (social navigation and rearrangement).
        agents: Agents that act; several make a PettingZoo environment, which has one world.
        render_mode: ``rgb_array`` for ``render()``.
        flatten: Observations are one vector instead of a dictionary of arrays.
        **options: Those of the task's stepper (`sim_kinematic.envs.world_stepper.WorldStepper`,
            `sim_kinematic.envs.skill_stepper.SkillStepper`) and `sim_kinematic.envs.stepper.Options`.

    Raises:
        InputError: no such task, scenes, agents or option, or both ``num_envs`` and several agents are wanted.
        MissingExtraError: Gymnasium or PettingZoo are not installed.
    """
    given = {"num_envs": num_envs, "device": device, "agents": agents, "render_mode": render_mode, **options}
    if flatten:
        given["flatten"] = True
    env = _make(task, scenes, num_envs, device, agents, render_mode, flatten, dict(options))
    if device is None:
        env.recipe = EnvRecipe(task, scenes, {name: value for name, value in given.items() if value is not None})
        if hasattr(env, "spec"):
            env.spec = env.recipe.gymnasium_spec()
    return env


def _make(
    task: str | Task,
    scenes: Scenes,
    num_envs: int | None,
    device: Any,
    agents: Sequence[str],
    render_mode: str | None,
    flatten: bool,
    options: dict[str, Any],
) -> Any:
    found = find_task(task) if isinstance(task, str) else task
    if device is not None:
        if flatten:
            raise InputError(
                "Observations on a torch device are tensors by name. Hint: leave out flatten or device.",
                code="H3-ENV-019",
            )
        return _on_device(found, scenes, num_envs, device, agents, options)
    from sim_kinematic.envs.stepper import FlatStepper, ManySteppers, Options

    if isinstance(agents, str):
        agents = (agents,)
    if len(agents) > 1 and num_envs is not None:
        raise InputError("An environment of two agents has one world. Hint: leave out num_envs.", code="H3-ENV-018")
    stepper_class = _stepper_class(found)
    if "agent" in options:
        agents = (options.pop("agent"),)
    shared = {f.name: options.pop(f.name) for f in fields(Options) if f.name in options}
    _require_known(found, stepper_class, options, [f.name for f in fields(Options)])
    given = {**options, "agents": tuple(agents), "options": Options(**shared)}
    given = {**found.env_defaults, **given}
    if num_envs is not None:
        from sim_kinematic.envs.vector import TaskVectorEnv

        many: Any
        if found.batched:
            many = stepper_class(found, scenes, worlds=num_envs, **given)
        else:
            many = ManySteppers(lambda: stepper_class(found, scenes, **given), num_envs)
        many = FlatStepper(many) if flatten else many
        return TaskVectorEnv(many, render_mode=render_mode)
    stepper: Any = stepper_class(found, scenes, **given)
    stepper = FlatStepper(stepper) if flatten else stepper
    if len(agents) > 1:
        from sim_kinematic.envs.parallel import TaskParallelEnv

        return TaskParallelEnv(stepper, name=found.name, render_mode=render_mode)
    from sim_kinematic.envs.single import TaskEnv

    return TaskEnv(stepper, render_mode=render_mode)


def _stepper_class(task: Task) -> Any:
    if task.batched:
        from sim_kinematic.envs.world_stepper import WorldStepper

        return WorldStepper
    from sim_kinematic.envs.skill_stepper import SkillStepper

    return SkillStepper


def _require_known(task: Task, stepper: Any, options: dict[str, Any], shared: Sequence[str]) -> None:
    """Refuses options that nobody takes."""
    parameters = inspect.signature(stepper.__init__).parameters.values()
    known = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in ("worlds", "options")]
    known += [*shared, *task.env_options, "num_envs", "device", "render_mode", "flatten"]
    for name in options:
        if name not in known:
            raise InputError(
                f"Unknown option {name!r} of {task.name}.{suggest(name, known, lead='Expected some of')}",
                code="H3-ENV-020",
            )


def _on_device(
    task: Task, scenes: Scenes, num_envs: int | None, device: Any, agents: Sequence[str], options: dict[str, Any]
) -> Any:
    make = DEVICE_ENVS.get(task.name)
    return make(1 if num_envs is None else num_envs, scenes, device=device, agents=agents, **options)
