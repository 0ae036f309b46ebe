"""Solids for furniture and walls: vertices, shading normals, triangles and texture coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

_CREASE_COS = float(np.cos(np.radians(50)))


@cache
def _box_template() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Return signs and normals of 24 corner vertices [24, 3], and 44 triangles, of which 12 are the sides."""
    corners: list[tuple[int, int, int]] = [(x, y, z) for x, y, z in product((-1, 1), repeat=3)]
    index: dict[tuple[tuple[int, int, int], int], int] = {
        (c, a): 3 * i + a for i, c in enumerate(corners) for a in range(3)
    }
    signs = np.repeat(np.array(corners, float), 3, axis=0)
    normals = signs * np.tile(np.eye(3), (8, 1))

    def at(values: dict[int, int]) -> tuple[int, int, int]:
        return values[0], values[1], values[2]

    quads: list[list[int]] = []
    bevels: list[list[int]] = []
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for s in (-1, 1):
            ring = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
            quads.append([index[at({a: s, b: p, c: q}), a] for p, q in ring])
        for p, q in product((-1, 1), repeat=2):
            ends = [at({a: e, b: p, c: q}) for e in (-1, 1)]
            bevels.append([index[ends[0], b], index[ends[1], b], index[ends[1], c], index[ends[0], c]])
    tips = [[index[c, 0], index[c, 1], index[c, 2]] for c in corners]
    position = signs * (1 + np.abs(normals))
    triangles = [t for q in quads + bevels for t in ([q[0], q[1], q[2]], [q[0], q[2], q[3]])] + tips
    faces = np.array(triangles, np.int32)
    p = position[faces]
    outward = np.einsum("fi,fi->f", np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), p.mean(1)) > 0
    faces[~outward] = faces[~outward][:, ::-1]
    return signs, normals, faces


