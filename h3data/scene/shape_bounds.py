"""Bounds of collision shapes: balls, capsules and boxes around them."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.geometry import pose_to_matrix, transform_points
from h3data.scene.records import Box, Capsule, Cylinder, Hull, Shape

PRISM_SIDES = 32
"""Number of sides of the prism that replaces a cylinder."""


def bounding_sphere(shape: Shape) -> tuple[NDArray[np.float64], float]:
    """Return centre [3] and radius [m] of a ball around a shape, in the shape's own frame."""
    if isinstance(shape, Capsule):
        a, b = np.asarray(shape.start, np.float64), np.asarray(shape.end, np.float64)
        return (a + b) / 2, float(np.linalg.norm(b - a) / 2 + shape.radius)
    if isinstance(shape, Hull):
        points = np.asarray(shape.points, np.float64)
        center = (points.min(0) + points.max(0)) / 2
        return center, float(np.linalg.norm(points - center, axis=1).max())
    center = np.asarray(shape.pose, np.float64)[:3]
    if isinstance(shape, Box):
        return center, float(np.linalg.norm(shape.half_extents))
    return center, float(np.hypot(shape.radius, shape.half_height))


def bounding_capsule(shape: Shape) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the ends [3] of the axis and the radius [m] of a capsule around a shape, in the shape's own frame.

    The axis is along the longest side of a box; the capsule of a hull is a ball.
    """
    if isinstance(shape, Capsule):
        return np.asarray(shape.start, np.float64), np.asarray(shape.end, np.float64), float(shape.radius)
    if isinstance(shape, Hull):
        center, radius = bounding_sphere(shape)
        return center, center, radius
    if isinstance(shape, Box):
        half = np.asarray(shape.half_extents, np.float64)
        # along one side only: of equal sides the first, so that the radius covers the other two
        axis = np.where(np.arange(3) == np.argmax(half), half, 0.0)
        radius = float(np.linalg.norm(half - axis))
    else:
        axis, radius = np.array([0.0, shape.half_height, 0.0]), float(shape.radius)
    start, end = transform_points(pose_to_matrix(np.asarray(shape.pose, np.float64)), np.stack([-axis, axis]))
    return start, end, radius


def shape_bounds(shape: Shape, matrix: ArrayLike) -> NDArray[np.float64]:
    """Return lower and upper corner [2, 3] [m] of a shape under a 4x4 matrix, which may scale it.

    The bounds are tight for boxes and hulls, and for round shapes with the same scale along all axes.
    """
    m = np.asarray(matrix, np.float64)
    if isinstance(shape, Capsule):
        points, margin = np.stack([shape.start, shape.end]), np.linalg.norm(m[:3, :3], axis=1) * shape.radius
    elif isinstance(shape, Hull):
        points, margin = np.asarray(shape.points), np.zeros(3)
    elif isinstance(shape, Box):
        points, margin = shape_corners(shape), np.zeros(3)
    else:
        m = m @ pose_to_matrix(np.asarray(shape.pose, np.float64))
        points = np.array([[0.0, -shape.half_height, 0.0], [0.0, shape.half_height, 0.0]])
        margin = np.hypot(m[:3, 0], m[:3, 2]) * shape.radius  # of the disc across its axis
    world = transform_points(m, points)
    return np.stack([world.min(0) - margin, world.max(0) + margin])


def shape_corners(shape: Box | Cylinder | Hull) -> NDArray[np.float64]:
    """Return points [N, 3] [m] in the asset's frame whose hull is the shape, or for a cylinder a prism around it."""
    if isinstance(shape, Hull):
        return np.asarray(shape.points, np.float64)
    if isinstance(shape, Box):
        local = np.array(list(product((-1.0, 1.0), repeat=3))) * np.asarray(shape.half_extents, np.float64)
    else:
        angle = np.arange(PRISM_SIDES) * (2 * np.pi / PRISM_SIDES)
        ring = np.stack([np.cos(angle), np.zeros(PRISM_SIDES), np.sin(angle)], -1)
        # the sides touch the circle and the corners lie outside, so that the prism never lets through what the cylinder stops
        ring *= shape.radius / np.cos(np.pi / PRISM_SIDES)
        half = np.array([0.0, shape.half_height, 0.0])
        local = np.concatenate([ring - half, ring + half])
    return transform_points(pose_to_matrix(np.asarray(shape.pose, np.float64)), local).astype(np.float64)
