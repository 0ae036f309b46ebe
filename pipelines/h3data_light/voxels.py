"""Static surfaces of a scene as voxels with their distance to the nearest surface, for fast ray casting.

All positions are in voxels: world = origin + cell * position. A ray advances by the distance stored in its current
voxel, so that it crosses a room in about ten steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel, kernel_part

CELL_M = 0.05
MAX_VOXELS = 12_000_000
"""Largest number of voxels; scenes that need more get larger voxels."""
MARGIN_M = 0.5
PROBE_VOXELS = 5
"""Number of voxels along the side of a block; each block has one probe and one mean colour per axis."""
GLASS = 255
"""Value of voxels of window panes: transparent for the sun, opaque for all other rays (see `direct`)."""
_FARTHEST = 100
_HOLLOW_M3 = 3.0
"""Volume below which a closed hollow is the inside of furniture or walls, where points of other surfaces are hidden."""


class Voxels(NamedTuple):
    """Voxel grid of a scene, with distances and colours."""

    distance: NDArray[np.uint8]
    """Chebyshev distance to the nearest surface (0 in surfaces) or `GLASS`, shape [X, Y, Z] [voxels]."""
    albedo: NDArray[np.float32]
    """Mean linear colour of the surfaces in each block that face along x, y and z, shape [X', Y', Z', 3, 3]."""
    origin: NDArray[np.float64]
    cell_m: float


def voxelise(
    triangles: NDArray[np.float64], colors: NDArray[np.float32], glass: NDArray[np.bool_], lamps: NDArray[np.float64]
) -> Voxels:
    """Return the voxels of triangles [F, 3, 3] [m] with linear colours [F, 3]; ``glass`` [F] are window panes.

    Hollows inside furniture are filled, except those that contain one of the ``lamps`` [L, 3] [m].
    """
    from scipy.ndimage import distance_transform_cdt

    low, high = triangles.min((0, 1)) - MARGIN_M, triangles.max((0, 1)) + MARGIN_M
    cell = max(CELL_M, float(np.prod(high - low) / MAX_VOXELS) ** (1 / 3))
    low -= 0.37 * cell  # walls and floors lie on round numbers: rather within a voxel than on the border of two
    blocks = np.ceil((high - low) / (cell * PROBE_VOXELS)).astype(int) + 1
    distance = np.full(blocks * PROBE_VOXELS, _FARTHEST, np.uint8)
    sums = np.zeros((*blocks, 3, 4), np.float32)
    _mark(((triangles - low) / cell).astype(np.float32), colors, glass, distance, sums)
    panes = distance == GLASS
    free = _reachable(distance != 0, lamps=(lamps - low) / cell, cell_m=cell)
    far = np.empty(distance.shape, np.int32)
    distance_transform_cdt(free & ~panes, "chessboard", distances=far)
    distance = np.minimum(far, _FARTHEST).astype(np.uint8)
    distance[panes] = GLASS
    total = sums.sum(3, keepdims=True)
    sums = np.where(sums[..., 3:] > 0, sums, total)
    albedo = np.where(sums[..., 3:] > 0, sums[..., :3] / np.maximum(sums[..., 3:], 1e-9), np.float32(0.5))
    return Voxels(distance, np.minimum(albedo, 0.9).astype(np.float32), low, cell)


@kernel(error_model="numpy", boundscheck=False)
def _mark(triangles, colors, glass, distance, sums):
    """Mark all voxels that triangles touch, by points at most 0.45 voxels apart, and sums up colours."""
    for f in range(len(triangles)):
        longest, first = 0.0, 0
        for k in range(3):
            m = (k + 1) % 3
            length = 0.0
            for a in range(3):
                length += (triangles[f, m, a] - triangles[f, k, a]) ** 2
            if length > longest:
                longest, first = length, k
        base = np.sqrt(longest)
        i, j, k = first, (first + 1) % 3, (first + 2) % 3
        ax, ay, az = triangles[f, i, 0], triangles[f, i, 1], triangles[f, i, 2]
        bx, by, bz = triangles[f, j, 0] - ax, triangles[f, j, 1] - ay, triangles[f, j, 2] - az
        cx, cy, cz = triangles[f, k, 0] - ax, triangles[f, k, 1] - ay, triangles[f, k, 2] - az
        nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        axis = 0
        if abs(ny) > abs(nx):
            axis = 1
        if abs(nz) > max(abs(nx), abs(ny)):
            axis = 2
        height = np.sqrt(nx * nx + ny * ny + nz * nz) / max(base, 1e-9)
        rows = int(height / 0.45) + 1
        for r in range(rows + 1):
            t = r / rows
            points = int(base * (1 - t) / 0.45) + 1
            for p in range(points + 1):
                s = (1 - t) * p / points
                x, y, z = int(ax + bx * s + cx * t), int(ay + by * s + cy * t), int(az + bz * s + cz * t)
                if glass[f]:
                    if distance[x, y, z] != 0:
                        distance[x, y, z] = GLASS
                    continue
                distance[x, y, z] = 0
                u, v, w = x // PROBE_VOXELS, y // PROBE_VOXELS, z // PROBE_VOXELS
                for a in range(3):
                    sums[u, v, w, axis, a] += colors[f, a]
                sums[u, v, w, axis, 3] += np.float32(1.0)


def _reachable(free: NDArray[np.bool_], *, lamps: NDArray[np.float64], cell_m: float) -> NDArray[np.bool_]:
    """Return the free voxels except those of closed hollows, smaller than `_HOLLOW_M3`, without a lamp.

    ``lamps`` are positions [L, 3].
    """
    from scipy.ndimage import label

    parts: NDArray[np.int32] = np.empty(free.shape, np.int32)
    count = int(np.asarray(label(free, output=parts)))
    keep = np.bincount(parts.ravel(), minlength=count + 1) * cell_m**3 > _HOLLOW_M3
    for border in (parts[0], parts[-1], parts[:, 0], parts[:, -1], parts[:, :, 0], parts[:, :, -1]):
        keep[border] = True
    at = lamps.astype(int)
    at = at[((at >= 0) & (at < free.shape)).all(1)]
    keep[parts[tuple(at.T)]] = True
    keep[0] = False  # surfaces
    return keep[parts]


@kernel_part()
def march(distance, x, y, z, dx, dy, dz, length, through_glass):
    """Follow a ray for ``length`` [voxels] times its direction, whose largest component is 1.

    The function returns the result (0: escaped or at its end, 1: surface, 2: window pane), the last free voxel and the
    hit voxel.
    """
    nx, ny, nz = distance.shape
    t = np.float32(0.0)
    pi, pj, pk = int(x), int(y), int(z)
    while t < length:
        px, py, pz = x + t * dx, y + t * dy, z + t * dz
        if px < 0 or py < 0 or pz < 0 or px >= nx or py >= ny or pz >= nz:
            return 0, pi, pj, pk, pi, pj, pk
        i, j, k = int(px), int(py), int(pz)
        d = distance[i, j, k]
        if d == 0:
            return 1, pi, pj, pk, i, j, k
        if d == GLASS:
            if not through_glass:
                return 2, pi, pj, pk, i, j, k
            d = np.uint8(1)
        pi, pj, pk = i, j, k
        t += np.float32(max(d - 1.0, 0.5))
    return 0, pi, pj, pk, pi, pj, pk


@kernel_part()
def sees(distance, x, y, z, tx, ty, tz):
    """Return whether no surface lies between two points [voxels]."""
    dx, dy, dz = tx - x, ty - y, tz - z
    length = max(abs(dx), abs(dy), abs(dz))
    if length < 1e-6:
        return True
    kind, _, _, _, _, _, _ = march(distance, x, y, z, dx / length, dy / length, dz / length, length, False)
    return kind == 0
