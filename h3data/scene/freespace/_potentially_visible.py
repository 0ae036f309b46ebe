"""Numba kernel of potentially visible sets: for every bucket of a floor, the corners that may be visible from within it.

A taut string leaves a corner only inside a wedge on either side of it, and walls hide most of that wedge. Of hundreds
of corners, about ten remain per bucket, so a query tests only these. A set never misses a corner (it is conservative),
so the result of a query is the same as with all corners.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel

INFLATE_M, MERGE_RAD = 1e-3, 1e-7
"""Distance by which buckets are enlarged on all sides, ten times what a point may lie outside the free area [m]; and
angle below which gaps between blocked angles are ignored: 3 um at 30 m, while the blocking edges are offset by 0.1
mm."""


@kernel()
def _wedge(before: NDArray, node: NDArray, after: NDArray) -> tuple[float, float, float]:
    """Return the middle direction (x, z) of the wedge in which a taut string may leave a corner, and half its angle.

    The other wedge is opposite.
    """
    px, pz = before[0] - node[0], before[1] - node[1]
    qx, qz = after[0] - node[0], after[1] - node[1]
    p, q = np.hypot(px, pz), np.hypot(qx, qz)
    px, pz, qx, qz = px / p, pz / p, qx / q, qz / q
    half = 0.5 * np.arctan2(abs(px * qz - pz * qx), -(px * qx + pz * qz))
    dx, dz = px - qx, pz - qz
    length = np.hypot(dx, dz)
    if length < 1e-9:  # the end of a wall without thickness: all around
        return -pz, px, 0.5 * np.pi
    return dx / length, dz / length, half


@kernel()
def _interval(x: float, z: float, dx: float, dz: float, corners: NDArray) -> tuple[float, float]:
    """Return the least and greatest angle of corners [n, 2] about (x, z) against a direction.

    The result is (inf, -inf) if they lie behind.
    """
    low, high = np.inf, -np.inf
    for k in range(len(corners)):
        ux, uz = corners[k, 0] - x, corners[k, 1] - z
        angle = np.arctan2(dx * uz - dz * ux, dx * ux + dz * uz)
        low, high = min(low, angle), max(high, angle)
    # the corners straddle the back, where angles jump from pi to -pi
    if high - low > np.pi:
        return np.inf, -np.inf
    return low, high


@kernel()
def _block(low: float, high: float, spans: NDArray, count: int) -> int:
    """Add an interval to sorted disjoint ones ``spans`` [.., 2]; return how many there are then."""
    first = 0
    while first < count and spans[first, 1] < low - MERGE_RAD:
        first += 1
    last = first
    while last < count and spans[last, 0] <= high + MERGE_RAD:
        low, high = min(low, spans[last, 0]), max(high, spans[last, 1])
        last += 1
    if last == first:
        for k in range(count, first, -1):
            spans[k, 0], spans[k, 1] = spans[k - 1, 0], spans[k - 1, 1]
    elif last > first + 1:
        for k in range(last, count):
            to = first + 1 + k - last
            spans[to, 0], spans[to, 1] = spans[k, 0], spans[k, 1]
    spans[first, 0], spans[first, 1] = low, high
    return count + 1 - (last - first)


@kernel()
def _seen_in_wedge(
    x: float,
    z: float,
    dx: float,
    dz: float,
    half: float,
    pieces: NDArray,
    boxes: NDArray,
    box_of: NDArray,
    seen: NDArray,
) -> None:
    """Mark in ``seen`` the buckets of which a part may be seen from (x, z) within ``half`` of a direction.

    Front to back: a bucket is hidden if the blocking pieces [P, 4] that end before it begins cover all its angles.
    """
    ends = np.empty((2, 2))
    n = 0
    near = np.empty(len(pieces))
    piece = np.empty((len(pieces), 2))
    c, s = np.cos(half), np.sin(half)
    lx, lz = dx * c - dz * s, dz * c + dx * s  # the two borders of the wedge
    rx, rz = dx * c + dz * s, dz * c - dx * s
    for k in range(len(pieces)):
        ax, az, bx, bz = pieces[k, 0] - x, pieces[k, 1] - z, pieces[k, 2] - x, pieces[k, 3] - z
        if rx * az - rz * ax < 0.0 and rx * bz - rz * bx < 0.0:
            continue
        if ax * lz - az * lx < 0.0 and bx * lz - bz * lx < 0.0:
            continue
        ends[0, 0], ends[0, 1], ends[1, 0], ends[1, 1] = pieces[k]
        low, high = _interval(x, z, dx, dz, ends)
        if low <= half and high >= -half:
            near[n] = max(ax * ax + az * az, bx * bx + bz * bz)
            piece[n, 0], piece[n, 1] = max(low, -half), min(high, half)
            n += 1
    m = 0
    begin = np.empty(len(boxes))
    angle = np.empty((len(boxes), 2))
    index = np.empty(len(boxes), np.int64)
    corners = np.empty((4, 2))
    for k in range(len(boxes)):
        x0, z0, x1, z1 = boxes[k]
        ux, uz = max(x0 - x, 0.0, x - x1), max(z0 - z, 0.0, z - z1)
        # as near as a bucket is wide: its angles say little, and it is mostly seen anyway
        if ux * ux + uz * uz < (x1 - x0) ** 2:
            seen[box_of[k]] = True
            continue
        mx, mz, reach = 0.5 * (x0 + x1) - x, 0.5 * (z0 + z1) - z, 0.75 * (x1 - x0)
        if rx * mz - rz * mx < -reach or mx * lz - mz * lx < -reach:
            continue
        corners[0, 0], corners[0, 1], corners[1, 0], corners[1, 1] = x0, z0, x1, z0
        corners[2, 0], corners[2, 1], corners[3, 0], corners[3, 1] = x0, z1, x1, z1
        low, high = _interval(x, z, dx, dz, corners)
        if low <= half and high >= -half:
            begin[m] = ux * ux + uz * uz
            angle[m, 0], angle[m, 1] = max(low, -half), min(high, half)
            index[m] = box_of[k]
            m += 1
    spans = np.empty((n + 1, 2))
    count = 0
    order = np.argsort(near[:n])
    done = 0
    for k in np.argsort(begin[:m]):
        while done < n and near[order[done]] <= begin[k]:
            count = _block(piece[order[done], 0], piece[order[done], 1], spans, count)
            done += 1
        hidden = False
        for j in range(count):
            hidden |= spans[j, 0] <= angle[k, 0] and spans[j, 1] >= angle[k, 1]
        if not hidden:
            seen[index[k]] = True
        # all of the wedge is blocked, so whatever is farther away is hidden too
        elif spans[0, 0] <= -half and spans[0, 1] >= half:
            break


@kernel()
def potentially_visible(
    nodes: NDArray,
    before: NDArray,
    after: NDArray,
    first: NDArray,
    edges: NDArray,
    edge_island: NDArray,
    used: NDArray,
    origin: NDArray,
    size: float,
) -> tuple[NDArray, NDArray]:
    """Return corners of each bucket as (start int32 [bx * bz + 1], corners int32), ascending.

    Only the buckets ``used`` [bx, bz] have corners.

    ``nodes``, ``before``, ``after``, ``first``, ``edges`` and ``edge_island`` are the fields of `Graph`.
    """
    nx, nz = used.shape
    cells = np.argwhere(used)
    boxes = np.empty((len(cells), 4))
    box_of = np.empty(len(cells), np.int64)
    for k in range(len(cells)):
        boxes[k, 0] = origin[0] + cells[k, 0] * size - INFLATE_M
        boxes[k, 1] = origin[1] + cells[k, 1] * size - INFLATE_M
        boxes[k, 2] = boxes[k, 0] + size + 2 * INFLATE_M
        boxes[k, 3] = boxes[k, 1] + size + 2 * INFLATE_M
        box_of[k] = cells[k, 0] * nz + cells[k, 1]
    parts = np.empty(
        len(edges), np.int64
    )  # long edges in pieces, so that the near end of a wall hides what is behind it
    for e in range(len(edges)):
        parts[e] = 1 + int(np.hypot(edges[e, 2] - edges[e, 0], edges[e, 3] - edges[e, 1]) / size)
    start = np.zeros(nx * nz + 1, np.int64)
    node_of = np.empty(1024, np.int32)
    bucket_of = np.empty(1024, np.int32)
    total = 0
    seen = np.empty(nx * nz, np.bool_)
    for island in range(len(first) - 1):
        n = 0
        for e in range(len(edges)):
            n += parts[e] if edge_island[e] == island else 0
        pieces = np.empty((n, 4))
        n = 0
        for e in range(len(edges)):
            if edge_island[e] == island:
                x, z = edges[e, 0], edges[e, 1]  # not by slices: numba takes 4 s to compile their copies
                dx, dz = (edges[e, 2] - x) / parts[e], (edges[e, 3] - z) / parts[e]
                for k in range(parts[e]):
                    pieces[n, 0], pieces[n, 1] = x + k * dx, z + k * dz
                    pieces[n, 2], pieces[n, 3] = x + (k + 1) * dx, z + (k + 1) * dz
                    n += 1
        for node in range(first[island], first[island + 1]):
            x, z = nodes[node]
            dx, dz, half = _wedge(before[node], nodes[node], after[node])
            seen[:] = False
            _seen_in_wedge(x, z, dx, dz, half, pieces, boxes, box_of, seen)
            _seen_in_wedge(x, z, -dx, -dz, half, pieces, boxes, box_of, seen)
            for b in range(nx * nz):
                if not seen[b]:
                    continue
                if total == len(node_of):
                    node_of = np.concatenate((node_of, np.empty_like(node_of)))
                    bucket_of = np.concatenate((bucket_of, np.empty_like(bucket_of)))
                node_of[total], bucket_of[total] = node, b
                start[b + 1] += 1
                total += 1
    for b in range(nx * nz):
        start[b + 1] += start[b]
    at = start.copy()
    corners = np.empty(total, np.int32)
    for k in range(total):
        corners[at[bucket_of[k]]] = node_of[k]
        at[bucket_of[k]] += 1
    return start.astype(np.int32), corners
