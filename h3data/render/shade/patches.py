"""Smooth patches: groups of triangles across whose shared edges the image is continuous."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import normalized
from h3data.render.shade.surface import Surface

_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F], np.uint64)
"""Odd factors with well-mixed bits, for hashing."""


def smooth_patches(
    surface: Surface, vertices: Sequence[NDArray[np.float32]], first_face: NDArray[np.int64]
) -> NDArray[np.int32]:
    """Return the index of each triangle's smooth patch, for all meshes in sequence, shape [F].

    Two triangles of a mesh that share an edge belong to one patch if the ends of the edge are the same for both:
    position, colour, normal, texture coordinates and gloss; where a mesh has no normals, the triangles also have to
    face the same way. The image is continuous across such an edge.

    Args:
        surface: Attributes of all meshes.
        vertices: Vertices of each mesh, each [V, 3].
        first_face: First triangle of each mesh, followed by their number, shape [M + 1].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(surface.faces)
    if not count:
        return np.zeros(0, np.int32)
    places = np.concatenate([np.zeros((0, 3), np.float32), *vertices])
    corners = _vertex_keys(surface, places)[surface.faces]
    # neighbours run along their common edge in opposite directions
    ends = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], -1), -1)  # [F, 3, 2]
    mesh = np.repeat(np.arange(len(vertices)), np.diff(first_face))
    # part of the key of an edge: equal vertices alone do not join triangles of two meshes, textures or flat sides
    own = _mixed((mesh << 32) + surface.face_textures + _flat_sides(surface, places))
    edges = _mixed(ends[..., 0] * _MIX[0] + ends[..., 1] * _MIX[1] + own[:, None]).ravel()
    order = np.argsort(edges, kind="stable")
    same = edges[order[1:]] == edges[order[:-1]]
    one, other = order[:-1][same] // 3, order[1:][same] // 3
    links = coo_array((np.ones(len(one), np.bool_), (one, other)), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int32)


def _flat_sides(surface: Surface, places: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return a number for the direction of each triangle without vertex normals, to 0.01, else 0, shape [F]."""
    flat = np.logical_not(surface.normals[surface.faces].reshape(-1, 9).any(axis=1))
    out = np.zeros(len(flat), np.int64)
    a, b, c = (places[surface.faces[flat, k]].astype(np.float64) for k in range(3))
    # from 1 to 201, a byte per axis
    sides = np.rint(normalized(np.cross(b - a, c - a)) * 100).astype(np.int64) + 101
    out[flat] = (sides << np.array([0, 8, 16])).sum(1)
    return out << 8  # the lowest bits number the texture


def _vertex_keys(surface: Surface, places: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Return a number for each vertex that is the same where everything drawn of the vertex is the same, shape [V]."""
    keys = np.zeros(len(places), np.uint64)
    for array in (places, surface.colors, surface.normals, surface.uv, surface.mirrors):
        array = array + array.dtype.type(0)  # -0 is 0
        bits = array.view(np.uint32) if array.dtype == np.float32 else array
        for column in bits.T if len(bits) else ():
            keys = _mixed(keys * _MIX[0] + column.astype(np.uint64))
    return keys


def _mixed(keys: NDArray[np.integer]) -> NDArray[np.uint64]:
    """Return the keys whose bits all depend on all bits of the given ones."""
    bits: NDArray[np.uint64] = keys.astype(np.uint64)
    bits = (bits ^ (bits >> np.uint64(29))) * _MIX[1]
    return bits ^ (bits >> np.uint64(32))
