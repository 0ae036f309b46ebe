"""Soft shadows of moving objects: capsules that block light from the pixels around them.

A capsule blocks two kinds of light from a point with normal n:

- **Light from everywhere.** With the nearest point of the axis at distance d in direction w, a sphere of radius r
  covers ``max(n . w, 0) r^2 / d^2`` of the cosine-weighted hemisphere and an endless cylinder ``max(n . w, 0) r / d``:
  form factors (Siegel and Howell, "Thermal Radiation Heat Transfer", appendix C), exact above the horizon. A capsule
  lies between them: ``r / d`` times the mean of both its halves' extents over d, at most 1. It is windowed by
  ``(1 - (d / range)^4)^2`` (Karis 2013, "Real Shading in Unreal Engine 4", for lights), so that a capsule affects few
  pixels.
- **Light from one direction.** The sphere around the point of the axis that is nearest to the ray towards the light
  (closest points of a line and a segment: Ericson 2005, "Real-Time Collision Detection", 5.1.8) covers a part of the
  light's disc: the overlap of two discs by a smooth step between touching and containing (Oat and Sander 2007, "Ambient
  Aperture Lighting"), times the share of the disc that the capsule can cover at most. Shadows are sharp where a foot
  stands on the floor and dissolve with distance.

Each group of capsules (one person, robot or object) has one direction of light and its share (`h3data_light.field`);
Iwanicki 2013 ("Lighting Technology of The Last of Us") splits light in this way. The point loses the share ``f`` of the
blocked light from the direction and ``1 - f`` of the blocked light from everywhere,
``f = share (n . l) / (share (n . l) + (1 - share) / 4)``: a surface receives a quarter of uniform light from
everywhere. A group does not darken itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel, kernel_part
from h3data.kernels.vectors import LANES
from h3data.render.raster.raster import INSTANCE, Target, View
from h3data.render.shade.blockers_simd import (
    ALONG,
    ALONG_LIGHT,
    BLOCKER_WORDS,
    DIRECTION,
    FADE_M,
    GROUP,
    KEPT_M,
    LENGTH,
    LIGHT,
    ORIGIN,
    PER_ACROSS2,
    PER_LENGTH2,
    PER_RADIUS,
    PER_RANGE4,
    RADIUS,
    RADIUS2,
    REACH,
    SHARE,
    SPREAD,
    START,
    WIDTH,
    begin_block,
    block_all_light,
    block_one_direction,
    dim_levels_block,
    end_group_block,
)

TILE_X, TILE_Y = 16, 8
"""Height and width of the tiles of an image, each with a list of capsules [px]."""
_ALL, _ONE = 1, 2
"""Bits of a capsule in a list, which state that it blocks light from everywhere and light from one direction."""


@dataclass(frozen=True, eq=False)
class Blockers:
    """Capsules that block light from surfaces at one step, and the light on moving instances."""

    rows: NDArray[np.float32]
    """Capsules as laid out in `blockers_simd`, sorted by group, shape [N, BLOCKER_WORDS]."""
    tints: NDArray[np.float32]
    """Factor on the colour of each instance of the scene and its group (-1 = none), shape [I, 4]."""


def blocker_rows(
    capsules: NDArray[np.floating],
    groups: NDArray[np.integer],
    light: NDArray[np.floating],
    share: NDArray[np.floating],
    reach_m: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Return the rows of capsules for the kernels.

    Args:
        capsules: Both ends of the axes and radii [N, 7] [m]. Capsules that are not finite are left out.
        groups: Group of each capsule [N].
        light: Unit direction towards the light [N, 3], equal within a group.
        share: Share of the light that comes from this direction [N], equal within a group.
        reach_m: Distance from each capsule to the first wall behind it, away from the light [N] [m].
    """
    c = np.asarray(capsules, np.float64).reshape(-1, 7)
    known = np.isfinite(c).all(1) & (c[:, 6] > 0)
    # by group: the kernel sums up what a group takes until the next capsule has another group
    order = np.flatnonzero(known)[np.argsort(groups[known], kind="stable")]
    c, light = c[order], np.asarray(light, np.float64)[order]
    along, radius = c[:, 3:6] - c[:, :3], np.maximum(c[:, 6], 1e-3)
    length2, to_light = (along**2).sum(1), (along * light).sum(1)
    across2 = np.maximum(length2 - to_light**2, 0)
    out = np.zeros((len(c), BLOCKER_WORDS), np.float32)
    out[:, START : START + 3], out[:, ALONG : ALONG + 3], out[:, LIGHT : LIGHT + 3] = c[:, :3], along, light
    # 0 where the axis is a point, or points at the light: the nearest point of the axis is then its start
    out[:, PER_LENGTH2] = np.where(length2 > 1e-8, 1 / np.maximum(length2, 1e-8), 0)
    out[:, ALONG_LIGHT] = to_light
    out[:, PER_ACROSS2] = np.where(across2 > 1e-6, 1 / np.maximum(across2, 1e-6), 0)
    out[:, RADIUS], out[:, RADIUS2] = radius, radius**2
    width = radius + np.sqrt(across2) / 2
    out[:, WIDTH] = width
    # a shadow ends where it takes less than 1/14 of the light
    out[:, REACH] = np.minimum(reach_m[order], np.sqrt(radius * width / (1 / 14)) / SPREAD)
    out[:, PER_RANGE4] = 1 / (4.0 * radius + 0.12) ** 4
    out[:, GROUP], out[:, SHARE], out[:, LENGTH] = groups[order], share[order], np.sqrt(length2)
    out[:, PER_RADIUS] = 1 / radius
    return out


