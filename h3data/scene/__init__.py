"""Homes: their furniture and objects, procedural generation, and the floor that agents can walk on.

- `records`: assets, instances, rooms, lights; `scene_file` stores them as GLB, `scene_json` as JSON records and a digest
- `floor_heights`: how high the floor is at a place, where a home has several storeys
- `articulation`: poses of doors and drawers, and of scenes in which they are open
- `sources`: what makes or reads scenes; the generator of furnished homes is the package `h3data_homes`
- `freespace`: geodesic distances and paths on the free floor
- `scene_sets`: train, val and test splits of scenes
- `validation`: faults such as cut-off floor and floating objects

Names are imported at first use, because free space needs numba and shapely.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from h3data.moved import RENAMED, refuse_renamed

if TYPE_CHECKING:
    from h3data.mesh.mesh import Mesh, Texture
    from h3data.scene.articulation import joint_names, opened, posed
    from h3data.scene.freespace.free_space import FreeSpace
    from h3data.scene.kinds import CATEGORIES
    from h3data.scene.records import (
        Articulation,
        Asset,
        Box,
        Capsule,
        Cylinder,
        Hull,
        Instance,
        Joint,
        LightSource,
        Part,
        Ramp,
        Receptacle,
        Room,
        Scene,
        Shape,
        instance_bounds,
        instance_matrix,
    )
    from h3data.scene.scene_file import load_scene, save_scene
    from h3data.scene.scene_json import scene_digest

_MODULE_OF = {
    name: module
    for module, names in {
        "h3data.mesh.mesh": "Mesh Texture",
        "h3data.scene.articulation": "joint_names opened posed",
        "h3data.scene.freespace.free_space": "FreeSpace",
        "h3data.scene.kinds": "CATEGORIES",
        "h3data.scene.records": "Articulation Asset Box Capsule Cylinder Hull Instance Joint LightSource Part "
        "Ramp Receptacle Room Scene Shape instance_bounds instance_matrix",
        "h3data.scene.scene_file": "load_scene save_scene",
        "h3data.scene.scene_json": "scene_digest",
    }.items()
    for name in names.split()
}

__all__ = [
    "CATEGORIES",
    "Articulation",
    "Asset",
    "Box",
    "Capsule",
    "Cylinder",
    "FreeSpace",
    "Hull",
    "Instance",
    "Joint",
    "LightSource",
    "Mesh",
    "Part",
    "Ramp",
    "Receptacle",
    "Room",
    "Scene",
    "Shape",
    "Texture",
    "instance_bounds",
    "instance_matrix",
    "joint_names",
    "load_scene",
    "opened",
    "posed",
    "save_scene",
    "scene_digest",
]


def __getattr__(name: str) -> Any:
    if f"{__name__}.{name}" in RENAMED:
        return refuse_renamed(__name__)(name)
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'h3data.scene' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)
