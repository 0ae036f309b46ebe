"""Scenes: homes and other places, the free floor in them, and sets of them (h3data docs scenes)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from h3data.plugins import import_name
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


def __getattr__(name: str) -> Any:
    if name not in ("HomeSpec", "build_home"):
        raise AttributeError(f"module 'h3data.scenes' has no attribute {name!r}; it has {', '.join(__all__)}")
    return import_name("h3data_homes", name)
