"""The short way in from Python: open a recording, draw one picture of it."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from h3data.errors import FormatError, InputError, did_you_mean
from h3data.recording import Dataset, Recording, open_recording
from h3data.render import Output
from h3data.replay import CameraTrack, Replay, camera_at

if TYPE_CHECKING:
    from h3data.habitat.scenes.scene_dataset import SceneDataset
    from h3data.scene import Scene

_INSTEAD = {
    "navmesh": "a Habitat navmesh. Hint: read it with h3data.habitat.navmesh.file.read_navmesh",
    "rearrange_episodes": "a Habitat episode file. Hint: read it with h3data.habitat.episodes.episode_files.read_episodes",
    "lighting_config": "a lighting configuration of a Habitat dataset. Hint: open a scene that names it",
    "semantic_config": "a semantic configuration of a Habitat dataset. Hint: open a scene that names it",
    "scene_filter": "a receptacle filter of a Habitat scene. Hint: open the scene that names it",
}
"""What to do with files that hold neither a recording nor a scene."""


def open(path: str | os.PathLike[str]) -> Any:
    """The `Recording` in an MCAP file, the `Dataset` in a folder, or the `Scene` in a file of ours (GLB) or of Habitat.

    ``*.scene_dataset_config.json`` gives a list of its scenes (`SceneDataset`), ``path#name`` one of them; for the other
    files of Habitat, and options, see `h3data.interop.load_habitat_scene`.

    Raises:
        FormatError: it is none of these; the message says what it looks like and what to do.
    """
    from h3data.habitat.scenes.scene_instance import HABITAT_ENDINGS, dataset_and_scene

    dataset, name = dataset_and_scene(path)
    if dataset is not None or os.fspath(path).lower().endswith(HABITAT_ENDINGS):
        return _open_scene(Path(path) if dataset is None else dataset, name)
    try:
        opened: Recording | Dataset = open_recording(Path(path))
    except FormatError as fault:
        from h3data.sniff import sniff

        instead = _INSTEAD.get(sniff(Path(path))) if os.path.isfile(path) else None
        if instead is None:
            raise
        raise FormatError(f"This is {instead}: {os.fspath(path)}") from fault
    return opened


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


def make(task: str, **options: Any) -> Any:
    """A training environment of a task: ``make("social_nav")``, ``make("social_nav", num_envs=64)`` (docs/environments.md).

    Tasks are the entry points of the group ``h3data.tasks``, so installed packages may bring their own; ``options`` go to
    the task.

    Raises:
        InputError: no such task is installed.
        MissingExtraError: Gymnasium or PettingZoo are not installed.
    """
    tasks = {entry.name: entry for entry in importlib.metadata.entry_points(group="h3data.tasks")}
    if task not in tasks:
        there = ", ".join(sorted(tasks)) or "(none is installed)"
        raise InputError(f"Unknown task {task!r}.{did_you_mean(task, tasks)} Expected one of: {there}.")
    return tasks[task].load()(**options)
