"""Space that a robot occupies: bounds of its collision shapes, and discs that cover it on the floor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.robots.robot import Robot
from h3data.geometry import IDENTITY_POSE, Array
from h3data.scene.shape_bounds import shape_bounds


def resting_bounds(robot: Robot) -> NDArray[np.float64]:
    """Return the lower and upper corners [S, 2, 3] [m] of all collision shapes of a resting robot, in its root frame."""
    frames = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0]
    bounds = [shape_bounds(shape, frames[k]) for k, link in enumerate(robot.links) for shape in link.shapes]
    return np.array(bounds).reshape(-1, 2, 3)


def resting_hull(robot: Robot) -> Array:
    """Return positions along x [H] [m] of discs of the base's radius that cover the whole resting robot and its base discs."""
    bounds, radius = resting_bounds(robot), robot.base_radius_m
    back, front = float(robot.base_discs.min()), float(robot.base_discs.max())
    # discs cover a radius beyond their places
    if len(bounds):
        back, front = min(back, bounds[:, 0, 0].min() + radius), max(front, bounds[:, 1, 0].max() - radius)
    # distance between two discs of a row, in radii: between them the row is 71% as wide as a disc
    spacing = 1.4
    # less a little, so that rounding does not add a disc
    gaps = math.ceil((front - back) / (spacing * radius) - 1e-9)
    return np.linspace(back, front, gaps + 1) if gaps > 0 else np.array([(back + front) / 2])


def row_radius(places: Array, points: Array) -> float:
    """Return the smallest radius [m] of discs at positions [D] [m] along x that cover floor points ``(x, z)`` [N, 2] [m]."""
    return float(np.hypot(points[:, None, 0] - places, points[:, None, 1]).min(1).max())
