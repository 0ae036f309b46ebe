"""Shortcuts: open a recording or scene, render one frame, make a training environment."""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from h3data.recording import Recording, open_recording
from h3data.render import Output
from h3data.replay import CameraTrack, Replay, camera_at

if TYPE_CHECKING:
    from h3data.habitat.scenes.scene_dataset import SceneDataset
    from h3data.scene import Scene


def open(path: str | os.PathLike[str]) -> Any:
    """Opens the `Recording` in an MCAP file, the `Dataset` in a folder, or the `Scene` in a GLB or Habitat file.

    A ``*.scene_dataset_config.json`` gives its list of scenes (`SceneDataset`), ``path#name`` one of them; the other files
    of Habitat, and options, are described in `h3data.habitat.scenes.scene_instance.load_habitat_scene`.

    Raises:
        FormatError: it is none of these; the message says what the file is and what to do with it.
    """
    from h3data.habitat.scenes.scene_instance import HABITAT_ENDINGS, dataset_and_scene

    dataset, name = dataset_and_scene(path)
    if dataset is not None or os.fspath(path).lower().endswith(HABITAT_ENDINGS):
        return _open_scene(Path(path) if dataset is None else dataset, name)
    return open_recording(Path(path))


def _open_scene(path: Path, name: str | None) -> Scene | SceneDataset:
    from h3data.habitat.scene_names import read_scene_file
    from h3data.habitat.scenes.scene_dataset import DATASET_ENDING, load_scene_dataset
    from h3data.scene.scene_sets import SceneFile

    if path.name.endswith(DATASET_ENDING) and name is None:
        return load_scene_dataset(path)
    return read_scene_file(SceneFile(path=str(path), scene=name or ""))


def render_frame(
    recording: Recording | Replay,
    *,
    camera: str = "third_person",
    step: int = 0,
    outputs: Sequence[Output] = ("rgb",),
    assets: Sequence[str | Path] = (),
) -> dict[str, NDArray[Any]]:
    """One picture: ``rgb`` uint8 [H, W, 3], ``depth`` float32 [H, W] [m], ``instance`` int32 [H, W], ...

    For many pictures make a `Replay` once and pass it, or use its `Replay.frames`.
    """
    replay = recording if isinstance(recording, Replay) else Replay(recording, assets=assets)
    row = replay.row(step)
    seen_from = camera_at(replay, camera, row)
    track = CameraTrack(camera=seen_from, poses=seen_from.pose[None])
    return next(iter(replay.frames([track], [row], outputs=outputs)))[1][0]


def make(task: Any, *args: Any, **options: Any) -> Any:
    """A training environment of a task: ``make("social_nav")``, ``make("social_nav", num_envs=64)`` (docs/environments.md).

    Arguments are those of `sim_kinematic.envs.make.make`; tasks of installed packages are found by entry points of the
    group ``h3data.tasks`` and by ``module:Class``.

    Raises:
        InputError: no such task, scenes or option.
        MissingExtraError: Gymnasium or PettingZoo are not installed.
    """
    return _simulator("envs.make").make(task, *args, **options)


def session(task: Any, *args: Any, **options: Any) -> Any:
    """An episode to be played one step at a time: `sim_kinematic.tasks.sessions.session`."""
    return _simulator("tasks.sessions").session(task, *args, **options)


def simulate(task: Any, *args: Any, **options: Any) -> Recording:
    """One episode played under policies: `sim_kinematic.tasks.sessions.simulate`."""
    return _simulator("tasks.sessions").simulate(task, *args, **options)


def _simulator(module: str) -> Any:
    """A module of the simulator, which h3data itself does not import: it lies above."""
    return importlib.import_module(f"sim_kinematic.{module}")
