"""Cutting a mesh along smooth scalar fields, so that hems are curves of their own and not jagged vertex borders.

All bodies share one topology: the cuts are found on one of them, the pattern, and repeated on the others by `Splits`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Splits:
    """Vertices that a cut adds: each lies at ``t`` on the way from vertex ``start`` to ``end``; all of shape [N]."""

    start: NDArray[np.int64]
    end: NDArray[np.int64]
    t: Array

    def extend(self, values: Array) -> Array:
        """Values per vertex [V, K] of the uncut mesh, followed by those of the added vertices: [V + N, K]."""
        t = self.t[:, None]
        return np.concatenate([values, (1 - t) * values[self.start] + t * values[self.end]])


def cut(mesh: Cloth, field: Field) -> tuple[Cloth, Splits]:
    """The same surface with every triangle that the zero set crosses split in three, and the vertices added for it."""
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
    splits = Splits(start=start, end=end, t=values[start] / (values[start] - values[end]))
    fresh = len(mesh.vertices) + inverse.ravel().astype(np.int32)
    p, q = fresh[: len(a)], fresh[len(a) :]
    pieces = np.concatenate([np.stack([a, p, q], 1), np.stack([p, b, c], 1), np.stack([p, c, q], 1)])
    before = np.zeros((len(mesh.faces), 0), np.bool_) if mesh.sides is None else mesh.sides
    side = np.concatenate([count[~crossed] == 3, lone_sign, ~lone_sign, ~lone_sign])
    old_sides = np.concatenate([before[~crossed], *[before[crossed]] * 3])
    result = Cloth(
        vertices=splits.extend(mesh.vertices),
        weights=splits.extend(mesh.weights),
        faces=np.concatenate([mesh.faces[~crossed], pieces]).astype(np.int32),
        sides=np.concatenate([old_sides, side[:, None]], axis=1),
    )
    return result, splits


@dataclass(frozen=True, kw_only=True, eq=False)
class Layers:
    """A cut mesh whose vertices along the borders exist once per region, so that each region has its colour and height."""

    source: NDArray[np.int64]
    """Vertex of the cut mesh that each vertex comes from, shape [V]."""
    regions: NDArray[np.uint8]
    """Region of each vertex, shape [V]."""
    faces: NDArray[np.int32]
    raised_as: NDArray[np.int64]
    """Vertex whose place each vertex takes: itself, or for a hem strip the one that it hems; shape [V]."""
    weld: NDArray[np.int64]
    """Vertices with the same number and colour are shaded as one; shape [V]."""


def layered(mesh: Cloth, face_regions: NDArray[np.uint8], rank: Sequence[int], *, hems: bool) -> Layers:
    """The cut mesh taken apart along its borders. ``hems`` adds strips that close the steps between regions of different
    height, in the colour of the region of higher ``rank`` [R]; they have vertices of their own, for a crisp edge."""
    region_count = len(rank)
    key = mesh.faces.astype(np.int64) * region_count + face_regions[:, None]
    pairs, corner = np.unique(key.ravel(), return_inverse=True)
    source, region = pairs // region_count, (pairs % region_count).astype(np.uint8)
    faces = corner.reshape(-1, 3).astype(np.int32)
    own = np.arange(len(source))
    if not hems:
        return Layers(source=source, regions=region, faces=faces, raised_as=own, weld=source)
    strip_from, strip_regions, strip_faces = _hem_strips(faces, source, region, rank)
    return Layers(
        source=np.concatenate([source, source[strip_from]]),
        regions=np.concatenate([region, strip_regions]),
        faces=np.concatenate([faces, strip_faces + len(source)]).astype(np.int32),
        raised_as=np.concatenate([own, strip_from]),
        weld=np.concatenate([source, len(mesh.vertices) + np.arange(len(strip_from))]),
    )


def _hem_strips(
    faces: NDArray[np.int32], source: NDArray[np.int64], region: NDArray[np.uint8], rank: Sequence[int]
) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int32]]:
    """Quads along the edges that two regions share: vertices to copy [S], their regions [S] and faces [2E, 3] among them."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = {(int(source[u]), int(source[v])): (int(u), int(v)) for u, v in edges}
    copies: dict[tuple[int, int], int] = {}
    quads = []
    for (start, end), (u, v) in forward.items():
        opposite = forward.get((end, start))
        if start > end or opposite is None or region[u] == region[opposite[0]]:
            continue
        v2, u2 = opposite
        outer = int(max(region[u], region[u2], key=lambda r: rank[int(r)]))
        quads.append([copies.setdefault((corner, outer), len(copies)) for corner in (v, u, u2, v2)])
    corners = np.array(quads, np.int32)
    copied, outers = np.array(list(copies)).T
    return copied, outers.astype(np.uint8), np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def raised(layers: Layers, mesh: Cloth, heights: Array) -> Array:
    """Vertices [V, 3] of the layers over ``mesh`` (the cut mesh of one body), each lifted along the surface normal by its
    region's ``heights`` [R, mesh vertices]. Without hem strips a border takes the greater height of both sides."""
    height = heights[layers.regions, layers.source]
    if layers.weld is layers.source:
        greatest = np.zeros(len(mesh.vertices))
        np.maximum.at(greatest, layers.source, height)
        height = greatest[layers.source]
    vertices = mesh.vertices[layers.source] + height[:, None] * normals(mesh.vertices, mesh.faces)[layers.source]
    return vertices[layers.raised_as]


def normals(vertices: Array, faces: NDArray[np.int32]) -> Array:
    """Unit normals per vertex [V, 3], the mean of the faces around weighted by area."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    cross = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], cross)
    return normalized(total)
