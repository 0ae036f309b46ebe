"""Meshes made of meshes: joined, painted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from h3data.scene.records import Mesh


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """All meshes (at least one) as one. Normals survive only if every part has them."""
    if len(meshes) == 1:
        return meshes[0]
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    normals = [m.normals for m in meshes if m.normals is not None]
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + np.int32(s) for m, s in zip(meshes, starts[:-1], strict=True)]),
        colors=np.concatenate([m.colors for m in meshes]),
        normals=np.concatenate(normals) if len(normals) == len(meshes) else None,
    )


def painted(mesh: Mesh, color: Sequence[int]) -> Mesh:
    """The same mesh in one sRGB colour 0..255."""
    colors = np.broadcast_to(np.asarray(color, np.uint8), mesh.vertices.shape).copy()
    return Mesh(vertices=mesh.vertices, faces=mesh.faces, colors=colors, normals=mesh.normals)
