"""Conversion of collision shapes to FCL's geometry: scale, axes of round shapes, hulls with faces turned outwards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError, SceneError
from h3data.geometry import cross, pose_to_matrix
from h3data.kernels import kernel
from h3data.scene.records import Box, Capsule, Hull, Shape
from h3data.scene.shape_bounds import shape_corners

if TYPE_CHECKING:
    import fcl

Y_TO_Z = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Rotation from the z axis to the y axis, as the axis of cylinders and capsules is z in FCL and y in h3data."""


def fcl_geometry(shape: Shape, scale: ArrayLike = (1.0, 1.0, 1.0)) -> tuple[fcl.CollisionGeometry, NDArray[np.float64]]:
    """Return FCL's geometry of a shape in a frame scaled per axis [3], and the rigid [4, 4] transform to that frame.

    Boxes, cylinders and capsules stay primitives where the scale allows it, and become convex hulls otherwise (never
    triangle meshes, for which python-fcl's answers are wrong). Every call returns a new geometry, by which contacts
    name the shape.

    Raises:
        InputError: A scale is 0 or not finite.
        SceneError: The points of a hull are in one plane.
    """
    import fcl

    s = np.asarray(scale, np.float64)
    if s.shape != (3,) or not np.isfinite(s).all() or (s == 0).any():
        raise InputError(f"A scale must be three finite numbers other than 0, got {s}.", code="H3-SIM-030")
    # comparisons are written out: this runs for every shape of a home, and np.allclose costs many times as much
    even = bool((np.abs(np.abs(s) - abs(s[0])) <= 1e-6 * abs(s[0]) + 1e-8).all())
    factor = float(np.abs(s).max())
    if isinstance(shape, Capsule):  # uneven scale: the fattest radius, so that no contact is missed
        start, end = np.asarray(shape.start) * s, np.asarray(shape.end) * s
        length = float(np.linalg.norm(end - start))
        if length == 0:  # FCL has exact formulas for balls, and only iterations for capsules
            return fcl.Sphere(shape.radius * factor), capsule_transforms(start, end)
        return fcl.Capsule(shape.radius * factor, length), capsule_transforms(start, end) @ Y_TO_Z
    if isinstance(shape, Hull):
        return _convex(np.asarray(shape.points, np.float64) * s)
    matrix = pose_to_matrix(shape.pose).astype(np.float64)
    matrix[:3, 3] *= s
    # a box or cylinder B is its own mirror image, so D R B = (D R D) B for a mirror D, and D R D is a rotation
    mirror = np.sign(s)
    matrix[:3, :3] *= mirror[:, None] * mirror[None, :]
    if isinstance(shape, Box):
        straight = bool((np.abs(matrix[:3, :3] - np.eye(3)) <= 1e-5 * np.eye(3) + 1e-9).all())
        if even or straight:
            size = 2 * np.asarray(shape.half_extents, np.float64) * np.abs(s)
            return fcl.Box(*size.tolist()), matrix
    elif even:
        return fcl.Cylinder(shape.radius * factor, 2 * shape.half_height * factor), matrix @ Y_TO_Z
    return _convex(shape_corners(shape) * s)


def capsule_transforms(start: ArrayLike, end: ArrayLike) -> NDArray[np.float64]:
    """Return the 4x4 frames [..., 4, 4] midway between ``start`` and ``end`` [..., 3] with the y axis towards ``end``.

    They pose capsules made by `shapes_from_capsules` (and FCL's, after `Y_TO_Z`). Their rotation about y is arbitrary.
    """
    a, b = np.broadcast_arrays(np.asarray(start, np.float64), np.asarray(end, np.float64))
    frames = np.zeros((*a.shape[:-1], 4, 4))
    _align_axes(
        np.ascontiguousarray(a).reshape(-1, 3), np.ascontiguousarray(b).reshape(-1, 3), frames.reshape(-1, 4, 4)
    )
    return frames


@kernel(error_model="numpy")
def _align_axes(starts, ends, frames):
    """Fill frames [n, 4, 4] of zeros as `capsule_transforms` says, in a tenth of the time of NumPy's calls."""
    for n in range(len(frames)):
        a, b, frame = starts[n], ends[n], frames[n]
        x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = (0.0, 1.0, 0.0) if length == 0.0 else (x / length, y / length, z / length)
        # any axis that is not parallel to y will do; this choice keeps the cross product far from 0
        hx, hz = (1.0, 0.0) if abs(x) < 0.7 else (0.0, 1.0)
        ux, uy, uz = 0.0 * z - hz * y, hz * x - hx * z, hx * y - 0.0 * x
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / length, uy / length, uz / length
        frame[0, 0], frame[1, 0], frame[2, 0] = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
        frame[0, 1], frame[1, 1], frame[2, 1] = x, y, z
        frame[0, 2], frame[1, 2], frame[2, 2] = ux, uy, uz
        frame[0, 3], frame[1, 3], frame[2, 3] = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2
        frame[3, 3] = 1.0


def shapes_from_capsules(start: ArrayLike, end: ArrayLike, radius: ArrayLike) -> tuple[Capsule, ...]:
    """Return capsules along the y axis of their own frames, with the lengths of the segments ``start`` to ``end`` [n, 3].

    The capsules are for bodies in which they keep their lengths while they move: `MovingShapes` holds them, and
    ``set_transforms(capsule_transforms(start, end))`` poses them.
    """
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    r = np.broadcast_to(np.asarray(radius, np.float64), a.shape[:-1])
    half = np.linalg.norm(b - a, axis=-1) / 2
    up = np.array([0.0, 1.0, 0.0])
    return tuple(Capsule(start=-h * up, end=h * up, radius=float(q)) for h, q in zip(half, r, strict=True))


def _convex(points: NDArray[np.float64]) -> tuple[fcl.CollisionGeometry, NDArray[np.float64]]:
    """Return the hull of points [N, 3] as FCL's convex body and the identity, as `fcl_geometry` returns them."""
    import fcl
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError) as fault:
        raise SceneError(
            f"A hull needs at least four points that are not in one plane, got {len(points)}.", code="H3-SIM-031"
        ) from fault
    # points inside the hull are no corners of it
    used = np.unique(hull.simplices)
    vertices = np.ascontiguousarray(points[used])
    faces = np.searchsorted(used, hull.simplices)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    # scipy's triangles have no fixed order of corners; FCL takes them as counter-clockwise seen from outside
    inwards = np.einsum("ij,ij->i", cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    flat = np.concatenate([np.full((len(faces), 1), 3), faces], axis=1).ravel()  # each face: its count, its corners
    return fcl.Convex(vertices, len(faces), flat), np.eye(4)
