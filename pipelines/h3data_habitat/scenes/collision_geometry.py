"""Collision parts of Habitat's objects: one convex hull per part and connected piece of a mesh, or a box."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import IDENTITY_QUAT
from h3data.mesh.mesh import Mesh
from h3data.scene.records import Box, Hull, Shape

MAX_PARTS = 64
"""Largest number of pieces of an object; one with more (a plant, a shelf with books) becomes one hull."""

_MIN_HALF_EXTENT_M = 1e-3
_WELD_M = 1e-5


def box_shape(points: NDArray[np.floating]) -> Box:
    """Return the box along the axes around points [N, 3]."""
    lo, hi = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
    return Box(
        pose=np.concatenate([(lo + hi) / 2, IDENTITY_QUAT]),
        half_extents=np.maximum((hi - lo) / 2, _MIN_HALF_EXTENT_M),
    )


def hull_shape(points: NDArray[np.floating]) -> Shape:
    """Return the convex hull of points [N, 3] (hollows are filled); a box if they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points.astype(np.float64))
    except (QhullError, ValueError):
        return box_shape(points)
    return Hull(points=points[hull.vertices].astype(np.float64))


def hull_shapes(parts: Iterable[Mesh]) -> tuple[Shape, ...]:
    """Return one hull per connected piece of each part of an object (`load_parts`).

    Bullet makes one hull per part; a piece that is joined to no other inside its part is separated here as well. More
    than 64 pieces give one hull per part, more than 64 parts a single one.
    """
    given = [part for part in parts if len(part.faces)]
    pieces = [piece for part in given for piece in _pieces(part.vertices, part.faces)]
    if len(pieces) > MAX_PARTS:
        pieces = [part.vertices[np.unique(part.faces)] for part in given]
    if len(pieces) > MAX_PARTS:
        pieces = [np.concatenate(pieces)]
    return tuple(hull_shape(piece) for piece in pieces)


def _pieces(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> list[NDArray[np.floating]]:
    """Return points of each set of triangles that hang together by corners at the same place."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    # vertices are doubled along seams of texture, so pieces hang together by place, not by index
    _, place = np.unique(np.round(np.asarray(vertices, np.float64) / _WELD_M), axis=0, return_inverse=True)
    corners = place.reshape(-1)[faces]
    # two sides of a triangle join its three corners
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    size = int(corners.max()) + 1
    _, label = connected_components(coo_matrix((np.ones(len(ends)), ends.T), shape=(size, size)), directed=False)
    piece = label[corners[:, 0]]
    found = np.unique(piece)
    if len(found) > 4 * MAX_PARTS:  # too many in any case: do not collect their points one by one
        return [vertices[np.unique(faces)]] * (MAX_PARTS + 1)
    return [vertices[np.unique(faces[piece == k])] for k in found]
