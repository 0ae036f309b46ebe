"""Convex solids with bevels for machine parts: every one is the hull of some points, shaded smooth below a crease angle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from h3data.geometry import Array, normalized
from h3data.mesh.mesh import Mesh

Color = tuple[int, int, int]
CREASE_DEG = 32.0


def box_points(size: Sequence[float], *, bevel: float, center: Sequence[float] = (0, 0, 0)) -> Array:
    """Return the 24 corners of a box with bevelled edges [24, 3]."""
    half = np.asarray(size, np.float64) / 2
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    corners = [signs * (half - bevel * (1 - np.eye(3)[axis])) for axis in range(3)]
    return np.concatenate(corners) + np.asarray(center)


def disc_points(
    radius: float,
    thickness: float,
    *,
    axis: int,
    center: Sequence[float] = (0, 0, 0),
    bevel: float = 0.006,
    sides: int = 18,
) -> Array:
    """Return a bevelled disc (short cylinder) about a coordinate axis [4 sides, 3]."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rows = []
    for r, h in ((radius - bevel, thickness / 2), (radius, thickness / 2 - bevel)):
        for sign in (-1, 1):
            row = np.full((sides, 3), sign * h)
            row[:, [(axis + 1) % 3, (axis + 2) % 3]] = ring * r
            rows.append(row)
    return np.concatenate(rows) + np.asarray(center)


def ball_points(radius: float, *, center: Sequence[float] = (0, 0, 0), sides: int = 12) -> Array:
    """Return a sphere of rings [N, 3]."""
    v, u = np.meshgrid(np.linspace(0, np.pi, sides // 2 + 1), np.linspace(0, 2 * np.pi, sides, endpoint=False))
    ball = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    return radius * np.unique(np.round(ball, 9), axis=0) + np.asarray(center)


def solid(points: Sequence[Array] | Array, color: Color) -> Mesh:
    """Return the convex hull of all points, smooth where faces meet at less than `CREASE_DEG`."""
    from scipy.spatial import ConvexHull

    cloud = points if isinstance(points, np.ndarray) else np.concatenate(list(points))
    hull = ConvexHull(cloud)
    a, b, c = (cloud[hull.simplices[:, k]] for k in range(3))
    flip = np.sum(np.cross(b - a, c - a) * hull.equations[:, :3], axis=1) < 0
    faces = np.where(flip[:, None], hull.simplices[:, ::-1], hull.simplices)
    return creased(cloud, faces, color)


def creased(vertices: Array, faces: np.ndarray, color: Color) -> Mesh:
    """Return a mesh with corner normals averaged over faces that differ by less than `CREASE_DEG`."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    unit = normalized(cross)
    corners = []
    for vertex in np.unique(faces):
        around = np.nonzero((faces == vertex).any(axis=1))[0]
        near = unit[around] @ unit[around].T > np.cos(np.radians(CREASE_DEG))
        normals = normalized(near @ cross[around])
        for face, normal in zip(around, normals, strict=True):
            corners.append((face, int(np.nonzero(faces[face] == vertex)[0][0]), vertex, *np.round(normal, 4)))
    table = np.array(corners)
    unique, inverse = np.unique(table[:, 2:], axis=0, return_inverse=True)
    out = np.zeros(faces.shape, np.int32)
    out[table[:, 0].astype(int), table[:, 1].astype(int)] = inverse.ravel()
    return Mesh(
        vertices=vertices[unique[:, 0].astype(int)].astype(np.float32),
        faces=out,
        colors=np.tile(np.array(color, np.uint8), (len(unique), 1)),
        normals=normalized(unique[:, 1:]).astype(np.float32),
    )
