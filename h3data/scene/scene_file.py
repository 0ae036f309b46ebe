"""Storage of a scene as one GLB (glTF 2.0 binary) that viewers can open and that restores the scene exactly.

Viewers see one mesh per asset (POSITION, NORMAL, COLOR_0 linear, TEXCOORD_0), one node per instance, and one material
per texture, whose image is embedded once as PNG. Data that glTF cannot represent (categories, collision shapes,
receptacles, rooms, float64 poses, ...) is JSON below ``extras.h3data``. sRGB colours survive exactly: the 16-bit linear
values of neighbouring 8-bit sRGB ones are at least 19 apart.

A mesh with ``face_textures`` has one primitive per texture, so its triangles are stored ordered by texture (stable
sort). The array itself is stored too; from it a reader restores the original order.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError, SceneError
from h3data.files import part_file
from h3data.mesh.accessors import GltfArrays, entry
from h3data.mesh.glb import (
    FLOAT32,
    INT16,
    UINT16,
    UINT32,
    VERTICES,
    GlbChunk,
    cutout,
    gltf_document,
    matte,
    pack_glb,
    placement,
    unpack_glb,
)
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.png import png_pixels
from h3data.scene.records import Asset, Scene
from h3data.scene.scene_json import (
    articulation_record,
    asset_record,
    instance_record,
    light_record,
    read_articulation,
    read_asset,
    read_instance,
    read_light,
    read_room,
    room_record,
)
from h3data.srgb import bytes_to_linear

FORMAT_NAME, FORMAT_VERSION = "h3data.scene", (1, 3)
"""Name and version (major, minor) of the format. A reader refuses a newer major version and ignores unknown fields.
Version 1.1 added textures, 1.2 articulated objects, 1.3 stairs; a file without the last two has version 1.1."""

_LINEAR, _MIPMAPS = 9729, 9987


@cache
def _linear_of_srgb() -> NDArray[np.uint16]:
    """Return 16-bit linear light of each 8-bit sRGB value, shape [256]."""
    return np.round(bytes_to_linear(np.arange(256)) * 65535).astype(np.uint16)


def _srgb_of_linear(linear: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Return the nearest 8-bit sRGB values; exact for values written by `save_scene`."""
    table = _linear_of_srgb().astype(np.int32)
    # values of other writers lie between ours, and take the nearer one
    middles = (table[1:] + table[:-1]) // 2
    return np.searchsorted(middles, linear, side="left").astype(np.uint8)


# --- writing ----------------------------------------------------------------------------------------------------------
class _Textures:
    """The textures of a file in order of first use, each written once."""

    def __init__(self, chunk: GlbChunk) -> None:
        self._chunk = chunk
        self._place: dict[int, int] = {}
        self.images: list[dict[str, Any]] = []
        self.materials: list[dict[str, Any]] = [{"name": "vertex colours", "pbrMetallicRoughness": matte()}]

    def index(self, texture: Texture) -> int:
        """Return the index of the texture in the file; its material has the next index, since material 0 has no texture."""
        # by identity: meshes that share a texture share the object
        if id(texture) not in self._place:
            place = self._place[id(texture)] = len(self.images)
            self.images.append(self._chunk.image(texture.pixels, texture.name, gray=True))
            look = {"pbrMetallicRoughness": matte(place), **cutout(texture.pixels)}
            self.materials.append({"name": texture.name, **look})
        return self._place[id(texture)]

    def records(self) -> dict[str, Any]:
        """Return the top-level entries of the glTF document."""
        if not self.images:
            return {"materials": self.materials}
        return {
            "materials": self.materials,
            "textures": [{"sampler": 0, "source": k} for k in range(len(self.images))],
            "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPS}],
            "images": self.images,
        }


def _add_mesh(chunk: GlbChunk, asset: Asset, textures: _Textures) -> dict[str, Any] | None:
    """Return the accessors and textures of a mesh; None if it has no triangles and no vertices."""
    mesh = asset.mesh
    if not len(mesh.vertices):
        return None
    for what, values in (("vertices", mesh.vertices), ("normals", mesh.normals), ("uv", mesh.uv)):
        if values is not None and not np.isfinite(values).all():
            raise SceneError(
                f"Asset {asset.name!r} has {what} that are not finite; a scene file cannot store them.",
                code="H3-SCENE-049",
            )
    out: dict[str, Any] = {"POSITION": chunk.vectors(mesh.vertices, limits=True)}
    if mesh.normals is not None:
        out["NORMAL"] = chunk.vectors(mesh.normals)
    rgba = np.full((len(mesh.vertices), 4), 65535, "<u2")  # a fourth component keeps every vertex aligned to 4 bytes
    rgba[:, :3] = _linear_of_srgb()[mesh.colors]
    out["COLOR_0"] = chunk.array(rgba, "VEC4", UINT16, VERTICES, normalized=True)
    if mesh.uv is not None:
        out["TEXCOORD_0"] = chunk.vectors(mesh.uv)
    if len(mesh.faces):
        faces = mesh.faces if mesh.face_textures is None else mesh.faces[np.argsort(mesh.face_textures, kind="stable")]
        out["indices"] = chunk.triangles(faces)
    if mesh.textures:
        out["textures"] = [textures.index(t) for t in mesh.textures]
    if mesh.face_textures is not None:
        out["face_textures"] = chunk.array(mesh.face_textures.astype("<i2"), "SCALAR", INT16)
    return out


