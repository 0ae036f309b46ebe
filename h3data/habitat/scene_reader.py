"""Habitat's scenes among the scenes that are found by path: an entry point of the group ``h3data.scenes``."""

from __future__ import annotations

from h3data.habitat.scenes.scene_dataset import DATASET_ENDING, load_scene_dataset
from h3data.habitat.scenes.scene_instance import HABITAT_ENDINGS, load_habitat_scene
from h3data.scene.records import Scene
from h3data.scene.sources import SceneFile, SceneReader


def read_scene(file: SceneFile) -> Scene:
    """Reads a scene of Habitat with the options of the file; fails as `load_habitat_scene` does."""
    return load_habitat_scene(
        file.path, file.scene or None, allow_missing=file.allow_missing, strict=file.strict, assets=file.assets
    )


HABITAT = SceneReader(
    endings=HABITAT_ENDINGS,
    read=read_scene,
    collection=DATASET_ENDING,
    open_collection=load_scene_dataset,
    scenes_in=lambda path: load_scene_dataset(path).scenes,
)
