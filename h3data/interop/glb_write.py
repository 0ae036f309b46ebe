"""Meshes as GLB (glTF 2.0 binary) with their colours in a small texture, which every viewer and habitat-sim draws.

`h3data.scene.save_scene` keeps scenes exactly, with vertex colours; many programs drop those of meshes that have a
material (habitat-sim's PBR shader among them), so what is meant for others comes from here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.geometry import IDENTITY_POSE, normalized
from h3data.scene.glb import FLOAT32, INDICES, UINT32, VERTICES, GlbChunk, pack_glb
from h3data.scene.records import Mesh

_NEAREST, _CLAMP = 9728, 33071
_BLOCK_PX = 4
"""Side of the square of one colour in the palette: the first two mipmaps of a viewer that makes some are still clean."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GlbNode:
    """One mesh placed in the file's frame."""

    name: str
    mesh: int
    """Index into the meshes of the file."""
    pose: NDArray[np.float64] = field(default_factory=IDENTITY_POSE.copy)
    """pose7, shape [7]."""
    scale: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    extras: Mapping[str, Any] = field(default_factory=dict)
    """Plain JSON that other programs keep or ignore."""


def glb_bytes(meshes: Sequence[Mesh], nodes: Sequence[GlbNode] | None = None) -> bytes:
    """A GLB with ``nodes`` (default: one per mesh); the same meshes give the same bytes.

    Positions are exact. Colours are exact where a triangle has one; a triangle whose corners differ gets their mean.
    """
    if nodes is None:
        nodes = [GlbNode(name=f"part_{k}", mesh=k) for k in range(len(meshes))]
    meshes = [_one_color_per_triangle(_checked(mesh)) for mesh in meshes]
    palette = np.unique(np.concatenate([m.colors for m in meshes]), axis=0)
    side = int(np.ceil(np.sqrt(len(palette))))
    chunk = GlbChunk()
    image = chunk.view(_palette_png(palette, side))
    records = [
        {"name": f"mesh_{k}", "primitives": [_primitive(chunk, mesh, palette, side)]} for k, mesh in enumerate(meshes)
    ]
    document = {
        "asset": {"version": "2.0", "generator": "h3data"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": [_node(node) for node in nodes],
        "meshes": records,
        "materials": [
            {
                "name": "palette",
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0
                },
            }
        ],
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [{"magFilter": _NEAREST, "minFilter": _NEAREST, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": [{"bufferView": image, "mimeType": "image/png"}],
        "accessors": chunk.accessors,
        "bufferViews": chunk.views,
        "buffers": [{"byteLength": chunk.size}],
    }  # fmt: skip
    return pack_glb(document, chunk)


def _primitive(chunk: GlbChunk, mesh: Mesh, palette: NDArray[np.uint8], side: int) -> dict[str, Any]:
    low, high = mesh.bounds.tolist()
    attributes = {"POSITION": chunk.array(mesh.vertices.astype("<f4"), "VEC3", FLOAT32, VERTICES, min=low, max=high)}
    if mesh.normals is not None:
        attributes["NORMAL"] = chunk.array(mesh.normals.astype("<f4"), "VEC3", FLOAT32, VERTICES)
    codes, wanted = _codes(palette), _codes(mesh.colors)
    index = np.searchsorted(codes, wanted)  # np.unique sorts rows as the codes do
    uv = np.stack([index % side + 0.5, index // side + 0.5], -1) / side
    attributes["TEXCOORD_0"] = chunk.array(uv.astype("<f4"), "VEC2", FLOAT32, VERTICES)
    faces = chunk.array(mesh.faces.astype("<u4").ravel(), "SCALAR", UINT32, INDICES)
    return {"attributes": attributes, "indices": faces, "material": 0, "mode": 4}


def _node(node: GlbNode) -> dict[str, Any]:
    record = {
        "name": node.name,
        "mesh": node.mesh,
        "translation": np.asarray(node.pose[:3], np.float64).tolist(),
        "rotation": np.clip(normalized(np.asarray(node.pose[3:], np.float64)), -1, 1).tolist(),
        "scale": np.asarray(node.scale, np.float64).tolist(),
    }
    return {**record, "extras": dict(node.extras)} if node.extras else record


def _palette_png(palette: NDArray[np.uint8], side: int) -> bytes:
    import cv2

    texels = np.zeros((side * side, 3), np.uint8)
    texels[: len(palette)] = palette
    image = texels.reshape(side, side, 3).repeat(_BLOCK_PX, 0).repeat(_BLOCK_PX, 1)
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes()


def _codes(colors: NDArray[np.uint8]) -> NDArray[np.int64]:
    return colors.astype(np.int64) @ np.array([65536, 256, 1])


def _one_color_per_triangle(mesh: Mesh) -> Mesh:
    """The mesh with corners of their own for triangles whose corners differ in colour, in the mean colour."""
    corners = mesh.colors[mesh.faces]
    mixed = (corners != corners[:, :1]).any((1, 2))
    if not mixed.any():
        return mesh
    old = mesh.faces[mixed]
    mean = np.rint(corners[mixed].mean(1)).astype(np.uint8)
    faces = mesh.faces.copy()
    faces[mixed] = len(mesh.vertices) + np.arange(old.size, dtype=np.int32).reshape(-1, 3)
    normals = None if mesh.normals is None else np.concatenate([mesh.normals, mesh.normals[old.ravel()]])
    return Mesh(
        vertices=np.concatenate([mesh.vertices, mesh.vertices[old.ravel()]]),
        faces=faces,
        colors=np.concatenate([mesh.colors, np.repeat(mean, 3, axis=0)]),
        normals=normals,
    )


def _checked(mesh: Mesh) -> Mesh:
    faults = [
        what for what, values in (("vertices", mesh.vertices), ("normals", mesh.normals))
        if values is not None and not np.isfinite(values).all()
    ]  # fmt: skip
    if faults or not len(mesh.faces):
        what = f"{' and '.join(faults)} that are not finite" if faults else "no triangles"
        raise SceneError(f"A mesh with {what} cannot be written as GLB.")
    return mesh
