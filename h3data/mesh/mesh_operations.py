"""Operations on meshes: joining, colouring, moving, flat shading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, normalized
from h3data.mesh.mesh import Mesh, Texture


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes (at least one) into one.

    The result has normals only if every part has them; textures are always included.
    """
    if len(meshes) == 1:
        return meshes[0]
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    normals = [m.normals for m in meshes if m.normals is not None]
    # by identity and in the order of first use: meshes share textures as objects
    textures = tuple({id(t): t for m in meshes for t in m.textures}.values())
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + np.int32(s) for m, s in zip(meshes, starts[:-1], strict=True)]),
        colors=np.concatenate([m.colors for m in meshes]),
        normals=np.concatenate(normals) if len(normals) == len(meshes) else None,
        uv=np.concatenate([np.zeros((len(m.vertices), 2), np.float32) if m.uv is None else m.uv for m in meshes])
        if textures
        else None,
        textures=textures,
        face_textures=np.concatenate([_face_textures(m, textures) for m in meshes]) if textures else None,
    )


def _face_textures(mesh: Mesh, textures: Sequence[Texture]) -> NDArray[np.int16]:
    """Return the texture of each triangle as an index into ``textures``, shape [F]."""
    place = {id(t): k for k, t in enumerate(textures)}
    index = np.array([place[id(t)] for t in mesh.textures] + [-1], np.int16)  # index -1 finds the last: no texture
    return index[face_texture_indices(mesh)]


def face_texture_indices(mesh: Mesh) -> NDArray[np.int16]:
    """Return the texture of each triangle as an index into the mesh's ``textures``, -1 = none, shape [F]."""
    if mesh.face_textures is not None:
        return mesh.face_textures
    return np.full(len(mesh.faces), 0 if mesh.textures else -1, np.int16)


def flat_shaded(mesh: Mesh) -> Mesh:
    """Return the mesh with separate corners for each triangle, which have its face normal."""
    corners = mesh.faces.ravel()
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).swapaxes(0, 1)
    normals = normalized(np.cross(b - a, c - a)).astype(np.float32)
    return Mesh(
        vertices=mesh.vertices[corners],
        faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
        colors=mesh.colors[corners],
        normals=np.repeat(normals, 3, axis=0),
        uv=None if mesh.uv is None else mesh.uv[corners],
        textures=mesh.textures,
        face_textures=mesh.face_textures,
    )


def painted(mesh: Mesh, color: Sequence[int]) -> Mesh:
    """Return the mesh in a single sRGB colour, 0 to 255, without its textures."""
    colors = np.broadcast_to(np.asarray(color, np.uint8), mesh.vertices.shape).copy()
    return Mesh(vertices=mesh.vertices, faces=mesh.faces, colors=colors, normals=mesh.normals)


def moved(mesh: Mesh, matrix: Array, scale: Sequence[float] = (1.0, 1.0, 1.0)) -> Mesh:
    """Return the mesh scaled along its own axes and then moved by a rigid matrix [4, 4]."""
    stretch = np.asarray(scale, np.float64)
    rotation = matrix[:3, :3]
    normals = mesh.normals
    if normals is not None:
        # the inverse transpose of a scale divides
        normals = normalized((normals / stretch) @ rotation.T).astype(np.float32)
    # an odd number of mirrors turns the surface inside out
    faces = mesh.faces if np.prod(stretch) > 0 else mesh.faces[:, ::-1]
    vertices = (mesh.vertices * stretch) @ rotation.T + matrix[:3, 3]
    return replace(mesh, vertices=vertices.astype(np.float32), faces=np.ascontiguousarray(faces), normals=normals)
