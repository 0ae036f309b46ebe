"""Ambient occlusion, the share of ambient light that nearby surfaces block, from the depth buffer alone.

Scalable ambient obscurance (McGuire et al. 2012) at half resolution: a few taps on a disc of fixed world size, rotated
from pixel to pixel, measure how far surfaces rise above the pixel's own plane; a blur and an interpolation within each
surface follow. Surfaces beyond the disc's radius do not count, so there are no halos, and a plane does not occlude
itself, so open floors and walls keep their exact colour.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel, kernel_part
from h3data.render.raster.raster import FAR_PADDING, Target, View
from h3data.render.shade.marks import SHADED, any_marked
from h3data.render.shade.occlusion_simd import (
    BIAS_PER_Z,
    CENTER_X,
    CENTER_Y,
    FOCAL_X,
    FOCAL_Y,
    GAIN,
    LAST_X,
    LAST_Y,
    NEAR_RADIUS,
    NOWHERE,
    OFFSETS,
    RADIUS,
    TABLE_WORDS,
    TAPS,
    blur_block,
    dim_block,
    occlusion_block,
)

RADIUS_M = 0.32
"""Distance beyond which surfaces do not occlude [m]."""
SPREAD = 0.18
"""Upper bound of the disc's radius as a share of the pixel's distance, which keeps the disc small in the image."""
CONTRAST = 11.0
"""Factor on the mean m over the taps; the amount is m / (1 + m), about one half in a right-angled corner."""
RECEDED_M = 100.0
"""Distance behind an orthographic camera of the eye that replaces its parallel rays [m]."""
EDGE, EDGE_ROWS = 8, 2
"""Padding columns and rows around the coarse image, so that blocks may overrun."""


def _offsets() -> NDArray[np.float64]:
    """Return taps on the unit disc for every pixel of a 4x4 square, repeated to 8 lanes, shape [4 rows, TAPS, x y, 8].

    A spiral, rotated and slightly scaled from pixel to pixel by an ordered dither, in which neighbours differ strongly;
    denser towards the centre, to resolve contacts.
    """
    order = np.tile([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]], 2)[:, None, :]
    tap = np.arange(TAPS)[None, :, None]
    angle = tap * np.pi * (3 - np.sqrt(5)) + order * (2 * np.pi / 16)
    # an exponent of 0.5 would spread the taps evenly over the disc
    length = ((tap + ((order * 7 + 3) % 16 + 0.5) / 16) / TAPS) ** 1.5
    return np.stack([length * np.cos(angle), length * np.sin(angle)], axis=2)


TAP_OFFSETS = _offsets()


class Occlusion(NamedTuple):
    """Image of occlusion at half resolution, with padding."""

    inv_z: NDArray[np.float32]
    """Value 1/z of each pixel, 0 = background, shape [rows, columns] [1/m]."""
    planes: NDArray[np.float32]
    """Slopes of 1/z along x and y, sharpness, and the amount of occlusion 0..1, shape [4, rows, columns]."""
    scratch: NDArray[np.float32]
    """Memory for z, amounts blurred along x, and amounts before they are blurred, shape [3, rows, columns]."""
    changed: NDArray[np.uint8]
    """Nonzero where a pixel differs from the previous image; undefined for the first image. Without padding."""


def _table(view: View, factor: int, last_x: int, last_y: int) -> NDArray[np.float32]:
    """Return words that all blocks share (`occlusion_simd`); coarse pixel k is the target's pixel ``factor * k``."""
    fx, fy, cx, cy = view.intrinsics
    afar = RECEDED_M if view.parallel else 1.0
    table = np.zeros(TABLE_WORDS, np.float32)
    table[FOCAL_X], table[FOCAL_Y] = fx * afar / factor, fy * afar / factor
    # a point occludes only if it rises above the surface by more than `BIAS_M` plus a thousandth of its distance
    table[BIAS_PER_Z] = 0.001 / afar
    # coarse pixel k is seen through the centre of the target's pixel, which lies half a pixel beyond its number
    table[CENTER_X], table[CENTER_Y] = (cx - 0.5) / factor, (cy - 0.5) / factor
    table[LAST_X], table[LAST_Y] = last_x, last_y
    table[RADIUS], table[NEAR_RADIUS], table[GAIN] = RADIUS_M, SPREAD, CONTRAST / TAPS
    table[OFFSETS:] = TAP_OFFSETS.ravel()
    return table


def receded(view: View, target: Target) -> NDArray[np.float32]:
    """Return 1/z of an orthographic image as seen by an eye far behind the camera, shape of ``target.inv_z``."""
    z = view.reach - target.inv_z
    hit = (target.inv_z > 0) & (target.inv_z < FAR_PADDING)
    return np.where(hit, 1 / (RECEDED_M + np.maximum(z, 0)), target.inv_z).astype(np.float32)


