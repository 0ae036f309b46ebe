"""RGB and normals from the visibility buffer, shaded once per pixel (at visible edges, with ``samples=4``, once per triangle).

Colours are linear internally. Light comes from a hemisphere (sky above, floor below), one sun, a weak fill light and a
headlight; corners and contacts are darkened (`occlusion`); cast shadows are optional (`Light.shadow_rays`). Surfaces
are lit on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import normalized
from h3data.kernels import kernel, kernel_part
from h3data.render.raster.raster import CLUSTER, FAR_PADDING, INSTANCE, Geometry, Placement, Target, View
from h3data.render.shade.blockers import (
    NO_BLOCKERS,
    TILE_X,
    TILE_Y,
    Blockers,
    Tiled,
    block_pixels,
    changed_tiles,
    owner_of,
    set_rays,
    tiled,
)
from h3data.render.shade.blockers_simd import RAY_ROWS, SCRATCH_ROWS
from h3data.render.shade.borrowed import borrowed
from h3data.render.shade.marks import SHADED, any_marked, mark_row, mark_run, marked_runs, next_blocks
from h3data.render.shade.occlusion import Occlusion, dim_row, light_left, occlude, receded
from h3data.render.shade.shading_setup import NO_TEXTURE, new_cache, set_up, slot_of
from h3data.render.shade.shading_simd import (
    ATTRIBUTES,
    BLOCK_WORDS,
    COLOR,
    COLOR_1,
    COLOR_2,
    GLOSS,
    LEVEL,
    RAY,
    TONE_LIMIT,
    TONE_SIZE,
    equal_words,
    even_nearness,
    gloss_block,
    light_block,
    light_coordinates_block,
    sky_block,
    texture_block,
    write_colors,
)
from h3data.render.shade.surface import Surface
from h3data.render.shade.textures_simd import LEVEL_WORDS, ONE_LEVEL
from h3data.srgb import bytes_to_linear, linear_to_srgb

Color = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Light:
    """Light of a scene; colours are linear RGB."""

    sky: Color = (0.56, 0.58, 0.61)
    """Ambient light on surfaces that face up."""
    ground: Color = (0.44, 0.42, 0.39)
    """Ambient light on surfaces that face down."""
    sun: Color = (0.42, 0.40, 0.36)
    sun_direction: Color = (0.28, 0.75, 0.60)
    """Direction towards the sun in the world frame, which is not halfway between x and z, so that the walls of a corner
    differ."""
    fill: Color = (0.10, 0.12, 0.15)
    fill_direction: Color = (-0.90, 0.15, -0.35)
    """Direction towards a weak second light on the other side, by which the remaining walls differ."""
    headlight: Color = (0.08, 0.08, 0.08)
    """Light from the camera; keeps shapes readable where no other light reaches."""
    horizon: Color = (0.80, 0.85, 0.90)
    """Background colour at eye level and below."""
    zenith: Color = (0.45, 0.60, 0.80)
    """Background colour straight up."""
    occlusion: float = 0.7
    """Strength of the darkening of corners and contacts, 0..1; 0 switches it off at no cost."""
    shadow_rays: int = 0
    """Rays towards the sun per pixel, for cast shadows with soft edges; 0 = no cast shadows. Needs the extra ``rays``."""
    sun_size_deg: float = 2.0
    """Angular diameter of the sun (0.5 in reality); larger values give softer shadow edges."""

    def __post_init__(self) -> None:
        colors = ("sky", "ground", "sun", "fill", "headlight", "horizon", "zenith")
        faults = [
            f"{name} = {getattr(self, name)}"
            for name in (*colors, "sun_direction", "fill_direction", "occlusion")
            if not np.isfinite(getattr(self, name)).all() or (name in colors and min(getattr(self, name)) < 0)
        ]
        if faults:
            raise InputError(
                f"Light needs finite numbers and no negative power, got {', '.join(faults)}.", code="H3-RENDER-068"
            )


_PADDING = np.int32(-3)
"""Word after the end of a row of pixels, which ends the last run of equal pixels."""
_MIXED = np.int32(-2)
"""Word of pixels whose four samples contain an edge."""
_SMOOTH_DEPTH = np.float32(0.01)
"""Relative difference of depths below which samples of one patch are of one surface, and not of a fold in front of
it."""
_BRIGHTEST_SAMPLE = int(1.25 * TONE_SIZE / TONE_LIMIT)
"""Level to which samples are clipped before averaging, because otherwise one bright sample would erode an edge."""


def tone_map(value: NDArray[np.floating]) -> NDArray[np.floating]:
    """Compress linear values: unchanged up to 0.75, compressed smoothly above, approaching 1 at infinity."""
    shoulder = 0.75
    # the slope at the shoulder is 1 on both sides, so that no band shows there
    rest = 1 - shoulder
    return np.where(value <= shoulder, value, 1 - rest * np.exp(-np.maximum(value - shoulder, 0) / rest))


LINEAR_OF_BYTE = bytes_to_linear(np.arange(256)).astype(np.float32)
BYTE_OF_LINEAR = np.round(
    255 * linear_to_srgb(tone_map((np.arange(TONE_SIZE) + 0.5) * (TONE_LIMIT / TONE_SIZE)))
).astype(np.uint8)


_NO_OCCLUSION = Occlusion(
    np.zeros((0, 0), np.float32),
    np.zeros((4, 0, 0), np.float32),
    np.zeros((3, 0, 0), np.float32),
    np.zeros((0, 0), np.uint8),
)


@dataclass
class KeptPicture:
    """Last image of a static camera, with the inputs of its shading, so that only changes are shaded again."""

    rgb: NDArray[np.uint8]
    """Colours (sRGB) of the image, shape [H, W, 3]."""
    occlusion: Occlusion | None = None
    cast: Tiled | None = None
    """Tiles of the capsules that cast shadows; None if there is no image yet."""


def light_table(light: Light) -> NDArray[np.float32]:
    """Return a light as the table of numbers that `shading_simd` reads, shape [27]."""
    sky, ground = np.array(light.sky), np.array(light.ground)
    colors = [(sky + ground) / 2, (sky - ground) / 2, light.sun, light.fill, light.headlight]
    directions = [normalized(np.array(light.sun_direction)), normalized(np.array(light.fill_direction))]
    return np.concatenate([*colors, *directions, light.horizon, light.zenith]).astype(np.float32)


def shade(
    geometry: Geometry,
    surface: Surface,
    placement: Placement,
    view: View,
    target: Target,
    light: Light,
    rgb: NDArray[np.uint8] | None,
    normal: NDArray[np.float32] | None,
    blockers: Blockers | None = None,
    patches: NDArray[np.int32] | None = None,
    kept: KeptPicture | None = None,
) -> None:
    """Fill ``rgb`` [H, W, 3] and ``normal`` [H, W, 3], where given, from a rendered target.

    ``blockers`` cast soft shadows in ``rgb``.
    With ``patches`` [F] (`patches.smooth_patches`), target and view have twice the size of ``rgb``: pixels whose four
    samples see different patches, or a fold of one patch, are averaged in linear light, and all other pixels are shaded
    once. With ``kept``, the record of the previous image of ``target``, only changed pixels are shaded, with
    bit-identical results; ``kept`` is updated.
    """
    samples = 1 if patches is None else 4
    strength = light.occlusion if rgb is not None else 0.0
    cast = NO_BLOCKERS if rgb is None else tiled(blockers, view, target, factor=2 if samples == 4 else 1)
    cast_changed, again, before = np.zeros(0, np.uint8), False, None
    if kept is not None:
        if kept.cast is not None:
            cast_changed, again, before = changed_tiles(kept.cast, cast), True, kept.occlusion
        # a copy: they are compared with those of the next picture, and the caller may write the next rows into the same array
        kept.cast = cast._replace(rows=cast.rows.copy())
    if view.parallel and strength > 0:
        # occlusion is computed for 1/z, which an orthographic target does not hold
        target = target._replace(inv_z=receded(view, target))
    occlusion = occlude(view, target, samples, before=before) if strength > 0 else _NO_OCCLUSION
    picture = np.zeros((0, 0, 3), np.uint8) if rgb is None else rgb
    if kept is not None:
        picture, kept.occlusion = kept.rgb, occlusion
    _shade_image(
        geometry,
        surface,
        placement.matrix,
        view,
        target,
        new_cache(),
        light_table(light),
        (LINEAR_OF_BYTE, BYTE_OF_LINEAR),
        occlusion,
        np.float32(strength),
        cast,
        cast_changed,
        picture,
        np.zeros((0, 0, 3), np.float32) if normal is None else normal,
        np.zeros(0, np.int32) if patches is None else patches,
        samples == 4,
        again,
    )
    if kept is not None and rgb is not None:
        rgb[:] = picture


@kernel(error_model="numpy", boundscheck=False)
def _shade_image(
    geometry,
    surface,
    matrices,
    view,
    target,
    cache,
    light,
    tables,
    occlusion,
    strength,
    cast,
    cast_changed,
    rgb,
    normal,
    patches,
    fine,
    again,
):
    geometry, surface, target = borrowed(geometry), borrowed(surface), borrowed(target)
    cache, occlusion, cast = borrowed(cache), borrowed(occlusion), borrowed(cast)
    factor = 2 if fine else 1
    height, width = view.height // factor, view.width // factor
    cofactors = _normal_matrices(matrices)
    texture_at = (np.uintp(surface.textures.levels.ctypes.data), np.uintp(surface.textures.words.ctypes.data))
    block = np.empty(BLOCK_WORDS, np.float32)
    strip = np.zeros((6, width + 8), np.int32)  # 8 more: blocks may overrun
    sample = np.zeros((6, 8), np.int32)
    coordinates = np.zeros((3, width + 8), np.float32)
    row = np.full(width + 8, _PADDING, np.int32)
    marks = np.full(width + 8, SHADED, np.uint8)
    near = np.zeros(width + 8, np.float32)
    owners, rays = np.zeros(width + 8, np.float32), np.zeros((RAY_ROWS, 8), np.float32)
    scratch = np.zeros((SCRATCH_ROWS, 8), np.float32)
    # samples at edges, of one tile of capsules, until there are eight: levels and normals; 1/z and owner; pixel and weight
    waiting, behind, places = np.zeros((6, 8), np.int32), np.zeros((2, 8), np.float32), np.zeros((2, 8), np.int32)
    row_at, inv_z_at = np.uintp(row.ctypes.data), np.uintp(target.inv_z.ctypes.data)
    inv_z_bytes = np.uintp(target.inv_z.shape[1] * 4)
    near_at, owners_at = np.uintp(near.ctypes.data), np.uintp(owners.ctypes.data)
    strip_at, strip_bytes = np.uintp(strip.ctypes.data), np.uintp(strip.shape[1] * 4)
    words, axes = target.words, view.axes.copy()
    if view.parallel:  # all rays have the same direction
        axes[:, :2] = 0
    linear, byte_of_level = tables
    bytes_at, rgb_at = np.uintp(byte_of_level.ctypes.data), np.uintp(rgb.ctypes.data)
    fx, fy, cx, cy = view.intrinsics[0], view.intrinsics[1], view.intrinsics[2], view.intrinsics[3]
    pixel = (factor / fx, factor / fy)
    tiles_across = -(-width // TILE_X)
    for y in range(height):
        first, last = 0, width
        if again:
            mark_row(marks, target.tile_drawn, occlusion.changed, cast_changed, factor, y, width)
            first, last = marked_runs(marks, words[factor * y], factor, width)
            if first == last:
                continue
        if fine:
            _fine_row_words(geometry, surface, target, patches, y, row, first, last)
        else:
            for x in range(first, last):  # by element: to copy slices, numba compiles an error text for 2 s
                row[x] = words[y, x]
        row[last] = _PADDING
        tile_row = y // TILE_Y * tiles_across
        blocked = len(cast.first) > 0 and cast.first[tile_row] < cast.first[tile_row + tiles_across]
        v = ((y + 0.5) * factor - cy) / fy
        x, count, waited = first, 0, 0
        while x < last:
            word = row[x]
            end = x + 1
            if word != _MIXED:  # to the end of the run
                equal = equal_words(row_at + np.uintp(end * 4), word)
                end += equal
                while equal == 8:
                    equal = equal_words(row_at + np.uintp(end * 4), word)
                    end += equal
                u, step = ((x + 0.5) * factor - cx) / fx, pixel[0]
                low, high = x, end
                if again:
                    mark_run(marks, x, end)
                    low, high = next_blocks(marks, x, x, end)
                while low < end:
                    if word >= 0:
                        slot = slot_of(word)
                        if cache.words[slot] != word:
                            set_up(word, slot, cache, geometry, surface, cofactors, view, target, linear, pixel)
                            _tint(word, slot, cache, cast, target)
                        _light_run(
                            slot, cache, texture_at, u, v, step, x, low, high, axes, light, block, coordinates, strip
                        )
                    else:
                        _sky_run(u, v, step, x, low, high, axes, light, block, strip)
                    low = high
                    if again:
                        low, high = next_blocks(marks, x, low, end)
            elif marks[x]:  # a pixel of its own
                marks[x] |= SHADED
                strip[:3, x] = 0
                seen = (
                    words[2 * y, 2 * x],
                    words[2 * y, 2 * x + 1],
                    words[2 * y + 1, 2 * x],
                    words[2 * y + 1, 2 * x + 1],
                )
                for k in range(4):
                    sx, sy = 2 * x + (k & 1), 2 * y + (k >> 1)
                    word, alike, right, down = _alike(seen, k)
                    if not alike:
                        continue  # samples of one triangle are shaded once, in their middle
                    u1 = (2 * x + right / alike + 0.5 - cx) / fx
                    v1 = (2 * y + down / alike + 0.5 - cy) / fy
                    if word >= 0:
                        slot = slot_of(word)
                        if cache.words[slot] != word:
                            set_up(word, slot, cache, geometry, surface, cofactors, view, target, linear, pixel)
                            _tint(word, slot, cache, cast, target)
                        _light_run(
                            slot, cache, texture_at, u1, v1, 0.0, 0, 0, 1, axes, light, block, coordinates, sample
                        )
                    else:
                        _sky_run(u1, v1, 0.0, 0, 0, 1, axes, light, block, sample)
                    left = light_left(occlusion, strength, x, y, target.inv_z[sy, sx]) if strength > 0 else 1.0
                    for a in range(3):
                        sample[a, 0] = int(min(sample[a, 0], _BRIGHTEST_SAMPLE) * left)
                    tile = tile_row + x // TILE_X
                    if blocked and word >= 0 and cast.first[tile] < cast.first[tile + 1]:
                        if count == 8 or tile != waited:
                            _dim_waiting(cast, waited, rays, behind, waiting, scratch, places, count, strip)
                            count, waited = 0, tile
                        for a in range(6):
                            waiting[a, count] = sample[a, 0]
                        behind[0, count], behind[1, count] = cast.inv_z[sy, sx], owner_of(cast, target, word)
                        places[0, count], places[1, count] = x, alike
                        set_rays(rays, count, view, axes, u1, v1, 0.0)
                        count += 1
                    else:
                        for a in range(3):
                            strip[a, x] += sample[a, 0] * alike
            x = end
        if fine:
            _dim_waiting(cast, waited, rays, behind, waiting, scratch, places, count, strip)
            for a in range(3):
                for x in range(first, last):
                    strip[a, x] >>= 2 if row[x] == _MIXED else 0
        if strength > 0:
            line_at = inv_z_at + np.uintp(y * factor) * inv_z_bytes
            if fine:
                for x in range(first, last, 8):
                    at = np.uintp(x * 4)
                    even_nearness(line_at + at + at, row_at + at, _MIXED, np.float32(FAR_PADDING), near_at + at)
                near[width:] = 0
                line_at = near_at
            dim_row(occlusion, strength, y, width, line_at, strip, marks)
        if blocked:
            for k in range(tiles_across):
                tile = tile_row + k
                if cast.first[tile] == cast.first[tile + 1]:
                    continue
                begin = k * TILE_X
                for x in range(begin, min(begin + TILE_X, width)):
                    whole = row[x] >= 0
                    near[x] = cast.inv_z[y * factor, x * factor] if whole else 0.0
                    owners[x] = owner_of(cast, target, row[x]) if whole else -1.0
                for x in range(begin, min(begin + TILE_X, width), 8):
                    if not any_marked(marks, x, x + 8, SHADED):
                        continue
                    at, only = np.uintp(x * 4), owners[x]
                    for lane in range(1, 8):
                        only = only if owners[x + lane] == owners[x] else np.float32(-1)
                    set_rays(rays, 0, view, axes, ((x + 0.5) * factor - cx) / fx, v, pixel[0])
                    block_pixels(
                        cast, tile, rays, near_at + at, owners_at + at, only, strip_at + at, strip_bytes, scratch
                    )
        if rgb.size:
            begin = first if again else width // 8 * 8  # where all pixels are shaded, eight are written at once
            for x in range(first, begin, 8):
                line_at = rgb_at + np.uintp((y * width + x) * 3)
                write_colors(strip_at + np.uintp(x * 4), strip_bytes, bytes_at, line_at)
            for x in range(begin, last):
                if marks[x] & SHADED:
                    for a in range(3):
                        rgb[y, x, a] = byte_of_level[strip[a, x]]
        if normal.size:
            normals = strip.view(np.float32)
            for x in range(width):
                for a in range(3):
                    normal[y, x, a] = normals[3 + a, x]


@kernel_part(forceinline=True)
def _alike(seen, k):
    """The word of the ``k``-th of four samples, how many show it, and how many of these on the right and below.

    There are 0 if an earlier sample shows it too.
    """
    word = seen[k]
    a, b, c, d = (seen[0] == word) * 1, (seen[1] == word) * 1, (seen[2] == word) * 1, (seen[3] == word) * 1
    earlier = (a if k > 0 else 0) + (b if k > 1 else 0) + (c if k > 2 else 0)
    return word, (0 if earlier else a + b + c + d), b + d, c + d


@kernel_part()
def _dim_waiting(cast, tile, rays, behind, waiting, scratch, places, count, strip):
    """Dim ``count`` samples by the capsules of a tile, and add the samples to their pixels of a strip."""
    if count:
        near_at, at, row_bytes = (
            np.uintp(behind.ctypes.data),
            np.uintp(waiting.ctypes.data),
            np.uintp(waiting.shape[1] * 4),
        )
        block_pixels(cast, tile, rays, near_at, near_at + row_bytes, np.float32(-1), at, row_bytes, scratch)
        for k in range(count):
            for a in range(3):
                strip[a, places[0, k]] += waiting[a, k] * places[1, k]


@kernel_part()
def _fine_row_words(geometry, surface, target, patches, y, row, first, last):
    """Fill the words of an image row [W] from ``first`` to ``last``.

    A word is that of one of the four samples if they show one surface, else `_MIXED`.
    """
    words, inv_z = target.words, target.inv_z
    for x in range(first, last):
        word = words[2 * y, 2 * x]
        row[x] = word
        right, lower, both = words[2 * y, 2 * x + 1], words[2 * y + 1, 2 * x], words[2 * y + 1, 2 * x + 1]
        if word == right and word == lower and word == both:
            continue
        row[x] = _MIXED
        # the background has no triangle whose patch could be compared
        if word < 0 or right < 0 or lower < 0 or both < 0:
            continue
        near, other, third, fourth = (
            inv_z[2 * y, 2 * x],
            inv_z[2 * y, 2 * x + 1],
            inv_z[2 * y + 1, 2 * x],
            inv_z[2 * y + 1, 2 * x + 1],
        )
        nearest, farthest = max(max(near, other), max(third, fourth)), min(min(near, other), min(third, fourth))
        if nearest - farthest > _SMOOTH_DEPTH * nearest:
            continue
        instance, patch = target.draws[word >> 7, INSTANCE], _patch_of(geometry, surface, target, patches, word)
        smooth = True
        for more in (right, lower, both):
            smooth &= (target.draws[more >> 7, INSTANCE] == instance) & (
                _patch_of(geometry, surface, target, patches, more) == patch
            )
        if smooth:
            row[x] = word


@kernel_part(forceinline=True)
def _patch_of(geometry, surface, target, patches, word):
    packet = geometry.cluster_packets[target.draws[word >> 7, CLUSTER], 0] + ((word & 127) >> 3)
    return patches[surface.packet_faces[packet, word & 7]]


@kernel_part()
def _normal_matrices(matrices):
    """Return the cofactors [I, 3, 3] of the 3x3 parts.

    They transform normals correctly under any scale, up to length and sign.
    """
    out = np.empty((len(matrices), 3, 3))
    for i in range(len(matrices)):
        m = matrices[i]
        for r in range(3):
            for c in range(3):
                r1, r2, c1, c2 = (r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3
                out[i, r, c] = m[r1, c1] * m[r2, c2] - m[r1, c2] * m[r2, c1]
    return out


@kernel_part(forceinline=True)
def _tint(word, slot, cache, cast, target):
    """Multiply the colours of a cached triangle by its instance's tint."""
    if cast.tints.size:
        instance = target.draws[word >> 7, INSTANCE]
        attributes = cache.attributes[slot]
        for a in range(3):
            for corner in (COLOR, COLOR_1, COLOR_2):
                attributes[corner + a] *= cast.tints[instance, a]


