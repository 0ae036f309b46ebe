"""RGB and normals from the visibility buffer, once per pixel (or once per quarter pixel at edges).

Colours are linear inside. Light is a hemisphere (sky above, floor below), one sun, a weak fill light and one at the camera;
there are no cast shadows, but corners and contacts get darker (`occlusion`). Surfaces are lit on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from h3data.geometry import normalized
from h3data.kernels import kernel
from h3data.render.occlusion import Occlusion, dim_row, light_left, occlude
from h3data.render.raster import CLUSTER, FAR_PADDING, INSTANCE, Geometry, Placement, Target, View
from h3data.render.scene import Surface
from h3data.render.shading_simd import (
    ATTRIBUTES,
    BLOCK_WORDS,
    COLOR,
    COLOR_1,
    COLOR_2,
    NORMAL,
    NORMAL_1,
    NORMAL_2,
    RAY,
    TONE_LIMIT,
    TONE_SIZE,
    light_block,
    sky_block,
)
from h3data.srgb import bytes_to_linear, linear_to_srgb

Color = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Light:
    """Light of a scene; colours are linear RGB."""

    sky: Color = (0.56, 0.58, 0.61)
    """What a surface that faces up gets from all around."""
    ground: Color = (0.44, 0.42, 0.39)
    """What a surface that faces down gets."""
    sun: Color = (0.42, 0.40, 0.36)
    sun_direction: Color = (0.28, 0.75, 0.60)
    """Towards the sun, world frame; not halfway between x and z, so that walls at a corner differ."""
    fill: Color = (0.10, 0.12, 0.15)
    fill_direction: Color = (-0.90, 0.15, -0.35)
    """A weak second light from the other side, for the same reason."""
    headlight: Color = (0.08, 0.08, 0.08)
    """From the camera; keeps shapes readable that no other light reaches."""
    horizon: Color = (0.80, 0.85, 0.90)
    """Background at eye level and below."""
    zenith: Color = (0.45, 0.60, 0.80)
    """Background straight up."""
    occlusion: float = 0.7
    """How much darker corners and contacts get, 0..1; 0 switches it off (and costs nothing)."""


_SHOULDER = 0.75
_CACHE_SIZE = 1024
"""Triangles whose set-up is kept within a picture (power of two)."""
_MIXED = np.int32(-2)
"""Stands in a row of words for "four samples that differ"."""
_BRIGHTEST_SAMPLE = int(1.25 * TONE_SIZE / TONE_LIMIT)
"""Samples are averaged up to this level, or one bright spot would eat an edge."""


def tone_map(value: NDArray[np.floating]) -> NDArray[np.floating]:
    """Linear values, unchanged up to 0.75, above bent smoothly so that 1 is only reached at infinity."""
    rest = 1 - _SHOULDER
    return np.where(value <= _SHOULDER, value, 1 - rest * np.exp(-np.maximum(value - _SHOULDER, 0) / rest))


_LINEAR_OF_BYTE = bytes_to_linear(np.arange(256)).astype(np.float32)
_BYTE_OF_LINEAR = np.round(
    255 * linear_to_srgb(tone_map((np.arange(TONE_SIZE) + 0.5) * (TONE_LIMIT / TONE_SIZE)))
).astype(np.uint8)


_NO_OCCLUSION = Occlusion(np.zeros((0, 0), np.float32), np.zeros((4, 0, 0), np.float32))


def _light_table(light: Light) -> NDArray[np.float32]:
    sky, ground = np.array(light.sky), np.array(light.ground)
    colors = [(sky + ground) / 2, (sky - ground) / 2, light.sun, light.fill, light.headlight]
    directions = [normalized(np.array(light.sun_direction)), normalized(np.array(light.fill_direction))]
    return np.concatenate([*colors, *directions, light.horizon, light.zenith]).astype(np.float32)


def shade(
    geometry: Geometry,
    surface: Surface,
    normals: NDArray[np.float32],
    placement: Placement,
    view: View,
    target: Target,
    light: Light,
    rgb: NDArray[np.uint8] | None,
    normal: NDArray[np.float32] | None,
    samples: int,
) -> None:
    """Write ``rgb`` [H, W, 3] and ``normal`` [H, W, 3] of a drawn target; None is left out.

    With ``samples=4`` target and view have twice the size of ``rgb``, and pixels in which not all four samples see the
    same triangle are averaged (in linear light).
    """
    no_rgb, no_normal = np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0, 3), np.float32)
    strength = light.occlusion if rgb is not None else 0.0
    occlusion = occlude(view, target, samples) if strength > 0 else _NO_OCCLUSION
    _shade_image(
        geometry,
        (surface.faces, surface.colors, normals, surface.packet_faces),
        placement.matrix,
        view,
        target,
        _light_table(light),
        (_LINEAR_OF_BYTE, _BYTE_OF_LINEAR),
        occlusion,
        np.float32(strength),
        no_rgb if rgb is None else rgb,
        no_normal if normal is None else normal,
        samples == 4,
    )


@kernel(error_model="numpy", boundscheck=False)
def _shade_image(geometry, surface, matrices, view, target, light, tables, occlusion, strength, rgb, normal, fine):
    factor = 2 if fine else 1
    height, width = view.height // factor, view.width // factor
    cofactors = _normal_matrices(matrices)
    tags = np.full(_CACHE_SIZE, -1, np.int32)
    planes = np.zeros((_CACHE_SIZE, 3, 3))
    attributes = np.zeros((_CACHE_SIZE, ATTRIBUTES), np.float32)
    block = np.empty(BLOCK_WORDS, np.float32)
    strip = np.zeros((6, width + 8), np.int32)  # 8 more: blocks may overrun
    sample = np.zeros((6, 8), np.int32)
    row = np.zeros(width, np.int32)
    near = np.zeros(width + 8, np.float32)
    words, axes = target.words, view.axes
    linear, byte_of_level = tables
    fx, fy, cx, cy = view.intrinsics[0], view.intrinsics[1], view.intrinsics[2], view.intrinsics[3]
    for y in range(height):
        _row_words(words, y, fine, row)
        v = ((y + 0.5) * factor - cy) / fy
        x = 0
        while x < width:
            word = row[x]
            end = x + 1
            if word == _MIXED:
                strip[:3, x] = 0
                for k in range(4):
                    sx, sy = 2 * x + (k & 1), 2 * y + (k >> 1)
                    u1, v1 = (sx + 0.5 - cx) / fx, (sy + 0.5 - cy) / fy
                    word = words[sy, sx]
                    if word >= 0:
                        slot = _slot(word)
                        if tags[slot] != word:
                            tags[slot] = word
                            _set_up(word, slot, geometry, surface, cofactors, axes, target, linear, planes, attributes)
                        _light_run(slot, planes, attributes, u1, v1, 0.0, 0, 1, axes, light, block, sample)
                    else:
                        _sky_run(u1, v1, 0.0, 0, 1, axes, light, block, sample)
                    left = light_left(occlusion, strength, x, y, target.inv_z[sy, sx]) if strength > 0 else 1.0
                    for a in range(3):
                        strip[a, x] += int(min(sample[a, 0], _BRIGHTEST_SAMPLE) * left)
                for a in range(3):
                    strip[a, x] >>= 2
            else:
                while end < width and row[end] == word:
                    end += 1
                u, step = ((x + 0.5) * factor - cx) / fx, factor / fx
                if word >= 0:
                    slot = _slot(word)
                    if tags[slot] != word:
                        tags[slot] = word
                        _set_up(word, slot, geometry, surface, cofactors, axes, target, linear, planes, attributes)
                    _light_run(slot, planes, attributes, u, v, step, x, end, axes, light, block, strip)
                else:
                    _sky_run(u, v, step, x, end, axes, light, block, strip)
            x = end
        if strength > 0:
            for x in range(width):
                near[x] = target.inv_z[y * factor, x * factor] if row[x] != _MIXED else FAR_PADDING
            dim_row(occlusion, strength, y, near, strip)
        if rgb.size:
            for x in range(width):
                for a in range(3):
                    rgb[y, x, a] = byte_of_level[strip[a, x]]
        if normal.size:
            normals = strip.view(np.float32)
            for x in range(width):
                for a in range(3):
                    normal[y, x, a] = normals[3 + a, x]


@njit(nogil=True)
def _row_words(words, y, fine, row):
    """Write the words of a picture's row [W]; `_MIXED` where the four samples of a pixel differ."""
    if not fine:
        row[:] = words[y, : len(row)]
        return
    upper, lower = words[2 * y], words[2 * y + 1]
    for x in range(len(row)):
        word = upper[2 * x]
        same = (word == upper[2 * x + 1]) & (word == lower[2 * x]) & (word == lower[2 * x + 1])
        row[x] = word if same else _MIXED


