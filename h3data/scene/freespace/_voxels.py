"""Numba kernels that find the floor among unordered triangles, by voxel columns and a flood fill over walkable surfaces.

The method is that of Recast (heightfields; spec/habitat.md lists the settings): an agent can stand on a surface that is
not too steep and has headroom, and neighbouring surfaces are joined if the step between them is not too high.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel


@kernel()
def _clip(poly: NDArray, count: int, axis: int, plane: float, keep_above: bool, out: NDArray) -> int:
    """Write the part of a convex polygon [count, 3] on one side of a plane to ``out`` (Sutherland-Hodgman)."""
    n = 0
    for k in range(count):
        m = (k + 1) % count
        a = poly[k, axis] - plane
        b = poly[m, axis] - plane
        # one comparison for both sides: the sign is turned instead
        if not keep_above:
            a, b = -a, -b
        if a >= 0.0:
            out[n] = poly[k]
            n += 1
        if (a >= 0.0) != (b >= 0.0):
            t = a / (a - b)
            for c in range(3):
                out[n, c] = poly[k, c] + t * (poly[m, c] - poly[k, c])
            n += 1
    return n


@kernel()
def voxel_columns(
    triangles: NDArray, steep_cos: float, origin: NDArray, cell: float, level: float, shape: tuple[int, int, int]
) -> NDArray:
    """Return columns uint8 [nx, nz, ny] of triangles [F, 3, 3]: 0 nothing, 1 surface, 2 surface flat enough to stand on.

    The result is exact, because every triangle is clipped to every column that it touches. ``origin`` [3] is the lower
    corner, ``cell`` the side of a column, ``level`` the height of a voxel [m]; steep means a normal whose |y| is below
    ``steep_cos``.
    """
    nx, nz, ny = shape
    columns = np.zeros((nx, nz, ny), np.uint8)
    strip = np.empty((12, 3))
    piece = np.empty((12, 3))
    spare = np.empty((12, 3))
    for f in range(len(triangles)):
        t = triangles[f]
        normal = np.cross(t[1] - t[0], t[2] - t[0])
        length = np.sqrt(np.sum(normal * normal))
        mark = np.uint8(2) if length > 0.0 and abs(normal[1]) >= steep_cos * length else np.uint8(1)
        # cut into strips along x first, so that each column cuts a piece of a strip and not the whole triangle
        i0 = max(int(np.floor((t[:, 0].min() - origin[0]) / cell)), 0)
        i1 = min(int(np.floor((t[:, 0].max() - origin[0]) / cell)), nx - 1)
        for i in range(i0, i1 + 1):
            spare[:3] = t
            n = _clip(spare, 3, 0, origin[0] + i * cell, True, piece)
            n = _clip(piece, n, 0, origin[0] + (i + 1) * cell, False, strip)
            if n == 0:
                continue
            z0, z1 = strip[:n, 2].min(), strip[:n, 2].max()
            j0 = max(int(np.floor((z0 - origin[2]) / cell)), 0)
            j1 = min(int(np.floor((z1 - origin[2]) / cell)), nz - 1)
            for j in range(j0, j1 + 1):
                m = _clip(strip, n, 2, origin[2] + j * cell, True, spare)
                m = _clip(spare, m, 2, origin[2] + (j + 1) * cell, False, piece)
                if m == 0:
                    continue
                k0 = max(int(np.floor((piece[:m, 1].min() - origin[1]) / level)), 0)
                k1 = min(int(np.floor((piece[:m, 1].max() - origin[1]) / level)), ny - 1)
                for k in range(k0, k1 + 1):
                    # of two surfaces in one voxel the flat one wins: where a wall meets the floor, the wall also
                    # fills the voxels above, so there is no headroom anyway
                    columns[i, j, k] = max(columns[i, j, k], mark)
    return columns


@kernel()
def mark_standable(columns: NDArray, head: int, climb: int) -> int:
    """Mark with 3 every surface voxel on which an agent can stand; return their number.

    Such a voxel is flat and has ``head`` empty voxels above it, or belongs to a low object (a fin, a ball) that ends at
    most ``climb`` voxels above a flat surface of the same column.
    """
    nx, nz, ny = columns.shape
    total = 0
    for i in range(nx):
        for j in range(nz):
            # so low that nothing at the bottom counts as standing on it
            flat = -1 - climb
            for k in range(ny):
                kind = columns[i, j, k]
                if kind == 0:
                    continue
                if kind == 1 and k - flat > climb:
                    continue
                if kind == 2:
                    flat = k
                free = True
                for y in range(k + 1, min(k + head + 1, ny)):  # above the grid there is air
                    if columns[i, j, y] != 0:
                        free = False
                        break
                if free:
                    columns[i, j, k] = 3
                    total += 1
    return total


@kernel()
def flood_surfaces(columns: NDArray, total: int, climb: int, head: int) -> tuple[NDArray, NDArray, NDArray]:
    """Find connected surfaces of voxels marked 3.

    Returns voxels [total, 3] as i j k, the component of each [total], and sizes of components [C].
    """
    nx, nz, ny = columns.shape
    voxel = np.empty((total, 3), np.int32)
    component = np.empty(total, np.int32)
    sizes = np.empty(total, np.int64)
    count = 0
    components = 0
    step_i = (1, -1, 0, 0)
    step_j = (0, 0, 1, -1)
    for si in range(nx):
        for sj in range(nz):
            for sk in range(ny):
                if columns[si, sj, sk] != 3:
                    continue
                begin = count
                columns[si, sj, sk] = 4
                voxel[count, 0], voxel[count, 1], voxel[count, 2] = si, sj, sk
                count += 1
                at = begin
                while at < count:
                    i, j, k = voxel[at]
                    component[at] = components
                    at += 1
                    for d in range(4):
                        u = i + step_i[d]
                        v = j + step_j[d]
                        if u < 0 or v < 0 or u >= nx or v >= nz:
                            continue
                        for w in range(max(k - climb, 0), min(k + climb + 1, ny)):
                            if columns[u, v, w] == 3 and _headroom(columns, i, j, k, u, v, w, head):
                                columns[u, v, w] = 4
                                voxel[count, 0], voxel[count, 1], voxel[count, 2] = u, v, w
                                count += 1
                sizes[components] = count - begin
                components += 1
    return voxel[:count], component[:count], sizes[:components]


@kernel()
def _headroom(columns: NDArray, i: int, j: int, k: int, u: int, v: int, w: int, head: int) -> bool:
    """Return whether a person standing on the higher of two surfaces also fits above the lower one."""
    ny = columns.shape[2]
    top = max(k, w)
    if k < w:
        u, v = i, j
    free = True
    for y in range(top + 1, min(top + head + 1, ny)):
        free = free and columns[u, v, y] == 0
    return free


@kernel()
def mask_rectangles(mask: NDArray) -> NDArray:
    """Cover a bool mask by disjoint rectangles ``i0 j0 i1 j1`` (ends excluded) [R, 4], by merging equal runs of rows."""
    nx, nz = mask.shape
    out = np.empty((256, 4), np.int64)
    count = 0
    open_from = 0  # rectangles from here on end at the current row
    for i in range(nx):
        row_from = count
        j = 0
        while j < nz:
            if not mask[i, j]:
                j += 1
                continue
            end = j
            while end < nz and mask[i, end]:
                end += 1
            grown = False
            for r in range(open_from, row_from):
                if out[r, 1] == j and out[r, 3] == end and out[r, 2] == i:
                    out[r, 2] = i + 1
                    grown = True
            if not grown:
                if count == len(out):
                    out = np.concatenate((out, np.empty_like(out)))
                out[count, 0], out[count, 1], out[count, 2], out[count, 3] = i, j, i + 1, end
                count += 1
            j = end
        while open_from < row_from and out[open_from, 2] <= i:
            open_from += 1
    return out[:count]
