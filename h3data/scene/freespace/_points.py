"""Floor points of any leading shape, for kernels that take [N, 2]."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError

SNAP_M = 0.3
"""Largest distance of the end of a path from the free area [m], within which the end is moved to its border, as in
Habitat."""


def floor_points(points: ArrayLike) -> NDArray[np.float64]:
    p = np.asarray(points, np.float64)
    if p.ndim == 0 or p.shape[-1] != 2:
        raise InputError(f"Floor points must be (x, z), shape [..., 2], got {list(p.shape)}.", code="H3-SCENE-006")
    return p


def one_point(point: ArrayLike) -> NDArray[np.float64]:
    p = np.asarray(point, np.float64)
    if p.shape != (2,):
        # points of any leading shape are refused here, others by `floor_points`
        raise InputError(
            f"Expected one floor point (x, z), shape [2], got {list(floor_points(p).shape)}.", code="H3-SCENE-007"
        )
    return p


def each_point(kernel: Callable[[NDArray], NDArray], points: ArrayLike) -> NDArray:
    """Apply a kernel on [N, 2] to points of any leading shape."""
    p = floor_points(points)
    out = kernel(np.ascontiguousarray(p.reshape(-1, 2)))
    # a kernel may give a number or a vector for each point
    return out.reshape(p.shape[:-1] + out.shape[1:])


def each_pair(kernel: Callable[[NDArray, NDArray], NDArray], a: ArrayLike, b: ArrayLike) -> NDArray:
    """Apply a kernel on two [N, 2] to points that broadcast against each other."""
    p, q = floor_points(a), floor_points(b)
    if p.shape != q.shape:  # broadcast_arrays alone takes 4 us
        p, q = np.broadcast_arrays(p, q)
    if p.ndim == 2:  # nothing to reshape, as in nearly all calls
        return kernel(np.ascontiguousarray(p), np.ascontiguousarray(q))
    out = kernel(np.ascontiguousarray(p.reshape(-1, 2)), np.ascontiguousarray(q.reshape(-1, 2)))
    return out.reshape(p.shape[:-1])