@njit(nogil=True)
def _normal_matrices(matrices):
    """Cofactors of the 3x3 parts [I, 3, 3]: they turn normals rightly under any scale (up to length and sign)."""
    out = np.empty((len(matrices), 3, 3))
    for i in range(len(matrices)):
        m = matrices[i]
        for r in range(3):
            r1, r2 = (r + 1) % 3, (r + 2) % 3
            for c in range(3):
                c1, c2 = (c + 1) % 3, (c + 2) % 3
                out[i, r, c] = m[r1, c1] * m[r2, c2] - m[r1, c2] * m[r2, c1]
    return out


# --- triangles ------------------------------------------------------------------------------------------------------
@njit(nogil=True, forceinline=True)
def _slot(word):
    """Where a triangle's set-up is kept."""
    return (word ^ (word >> 10)) & (_CACHE_SIZE - 1)


@njit(nogil=True)
def _set_up(word, slot, geometry, surface, cofactors, axes, target, linear, planes, attributes):
    """Set up the triangle behind a pixel's word."""
    instance, cluster = target.draws[word >> 7, INSTANCE], target.draws[word >> 7, CLUSTER]
    packet = geometry.cluster_packets[cluster, 0] + ((word & 127) >> 3)
    lane = word & 7
    face = surface[3][packet, lane]
    shared = len(geometry.shared_packets)
    soup = geometry.shared_packets
    if packet >= shared:
        soup, packet = geometry.own_packets, packet - shared
    _set_up_planes(soup, packet, lane, target.camera_from_mesh[instance], axes, planes[slot], attributes[slot])
    _set_up_attributes(surface, face, cofactors[instance], linear, attributes[slot])


