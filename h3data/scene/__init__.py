"""Homes: what stands where, and where one can go. Everything is imported at first use (free space needs numba, shapely)."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from h3data.mesh.records import Mesh, Texture
    from h3data.scene.freespace.free_space import FreeSpace
    from h3data.scene.homes import CATEGORIES, HOME_PRESETS, HomePreset, HomeSpec, build_home
    from h3data.scene.records import (
        Asset,
        Box,
        Capsule,
        Cylinder,
        Hull,
        Instance,
        LightSource,
        Receptacle,
        Room,
        Scene,
        Shape,
        instance_bounds,
        instance_matrix,
    )
    from h3data.scene.scene_file import load_scene, save_scene
    from h3data.scene.scene_json import scene_digest

_HOMES = {
    "FreeSpace": "h3data.scene.freespace.free_space",
    "CATEGORIES": "h3data.scene.homes",
    "HOME_PRESETS": "h3data.scene.homes",
    "HomePreset": "h3data.scene.homes",
    "HomeSpec": "h3data.scene.homes",
    "build_home": "h3data.scene.homes",
    "Asset": "h3data.scene.records",
    "Box": "h3data.scene.records",
    "Capsule": "h3data.scene.records",
    "Cylinder": "h3data.scene.records",
    "Hull": "h3data.scene.records",
    "Instance": "h3data.scene.records",
    "LightSource": "h3data.scene.records",
    "Mesh": "h3data.mesh.records",
    "Receptacle": "h3data.scene.records",
    "Room": "h3data.scene.records",
    "Scene": "h3data.scene.records",
    "Shape": "h3data.scene.records",
    "Texture": "h3data.mesh.records",
    "instance_bounds": "h3data.scene.records",
    "instance_matrix": "h3data.scene.records",
    "load_scene": "h3data.scene.scene_file",
    "save_scene": "h3data.scene.scene_file",
    "scene_digest": "h3data.scene.scene_json",
}

__all__ = [
    "CATEGORIES",
    "HOME_PRESETS",
    "Asset",
    "Box",
    "Capsule",
    "Cylinder",
    "FreeSpace",
    "HomePreset",
    "HomeSpec",
    "Hull",
    "Instance",
    "LightSource",
    "Mesh",
    "Receptacle",
    "Room",
    "Scene",
    "Shape",
    "Texture",
    "build_home",
    "instance_bounds",
    "instance_matrix",
    "load_scene",
    "save_scene",
    "scene_digest",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'h3data.scene' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(importlib.import_module(_HOMES[name]), name)