@cache
def _grid_cube(n: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return grid indices [V, 3] (0..n) of the six sides of a cube and their triangles, counter-clockwise."""
    points, faces = [], []
    for a, end in product(range(3), (0, n)):
        b, c = (a + 1) % 3, (a + 2) % 3
        first = len(points)
        for p, q in product(range(n + 1), repeat=2):
            index = [0, 0, 0]
            index[a], index[b], index[c] = end, p, q
            points.append(index)
        for p, q in product(range(n), repeat=2):
            i = first + p * (n + 1) + q
            quad = [i, i + n + 1, i + n + 2, i + 1]
            quad = quad if end else quad[::-1]
            faces += [[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]]
    return np.array(points), np.array(faces, np.int32)


class Solid(NamedTuple):
    """Surface mesh of a solid about the origin."""

    vertices: NDArray[np.float64]
    """Positions of the vertices, shape [V, 3] [m]."""
    normals: NDArray[np.float64]
    """Unit shading normals, shape [V, 3]."""
    faces: NDArray[np.int32]
    """Vertex indices of each triangle, shape [F, 3]."""
    place: NDArray[np.float64]
    """Texture coordinates of each vertex on its material, along and across the grain, shape [V, 2] [m]."""


def _side_places(vertices: NDArray[np.float64], side: NDArray[np.intp], order: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return texture places [V, 2] of vertices [V, 3] on sides that face along the axes ``side`` [V].

    ``order`` [V, 3] or [3] lists the axes from long to short; the grain runs along the longest axis of a side.
    """
    order = np.broadcast_to(order, (len(side), 3))
    along = np.where(order[:, 0] == side, order[:, 1], order[:, 0])
    row = np.arange(len(side))
    return np.stack([vertices[row, along], vertices[row, 3 - side - along]], 1)


def _longest_first(size: NDArray[np.float64]) -> NDArray[np.intp]:
    return np.argsort(-size, axis=-1, kind="stable")


def boxes(size: NDArray[np.float64], bevel: NDArray[np.float64]) -> tuple[Solid, NDArray[np.intp], NDArray[np.bool_]]:
    """Return boxes of full sizes [N, 3] [m] with bevels [N] [m] at their edges, with 24 vertices each.

    The function also returns the index of each vertex's box [V] and whether each triangle belongs to a bevel [F]. The
    computation is batched, because a home has thousands of boxes.
    """
    signs, normals, faces = _box_template()
    half = size[:, None] / 2
    cut = np.minimum(bevel[:, None, None], 0.98 * half.min(2, keepdims=True))
    vertices = signs * (half - cut) + normals * cut
    first = 24 * np.arange(len(size), dtype=np.int32)[:, None, None]
    cuts = (faces[12:] + first[bevel > 0]).reshape(-1, 3)
    triangles = np.concatenate([(faces[:12] + first).reshape(-1, 3), cuts]).astype(np.int32)
    owner, vertices = np.repeat(np.arange(len(size)), 24), vertices.reshape(-1, 3)
    place = _side_places(vertices, np.tile(np.arange(3), 8 * len(size)), _longest_first(size)[owner])
    solid = Solid(vertices, np.tile(normals, (len(size), 1)), triangles, place)
    return solid, owner, np.arange(len(triangles)) >= 12 * len(size)


def cushion(size: NDArray[np.float64], radius: float) -> Solid:
    """Return a box of full size [3] [m] with rounded edges."""
    index, faces = _grid_cube(3)
    half = size / 2
    r = min(radius, 0.98 * float(half.min()))
    lines = np.stack([-half, r - half, half - r, half])
    p = lines[index, np.arange(3)]
    inner = np.clip(p, r - half, half - r)
    normals = p - inner
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = inner + r * normals
    side = np.repeat(np.arange(3), len(vertices) // 3)  # as `_grid_cube` orders them
    return Solid(vertices, normals, faces, _side_places(p, side, _longest_first(size)))


@cache
def _pillow_template() -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return vertices [V, 3] of a pillow in the cube of half size 1, and its triangles."""
    n = 6
    index, faces = _grid_cube(n)
    used = (index[:, 1] == 0) | (index[:, 1] == n)
    faces = faces[used[faces].all(1) & (index[faces][:, :, 1].min(1) == index[faces][:, :, 1].max(1))]
    u = index / n * 2 - 1
    puff = (1 - u[:, 0] ** 4) * (1 - u[:, 2] ** 4)
    v = np.stack([u[:, 0], np.sign(u[:, 1]) * np.sqrt(puff), u[:, 2]], 1)
    keep = np.unique(faces)
    renumber = np.zeros(len(v), np.int32)
    renumber[keep] = np.arange(len(keep))
    return v[keep], renumber[faces]


def pillow(size: NDArray[np.float64]) -> Solid:
    """Return a pillow of full size [3] [m], which is thickest in the middle."""
    unit, faces = _pillow_template()
    vertices = unit * (size / 2)
    return Solid(vertices, _smooth_normals(vertices, faces), faces, vertices[:, ::2])


def lathe(
    profile: Sequence[tuple[float, float]], segments: int, stretch: tuple[float, float], repeat_m: float = 0.0
) -> Solid:
    """Return the surface of a profile of (radius, height) [m] revolved about y, with scaled x and z.

    With ``repeat_m``, the width after which a material repeats, the surface has a seam, so that the material repeats a
    whole number of times around it. Parts flatter than 45 degrees are textured from above.
    """
    p = np.array(profile, float)
    along = p[1:] - p[:-1]
    flat = along[:, ::-1] * (1, -1)
    flat /= np.maximum(np.sqrt((flat * flat).sum(1, keepdims=True)), 1e-12)
    start, end = flat.copy(), flat.copy()
    joined = (flat[:-1] * flat[1:]).sum(1) > _CREASE_COS
    mean = flat[:-1] + flat[1:]
    mean /= np.maximum(np.sqrt((mean * mean).sum(1, keepdims=True)), 1e-12)
    start[1:][joined], end[:-1][joined] = mean[joined], mean[joined]
    rings = np.stack([p[:-1], p[1:]], 1).reshape(-1, 2)  # two per segment of the profile: kinks keep two normals
    slopes = np.stack([start, end], 1).reshape(-1, 2)
    points = segments + (repeat_m > 0)
    turn, circle = _turns(points, segments)
    shape = np.asarray(stretch, float)
    vertices, normals = np.empty((len(rings), points, 3)), np.empty((len(rings), points, 3))
    vertices[..., ::2] = circle * shape * rings[:, :1, None]
    normals[..., ::2] = circle / shape * slopes[:, :1, None]
    vertices[..., 1], normals[..., 1] = rings[:, 1:], slopes[:, 1:]
    normals /= np.maximum(np.sqrt((normals * normals).sum(2, keepdims=True)), 1e-12)
    place = np.zeros((len(rings), points, 2))
    if repeat_m:
        around = 2 * np.pi * float(p[:, 0].max()) * float(shape.mean())
        steps = np.zeros(len(rings))
        steps[1::2] = np.sqrt((along * along).sum(1))
        place[..., 0] = turn * max(1, round(around / repeat_m)) * repeat_m
        place[..., 1] = np.cumsum(steps)[:, None]
        level = np.repeat(np.abs(flat[:, 1]) > np.sqrt(0.5), 2)
        place[level] = vertices[level][..., ::2]
    triangles = _strips(tuple((p[:, 0] > 0).tolist()), points, segments)
    return Solid(vertices.reshape(-1, 3), normals.reshape(-1, 3), triangles, place.reshape(-1, 2))


@lru_cache(maxsize=64)
def _turns(points: int, segments: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return shares of a turn [points], ``segments`` of which are a whole one, and where they are on a circle [points, 2]."""
    turn = np.arange(points) / segments
    angle = turn * (2 * np.pi)
    return turn, np.stack([np.sin(angle), np.cos(angle)], 1)


@lru_cache(maxsize=512)
def _strips(wide: tuple[bool, ...], points: int, segments: int) -> NDArray[np.int32]:
    """Return triangles [F, 3] of a lathe with a profile of ``points`` points.

    ``wide`` marks the points away from the axis, where there is a triangle and not an edge. The result is shared: never
    write to it.
    """
    k = np.arange(segments)
    n = (k + 1) % points
    faces = []
    for s, (start, end) in enumerate(pairwise(wide)):
        low, high = 2 * s * points, (2 * s + 1) * points
        if start:
            faces.append(np.stack([low + k, low + n, high + n], 1))
        if end:
            faces.append(np.stack([low + k, high + n, high + k], 1))
    triangles = np.concatenate(faces).astype(np.int32)
    triangles.flags.writeable = False
    return triangles


def quads(corners: ArrayLike, place: NDArray[np.float64] | None = None) -> Solid:
    """Build a solid of flat quads [Q, 4, 3] [m] with texture coordinates ``place`` [Q, 4, 2] [m].

    Without ``place``, coordinates in the mesh's frame are used, so that the pattern continues across the parts of one
    wall. The material is upright on vertical quads.
    """
    c = np.asarray(corners, float).reshape(-1, 4, 3)
    normal = _cross(c[:, 1] - c[:, 0], c[:, 3] - c[:, 0])
    normal /= np.maximum(np.sqrt((normal * normal).sum(1, keepdims=True)), 1e-12)
    first = 4 * np.arange(len(c), dtype=np.int32)[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]], np.int32)).reshape(-1, 3)
    vertices, normals = c.reshape(-1, 3), np.repeat(normal, 4, axis=0)
    if place is None:
        side = np.abs(normals).argmax(1)
        place = np.empty((len(vertices), 2))
        place[:, 0] = np.where(side == 0, vertices[:, 2], vertices[:, 0])
        place[:, 1] = np.where(side == 1, vertices[:, 2], -vertices[:, 1])
    return Solid(vertices, normals, faces, place.reshape(-1, 2))


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `numpy.cross` of [N, 3] without its overhead for small N."""
    x, y, z = a.T
    u, v, w = b.T
    out = np.empty(a.shape)
    out[:, 0], out[:, 1], out[:, 2] = y * w - z * v, z * u - x * w, x * v - y * u
    return out


def _smooth_normals(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    p = vertices[faces]
    area = _cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], area)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
