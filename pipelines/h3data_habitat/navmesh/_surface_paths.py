"""Numba kernels of exact shortest paths on a walking surface: cones of view through shared edges, and A* over the corners."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data_habitat.navmesh._surface import ANGLE_EPS, TAUT_EPS, TOUCH_M, Surface, _cross, _on_segment, nearest

STARTS_MAX = 64
"""Largest number of polygons that may meet in one point."""


@kernel()
def _in_cone(ux: float, uz: float, rx: float, rz: float, lx: float, lz: float) -> bool:
    """Return whether direction u lies between the right and the left border of a cone (less than half a turn)."""
    eps = ANGLE_EPS * (abs(ux) + abs(uz))
    right = _cross(rx, rz, ux, uz) >= -eps * (abs(rx) + abs(rz))
    return right and _cross(ux, uz, lx, lz) >= -eps * (abs(lx) + abs(lz))


@kernel()
def _meeting(surface: Surface, polygon: int, x: float, z: float, found: NDArray) -> int:
    """Count the polygons that meet in (x, z), from one of them through edges that touch the point; fill their indices."""
    found[0] = polygon
    count, head = 1, 0
    while head < count:
        p = found[head]
        head += 1
        first, last = surface.start[p], surface.start[p + 1]
        for s in range(first, last):
            beyond = surface.neighbour[s]
            if beyond < 0 or count == len(found):
                continue
            r = s + 1 if s + 1 < last else first
            ax, az, bx, bz = surface.corner[s, 0], surface.corner[s, 2], surface.corner[r, 0], surface.corner[r, 2]
            # a point on an edge or a corner is in all polygons there, and sees through all of them
            t = _on_segment(x, z, ax, az, bx, bz)
            if np.hypot(x - ax - t * (bx - ax), z - az - t * (bz - az)) > TOUCH_M:
                continue
            known = False
            for k in range(count):
                known |= found[k] == beyond
            if not known:
                found[count] = beyond
                count += 1
    return count


@kernel()
def view(surface: Surface, polygon: int, x: float, z: float, target: int, tx: float, tz: float, seen: NDArray) -> bool:
    """Mark the nodes that are visible from (x, z), bool [n], and return whether (tx, tz) in polygon ``target`` is.

    Triangular expansion (Bungiu et al. 2014) on convex polygons: a cone of view is narrowed by every edge it goes through.
    """
    starts = np.empty(STARTS_MAX, np.int32)
    # from every polygon that meets in the point: a view from one would end at the edge it lies on
    count = _meeting(surface, polygon, x, z, starts)
    depth = 6 * len(surface.island) + 6 * STARTS_MAX  # a straight ray meets no polygon twice, each adds at most five
    into, came, cone = np.empty(depth, np.int32), np.empty(depth, np.int32), np.empty((depth, 4))
    top = 0
    hit = False
    for k in range(count):
        p = starts[k]
        hit |= p == target
        first, last = surface.start[p], surface.start[p + 1]
        for s in range(first, last):
            if surface.corner_node[s] >= 0:
                seen[surface.corner_node[s]] = True
            beyond = surface.neighbour[s]
            if beyond < 0 or (starts[:count] == beyond).any():
                continue
            r = s + 1 if s + 1 < last else first
            ax, az = surface.corner[s, 0] - x, surface.corner[s, 2] - z
            bx, bz = surface.corner[r, 0] - x, surface.corner[r, 2] - z
            # an edge that is seen from its back, or end on, lets nothing through
            if _cross(ax, az, bx, bz) > 0.0 and top < depth:
                into[top], came[top] = beyond, p
                cone[top, 0], cone[top, 1], cone[top, 2], cone[top, 3] = ax, az, bx, bz
                top += 1
    while top > 0:
        top -= 1
        p, back = into[top], came[top]
        rx, rz, lx, lz = cone[top]
        hit |= p == target and _in_cone(tx - x, tz - z, rx, rz, lx, lz)
        first, last = surface.start[p], surface.start[p + 1]
        for s in range(first, last):
            ax, az = surface.corner[s, 0] - x, surface.corner[s, 2] - z
            node = surface.corner_node[s]
            if node >= 0 and not seen[node] and _in_cone(ax, az, rx, rz, lx, lz):
                seen[node] = True
            beyond = surface.neighbour[s]
            if beyond < 0 or beyond == back or top == depth:
                continue
            r = s + 1 if s + 1 < last else first
            bx, bz = surface.corner[r, 0] - x, surface.corner[r, 2] - z
            if _cross(ax, az, bx, bz) <= 0.0:
                continue
            # the cone is narrowed from the side on which the edge ends inside of it
            nrx, nrz, nlx, nlz = rx, rz, lx, lz
            if _cross(rx, rz, ax, az) > 0.0:
                nrx, nrz = ax, az
            if _cross(bx, bz, lx, lz) > 0.0:
                nlx, nlz = bx, bz
            if _cross(nrx, nrz, nlx, nlz) > 0.0:
                into[top], came[top] = beyond, p
                cone[top, 0], cone[top, 1], cone[top, 2], cone[top, 3] = nrx, nrz, nlx, nlz
                top += 1
    return hit


@kernel()
def _taut(surface: Surface, node: int, x: float, z: float) -> bool:
    """Return whether a taut string from (x, z) can bend at a node: both walls beside it lie on one side of the string."""
    vx, vz = surface.node[node, 0], surface.node[node, 2]
    side = surface.node_side[node]
    ux, uz = vx - x, vz - z
    # the point may be off by as much, which moves the products by this
    slack = TOUCH_M * (abs(side[0] - vx) + abs(side[1] - vz) + abs(side[2] - vx) + abs(side[3] - vz))
    a = _cross(ux, uz, side[0] - vx, side[1] - vz)
    b = _cross(ux, uz, side[2] - vx, side[3] - vz)
    eps = TAUT_EPS + slack
    return not ((a > eps and b < -eps) or (a < -eps and b > eps))


@kernel()
def link_nodes(surface: Surface) -> tuple[NDArray, NDArray]:
    """Link nodes that see each other and are taut at both ends: (start int64 [n + 1], node int64 [links])."""
    n = len(surface.node)
    start = np.zeros(n + 1, np.int64)
    links = np.empty(max(16 * n, 1), np.int64)
    count = 0
    seen = np.zeros(n, np.bool_)
    for i in range(n):
        seen[:] = False
        x, z = surface.node[i, 0], surface.node[i, 2]
        view(surface, surface.node_polygon[i], x, z, -1, 0.0, 0.0, seen)
        for j in range(n):
            if j == i or not seen[j] or not _taut(surface, j, x, z):
                continue
            # taut at both ends: a shortest path bends at each of its nodes
            if not _taut(surface, i, surface.node[j, 0], surface.node[j, 2]):
                continue
            if count == len(links):
                links = np.concatenate((links, np.empty_like(links)))
            links[count] = j
            count += 1
        start[i + 1] = count
    return start, links[:count]


@kernel()
def shortest(surface: Surface, start: NDArray, first: int, end: NDArray, last: int) -> tuple[float, NDArray]:
    """Return the length [m] in space of the shortest path between two points [3], and the path's points [k, 3].

    The points lie in polygons ``first`` and ``last``. Returns infinity and no points if there is no path.
    """
    if surface.island[first] != surface.island[last]:
        return np.inf, np.empty((0, 3))
    n = len(surface.node)
    near = np.zeros(n, np.bool_)
    if view(surface, first, start[0], start[2], last, end[0], end[2], near):
        points = np.empty((2, 3))
        points[0], points[1] = start, end
        return np.sqrt(((end - start) ** 2).sum()), points
    goal = np.zeros(n, np.bool_)
    view(surface, last, end[0], end[2], -1, 0.0, 0.0, goal)
    # A* with the straight line as estimate, which never exceeds the path
    best = np.full(n + 1, np.inf)  # node n is the end
    rest = np.full(n, np.inf)
    parent = np.full(n + 1, -1, np.int32)
    closed = np.zeros(n + 1, np.bool_)
    # one entry that is taken out again tells numba the type of the list
    heap = [(0.0, n)]
    heap.pop()
    for i in range(n):
        if near[i] and _taut(surface, i, start[0], start[2]):
            best[i] = np.sqrt(((surface.node[i] - start) ** 2).sum())
            rest[i] = np.sqrt(((surface.node[i] - end) ** 2).sum())
            heappush(heap, (best[i] + rest[i], i))
    while len(heap) > 0:
        i = heappop(heap)[1]
        if i == n:
            break
        # an older, longer entry of a node that was reached by a shorter path since
        if closed[i]:
            continue
        closed[i] = True
        if goal[i] and _taut(surface, i, end[0], end[2]) and best[i] + rest[i] < best[n]:
            best[n] = best[i] + rest[i]
            parent[n] = i
            heappush(heap, (best[n], n))
        for k in range(surface.link_start[i], surface.link_start[i + 1]):
            j = surface.link_node[k]
            length = best[i] + surface.link_length[k]
            if length < best[j]:
                best[j] = length
                parent[j] = i
                if rest[j] == np.inf:
                    rest[j] = np.sqrt(((surface.node[j] - end) ** 2).sum())
                heappush(heap, (length + rest[j], int(j)))
    if parent[n] < 0:
        return np.inf, np.empty((0, 3))
    count = 2
    i = parent[n]
    while i >= 0:
        count += 1
        i = parent[i]
    points = np.empty((count, 3))
    points[0], points[count - 1] = start, end
    i = parent[n]
    for k in range(count - 2, 0, -1):
        points[k] = surface.node[i]
        i = parent[i]
    return best[n], points


@kernel()
def way(surface: Surface, a: NDArray, b: NDArray) -> tuple[float, NDArray]:
    """Return the path of `shortest` between the points of the surface nearest to a [3] and b [3] [m]."""
    first, ax, ay, az = nearest(surface, a[0], a[1], a[2], -1)
    last, bx, by, bz = nearest(surface, b[0], b[1], b[2], -1)
    if first < 0 or last < 0:
        return np.inf, np.empty((0, 3))
    return shortest(surface, np.array([ax, ay, az]), first, np.array([bx, by, bz]), last)
