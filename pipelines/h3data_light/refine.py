"""Refinement of the meshes of a scene where light is not linear along an edge, and their smoothed light.

Whether an edge is cut depends only on its ends, so both triangles at an edge agree and no cracks appear.
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

LONGEST_M, SHORTEST_M = 1.5, 0.16
"""Length above which edges are always cut, and length below which they are never cut [m]."""
_BEND = 0.075
"""Difference of brightness (square root of light, 1 = mean) between the middle of an edge and the mean of its ends above
which the edge is cut."""
_FLAT = 0.15
"""Difference between the ends of an edge of up to `_NEAR_M` below which its middle is not tested."""
_NEAR_M = 0.4
_BRIGHTEST = 1.8
"""Brightness above which differences of light are hardly visible."""
_UPWARD, _CONTACT_M = 0.7, 0.3
"""Least upward component of normals of surfaces on which edges longer than the second number are cut where they run
under something."""
_APART = 0.4
"""Difference of the ends above which an edge is cut although its middle is hidden."""
_UNDER = 0.75
"""Light of surfaces hidden under furniture, in units of that beside it."""
_SMOOTH_M, _SMOOTHINGS = 0.22, 2
"""Distance of neighbours from which vertices take light, and number of repetitions: shadows get soft edges rather than
the mesh's."""
_ROUNDS = 8
_NO_FACES = np.zeros((0, 3), np.int64)

LightAt = Callable[[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]], NDArray[np.float32]]
"""Function that returns irradiance [n, 3] at positions, normals and inward directions [n, 3], NaN where unknown."""


@dataclass
class Heap:
    """Vertices of several meshes with all values that are interpolated along edges, in the mesh frames.

    The columns are ``x y z nx ny nz r g b u v``.
    """

    vertices: NDArray[np.float64]
    """Attributes ``x y z nx ny nz r g b u v`` of the vertices in their mesh's frame, shape [V, 11]."""
    world: NDArray[np.float64]
    """Positions and unit normals in the world, shape [V, 6]."""
    faces: NDArray[np.int64]
    mesh: NDArray[np.int64]
    """Mesh index of each face, shape [F]."""
    textures: NDArray[np.int16]
    """Texture index of each face, shape [F]."""
    light: NDArray[np.float32]
    """Irradiance at the vertices, shape [V, 3]."""


def heap_of(meshes: Sequence[Mesh], matrices: Sequence[NDArray[np.float64]]) -> Heap:
    """Return the triangles of all meshes; in meshes without normals, each triangle has its own corners."""
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
    """Compute the light of all vertices and cut edges, in place; meshes that are not ``lit`` are not changed."""
    pending = lit[heap.mesh]
    parts = [(heap.faces[~pending], heap.mesh[~pending], heap.textures[~pending])]
    faces, mesh, textures = heap.faces[pending], heap.mesh[pending], heap.textures[pending]
    _light_new(heap, faces, light_at)
    done = 0
    for _ in range(_ROUNDS):
        if not len(faces) or done + len(faces) > max_faces:
            break
        cut, middle = _cut_edges(heap, faces, light_at, mean)
        whole = ~cut.any(1)
        parts.append((faces[whole], mesh[whole], textures[whole]))
        done += int(whole.sum())
        children, parent = _children(faces[~whole], cut[~whole], middle[~whole], heap.world[:, :3])
        faces, mesh, textures = children, mesh[~whole][parent], textures[~whole][parent]
    parts.append((faces, mesh, textures))
    heap.faces, heap.mesh, heap.textures = (np.concatenate(column) for column in zip(*parts, strict=True))
    _smooth(heap)


def _light_new(heap: Heap, faces: NDArray[np.int64], light_at: LightAt) -> None:
    """Set the light of the vertices of ``faces``."""
    corners = heap.world[faces, :3]
    offset = (corners.mean(1)[:, None] - corners).reshape(-1, 3)
    sums = [np.bincount(faces.ravel(), offset[:, a], len(heap.vertices)) for a in range(3)]
    inward = np.column_stack(sums).astype(np.float64)
    index = np.flatnonzero(np.bincount(faces.ravel(), minlength=1))
    heap.light[index] = light_at(heap.world[index, :3], heap.world[index, 3:], _direction(inward[index]))


