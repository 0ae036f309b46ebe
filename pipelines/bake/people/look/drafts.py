"""Patches in the making: sheets cut out of the base along smooth fields, refined, raised, and laid over it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bake.people.look.base import Base
from bake.people.look.measures import Cloth
from h3data.bodies.people.look.patches import SHADE_UNIT, SHARE_UNIT, UNIT_M, vertex_normals
from h3data.geometry import Array, normalized

SNAP = 1e-4
"""Distance from a border below which vertices count as beyond it [m], so that no slivers are thinner."""
WEIGHT_UNIT = 1 / 255

Field = Callable[[Cloth], Array]
"""Signed field at the vertices, continuous near zero, at whose zero set a sheet is cut."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sheet(Cloth):
    """Piece of the base of the pattern body, whose vertices lie on it, or near it if the piece has been simplified."""

    slots: NDArray[np.uint8]
    """Slot of each vertex, shape [V]."""

    def mesh(self) -> Cloth:
        """Return the piece as cloth, with skin weights."""
        return Cloth(vertices=self.vertices, weights=self.weights, faces=self.faces)


def sheet(body: Cloth, faces: NDArray[np.int32]) -> Sheet:
    """Return the piece of a body that consists of some of its faces."""
    used, compact = np.unique(faces, return_inverse=True)
    return Sheet(
        vertices=body.vertices[used],
        weights=body.weights[used],
        faces=compact.reshape(-1, 3).astype(np.int32),
        slots=np.zeros(len(used), np.uint8),
    )


def _split(s: Sheet, edges: NDArray[np.int64], t: Array) -> Sheet:
    """Return a mesh with vertices added at ``t`` of edges [E, 2]; the faces are unchanged."""
    a, b = edges.T
    t = t[:, None]
    return replace(
        s,
        vertices=np.concatenate([s.vertices, (1 - t) * s.vertices[a] + t * s.vertices[b]]),
        weights=np.concatenate([s.weights, (1 - t) * s.weights[a] + t * s.weights[b]]),
        slots=np.concatenate([s.slots, s.slots[a]]),
    )


def cut(s: Sheet, field: Field) -> tuple[Sheet, NDArray[np.bool_]]:
    """Return the sheet with triangles split at the zero set of a field, and whether each face is positive."""
    values = field(s)
    values = np.where(np.abs(values) < SNAP, SNAP, values)
    positive = values[s.faces] > 0
    count = positive.sum(axis=1)
    crossed = (count == 1) | (count == 2)
    faces, signs = s.faces[crossed], positive[crossed]
    lone = count[crossed] == 1
    first = np.argmax(signs == lone[:, None], axis=1)
    a, b, c = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1).T
    edges = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    fresh = len(s.vertices) + inverse.ravel()
    p, q = fresh[: len(a)], fresh[len(a) :]
    start, end = unique.T
    result = _split(s, unique.astype(np.int64), values[start] / (values[start] - values[end]))
    pieces = np.concatenate([np.stack([a, p, q], 1), np.stack([p, b, c], 1), np.stack([p, c, q], 1)])
    side = np.concatenate([count[~crossed] == 3, lone, ~lone, ~lone])
    return replace(result, faces=np.concatenate([s.faces[~crossed], pieces]).astype(np.int32)), side


def kept(s: Sheet, field: Field) -> Sheet:
    """Return the part of a sheet where a field is positive."""
    whole, side = cut(s, field)
    return only(whole, side)


def only(s: Sheet, faces: NDArray[np.bool_]) -> Sheet:
    """Return a sheet of some of the faces, with only the vertices that they use."""
    used, compact = np.unique(s.faces[faces], return_inverse=True)
    return replace(
        s,
        vertices=s.vertices[used],
        weights=s.weights[used],
        slots=s.slots[used],
        faces=compact.reshape(-1, 3).astype(np.int32),
    )


