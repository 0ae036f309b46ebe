"""Scenes of stored episodes, which are generated again or read from a file next to the episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from h3data.errors import H3DataError, SceneError
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode
from h3data.recording.task_episodes.stored_episodes import StoredEpisode
from h3data.scene import scene_digest
from h3data.scene.open import open_scene
from h3data.scene.sources import SceneFile, SceneSource, SceneSpec, scene_generators
from h3data_habitat.scene_files import dataset_at, find_scene_file, folders_of
from h3data_habitat.scenes.scene_dataset import DATASET_ENDING


def scene_of_episode(
    episode: RearrangeEpisode,
    stored: StoredEpisode | None,
    folder: Path,
    *,
    assets: Sequence[str | Path] = (),
    allow_missing: bool = False,
) -> SceneSource:
    """Return the scene of an episode that was read from a file in ``folder``; ``stored`` is its record, if it has one.

    A generated home is built again and must have the same content. If its content differs because the generator has
    changed, or if the scene is not a generated home, the file that the episode names is used. It is searched below
    ``folder``, its parent folder, the working directory and the asset folders (default: H3DATA_ASSETS). If the folder
    of an export has been moved, the dataset in it is used. The other options are those of `load_habitat_scene`.

    Raises:
        SceneError: no scene is available; the message states the reason.
    """
    source = {} if stored is None else stored.scene_source
    home = _home(source)
    if stored is not None and home is not None and stored.scene_sha256 in ("", _digest(home)):
        return home
    found = _named_file(episode, folder, tuple(map(str, assets)))
    # the path at the time of the recording, on this machine
    if found is None:
        config, scene = source.get("config"), source.get("scene")
        if isinstance(config, str) and Path(config).is_file():
            of_dataset = config.endswith(DATASET_ENDING) and isinstance(scene, str)
            found = config, str(scene) if of_dataset else ""
    if found is not None:
        options = {"assets": tuple(map(str, assets)), "allow_missing": allow_missing}
        return SceneFile(path=found[0], scene=found[1], **options)
    why = "it is no home, and " if source else ""
    why = "this version of h3data makes another home from its specification, and " if home is not None else why
    named = " or ".join(
        name for name in (episode.scene_id, episode.scene_dataset_config) if name not in ("", "default")
    )
    raise SceneError(
        f"Cannot find the scene {episode.scene_id!r} of episode {episode.episode_id!r}: {why}there is no file {named} in "
        f"{folder} or above it, in the working directory, or below the folders of assets= and H3DATA_ASSETS.",
        code="H3-HABITAT-032",
    )


def _named_file(episode: RearrangeEpisode, folder: Path, assets: tuple[str, ...]) -> tuple[str, str] | None:
    """Return the path of the dataset and name of its scene, or path of a scene and nothing."""
    scene = Path(episode.scene_id).name.split(".")[0]
    for root in (folder, folder.parent, Path()):
        for config, file in (
            (root / episode.scene_dataset_config, root / episode.scene_id),
            # an exported folder that was moved: its own layout, without the recorded folders
            (root / Path(episode.scene_dataset_config).name, root / "scenes" / Path(episode.scene_id).name),
        ):
            if config.name.endswith(DATASET_ENDING) and config.is_file() and _has_scene(config, scene):
                return str(config), scene
            if file.is_file():
                return str(file), ""
    folders = folders_of(assets)
    config = find_scene_file(episode.scene_dataset_config, folders)
    if config is not None and _has_scene(config, scene):
        return str(config), scene
    file = find_scene_file(episode.scene_id, folders)
    return None if file is None else (str(file), "")


@lru_cache(maxsize=4096)
def _has_scene(config: Path, scene: str) -> bool:
    found, _ = dataset_at(str(config)).find("scene_instances", scene)
    return found is not None and found.handle == scene


def _home(source: Mapping[str, Any]) -> SceneSpec | None:
    try:
        return recorded_spec(source)
    except (TypeError, H3DataError):
        return None


@lru_cache(maxsize=128)
def _digest(home: SceneSpec) -> str:
    return scene_digest(open_scene(home))


def recorded_spec(source: Mapping[str, Any]) -> SceneSpec | None:
    """Return the spec of a scene whose `Scene.source` is ``source``; None if no installed generator makes its kind.

    Raises:
        TypeError, H3DataError: the generator does not know such values.
    """
    generator = scene_generators().get(str(source.get("kind", "")))
    if generator is None:
        return None
    return generator.Spec(**{name: value for name, value in source.items() if name != "kind"})
