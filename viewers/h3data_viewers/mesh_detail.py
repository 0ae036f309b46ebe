"""Meshes light enough for a viewer file: fewer vertices by clustering, facets for meshes without normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.scene.records import Mesh


@dataclass(frozen=True, kw_only=True, eq=False)
class ThinMesh:
    """A subset of a mesh's vertices, and triangles between them."""

    keep: NDArray[np.int64]
    """Indices of the kept vertices in the full mesh, shape [K]: also thins any later positions of the same vertices."""
    faces: NDArray[np.int32]
    """Indices into ``keep``, shape [F, 3]."""


def thin_mesh(mesh: Mesh, max_vertices: int) -> ThinMesh:
    """At most ``max_vertices`` vertices that represent the mesh: one per cell of a grid, by bisection of the cell size.

    A mesh that is small enough stays as it is. Kept vertices are original ones, so a skinned mesh thinned in its rest
    pose stays valid in every pose.
    """
    count = len(mesh.vertices)
    if count <= max_vertices or count == 0:
        return ThinMesh(keep=np.arange(count), faces=mesh.faces)
    lo, hi = mesh.bounds
    fine, coarse = 0.0, float((hi - lo).max()) + 1e-6
    best = _cluster(mesh, lo, coarse)
    for _ in range(14):
        size = (fine + coarse) / 2
        cells = _cluster(mesh, lo, size)
        if cells.max() < max_vertices:
            best, coarse = cells, size
        else:
            fine = size
    _, keep = np.unique(best, return_index=True)
    faces = best[mesh.faces].astype(np.int32)
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return ThinMesh(keep=keep, faces=faces[whole])


def _cluster(mesh: Mesh, origin: NDArray[np.float32], size: float) -> NDArray[np.int64]:
    """Number of the occupied grid cell of each vertex, 0..cells-1, shape [V]."""
    cell = np.floor((mesh.vertices - origin) / size).astype(np.int64)
    cell = np.minimum(cell, (1 << 20) - 1)
    key = (cell[:, 0] << 40) | (cell[:, 1] << 20) | cell[:, 2]
    return np.unique(key, return_inverse=True)[1].reshape(-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewMesh:
    """Arrays as the viewer wants them."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32] | None
    """None: every three vertices are a triangle of their own, which the viewer shades flat."""
    colors: NDArray[np.uint8]
    normals: NDArray[np.float32] | None

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays, colours with alpha."""
        faces = 0 if self.faces is None else self.faces.nbytes
        return (
            4 * len(self.colors) + self.vertices.nbytes + faces + (0 if self.normals is None else self.normals.nbytes)
        )


def view_mesh(mesh: Mesh, *, max_vertices: int | None = None) -> ViewMesh:
    """A mesh for the viewer, thinned if asked; flat facets where the mesh has no normals, as the mesh record says."""
    thin = thin_mesh(mesh, max_vertices) if max_vertices is not None else None
    if thin is not None and len(thin.keep) < len(mesh.vertices):
        normals = None if mesh.normals is None else mesh.normals[thin.keep]
        return ViewMesh(
            vertices=mesh.vertices[thin.keep], faces=thin.faces, colors=mesh.colors[thin.keep], normals=normals
        )
    if mesh.normals is None:
        corners = mesh.faces.reshape(-1)
        return ViewMesh(vertices=mesh.vertices[corners], faces=None, colors=mesh.colors[corners], normals=None)
    return ViewMesh(vertices=mesh.vertices, faces=mesh.faces, colors=mesh.colors, normals=mesh.normals)
