"""Simulated scans of a planar lidar, from the distance grid of a floor and the discs of people."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import distance_to_circles
from h3data.scene import FreeSpace

RANGE_M = (0.05, 12.0)
"""Nearest and farthest range [m]; measurements beyond are infinite, as in REP 117."""
_BLOCK = 64


def cast_scans(
    free: FreeSpace,
    at: NDArray[np.float64],
    headings: NDArray[np.float64],
    people: NDArray[np.float64],
    *,
    rays: int,
    radius_m: float,
) -> NDArray[np.float32]:
    """Return the ranges [T, rays] [m] that a lidar at the floor points ``at`` [T, 2] measures.

    The first ray points backwards, and the others follow to the left. Ranges are NaN if the lidar's position is NaN.
    The outline of the floor is that of objects between knee and head height (`FreeSpace.free_along`).

    Args:
        free: Free space of the floor.
        at: Positions (x, z) of the lidar in the world [T, 2] [m].
        headings: Headings of the lidar [T] [rad].
        people: Positions (x, z) of people [T, P, 2] [m]; NaN while absent.
        rays: Number of rays per revolution.
        radius_m: Radius of the disc of a person [m].
    """
    angles = -np.pi + np.arange(rays) * (2 * np.pi / rays)
    ranges = np.full((len(at), rays), np.nan, np.float32)
    discs = np.concatenate([people, np.full((*people.shape[:2], 1), radius_m)], axis=-1)
    # in blocks: rays times people of a whole episode would be hundreds of megabytes
    for start in range(0, len(at), _BLOCK):
        rows = slice(start, start + _BLOCK)
        heading = headings[rows, None] + angles
        known = np.isfinite(at[rows]).all(-1)
        far = np.full(heading.shape, np.nan)
        far[known] = free.free_along(at[rows][known], heading[known], max_m=RANGE_M[1])
        if people.shape[1]:
            far = np.fmin(far, distance_to_circles(at[rows], heading, discs[rows]))
        far[~known] = np.nan
        far[far >= RANGE_M[1]] = np.inf
        ranges[rows] = far
    return ranges
