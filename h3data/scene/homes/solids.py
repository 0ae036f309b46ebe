"""Small solids with colours and shading normals, collected into one mesh: the clay of walls, furniture and objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.scene.records import Mesh

Color = tuple[int, int, int]
"""sRGB, 0-255."""

_CREASE_COS = float(np.cos(np.radians(50)))


def shade(color: Sequence[int], factor: float) -> Color:
    """The colour made darker (factor < 1) or lighter."""
    r, g, b = (min(255, max(0, round(c * factor))) for c in color)
    return r, g, b


def vary(rng: np.random.Generator, color: Sequence[int], amount: float = 0.06) -> Color:
    """The colour with its brightness changed by up to ``amount`` either way, and its hue a little."""
    draws = (2 * rng.random(4) - 1) * amount
    common, *hue = draws.tolist()
    r, g, b = (min(255, max(0, round(c * (1 + common + h / 4)))) for c, h in zip(color, hue, strict=True))
    return r, g, b


def turn_x(angle_rad: float) -> NDArray[np.float64]:
    """3x3 rotation about x: positive tips the top (+y) towards the front (+z)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def turn_y(angle_rad: float) -> NDArray[np.float64]:
    """3x3 rotation about y: positive turns +z towards +x."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


@cache
def _box_template() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Signs and normals of the 24 corner vertices [24, 3], and 44 triangles: 12 of the sides, then 32 of the bevels."""
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
    """Grid indices [V, 3] (0..n) of the six sides of a cube and their triangles, counter-clockwise from outside."""
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


_Solid = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]
"""Vertices [V, 3], unit normals [V, 3] and triangles [F, 3] about the origin."""


def _boxes(size: NDArray[np.float64], bevel: NDArray[np.float64]) -> tuple[_Solid, NDArray[np.intp]]:
    """Boxes of whole sizes [N, 3], edges cut by bevels [N], and the box of each vertex; all in one go, as there are many."""
    signs, normals, faces = _box_template()
    half = size[:, None] / 2
    cut = np.minimum(bevel[:, None, None], 0.98 * half.min(2, keepdims=True))
    vertices = signs * (half - cut) + normals * cut
    first = 24 * np.arange(len(size), dtype=np.int32)[:, None, None]
    sharp = bevel <= 0
    triangles = np.concatenate([(faces[:12] + first).reshape(-1, 3), (faces[12:] + first[~sharp]).reshape(-1, 3)])
    solid = vertices.reshape(-1, 3), np.tile(normals, (len(size), 1)), triangles.astype(np.int32)
    return solid, np.repeat(np.arange(len(size)), 24)


def _cushion(size: NDArray[np.float64], radius: float) -> _Solid:
    index, faces = _grid_cube(3)
    half = size / 2
    r = min(radius, 0.98 * float(half.min()))
    lines = np.stack([-half, r - half, half - r, half])
    p = lines[index, np.arange(3)]
    inner = np.clip(p, r - half, half - r)
    normals = p - inner
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return inner + r * normals, normals, faces


