"""Numba kernels of exact shortest paths between two points, over the visibility graph of a free area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene.freespace._visibility import Graph, locate, nearest_free, sees, tangent_nodes


@kernel()
def geodesic_pair(
    graph: Graph, ax: float, az: float, bx: float, bz: float, max_snap: float
) -> tuple[float, int, int, float, float, float, float]:
    """Return the length of the shortest path [m] (inf: none), its end nodes (-1: straight), and the two snapped ends.

    The search is best-first: of all pairs of corners near the ends, the pair with the shortest path is tested, and
        dropped if an end does not see its corner. Tests of visibility are expensive, and usually the first pair is
        visible.
    """
    island, other = locate(graph, ax, az), locate(graph, bx, bz)
    if island < 0:
        ax, az, island = nearest_free(graph, ax, az, max_snap)
    if other < 0:
        bx, bz, other = nearest_free(graph, bx, bz, max_snap)
    if island < 0 or island != other:
        return np.inf, -1, -1, ax, az, bx, bz
    if sees(graph, ax, az, bx, bz):
        return np.hypot(bx - ax, bz - az), -1, -1, ax, az, bx, bz
    nodes, distance = graph.nodes, graph.distance
    near_a, away_a = tangent_nodes(graph, ax, az)
    near_b, away_b = tangent_nodes(graph, bx, bz)
    # each corner is looked at once at most, however often it is part of the best pair
    seen_a, seen_b = np.zeros(len(near_a), np.bool_), np.zeros(len(near_b), np.bool_)
    while True:
        best, p, q = np.inf, -1, -1
        for i in range(len(near_a)):
            # already longer before the second half is added
            if away_a[i] >= best:
                continue
            for j in range(len(near_b)):
                length = away_a[i] + distance[near_a[i], near_b[j]] + away_b[j]
                if length < best:
                    best, p, q = length, i, j
        if p < 0:
            return np.inf, -1, -1, ax, az, bx, bz
        if not seen_a[p]:
            seen_a[p] = sees(graph, ax, az, nodes[near_a[p], 0], nodes[near_a[p], 1])
            if not seen_a[p]:
                away_a[p] = np.inf
                continue
        if not seen_b[q]:
            seen_b[q] = sees(graph, bx, bz, nodes[near_b[q], 0], nodes[near_b[q], 1])
            if not seen_b[q]:
                away_b[q] = np.inf
                continue
        return best, near_a[p], near_b[q], ax, az, bx, bz


@kernel()
def geodesic_many(graph: Graph, starts: NDArray, ends: NDArray, max_snap: float) -> NDArray:
    """Return shortest path lengths [N] [m] between points [N, 2]; inf where there is no path."""
    out = np.empty(len(starts))
    for k in range(len(starts)):
        out[k] = geodesic_pair(graph, starts[k, 0], starts[k, 1], ends[k, 0], ends[k, 1], max_snap)[0]
    return out


@kernel()
def first_leg(
    graph: Graph, ax: float, az: float, bx: float, bz: float, max_snap: float, beyond: float
) -> tuple[float, float, float]:
    """Return the length of the shortest path [m] and ``(x, z)`` of its first waypoint farther than ``beyond`` from a.

    If no waypoint is farther, the end of the path is returned. The length is infinite if there is no path.
    """
    length, enter, leave, ax, az, bx, bz = geodesic_pair(graph, ax, az, bx, bz, max_snap)
    if not np.isfinite(length):
        return length, np.nan, np.nan
    x, z, node = bx, bz, leave
    while node >= 0:  # from the end to the start: the last that is far enough is the first on the path
        dx, dz = graph.nodes[node, 0] - ax, graph.nodes[node, 1] - az
        if np.sqrt(dx * dx + dz * dz) > beyond:
            x, z = graph.nodes[node, 0], graph.nodes[node, 1]
        node = graph.previous[enter, node] if node != enter else -1
    return length, x, z


@kernel()
def path_pair(graph: Graph, ax: float, az: float, bx: float, bz: float, max_snap: float) -> NDArray:
    """Return the waypoints of the shortest path, both ends included, shape [k, 2]; k = 0 if there is no path."""
    length, enter, leave, ax, az, bx, bz = geodesic_pair(graph, ax, az, bx, bz, max_snap)
    if not np.isfinite(length):
        return np.empty((0, 2))
    corners = 0
    node = leave
    while node >= 0:
        corners += 1
        node = graph.previous[enter, node] if node != enter else -1
    points = np.empty((corners + 2, 2))
    points[0, 0], points[0, 1] = ax, az
    points[corners + 1, 0], points[corners + 1, 1] = bx, bz
    node = leave
    for k in range(corners, 0, -1):
        x, z = graph.nodes[node]
        points[k, 0], points[k, 1] = x, z  # by element: to copy slices, numba compiles an error text for 2 s
        node = graph.previous[enter, node] if node != enter else -1
    return points
