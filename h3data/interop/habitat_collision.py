"""Collision parts of Habitat's objects: one convex hull per node and connected piece of a mesh, or a box."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.geometry import IDENTITY_QUAT
from h3data.interop.meshes import frame_rotation
from h3data.scene.records import Box, Hull, Mesh, Shape

MAX_PARTS = 64
"""An object of more pieces (a plant, a shelf with books) becomes one hull."""

_MIN_HALF_EXTENT_M = 1e-3
_WELD_M = 1e-5


def box_shape(points: NDArray[np.floating]) -> Box:
    """The box along the axes around points [N, 3]."""
    lo, hi = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
    return Box(
        pose=np.concatenate([(lo + hi) / 2, IDENTITY_QUAT]),
        half_extents=np.maximum((hi - lo) / 2, _MIN_HALF_EXTENT_M),
    )


def hull_shape(points: NDArray[np.floating]) -> Shape:
    """The convex hull of points [N, 3] (hollows are filled); a box if they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points.astype(np.float64))
    except (QhullError, ValueError):
        return box_shape(points)
    return Hull(points=points[hull.vertices].astype(np.float64))


def hull_shapes(nodes: Iterable[tuple[NDArray[np.floating], NDArray[np.integer]]]) -> tuple[Shape, ...]:
    """One hull per connected piece of each node, given as vertices [V, 3] and triangles [F, 3].

    Bullet makes one hull per node; a piece that is joined to no other inside its node is told apart here as well. More
    than 64 pieces give one hull per node, more than 64 nodes a single one.
    """
    given = [(vertices, faces) for vertices, faces in nodes if len(faces)]
    pieces = [piece for vertices, faces in given for piece in _pieces(vertices, faces)]
    if len(pieces) > MAX_PARTS:
        pieces = [vertices[np.unique(faces)] for vertices, faces in given]
    if len(pieces) > MAX_PARTS:
        pieces = [np.concatenate(pieces)]
    return tuple(hull_shape(piece) for piece in pieces)


def mesh_nodes(
    path: Path, *, up: Sequence[float], front: Sequence[float], units_m: float
) -> list[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Vertices and triangles of each node of a mesh file, in our frame and metres (as `load_mesh`, which joins them)."""
    import trimesh

    rotation = frame_rotation(up, front)
    try:
        scene = trimesh.load_scene(path, process=False)
        nodes = []
        for node in scene.graph.nodes_geometry:
            matrix, name = scene.graph[node]
            geometry = scene.geometry[name]
            if isinstance(geometry, trimesh.Trimesh):
                world = np.asarray(geometry.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
                nodes.append((world @ rotation.T * units_m, np.asarray(geometry.faces, np.int64).reshape(-1, 3)))
    except Exception as fault:  # trimesh raises whatever its loaders meet
        raise SceneError(f"Cannot read this mesh file ({type(fault).__name__}: {str(fault)[:120]}): {path}") from None
    if not all(np.isfinite(v).all() and (not len(f) or 0 <= f.min() <= f.max() < len(v)) for v, f in nodes):
        raise SceneError(f"A mesh with vertices that are not finite or do not exist: {path}")
    return nodes


def whole_mesh(mesh: Mesh) -> list[tuple[NDArray[np.float32], NDArray[np.int32]]]:
    """A mesh as a single node."""
    return [(mesh.vertices, mesh.faces)]


def _pieces(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> list[NDArray[np.floating]]:
    """Points of each set of triangles that hang together by corners at the same place."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    _, place = np.unique(np.round(np.asarray(vertices, np.float64) / _WELD_M), axis=0, return_inverse=True)
    corners = place.reshape(-1)[faces]
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    size = int(corners.max()) + 1
    _, label = connected_components(coo_matrix((np.ones(len(ends)), ends.T), shape=(size, size)), directed=False)
    piece = label[corners[:, 0]]
    found = np.unique(piece)
    if len(found) > 4 * MAX_PARTS:  # too many in any case: do not collect their points one by one
        return [vertices[np.unique(faces)]] * (MAX_PARTS + 1)
    return [vertices[np.unique(faces[piece == k])] for k in found]
