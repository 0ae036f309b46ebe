"""Cutting a skinned mesh along smooth scalar fields, so that hems are curves of their own and not jagged vertex borders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, normalized


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloth:
    """A mesh with dense skin weights: what fields are evaluated on and what is cut."""

    vertices: Array
    """Shape [V, 3] [m]."""
    weights: Array
    """Shape [V, 55]."""
    faces: NDArray[np.int32]
    sides: NDArray[np.bool_] | None = None
    """Whether each face lies where the k-th field that cut it is positive, shape [F, K]; None = never cut."""


Field = Callable[[Cloth], Array]
"""Signed values at the vertices, continuous near zero; the zero set is where the mesh is cut."""

SNAP = 1e-4
"""Vertices nearer to the border than this [m] count as beyond it: no slivers thinner than a tenth of a millimetre."""


def cut(mesh: Cloth, field: Field) -> Cloth:
    """The same surface with every triangle that the zero set crosses split in three."""
    values = field(mesh)
    values = np.where(np.abs(values) < SNAP, SNAP, values)
    positive = values[mesh.faces] > 0
    count = positive.sum(axis=1)
    crossed = (count == 1) | (count == 2)
    faces, signs = mesh.faces[crossed], positive[crossed]
    lone_sign = count[crossed] == 1
    first = np.argmax(signs == lone_sign[:, None], axis=1)
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    edges = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    start, end = unique.T
    t = (values[start] / (values[start] - values[end]))[:, None]
    fresh = len(mesh.vertices) + inverse.ravel().astype(np.int32)
    p, q = fresh[: len(a)], fresh[len(a) :]
    split = np.concatenate([np.stack([a, p, q], 1), np.stack([p, b, c], 1), np.stack([p, c, q], 1)])
    before = np.zeros((len(mesh.faces), 0), np.bool_) if mesh.sides is None else mesh.sides
    side = np.concatenate([count[~crossed] == 3, lone_sign, ~lone_sign, ~lone_sign])
    old_sides = np.concatenate([before[~crossed], *[before[crossed]] * 3])
    return Cloth(
        vertices=np.concatenate([mesh.vertices, (1 - t) * mesh.vertices[start] + t * mesh.vertices[end]]),
        weights=np.concatenate([mesh.weights, (1 - t) * mesh.weights[start] + t * mesh.weights[end]]),
        faces=np.concatenate([mesh.faces[~crossed], split]).astype(np.int32),
        sides=np.concatenate([old_sides, side[:, None]], axis=1),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Dressed:
    """A mesh whose vertices each belong to one region (skin, shirt, ...), raised by the region's thickness."""

    vertices: Array
    weights: Array
    faces: NDArray[np.int32]
    regions: NDArray[np.uint8]
    """Region of each vertex, shape [V]."""


def raise_regions(mesh: Cloth, face_regions: NDArray[np.uint8], thickness: Callable[[Cloth, int], Array]) -> Dressed:
    """Every region lifted along the normals by ``thickness(mesh, region)`` [V]; steps between regions closed by hem strips."""
    normals = _normals(mesh.vertices, mesh.faces)
    region_count = int(face_regions.max()) + 1
    key = mesh.faces.astype(np.int64) * region_count + face_regions[:, None]
    pairs, corner = np.unique(key.ravel(), return_inverse=True)
    old, region = pairs // region_count, (pairs % region_count).astype(np.uint8)
    height = np.zeros(len(old))
    for r in range(region_count):
        height[region == r] = thickness(mesh, r)[old[region == r]]
    raised = mesh.vertices[old] + height[:, None] * normals[old]
    faces = corner.reshape(-1, 3).astype(np.int32)
    strip_from, strip_regions, strip_faces = _hem_strips(faces, old, region, height)
    source = np.concatenate([np.arange(len(old)), strip_from])
    return Dressed(
        vertices=raised[source],
        weights=mesh.weights[old][source],
        faces=np.concatenate([faces, strip_faces + len(old)]).astype(np.int32),
        regions=np.concatenate([region, strip_regions]),
    )


def _hem_strips(
    faces: NDArray[np.int32], old: NDArray[np.int64], region: NDArray[np.uint8], height: Array
) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int32]]:
    """Quads that join regions of different height along shared edges: vertices to copy [S], their regions [S] and the
    faces [2E, 3] among them. A hem has vertices of its own, in the colour of its outer layer, so that it has a crisp edge."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = {(int(old[u]), int(old[v])): (int(u), int(v)) for u, v in edges}
    copies: dict[tuple[int, int], int] = {}
    quads = []
    for (start, end), (u, v) in forward.items():
        opposite = forward.get((end, start))
        if start > end or opposite is None:
            continue
        v2, u2 = opposite
        if region[u] != region[u2] and max(abs(height[u] - height[u2]), abs(height[v] - height[v2])) > 1e-4:
            outer = int(region[u] if height[u] + height[v] > height[u2] + height[v2] else region[u2])
            quads.append([copies.setdefault((corner, outer), len(copies)) for corner in (v, u, u2, v2)])
    if not quads:
        return np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros((0, 3), np.int32)
    corners = np.array(quads, np.int32)
    source, outers = np.array(list(copies)).T
    return source, outers.astype(np.uint8), np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def _normals(vertices: Array, faces: NDArray[np.int32]) -> Array:
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    cross = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], cross)
    return normalized(total)
