"""Function `h3data.make`, which makes a training environment of any task."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypedDict, Unpack, overload

from h3data.bodies import Robot, robot_name
from h3data.errors import InputError, suggest
from h3data.plugins import Registry
from h3data.render.light.sources import LightMode
from sim_kinematic.envs.recipe import EnvRecipe
from sim_kinematic.policies.assignment import PolicyChoice
from sim_kinematic.sensing.sensor import NoiseModel
from sim_kinematic.tasks.episode import with_options
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.sources import Scenes
from sim_kinematic.tasks.task import Task

if TYPE_CHECKING:
    import gymnasium.vector
    import pettingzoo
    import torch

    from h3data.commands.command import RuleSet
    from sim_kinematic.tasks.sessions import Spec


class Bank(Protocol):
    """Episodes as arrays, from which worlds on a device sample (`h3data_training.torch.episodes.EpisodeBank`)."""

    def __len__(self) -> int: ...


DEVICE_ENVS: Registry[Callable[..., Any]] = Registry("h3data.device_envs", {}, what="task on a torch device")
"""Functions that make W worlds of a task on a torch device, by the name of the task:
``(worlds, scenes, *, device, agents, **options)``. Tasks without an entry use ``any``, which also takes the ``task``.
"""


class MakeOptions(TypedDict, total=False):
    """Options of `make` other than task, scenes, number of worlds, device and agents."""

    render_mode: str | None
    autoreset_mode: str | None
    flatten: bool | None
    observations: Sequence[str] | None
    reward: str | None
    partner: PolicyChoice | None
    level: Literal["high", "low"] | None
    spec: Spec | None
    rules: RuleSet | None
    roster: str | Sequence[str | Robot] | None
    robot: str | Path | Robot | None
    human: str | None
    depth_size: tuple[int, int] | None
    rgb_size: tuple[int, int] | None
    light: LightMode | None
    noise: Mapping[str, NoiseModel] | None
    end_on_success: bool | None
    interrupts_when_close: bool | None
    threads: int | None
    dtype: torch.dtype | None
    episodes: int | Bank | None
    episodes_seed: int | None
    graph: bool | None
    compile: bool | None


@overload
def make(
    task: str | Task | type[Task],
    scenes: Scenes = ...,
    *,
    num_envs: None = None,
    device: None = None,
    agents: str | tuple[str] = ...,
    **options: Unpack[MakeOptions],
) -> gymnasium.Env[Any, Any]: ...
@overload
def make(
    task: str | Task | type[Task],
    scenes: Scenes = ...,
    *,
    num_envs: int,
    device: None = None,
    agents: str | tuple[str] = ...,
    **options: Unpack[MakeOptions],
) -> gymnasium.vector.VectorEnv[Any, Any, Any]: ...
@overload
def make(
    task: str | Task | type[Task],
    scenes: Scenes = ...,
    *,
    num_envs: int | None = None,
    device: str | torch.device | None = None,
    agents: Sequence[str] = ...,
    **options: Unpack[MakeOptions],
) -> Any: ...
def make(
    task: str | Task | type[Task],
    scenes: Scenes = "h3-homes/train",
    *,
    num_envs: int | None = None,
    device: str | torch.device | None = None,
    agents: str | Sequence[str] | None = None,
    render_mode: str | None = None,
    autoreset_mode: str | None = None,
    flatten: bool | None = None,
    observations: Sequence[str] | None = None,
    reward: str | None = None,
    partner: PolicyChoice | None = None,
    level: Literal["high", "low"] | None = None,
    spec: Spec | None = None,
    rules: RuleSet | None = None,
    roster: str | Sequence[str | Robot] | None = None,
    robot: str | Path | Robot | None = None,
    human: str | None = None,
    depth_size: tuple[int, int] | None = None,
    rgb_size: tuple[int, int] | None = None,
    light: LightMode | None = None,
    noise: Mapping[str, NoiseModel] | None = None,
    end_on_success: bool | None = None,
    interrupts_when_close: bool | None = None,
    threads: int | None = None,
    dtype: torch.dtype | None = None,
    episodes: int | Bank | None = None,
    episodes_seed: int | None = None,
    graph: bool | None = None,
    compile: bool | None = None,
    **task_options: object,
) -> gymnasium.Env[Any, Any] | gymnasium.vector.VectorEnv[Any, Any, Any] | pettingzoo.ParallelEnv[str, Any, Any]:
    """Make a training environment of a task: ``make("social_nav")``, ``make("social_nav", num_envs=64)``.

    One world makes a Gymnasium environment, ``num_envs`` worlds a vector environment, several ``agents`` a PettingZoo
    environment, and a ``device`` worlds as torch tensors (h3data docs environments). None stands for the default of the
    task or the device. An option that the task or the device does not have is refused.

    Args:
        task: Name (``social_nav``, ``rearrange``, or of an installed package), ``module:Class``, or a task.
        scenes: Homes to play in: names such as ``small:3`` and ``h3-homes/train``, paths, scenes, or several of these.
        num_envs: Number of worlds; None is one world without a leading axis.
        device: Torch device of the worlds, such as ``cuda`` or ``cpu``; None simulates with NumPy.
        agents: Names of the agents that act (default: the robot).
        render_mode: ``rgb_array`` for ``render()``.
        autoreset_mode: Start of the next episodes in ``num_envs`` worlds: ``NEXT_STEP`` (default), ``SAME_STEP`` or
            ``DISABLED``, as of Gymnasium; not on a device.
        flatten: True if observations are one vector instead of a dictionary of arrays; not on a device.
        observations: Names of sensors and images; each agent gets the ones that its kind has.
        reward: Reward of social navigation: ``paper`` or ``habitat``.
        partner: Policy of the agents that do not act.
        level: Actions of rearrangement: ``high`` chooses skills, ``low`` base velocity, arm joints and grip.
        spec: Rules of the task.
        rules: Name of a set of rules that changes them: ``natural`` or ``paper`` (h3data docs simulation).
        roster: Agents that are present.
        robot: Body of robots.
        human: Body of people.
        depth_size: Width and height of depth, masks and boxes [pixels] (default: each camera's own).
        rgb_size: Width and height of colour images [pixels].
        light: Light in colour images: ``baked`` or ``flat``.
        noise: Noise model by name of an observation (default: all are exact).
        end_on_success: True if success terminates an episode even if the task continues.
        interrupts_when_close: True if agents of rearrangement may choose again at every step while the other is near.
        threads: Threads that render images.
        dtype: Floating type of the state on a device (default: float64 on the CPU, float32 on others).
        episodes: Number of episodes that worlds on a device sample from, or a bank of them.
        episodes_seed: Seed of those episodes.
        graph: True if a CUDA device replays each step as one graph.
        compile: True if worlds on a device are compiled by torch.
        **task_options: Options of a custom task. Type checkers accept them as ``**{"name": value}``.

    Raises:
        InputError: The task, scenes or an option do not exist.
        MissingExtraError: Gymnasium or PettingZoo are not installed.
    """
    options: dict[str, Any] = {
        "num_envs": num_envs,
        "device": device,
        "agents": agents,
        "render_mode": render_mode,
        "autoreset_mode": autoreset_mode,
        "flatten": flatten,
        "observations": observations,
        "reward": reward,
        "partner": partner,
        "level": level,
        "spec": spec,
        "rules": rules,
        "roster": roster,
        "robot": robot,
        "human": human,
        "depth_size": depth_size,
        "rgb_size": rgb_size,
        "light": light,
        "noise": noise,
        "end_on_success": end_on_success,
        "interrupts_when_close": interrupts_when_close,
        "threads": threads,
        "dtype": dtype,
        "episodes": episodes,
        "episodes_seed": episodes_seed,
        "graph": graph,
        "compile": compile,
    }
    # bodies become names, so that an environment can be pickled and made again by its recipe
    if robot is not None:
        options["robot"] = robot_name(robot)
    # without None: an option that a task or device does not have is refused, whatever its value
    given = {name: value for name, value in {**options, **task_options}.items() if value is not None}
    return make_env(find_task(task) if isinstance(task, type) else task, scenes, **given)


def make_env(
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
    """Return a training environment of a task, with the options of its stepper or its device passed by name.

    Args:
        task: Name of a task, ``module:Class``, or a `Task`.
        scenes: Source of episodes (`sim_kinematic.tasks.sources.EpisodeSource`).
        num_envs: Number W of worlds of a vector environment; None makes one world as a Gymnasium environment.
        device: Torch device of the worlds, whose states are tensors; None simulates with NumPy.
        agents: Agents that act; several make a PettingZoo environment, which has one world.
        render_mode: ``rgb_array`` for ``render()``.
        flatten: True if observations are one vector instead of a dictionary of arrays.
        **options: Options of `sim_kinematic.envs.world_stepper.WorldStepper` and `sim_kinematic.envs.stepper.Options`.

    Raises:
        InputError: The task, scenes, agents or an option do not exist, or ``num_envs`` is combined with several agents.
        MissingExtraError: Gymnasium or PettingZoo are not installed.
    """
    given = {"num_envs": num_envs, "device": device, "agents": agents, "render_mode": render_mode, **options}
    if flatten:
        given["flatten"] = True
    env = _make(task, scenes, num_envs, device, agents, render_mode, flatten, dict(options))
    if device is None:
        env.recipe = EnvRecipe(task, scenes, {name: value for name, value in given.items() if value is not None})
        # environments of PettingZoo have no specification
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
    """Return the environment that `make_env` describes, without a recipe."""
    found = find_task(task)
    # rules change those that the environment would have without them, which may differ from the task's own
    if (rules := options.pop("rules", None)) is not None:
        usual = (device is not None and found.usage.device_rules) or found.usage.env_rules or found.Spec()
        options["spec"] = with_options(options.get("spec") or usual, rules=rules)
    if device is not None:
        if flatten:
            raise InputError(
                "Observations on a torch device are tensors by name. Hint: leave out flatten or device.",
                code="H3-ENV-019",
            )
        # made by the entry of the task, or the one for any task
        worlds, place = 1 if num_envs is None else num_envs, {"device": device, "agents": agents}
        if found.name in DEVICE_ENVS.names():
            return DEVICE_ENVS.get(found.name)(worlds, scenes, **place, **options)
        return DEVICE_ENVS.get("any")(worlds, scenes, task=found, **place, **options)
    # imported here because they need Gymnasium, which worlds on a device do without
    from sim_kinematic.envs.stepper import FlatStepper, Options
    from sim_kinematic.envs.world_stepper import WorldStepper

    if isinstance(agents, str):
        agents = (agents,)
    # one world has no autoreset: left among the options, the mode is refused there as unknown
    autoreset_mode = options.pop("autoreset_mode", None) if num_envs is not None else None
    if len(agents) > 1 and num_envs is not None:
        raise InputError("An environment of two agents has one world. Hint: leave out num_envs.", code="H3-ENV-018")
    if "agent" in options:
        agents = (options.pop("agent"),)
    shared = {f.name: options.pop(f.name) for f in fields(Options) if f.name in options}
    _require_known(found, WorldStepper, options, [f.name for f in fields(Options)])
    given = {**options, "agents": tuple(agents), "options": Options(**shared)}
    if found.usage.env_rules is not None:
        # rules that the caller gives win over those that the task has in environments
        given = {"spec": found.usage.env_rules, **given}
    if num_envs is not None:
        from sim_kinematic.envs.vector import TaskVectorEnv, checked_autoreset_mode

        mode = checked_autoreset_mode(autoreset_mode or "NEXT_STEP")

        many: Any = WorldStepper(found, scenes, worlds=num_envs, **given)
        many = FlatStepper(many) if flatten else many
        return TaskVectorEnv(many, render_mode=render_mode, autoreset_mode=mode)
    stepper: Any = WorldStepper(found, scenes, **given)
    stepper = FlatStepper(stepper) if flatten else stepper
    if len(agents) > 1:
        from sim_kinematic.envs.parallel import TaskParallelEnv

        return TaskParallelEnv(stepper, name=found.name, render_mode=render_mode)
    from sim_kinematic.envs.single import TaskEnv

    return TaskEnv(stepper, render_mode=render_mode)


def _require_known(task: Task, stepper: Any, options: dict[str, Any], shared: Sequence[str]) -> None:
    """Check that each option is one of the stepper, of all environments or of the task.

    Raises:
        InputError: There is no such option.
    """
    # the signature says which options there are, so that the two never differ
    parameters = inspect.signature(stepper.__init__).parameters.values()
    # `worlds` and `options` are filled in by `_make`, under other names for the caller
    known = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in ("worlds", "options")]
    known += [*shared, *task.usage.env_options, "rules", "num_envs", "device", "render_mode", "flatten"]
    for name in options:
        if name not in known:
            raise InputError(
                f"Unknown option {name!r} of {task.name}.{suggest(name, known, lead='Expected some of')}",
                code="H3-ENV-020",
            )
