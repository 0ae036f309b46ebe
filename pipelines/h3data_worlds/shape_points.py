"""Sample points on collision shapes."""

from __future__ import annotations

import numpy as np

from h3data.geometry import Array, pose_to_matrix, transform_points
from h3data.scene.records import Box, Cylinder, Hull, Shape
from h3data.scene.shape_bounds import PRISM_SIDES, shape_corners


def shape_points(shape: Shape) -> Array:
    """Return points [N, 3] [m] on a shape in its own frame: all corners, and points around its round parts."""
    if isinstance(shape, Hull):
        return np.asarray(shape.points, np.float64)
    if isinstance(shape, Box):
        return shape_corners(shape)
    angle = np.arange(PRISM_SIDES) * (2 * np.pi / PRISM_SIDES)
    ring = np.stack([np.cos(angle), np.zeros(PRISM_SIDES), np.sin(angle)], -1)
    if isinstance(shape, Cylinder):
        half = np.array([0.0, shape.half_height, 0.0])
        matrix = pose_to_matrix(np.asarray(shape.pose, np.float64))
        return transform_points(matrix, np.concatenate([shape.radius * ring - half, shape.radius * ring + half]))
    ball = shape.radius * np.concatenate([np.roll(ring, k, axis=1) for k in range(3)])
    return np.concatenate([ball + end for end in (shape.start, shape.end)])
