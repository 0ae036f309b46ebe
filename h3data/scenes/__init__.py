"""Scenes: homes and other places, their free floor, and sets of scenes (h3data docs scenes)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.moved import lazy_names
from h3data.scene import FreeSpace, Scene, save_scene
from h3data.scene.scene_sets import SceneFile, SceneSet, find_scene_set

if TYPE_CHECKING:
    from h3data_homes import HomeSpec, build_home

__all__ = [
    "FreeSpace",
    "HomeSpec",
    "Scene",
    "SceneFile",
    "SceneSet",
    "build_home",
    "find_scene_set",
    "save_scene",
]

__getattr__ = lazy_names(__name__, {"HomeSpec": "h3data_homes", "build_home": "h3data_homes"})
