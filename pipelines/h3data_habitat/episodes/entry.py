"""Entry point of Habitat's episode files in the group ``h3data.episode_files``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.recording.task_episodes.episode_files import EpisodeFiles
from h3data.recording.task_episodes.stored_rearrangements import EpisodeObject
from h3data.scene.records import Scene
from h3data.scene.sources import SceneSource
from h3data_habitat.episodes.episode_json import encode_episode
from h3data_habitat.episodes.files import read_episodes, write_episodes
from h3data_habitat.episodes.objects import read_object_template, search_in, search_of, with_objects
from h3data_habitat.episodes.scenes import scene_of_episode


def _add_objects(
    scene: Scene, objects: Sequence[EpisodeObject], paths: Sequence[str], assets: Sequence[str]
) -> tuple[Scene, Mapping[str, NDArray[np.float64]]]:
    return with_objects(scene, objects, search_of(scene, paths, assets))


def _stand_ins(source: SceneSource, objects: Sequence[EpisodeObject], paths: Sequence[str]) -> Sequence[str]:
    search = search_in(source, paths)
    read = [read_object_template(config, search) for config in {thing.config: None for thing in objects}]
    return tuple(found.missing for found in read if found.missing)


HABITAT = EpisodeFiles(
    read=read_episodes,
    write=write_episodes,
    encode=encode_episode,
    scene_of=scene_of_episode,
    add_objects=_add_objects,
    stand_ins=_stand_ins,
)
