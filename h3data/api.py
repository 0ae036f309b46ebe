"""Shortcuts: open a recording or scene, measure, render one frame."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, overload

from numpy.typing import NDArray

from h3data.bodies.people.rigid_parts import PeopleStyle
from h3data.errors import InputError, suggest_keywords
from h3data.recording import Dataset, Episodes, Recording, open_recording
from h3data.render import Output
from h3data.render.light.sources import LightMode
from h3data.replay import CameraTrack, Replay, camera_at

if TYPE_CHECKING:
    from h3data.metrics import EpisodeMetrics, MetricsTable
    from h3data.scene import Scene

T = TypeVar("T")


@overload
def open(path: str | os.PathLike[str], kind: type[T]) -> T: ...
@overload
def open(path: str | os.PathLike[str]) -> Any: ...
def open(path: str | os.PathLike[str], kind: type[Any] | None = None) -> Any:
    """Open recordings, datasets and scenes, by the names that the command line accepts.

    ====================================================  ==========================================
    ``episode.mcap``, ``ds#3``                             `Recording`
    ``ds/``, ``s3://bucket/ds``                            `Dataset`
    ``recordings/*.mcap``, ``runs/*/``, a folder of logs   `Episodes`, each read at first access
    ``small:3``, ``h3-homes/test#3``                       `Scene`
    a GLB or a scene of Habitat                            `Scene`
    ``*.scene_dataset_config.json``                        `SceneDataset`; followed by ``#name``, a `Scene`
    ====================================================  ==========================================

    `h3data.scene.sources.SceneFile` describes the options of scenes in files.

    Args:
        path: Path, URI or name.
        kind: Expected type, such as ``Recording``. Other objects are refused, and type checkers infer the type of the
            result.

    Raises:
        InputError: nothing has that name, or the object is not of that ``kind``.
        FormatError: a file has another format; the message names the format and suggests how to open it.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"Expected a path, URI or name, got {path!r:.60}.", code="H3-FILE-001")
    opened = _open(os.fspath(path))
    if kind is not None and not isinstance(opened, kind):
        raise InputError(f"Expected a {kind.__name__}, this is a {type(opened).__name__}: {path}", code="H3-FILE-002")
    return opened


def load_recording(path: str | os.PathLike[str]) -> Recording:
    """Open one episode.

    Args:
        path: Path or URI, such as ``episode.mcap``, ``ds#3`` or ``s3://bucket/ds#3``. `open` lists the errors.
    """
    return open(path, Recording)


def load_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Open a dataset.

    Args:
        path: Folder or URI, such as ``s3://bucket/ds``. `open` lists the errors.
    """
    return open(path, Dataset)


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Open a home or scene.

    Args:
        path: Name or path: ``small:3``, ``h3-homes/test#3``, a GLB file or a Habitat scene. `open` lists the errors.
    """
    from h3data.scene import Scene

    return open(path, Scene)


def _open(path: str) -> Any:
    from h3data.recording.finding import find_episodes
    from h3data.recording.parquet.files import is_dataset
    from h3data.scene.open import is_builtin_name, named_scenes, open_scene, open_scene_path

    # names first, then scene files by their endings; whatever is left is a recording, whose reader says what it expected
    if is_builtin_name(path):
        first, *more = named_scenes(path)
        if more:
            raise InputError(f"{path} names several scenes. Expected one, such as {first.name}.", code="H3-FILE-005")
        return open_scene(first.source)
    scene = open_scene_path(path)
    if scene is not None:
        return scene
    place = Path(path)
    # a shell that finds nothing passes the pattern on; a file may have such signs in its name, and an URI its query
    if re.search(r"[*?\[]", path) and "://" not in path and not place.exists():
        found = sorted(glob.glob(path, recursive=True))
    elif place.is_dir() and not is_dataset(place):
        found = [path]
    else:
        return open_recording(path)
    if not found:
        raise InputError(f"No file has such a name. Expected recordings or datasets: {path}", code="H3-FILE-003")
    return Episodes(find_episodes(found))


@overload
def measure(recordings: Recording, profile: str | None = None) -> EpisodeMetrics: ...
@overload
def measure(
    recordings: Dataset | Iterable[Recording] | str | os.PathLike[str], profile: str | None = None
) -> MetricsTable: ...
def measure(recordings: Any, profile: str | None = None) -> EpisodeMetrics | MetricsTable:
    """Compute task metrics: the values of one recording, or the table of many with means and 95% intervals.

    Args:
        recordings: A recording; or a dataset, episodes, or the path of a log, a dataset, or a folder of these.
        profile: Name of a profile, such as ``field`` (default: that of the recordings' task).

    Raises:
        InputError: there is no such profile, or the recordings are of tasks with different metrics.
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
        raise InputError(f"Expected recordings, a dataset or a path, got {recordings!r:.60}.", code="H3-FILE-004")
    return metrics.measure_many(recordings, profile)


@suggest_keywords
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
    """Return the images of one camera: ``rgb`` uint8 [H, W, 3], ``depth`` float32 [H, W] [m], ``instance`` int32 [H, W].

    To render many images, create a `Replay` once and pass it, or call `Replay.frames`. A replay has its own settings
    for ``assets``, ``people``, ``light`` and ``stand_ins``.

    Args:
        recording: Recording, or a replay of one.
        camera: Name of a camera, or a .toml or .json file with one.
        step: Index of the step to render.
        outputs: Images to render.
        assets: Folders to search for recorded asset files.
        people: Appearance of people: skin, collision capsules, or bones.
        light: ``baked``, from windows, sun and lamps; or ``flat``, the same everywhere.
        stand_ins: True if built-in robots and people and plain boxes take the place of assets that are not found.
    """
    if isinstance(recording, Replay):
        replay = recording
    else:
        # baking takes time, and neither depth nor ids show light
        shown_in: LightMode = light if "rgb" in outputs else "flat"
        replay = Replay(recording, assets=assets, people=people, light=shown_in, stand_ins=stand_ins)
    row = replay.row(step)
    seen_from = camera_at(replay, camera, row)
    # the camera of one step as one that stands still
    track = CameraTrack(camera=seen_from, poses=seen_from.pose[None])
    return next(iter(replay.frames([track], [row], outputs=outputs)))[1][0]