# --- runs of pixels -------------------------------------------------------------------------------------------------
@kernel_part(forceinline=True)
def _light_run(slot, cache, texture_at, u, v, step, begin, low, end, axes, light, block, coordinates, strip):
    """Light pixels low..end of a strip, which see one triangle; the ray of the pixel ``begin`` is (u, v, 1)."""
    _, planes, attributes, levels = cache
    strip_at, row_bytes = np.uintp(strip.ctypes.data), np.uintp(strip.shape[1] * 4)
    attributes_at = np.uintp(attributes.ctypes.data) + np.uintp(slot * ATTRIBUTES * 4)
    block_at, light_at = np.uintp(block.ctypes.data), np.uintp(light.ctypes.data)
    coordinates_at, coordinates_bytes = np.uintp(coordinates.ctypes.data), np.uintp(coordinates.shape[1] * 4)
    level = levels[slot]
    for k in range(3):
        block[2 * k + 1] = planes[slot, k, 0] * step
        block[RAY + 2 * k + 1] = axes[k, 0] * step
    # blocks start from numbers in double: a plane that is stepped through a wide picture in float32 would drift
    for x in range(low, end, 8):
        first = u + step * (x - begin)
        for k in range(3):
            block[2 * k] = planes[slot, k, 0] * first + planes[slot, k, 1] * v + planes[slot, k, 2]
            block[RAY + 2 * k] = axes[k, 0] * first + axes[k, 1] * v + axes[k, 2]
        at = strip_at + np.uintp(x * 4)
        if level == NO_TEXTURE:
            light_block(block_at, attributes_at, light_at, at, row_bytes)
        else:
            uv_at = coordinates_at + np.uintp(x * 4)
            light_coordinates_block(block_at, attributes_at, light_at, at, row_bytes, uv_at, coordinates_bytes)
    if level != NO_TEXTURE:
        levels_at, words_at = texture_at[0] + np.uintp(level * LEVEL_WORDS * 4), texture_at[1]
        for x in range(low, end, 8):
            at, uv_at = strip_at + np.uintp(x * 4), coordinates_at + np.uintp(x * 4)
            detail = coordinates[LEVEL, x]  # the first pixel decides for all 8
            base = np.int32(detail + np.float32(ONE_LEVEL))
            blended = np.int32(detail - base > np.float32(ONE_LEVEL - 0.1))  # margin for the other pixels
            texture_block(at, row_bytes, uv_at, coordinates_bytes, base, blended, levels_at, words_at)
    # after the texture, because mirrored light does not take the colour of the floor
    if attributes[slot, GLOSS] > 0:
        for x in range(low, end, 8):
            first = u + step * (x - begin)
            for k in range(3):
                block[2 * k] = planes[slot, k, 0] * first + planes[slot, k, 1] * v + planes[slot, k, 2]
                block[RAY + 2 * k] = axes[k, 0] * first + axes[k, 1] * v + axes[k, 2]
            gloss_block(block_at, attributes_at, strip_at + np.uintp(x * 4), row_bytes)


@kernel_part(forceinline=True)
def _sky_run(u, v, step, begin, low, end, axes, light, block, strip):
    """Fill background pixels low..end of a strip; the ray of the pixel ``begin`` is (u, v, 1)."""
    strip_at, row_bytes = np.uintp(strip.ctypes.data), np.uintp(strip.shape[1] * 4)
    block_at, light_at = np.uintp(block.ctypes.data), np.uintp(light.ctypes.data)
    for k in range(3):
        block[RAY + 2 * k + 1] = axes[k, 0] * step
    for x in range(low, end, 8):
        first = u + step * (x - begin)
        for k in range(3):
            block[RAY + 2 * k] = axes[k, 0] * first + axes[k, 1] * v + axes[k, 2]
        sky_block(block_at, light_at, strip_at + np.uintp(x * 4), row_bytes)
