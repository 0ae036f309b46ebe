"""Numba kernels on a signed distance grid: look-up, gradient, line of sight, and construction from polygon edges.

A grid is ``sdf`` float32 [nx, nz] with the values at cell centres; ``origin`` (x, z) is the lower corner of cell [0, 0], so
the centre of cell [i, j] is ``origin + (i + 0.5, j + 0.5) * cell``. Distances are to the nearest obstacle or border of the
floor, positive on free floor, negative off it. They are not inflated: a disc of radius r fits where ``sdf >= r``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel, kernel_part

SLACK_M = 0.004
"""Tolerance of the clearance of a line of sight [m], which is the error of bilinear look-up on a 5 cm grid near a
surface (p99 6 mm, research/navigation-and-stepping.md 1.3)."""


HIT_M = 0.002
"""Distance from an obstacle at which a ray of a laser scanner ends [m]."""
RAY_STRIDE_M = 0.01
"""Shortest stride of a scanner's ray at its start [m], and its growth per metre of the ray."""
RAY_STRIDE_GROWTH = 0.005
RAY_STRIDES = 64
"""Largest number of strides of a scanner's ray, with which 99.7% of rays in furnished homes are within 5 cm, half of
them within 1 mm."""


@kernel_part(inline="always")
def _clipped(value: float, most: float) -> float:
    """Return the value in 0..most; as `min` and `max` of numba, which look for NaN too, but a tenth of a look-up faster."""
    value = value if value > 0.0 else 0.0
    return value if value < most else most


@kernel(inline="always")  # called, it would count references to its arrays: stepping takes a quarter longer
def sample_sdf(sdf: NDArray, origin: NDArray, cell: float, x: float, z: float) -> float:
    """Return the signed distance [m] at the floor point (x, z), by bilinear interpolation.

    Off the grid it is the border value minus the distance to the border.
    """
    fx = (x - origin[0]) / cell - 0.5
    fz = (z - origin[1]) / cell - 0.5
    cx, cz = _clipped(fx, sdf.shape[0] - 1.0), _clipped(fz, sdf.shape[1] - 1.0)
    i = min(int(cx), sdf.shape[0] - 2)
    j = min(int(cz), sdf.shape[1] - 2)
    a = cx - i
    b = cz - j
    near = (1.0 - a) * ((1.0 - b) * sdf[i, j] + b * sdf[i, j + 1])
    far = a * ((1.0 - b) * sdf[i + 1, j] + b * sdf[i + 1, j + 1])
    distance = near + far
    if cx != fx or cz != fz:  # a branch, because hypot costs as much as all the rest
        distance -= cell * np.hypot(fx - cx, fz - cz)
    return distance


@kernel(inline="always")
def sdf_gradient(sdf: NDArray, origin: NDArray, cell: float, x: float, z: float) -> tuple[float, float]:
    """Return the gradient (d/dx, d/dz) of the bilinear distance at (x, z).

    It points away from the nearest obstacle, with a length of about 1 (shorter on the ridges half-way between
    obstacles).
    """
    cx = _clipped((x - origin[0]) / cell - 0.5, sdf.shape[0] - 1.0)
    cz = _clipped((z - origin[1]) / cell - 0.5, sdf.shape[1] - 1.0)
    i = min(int(cx), sdf.shape[0] - 2)
    j = min(int(cz), sdf.shape[1] - 2)
    a = cx - i
    b = cz - j
    s00 = sdf[i, j]
    s01 = sdf[i, j + 1]
    s10 = sdf[i + 1, j]
    s11 = sdf[i + 1, j + 1]
    gx = ((1.0 - b) * (s10 - s00) + b * (s11 - s01)) / cell
    gz = ((1.0 - a) * (s01 - s00) + a * (s11 - s10)) / cell
    return gx, gz


@kernel()
def line_of_sight(
    sdf: NDArray, origin: NDArray, cell: float, radius: float, ax: float, az: float, bx: float, bz: float
) -> bool:
    """Return whether a disc of ``radius`` [m] can move straight from a to b, by sphere tracing, with 5 mm of tolerance."""
    length = np.hypot(bx - ax, bz - az)
    if length == 0.0:
        return sample_sdf(sdf, origin, cell, ax, az) >= radius - SLACK_M
    ux = (bx - ax) / length
    uz = (bz - az) / length
    t = 0.0
    while t < length:
        s = sample_sdf(sdf, origin, cell, ax + ux * t, az + uz * t) - radius
        if s < -SLACK_M:
            return False
        # nothing is nearer than s, so a stride of this length cannot pass through anything
        # 0.02: shortest stride of sphere tracing: without it a ray along a wall would creep
        t += max(s, 0.02)
    return sample_sdf(sdf, origin, cell, bx, bz) >= radius - SLACK_M