def _direction(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vectors of offsets [n, 3], 0 for those without length."""
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    return np.where(length > 1e-4, offset / np.maximum(length, 1e-9), 0.0)


def _cut_edges(
    heap: Heap, faces: NDArray[np.int64], light_at: LightAt, mean: float
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which edges of each face are cut, and the vertices at their middle, each [F, 3].

    Edge k goes from corner k to k + 1.
    """
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    count = len(heap.vertices)
    keys, back = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True)
    a, b = keys // count, keys % count
    length = np.linalg.norm(heap.world[a, :3] - heap.world[b, :3], axis=1)
    difference = np.abs(_bright(heap.light[a], mean) - _bright(heap.light[b], mean))
    looked = (length > _NEAR_M) | ((length > SHORTEST_M) & ~(difference < _FLAT))
    hidden = np.isnan(heap.light[a, 0]).astype(int) + np.isnan(heap.light[b, 0])
    looked &= (hidden < 2) | (length > LONGEST_M)
    chosen = np.flatnonzero(looked)
    one, two = a[chosen], b[chosen]
    world = (heap.world[one] + heap.world[two]) / 2
    world[:, 3:] = normalized(world[:, 3:])
    middle_of_face = heap.world[faces, :3].mean(1)
    inward = np.column_stack([np.bincount(back, np.repeat(middle_of_face[:, k], 3), len(keys)) for k in range(3)])
    inward /= np.bincount(back, minlength=len(keys))[:, None]
    light = light_at(world[:, :3], world[:, 3:], _direction(inward[chosen] - world[:, :3]))
    expected = (_bright(heap.light[one], mean) + _bright(heap.light[two], mean)) / 2
    cut = ~(np.abs(_bright(light, mean) - expected) <= _BEND) & ~np.isnan(light[:, 0])
    cut |= length[chosen] > LONGEST_M
    cut |= np.isnan(light[:, 0]) & (difference[chosen] > _APART)  # light on both sides of a wall
    upward = np.minimum(heap.world[one, 4], heap.world[two, 4]) > _UPWARD
    cut |= upward & (hidden[chosen] == 1) & (length[chosen] > _CONTACT_M)  # where furniture stands on a floor
    kept = chosen[cut]
    middles = np.full(len(keys), -1)
    middles[kept] = count + np.arange(len(kept))
    rows = (heap.vertices[one[cut]] + heap.vertices[two[cut]]) / 2
    rows[:, 3:6] = normalized(rows[:, 3:6])
    heap.vertices = np.concatenate([heap.vertices, rows])
    heap.world = np.concatenate([heap.world, world[cut]])
    heap.light = np.concatenate([heap.light, light[cut]])
    return (middles >= 0)[back].reshape(-1, 3), middles[back].reshape(-1, 3)


def _bright(light: NDArray[np.float32], mean: float) -> NDArray[np.float32]:
    """Return how bright light [n, 3] looks, 1 = mean, shape [n]; NaN where it is unknown."""
    return np.minimum(np.sqrt(light.mean(1) / mean), _BRIGHTEST)


def _children(
    faces: NDArray[np.int64], cut: NDArray[np.bool_], middle: NDArray[np.int64], place: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the 2, 3 or 4 parts of each face, and the face that each is part of."""
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
        add(which, x, b, y)
        first_half, second_half = np.stack([a, x, y]), np.stack([a, y, c])
        other = np.linalg.norm(place[x] - place[c], axis=1) < np.linalg.norm(place[a] - place[y], axis=1)
        add(which, *np.where(other, np.stack([a, x, c]), first_half))  # the shorter diagonal
        add(which, *np.where(other, np.stack([x, y, c]), second_half))
    return np.concatenate(children), np.concatenate(parents)


def _smooth(heap: Heap) -> None:
    """Give vertices without light, inside other surfaces, that of their neighbours, and smooth the light a little.

    Vertices with equal positions and normals count as one.
    """
    keys = np.column_stack([np.rint(heap.world[:, :3] * 2000), np.rint(heap.world[:, 3:] * 20)]).astype(np.int64)
    _, first, point = np.unique(hashes(keys), return_index=True, return_inverse=True)
    count = len(first)
    light = np.column_stack([_mean_known(heap.light[:, a], point, count) for a in range(3)])
    ends = point[np.concatenate([heap.faces[:, [0, 1]], heap.faces[:, [1, 2]], heap.faces[:, [2, 0]]])]
    ends = np.sort(ends.min(1) * count + ends.max(1))
    ends = ends[np.diff(ends, prepend=-1) != 0]  # np.unique takes ten times as long
    a, b = ends // count, ends % count
    place = heap.world[first, :3]
    length = np.linalg.norm(place[a] - place[b], axis=1)
    a, b = np.concatenate([a, b]), np.concatenate([b, a])
    upward = heap.world[first, 4] > _UPWARD
    under = np.isnan(light[:, 0]) & upward
    weight = np.tile(np.exp(-((length / _SMOOTH_M) ** 2)), 2)
    weight[under[a] | under[b]] = 0
    dark = np.flatnonzero(np.isnan(light[a, 0]))
    for ring in range(24):
        useful = dark[np.isnan(light[a[dark], 0]) & ~np.isnan(light[b[dark], 0])]
        if not len(useful):
            break
        number = np.bincount(a[useful], minlength=count)
        sums = np.column_stack([np.bincount(a[useful], light[b[useful], k], count) for k in range(3)])
        order = useful[np.argsort(light[b[useful]].sum(1), kind="stable")]
        found, darkest = np.unique(a[order], return_index=True)
        fill = light[b[order[darkest]]] * (_UNDER if ring == 0 else 0.9)  # the mean would pass light under walls
        light[found] = np.where(upward[found, None], fill, sums[found] / number[found, None])
    total = 1 + np.bincount(a, weight, count)
    for _ in range(_SMOOTHINGS):
        known = np.nan_to_num(light)
        sums = np.column_stack([np.bincount(a, weight * known[b, k], count) for k in range(3)])
        light = (light + sums) / total[:, None]
    heap.light = light[point].astype(np.float32)


def hashes(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one hash for each row of keys [n, 6]."""
    return keys @ np.array([73856093, 19349663, 83492791, 15485863, 32452843, 49979687])


def _mean_known(values: NDArray[np.float32], group: NDArray[np.intp], count: int) -> NDArray[np.float64]:
    """Return the mean of the values [n] of each group that are not NaN, NaN if there are none, shape [count]."""
    known = ~np.isnan(values)
    number = np.bincount(group[known], minlength=count)
    sums = np.bincount(group[known], values[known], count)
    return np.where(number > 0, sums / np.maximum(number, 1), np.nan)
