"""Cache of the triangles in an image for shading: planes over the ray, and vertex attributes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel_part
from h3data.render.raster.raster import CLUSTER, INSTANCE
from h3data.render.shade.shading_simd import (
    ATTRIBUTES,
    COLOR,
    COLOR_1,
    COLOR_2,
    GLOSS,
    LAST_LEVEL,
    MIRROR,
    MIRROR_SIDES,
    NEARNESS_STEP,
    NORMAL,
    NORMAL_1,
    NORMAL_2,
    TEXELS,
    UV,
    UV_1,
    UV_2,
    UV_STEP_X,
    UV_STEP_Y,
)
from h3data.render.shade.textures import WORD_SCALE
from h3data.render.shade.textures_simd import FOLLOWING, HEIGHT, WIDTH

CACHE_SIZE = 1024
"""Number of cached triangles (a power of two)."""
NO_TEXTURE = -1
_WORD_SCALE = np.array(WORD_SCALE, np.float32)


class Cache(NamedTuple):
    """Cache of triangles by slot."""

    words: NDArray[np.int32]
    """Pixel word of each triangle, -1 = empty, shape [N]."""
    planes: NDArray[np.float64]
    """Value 1/z and the barycentrics of vertices 1 and 2 over z, as linear functions of the ray (u, v, 1), shape [N, 3, 3]."""
    attributes: NDArray[np.float32]
    """Attributes of the vertices in the layout of `shading_simd`, shape [N, ATTRIBUTES]."""
    levels: NDArray[np.int32]
    """Row of the texture's finest level, or `NO_TEXTURE`, shape [N]."""


def new_cache() -> Cache:
    """Return an empty cache."""
    return Cache(
        np.full(CACHE_SIZE, -1, np.int32),
        np.empty((CACHE_SIZE, 3, 3)),
        np.empty((CACHE_SIZE, ATTRIBUTES), np.float32),
        np.empty(CACHE_SIZE, np.int32),
    )


@kernel_part(forceinline=True)
def slot_of(word):
    """Return the slot of the triangle of a pixel's word."""
    return (word ^ (word >> 10)) & (CACHE_SIZE - 1)


@kernel_part(forceinline=True)
def set_up(word, slot, cache, geometry, surface, cofactors, view, target, linear, pixel):
    """Cache the triangle of a pixel's word; ``pixel`` is the size (x, y) of a pixel at z = 1."""
    instance, cluster = target.draws[word >> 7, INSTANCE], target.draws[word >> 7, CLUSTER]
    packet = geometry.cluster_packets[cluster, 0] + ((word & 127) >> 3)
    lane = word & 7
    face = surface.packet_faces[packet, lane]
    shared = len(geometry.shared_packets)
    soup = geometry.shared_packets
    if packet >= shared:
        soup, packet = geometry.own_packets, packet - shared
    cache.words[slot] = word
    planes, attributes = cache.planes[slot], cache.attributes[slot]
    _set_up_planes(soup, packet, lane, target.camera_from_mesh[instance], view, planes, attributes)
    _set_up_attributes(surface, face, cofactors[instance], linear, attributes)
    _set_up_mirror(surface, face, attributes)
    texture = surface.face_textures[face]
    cache.levels[slot] = NO_TEXTURE
    if texture >= 0:
        cache.levels[slot] = surface.textures.first_level[texture]
        _set_up_texture(surface, face, cache.levels[slot], planes, pixel, attributes)


