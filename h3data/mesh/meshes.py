"""Meshes made of meshes: joined, painted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.mesh.records import Mesh, Texture


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """All meshes (at least one) as one. Normals survive only if every part has them; textures always do."""
    if len(meshes) == 1:
        return meshes[0]
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    normals = [m.normals for m in meshes if m.normals is not None]
    textures = tuple({id(t): t for m in meshes for t in m.textures}.values())
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + np.int32(s) for m, s in zip(meshes, starts[:-1], strict=True)]),
        colors=np.concatenate([m.colors for m in meshes]),
        normals=np.concatenate(normals) if len(normals) == len(meshes) else None,
        uv=np.concatenate([_uv(m) for m in meshes]) if textures else None,
        textures=textures,
        face_textures=np.concatenate([_face_textures(m, textures) for m in meshes]) if textures else None,
    )


def _uv(mesh: Mesh) -> NDArray[np.float32]:
    return np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uv is None else mesh.uv


def _face_textures(mesh: Mesh, textures: Sequence[Texture]) -> NDArray[np.int16]:
    """The mesh's texture of each triangle as an index into ``textures``."""
    place = {id(t): k for k, t in enumerate(textures)}
    index = np.array([place[id(t)] for t in mesh.textures] + [-1], np.int16)  # the last one answers -1
    return index[face_texture_indices(mesh)]


def face_texture_indices(mesh: Mesh) -> NDArray[np.int16]:
    """The texture of each triangle as an index into the mesh's ``textures``, -1 = none, shape [F]."""
    if mesh.face_textures is not None:
        return mesh.face_textures
    return np.full(len(mesh.faces), 0 if mesh.textures else -1, np.int16)


def painted(mesh: Mesh, color: Sequence[int]) -> Mesh:
    """The same mesh in one sRGB colour 0..255, without its textures."""
    colors = np.broadcast_to(np.asarray(color, np.uint8), mesh.vertices.shape).copy()
    return Mesh(vertices=mesh.vertices, faces=mesh.faces, colors=colors, normals=mesh.normals)
