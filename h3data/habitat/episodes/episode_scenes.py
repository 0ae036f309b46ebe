"""Where the scene of a stored episode is: a home that can be built again, or a file beside the episodes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from h3data.errors import H3DataError, SceneError
from h3data.habitat.episodes.rearrange_episode import RearrangeEpisode
from h3data.habitat.episodes.social_nav_episodes import SocialNavEpisode
from h3data.habitat.scene_names import open_scene
from h3data.habitat.scenes.scene_dataset import DATASET_ENDING
from h3data.scene import HomeSpec, scene_digest
from h3data.scene.scene_sets import SceneFile, SceneSource


def scene_of_episode(episode: RearrangeEpisode, nav: SocialNavEpisode, folder: Path) -> SceneSource:
    """How to get the scene of an episode that was read from a file in ``folder``.

    A home is built again and must have the same content; if it has not, since the generator has changed, or if it is no
    home, the file is taken that the episode names: below ``folder``, the folder above it or the working directory; or the
    dataset that lies there, when the folder of an export has been moved.

    Raises:
        SceneError: neither is there; the message says why.
    """
    home = _home(nav.scene_source)
    if home is not None and nav.scene_sha256 in ("", _digest(home)):
        return home
    for root in (folder, folder.parent, Path()):
        for config, file in (
            (root / episode.scene_dataset_config, root / episode.scene_id),
            (root / Path(episode.scene_dataset_config).name, root / "scenes" / Path(episode.scene_id).name),
        ):
            if config.name.endswith(DATASET_ENDING) and config.is_file():
                return SceneFile(path=str(config), scene=Path(episode.scene_id).name.split(".")[0])
            if file.is_file():
                return SceneFile(path=str(file))
    config, scene = nav.scene_source.get("config"), nav.scene_source.get("scene")
    if isinstance(config, str) and Path(config).is_file():
        of_dataset = config.endswith(DATASET_ENDING) and isinstance(scene, str)
        return SceneFile(path=config, scene=str(scene) if of_dataset else "")
    why = "this version of h3data makes another home from its specification" if home is not None else "it is no home"
    raise SceneError(
        f"Cannot find the scene {episode.scene_id!r} of episode {episode.episode_id!r}: {why}, and there is no file "
        f"{episode.scene_id} or {episode.scene_dataset_config} in {folder} or above it."
    )


def _home(source: Mapping[str, Any]) -> HomeSpec | None:
    if source.get("kind") != "home":
        return None
    try:
        return HomeSpec(**{name: value for name, value in source.items() if name != "kind"})
    except (TypeError, H3DataError):
        return None


@lru_cache(maxsize=128)
def _digest(home: HomeSpec) -> str:
    return scene_digest(open_scene(home))
