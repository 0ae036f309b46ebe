"""The rasteriser's three fillers, which turn a triangle's edge functions into blocks of 8 pixels."""

from __future__ import annotations

import numpy as np

from h3data.kernels import kernel_part
from h3data.render.raster.raster_simd import (
    E0,
    E0_DX,
    E0_DY,
    E1,
    E1_DX,
    E1_DY,
    E2,
    E2_DX,
    E2_DY,
    INV_Z,
    INV_Z_DX,
    INV_Z_DY,
    X0,
    X1,
    Y0,
    Y1,
    blend_block,
    fetch_ahead,
)

_ROWS_AHEAD = 2
"""Number of rows between the row that is filled and the row that is prefetched into the cache."""


@kernel_part(forceinline=True)
def fill_small(table, boxes, lane, inv_z_at, words_at, stride, word):
    """Fill a triangle at most 8 pixels wide with one block per row."""
    e0, e1, e2, inv_z = table[E0, lane], table[E1, lane], table[E2, lane], table[INV_Z, lane]
    e0_dx, e1_dx, e2_dx, inv_z_dx = table[E0_DX, lane], table[E1_DX, lane], table[E2_DX, lane], table[INV_Z_DX, lane]
    y0, y1 = boxes[Y0, lane], boxes[Y1, lane]
    # addresses, not indices: of each index numba would ask whether it counts from the end
    offset = np.uintp((np.int64(y0) * stride + boxes[X0, lane]) * 4)
    for _ in range(y0, y1 + 1):
        blend_block(
            inv_z_at + offset, words_at + offset, e0, e1, e2, inv_z, e0_dx, e1_dx, e2_dx, inv_z_dx, np.int32(word)
        )
        e0 += table[E0_DY, lane]
        e1 += table[E1_DY, lane]
        e2 += table[E2_DY, lane]
        inv_z += table[INV_Z_DY, lane]
        offset += np.uintp(stride * 4)


@kernel_part(forceinline=True, error_model="numpy")
def _cut(low, high, edge, step, minus_inverse):
    """Return the part of the span low..high where ``edge + step * x >= 0``.

    A zero step makes the crossing infinite or NaN; comparisons with NaN are false, which leaves the span unchanged.
    """
    crossing = edge * minus_inverse
    if step >= 0:
        if crossing > low:
            low = crossing
    elif crossing < high:
        high = crossing
    return low, high


@kernel_part(forceinline=True, error_model="numpy")
def fill_medium(table, boxes, lane, inv_z_at, words_at, stride, word):
    """Fill a triangle up to 64 pixels wide and high: float32 spans per row, then blocks, which test each pixel."""
    e0, e1, e2, inv_z = table[E0, lane], table[E1, lane], table[E2, lane], table[INV_Z, lane]
    e0_dx, e1_dx, e2_dx, inv_z_dx = table[E0_DX, lane], table[E1_DX, lane], table[E2_DX, lane], table[INV_Z_DX, lane]
    minus_one, zero = np.float32(-1), np.float32(0)
    inverse0, inverse1, inverse2 = minus_one / e0_dx, minus_one / e1_dx, minus_one / e2_dx
    y0, y1 = boxes[Y0, lane], boxes[Y1, lane]
    # x from the left edge of the box: float32 has too few digits for columns of a large image
    last = np.float32(boxes[X1, lane] - boxes[X0, lane])
    row = np.uintp((np.int64(y0) * stride + boxes[X0, lane]) * 4)
    for _ in range(y0, y1 + 1):
        low, high = _cut(zero, last, e0, e0_dx, inverse0)
        low, high = _cut(low, high, e1, e1_dx, inverse1)
        low, high = _cut(low, high, e2, e2_dx, inverse2)
        # a pixel of slack: the span is rounded, and the blocks test each pixel anyway
        if high >= 0 and high >= low + minus_one:
            x, end = np.int32(low), np.int32(high)
            while x <= end:
                s = np.float32(x)
                offset = row + np.uintp(np.int64(x) * 4)
                blend_block(
                    inv_z_at + offset,
                    words_at + offset,
                    e0 + e0_dx * s,
                    e1 + e1_dx * s,
                    e2 + e2_dx * s,
                    inv_z + inv_z_dx * s,
                    e0_dx,
                    e1_dx,
                    e2_dx,
                    inv_z_dx,
                    np.int32(word),
                )
                x += np.int32(8)
        e0 += table[E0_DY, lane]
        e1 += table[E1_DY, lane]
        e2 += table[E2_DY, lane]
        inv_z += table[INV_Z_DY, lane]
        row += np.uintp(stride * 4)


