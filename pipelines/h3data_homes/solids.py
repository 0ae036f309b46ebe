"""Builder of meshes from coloured and textured solids, and operations on colours and meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.mesh.mesh import Mesh
from h3data_homes import primitives
from h3data_homes.materials import MATERIALS, Finish, texture
from h3data_homes.primitives import Solid

Color = tuple[int, int, int]
"""Colour as sRGB values 0-255; the subclass `Finish` also names a material."""


def material_of(color: object) -> str:
    """Return the material of a `Finish`, or an empty string for a plain colour."""
    return color.material if isinstance(color, Finish) else ""


def shade(color: Sequence[int], factor: float) -> Color:
    """Return a darker (factor < 1) or lighter colour; a `Finish` keeps its material."""
    return _scaled(color, (factor, factor, factor))


def vary(rng: np.random.Generator, color: Sequence[int], amount: float = 0.06) -> Color:
    """Return a colour with its brightness changed randomly by up to +-``amount``, and its hue slightly.

    A `Finish` keeps its material.
    """
    brightness, *hue = ((2 * rng.random(4) - 1) * amount).tolist()
    return _scaled(color, [1 + brightness + h / 4 for h in hue])


def _scaled(color: Sequence[int], factors: Sequence[float]) -> Color:
    # written out: a large home scales 11,000 colours, and a generator takes twice as long
    (r, g, b), (for_r, for_g, for_b) = color, factors
    scaled = round(r * for_r), round(g * for_g), round(b * for_b)
    if min(scaled) < 0 or max(scaled) > 255:
        r, g, b = scaled
        scaled = min(255, max(0, r)), min(255, max(0, g)), min(255, max(0, b))
    return Finish(scaled, color.material) if isinstance(color, Finish) else scaled


def turn_x(angle_rad: float) -> NDArray[np.float64]:
    """Return the 3x3 rotation about x, which for positive angles tilts the top (+y) towards the front (+z)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def turn_y(angle_rad: float) -> NDArray[np.float64]:
    """Return the 3x3 rotation about y, which for positive angles takes +z towards +x."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


_Turn = NDArray[np.float64] | None


class MeshBuilder:
    """Builder that collects solids and returns them as one `Mesh`.

    A part whose colour is a `Finish` has that material, with its grain along the part's longest side. Every part shows
    a different section of the pattern. Meshes are built lazily, by `mesh`, because most furniture is tried and
    discarded.
    """

    def __init__(self) -> None:
        self._boxes: list[tuple[ArrayLike, ArrayLike, Color, float, _Turn]] = []
        self._solids: list[tuple[Callable[..., Solid], tuple, ArrayLike, str, ArrayLike, _Turn]] = []
        self._mesh: Mesh | None = None

    def box(
        self,
        center: ArrayLike,
        size: ArrayLike,
        color: Color,
        *,
        bevel: float = 0.0,
        turn: _Turn = None,
    ) -> None:
        """Add a box; ``bevel`` [m] cuts its edges and shades them smoothly (24 vertices with or without)."""
        self._boxes.append((center, size, color, bevel, turn))

    def span(self, low: Sequence[float], high: Sequence[float], color: Color, *, bevel: float = 0.0) -> None:
        """Add a box between two corners."""
        (a, b, c), (d, e, f) = low, high
        self._boxes.append((((a + d) / 2, (b + e) / 2, (c + f) / 2), (d - a, e - b, f - c), color, bevel, None))

    def cushion(
        self,
        center: ArrayLike,
        size: ArrayLike,
        color: Color,
        *,
        radius: float = 0.05,
        turn: _Turn = None,
    ) -> None:
        """Add a box with rounded edges (108 triangles), for upholstery."""
        self._add(primitives.cushion, (np.asarray(size, float), radius), color, center, turn)

    def pillow(self, center: ArrayLike, size: ArrayLike, color: Color, *, turn: _Turn = None) -> None:
        """Add a pillow lying flat, thick in the middle and thin at its rim (144 triangles)."""
        self._add(primitives.pillow, (np.asarray(size, float),), color, center, turn)

    def lathe(
        self,
        profile: Sequence[tuple[float, float]],
        color: Color,
        *,
        center: ArrayLike = (0.0, 0.0, 0.0),
        segments: int = 16,
        stretch: tuple[float, float] = (1.0, 1.0),
        turn: _Turn = None,
    ) -> None:
        """Add a profile of (radius, height) [m] revolved about y; an ascending profile faces outwards.

        ``stretch`` scales x and z. Edges above 50 degrees stay sharp, and the rest is shaded smoothly.
        """
        material = material_of(color)
        repeat_m = MATERIALS[material].size_m[0] if material else 0.0
        self._add(primitives.lathe, (profile, segments, stretch, repeat_m), color, center, turn)

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
        turn: _Turn = None,
    ) -> None:
        """Add a closed cylinder or cone frustum about y, given by its centre."""
        top, h = radius if top_radius is None else top_radius, height / 2
        if bevel > 0:
            rim = [(radius - bevel, -h), (radius, bevel - h), (top, h - bevel), (top - bevel, h)]
        else:
            rim = [(radius, -h), (top, h)]
        self.lathe([(0, -h), *rim, (0, h)], color, center=center, segments=segments, turn=turn)

    def ellipsoid(
        self, center: ArrayLike, radii: Sequence[float], color: Color, *, segments: int = 12, rings: int = 7
    ) -> None:
        """Add a closed ellipsoid with half axes ``radii`` (x, y, z) [m]."""
        angle = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
        profile = [
            (max(float(np.cos(a)), 0.0) if 0 < i < rings else 0.0, float(np.sin(a)) * radii[1])
            for i, a in enumerate(angle)
        ]
        self.lathe(profile, color, center=center, segments=segments, stretch=(radii[0], radii[2]))

    def quads(self, corners: ArrayLike, colors: Sequence, *, place: NDArray[np.float64] | None = None) -> None:
        """Add flat quads [Q, 4, 3], counter-clockwise from the visible side, in one colour or one colour each.

        All quads have the material of the first. ``place`` [Q, 4, 2] has texture coordinates on it [m]; by default they
        follow from the corners.
        """
        material = material_of(colors) or material_of(colors[0])
        self._solids.append((primitives.quads, (corners, place), colors, material, 0.0, None))

    def _add(self, make: Callable[..., Solid], arguments: tuple, color: Color, center: ArrayLike, turn: _Turn) -> None:
        self._solids.append((make, arguments, color, material_of(color), center, turn))

    def mesh(self) -> Mesh:
        """Return all solids added so far as one mesh, which is built only once."""
        if self._mesh is None:
            self._mesh = self._build()
        return self._mesh

    def _build(self) -> Mesh:
        solids: list[Solid] = []
        colors: list[NDArray[np.uint8]] = []
        kinds: list[NDArray[np.intp]] = []  # index of the material per vertex; -1 = none
        cuts: list[NDArray[np.float64]] = []  # offset of its part on the material per vertex
        bevels: list[NDArray[np.bool_]] = []  # per triangle
        if self._boxes:
            center, size, color, bevel, turn = zip(*self._boxes, strict=True)
            (v, n, f, place), owner, narrow = primitives.boxes(np.array(size, float), np.array(bevel, float))
            if any(t is not None for t in turn):
                matrices = np.array([np.eye(3) if t is None else t for t in turn])[owner]
                v, n = np.einsum("vij,vj->vi", matrices, v), np.einsum("vij,vj->vi", matrices, n)
            solids.append(Solid(v + np.array(center, float)[owner], n, f, place))
            colors.append(np.array(color, np.uint8)[owner])
            kinds.append(np.array([_KIND[material_of(c)] for c in color])[owner])
            cuts.append(_cut(np.arange(len(color)))[owner])
            bevels.append(narrow)
        for number, (make, arguments, color, material, center, turn) in enumerate(self._solids, len(self._boxes)):
            v, n, f, place = make(*arguments)
            if turn is not None:
                v, n = v @ turn.T, n @ turn.T
            solids.append(Solid(v + np.asarray(center, float), n, f, place))
            tints = np.asarray(color, np.uint8)
            colors.append(np.broadcast_to(tints, v.shape) if tints.ndim == 1 else np.repeat(tints, 4, axis=0))
            kinds.append(np.full(len(v), _KIND[material]))
            cuts.append(np.broadcast_to(_cut(0 if make is primitives.quads else number), place.shape))
            bevels.append(np.zeros(len(f), bool))
        if not solids:
            empty = np.zeros((0, 3), np.float32)
            return Mesh(vertices=empty, faces=empty.astype(np.int32), colors=empty.astype(np.uint8), normals=empty)
        first = np.cumsum([0, *(len(s.vertices) for s in solids)])[:-1].tolist()
        mesh = Mesh(
            vertices=np.concatenate([s.vertices for s in solids]).astype(np.float32),
            faces=np.concatenate([s.faces + np.int32(k) for s, k in zip(solids, first, strict=True)]),
            colors=np.concatenate(colors),
            normals=np.concatenate([s.normals for s in solids]).astype(np.float32),
        )
        places = np.concatenate([s.place for s in solids])
        return _textured(mesh, places, np.concatenate(cuts), np.concatenate(kinds), np.concatenate(bevels))


_KIND = {name: k for k, name in enumerate(MATERIALS)} | {"": -1}
_SIZE_M = np.array([m.size_m for m in MATERIALS.values()])


def _cut(number: NDArray[np.intp] | int) -> NDArray[np.float64]:
    """Return the offsets of numbered parts on their material, in repetitions, shape [..., 2]; part 0 has offset 0."""
    # Multiples of irrational numbers (golden ratio, plastic number) spread evenly without random numbers.
    return np.multiply.outer(number, (0.6180339887, 0.7548776662)) % 1


def _textured(
    mesh: Mesh,
    places: NDArray[np.float64],
    cuts: NDArray[np.float64],
    kinds: NDArray[np.intp],
    bevels: NDArray[np.bool_],
) -> Mesh:
    """Return the mesh with the textures of its materials.

    Bevels get no texture, because they lie between two sides and their uv is distorted.
    """
    used = np.unique(kinds[kinds >= 0])
    if not len(used):
        return mesh
    uv = np.where(kinds[:, None] >= 0, places / _SIZE_M[kinds] + cuts, 0.0)
    index = np.full(len(MATERIALS) + 1, -1, np.int16)  # the extra last entry serves kind -1
    index[used] = np.arange(len(used))
    return replace(
        mesh,
        uv=uv.astype(np.float32),
        textures=tuple(texture(name) for name, k in _KIND.items() if k in used),
        face_textures=np.where(bevels, np.int16(-1), index[kinds[mesh.faces[:, 0]]]),
    )


def subdivided(mesh: Mesh, parts: int) -> Mesh:
    """Return the surface with every edge cut into ``parts``, and with parts^2 times as many triangles.

    Neighbours share the points on their common edge, so no cracks appear. Normals, colours and uv are interpolated.
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
    weights = np.column_stack([parts - ij.sum(1), ij]) / parts  # barycentric

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
        uv=None if mesh.uv is None else spread(mesh.uv).astype(np.float32),
        textures=mesh.textures,
        face_textures=None if mesh.face_textures is None else np.repeat(mesh.face_textures, parts * parts),
    )