def _primitives(chunk: GlbChunk, mesh: Mesh, accessors: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the primitives that viewers show: one for all triangles, or one per texture."""
    attributes = {name: index for name, index in accessors.items() if name.isupper()}
    materials = [*(1 + k for k in accessors.get("textures", [])), 0]  # the last one serves texture -1
    if mesh.face_textures is None:
        material = materials[0]
        return [{"attributes": attributes, "indices": accessors["indices"], "material": material, "mode": 4}]
    kinds, counts = np.unique(mesh.face_textures, return_counts=True)
    primitives, start = [], 0
    for kind, count in zip(kinds.tolist(), counts.tolist(), strict=True):
        indices = chunk.part(accessors["indices"], 3 * start, 3 * count)
        primitives.append({"attributes": attributes, "indices": indices, "material": materials[kind], "mode": 4})
        start += count
    return primitives


def scene_bytes(scene: Scene) -> bytes:
    """Return the scene as the bytes of one GLB; the same scene gives the same bytes."""
    chunk = GlbChunk()
    textures = _Textures(chunk)
    records, meshes, mesh_of = [], [], {}
    for key, asset in scene.assets.items():
        try:
            accessors = _add_mesh(chunk, asset, textures)
        except ValueError as error:
            raise SceneError(
                f"Asset {asset.name!r} of scene {scene.name!r} cannot be written: {error}.", code="H3-SCENE-054"
            ) from error
        records.append({"key": key, **asset_record(asset, accessors)})
        if accessors is not None and "indices" in accessors:
            mesh_of[key] = len(meshes)
            meshes.append({"name": asset.name, "primitives": _primitives(chunk, asset.mesh, accessors)})
    nodes = [
        {
            "name": i.name,
            **placement(i.pose, i.scale),
            **({"mesh": mesh_of[i.asset]} if i.asset in mesh_of else {}),
        }
        for i in scene.instances
    ]
    things = [articulation_record(thing) for thing in scene.articulations]
    extras = {
        "format": FORMAT_NAME,
        # the lowest version that has all that is in the file, so that older readers open it, and its bytes stay the same
        "version": [1, 3 if any(r.ramp for r in scene.rooms) else 2 if scene.articulations else 1],
        "name": scene.name,
        "source": dict(scene.source),
        "rooms": [room_record(r) for r in scene.rooms],
        "assets": records,
        "instances": [instance_record(i) for i in scene.instances],
        **({} if scene.lights is None else {"lights": [light_record(light) for light in scene.lights]}),
        **({"articulations": things} if things else {}),
    }
    shown = {"name": scene.name, **({"nodes": list(range(len(nodes)))} if nodes else {})}
    lists = {
        "nodes": nodes,
        "meshes": meshes,
        **(textures.records() if meshes or textures.images else {}),
        "accessors": chunk.accessors,
        "bufferViews": chunk.views,
        "buffers": [{"byteLength": chunk.size}] if chunk.size else [],
    }
    # glTF forbids empty lists
    lists = {name: value for name, value in lists.items() if value}
    try:
        return pack_glb(gltf_document(shown, extras={"h3data": extras}, **lists), chunk)
    except (TypeError, ValueError) as error:
        raise SceneError(
            f"Scene {scene.name!r} cannot be written: {error}. Poses, shapes and `source` must be finite and plain JSON.",
            code="H3-SCENE-050",
        ) from error


def save_scene(scene: Scene, path_or_buffer: str | os.PathLike[str] | BinaryIO) -> None:
    """Write a scene as GLB to a path (atomically, through ``.part``) or into an open binary file."""
    data = scene_bytes(scene)
    if not isinstance(path_or_buffer, str | os.PathLike):
        path_or_buffer.write(data)
        return
    path = Path(path_or_buffer)
    try:
        with part_file(path) as part:
            part.write_bytes(data)
    except OSError as error:
        raise InputError(
            f"Cannot write the scene: {error.strerror or error}. Path: {path}", code="H3-SCENE-051"
        ) from error


# --- reading ----------------------------------------------------------------------------------------------------------
def load_scene(path_or_bytes: str | os.PathLike[str] | bytes | BinaryIO) -> Scene:
    """Return the scene of a GLB written by `save_scene`, equal to the saved one (same `scene_digest`)."""
    if isinstance(path_or_bytes, bytes | bytearray | memoryview):
        data, where = bytes(path_or_bytes), "the given bytes"
    elif isinstance(path_or_bytes, str | os.PathLike):
        where = str(path_or_bytes)
        try:
            data = Path(path_or_bytes).read_bytes()
        except OSError as error:
            raise InputError(
                f"Cannot read a scene: {error.strerror or error}. Path: {where}", code="H3-SCENE-055"
            ) from error
    else:
        data, where = path_or_bytes.read(), getattr(path_or_bytes, "name", "the given file")
    document, binary = unpack_glb(data, where, what="a scene as GLB")
    extras = document.get("extras")
    record = extras.get("h3data") if isinstance(extras, dict) else None
    if not isinstance(record, dict) or record.get("format") != FORMAT_NAME:
        raise FormatError(
            "A GLB, but not one written by h3data.scene.save_scene. "
            f"Hint: h3data.open reads other GLBs and Habitat's scenes. File: {where}",
            code="H3-SCENE-048",
        )
    try:
        major = int(record["version"][0])
        if major > FORMAT_VERSION[0]:
            raise FormatError(
                f"The scene has format version {major}, this h3data reads up to {FORMAT_VERSION[0]}. "
                f"Hint: upgrade h3data. File: {where}",
                code="H3-SCENE-052",
            )
        # a GLB has one buffer, its binary chunk
        return _scene(record, GltfArrays(document, lambda index: binary))
    # a file is anybody's: each of these is what some wrong value raises in one of the readers of records
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, SceneError) as error:
        raise FormatError(
            f"Damaged scene file ({type(error).__name__}: {error}). File: {where}", code="H3-SCENE-053"
        ) from error


def _accessor(arrays: GltfArrays, index: object, kind: str, component: int) -> NDArray[Any]:
    """Return one accessor, of the kind that we write."""
    record = entry(arrays.document, "accessors", index)
    if (record.get("type"), record.get("componentType")) != (kind, component):
        raise ValueError(
            f"accessors[{index}] is {record.get('type')}/{record.get('componentType')}, not {kind}/{component}"
        )
    return arrays.accessor(index)


def _mesh(record: dict[str, Any], arrays: GltfArrays, textures: Sequence[Texture]) -> Mesh:
    accessors = record["mesh"]
    if accessors is None:
        none = np.zeros((0, 3), np.float32)
        normals = none.copy() if record["has_normals"] else None
        return Mesh(vertices=none, faces=none.astype(np.int32), colors=none.astype(np.uint8), normals=normals)

    def floats32(name: str, kind: str) -> NDArray[np.float32] | None:
        if name not in accessors:
            return None
        return _accessor(arrays, accessors[name], kind, FLOAT32).astype(np.float32)

    faces = np.zeros((0, 3), np.int32)
    if "indices" in accessors:
        faces = _accessor(arrays, accessors["indices"], "SCALAR", UINT32).reshape(-1, 3).astype(np.int32)
    face_textures = None
    if "face_textures" in accessors:
        face_textures = _accessor(arrays, accessors["face_textures"], "SCALAR", INT16).astype(np.int16)
        # the same stable order as in `_add_mesh`, undone
        ordered, faces = faces, np.empty_like(faces)
        faces[np.argsort(face_textures, kind="stable")] = ordered
    color = _accessor(arrays, accessors["COLOR_0"], "VEC4", UINT16)
    return Mesh(
        vertices=_accessor(arrays, accessors["POSITION"], "VEC3", FLOAT32).astype(np.float32),
        faces=faces,
        colors=_srgb_of_linear(color[:, :3]),
        normals=floats32("NORMAL", "VEC3"),
        uv=floats32("TEXCOORD_0", "VEC2"),
        textures=tuple(textures[k] for k in accessors.get("textures", ())),
        face_textures=face_textures,
    )


def _scene(record: dict[str, Any], arrays: GltfArrays) -> Scene:
    textures = [
        Texture(pixels=png_pixels(arrays.view(image.get("bufferView"))), name=str(image.get("name", "")))
        for image in arrays.document.get("images", [])
    ]
    return Scene(
        name=str(record["name"]),
        assets={str(a["key"]): read_asset(a, _mesh(a, arrays, textures)) for a in record["assets"]},
        instances=tuple(read_instance(i) for i in record["instances"]),
        rooms=tuple(read_room(r) for r in record["rooms"]),
        lights=None if (lights := record.get("lights")) is None else tuple(read_light(light) for light in lights),
        source=dict(cast("Mapping[str, Any]", record["source"])),
        articulations=tuple(read_articulation(thing) for thing in record.get("articulations", ())),
    )
