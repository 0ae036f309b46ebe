"""Numba kernels of visibility among polygons: buckets of edges, point location, the corners that a point sees.

The free area is used twice: its corners are the nodes, and the edges of the same area *grown by* `GROW_M` block the
view. A taut string runs along walls and through corners, where crossing tests on the area itself would depend on
rounding. In the grown area no valid segment comes near an edge, so the tests need no special cases (and a point 0.1 mm
outside is inside).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel

GROW_M = 1e-4
"""Distance of the blocking edges outside the free area [m]."""


class Graph(NamedTuple):
    """Visibility graph of all islands of a free area, whose nodes are its reflex corners, ordered by island."""

    nodes: NDArray[np.float64]
    """Corners of the graph (x, z), shape [n, 2] [m]."""
    before: NDArray[np.float64]
    """Corner before each node on its ring (free area on the left), shape [n, 2] [m]."""
    after: NDArray[np.float64]
    """Corner after each node on its ring, shape [n, 2] [m]."""
    first: NDArray[np.int64]
    """First node of each island, shape [islands + 1]: island k has the nodes ``first[k]:first[k + 1]``."""
    distance: NDArray[np.float32]
    """Length of the shortest taut path between nodes, along edges that are tangent at both ends, shape [n, n] [m]; inf
    where there is none. Paths that would kink at their first or last node are left out: no shortest path has such a
    part."""
    previous: NDArray[np.int16]
    """Node before j on the shortest path from i to j, shape [n, n]; negative: none."""
    rings: NDArray[np.float64]
    """Edges of the free area, ``x0 z0 x1 z1``, shape [r, 4]."""
    ring_island: NDArray[np.int32]
    """Island of each ring, shape [r]."""
    edges: NDArray[np.float64]
    """Blocking edges (of the grown area), shape [e, 4]."""
    edge_island: NDArray[np.int32]
    """Island of each blocking edge, shape [e]."""
    bucket_start: NDArray[np.int32]
    """First blocking edge of each bucket: bucket b = i * buckets_z + j has
    ``bucket_edges[bucket_start[b]:bucket_start[b + 1]]``."""
    bucket_edges: NDArray[np.int32]
    bucket_label: NDArray[np.int32]
    """Island at the middle of each bucket, -1 = not free, shape [bx, bz]."""
    bucket_origin: NDArray[np.float64]
    """Lower corner of bucket [0, 0], shape [2] [m]."""
    bucket_size: NDArray[np.float64]
    """Side of a bucket, as an array of shape [1] [m]."""
    visible_start: NDArray[np.int32]
    """First visible node of each bucket: a taut string that starts in bucket b first reaches one of
    ``visible_nodes[visible_start[b]:visible_start[b + 1]]`` (the list has some further nodes)."""
    visible_nodes: NDArray[np.int32]


@kernel()
def crosses(ax: float, az: float, bx: float, bz: float, cx: float, cz: float, dx: float, dz: float) -> bool:
    """Return whether segments a-b and c-d cross.

    Segments are half-open: a line through a shared end point of two edges that lie on its two sides crosses exactly one
    of them, so that no line passes through a vertex.
    """
    a = (dx - cx) * (az - cz) - (dz - cz) * (ax - cx)
    b = (dx - cx) * (bz - cz) - (dz - cz) * (bx - cx)
    if (a >= 0.0) == (b >= 0.0):
        return False
    c = (bx - ax) * (cz - az) - (bz - az) * (cx - ax)
    d = (bx - ax) * (dz - az) - (bz - az) * (dx - ax)
    return (c >= 0.0) != (d >= 0.0)


@kernel()
def bucket_edges(edges: NDArray, origin: NDArray, size: float, nx: int, nz: int) -> tuple[NDArray, NDArray]:
    """Return which edges [E, 4] touch each bucket of a grid, as (start int32 [nx * nz + 1], items int32)."""
    margin = 1e-6  # so that a ray through the corner of a bucket finds its edges whichever way rounding sends it
    count = np.zeros(nx * nz + 1, np.int64)
    items = np.empty(0, np.int32)
    # first counted, then filled in: the lists of all buckets lie in one array
    for phase in range(2):
        if phase == 1:
            total = 0
            for b in range(nx * nz):
                n = count[b]
                count[b] = total
                total += n
            count[nx * nz] = total
            items = np.empty(total, np.int32)
        for e in range(len(edges)):
            ax, az, bx, bz = edges[e]
            i0 = max(int(np.floor((min(ax, bx) - margin - origin[0]) / size)), 0)
            i1 = min(int(np.floor((max(ax, bx) + margin - origin[0]) / size)), nx - 1)
            j0 = max(int(np.floor((min(az, bz) - margin - origin[1]) / size)), 0)
            j1 = min(int(np.floor((max(az, bz) + margin - origin[1]) / size)), nz - 1)
            half = 0.5 * size + margin
            reach = half * (abs(bx - ax) + abs(bz - az))
            for i in range(i0, i1 + 1):
                mx = origin[0] + (i + 0.5) * size
                for j in range(j0, j1 + 1):
                    mz = origin[1] + (j + 0.5) * size
                    # the separating axis of a square and a line: beyond it the edge only passes by the bucket
                    if abs((bx - ax) * (mz - az) - (bz - az) * (mx - ax)) > reach:
                        continue
                    b = i * nz + j
                    if phase == 1:
                        items[count[b]] = e
                    count[b] += 1
    start = np.zeros(nx * nz + 1, np.int32)
    for b in range(nx * nz):
        start[b + 1] = count[b]
    return start, items


@kernel()
def sees(graph: Graph, ax: float, az: float, bx: float, bz: float) -> bool:
    """Return whether the straight line from a to b stays in the free area, by a walk over the buckets along it."""
    edges, items, start = graph.edges, graph.bucket_edges, graph.bucket_start  # taken out in the loop they cost as much
    size = graph.bucket_size[0]
    nx, nz = graph.bucket_label.shape
    px = (ax - graph.bucket_origin[0]) / size
    pz = (az - graph.bucket_origin[1]) / size
    qx = (bx - graph.bucket_origin[0]) / size
    qz = (bz - graph.bucket_origin[1]) / size
    i, j = int(np.floor(px)), int(np.floor(pz))
    last_i, last_j = int(np.floor(qx)), int(np.floor(qz))
    step_i = 1 if qx > px else -1
    step_j = 1 if qz > pz else -1
    # shares of the whole way, from one border of buckets to the next
    delta_i = abs(1.0 / (qx - px)) if qx != px else np.inf
    delta_j = abs(1.0 / (qz - pz)) if qz != pz else np.inf
    next_i = ((i + 1 - px) if step_i > 0 else (px - i)) * delta_i if qx != px else np.inf
    next_j = ((j + 1 - pz) if step_j > 0 else (pz - j)) * delta_j if qz != pz else np.inf
    # a bounded loop (Amanatides and Woo 1987): rounding at a corner of buckets must not lead past the last one for ever
    for _ in range(abs(last_i - i) + abs(last_j - j) + 1):
        if i < 0 or j < 0 or i >= nx or j >= nz:
            return False
        b = i * nz + j
        for k in range(start[b], start[b + 1]):
            e = items[k]
            if crosses(ax, az, bx, bz, edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]):
                return False
        if next_i < next_j:
            i += step_i
            next_i += delta_i
        else:
            j += step_j
            next_j += delta_j
    return True


@kernel()
def locate(graph: Graph, x: float, z: float) -> int:
    """Return the island of a point, -1 = not free.

    The island is computed from the label of the bucket's middle, which changes at every edge between the middle and the
    point.
    """
    size = graph.bucket_size[0]
    nx, nz = graph.bucket_label.shape
    if not (np.isfinite(x) and np.isfinite(z)):
        return -1
    i = int(np.floor((x - graph.bucket_origin[0]) / size))
    j = int(np.floor((z - graph.bucket_origin[1]) / size))
    if i < 0 or j < 0 or i >= nx or j >= nz:
        return -1
    mx = graph.bucket_origin[0] + (i + 0.5) * size
    mz = graph.bucket_origin[1] + (j + 0.5) * size
    odd = False
    nearest = np.inf
    island = graph.bucket_label[i, j]
    free = island >= 0
    b = i * nz + j
    for k in range(graph.bucket_start[b], graph.bucket_start[b + 1]):
        e = graph.bucket_edges[k]
        cx, cz, dx, dz = graph.edges[e, 0], graph.edges[e, 1], graph.edges[e, 2], graph.edges[e, 3]
        if not crosses(x, z, mx, mz, cx, cz, dx, dz):
            continue
        odd = not odd
        # the nearest edge on the way names the island: the point may lie behind a wall from the bucket's middle
        p = (dx - cx) * (z - cz) - (dz - cz) * (x - cx)
        m = (dx - cx) * (mz - cz) - (dz - cz) * (mx - cx)
        t = p / (p - m)
        if t < nearest:
            nearest = t
            island = graph.edge_island[e]
    return int(island) if free != odd else -1


@kernel()
def nearest_free(graph: Graph, x: float, z: float, max_distance: float) -> tuple[float, float, int]:
    """Return (x, z, island) of the free point nearest to (x, z); island -1 and NaN if there is none within reach."""
    island = locate(graph, x, z)
    if island >= 0:
        return x, z, island
    best = max_distance
    found_x, found_z = np.nan, np.nan
    if not (np.isfinite(x) and np.isfinite(z)):
        return found_x, found_z, -1
    # the true border, not the grown one, so that the point that is found lies in the free area
    for e in range(len(graph.rings)):
        ax, az, bx, bz = graph.rings[e]
        dx = bx - ax
        dz = bz - az
        square = dx * dx + dz * dz
        t = min(max(((x - ax) * dx + (z - az) * dz) / square, 0.0), 1.0) if square > 0.0 else 0.0
        distance = np.hypot(x - ax - t * dx, z - az - t * dz)
        if distance <= best:
            best = distance
            found_x, found_z, island = ax + t * dx, az + t * dz, graph.ring_island[e]
    return found_x, found_z, island


@kernel()
def tangent(graph: Graph, x: float, z: float, node: int, slack: float) -> bool:
    """Return whether a taut string from (x, z) can bend at a node: both its ring neighbours lie on one side of the string.

    ``slack`` is a tolerance for (x, z) [m], because a point just outside a wall must still find the corners along it.
    """
    vx, vz = graph.nodes[node]
    ux = vx - x
    uz = vz - z
    px, pz = graph.before[node, 0] - vx, graph.before[node, 1] - vz
    qx, qz = graph.after[node, 0] - vx, graph.after[node, 1] - vz
    a, b = ux * pz - uz * px, ux * qz - uz * qx
    # cross products [m^2] below this count as collinear
    tangent_eps = 1e-9
    # relative to the length of the ring's edge, because the cross product grows with it
    eps_a = tangent_eps + slack * (abs(px) + abs(pz))
    eps_b = tangent_eps + slack * (abs(qx) + abs(qz))
    return not ((a > eps_a and b < -eps_b) or (a < -eps_a and b > eps_b))


@kernel()
def bucket_of(graph: Graph, x: float, z: float) -> int:
    """Return the index of the bucket of a point in the free area."""
    i = int(np.floor((x - graph.bucket_origin[0]) / graph.bucket_size[0]))
    j = int(np.floor((z - graph.bucket_origin[1]) / graph.bucket_size[0]))
    return i * graph.bucket_label.shape[1] + j


@kernel()
def visibility_edges(graph: Graph) -> tuple[NDArray, NDArray]:
    """Return pairs of nodes (i, j) [k, 2], i < j, that see each other and are tangent at both ends, and their lengths [k]."""
    pairs = np.empty((1024, 2), np.int32)
    lengths = np.empty(1024)
    count = 0
    for island in range(len(graph.first) - 1):
        for i in range(graph.first[island], graph.first[island + 1]):
            ix, iz = graph.nodes[i]
            b = bucket_of(graph, ix, iz)
            for k in range(graph.visible_start[b], graph.visible_start[b + 1]):
                j = graph.visible_nodes[k]
                # each pair once, and none across islands, between which there is no way
                if j <= i or j >= graph.first[island + 1]:
                    continue
                jx, jz = graph.nodes[j]
                if not tangent(graph, ix, iz, j, 0.0) or not tangent(graph, jx, jz, i, 0.0):
                    continue
                if not sees(graph, ix, iz, jx, jz):
                    continue
                if count == len(pairs):
                    pairs = np.concatenate((pairs, np.empty_like(pairs)))
                    lengths = np.concatenate((lengths, np.empty_like(lengths)))
                pairs[count, 0] = i
                pairs[count, 1] = j
                lengths[count] = np.hypot(jx - ix, jz - iz)
                count += 1
    return pairs[:count], lengths[:count]


@kernel()
def tangent_nodes(graph: Graph, x: float, z: float) -> tuple[NDArray, NDArray]:
    """Return nodes at which a taut string from a free point (x, z) could bend first, visible or not, and distances [m]."""
    nodes, candidates = graph.nodes, graph.visible_nodes
    b = bucket_of(graph, x, z)
    size = graph.visible_start[b + 1] - graph.visible_start[b]
    found = np.empty(size, np.int64)
    away = np.empty(size)
    count = 0
    for k in range(graph.visible_start[b], graph.visible_start[b + 1]):
        node = candidates[k]
        if tangent(graph, x, z, node, GROW_M):
            found[count] = node
            away[count] = np.hypot(nodes[node, 0] - x, nodes[node, 1] - z)
            count += 1
    return found[:count], away[:count]


@kernel()
def visible_nodes(graph: Graph, x: float, z: float) -> tuple[NDArray, NDArray]:
    """Return nodes that a taut string from a free point (x, z) can reach first, and their distances [m]."""
    found, away = tangent_nodes(graph, x, z)
    count = 0
    for k in range(len(found)):
        if sees(graph, x, z, graph.nodes[found[k], 0], graph.nodes[found[k], 1]):
            found[count], away[count] = found[k], away[k]
            count += 1
    return found[:count], away[:count]


@kernel()
def locate_many(graph: Graph, points: NDArray) -> NDArray:
    """Return the islands [N] of points [N, 2], -1 = not free."""
    out = np.empty(len(points), np.int32)
    for k in range(len(points)):
        out[k] = locate(graph, points[k, 0], points[k, 1])
    return out


@kernel()
def snap_many(graph: Graph, points: NDArray, max_distance: float) -> NDArray:
    """Return the nearest free points [N, 2] of points [N, 2]; NaN where none is within ``max_distance``."""
    out = np.empty((len(points), 2))
    for k in range(len(points)):
        x, z, _ = nearest_free(graph, points[k, 0], points[k, 1], max_distance)
        out[k, 0], out[k, 1] = x, z
    return out
