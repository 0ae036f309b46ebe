"""Shortcuts: open a recording or scene, measure, render one frame, make a training environment."""

from __future__ import annotations

import glob
import importlib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, TypeVar, Unpack, overload

from numpy.typing import NDArray

from h3data.bodies.people.rigid_parts import PeopleStyle
from h3data.errors import InputError
from h3data.recording import Dataset, Episodes, Recording, open_recording
from h3data.render import Output
from h3data.render.light.sources import LightMode
from h3data.replay import CameraTrack, Replay, camera_at

if TYPE_CHECKING:
    import gymnasium
    import gymnasium.vector

    from h3data.metrics import EpisodeMetrics, MetricsTable

T = TypeVar("T")
_GLOB = re.compile(r"[*?\[]")


@overload
def open(path: str | os.PathLike[str], kind: type[T]) -> T: ...
@overload
def open(path: str | os.PathLike[str]) -> Any: ...
def open(path: str | os.PathLike[str], kind: type[Any] | None = None) -> Any:
    """Opens recordings, datasets and scenes, by whatever name the command line knows them.

    ====================================================  ==========================================
    ``episode.mcap``, ``ds#3``                             `Recording`
    ``ds/``, ``s3://bucket/ds``                            `Dataset`
    ``recordings/*.mcap``, ``runs/*/``, a folder of logs   `Episodes`, read when they are asked for
    ``small:3``, ``h3-homes/test#3``                       `Scene`
    a GLB or a scene of Habitat                            `Scene`
    ``*.scene_dataset_config.json``                        `SceneDataset`; followed by ``#name``, a `Scene`
    ====================================================  ==========================================

    Options of scenes in files: `h3data.scene.sources.SceneFile`.

    Args:
        path: Path, URI or name.
        kind: What is expected, such as ``Recording``: anything else is refused, and type checkers know the result.

    Raises:
        InputError: there is nothing of that name, or it is not of that ``kind``.
        FormatError: a file is something else; the message says what it is and what to do with it.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"Expected a path, URI or name, got {path!r:.60}.")
    opened = _open(os.fspath(path))
    if kind is not None and not isinstance(opened, kind):
        raise InputError(f"Expected a {kind.__name__}, this is a {type(opened).__name__}: {path}")
    return opened


def _open(path: str) -> Any:
    from h3data.recording.parquet.files import is_dataset
    from h3data.scene.open import is_builtin_name, named_scenes, open_scene, open_scene_path

    if is_builtin_name(path):
        first, *more = named_scenes(path)
        if more:
            raise InputError(f"{path} names several scenes. Expected one, such as {first.name}.")
        return open_scene(first.source)
    scene = open_scene_path(path)
    if scene is not None:
        return scene
    place = Path(path)
    if _GLOB.search(path) and "://" not in path and not place.exists():
        return _below(sorted(glob.glob(path, recursive=True)), path)
    if place.is_dir() and not is_dataset(place):
        return _below([path], path)
    return open_recording(path)


def _below(paths: list[str], named: str) -> Episodes:
    """Every episode below some paths."""
    from h3data.recording.finding import find_episodes

    if not paths:
        raise InputError(f"No file has such a name. Expected recordings or datasets: {named}")
    return Episodes(find_episodes(paths))


@overload
def measure(recordings: Recording, profile: str | None = None) -> EpisodeMetrics: ...
@overload
def measure(
    recordings: Dataset | Iterable[Recording] | str | os.PathLike[str], profile: str | None = None
) -> MetricsTable: ...
def measure(recordings: Any, profile: str | None = None) -> EpisodeMetrics | MetricsTable:
    """Computes task metrics: the values of one recording, or the table of many with means and 95% intervals.

    Args:
        recordings: A recording; or a dataset, episodes, or the path of a log, a dataset, or a folder of these.
        profile: Name of a profile, such as ``field`` (default: that of the recordings' task).

    Raises:
        InputError: no such profile, or the recordings are of tasks with different metrics.
        UnmeasurableError: the recording, or all of them, lack what every metric needs.
    """
    from h3data import metrics

    if isinstance(recordings, Recording):
        return metrics.measure(recordings, profile)
    if isinstance(recordings, Dataset):
        return metrics.measure_files([recordings.root], profile)
    if isinstance(recordings, str | os.PathLike):
        return metrics.measure_files([recordings], profile)
    if not isinstance(recordings, Iterable):
        raise InputError(f"Expected recordings, a dataset or a path, got {recordings!r:.60}.")
    return metrics.measure_many(recordings, profile)


def render_frame(
    recording: Recording | Replay,
    *,
    camera: str = "third_person",
    step: int = 0,
    outputs: Sequence[Output] = ("rgb",),
    assets: Sequence[str | Path] = (),
    people: PeopleStyle = "skin",
    light: LightMode = "baked",
    stand_ins: bool = False,
) -> dict[str, NDArray[Any]]:
    """One picture: ``rgb`` uint8 [H, W, 3], ``depth`` float32 [H, W] [m], ``instance`` int32 [H, W], ...

    For many pictures make a `Replay` once and pass it, or use its `Replay.frames`; it has ``assets``, ``people``,
    ``light`` and ``stand_ins`` of its own.
    """
    if isinstance(recording, Replay):
        replay = recording
    else:
        shown_in: LightMode = light if "rgb" in outputs else "flat"
        replay = Replay(recording, assets=assets, people=people, light=shown_in, stand_ins=stand_ins)
    row = replay.row(step)
    seen_from = camera_at(replay, camera, row)
    track = CameraTrack(camera=seen_from, poses=seen_from.pose[None])
    return next(iter(replay.frames([track], [row], outputs=outputs)))[1][0]


class MakeOptions(TypedDict, total=False):
    """Options of `make` beyond task, scenes, number of worlds, device and agents."""

    render_mode: str | None
    flatten: bool | None
    observations: Sequence[str] | None
    reward: str | None
    partner: Any
    level: Literal["high", "low"] | None
    spec: Any
    roster: str | Sequence[str] | None
    robot: str | None
    human: str | None
    depth_size: tuple[int, int] | None
    rgb_size: tuple[int, int] | None
    light: LightMode | None
    noise: Mapping[str, Any] | None
    end_on_success: bool | None
    interrupts_when_close: bool | None
    threads: int | None
    dtype: Any
    episodes: Any
    episodes_seed: int | None
    graph: bool | None
    compile: bool | None


@overload
def make(
    task: Any,
    scenes: Any = ...,
    *,
    num_envs: None = None,
    device: None = None,
    agents: tuple[str] = ...,
    **options: Unpack[MakeOptions],
) -> gymnasium.Env[Any, Any]: ...
@overload
def make(
    task: Any,
    scenes: Any = ...,
    *,
    num_envs: int,
    device: None = None,
    agents: tuple[str] = ...,
    **options: Unpack[MakeOptions],
) -> gymnasium.vector.VectorEnv[Any, Any, Any]: ...
@overload
def make(
    task: Any,
    scenes: Any = ...,
    *,
    num_envs: int | None = None,
    device: Any = None,
    agents: Sequence[str] = ...,
    **options: Unpack[MakeOptions],
) -> Any: ...
def make(
    task: Any,
    scenes: Any = "h3-homes/train",
    *,
    num_envs: int | None = None,
    device: Any = None,
    agents: Sequence[str] | None = None,
    render_mode: str | None = None,
    flatten: bool | None = None,
    observations: Sequence[str] | None = None,
    reward: str | None = None,
    partner: Any = None,
    level: Literal["high", "low"] | None = None,
    spec: Any = None,
    roster: str | Sequence[str] | None = None,
    robot: str | None = None,
    human: str | None = None,
    depth_size: tuple[int, int] | None = None,
    rgb_size: tuple[int, int] | None = None,
    light: LightMode | None = None,
    noise: Mapping[str, Any] | None = None,
    end_on_success: bool | None = None,
    interrupts_when_close: bool | None = None,
    threads: int | None = None,
    dtype: Any = None,
    episodes: Any = None,
    episodes_seed: int | None = None,
    graph: bool | None = None,
    compile: bool | None = None,
    **task_options: Any,
) -> Any:
    """Makes a training environment of a task: ``make("social_nav")``, ``make("social_nav", num_envs=64)``.

    One world is a Gymnasium environment, ``num_envs`` worlds a vector environment, several ``agents`` a PettingZoo
    environment, a ``device`` worlds as torch tensors (h3data docs environments). None stands for the default of the task or
    the device. An option that the task or the device does not have is refused.

    Args:
        task: Name (``social_nav``, ``rearrange``, or of an installed package), ``module:Class``, or a task.
        scenes: Homes to play in: names such as ``small:3`` and ``h3-homes/train``, paths, scenes, or several of these.
        num_envs: Number of worlds; None is one world without a leading axis.
        device: Torch device of the worlds, such as ``cuda`` or ``cpu``; None simulates with NumPy.
        agents: Names of the agents that act (default: the robot).
        render_mode: ``rgb_array`` for ``render()``.
        flatten: Whether observations are one vector instead of a dictionary of arrays; not on a device.
        observations: Names of sensors and images; each agent gets those that it has.
        reward: Reward of social navigation: ``paper`` or ``habitat``.
        partner: Policy of the agents that do not act.
        level: Actions of rearrangement: ``high`` chooses skills, ``low`` base velocity, arm joints and grip.
        spec: Rules of the task.
        roster: Agents that are present.
        robot: Body of robots.
        human: Body of people.
        depth_size: Width and height of depth, masks and boxes [pixels] (default: each camera's own).
        rgb_size: Width and height of colour images [pixels].
        light: Light in colour images: ``baked`` or ``flat``.
        noise: Noise model by name of an observation (default: all are exact).
        end_on_success: Whether success terminates an episode even where the task goes on.
        interrupts_when_close: Whether agents of rearrangement may choose anew at every step while the other is close.
        threads: Threads that render images.
        dtype: Floating type of the state on a device (default: float64 on the CPU, float32 on others).
        episodes: Number of episodes that worlds on a device draw from, or a bank of them.
        episodes_seed: Seed of those episodes.
        graph: Whether a CUDA device replays each step as one graph.
        compile: Whether worlds on a device are compiled by torch.
        **task_options: Options of a task of your own. Type checkers accept them as ``**{"name": value}``.

    Raises:
        InputError: no such task, scenes or option.
        MissingExtraError: Gymnasium or PettingZoo are not installed.
    """
    options: dict[str, Any] = {
        "num_envs": num_envs, "device": device, "agents": agents, "render_mode": render_mode,
        "flatten": flatten, "observations": observations, "reward": reward, "partner": partner, "level": level, "spec": spec,
        "roster": roster, "robot": robot, "human": human, "depth_size": depth_size, "rgb_size": rgb_size,
        "light": light, "noise": noise, "end_on_success": end_on_success,
        "interrupts_when_close": interrupts_when_close, "threads": threads, "dtype": dtype, "episodes": episodes,
        "episodes_seed": episodes_seed, "graph": graph, "compile": compile,
    }  # fmt: skip
    given = {name: value for name, value in options.items() if value is not None}
    return _simulator("envs.make").make(task, scenes, **given, **task_options)


def _simulator(module: str) -> Any:
    """A module of the simulator, which h3data itself does not import: it lies above."""
    return importlib.import_module(f"sim_kinematic.{module}")
