"""Homes: their furniture and objects, procedural generation, and the floor that agents can walk on.

- `records`: assets, instances, rooms, lights; `scene_file` stores them as GLB, `scene_json` as JSON records and a
digest
- `floor_heights`: heights of the floor in homes with several storeys
- `articulation`: poses of doors and drawers, and scenes with open ones
- `sources`: recipes and files of scenes; the generator of furnished homes is the package `h3data_homes`
- `freespace`: geodesic distances and paths on the free floor
- `scene_sets`: train, val and test splits of scenes
- `validation`: faults such as cut-off floor and floating objects

Names are imported at first use, because free space needs numba and shapely.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.moved import lazy_names

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

__getattr__ = lazy_names(
    __name__,
    {
        **dict.fromkeys(("Mesh", "Texture"), "h3data.mesh.mesh"),
        **dict.fromkeys(("joint_names", "opened", "posed"), ".articulation"),
        "FreeSpace": ".freespace.free_space",
        "CATEGORIES": ".kinds",
        **dict.fromkeys(
            (
                "Articulation",
                "Asset",
                "Box",
                "Capsule",
                "Cylinder",
                "Hull",
                "Instance",
                "Joint",
                "LightSource",
                "Part",
                "Ramp",
                "Receptacle",
                "Room",
                "Scene",
                "Shape",
                "instance_bounds",
                "instance_matrix",
            ),
            ".records",
        ),
        **dict.fromkeys(("load_scene", "save_scene"), ".scene_file"),
        "scene_digest": ".scene_json",
    },
)
