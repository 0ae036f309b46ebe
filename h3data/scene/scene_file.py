"""A scene as one GLB (glTF 2.0 binary) that any viewer opens and that gives the same scene back exactly.

Viewers see one mesh per asset (POSITION, NORMAL, COLOR_0 linear) and one node per instance. What glTF has no place for
(categories, collision shapes, receptacles, rooms, float64 poses, ...) lies as JSON below ``extras.h3data`` of the file.
sRGB colours survive exactly: 16-bit linear values are at least 19 steps apart for neighbouring 8-bit sRGB ones.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError, SceneError
from h3data.files import part_file
from h3data.geometry import normalized
from h3data.scene.glb import FLOAT32, INDICES, UINT16, UINT32, VERTICES, GlbChunk, pack_glb, unpack_glb
from h3data.scene.records import Asset, Instance, Mesh, Scene
from h3data.scene.scene_json import (
    asset_record,
    floats,
    instance_record,
    light_record,
    read_asset,
    read_instance,
    read_light,
    read_room,
    room_record,
)
from h3data.srgb import bytes_to_linear

FORMAT_NAME = "h3data.scene"
FORMAT_VERSION = (1, 0)
"""Major, minor. A reader refuses a newer major version and ignores fields that it does not know."""


@cache
def _linear_of_srgb() -> NDArray[np.uint16]:
    """16-bit linear light of each 8-bit sRGB value, shape [256]."""
    return np.round(bytes_to_linear(np.arange(256)) * 65535).astype(np.uint16)


def _srgb_of_linear(linear: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """The nearest 8-bit sRGB values; exact for values written by `save_scene`."""
    table = _linear_of_srgb().astype(np.int32)
    middles = (table[1:] + table[:-1]) // 2
    return np.searchsorted(middles, linear, side="left").astype(np.uint8)


# --- writing ----------------------------------------------------------------------------------------------------------
def _add_mesh(chunk: GlbChunk, asset: Asset) -> dict[str, int] | None:
    """Accessors of a mesh; None if it has no triangles and no vertices."""
    mesh = asset.mesh
    if not len(mesh.vertices):
        return None
    for what, values in (("vertices", mesh.vertices), ("normals", mesh.normals)):
        if values is not None and not np.isfinite(values).all():
            raise SceneError(f"Asset {asset.name!r} has {what} that are not finite; a scene file cannot hold them.")
    low, high = mesh.bounds.tolist()
    vertices = mesh.vertices.astype("<f4")
    out = {"POSITION": chunk.array(vertices, "VEC3", FLOAT32, VERTICES, min=low, max=high)}
    if mesh.normals is not None:
        out["NORMAL"] = chunk.array(mesh.normals.astype("<f4"), "VEC3", FLOAT32, VERTICES)
    rgba = np.full((len(vertices), 4), 65535, "<u2")  # four components keep every vertex on a 4-byte border
    rgba[:, :3] = _linear_of_srgb()[mesh.colors]
    out["COLOR_0"] = chunk.array(rgba, "VEC4", UINT16, VERTICES, normalized=True)
    if len(mesh.faces):
        out["indices"] = chunk.array(mesh.faces.astype("<u4").ravel(), "SCALAR", UINT32, INDICES)
    return out


def _node(instance: Instance, mesh: int | None) -> dict[str, Any]:
    rotation = normalized(instance.pose[3:])
    node: dict[str, Any] = {
        "name": instance.name,
        "translation": floats(instance.pose[:3]),
        "rotation": [float(np.clip(v, -1, 1)) for v in rotation],
        "scale": floats(instance.scale),
    }
    return node if mesh is None else {**node, "mesh": mesh}


def scene_bytes(scene: Scene) -> bytes:
    """The scene as the bytes of one GLB; the same scene gives the same bytes."""
    chunk = GlbChunk()
    records, meshes, mesh_of = [], [], {}
    for key, asset in scene.assets.items():
        accessors = _add_mesh(chunk, asset)
        records.append({"key": key, **asset_record(asset, accessors)})
        if accessors is not None and "indices" in accessors:
            attributes = {name: index for name, index in accessors.items() if name != "indices"}
            primitive = {"attributes": attributes, "indices": accessors["indices"], "material": 0, "mode": 4}
            mesh_of[key] = len(meshes)
            meshes.append({"name": asset.name, "primitives": [primitive]})
    nodes = [_node(i, mesh_of.get(i.asset)) for i in scene.instances]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "h3data"},
        "scene": 0,
        "scenes": [{"name": scene.name, "nodes": list(range(len(nodes)))} if nodes else {"name": scene.name}],
        "extras": {
            "h3data": {
                "format": FORMAT_NAME,
                "version": list(FORMAT_VERSION),
                "name": scene.name,
                "source": dict(scene.source),
                "rooms": [room_record(r) for r in scene.rooms],
                "assets": records,
                "instances": [instance_record(i) for i in scene.instances],
                **({} if scene.lights is None else {"lights": [light_record(light) for light in scene.lights]}),
            }
        },
    }
    material = {"name": "vertex colours", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
    more = {
        "nodes": nodes,
        "meshes": meshes,
        "materials": [material] if meshes else [],
        "accessors": chunk.accessors,
        "bufferViews": chunk.views,
        "buffers": [{"byteLength": chunk.size}] if chunk.size else [],
    }
    document |= {name: value for name, value in more.items() if value}
    try:
        return pack_glb(document, chunk)
    except (TypeError, ValueError) as error:
        raise SceneError(
            f"Scene {scene.name!r} cannot be written: {error}. Poses, shapes and `source` must be finite and plain JSON."
        ) from error


def save_scene(scene: Scene, path_or_buffer: str | os.PathLike[str] | BinaryIO) -> None:
    """Writes a scene as GLB to a path (first to ``.part``, then renamed) or into an open binary file."""
    data = scene_bytes(scene)
    if not isinstance(path_or_buffer, str | os.PathLike):
        path_or_buffer.write(data)
        return
    path = Path(path_or_buffer)
    try:
        with part_file(path) as part:
            part.write_bytes(data)
    except OSError as error:
        raise InputError(f"Cannot write the scene: {error.strerror or error}. Path: {path}") from error


# --- reading ----------------------------------------------------------------------------------------------------------
def load_scene(path_or_bytes: str | os.PathLike[str] | bytes | BinaryIO) -> Scene:
    """The scene of a GLB written by `save_scene`, equal to the one saved (`scene_digest` tells)."""
    if isinstance(path_or_bytes, bytes | bytearray | memoryview):
        data, where = bytes(path_or_bytes), "the given bytes"
    elif isinstance(path_or_bytes, str | os.PathLike):
        where = str(path_or_bytes)
        try:
            data = Path(path_or_bytes).read_bytes()
        except OSError as error:
            raise InputError(f"Cannot read a scene: {error.strerror or error}. Path: {where}") from error
    else:
        data, where = path_or_bytes.read(), getattr(path_or_bytes, "name", "the given file")
    document, binary = unpack_glb(data, where, what="a scene as GLB")
    extras = document.get("extras")
    record = extras.get("h3data") if isinstance(extras, dict) else None
    if not isinstance(record, dict) or record.get("format") != FORMAT_NAME:
        raise FormatError(
            "A GLB, but not one written by h3data.scene.save_scene. "
            f"Hint: h3data.interop reads GLBs and scenes of other makers. File: {where}"
        )
    try:
        major = int(record["version"][0])
        if major > FORMAT_VERSION[0]:
            raise FormatError(
                f"The scene has format version {major}, this h3data reads up to {FORMAT_VERSION[0]}. "
                f"Hint: upgrade h3data. File: {where}"
            )
        return _scene(record, document, binary)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, SceneError) as error:
        raise FormatError(f"Damaged scene file ({type(error).__name__}: {error}). File: {where}") from error


_WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_DTYPE = {FLOAT32: "<f4", UINT16: "<u2", UINT32: "<u4"}


def _accessor(document: dict[str, Any], binary: bytes, index: int, kind: str, component: int) -> NDArray[Any]:
    """One accessor of our own writer: tightly packed, of the kind that we write."""
    accessor = document["accessors"][index]
    if (accessor["type"], accessor["componentType"]) != (kind, component):
        raise ValueError(f"accessor {index} is {accessor['type']}/{accessor['componentType']}, not {kind}/{component}")
    view = document["bufferViews"][accessor["bufferView"]]
    dtype, width = np.dtype(_DTYPE[component]), _WIDTH[kind]
    start, size = int(view["byteOffset"]), int(accessor["count"]) * width * dtype.itemsize
    if start < 0 or size < 0 or start + size > len(binary):
        raise ValueError(f"accessor {index} needs bytes {start}..{start + size}, the file has {len(binary)}")
    array = np.frombuffer(binary, dtype, count=size // dtype.itemsize, offset=start)
    return array.reshape(-1, width) if width > 1 else array


def _mesh(record: dict[str, Any], document: dict[str, Any], binary: bytes) -> Mesh:
    accessors = record["mesh"]
    if accessors is None:
        none = np.zeros((0, 3), np.float32)
        normals = none.copy() if record["has_normals"] else None
        return Mesh(vertices=none, faces=none.astype(np.int32), colors=none.astype(np.uint8), normals=normals)
    normals = None
    if "NORMAL" in accessors:
        normals = _accessor(document, binary, accessors["NORMAL"], "VEC3", FLOAT32).astype(np.float32)
    faces = np.zeros((0, 3), np.int32)
    if "indices" in accessors:
        faces = _accessor(document, binary, accessors["indices"], "SCALAR", UINT32).reshape(-1, 3).astype(np.int32)
    color = _accessor(document, binary, accessors["COLOR_0"], "VEC4", UINT16)
    return Mesh(
        vertices=_accessor(document, binary, accessors["POSITION"], "VEC3", FLOAT32).astype(np.float32),
        faces=faces,
        colors=_srgb_of_linear(color[:, :3]),
        normals=normals,
    )


def _scene(record: dict[str, Any], document: dict[str, Any], binary: bytes) -> Scene:
    return Scene(
        name=str(record["name"]),
        assets={str(a["key"]): read_asset(a, _mesh(a, document, binary)) for a in record["assets"]},
        instances=tuple(read_instance(i) for i in record["instances"]),
        rooms=tuple(read_room(r) for r in record["rooms"]),
        lights=None if (lights := record.get("lights")) is None else tuple(read_light(light) for light in lights),
        source=dict(cast("Mapping[str, Any]", record["source"])),
    )
