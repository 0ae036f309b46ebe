"""Structs of the CUDA code (`common.cuh`, `deform.cu`, `raster.cu`, `shade.cu`, `occlusion.cu`) for ctypes and NumPy.

Pointers in the CUDA code are represented by device addresses.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

CAMERA_WORDS = 18
"""Number of 32-bit words per view: a 3x4 matrix from camera to world, fx, fy, cx, cy, near and far."""
BOX = np.dtype([("center", "3f4"), ("first", "i4"), ("half", "3f4"), ("second", "i4")])
PLACE = np.dtype([("slot", "i4"), ("layer", "u4"), ("group", "i4"), ("instance", "i4")])
SCENE = np.dtype(
    [
        ("first_item", "i4"),
        ("items", "i4"),
        ("first_instance", "i4"),
        ("first_group", "i4"),
        ("groups", "i4"),
        ("first_vertex", "i4"),
        ("first_cluster", "i4"),
        ("unused", "i4"),
    ]
)
GROUP = np.dtype([("first_cluster", "i4"), ("clusters", "i4"), ("body", "i4"), ("first_source", "i4")])


class Struct(ctypes.Structure):
    """Struct of the CUDA code that is filled by field name; a tensor is stored as its address."""

    def fill(self, **values: Any) -> None:
        """Set fields by name; a tensor is stored as the address of its data."""
        for name, value in values.items():
            setattr(self, name, value.data_ptr() if hasattr(value, "data_ptr") else value)


def _fields(pointers: str, **rest: str) -> list[tuple[str, Any]]:
    kinds = {"int": ctypes.c_int, "float": ctypes.c_float}
    fields: list[tuple[str, Any]] = [(name, ctypes.c_void_p) for name in pointers.split()]
    for kind, names in rest.items():
        fields += [(name, kinds[kind.rstrip("_")]) for name in names.split()]
    return fields


class World(Struct):
    """Struct with the scene, poses and cameras that all kernels read."""

    _fields_ = _fields(
        "vertices triangles clusters items places scenes scene_of_world world_of_view groups poses cameras hidden "
        "placement deformed deformed_clusters deformed_groups",
        int="slots deformed_vertices deformed_cluster_count deformed_group_count width height first_view views scale "
        "unused",
    )


class Deform(Struct):
    """Arguments of the kernels that skin meshes."""

    _fields_ = [
        ("world", World),
        *_fields(
            "joints inverse_bind palettes skin_joints skin_weights sources source_vertex",
            int="worlds bodies joint_count joint_words source_count unused",
        ),
    ]


class Cutouts(Struct):
    """Struct with the textures whose transparent pixels the rasteriser leaves out."""

    _fields_ = _fields("uv triangle_textures maps opacity")


class Raster(Struct):
    """Arguments of the rasteriser."""

    _fields_ = [("world", World), *_fields("depth words cutouts")]


class Shade(Struct):
    """Arguments of the kernels that compute colours, ids and normals from rasterised triangles."""

    _fields_ = [
        ("world", World),
        *_fields(
            "depth words triangle_instances triangle_faces instance_ids semantic_ids normals colors uv mirrors "
            "triangle_textures "
            "levels first_level texels normal_groups group_first group_faces linear_of_byte byte_of_level surfaces occlusion "
            "blockers blocker_counts receivers instance semantic triangle normal rgb"
        ),
        ("light", ctypes.c_float * 27),
        *_fields("", float="strength", int="coarse_width coarse_height blocker_limit receiver_limit samples"),
    ]


class Occlude(Struct):
    """Arguments of the kernels that compute ambient occlusion."""

    _fields_ = _fields(
        "depth cameras offsets surfaces amounts source",
        int="width height factor coarse_width coarse_height scale first_view views along_y",
        float="radius near_radius gain",
    )