class Tiled(NamedTuple):
    """Capsules and the tiles of an image that they affect, in the form for kernels."""

    rows: NDArray[np.float32]
    tints: NDArray[np.float32]
    """Factors and groups of instances (`Blockers.tints`), shape [I, 4], or [0, 4] without tints."""
    first: NDArray[np.int32]
    """Index in ``listed`` at which the list of each tile starts, row by row, shape [tiles + 1]; [0] if there are no
    capsules."""
    listed: NDArray[np.int32]
    """Capsules of each tile: four times the index of the capsule, plus two bits for the kinds of light that it
    blocks."""
    inv_z: NDArray[np.float32]
    """Value 1/z of each pixel of the target, also for orthographic cameras."""


NO_BLOCKERS = Tiled(
    np.zeros((0, BLOCKER_WORDS), np.float32),
    np.zeros((0, 4), np.float32),
    np.zeros(0, np.int32),
    np.zeros(0, np.int32),
    np.zeros((0, 0), np.float32),
)


def tiled(blockers: Blockers | None, view: View, target: Target, *, factor: int) -> Tiled:
    """Find the capsules that can shade each tile of an image with ``factor`` samples along each axis of a pixel."""
    if blockers is None:
        return NO_BLOCKERS
    nothing = NO_BLOCKERS._replace(tints=blockers.tints)
    if not len(blockers.rows):
        return nothing
    # the kernels find a pixel's place by 1/z, but an orthographic target holds ``reach - z``
    inv_z = target.inv_z
    if view.parallel:
        inv_z = np.where(inv_z > 0, 1 / np.maximum(view.reach - inv_z, 1e-6), 0).astype(np.float32)
    seen = np.empty((len(blockers.rows), 6))
    _on_screen(blockers.rows, view, factor, seen)
    index = np.flatnonzero(seen[:, 3] > seen[:, 0])
    if not len(index):
        return nothing
    height, width = view.height // factor, view.width // factor
    tiles = -(-width // TILE_X) * -(-height // TILE_Y)
    first, listed = np.zeros(tiles + 1, np.int32), np.empty(tiles * len(index), np.int32)
    count = _fill_tiles(seen[index], index, blockers.rows, view, inv_z, factor, first, listed)
    return Tiled(blockers.rows, blockers.tints, first, listed, inv_z) if count else nothing


def changed_tiles(before: Tiled, after: Tiled) -> NDArray[np.uint8]:
    """Return 1 for each tile of an image whose capsules have changed, uint8 [tiles].

    The shape is [0] if there are no capsules before and after.
    """
    if not len(before.first) and not len(after.first):
        return np.zeros(0, np.uint8)
    tiles = max(len(before.first), len(after.first)) - 1
    first, earlier = (t.first if len(t.first) else np.zeros(tiles + 1, np.int32) for t in (after, before))
    # with another number of capsules their indices have shifted, and no capsule can be said to be the same
    same = np.zeros(len(after.rows), np.bool_)
    if before.rows.shape == after.rows.shape:
        same = (before.rows == after.rows).all(1)
    changed = np.zeros(tiles, np.uint8)
    _compare_tiles(earlier, before.listed, first, after.listed, same, changed)
    return changed


@kernel(boundscheck=False)
def _compare_tiles(earlier, listed_earlier, first, listed, same, changed):
    for tile in range(len(changed)):
        begin, old, count = first[tile], earlier[tile], first[tile + 1] - first[tile]
        if earlier[tile + 1] - old != count:
            changed[tile] = 1
            continue
        for k in range(count):
            if listed[begin + k] != listed_earlier[old + k] or not same[listed[begin + k] >> 2]:
                changed[tile] = 1


@kernel(error_model="numpy", boundscheck=False)
def _on_screen(rows, view, factor, seen):
    """Fill ``seen`` [N, 6] with boxes on the screen around all that each capsule may darken.

    That is within four spheres, one around the capsule and three along its shadow: a single one would be as wide as the
    shadow is long. A box reaches from x, y [px] and 1/z to x, y and 1/z; it is 1e9 to 0 if no sphere is visible.
    """
    center, low, high = np.empty(3), np.empty(3), np.empty(3)
    size = view.width // factor, view.height // factor
    for n in range(len(rows)):
        row, half, radius = rows[n], 0.5 * rows[n, LENGTH], np.float64(rows[n, RADIUS])
        reach = rows[n, REACH] + (KEPT_M + FADE_M) + half
        seen[n, :3], seen[n, 3:] = 1e9, 0
        for k in range(4 if row[SHARE] > 0 else 1):
            center[:] = 0
            for a in range(3):
                away = row[START + a] + 0.5 * row[ALONG + a] - (k - 0.5 if k else 0.0) / 3 * reach * row[LIGHT + a]
                for axis in range(3):
                    center[axis] += (away - view.eye[a]) * view.axes[a, axis]
            # the capsule, the light's disc at the far end of the section, and half the length of the section
            far = half + radius + (SPREAD * k / 3 + 1 / 6) * reach + 0.02
            z, r = center[2], far if k else half + row[PER_RANGE4] ** -0.25
            for a in range(2):
                f, c = view.intrinsics[a] / factor, view.intrinsics[2 + a] / factor
                if view.parallel:
                    low[a], high[a] = f * (center[a] - r) + c, f * (center[a] + r) + c
                else:  # both tangents from the eye, in the plane of the axis and z
                    apart = np.sqrt(max(center[a] * center[a] + z * z - r * r, 0.0))
                    middle, wide = np.arctan2(center[a], z), np.arctan2(r, max(apart, 1e-9))
                    front = z > r + 0.05 and apart > 0
                    # 1.5 rad is 86 degrees, beyond which the tangent explodes: such a sphere reaches past any picture
                    low[a] = f * np.tan(middle - wide) + c if front and middle - wide > -1.5 else -1e6
                    high[a] = f * np.tan(middle + wide) + c if front and middle + wide < 1.5 else 1e6
                low[a], high[a] = max(low[a], 0.0), min(high[a], float(size[a]))
            low[2], high[2] = 1 / max(z + r, 1e-3), 1 / max(z - r, 1e-6)
            if z + r > 0 and low[0] < high[0] and low[1] < high[1]:
                for a in range(3):
                    seen[n, a], seen[n, 3 + a] = min(seen[n, a], low[a]), max(seen[n, 3 + a], high[a])


@kernel(error_model="numpy", boundscheck=False)
def _fill_tiles(seen, index, rows, view, inv_z, factor, first, listed):
    """List the capsules of every tile by the space that is seen in it; return the length of all lists together.

    ``seen`` [n, 6] (`_on_screen`) is that of the capsules ``index`` [n].
    """
    count, height, width = 0, view.height // factor, view.width // factor
    across = -(-width // TILE_X)
    low_x, low_y, high_x, high_y = seen[:, 0].min(), seen[:, 1].min(), seen[:, 3].max(), seen[:, 4].max()
    for tile in range(len(first) - 1):
        first[tile] = count
        x0, y0 = (tile % across) * TILE_X, (tile // across) * TILE_Y
        x1, y1 = min(x0 + TILE_X, width), min(y0 + TILE_Y, height)
        if x0 >= high_x or x1 <= low_x or y0 >= high_y or y1 <= low_y:
            continue
        # 1/z grows towards the camera, and 0 is the background, which nothing darkens
        nearest, farthest = np.float32(0), np.float32(1e9)
        for y in range(y0 * factor, y1 * factor):
            for x in range(x0 * factor, x1 * factor):
                w = inv_z[y, x]
                nearest = max(nearest, w)
                farthest = min(farthest, w if w > 0 else np.float32(1e9))
        if nearest == 0:
            continue
        around = _around_tile(view, factor, x0, x1, y0, y1, 1 / nearest, 1 / farthest)
        for n in range(len(seen)):
            if (
                seen[n, 0] < x1
                and seen[n, 3] > x0
                and seen[n, 1] < y1
                and seen[n, 4] > y0
                and seen[n, 2] <= nearest
                and seen[n, 5] >= farthest
            ):
                bits = _matters(rows, index[n], around)
                if bits:
                    listed[count] = 4 * index[n] + bits
                    count += 1
    first[-1] = count
    return count


@kernel_part()
def _around_tile(view, factor, x0, x1, y0, y1, near, far):
    """Return a sphere around all points of a tile between two distances: x, y, z, radius."""
    fx, fy, cx, cy = view.intrinsics[0], view.intrinsics[1], view.intrinsics[2], view.intrinsics[3]
    # the sphere around a box around the eight corners: loose, but only a filter before the exact kernels
    low, high = (1e9, 1e9, 1e9), (-1e9, -1e9, -1e9)
    for corner in range(8):
        u = ((x1 if corner & 1 else x0) * factor - cx) / fx
        v = ((y1 if corner & 2 else y0) * factor - cy) / fy
        z = far if corner & 4 else near
        size = 1.0 if view.parallel else z
        p, a = view.eye, view.axes
        x = p[0] + (a[0, 0] * u + a[0, 1] * v) * size + a[0, 2] * z
        y = p[1] + (a[1, 0] * u + a[1, 1] * v) * size + a[1, 2] * z
        w = p[2] + (a[2, 0] * u + a[2, 1] * v) * size + a[2, 2] * z
        low = (min(low[0], x), min(low[1], y), min(low[2], w))
        high = (max(high[0], x), max(high[1], y), max(high[2], w))
    dx, dy, dz = high[0] - low[0], high[1] - low[1], high[2] - low[2]
    radius = 0.5 * np.sqrt(dx * dx + dy * dy + dz * dz) + 1e-3
    return (low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2, radius


@kernel_part(forceinline=True)
def _matters(rows, n, around):
    """Return which light a capsule may take from points in a sphere, by distances of `blockers_simd.block_block`."""
    px, py, pz = around[0] - rows[n, START], around[1] - rows[n, START + 1], around[2] - rows[n, START + 2]
    ax, ay, az = rows[n, ALONG], rows[n, ALONG + 1], rows[n, ALONG + 2]
    lx, ly, lz = rows[n, LIGHT], rows[n, LIGHT + 1], rows[n, LIGHT + 2]
    beside, ahead = px * ax + py * ay + pz * az, px * lx + py * ly + pz * lz
    bits = 0
    s = min(max(beside * rows[n, PER_LENGTH2], 0.0), 1.0)
    qx, qy, qz = ax * s - px, ay * s - py, az * s - pz
    distance = np.sqrt(qx * qx + qy * qy + qz * qz) - around[3]
    if distance <= 0 or distance**4 * rows[n, PER_RANGE4] < 1:
        bits |= _ALL
    if rows[n, SHARE] > 0:
        s = min(max((beside - ahead * rows[n, ALONG_LIGHT]) * rows[n, PER_ACROSS2], 0.0), 1.0)
        qx, qy, qz = ax * s - px, ay * s - py, az * s - pz
        away = s * rows[n, ALONG_LIGHT] - ahead
        off = np.sqrt(max(qx * qx + qy * qy + qz * qz - away * away, 0.0))
        # points beside the middle may see another part of the axis
        high = max(rows[n, ALONG_LIGHT], 0.0) - ahead + around[3]
        low = min(rows[n, ALONG_LIGHT], 0.0) - ahead - around[3]
        longest = rows[n, REACH] + KEPT_M + FADE_M
        if high > 0 and low < longest:
            disc = max(min(high, longest) * SPREAD, 0.01)
            if off < disc + rows[n, RADIUS] + around[3]:
                bits |= _ONE
    return bits


# --- inside the shading kernel -------------------------------------------------------------------------------------------
@kernel_part(forceinline=True)
def owner_of(blockers, target, word):
    """Return the group of the instance in a pixel's word, or -1 if it has no group."""
    instance = target.draws[word >> 7, INSTANCE]
    return blockers.tints[instance, 3]


@kernel_part(forceinline=True)
def set_rays(rays, lane, view, axes, u, v, step):
    """Fill the rays of pixels from ``lane`` on, with directions (u, v, 1), (u + step, v, 1), and so on.

    ``axes`` [3, 3] rotates the directions from the camera to the world.
    """
    for k in range(3):
        aside = view.axes[k, 0] if view.parallel else 0.0
        beside = aside * u + (view.axes[k, 1] * v if view.parallel else 0.0)
        origin, direction = np.float32(view.eye[k]), np.float32(axes[k, 0] * u + axes[k, 1] * v + axes[k, 2])
        origin, across, turned = np.float32(origin + beside), np.float32(aside * step), np.float32(axes[k, 0] * step)
        for other in range(lane, LANES):
            rays[ORIGIN + k, other] = origin + across * np.float32(other - lane)
            rays[DIRECTION + k, other] = direction + turned * np.float32(other - lane)


@kernel_part()
def block_pixels(blockers, tile, rays, near_at, owners_at, only, strip_at, row_bytes, scratch):
    """Dim 8 pixels of a strip (levels and normals, `shading_simd`) by the capsules of a tile.

    ``only`` is the group of all 8, or -1; its own capsules are skipped.
    """
    rows, scratch_at = blockers.rows, np.uintp(scratch.ctypes.data)
    rows_at, stride = np.uintp(rows.ctypes.data), np.uintp(BLOCKER_WORDS * 4)
    begin, end = blockers.first[tile], blockers.first[tile + 1]
    begin_block(np.uintp(rays.ctypes.data), near_at, scratch_at)
    for k in range(begin, end):
        n, bits = blockers.listed[k] >> 2, blockers.listed[k] & 3
        # the common case, a tile full of one body, saves the whole capsule instead of masking all 8 pixels
        if rows[n, GROUP] == only:
            continue
        blocker_at = rows_at + np.uintp(n) * stride
        if bits & _ALL:
            block_all_light(blocker_at, strip_at, row_bytes, owners_at, scratch_at)
        if bits & _ONE:
            block_one_direction(blocker_at, owners_at, scratch_at)
        if k + 1 == end or rows[blockers.listed[k + 1] >> 2, GROUP] != rows[n, GROUP]:
            end_group_block(blocker_at, strip_at, row_bytes, scratch_at)
    dim_levels_block(near_at, strip_at, row_bytes, scratch_at)
