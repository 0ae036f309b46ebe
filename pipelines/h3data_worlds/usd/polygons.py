"""Triangulation of polygons by fans if possible, or else by ear clipping."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array

MAX_CORNERS = 1000
"""Largest number of corners of a polygon that no fan fits."""


def triangles_of(
    points: Array, counts: NDArray[np.int64], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return triangles [F, 3] of polygons as positions in ``indices``, and the polygon of each [F].

    Args:
        points: Vertices [N, 3].
        counts: Number of corners of each polygon, shape [P].
        indices: Vertex index of each corner, shape [sum of counts].

    Raises:
        ValueError: a polygon that no fan fits has more than `MAX_CORNERS` corners.
    """
    starts = np.cumsum(counts) - counts
    each = np.maximum(counts - 2, 0)
    first_row = np.cumsum(each) - each
    face_of = np.repeat(np.arange(len(counts)), each)
    step = np.arange(len(face_of)) - first_row[face_of]
    first = starts[face_of]
    corners = np.stack([first, first + step + 1, first + step + 2], -1)
    place = np.asarray(points, np.float64)[indices]
    a, b, c = (place[corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    total = np.zeros((len(counts), 3))
    np.add.at(total, face_of, normal)
    along = (normal * total[face_of]).sum(1)
    against = along < -1e-6 * (total[face_of] ** 2).sum(1)
    for face in np.unique(face_of[against]).tolist():
        if counts[face] > MAX_CORNERS:
            raise ValueError(f"a concave face has {counts[face]} corners, the limit is {MAX_CORNERS}")
        here = slice(starts[face], starts[face] + counts[face])
        rows = slice(first_row[face], first_row[face] + each[face])
        corners[rows] = starts[face] + _ears(place[here], total[face])
    return corners, face_of


def _ears(points: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return triangles [N - 2, 3] of one polygon [N, 3], by cutting off ears: convex corners with no other corner inside."""
    side = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axes = np.stack([side, np.cross(normal, side) / np.linalg.norm(normal)], -1)
    flat = np.asarray(points @ axes, np.float64)
    left, out = list(range(len(points))), []
    while len(left) > 3:
        k = next((k for k in range(len(left)) if _is_ear(flat[np.array(left)], k)), 0)  # 0: the rest has no area
        out.append([left[k - 1], left[k], left[(k + 1) % len(left)]])
        del left[k]
    return np.array([*out, left], np.int64)


def _is_ear(flat: NDArray[np.float64], k: int) -> bool:
    """Return whether corner ``k`` of a counter-clockwise polygon [N, 2] can be cut off."""
    triangle = np.stack([flat[k - 1], flat[k], flat[(k + 1) % len(flat)]])
    if _turn(triangle[0], triangle[1], triangle[2][None])[0] <= 0:
        return False
    elsewhere = flat[(flat[:, None] != triangle).any(-1).all(-1)]  # a corner at the same place is not inside
    turns = [_turn(triangle[i], triangle[(i + 1) % 3], elsewhere) for i in range(3)]
    return not (np.min(turns, axis=0) >= 0).any() if len(elsewhere) else True


def _turn(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return twice the signed area of triangles a, b, c [N, 2]; positive if they are counter-clockwise."""
    return (b[0] - a[0]) * (c[:, 1] - a[1]) - (b[1] - a[1]) * (c[:, 0] - a[0])