@kernel(error_model="numpy")
def trace_rays(sdf, origin, cell, points, angles, most):
    """Return distances [N, R] [m], at most ``most``, from points [N, 2] to the nearest obstacle along headings [N, R] [rad].

    The method is sphere tracing (Hart, 1996). A ray ends where the distance is at most `HIT_M`; strides grow with the
    distance from the point, so that `RAY_STRIDES` of them suffice along a wall too.
    """
    out = np.empty(angles.shape)
    for n in range(len(points)):
        for k in range(angles.shape[1]):
            dx = math.cos(angles[n, k])
            dz = -math.sin(angles[n, k])
            reach = 0.0
            for _ in range(RAY_STRIDES):
                left = sample_sdf(sdf, origin, cell, points[n, 0] + reach * dx, points[n, 1] + reach * dz)
                if left <= HIT_M:
                    if left < 0.0:  # back out of the obstacle into which a shortest stride has led
                        reach = max(reach + left, 0.0)
                    break
                reach += max(left, RAY_STRIDE_M + RAY_STRIDE_GROWTH * reach)
                if not reach < most:
                    reach = most
                    break
            out[n, k] = reach
    return out


@kernel()
def sample_sdf_many(sdf: NDArray, origin: NDArray, cell: float, points: NDArray) -> NDArray:
    """Return the signed distances [N] [m] at points [N, 2]."""
    out = np.empty(len(points))
    for k in range(len(points)):
        out[k] = sample_sdf(sdf, origin, cell, points[k, 0], points[k, 1])
    return out


@kernel()
def sdf_gradient_many(sdf: NDArray, origin: NDArray, cell: float, points: NDArray) -> NDArray:
    """Return the gradients [N, 2] of the distance at points [N, 2]."""
    out = np.empty((len(points), 2))
    for k in range(len(points)):
        out[k, 0], out[k, 1] = sdf_gradient(sdf, origin, cell, points[k, 0], points[k, 1])
    return out


@kernel()
def point_segment_distance(x: float, z: float, ax: float, az: float, bx: float, bz: float) -> float:
    """Return the distance from a point to the segment a-b."""
    dx = bx - ax
    dz = bz - az
    square = dx * dx + dz * dz
    t = 0.0
    if square > 0.0:
        t = min(max(((x - ax) * dx + (z - az) * dz) / square, 0.0), 1.0)
    return np.hypot(x - ax - t * dx, z - az - t * dz)


@kernel()
def inside_mask(edges: NDArray, origin: NDArray, cell: float, nx: int, nz: int) -> NDArray:
    """Return whether the centre of each cell lies inside the rings ``edges`` [E, 4] (even-odd rule), bool [nx, nz].

    A scan line per row of cells inverts all cells behind each crossing.
    """
    flips = np.zeros((nx, nz + 1), np.uint8)
    for e in range(len(edges)):
        ax, az, bx, bz = edges[e]
        if ax > bx:
            ax, az, bx, bz = bx, bz, ax, az
        first = max(0, int(np.ceil((ax - origin[0]) / cell - 0.5)) - 1)
        for i in range(first, nx):
            x = origin[0] + (i + 0.5) * cell
            if x < ax:  # compared as below, so that a shared end point belongs to exactly one of its two edges
                continue
            if x >= bx:
                break
            z = az + (bz - az) * (x - ax) / (bx - ax)
            j = int(np.ceil((z - origin[1]) / cell - 0.5))
            flips[i, min(max(j, 0), nz)] ^= 1
    inside = np.empty((nx, nz), np.bool_)
    for i in range(nx):
        state = 0
        for j in range(nz):
            state ^= flips[i, j]
            inside[i, j] = state == 1
    return inside


@kernel()
def sdf_from_edges(edges: NDArray, origin: NDArray, cell: float, nx: int, nz: int) -> NDArray:
    """Return the exact signed distance [m] of every cell centre to the closed rings ``edges`` [E, 4], float32 [nx, nz].

    Blocks of cells share a list of edges that can be nearest to any of their cells. An edge cannot be nearest if it is
    farther from the middle of the block than the nearest edge plus the block's diameter.
    """
    size = 12
    sdf = np.empty((nx, nz), np.float32)
    inside = inside_mask(edges, origin, cell, nx, nz)
    distance = np.empty(len(edges))
    chosen = np.empty(len(edges), np.int64)
    diameter = size * cell * np.sqrt(2.0)
    for bi in range(0, nx, size):
        for bj in range(0, nz, size):
            mx = origin[0] + (bi + 0.5 * size) * cell
            mz = origin[1] + (bj + 0.5 * size) * cell
            nearest = np.inf
            for e in range(len(edges)):
                distance[e] = point_segment_distance(mx, mz, edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3])
                nearest = min(nearest, distance[e])
            count = 0
            for e in range(len(edges)):
                if distance[e] <= nearest + diameter:
                    chosen[count] = e
                    count += 1
            for i in range(bi, min(bi + size, nx)):
                for j in range(bj, min(bj + size, nz)):
                    x = origin[0] + (i + 0.5) * cell
                    z = origin[1] + (j + 0.5) * cell
                    best = np.inf
                    for c in range(count):
                        e = chosen[c]
                        d = point_segment_distance(x, z, edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3])
                        best = min(best, d)
                    sdf[i, j] = best if inside[i, j] else -best
    return sdf