@kernel_part(forceinline=True)
def camera_corners(soup, to_camera, corners):
    """Fill ``corners`` [9] with a triangle's corners in camera space; return the smallest z."""
    nearest = np.inf
    for v in range(3):
        for r in range(3):
            corners[3 * v + r] = (
                to_camera[r, 0] * soup[3 * v]
                + to_camera[r, 1] * soup[3 * v + 1]
                + to_camera[r, 2] * soup[3 * v + 2]
                + to_camera[r, 3]
            )
        nearest = min(nearest, corners[3 * v + 2])
    return nearest


@kernel_part(error_model="numpy")
def clip_near(pieces, near):
    """Clip the triangle ``pieces[0]`` at z = near in camera space into 0 to 2 triangles in ``pieces`` [2, 9].

    Returns the number of triangles.
    """
    polygon, count, corners = np.empty((4, 3)), 0, pieces[0]
    for v in range(3):
        a, b = corners[3 * v : 3 * v + 3], corners[3 * ((v + 1) % 3) : 3 * ((v + 1) % 3) + 3]
        if a[2] >= near:
            for axis in range(3):  # by element: to copy slices, numba compiles an error text for 2 s
                polygon[count, axis] = a[axis]
            count += 1
        if (a[2] >= near) != (b[2] >= near):
            s = (near - a[2]) / (b[2] - a[2])
            polygon[count, 0], polygon[count, 1] = a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1])
            polygon[count, 2] = near
            count += 1
    for k in range(count - 2):
        for v, corner in enumerate((0, k + 1, k + 2)):
            for axis in range(3):
                pieces[k, 3 * v + axis] = polygon[corner, axis]
    return max(count - 2, 0)


@kernel_part()
def visible_box(p, view):
    """Return the pixel box of the part of a triangle in front of the eye plane.

    The box is (x0, x1, y0, y1) with ends included; it is empty if x1 < x0.
    """
    fx, fy, cx, cy = view.intrinsics
    left, right, top, bottom = 1e30, -1e30, 1e30, -1e30
    # not zero: a corner in the plane of the eye is infinitely far away on the screen
    smallest_z = 1e-4
    for v in range(3):
        n = 3 * ((v + 1) % 3)
        ax, ay, az = p[3 * v], p[3 * v + 1], 1.0 if view.parallel else p[3 * v + 2]
        bx, by, bz = p[n], p[n + 1], 1.0 if view.parallel else p[n + 2]
        if az >= smallest_z:
            x, y = fx * ax / az + cx, fy * ay / az + cy
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        if (az >= smallest_z) != (bz >= smallest_z):
            s = (smallest_z - az) / (bz - az)
            x = fx * (ax + s * (bx - ax)) / smallest_z + cx
            y = fy * (ay + s * (by - ay)) / smallest_z + cy
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
    if not (left <= right and top <= bottom):
        return 0, -1, 0, -1
    # clamped while they are floats: an integer of 1e30 is undefined
    x0 = int(np.ceil(min(max(left, 0.0), view.width + 1.0) - 0.5))
    x1 = int(np.floor(max(min(right, float(view.width)), -1.0) - 0.5))
    y0 = int(np.ceil(min(max(top, 0.0), view.height + 1.0) - 0.5))
    y1 = int(np.floor(max(min(bottom, float(view.height)), -1.0) - 0.5))
    return x0, x1, y0, y1


@kernel_part(forceinline=True)
def cut_exact(low, high, edge, step, minus_inverse):
    """Cut a span of pixels by an edge function like `_cut`, in double precision.

    With a zero step the whole span remains, or nothing.
    """
    crossing = edge * minus_inverse
    if step > 0:
        return (crossing if crossing > low else low), high
    if step < 0:
        return low, (crossing if crossing < high else high)
    return low, (high if edge >= 0 else -1.0)