@cache
def _pillow_template() -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices [V, 3] of a pillow in the cube of half size 1, and its triangles."""
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


def _pillow(size: NDArray[np.float64]) -> _Solid:
    unit, faces = _pillow_template()
    vertices = unit * (size / 2)
    return vertices, _smooth_normals(vertices, faces), faces


def _lathe(profile: Sequence[tuple[float, float]], segments: int, stretch: tuple[float, float]) -> _Solid:
    p = np.array(profile, float)
    along = np.diff(p, axis=0)
    flat = np.stack([along[:, 1], -along[:, 0]], 1)
    flat /= np.maximum(np.sqrt((flat * flat).sum(1, keepdims=True)), 1e-12)
    start, end = flat.copy(), flat.copy()
    joined = (flat[:-1] * flat[1:]).sum(1) > _CREASE_COS
    mean = flat[:-1] + flat[1:]
    mean /= np.maximum(np.sqrt((mean * mean).sum(1, keepdims=True)), 1e-12)
    start[1:][joined], end[:-1][joined] = mean[joined], mean[joined]
    rings = np.stack([p[:-1], p[1:]], 1).reshape(-1, 2)  # two for each piece of the profile
    slopes = np.stack([start, end], 1).reshape(-1, 2)
    angle = np.arange(segments) * (2 * np.pi / segments)
    circle = np.stack([np.sin(angle), np.cos(angle)], 1)
    shape = np.asarray(stretch, float)
    vertices, normals = np.empty((len(rings), segments, 3)), np.empty((len(rings), segments, 3))
    vertices[..., ::2] = circle * shape * rings[:, :1, None]
    normals[..., ::2] = circle / shape * slopes[:, :1, None]
    vertices[..., 1], normals[..., 1] = rings[:, 1:], slopes[:, 1:]
    normals /= np.maximum(np.sqrt((normals * normals).sum(2, keepdims=True)), 1e-12)
    k = np.arange(segments)
    n = (k + 1) % segments
    faces = []
    for s, (r0, r1) in enumerate(zip(p[:-1, 0].tolist(), p[1:, 0].tolist(), strict=True)):
        low, high = 2 * s * segments, (2 * s + 1) * segments
        if r0 > 0:
            faces.append(np.stack([low + k, low + n, high + n], 1))
        if r1 > 0:
            faces.append(np.stack([low + k, high + n, high + k], 1))
    return vertices.reshape(-1, 3), normals.reshape(-1, 3), np.concatenate(faces).astype(np.int32)


def _quads(corners: NDArray[np.float64]) -> _Solid:
    c = corners
    normal = _cross(c[:, 1] - c[:, 0], c[:, 3] - c[:, 0])
    normal /= np.maximum(np.sqrt((normal * normal).sum(1, keepdims=True)), 1e-12)
    first = 4 * np.arange(len(c), dtype=np.int32)[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]], np.int32)).reshape(-1, 3)
    return c.reshape(-1, 3), np.repeat(normal, 4, axis=0), faces


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """`numpy.cross` of [N, 3], without its overhead for small N."""
    x, y, z = a.T
    u, v, w = b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], 1)


class MeshBuilder:
    """Collects solids and gives them back as one `Mesh`.

    It only notes what is wanted until `mesh` is called, because most pieces of furniture are tried and not used.
    """

    def __init__(self) -> None:
        self._boxes: list[tuple[ArrayLike, ArrayLike, Color, float, NDArray[np.float64] | None]] = []
        self._solids: list[tuple[Callable[..., _Solid], tuple, ArrayLike, ArrayLike, NDArray[np.float64] | None]] = []
        self._mesh: Mesh | None = None

    def box(
        self,
        center: ArrayLike,
        size: ArrayLike,
        color: Color,
        *,
        bevel: float = 0.0,
        turn: NDArray[np.float64] | None = None,
    ) -> None:
        """A box; with a bevel its edges are cut and shaded round (24 vertices either way)."""
        self._boxes.append((center, size, color, bevel, turn))

    def span(self, low: Sequence[float], high: Sequence[float], color: Color, *, bevel: float = 0.0) -> None:
        """A box between two corners."""
        (a, b, c), (d, e, f) = low, high
        self._boxes.append((((a + d) / 2, (b + e) / 2, (c + f) / 2), (d - a, e - b, f - c), color, bevel, None))

    def cushion(
        self,
        center: ArrayLike,
        size: ArrayLike,
        color: Color,
        *,
        radius: float = 0.05,
        turn: NDArray[np.float64] | None = None,
    ) -> None:
        """A box with round edges (108 triangles): upholstery."""
        self._solids.append((_cushion, (np.asarray(size, float), radius), color, center, turn))

    def pillow(
        self, center: ArrayLike, size: ArrayLike, color: Color, *, turn: NDArray[np.float64] | None = None
    ) -> None:
        """A puffed sheet, thick in the middle and thin at its rim: a pillow lying flat (144 triangles)."""
        self._solids.append((_pillow, (np.asarray(size, float),), color, center, turn))

    def lathe(
        self,
        profile: Sequence[tuple[float, float]],
        color: Color,
        *,
        center: ArrayLike = (0.0, 0.0, 0.0),
        segments: int = 16,
        stretch: tuple[float, float] = (1.0, 1.0),
        turn: NDArray[np.float64] | None = None,
    ) -> None:
        """A profile of (radius, height) turned about y; going up gives an outer skin. ``stretch`` widens x and z.

        Kinks sharper than 50 degrees stay sharp; the rest is shaded smooth.
        """
        self._solids.append((_lathe, (profile, segments, stretch), color, center, turn))

    def cylinder(
        self,
        center: ArrayLike,
        radius: float,
        height: float,
        color: Color,
        *,
        top_radius: float | None = None,
        segments: int = 16,
        bevel: float = 0.0,
        turn: NDArray[np.float64] | None = None,
    ) -> None:
        """A closed cylinder or cone frustum about y, given by its middle."""
        top, h = radius if top_radius is None else top_radius, height / 2
        if bevel > 0:
            rim = [(radius - bevel, -h), (radius, bevel - h), (top, h - bevel), (top - bevel, h)]
        else:
            rim = [(radius, -h), (top, h)]
        self.lathe([(0, -h), *rim, (0, h)], color, center=center, segments=segments, turn=turn)

    def ellipsoid(
        self, center: ArrayLike, radii: Sequence[float], color: Color, *, segments: int = 12, rings: int = 7
    ) -> None:
        """A closed ellipsoid with half axes ``radii`` (x, y, z)."""
        angle = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
        profile = [
            (max(float(np.cos(a)), 0.0) if 0 < i < rings else 0.0, float(np.sin(a)) * radii[1])
            for i, a in enumerate(angle)
        ]
        self.lathe(profile, color, center=center, segments=segments, stretch=(radii[0], radii[2]))

    def quads(self, corners: ArrayLike, colors: ArrayLike) -> None:
        """Flat quads [Q, 4, 3], counter-clockwise from the visible side, in colours [Q, 3] or [3]."""
        c = np.asarray(corners, float).reshape(-1, 4, 3)
        color = np.asarray(colors, np.uint8)
        if color.ndim == 2:
            color = np.repeat(color, 4, axis=0)
        self._solids.append((_quads, (c,), color, 0.0, None))

    def mesh(self) -> Mesh:
        """Everything collected so far; the same mesh again if it is asked again."""
        if self._mesh is None:
            self._mesh = self._build()
        return self._mesh

    def _build(self) -> Mesh:
        solids: list[_Solid] = []
        colors: list[NDArray[np.uint8]] = []
        if self._boxes:
            center, size, color, bevel, turn = zip(*self._boxes, strict=True)
            (v, n, f), owner = _boxes(np.array(size, float), np.array(bevel, float))
            if any(t is not None for t in turn):
                matrices = np.array([np.eye(3) if t is None else t for t in turn])[owner]
                v, n = np.einsum("vij,vj->vi", matrices, v), np.einsum("vij,vj->vi", matrices, n)
            solids.append((v + np.array(center, float)[owner], n, f))
            colors.append(np.array(color, np.uint8)[owner])
        for make, arguments, color, center, turn in self._solids:
            v, n, f = make(*arguments)
            if turn is not None:
                v, n = v @ turn.T, n @ turn.T
            solids.append((v + np.asarray(center, float), n, f))
            colors.append(np.broadcast_to(np.asarray(color, np.uint8), v.shape))
        if not solids:
            empty = np.zeros((0, 3), np.float32)
            return Mesh(vertices=empty, faces=empty.astype(np.int32), colors=empty.astype(np.uint8), normals=empty)
        first = np.cumsum([0, *(len(v) for v, _, _ in solids)])[:-1].tolist()
        return Mesh(
            vertices=np.concatenate([v for v, _, _ in solids]).astype(np.float32),
            faces=np.concatenate([f + np.int32(k) for (_, _, f), k in zip(solids, first, strict=True)]),
            colors=np.concatenate(colors),
            normals=np.concatenate([n for _, n, _ in solids]).astype(np.float32),
        )


def subdivided(mesh: Mesh, parts: int) -> Mesh:
    """The same surface with every edge cut into ``parts``: triangles x parts^2, on the old ones' planes.

    Neighbours share the points on their common edge, so no cracks open. Normals and colours are interpolated.
    """
    if parts == 1 or not len(mesh.faces):
        return mesh
    ij = np.array([(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)])
    index = np.full((parts + 1, parts + 1), -1)
    index[ij[:, 0], ij[:, 1]] = np.arange(len(ij))
    small = []
    for i, j in ij[ij.sum(1) < parts].tolist():
        small.append((index[i, j], index[i + 1, j], index[i, j + 1]))
        if i + j < parts - 1:
            small.append((index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]))
    weights = np.column_stack([parts - ij.sum(1), ij]) / parts  # of the three corners

    def spread(values: NDArray) -> NDArray[np.float64]:
        corners = values.astype(np.float64)[mesh.faces]
        return np.einsum("pc,fcd->fpd", weights, corners).reshape(-1, values.shape[1])

    normals = None
    if mesh.normals is not None:
        n = spread(mesh.normals)
        normals = (n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)).astype(np.float32)
    first = len(ij) * np.arange(len(mesh.faces), dtype=np.int32)[:, None, None]
    return Mesh(
        vertices=spread(mesh.vertices).astype(np.float32),
        faces=(first + np.array(small, np.int32)).reshape(-1, 3),
        colors=np.round(spread(mesh.colors)).astype(np.uint8),
        normals=normals,
    )


def _smooth_normals(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    p = vertices[faces]
    area = _cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], area)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
