"""Collision shapes of a stage: prims with `UsdPhysics.CollisionAPI` as convex parts of an asset."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import IDENTITY_QUAT, Array, pose_from_matrix, transform_points
from h3data.mesh.mesh import Mesh
from h3data.scene.records import Box, Capsule, Cylinder, Hull, Shape
from h3data_worlds.shape_points import shape_points
from h3data_worlds.usd.stages import OpenStage, pxr
from h3data_worlds.usd.surfaces import prim_axis, prim_size

MAX_PIECES = 64
"""Largest number of connected pieces of a mesh with one hull each; a mesh with more gets a single hull."""
HALF_MIN_M = 1e-3
"""Least half extent of a box around flat objects [m]."""
_WELD_M = 1e-5
_SQUARE = 1e-6
"""Largest difference of scales, and of axes from right angles, that counts as rounding."""


def is_collider(prim: Any) -> bool:
    """Return whether a prim has collisions enabled."""
    physics = pxr("UsdPhysics")
    return prim.HasAPI(physics.CollisionAPI) and physics.CollisionAPI(prim).GetCollisionEnabledAttr().Get() is not False


def collider_shapes(
    opened: OpenStage, prim: Any, mesh: Mesh | None, matrix: NDArray[np.float64], *, moves: bool
) -> list[Shape]:
    """Return the shapes of a collider in the frame of its asset.

    Args:
        opened: Open stage.
        prim: A prim with `UsdPhysics.CollisionAPI`.
        mesh: Mesh of the prim, in the prim's frame.
        matrix: Transform from the prim's frame to that of the asset, both +Y up, in metres; it may scale.
        moves: True for bodies that move, whose triangles are never exact colliders.
    """
    kind = prim.GetTypeName()
    try:
        if kind == "Cube":
            half = prim_size(prim, "size", 2.0) * opened.metres / 2
            return [_box(matrix, np.full(3, half))]
        if kind in ("Sphere", "Capsule"):
            radius = prim_size(prim, "radius", 1.0 if kind == "Sphere" else 0.5) * opened.metres
            reach = 0.0 if kind == "Sphere" else prim_size(prim, "height", 1.0, least=0.0) / 2
            end = opened.points(prim_axis(prim)[None] * reach)[0]
            return [_swept(matrix, Capsule(start=-end, end=end, radius=radius))]
        if kind == "Cylinder":
            radius, half = prim_size(prim, "radius", 1.0), prim_size(prim, "height", 2.0) / 2
            axis = opened.directions(prim_axis(prim)[None])[0]
            return [_cylinder(matrix, axis, radius * opened.metres, half * opened.metres)]
    except ValueError:
        return []
    if mesh is None or not len(mesh.faces):
        return []
    approximation = str(prim.GetAttribute("physics:approximation").Get() or "none")
    points = transform_points(matrix, mesh.vertices.astype(np.float64))
    if approximation == "boundingCube":
        return [box_around(points)]
    if approximation in ("convexHull", "boundingSphere"):
        return [hull_around(points)]
    if approximation == "convexDecomposition" or moves:
        return hulls_of(points, mesh.faces)
    return []  # exact triangles, which free space reads from the mesh


def hulls_of(points: Array, faces: NDArray[np.int32]) -> list[Shape]:
    """Return the convex hull of each connected piece of a mesh, or one hull of all if there are many."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    # exporters write a vertex once for each face, for normals and UV: unwelded, every triangle would be a piece
    _, vertex = np.unique(np.round(points / _WELD_M).astype(np.int64), axis=0, return_inverse=True)
    vertex = vertex.ravel()
    edges = vertex[faces[:, [0, 1, 1, 2]]].reshape(-1, 2)
    n = int(vertex.max()) + 1
    links = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(n, n))
    count, piece = connected_components(links, directed=False)
    used = np.unique(vertex[faces])
    if count > MAX_PIECES:
        return [hull_around(points[faces.ravel()])]
    return [hull_around(points[piece[vertex] == k]) for k in np.unique(piece[used])]


def hull_around(points: Array) -> Shape:
    """Return the convex hull of points [N, 3], or a box if they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return Hull(points=np.asarray(points[ConvexHull(points).vertices], np.float64))
    except (QhullError, ValueError):
        return box_around(points)


def box_around(points: Array) -> Box:
    """Return the axis-aligned box around points [N, 3]."""
    low, high = np.asarray(points.min(0), np.float64), np.asarray(points.max(0), np.float64)
    pose = np.concatenate([(low + high) / 2, IDENTITY_QUAT])
    return Box(pose=pose, half_extents=np.maximum((high - low) / 2, HALF_MIN_M))


def _box(matrix: NDArray[np.float64], half: NDArray[np.float64]) -> Shape:
    frame = _rigid(matrix)
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    if frame is None:
        return hull_around(transform_points(matrix, corner))
    turn, scale = frame
    return Box(pose=np.asarray(pose_from_matrix(turn), np.float64), half_extents=np.maximum(half * scale, HALF_MIN_M))


def _swept(matrix: NDArray[np.float64], shape: Capsule) -> Shape:
    frame = _rigid(matrix)
    # scaled unevenly, a sphere is an ellipsoid, for which there is no shape
    if frame is None or np.ptp(frame[1]) > _SQUARE * frame[1].max():
        return hull_around(transform_points(matrix, shape_points(shape)))
    start, end = transform_points(matrix, np.stack([shape.start, shape.end]))
    return Capsule(start=start, end=end, radius=shape.radius * float(frame[1][0]))


def _cylinder(matrix: NDArray[np.float64], axis: NDArray[np.float64], radius: float, half: float) -> Shape:
    k = int(np.argmax(np.abs(axis)))
    turn = np.eye(4)  # columns: another axis, the cylinder's, the third
    turn[:3, :3] = np.eye(3)[:, [(k + 2) % 3, k, (k + 1) % 3]]
    matrix = matrix @ turn if k != 1 else matrix
    frame = _rigid(matrix)
    identity = np.concatenate([np.zeros(3), IDENTITY_QUAT])
    if frame is None or abs(frame[1][0] - frame[1][2]) > _SQUARE * frame[1].max():
        local = shape_points(Cylinder(pose=identity, radius=radius, half_height=half))
        return hull_around(transform_points(matrix, local))
    pose, scale = np.asarray(pose_from_matrix(frame[0]), np.float64), frame[1]
    return Cylinder(pose=pose, radius=radius * float(scale[0]), half_height=half * float(scale[1]))


def _rigid(matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the rigid part [4, 4] of a matrix and its scale per axis [3]; None if its axes are not square to each other."""
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    if not scale.all():
        return None
    turn = matrix.copy()
    turn[:3, :3] /= scale
    if np.abs(turn[:3, :3].T @ turn[:3, :3] - np.eye(3)).max() > _SQUARE:
        return None
    if np.linalg.det(turn[:3, :3]) < 0:  # the shapes are their own mirror images
        turn[:3, 2] *= -1
    return turn, scale