@njit(nogil=True)
def _camera_point(soup, packet, lane, corner, m):
    x, y, z = soup[packet, 3 * corner, lane], soup[packet, 3 * corner + 1, lane], soup[packet, 3 * corner + 2, lane]
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@njit(nogil=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(nogil=True)
def _set_up_planes(soup, packet, lane, to_camera, axes, planes, attributes):
    """Write the planes over the ray (u, v, 1) of 1/z and of the barycentrics of vertices 1 and 2 over z [3, 3].

    All three share an arbitrary factor, which cancels. Also writes the geometric world normal, turned to the eye.
    """
    p = _camera_point(soup, packet, lane, 0, to_camera)
    q = _camera_point(soup, packet, lane, 1, to_camera)
    r = _camera_point(soup, packet, lane, 2, to_camera)
    n = _cross((q[0] - p[0], q[1] - p[1], q[2] - p[2]), (r[0] - p[0], r[1] - p[1], r[2] - p[2]))
    s, t = _cross(r, p), _cross(p, q)
    for a in range(3):
        planes[0, a], planes[1, a], planes[2, a] = n[a], s[a], t[a]
    length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
    sign = -1.0 if n[0] * p[0] + n[1] * p[1] + n[2] * p[2] > 0 else 1.0
    scale = sign / length if length > 0 else 0.0
    for a in range(3):
        attributes[NORMAL + a] = (axes[a, 0] * n[0] + axes[a, 1] * n[1] + axes[a, 2] * n[2]) * scale


@njit(nogil=True)
def _set_up_attributes(surface, face, cofactor, linear, attributes):
    """Write colours and, if the mesh has them, vertex normals on the side of the geometric one."""
    faces, colors, normals, _ = surface
    i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
    for a in range(3):
        color = linear[colors[i, a]]
        attributes[COLOR + a] = color
        attributes[COLOR_1 + a] = linear[colors[j, a]] - color
        attributes[COLOR_2 + a] = linear[colors[k, a]] - color
        attributes[NORMAL_1 + a] = 0
        attributes[NORMAL_2 + a] = 0
    flat = (attributes[NORMAL], attributes[NORMAL + 1], attributes[NORMAL + 2])
    n0, n1, n2 = (
        _world_normal(normals, i, cofactor),
        _world_normal(normals, j, cofactor),
        _world_normal(normals, k, cofactor),
    )
    side = 0.0
    for a in range(3):
        side += (n0[a] + n1[a] + n2[a]) * flat[a]
    if side == 0:
        return  # flat shading: the mesh has no normals, or useless ones
    sign = -1.0 if side < 0 else 1.0
    for a in range(3):
        attributes[NORMAL + a] = sign * n0[a]
        attributes[NORMAL_1 + a] = sign * (n1[a] - n0[a])
        attributes[NORMAL_2 + a] = sign * (n2[a] - n0[a])


@njit(nogil=True)
def _world_normal(normals, vertex, cofactor):
    x, y, z = normals[vertex, 0], normals[vertex, 1], normals[vertex, 2]
    nx = cofactor[0, 0] * x + cofactor[0, 1] * y + cofactor[0, 2] * z
    ny = cofactor[1, 0] * x + cofactor[1, 1] * y + cofactor[1, 2] * z
    nz = cofactor[2, 0] * x + cofactor[2, 1] * y + cofactor[2, 2] * z
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    scale = 1 / length if length > 0 else 0.0
    return nx * scale, ny * scale, nz * scale


# --- runs of pixels -------------------------------------------------------------------------------------------------
@njit(nogil=True, forceinline=True)
def _light_run(slot, planes, attributes, u, v, step, begin, end, axes, light, block, strip):
    """Light pixels begin..end of a strip that see one triangle; the first one's ray is (u, v, 1)."""
    row_bytes = np.uintp(strip.shape[1] * 4)
    strip_at = np.uintp(strip.ctypes.data)
    attributes_at = np.uintp(attributes.ctypes.data) + np.uintp(slot * ATTRIBUTES * 4)
    block_at, light_at = np.uintp(block.ctypes.data), np.uintp(light.ctypes.data)
    for k in range(3):
        block[2 * k + 1] = planes[slot, k, 0] * step
        block[RAY + 2 * k + 1] = axes[k, 0] * step
    for x in range(begin, end, 8):
        first = u + step * (x - begin)
        for k in range(3):
            block[2 * k] = planes[slot, k, 0] * first + planes[slot, k, 1] * v + planes[slot, k, 2]
            block[RAY + 2 * k] = axes[k, 0] * first + axes[k, 1] * v + axes[k, 2]
        light_block(block_at, attributes_at, light_at, strip_at + np.uintp(x * 4), row_bytes)


@njit(nogil=True, forceinline=True)
def _sky_run(u, v, step, begin, end, axes, light, block, strip):
    """Write pixels begin..end of a strip that see nothing; the first one's ray is (u, v, 1)."""
    row_bytes = np.uintp(strip.shape[1] * 4)
    strip_at, block_at, light_at = np.uintp(strip.ctypes.data), np.uintp(block.ctypes.data), np.uintp(light.ctypes.data)
    for k in range(3):
        block[RAY + 2 * k + 1] = axes[k, 0] * step
    for x in range(begin, end, 8):
        first = u + step * (x - begin)
        for k in range(3):
            block[RAY + 2 * k] = axes[k, 0] * first + axes[k, 1] * v + axes[k, 2]
        sky_block(block_at, light_at, strip_at + np.uintp(x * 4), row_bytes)
