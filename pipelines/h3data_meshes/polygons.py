"""Triangulation of polygons of any shape: concave, with holes, self-touching, or not quite flat."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array

_TRIED_FANS = 4
"""Number of corners from which a fan is tried for all polygons at once; a quadrilateral without crossings needs at most two."""


def triangulated(points: Array, counts: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return triangles [F, 3] as indices into ``points``, and the polygon of each [F], with order and winding kept.

    ``points`` [N, 3] are the corners of one polygon after another, and ``counts`` [P] the numbers of their corners.
    Convex polygons become the fan around their first corner. Polygons with fewer than three corners are ignored. Every
    other polygon gives ``count - 2`` triangles. For polygons that cross themselves, which have no unique triangulation,
    the triangles only use the same corners.
    """
    counts = np.asarray(counts, np.int64)
    starts = np.cumsum(counts) - counts
    places: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
    cuts: list[NDArray[np.int64]] = [np.zeros((0, 3), np.int64)]
    for size in np.unique(counts[counts >= 3]).tolist():
        owners = np.flatnonzero(counts == size)
        corners = starts[owners][:, None] + np.arange(size)
        fans = _fan(size)[None].repeat(len(owners), 0)
        if size > 3:
            flat = _flattened(points[corners])
            waiting = np.arange(len(owners))
            for first in range(min(size, _TRIED_FANS)):
                fan = (_fan(size) + first) % size
                a, b, c = (flat[waiting][:, fan[:, k]] for k in range(3))
                room = 1e-9 * np.abs(flat[waiting]).max((1, 2), initial=0) ** 2
                good = (_cross(a, b, c) >= -room[:, None]).all(1)
                fans[waiting[good]] = fan
                waiting = waiting[~good]
            for k in waiting.tolist():
                fans[k] = _clipped(flat[k])
        cuts.append(np.take_along_axis(corners, fans.reshape(len(owners), -1), 1).reshape(-1, 3))
        places.append(np.repeat(owners, size - 2))
    owner, cut = np.concatenate(places), np.concatenate(cuts)
    order = np.argsort(owner, kind="stable")
    return cut[order], owner[order]


def with_holes(outline: Array, holes: Sequence[Array]) -> NDArray[np.int64]:
    """Return a closed outline of a polygon with holes, as indices into ``outline`` and ``holes`` [*, 3] joined.

    Each hole is connected to the outline by a bridge, which is traversed in both directions.
    """
    rings = [np.asarray(ring, np.float64) for ring in (outline, *holes) if len(ring)]
    starts = np.cumsum([0, *map(len, rings)])
    everything = np.concatenate(rings)
    normal = _normals(rings[0][None])[0]
    flat = _project(everything[None], normal[None])[0]
    walk = np.arange(len(rings[0]))
    loops = [np.arange(starts[k], starts[k + 1]) for k in range(1, len(rings))]
    for number, loop in enumerate(loops):
        area = _doubled_area(flat[loop])
        loops[number] = loop[::-1] if area > 0 else loop  # against the outline, which goes counter-clockwise here
    loops.sort(key=lambda loop: -flat[loop, 0].max())
    for number, loop in enumerate(loops):
        loop = np.roll(loop, -int(flat[loop, 0].argmax()))
        edges = [np.stack([ring, np.roll(ring, -1)]) for ring in (walk, *loops[number:])]
        start, end = (flat[np.concatenate([e[k] for e in edges])] for k in range(2))
        tip = flat[loop[0]]
        near = np.argsort(((flat[walk] - tip) ** 2).sum(1), kind="stable")
        at = next((k for k in near.tolist() if _sees(tip, flat[walk[k]], start, end)), int(near[0]))
        same = np.flatnonzero((flat[walk] == flat[walk[at]]).all(1))
        if len(same) > 1:  # a corner that an earlier bridge doubled: take the copy that opens towards the hole
            at = next((int(k) for k in same if _opens(flat, walk, int(k), tip)), at)
        walk = np.concatenate([walk[: at + 1], loop, loop[:1], walk[at:]])
    return walk


