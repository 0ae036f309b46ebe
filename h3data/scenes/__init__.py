"""Scenes: homes and other places, the free floor in them, and sets of them (h3data docs scenes)."""

from __future__ import annotations

from h3data.scene import FreeSpace, HomeSpec, Scene, build_home, save_scene
from h3data.scene.scene_sets import SceneFile, SceneSet, find_scene_set

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