@kernel_part(forceinline=True)
def _camera_point(soup, packet, lane, corner, m):
    x, y, z = soup[packet, 3 * corner, lane], soup[packet, 3 * corner + 1, lane], soup[packet, 3 * corner + 2, lane]
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@kernel_part(forceinline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel_part(forceinline=True)
def _set_up_planes(soup, packet, lane, to_camera, view, planes, attributes):
    """Fill the planes over the ray (u, v, 1) of 1/z and of the barycentrics of vertices 1 and 2 over z [3, 3].

    All three share an arbitrary factor, which cancels. Also fills the geometric world normal, facing the eye. For
    orthographic cameras, 1 takes the place of z.
    """
    p = _camera_point(soup, packet, lane, 0, to_camera)
    q = _camera_point(soup, packet, lane, 1, to_camera)
    r = _camera_point(soup, packet, lane, 2, to_camera)
    n = _cross((q[0] - p[0], q[1] - p[1], q[2] - p[2]), (r[0] - p[0], r[1] - p[1], r[2] - p[2]))
    away = n[2] if view.parallel else n[0] * p[0] + n[1] * p[1] + n[2] * p[2]
    length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
    # towards the eye, whichever way round the corners are
    scale = (-1.0 if away > 0 else 1.0) / length if length > 0 else 0.0
    axes = view.axes
    for a in range(3):
        attributes[NORMAL + a] = (axes[a, 0] * n[0] + axes[a, 1] * n[1] + axes[a, 2] * n[2]) * scale
    # The rows of the adjugate of [p q r]: those of q and r give their barycentrics over z, and the sum of all three is
    # the plane's normal, which gives 1/z. The determinant is the common factor.
    if view.parallel:
        p, q, r = (p[0], p[1], 1.0), (q[0], q[1], 1.0), (r[0], r[1], 1.0)
        n = (0.0, 0.0, n[2])
    s, t = _cross(r, p), _cross(p, q)
    for a in range(3):
        planes[0, a], planes[1, a], planes[2, a] = n[a], s[a], t[a]


@kernel_part(forceinline=True)
def _set_up_attributes(surface, face, cofactor, linear, attributes):
    """Fill colours and, if the mesh has them, vertex normals on the side of the geometric normal."""
    faces, colors, normals = surface.faces, surface.colors, surface.normals
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
        return  # flat shading: the mesh has no normals, or degenerate ones
    # a mirrored instance turns its normals inside out, and surfaces are lit on both sides
    sign = -1.0 if side < 0 else 1.0
    for a in range(3):
        attributes[NORMAL + a] = sign * n0[a]
        attributes[NORMAL_1 + a] = sign * (n1[a] - n0[a])
        attributes[NORMAL_2 + a] = sign * (n2[a] - n0[a])


@kernel_part(forceinline=True)
def _world_normal(normals, vertex, cofactor):
    x, y, z = normals[vertex, 0], normals[vertex, 1], normals[vertex, 2]
    nx, ny, nz = (
        cofactor[0, 0] * x + cofactor[0, 1] * y + cofactor[0, 2] * z,
        cofactor[1, 0] * x + cofactor[1, 1] * y + cofactor[1, 2] * z,
        cofactor[2, 0] * x + cofactor[2, 1] * y + cofactor[2, 2] * z,
    )
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    scale = 1 / length if length > 0 else 0.0
    return nx * scale, ny * scale, nz * scale


@kernel_part(forceinline=True)
def _set_up_mirror(surface, face, attributes):
    """Fill the light that a glossy face mirrors, or mark the face as not glossy."""
    faces, mirrors = surface.faces, surface.mirrors
    attributes[GLOSS] = 0
    if not len(mirrors):
        return
    i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
    for a in range(MIRROR_SIDES):
        first = mirrors[i, a]
        attributes[MIRROR + a] = first
        attributes[MIRROR + MIRROR_SIDES + a] = mirrors[j, a] - first
        attributes[MIRROR + 2 * MIRROR_SIDES + a] = mirrors[k, a] - first
        if first > 0 or mirrors[j, a] > 0 or mirrors[k, a] > 0:
            attributes[GLOSS] = 1


@kernel_part(forceinline=True)
def _set_up_texture(surface, face, level, planes, pixel, attributes):
    """Fill texture coordinates (shifted close to 0, for float32) and derivatives; scale colours for `WORD_SCALE`."""
    faces, uv, levels = surface.faces, surface.uv, surface.textures.levels
    i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
    attributes[TEXELS], attributes[TEXELS + 1] = levels[level, WIDTH], levels[level, HEIGHT]
    attributes[LAST_LEVEL] = levels[level, FOLLOWING]
    for a in range(2):
        start = np.float64(uv[i, a])
        second, third = uv[j, a] - start, uv[k, a] - start
        attributes[UV + a] = start - np.floor(start)
        attributes[UV_1 + a], attributes[UV_2 + a] = second, third
        attributes[UV_STEP_X + a] = (second * planes[1, 0] + third * planes[2, 0]) * pixel[0]
        attributes[UV_STEP_Y + a] = (second * planes[1, 1] + third * planes[2, 1]) * pixel[1]
        attributes[NEARNESS_STEP + a] = planes[0, a] * pixel[a]
    # texels come as squared steps, so the colour that they multiply takes the size of a step
    for a in range(3):
        for corner in (COLOR, COLOR_1, COLOR_2):
            attributes[corner + a] *= _WORD_SCALE[a]