def _sees(tip: Array, corner: Array, start: Array, end: Array) -> bool:
    """Return whether the line between two points [2] meets none of the edges, those that end at one of them apart."""
    apart = ~((start == tip).all(1) | (end == tip).all(1) | (start == corner).all(1) | (end == corner).all(1))
    start, end = start[apart], end[apart]
    sides = _cross(tip, corner, start) * _cross(tip, corner, end) <= 0
    return not (sides & (_cross(start, end, tip) * _cross(start, end, corner) <= 0)).any()


def _opens(flat: Array, walk: NDArray[np.int64], at: int, tip: Array) -> bool:
    """Return whether the inner angle of a walk's corner contains the direction to ``tip``."""
    before, corner, after = flat[walk[at - 1]], flat[walk[at]], flat[walk[(at + 1) % len(walk)]]
    left, right = _cross(corner, after, tip) >= 0, _cross(before, corner, tip) >= 0
    return bool(left and right if _cross(before, corner, after) >= 0 else left or right)


def _fan(size: int) -> NDArray[np.int64]:
    second = np.arange(1, size - 1)
    return np.stack([np.zeros_like(second), second, second + 1], 1)


def _normals(polygons: Array) -> Array:
    """Return Newell's normals of polygons [n, k, 3], not of unit length; z where there is no area."""
    nearby = polygons - polygons[:, :1]
    normal = np.cross(nearby, np.roll(nearby, -1, 1)).sum(1)
    normal[~(np.abs(normal).max(1) > 0)] = (0, 0, 1)
    return normal


def _project(polygons: Array, normals: Array) -> Array:
    """Return polygons [n, k, 3] in two coordinates [n, k, 2], around their first corner; areas keep their sign."""
    axis = np.abs(normals).argmax(1)
    sign = np.sign(normals[np.arange(len(normals)), axis])
    nearby = polygons - polygons[:, :1]
    take = np.array([[1, 2], [2, 0], [0, 1]])[axis]
    flat = np.take_along_axis(nearby, take[:, None, :].repeat(polygons.shape[1], 1), 2)
    flat[..., 0] *= np.where(sign < 0, -1, 1)[:, None]
    return flat


def _flattened(polygons: Array) -> Array:
    polygons = np.nan_to_num(polygons.astype(np.float64))
    return _project(polygons, _normals(polygons))


def _doubled_area(ring: Array) -> float:
    after = np.roll(ring, -1, 0)
    return float((ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum())


def _cross(a: Array, b: Array, c: Array) -> Array:
    """Return twice the signed area of triangles [..., 2]."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def _clipped(flat: Array) -> NDArray[np.int64]:
    """Return the triangles [k - 2, 3] of a counter-clockwise polygon [k, 2], whose ears are cut one after another."""
    left = list(range(len(flat)))
    out = []
    at = 0
    while len(left) > 3:
        at = _ear(flat, left, at)
        out.append((left[at - 1], left[at], left[(at + 1) % len(left)]))
        del left[at]
        at = max(at - 1, 0) % len(left)
    return np.array([*out, left], np.int64)


def _ear(flat: Array, left: list[int], first: int) -> int:
    """Return the place in ``left`` of a corner that can be cut off; of one that harms least, if none can."""
    ring = flat[left]
    before, after = np.roll(ring, 1, 0), np.roll(ring, -1, 0)
    area = _cross(before, ring, after)
    bent_in = ring[area <= 0]
    flat_ones = np.flatnonzero((area == 0) & (before == after).all(1))
    if len(flat_ones):  # a line that is walked there and back
        return int(flat_ones[0])
    order = np.roll(np.flatnonzero(area > 0), -int(np.searchsorted(np.flatnonzero(area > 0), first)))
    for k in order.tolist():
        a, b, c = before[k], ring[k], after[k]
        inside = (_cross(a, b, bent_in) > 0) & (_cross(b, c, bent_in) > 0) & (_cross(c, a, bent_in) >= 0)
        own = (bent_in == a).all(1) | (bent_in == b).all(1) | (bent_in == c).all(1)
        if not (inside & ~own).any():
            return k
    flat_ones = np.flatnonzero(area == 0)
    if len(flat_ones):
        return int(flat_ones[0])
    return int(np.argmin(np.where(area > 0, area, np.inf))) if (area > 0).any() else first % len(left)