def occlude(view: View, target: Target, samples: int, *, before: Occlusion | None = None) -> Occlusion:
    """Compute the occlusion of a rendered target; with ``samples=4``, target and view have twice the image's size.

    For an orthographic view, ``target.inv_z`` must be the result of `receded`. If ``before`` is the occlusion of the
    previous image of the target, in the same view, only its changes are computed, with the same result.
    """
    factor = 4 if samples == 4 else 2
    height, width = -(-view.height // factor), -(-view.width // factor)
    out = before
    if out is None:
        rows, columns = height + 2 * EDGE_ROWS, -(-width // 8) * 8 + 2 * EDGE
        out = Occlusion(
            np.empty((rows, columns), np.float32),
            np.empty((4, rows, columns), np.float32),
            np.empty((3, rows, columns), np.float32),
            np.zeros((height, width), np.uint8),
        )
    table = _table(view, factor, width - 1, height - 1)
    _occlude(target.inv_z, target.tile_drawn, factor, height, width, table, out, before is not None)
    return out


@kernel(error_model="numpy", boundscheck=False)
def _occlude(source, drawn, factor, height, width, table, out, again):
    """Fill ``out``, or with ``again`` only the part that depends on the tiles that were drawn."""
    inv_z, planes, scratch, changed = out
    row = inv_z.shape[1]
    row_bytes, plane_bytes = np.uintp(row * 4), np.uintp(inv_z.size * 4)
    z, raw, final = scratch[0], scratch[2], planes[3]
    if not again:
        inv_z[:] = FAR_PADDING
        scratch[1:] = 0
    changed[:] = 0
    for y in range(height):
        for x in range(width):
            if again and not drawn[y * factor >> 3, x * factor >> 3]:
                continue
            w = source[y * factor, x * factor]
            # drawn again but with the same depth: a thing that moved elsewhere in the tile
            if again and w == inv_z[y + EDGE_ROWS, x + EDGE]:
                continue
            changed[y, x] = 1
            inv_z[y + EDGE_ROWS, x + EDGE] = w
            # the background is so far away that it rises above no surface
            z[y + EDGE_ROWS, x + EDGE] = np.float32(1) / w if w > 0 else np.float32(1e6)
    first = np.uintp((EDGE_ROWS * row + EDGE) * 4)
    inv_z_at, z_at = np.uintp(inv_z.ctypes.data) + first, np.uintp(z.ctypes.data) + first
    planes_at, half_at = np.uintp(planes.ctypes.data) + first, np.uintp(scratch.ctypes.data) + plane_bytes + first
    raw_at = half_at + plane_bytes
    table_at = np.uintp(table.ctypes.data)
    sums = _changed_sums(changed, again)
    # blocks of 8 pixels whose amount or plane has changed, with a column to the left and right; whose blur along x has
    touched = np.zeros((height, -(-width // 8) + 2), np.uint8)
    blurred = np.zeros((height + 4, -(-width // 8)), np.uint8)
    before = np.empty((4, 8), np.float32)
    for y in range(height):
        r = y + EDGE_ROWS
        for x in range(0, width, 8):
            count, c = min(8, width - x), x + EDGE
            if again:
                if not _reaches_changed(sums, inv_z, table, x, y, count):
                    continue
                for p in range(4):
                    for k in range(count):
                        before[p, k] = planes[p, r, c + k]
            occlusion_block(inv_z_at, z_at, planes_at, plane_bytes, np.uintp(x), np.uintp(y), np.uintp(row), table_at)
            if not again:
                for k in range(count):
                    raw[r, c + k] = final[r, c + k]
                continue
            for k in range(count):
                amount = final[r, c + k]
                final[r, c + k] = before[3, k]
                for p in range(3):
                    if planes[p, r, c + k] != before[p, k]:
                        changed[y, x + k] = 1
                if changed[y, x + k] or amount != raw[r, c + k]:
                    touched[y, x // 8 + 1] = 1
                raw[r, c + k] = amount
    # blocks of 8 have written beyond the right border, where the blur must not find surfaces
    _clear_edges(planes, height, width)
    sharpness_at, amount_at = planes_at + np.uintp(2) * plane_bytes, planes_at + np.uintp(3) * plane_bytes
    for y in range(height):
        for b in range(-(-width // 8)):
            if again and not (touched[y, b] or touched[y, b + 1] or touched[y, b + 2]):
                continue
            blurred[y + 2, b] = 1
            k = np.uintp((y * row + 8 * b) * 4)
            blur_block(inv_z_at + k, planes_at + k, sharpness_at + k, raw_at + k, half_at + k, np.uintp(4))
    for y in range(height):
        for b in range(-(-width // 8)):
            some = blurred[y, b] | blurred[y + 1, b] | blurred[y + 2, b] | blurred[y + 3, b] | blurred[y + 4, b]
            if not some:
                continue
            r, c = y + EDGE_ROWS, 8 * b + EDGE
            for k in range(8):
                before[3, k] = final[r, c + k]
            k = np.uintp((y * row + 8 * b) * 4)
            slope_at = planes_at + plane_bytes + k
            blur_block(inv_z_at + k, slope_at, sharpness_at + k, half_at + k, amount_at + k, row_bytes)
            for k in range(min(8, width - 8 * b) if again else 0):
                if final[r, c + k] != before[3, k]:
                    changed[y, 8 * b + k] = 1
    _clear_edges(planes, height, width)


@kernel_part()
def _changed_sums(changed, again):
    """Return the number of changed pixels above and left of each pixel, shape [H + 1, W + 1].

    The result is [1, 1] if there was no image before.
    """
    if not again:
        return np.zeros((1, 1), np.int32)
    height, width = changed.shape
    sums = np.zeros((height + 1, width + 1), np.int32)
    for y in range(height):
        total = np.int32(0)
        for x in range(width):
            total += np.int32(changed[y, x])
            sums[y + 1, x + 1] = sums[y, x + 1] + total
    return sums


@kernel_part()
def _reaches_changed(sums, inv_z, table, x, y, count):
    """Return whether a changed pixel lies within the disc of taps and slopes of ``count`` pixels from (x, y)."""
    nearest = np.float32(0)
    for k in range(count):
        nearest = max(nearest, inv_z[y + EDGE_ROWS, x + k + EDGE])
    # a little more than the kernel's disc, which is computed in float32; the pixel nearest to the eye has the largest
    share = min(float(table[RADIUS]) * nearest, float(table[NEAR_RADIUS])) * 1.001
    # 3 more: taps are rounded to pixels, and slopes are taken from two neighbours on either side
    across, down = int(share * table[FOCAL_X]) + 3, int(share * table[FOCAL_Y]) + 3
    height, width = sums.shape
    x0, x1 = max(x - across, 0), min(x + count + across, width - 1)
    y0, y1 = max(y - down, 0), min(y + 1 + down, height - 1)
    return sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0] > 0


@kernel_part()
def _clear_edges(planes, height, width):
    """Set the padding to no occlusion, on planes that match no pixel."""
    for k in range(4):
        # an endless sharpness: whatever 1/z a pixel has, it is not on this plane
        value = np.float32(FAR_PADDING if k == 2 else 0)
        planes[k, :EDGE_ROWS] = value
        planes[k, EDGE_ROWS + height :] = value
        planes[k, :, :EDGE] = value
        planes[k, :, EDGE + width :] = value


@kernel_part()
def dim_row(occlusion, strength, y, width, near_at, strip, marks):
    """Dim an image row of linear levels, the first three rows of ``strip`` [.., W + 8], by its occlusion.

    The function gets the address of the row's 1/z [W + 8].

    Blocks of 8 pixels without any pixel marked as shaded (`marks`) are skipped.
    """
    inv_z, planes = occlusion.inv_z, occlusion.planes
    row_bytes, plane_bytes = np.uintp(inv_z.shape[1] * 4), np.uintp(inv_z.size * 4)
    first = np.uintp(((y // 2 + EDGE_ROWS) * inv_z.shape[1] + EDGE) * 4)
    inv_z_at, planes_at = np.uintp(inv_z.ctypes.data) + first, np.uintp(planes.ctypes.data) + first
    strip_at = np.uintp(strip.ctypes.data)
    strip_bytes = np.uintp(strip.shape[1] * 4)
    between = y & 1
    lower_bytes, half_row = row_bytes * np.uintp(between), np.float32(0.5 * between)
    for x in range(0, width, 8):
        if not any_marked(marks, x, x + 8, SHADED):
            continue
        c, f = np.uintp(x // 2 * 4), np.uintp(x * 4)
        dim_block(
            inv_z_at + c,
            planes_at + c,
            plane_bytes,
            lower_bytes,
            near_at + f,
            strip_at + f,
            strip_bytes,
            half_row,
            strength,
        )


@kernel_part(forceinline=True, error_model="numpy")
def light_left(occlusion, strength, x, y, near):
    """Return the share of light that `dim_row` leaves at image pixel (x, y), for one sample at 1/z ``near``."""
    inv_z, planes = occlusion.inv_z, occlusion.planes
    # up to four coarse pixels, with repetitions where the pixel coincides with a coarse row or column, as in `dim_block`
    total, weights, amounts = 0.0, NOWHERE, planes[3]
    r, c = y // 2 + EDGE_ROWS, x // 2 + EDGE
    # as in most of a picture, and quick to tell
    if amounts[r, c] + amounts[r, c + 1] + amounts[r + 1, c] + amounts[r + 1, c + 1] == 0:
        return 1.0
    for down in range(2):
        for right in range(2):
            r, c = (y + down) // 2 + EDGE_ROWS, (x + right) // 2 + EDGE
            dx, dy = 0.5 * (x - 2 * (c - EDGE)), 0.5 * (y - 2 * (r - EDGE_ROWS))
            expected = inv_z[r, c] + planes[0, r, c] * dx + planes[1, r, c] * dy
            weight = max(1 - abs(near - expected) * planes[2, r, c], 0.0)
            total += weight * planes[3, r, c]
            weights += weight
    return 1 - strength * total / weights
