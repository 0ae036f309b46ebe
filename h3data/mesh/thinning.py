"""Meshes of fewer vertices: one per occupied cell of a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.mesh.mesh import Mesh


@dataclass(frozen=True, kw_only=True, eq=False)
class ThinMesh:
    """Thinned mesh: a subset of a mesh's vertices and the triangles between them."""

    keep: NDArray[np.int64]
    """Indices of the remaining vertices in the full mesh, shape [K]; they can be used for all poses of the mesh."""
    faces: NDArray[np.int32]
    """Indices into ``keep``, shape [F, 3]."""


def thin_mesh(mesh: Mesh, max_vertices: int) -> ThinMesh:
    """Thin a mesh to at most ``max_vertices`` vertices: one per occupied cell of a grid, whose size is bisected.

    A mesh that is small enough is unchanged. The remaining vertices are original ones rather than cell averages, so a
    skinned mesh thinned in its rest pose is valid in every pose.
    """
    count = len(mesh.vertices)
    if count <= max_vertices or count == 0:
        return ThinMesh(keep=np.arange(count), faces=mesh.faces)
    lo, hi = mesh.bounds
    fine, coarse = 0.0, float((hi - lo).max()) + 1e-6
    best = _cluster(mesh, lo, coarse)
    # 14 halvings leave a 16,000th of the mesh's size, after which the number of cells hardly changes
    for _ in range(14):
        size = (fine + coarse) / 2
        cells = _cluster(mesh, lo, size)
        if cells.max() < max_vertices:
            best, coarse = cells, size
        else:
            fine = size
    _, keep = np.unique(best, return_index=True)
    faces = best[mesh.faces].astype(np.int32)
    collapsed = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return ThinMesh(keep=keep, faces=faces[~collapsed])


def _cluster(mesh: Mesh, origin: NDArray[np.float32], size: float) -> NDArray[np.int64]:
    """Return the index of each vertex's grid cell among the occupied cells, shape [V]."""
    cell = np.floor((mesh.vertices - origin) / size).astype(np.int64)
    # 20 bits for each axis in one key of 64
    cell = np.minimum(cell, (1 << 20) - 1)
    key = (cell[:, 0] << 40) | (cell[:, 1] << 20) | cell[:, 2]
    return np.unique(key, return_inverse=True)[1].reshape(-1)
