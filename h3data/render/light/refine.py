"""Meshes of a scene in one heap of triangles, refined where light changes along an edge.

Whether an edge is cut depends on nothing but its ends, so both triangles at an edge agree and no cracks appear.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import normalized
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import flat_shaded
from h3data.srgb import bytes_to_linear

LONGEST_M, SHORTEST_M = 0.6, 0.15
"""Longer edges are always cut, shorter ones never."""
_CONTRAST = 0.22
"""Difference of brightness (square root of light, 1 = mean) along an edge above which it is cut."""
_ROUNDS = 8
_NO_FACES = np.zeros((0, 3), np.int64)

LightAt = Callable[[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]], NDArray[np.float32]]
"""Irradiance [n, 3] at positions, normals and inward directions [n, 3], NaN where unknown."""


@dataclass
class Heap:
    """Vertices of several meshes with what is interpolated along edges: rows ``x y z  nx ny nz  r g b  u v``, mesh frame."""

    vertices: NDArray[np.float64]
    """Shape [V, 11]."""
    world: NDArray[np.float64]
    """Positions and unit normals in the world, shape [V, 6]."""
    faces: NDArray[np.int64]
    mesh: NDArray[np.int64]
    """Mesh of each face, shape [F]."""
    textures: NDArray[np.int16]
    """Texture of each face, shape [F]."""
    light: NDArray[np.float32]
    """Irradiance, shape [V, 3]."""


def heap_of(meshes: Sequence[Mesh], matrices: Sequence[NDArray[np.float64]]) -> Heap:
    """The triangles of all meshes. Those without normals get corners of their own for each triangle."""
    rows, world, faces, owner, textures = [], [], [], [], []
    start = 0
    for number, (mesh, matrix) in enumerate(zip(meshes, matrices, strict=True)):
        mesh = flat_shaded(mesh) if mesh.normals is None else mesh
        assert mesh.normals is not None
        uv = np.zeros((len(mesh.vertices), 2)) if mesh.uv is None else mesh.uv
        rows.append(np.column_stack([mesh.vertices, mesh.normals, bytes_to_linear(mesh.colors), uv]))
        linear = matrix[:3, :3]
        place = mesh.vertices @ linear.T + matrix[:3, 3]
        cofactor = np.linalg.inv(linear).T if abs(np.linalg.det(linear)) > 1e-12 else linear
        world.append(np.column_stack([place, normalized(mesh.normals @ cofactor.T)]))
        faces.append(mesh.faces.astype(np.int64) + start)
        owner.append(np.full(len(mesh.faces), number))
        index = mesh.face_textures
        textures.append(np.full(len(mesh.faces), 0 if mesh.textures else -1, np.int16) if index is None else index)
        start += len(mesh.vertices)
    vertices = np.concatenate(rows)
    return Heap(
        vertices=vertices,
        world=np.concatenate(world),
        faces=np.concatenate(faces),
        mesh=np.concatenate(owner),
        textures=np.concatenate(textures),
        light=np.full((len(vertices), 3), np.nan, np.float32),
    )


def refine(heap: Heap, light_at: LightAt, *, mean: float, lit: NDArray[np.bool_], max_faces: int) -> None:
    """Computes the light of all vertices and cuts edges, in place. Meshes that are not ``lit`` stay as they are."""
    pending = lit[heap.mesh]
    parts = [(heap.faces[~pending], heap.mesh[~pending], heap.textures[~pending])]
    faces, mesh, textures = heap.faces[pending], heap.mesh[pending], heap.textures[pending]
    done = 0
    for round_ in range(_ROUNDS + 1):
        _light_new(heap, faces, light_at)
        if round_ == _ROUNDS or not len(faces) or done + len(faces) > max_faces:
            break
        cut, middle = _cut_edges(heap, faces, mean)
        whole = ~cut.any(1)
        parts.append((faces[whole], mesh[whole], textures[whole]))
        done += int(whole.sum())
        children, parent = _children(faces[~whole], cut[~whole], middle[~whole])
        faces, mesh, textures = children, mesh[~whole][parent], textures[~whole][parent]
    parts.append((faces, mesh, textures))
    heap.faces, heap.mesh, heap.textures = (np.concatenate(column) for column in zip(*parts, strict=True))
    _fill(heap)


def _light_new(heap: Heap, faces: NDArray[np.int64], light_at: LightAt) -> None:
    """Light of the vertices of ``faces`` that have none, computed once for equal positions and normals."""
    fresh = np.zeros(len(heap.vertices), bool)
    fresh[faces] = True
    fresh[: len(heap.light)] &= np.isnan(heap.light[: len(fresh), 0])
    index = np.flatnonzero(fresh)
    if not len(index):
        return
    corners = heap.world[faces, :3]
    offset = (corners.mean(1)[:, None] - corners).reshape(-1, 3)
    inward = np.column_stack([np.bincount(faces.ravel(), offset[:, a], len(heap.vertices)) for a in range(3)])[index]
    length = np.linalg.norm(inward, axis=1, keepdims=True)
    inward = np.where(length > 1e-4, inward / np.maximum(length, 1e-9), 0.0)
    heap.light[index] = light_at(heap.world[index, :3], heap.world[index, 3:], inward)


def _cut_edges(heap: Heap, faces: NDArray[np.int64], mean: float) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which edges of each face are cut and the vertices at their middle, each [F, 3]; edge k goes from corner k to k + 1."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    count = len(heap.vertices)
    keys, back = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True)
    a, b = keys // count, keys % count
    length = np.linalg.norm(heap.world[a, :3] - heap.world[b, :3], axis=1)
    bright = np.sqrt(np.nan_to_num(heap.light.mean(1), nan=0.0) / mean)
    bright = np.minimum(bright, 2.2)
    unknown = np.isnan(heap.light[a, 0]) | np.isnan(heap.light[b, 0])
    contrast = np.abs(bright[a] - bright[b])
    cut = (length > LONGEST_M) | ((length > SHORTEST_M) & (contrast > _CONTRAST) & ~unknown)
    chosen = np.flatnonzero(cut)
    middles = np.full(len(keys), -1)
    middles[chosen] = count + np.arange(len(chosen))
    one, two = a[chosen], b[chosen]
    rows = (heap.vertices[one] + heap.vertices[two]) / 2
    rows[:, 3:6] = normalized(rows[:, 3:6])
    world = (heap.world[one] + heap.world[two]) / 2
    world[:, 3:] = normalized(world[:, 3:])
    heap.vertices = np.concatenate([heap.vertices, rows])
    heap.world = np.concatenate([heap.world, world])
    heap.light = np.concatenate([heap.light, np.full((len(rows), 3), np.nan, np.float32)])
    return cut[back].reshape(-1, 3), middles[back].reshape(-1, 3)


def _children(
    faces: NDArray[np.int64], cut: NDArray[np.bool_], middle: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The 2, 3 or 4 parts of each face, and the face that each is part of."""
    children, parents = [_NO_FACES], [np.zeros(0, np.int64)]

    def add(which: NDArray[np.int64], *corners: NDArray[np.int64]) -> None:
        children.append(np.column_stack(corners))
        parents.append(which)

    number = cut.sum(1)
    which = np.flatnonzero(number == 3)
    (a, b, c), (x, y, z) = faces[which].T, middle[which].T
    for corners in ((a, x, z), (x, b, y), (z, y, c), (x, y, z)):
        add(which, *corners)
    for first in range(3):
        turned, cuts, middles = (np.roll(v, -first, axis=1) for v in (faces, cut, middle))
        which = np.flatnonzero((number == 1) & cuts[:, 0])
        (a, b, c), x = turned[which].T, middles[which, 0]
        add(which, a, x, c)
        add(which, x, b, c)
        which = np.flatnonzero((number == 2) & cuts[:, 0] & cuts[:, 1])
        (a, b, c), (x, y) = turned[which].T, middles[which, :2].T
        for corners in ((x, b, y), (a, x, y), (a, y, c)):
            add(which, *corners)
    return np.concatenate(children), np.concatenate(parents)


def _fill(heap: Heap) -> None:
    """Gives vertices without light, which lie in other surfaces, the mean of their neighbours."""
    edges = np.concatenate([heap.faces[:, [0, 1]], heap.faces[:, [1, 2]], heap.faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    for _ in range(6):
        unknown = np.isnan(heap.light[:, 0])
        useful = edges[unknown[edges[:, 0]] & ~unknown[edges[:, 1]]]
        if not len(useful):
            break
        count = np.bincount(useful[:, 0], minlength=len(unknown))
        sums = [np.bincount(useful[:, 0], heap.light[useful[:, 1], a], len(unknown)) for a in range(3)]
        known = count > 0
        heap.light[known] = (np.column_stack(sums)[known] / count[known, None]).astype(np.float32)
