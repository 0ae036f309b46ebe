"""Cutting a skinned mesh along smooth scalar fields, so that hems are curves of their own and not jagged vertex borders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import normalized


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloth:
    """A mesh with dense skin weights: what fields are evaluated on and what is cut."""

    vertices: NDArray[np.float64]
    """Shape [V, 3] [m]."""
    weights: NDArray[np.float64]
    """Shape [V, 55]."""
    faces: NDArray[np.int32]

    @property
    def centroids(self) -> Cloth:
        """One vertex per face, at its middle, with the mean weights; no faces."""
        return Cloth(
            vertices=self.vertices[self.faces].mean(axis=1),
            weights=self.weights[self.faces].mean(axis=1),
            faces=np.zeros((0, 3), np.int32),
        )


Field = Callable[[Cloth], NDArray[np.float64]]
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
    if not crossed.any():
        return mesh
    faces, signs = mesh.faces[crossed], positive[crossed]
    lone_sign = (count[crossed] == 1)[:, None]
    first = np.argmax(signs == lone_sign, axis=1)
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    edges = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    start, end = unique.T
    t = (values[start] / (values[start] - values[end]))[:, None]
    fresh = len(mesh.vertices) + inverse.ravel().astype(np.int32)
    p, q = fresh[: len(a)], fresh[len(a) :]
    split = np.concatenate([np.stack([a, p, q], 1), np.stack([p, b, c], 1), np.stack([p, c, q], 1)])
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, (1 - t) * mesh.vertices[start] + t * mesh.vertices[end]]),
        weights=np.concatenate([mesh.weights, (1 - t) * mesh.weights[start] + t * mesh.weights[end]]),
        faces=np.concatenate([mesh.faces[~crossed], split]).astype(np.int32),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Dressed:
    """A mesh whose vertices each belong to one region (skin, shirt, ...), raised by the region's thickness."""

    vertices: NDArray[np.float64]
    weights: NDArray[np.float64]
    faces: NDArray[np.int32]
    regions: NDArray[np.uint8]
    """Region of each vertex, shape [V]."""


def raise_regions(
    mesh: Cloth, face_regions: NDArray[np.uint8], thickness: Callable[[Cloth, int], NDArray[np.float64]]
) -> Dressed:
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
    strip_from, strip_faces = _hem_strips(faces, old, region, height, len(old))
    # a hem shows the colour of the outer layer: the higher side of its first edge
    outer = np.argmax(height[strip_from].reshape(-1, 4), axis=1)
    region_of_strip = np.take_along_axis(region[strip_from].reshape(-1, 4), outer[:, None], axis=1)[:, 0]
    source = np.concatenate([np.arange(len(old)), strip_from])
    return Dressed(
        vertices=raised[source],
        weights=mesh.weights[old][source],
        faces=np.concatenate([faces, strip_faces]).astype(np.int32),
        regions=np.concatenate([region, np.repeat(region_of_strip, 4)]),
    )


def _hem_strips(
    faces: NDArray[np.int32], old: NDArray[np.int64], region: NDArray[np.uint8], height: NDArray[np.float64], first: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Vertices to copy [4E] and faces [2E, 3] of the quads that join regions of different height along shared edges."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = {(int(old[u]), int(old[v])): (int(u), int(v)) for u, v in edges}
    quads = []
    for (ou, ov), (u, v) in forward.items():
        other = forward.get((ov, ou))
        if ou > ov or other is None:
            continue
        v2, u2 = other
        if region[u] != region[u2] and max(abs(height[u] - height[u2]), abs(height[v] - height[v2])) > 1e-4:
            quads.append((v, u, u2, v2))
    if not quads:
        return np.zeros(0, np.int64), np.zeros((0, 3), np.int32)
    base = first + 4 * np.arange(len(quads), dtype=np.int32)[:, None]
    strip = np.concatenate([base + np.array([0, 1, 2], np.int32), base + np.array([0, 2, 3], np.int32)])
    return np.array(quads, np.int64).ravel(), strip


def _normals(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    cross = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], cross)
    return normalized(total)
