"""Small solids with colours and shading normals, collected into one mesh: the clay of walls, furniture and objects."""

from __future__ import annotations

from collections.abc import Sequence
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
    r, g, b = (int(np.clip(round(c * factor), 0, 255)) for c in color)
    return r, g, b


def vary(rng: np.random.Generator, color: Sequence[int], amount: float = 0.06) -> Color:
    """The colour with its brightness changed by up to ``amount`` either way, and its hue a little."""
    factor = 1 + rng.uniform(-amount, amount) + rng.uniform(-amount, amount, 3) / 4
    r, g, b = np.clip(np.round(np.asarray(color) * factor), 0, 255).astype(int).tolist()
    return r, g, b


def turn_x(angle_rad: float) -> NDArray[np.float64]:
    """3x3 rotation about x: positive tips the top (+y) towards the front (+z)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def turn_y(angle_rad: float) -> NDArray[np.float64]:
    """3x3 rotation about y: positive turns +z towards +x."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def turn_z(angle_rad: float) -> NDArray[np.float64]:
    """3x3 rotation about z: positive turns +x towards +y."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


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


class MeshBuilder:
    """Collects solids and gives them back as one `Mesh`. The only mutable thing here; it lives inside one function."""

    def __init__(self) -> None:
        self._vertices: list[NDArray[np.float64]] = []
        self._normals: list[NDArray[np.float64]] = []
        self._colors: list[NDArray[np.uint8]] = []
        self._faces: list[NDArray[np.int32]] = []
        self._count = 0

    def add(
        self,
        vertices: NDArray[np.float64],
        normals: NDArray[np.float64],
        faces: NDArray[np.int32],
        color: ArrayLike,
        *,
        center: ArrayLike = (0.0, 0.0, 0.0),
        turn: NDArray[np.float64] | None = None,
    ) -> None:
        """Adds triangles given about the origin: turned by a 3x3 rotation, then moved to ``center``."""
        if turn is not None:
            vertices, normals = vertices @ turn.T, normals @ turn.T
        self._vertices.append(vertices + np.asarray(center, float))
        self._normals.append(normals)
        self._colors.append(np.broadcast_to(np.asarray(color, np.uint8), vertices.shape))
        self._faces.append(faces + self._count)
        self._count += len(vertices)

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
        signs, normals, faces = _box_template()
        half = np.asarray(size, float) / 2
        bevel = min(bevel, 0.49 * 2 * float(half.min()))
        vertices = signs * (half - bevel) + normals * bevel
        self.add(vertices, normals, faces if bevel > 0 else faces[:12], color, center=center, turn=turn)

    def span(self, low: ArrayLike, high: ArrayLike, color: Color, *, bevel: float = 0.0) -> None:
        """A box between two corners."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        self.box((low + high) / 2, high - low, color, bevel=bevel)

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
        index, faces = _grid_cube(3)
        half = np.asarray(size, float) / 2
        r = min(radius, 0.98 * float(half.min()))
        lines = np.stack([-half, r - half, half - r, half])
        p = lines[index, np.arange(3)]
        inner = np.clip(p, r - half, half - r)
        normals = p - inner
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        self.add(inner + r * normals, normals, faces, color, center=center, turn=turn)

    def pillow(
        self, center: ArrayLike, size: ArrayLike, color: Color, *, turn: NDArray[np.float64] | None = None
    ) -> None:
        """A puffed sheet, thick in the middle and thin at its rim: a pillow lying flat (200 triangles)."""
        n = 6
        index, faces = _grid_cube(n)
        used = (index[:, 1] == 0) | (index[:, 1] == n)
        faces = faces[used[faces].all(1) & (index[faces][:, :, 1].min(1) == index[faces][:, :, 1].max(1))]
        u = index / n * 2 - 1
        puff = (1 - u[:, 0] ** 4) * (1 - u[:, 2] ** 4)
        half = np.asarray(size, float) / 2
        v = np.stack([u[:, 0] * half[0], np.sign(u[:, 1]) * half[1] * np.sqrt(puff), u[:, 2] * half[2]], 1)
        keep = np.unique(faces)
        renumber = np.zeros(len(v), np.int32)
        renumber[keep] = np.arange(len(keep))
        faces, v = renumber[faces], v[keep]
        self.add(v, _smooth_normals(v, faces), faces, color, center=center, turn=turn)

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
        p = np.array(profile, float)
        along = np.diff(p, axis=0)
        flat = np.stack([along[:, 1], -along[:, 0]], 1)
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        start, end = flat.copy(), flat.copy()
        joined = np.einsum("si,si->s", flat[:-1], flat[1:]) > _CREASE_COS
        mean = flat[:-1] + flat[1:]
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
        start[1:][joined], end[:-1][joined] = mean[joined], mean[joined]
        angle = np.arange(segments) * (2 * np.pi / segments)
        sx, sz = stretch
        circle = np.stack([np.sin(angle), np.cos(angle)], 1)
        vertices, normals = [], []
        for (r0, y0), (r1, y1), n0, n1 in zip(p[:-1], p[1:], start, end, strict=True):
            for r, y, n in ((r0, y0, n0), (r1, y1, n1)):
                vertices.append(np.column_stack([circle[:, 0] * r * sx, np.full(segments, y), circle[:, 1] * r * sz]))
                normals.append(
                    np.column_stack([circle[:, 0] * n[0] / sx, np.full(segments, n[1]), circle[:, 1] * n[0] / sz])
                )
        k = np.arange(segments)
        ring = np.stack([k, (k + 1) % segments], 1)
        faces = []
        for s, (r0, r1) in enumerate(zip(p[:-1, 0], p[1:, 0], strict=True)):
            low, high = ring + 2 * s * segments, ring + (2 * s + 1) * segments
            if r0 > 0:
                faces.append(np.stack([low[:, 0], low[:, 1], high[:, 1]], 1))
            if r1 > 0:
                faces.append(np.stack([low[:, 0], high[:, 1], high[:, 0]], 1))
        normal = np.concatenate(normals)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        self.add(
            np.concatenate(vertices), normal, np.concatenate(faces).astype(np.int32), color, center=center, turn=turn
        )

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
        normal = np.cross(c[:, 1] - c[:, 0], c[:, 3] - c[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        color = np.repeat(np.broadcast_to(np.asarray(colors, np.uint8), (len(c), 3)), 4, axis=0)
        first = 4 * np.arange(len(c))[:, None, None]
        faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3).astype(np.int32)
        self.add(c.reshape(-1, 3), np.repeat(normal, 4, axis=0), faces, color)

    def mesh(self) -> Mesh:
        """Everything added so far."""
        if not self._vertices:
            empty = np.zeros((0, 3), np.float32)
            return Mesh(vertices=empty, faces=empty.astype(np.int32), colors=empty.astype(np.uint8), normals=empty)
        return Mesh(
            vertices=np.concatenate(self._vertices).astype(np.float32),
            faces=np.concatenate(self._faces),
            colors=np.concatenate(self._colors),
            normals=np.concatenate(self._normals).astype(np.float32),
        )


def _smooth_normals(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    p = vertices[faces]
    area = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], area)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
