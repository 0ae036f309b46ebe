"""Collision parts as closed meshes for Habitat's collider files, and assets with the scale of an instance applied."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.geometry import normalized, pose_to_matrix, transform_points
from h3data.mesh.mesh import Mesh
from h3data.scene.records import Asset, Box, Capsule, Cylinder, Hull, Receptacle, Shape

CYLINDER_SIDES = 24
"""Number of sides of the prism around a cylinder (0.9 % of the radius too large at its corners)."""
_BALL_RINGS = 5
_GREY = 160


def part_mesh(shape: Shape) -> Mesh:
    """Return the surface of a convex part as one closed mesh in the asset's frame, counter-clockwise from outside."""
    from scipy.spatial import ConvexHull, QhullError

    points = part_points(shape)
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError) as fault:
        raise SceneError(
            f"A collision part of {len(points)} points has no volume, so it cannot be written.", code="H3-HABITAT-111"
        ) from fault
    used = np.unique(hull.simplices)
    vertices, faces = points[used], np.searchsorted(used, hull.simplices)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    # SciPy does not turn the triangles of a hull in one direction
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return Mesh(
        vertices=vertices.astype(np.float32),
        faces=faces.astype(np.int32),
        colors=np.full(vertices.shape, _GREY, np.uint8),
    )


def part_points(shape: Shape) -> NDArray[np.float64]:
    """Return points [N, 3] in the asset's frame whose hull is the part; round parts are enclosed by a polyhedron."""
    if isinstance(shape, Hull):
        return np.asarray(shape.points, np.float64)
    if isinstance(shape, Capsule):
        ball = _ball() * shape.radius
        return np.concatenate([ball + np.asarray(end, np.float64) for end in (shape.start, shape.end)])
    if isinstance(shape, Box):
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
        local = signs * np.asarray(shape.half_extents, np.float64)
    else:
        # the sides of the prism touch the cylinder from outside
        ring = _ring(CYLINDER_SIDES) * (shape.radius / np.cos(np.pi / CYLINDER_SIDES))
        lift = np.array([0.0, shape.half_height, 0.0])
        local = np.concatenate([ring - lift, ring + lift])
    return transform_points(pose_to_matrix(np.asarray(shape.pose, np.float64)), local).astype(np.float64)


def scaled_asset(asset: Asset, scale: NDArray[np.float64]) -> Asset:
    """Return the asset in the size of an instance: mesh, parts and receptacles scaled per axis [3]; itself for scale 1.

    habitat-lab does not scale the receptacles of rigid objects, and Bullet does not mirror collision parts.
    """
    s = np.asarray(scale, np.float64)
    if np.all(s == 1):
        return asset
    mesh = asset.mesh
    # normals scale by the inverse
    normals = None if mesh.normals is None else normalized(mesh.normals / s).astype(np.float32)
    # a mirror image is inside out
    faces = mesh.faces if np.prod(s) > 0 else np.ascontiguousarray(mesh.faces[:, ::-1])
    return replace(
        asset,
        mesh=Mesh(vertices=(mesh.vertices * s).astype(np.float32), faces=faces, colors=mesh.colors, normals=normals),
        shapes=tuple(_scaled_part(p, s) for p in asset.shapes),
        receptacles=tuple(_scaled_receptacle(r, s) for r in asset.receptacles if s[1] > 0),
    )


def _scaled_part(shape: Shape, s: NDArray[np.float64]) -> Shape:
    # stretched boxes and cylinders that are turned are none any more
    even = bool(np.all(s == s[0]) and s[0] > 0)
    if even and isinstance(shape, Box | Cylinder):
        pose = np.concatenate([np.asarray(shape.pose, np.float64)[:3] * s, np.asarray(shape.pose, np.float64)[3:]])
        if isinstance(shape, Box):
            return Box(pose=pose, half_extents=np.asarray(shape.half_extents) * s[0])
        return Cylinder(pose=pose, radius=shape.radius * float(s[0]), half_height=shape.half_height * float(s[0]))
    return Hull(points=part_points(shape) * s)


def _scaled_receptacle(receptacle: Receptacle, s: NDArray[np.float64]) -> Receptacle:
    return Receptacle(
        name=receptacle.name,
        center=np.asarray(receptacle.center, np.float64) * s,
        half_size=np.asarray(receptacle.half_size, np.float64) * np.abs(s[[0, 2]]),
        clearance_m=receptacle.clearance_m * float(abs(s[1])),
    )


def _ring(sides: int) -> NDArray[np.float64]:
    angle = np.arange(sides) * (2 * np.pi / sides)
    return np.stack([np.cos(angle), np.zeros(sides), np.sin(angle)], -1)


def _ball() -> NDArray[np.float64]:
    """Return points [N, 3] whose hull encloses the unit ball."""
    from scipy.spatial import ConvexHull

    polar = np.arange(1, 2 * _BALL_RINGS) * (np.pi / (2 * _BALL_RINGS))
    rings = [_ring(4 * _BALL_RINGS) * np.sin(a) + [0, np.cos(a), 0] for a in polar]
    points = np.concatenate([np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]), *rings])
    return points / np.abs(ConvexHull(points).equations[:, 3]).min()  # the nearest face touches the ball