@kernel_part(inline="always", error_model="numpy")
def edge_functions(p, view, x0, y0):
    """Compute homogeneous edge functions (Olano & Greer 1997) and nearness of a triangle [9] in camera space, in double.

    Returns whether the triangle has an area; the three barycentrics over z (orthographic: the barycentrics) and nearness
    at pixel (x0, y0); their increments per pixel to the right; and their increments per pixel downwards.

    The rows of the inverse of [p0 p1 p2] give each barycentric over z as a linear function of the ray (u, v, 1). For
    orthographic cameras, 1 takes the place of z, and nearness is interpolated between the corners. Modifies ``p``.
    Inlined by numba, because leaving it to LLVM makes small images 5% slower.
    """
    fx, fy, cx, cy = view.intrinsics
    start, to_second, to_third = view.reach - p[2], p[2] - p[5], p[2] - p[8]
    if view.parallel:
        p[2] = p[5] = p[8] = 1.0
    ax, ay, az = p[4] * p[8] - p[5] * p[7], p[5] * p[6] - p[3] * p[8], p[3] * p[7] - p[4] * p[6]
    bx, by, bz = p[7] * p[2] - p[8] * p[1], p[8] * p[0] - p[6] * p[2], p[6] * p[1] - p[7] * p[0]
    gx, gy, gz = p[1] * p[5] - p[2] * p[4], p[2] * p[3] - p[0] * p[5], p[0] * p[4] - p[1] * p[3]
    determinant = p[0] * ax + p[1] * ay + p[2] * az
    # zero for a triangle seen from its edge; the infinities are dropped by the caller, and a test here would cost
    # more
    k = 1 / determinant
    # 1/z from the normal of the edge vectors, which avoids cancellation
    sx, sy, sz = p[3] - p[0], p[4] - p[1], p[5] - p[2]
    tx, ty, tz = p[6] - p[0], p[7] - p[1], p[8] - p[2]
    nx, ny, nz = (sy * tz - sz * ty) * k, (sz * tx - sx * tz) * k, (sx * ty - sy * tx) * k
    if view.parallel:
        to_second, to_third = to_second * k, to_third * k
        nx, ny = bx * to_second + gx * to_third, by * to_second + gy * to_third
        nz = start + bz * to_second + gz * to_third
    per_x, per_y = 1 / fx, 1 / fy
    u, v = (x0 + 0.5 - cx) * per_x, (y0 + 0.5 - cy) * per_y
    d0, d1, d2, dw = ax * k * per_x, bx * k * per_x, gx * k * per_x, nx * per_x
    c0, c1, c2, cw = ay * k * per_y, by * k * per_y, gy * k * per_y, ny * per_y
    # enlarged by 1e-5 pixel, against cracks
    e0 = (ax * u + ay * v + az) * k + 1e-5 * (abs(d0) + abs(c0))
    e1 = (bx * u + by * v + bz) * k + 1e-5 * (abs(d1) + abs(c1))
    e2 = (gx * u + gy * v + gz) * k + 1e-5 * (abs(d2) + abs(c2))
    inv_z = nx * u + ny * v + nz
    return determinant != 0, (e0, e1, e2, inv_z), (d0, d1, d2, dw), (c0, c1, c2, cw)


@kernel_part(error_model="numpy")
def fill_large(p, view, is_near, box, inv_z_at, words_at, stride, word):
    """Fill any triangle [9] in camera space by `edge_functions`, which need no clipping; ``p`` is changed."""
    x0, x1, y0, y1 = np.int64(box[X0]), np.int64(box[X1]), np.int64(box[Y0]), np.int64(box[Y1])
    if is_near:
        x0, x1, y0, y1 = visible_box(p, view)
    if x1 < x0 or y1 < y0:
        return
    found, (e0, e1, e2, inv_z), (d0, d1, d2, dw), (c0, c1, c2, cw) = edge_functions(p, view, x0, y0)
    if not found:
        return
    last = float(x1 - x0)
    inverse0, inverse1, inverse2 = -1 / d0, -1 / d1, -1 / d2
    f0, f1, f2, fw = np.float32(d0), np.float32(d1), np.float32(d2), np.float32(dw)
    row, further = np.uintp((y0 * stride + x0) * 4), np.uintp(_ROWS_AHEAD * stride * 4)
    for _ in range(y0, y1 + 1):
        low, high = cut_exact(0.0, last, e0, d0, inverse0)
        low, high = cut_exact(low, high, e1, d1, inverse1)
        low, high = cut_exact(low, high, e2, d2, inverse2)
        if high >= 0 and high >= low - 1:
            x, end = int(low), int(high)
            while x <= end:
                offset = row + np.uintp(x * 4)
                # the buffers of a large image do not fit the caches, and each row begins on another page
                fetch_ahead(inv_z_at + offset + further)
                fetch_ahead(words_at + offset + further)
                blend_block(
                    inv_z_at + offset,
                    words_at + offset,
                    np.float32(e0 + d0 * x),
                    np.float32(e1 + d1 * x),
                    np.float32(e2 + d2 * x),
                    np.float32(inv_z + dw * x),
                    f0,
                    f1,
                    f2,
                    fw,
                    np.int32(word),
                )
                x += 8
        e0 += c0
        e1 += c1
        e2 += c2
        inv_z += cw
        row += np.uintp(stride * 4)