def refined(s: Sheet, where: Callable[[Cloth], NDArray[np.bool_]], *, longer_m: float = 0.0) -> Sheet:
    """Return a sheet in which edges between vertices of ``where`` that are longer than ``longest`` are halved."""
    mark = where(s)
    edges = np.sort(np.concatenate([s.faces[:, [0, 1]], s.faces[:, [1, 2]], s.faces[:, [2, 0]]]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    length = np.linalg.norm(s.vertices[unique[:, 0]] - s.vertices[unique[:, 1]], axis=1)
    halve = mark[unique].all(axis=1) & (length > longer_m)
    number = np.full(len(unique), -1)
    number[halve] = len(s.vertices) + np.arange(halve.sum())
    middle = number[inverse.reshape(3, -1).T]  # of edges ab, bc, ca
    out = [s.faces[(middle < 0).all(axis=1)]]
    split = middle >= 0
    for count in (1, 2, 3):
        rows = split.sum(axis=1) == count
        f, m = s.faces[rows], middle[rows]
        if count == 3:
            (a, b, c), (p, q, r) = f.T, m.T
            out += [np.stack(x, 1) for x in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
            continue
        # turned so that the edge that is halved alone, or alone not, comes first
        first = np.argmax(split[rows] == (count == 1), axis=1)
        turn = (first[:, None] + np.arange(3)) % 3
        (a, b, c), (p, q, r) = np.take_along_axis(f, turn, 1).T, np.take_along_axis(m, turn, 1).T
        if count == 1:
            out += [np.stack(x, 1) for x in ((a, p, c), (p, b, c))]
        else:
            out += [np.stack(x, 1) for x in ((a, b, q), (a, q, r), (r, q, c))]
    result = _split(s, unique[halve].astype(np.int64), np.full(int(halve.sum()), 0.5))
    return replace(result, faces=np.concatenate(out).astype(np.int32))


def colored(s: Sheet, face_slots: NDArray[np.uint8]) -> tuple[Sheet, NDArray[np.int64]]:
    """Return a sheet with separate vertices for faces of different slots, and the source of each vertex."""
    key = s.faces.astype(np.int64) * 64 + face_slots[:, None]
    pairs, corner = np.unique(key.ravel(), return_inverse=True)
    source = pairs // 64
    return replace(
        s,
        vertices=s.vertices[source],
        weights=s.weights[source],
        slots=(pairs % 64).astype(np.uint8),
        faces=corner.reshape(-1, 3).astype(np.int32),
    ), source


@dataclass(frozen=True, kw_only=True, eq=False)
class Draft:
    """Patch under construction on the pattern body."""

    mesh: Sheet
    """Sheet with the patch's points on the base."""
    lift: Array
    """Height along the base's normal [m], shape [V]."""
    offset: Array | None = None
    shade: Array | None = None
    """Factor on the colour, shape [V]; None darkens hollows."""
    paint: Array | None = None
    weights: Array | None = None
    """Dense skin weights, shape [V, 55]; None for those of the base."""


def joined(drafts: list[Draft]) -> Draft:
    """Return several drafts as one."""
    starts = np.cumsum([0, *(len(d.mesh.vertices) for d in drafts)])
    mesh = Sheet(
        vertices=np.concatenate([d.mesh.vertices for d in drafts]),
        weights=np.concatenate([d.mesh.weights if d.weights is None else d.weights for d in drafts]),
        faces=np.concatenate([d.mesh.faces + int(k) for d, k in zip(drafts, starts[:-1], strict=True)]),
        slots=np.concatenate([d.mesh.slots for d in drafts]),
    )
    offset = None
    if any(d.offset is not None for d in drafts):
        offset = np.concatenate([np.zeros_like(d.mesh.vertices) if d.offset is None else d.offset for d in drafts])
    return Draft(
        mesh=mesh,
        lift=np.concatenate([d.lift for d in drafts]),
        offset=offset,
        shade=np.concatenate([np.ones(len(d.lift)) if d.shade is None else d.shade for d in drafts]),
    )


class Ground:
    """The base of the pattern body, to which points are attached."""

    def __init__(self, base: Base) -> None:
        self.base, self.body = base, base.pattern
        self.normals = base_normals(base)

    def attached(self, points: Array, part: str) -> tuple[NDArray[np.int64], Array, Array]:
        """Return the nearest triangles of a part: corners [N, 3], barycentric weights [N, 3], and height above it [N]."""
        return over_surface(points, self.body.vertices, self.base.part(part), self.normals)

    def shown(self, draft: Draft, part: str) -> Array:
        """Return the vertices of a draft on the pattern body [m]."""
        corners, shares, height = self.attached(draft.mesh.vertices, part)
        up = normalized(np.einsum("nc,ncj->nj", shares, self.normals[corners]))
        point = np.einsum("nc,ncj->nj", shares, self.body.vertices[corners]) + (height + draft.lift)[:, None] * up
        return point if draft.offset is None else point + draft.offset

    def arrays(self, draft: Draft, part: str, *, ruler: tuple[int, int] = (0, 1)) -> dict[str, NDArray]:
        """Return the arrays of the patch (`h3data.bodies.people.look.patches.read_patch`)."""
        corners, shares, height = self.attached(draft.mesh.vertices, part)
        weights = draft.mesh.weights if draft.weights is None else draft.weights
        order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
        greatest = np.take_along_axis(weights, order, axis=1)
        greatest /= greatest.sum(axis=1, keepdims=True)
        whole = np.round(greatest / WEIGHT_UNIT)
        order[whole == 0] = 0
        shade = draft.shade
        if shade is None:
            shade = hollows(self.shown(draft, part), draft.mesh.faces)
        share = np.round(shares / SHARE_UNIT)
        share[:, 0] = np.minimum(share[:, 0], 255)
        share[:, 1] = np.minimum(share[:, 1], 255 - share[:, 0])
        out = {
            "corners": corners.astype(np.uint16),
            "shares": share[:, :2].astype(np.uint8),
            "lift": np.round((draft.lift + height) / UNIT_M).astype(np.int16),
            "faces": canonical(draft.mesh.faces),
            "joints": order.astype(np.uint8),
            "weights": whole.astype(np.uint8),
            "slots": draft.mesh.slots,
            "shade": np.clip(np.round(shade / SHADE_UNIT), 0, 255).astype(np.uint8),
        }
        if draft.paint is not None:
            out["paint"] = np.round(np.clip(draft.paint, 0, 1) * 255).astype(np.uint8)
        if draft.offset is not None:
            out["offset"] = np.round(draft.offset / UNIT_M).astype(np.int16)
            out["ruler"] = np.array(ruler, np.uint16)
            out["ruler_m"] = np.array(np.linalg.norm(self.body.vertices[ruler[0]] - self.body.vertices[ruler[1]]))
        return out


def base_normals(base: Base) -> Array:
    """Return normals of the pattern body's base [V, 3]."""
    return vertex_normals(base.pattern.vertices.astype(np.float32), base.pattern.faces).astype(np.float64)


def hollows(points: Array, faces: NDArray[np.int32], strength: float = 130.0, rounds: int = 1) -> Array:
    """Return factor per vertex that darkens hollows and brightens ridges a little.

    It is ``strength`` [1/m] times the height of the neighbours above the vertex.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    i, j = np.r_[edges[:, 0], edges[:, 1]], np.r_[edges[:, 1], edges[:, 0]]
    count = np.maximum(np.bincount(i, minlength=len(points)), 1)
    up = vertex_normals(points.astype(np.float32), faces).astype(np.float64)
    mean = np.stack([np.bincount(i, points[j, k], minlength=len(points)) for k in range(3)], 1) / count[:, None]
    deep = np.sum((mean - points) * up, axis=1)
    for _ in range(rounds):
        deep = (deep + np.bincount(i, deep[j], minlength=len(points)) / count) / 2
    border = np.zeros(len(points), bool)
    pairs, times = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    border[pairs[times == 1].ravel()] = True
    return np.where(border, 1.0, np.clip(1 - strength * deep, 0.72, 1.08))


def over_surface(
    points: Array, vertices: Array, faces: NDArray[np.int32], vertex_up: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the nearest triangles: corners [N, 3], barycentric coordinates [N, 3], heights above them [N]."""
    from scipy.spatial import KDTree

    a, b, c = (vertices[faces[:, k]] for k in range(3))
    _, near = KDTree((a + b + c) / 3).query(points, k=24)
    p, e0, e1 = points[:, None] - a[near], (b - a)[near], (c - a)[near]
    d00, d01, d11 = (np.sum(x * y, -1) for x, y in ((e0, e0), (e0, e1), (e1, e1)))
    d20, d21 = np.sum(p * e0, -1), np.sum(p * e1, -1)
    area = np.maximum(d00 * d11 - d01**2, 1e-18)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    share = np.maximum(np.stack([1 - v - w, v, w], -1), 0)
    share /= share.sum(-1, keepdims=True)
    off = points[:, None] - np.einsum("nkc,nkcj->nkj", share, vertices[faces[near]])
    best = np.argmin(np.sum(off**2, -1), axis=1)
    rows = np.arange(len(points))
    face, share, off = np.asarray(near)[rows, best], share[rows, best], off[rows, best]
    up = normalized(np.einsum("nc,ncj->nj", share, vertex_up[faces[face]]))
    return faces[face].astype(np.int64), share, np.sum(off * up, axis=-1)


def canonical(faces: NDArray[np.integer]) -> NDArray[np.int32]:
    """Return triangles in an order that compresses well: each starts with its lowest vertex index, and all are sorted."""
    first = faces.argmin(axis=1)
    # turned and not sorted: the order of the corners tells which side is outside
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return turned[np.lexsort(turned.T[::-1])].astype(np.int32)


def pack_faces(faces: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Pack canonical triangles [F, 3] of up to 65,536 vertices into planes of bytes [3, 2, F] of small differences.

    They compress to half the size.
    """
    a, b, c = faces.astype(np.int64).T
    steps = np.stack([np.diff(a, prepend=0), b - a, c - a]).astype("<u2")
    return np.ascontiguousarray(steps.view(np.uint8).reshape(3, -1, 2).transpose(0, 2, 1))
