"""Numba kernels of approximate distances between two points, by a table of all pairs of nodes of a coarse lattice."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene.freespace._geodesic import geodesic_pair
from h3data.scene.freespace._sdf import line_of_sight
from h3data.scene.freespace._visibility import Graph, locate, sees, visible_nodes

NEAR_M = 3.0
"""Length of paths around corners below which they are computed exactly [m], because the lattice's error reaches 10%."""


def lattice_step(area_m2: float) -> float:
    """Return the spacing [m] of the lattice for a free area."""
    # 1,200 nodes make a table of 6 MB. In small homes 0.25 m leaves an error of 2.0% at p95 and 0.15 m one of 0.9%; with
    # 0.5 m, 12 of 720 pairs fail (research/navigation-and-stepping.md 2.3).
    step = min(max(float(np.sqrt(area_m2 / 1200)), 0.15), 0.25)
    # larger floors get a coarser lattice: with 4,000 nodes the table stays below 64 MB
    return max(step, float(np.sqrt(area_m2 / 4000)))


class Lattice(NamedTuple):
    """Shortest distances between all free points of a square lattice."""

    origin: NDArray[np.float64]
    """Lower corner of lattice cell [0, 0] (x, z); nodes sit at cell centres, shape [2] [m]."""
    step: float
    rows: NDArray[np.int32]
    """Row of the table of each lattice node, -1 = not free, shape [lx, lz]."""
    table: NDArray[np.float32]
    """Shortest path lengths [m], inf between islands, shape [k, k]."""


@kernel()
def _table(graph: Graph, points: NDArray, island: NDArray) -> NDArray:
    """Return the exact distances [k, k] between free points: through the corners that each sees, or straight."""
    k = len(points)
    n = len(graph.nodes)
    table = np.full((k, k), np.inf, np.float32)
    start = np.zeros(k + 1, np.int64)
    seen = np.empty(1024, np.int32)
    away = np.empty(1024, np.float64)
    for p in range(k):
        one_seen, one_away = visible_nodes(graph, points[p, 0], points[p, 1])
        count = len(one_seen)
        # doubled, so that whatever is in it is copied only a few times
        while start[p] + count > len(seen):
            seen = np.concatenate((seen, np.empty_like(seen)))
            away = np.concatenate((away, np.empty_like(away)))
        for c in range(count):
            seen[start[p] + c] = one_seen[c]
            away[start[p] + c] = one_away[c]
        start[p + 1] = start[p] + count
    # one row of sums for all goals: from p by way of any corner that it sees to every other corner
    through = np.empty(n, np.float32)  # from p to every corner
    for p in range(k):
        through[:] = np.inf
        for c in range(start[p], start[p + 1]):
            row = graph.distance[seen[c]]
            a = np.float32(away[c])
            for v in range(n):
                through[v] = min(through[v], a + row[v])
        table[p, p] = 0.0
        for q in range(p + 1, k):
            if island[p] != island[q]:
                continue
            best = np.float32(np.inf)
            for c in range(start[q], start[q + 1]):
                best = min(best, through[seen[c]] + np.float32(away[c]))
            straight = np.float32(np.hypot(points[p, 0] - points[q, 0], points[p, 1] - points[q, 1]))
            # looked at only where it would be shorter than the way around corners
            if straight < best - 1e-6 and sees(graph, points[p, 0], points[p, 1], points[q, 0], points[q, 1]):
                best = straight
            table[p, q] = best
            table[q, p] = best
    return table


@kernel()
def _islands(graph: Graph, origin: NDArray, step: float, nx: int, nz: int) -> NDArray:
    out = np.empty((nx, nz), np.int32)
    for i in range(nx):
        for j in range(nz):
            out[i, j] = locate(graph, origin[0] + (i + 0.5) * step, origin[1] + (j + 0.5) * step)
    return out


def build_lattice(graph: Graph, bounds: tuple[float, float, float, float], *, step: float) -> Lattice:
    """Compute the lattice of a free area with ``bounds`` (x0, z0, x1, z1) [m]."""
    x0, z0, x1, z1 = bounds
    origin = np.array([x0, z0])
    nx, nz = max(1, int(np.ceil((x1 - x0) / step))), max(1, int(np.ceil((z1 - z0) / step)))
    island = _islands(graph, origin, step, nx, nz)
    free = island >= 0
    rows = np.full((nx, nz), -1, np.int32)
    rows[free] = np.arange(free.sum(), dtype=np.int32)
    points = origin + (np.argwhere(free) + 0.5) * step
    return Lattice(origin, step, rows, _table(graph, points, island[free]))


@kernel()
def _seen_nodes(
    sdf: NDArray,
    origin: NDArray,
    cell: float,
    radius: float,
    lattice: Lattice,
    x: float,
    z: float,
    found: NDArray,
    away: NDArray,
) -> int:
    """Return the nodes of the 4 x 4 around (x, z) that a disc can go to straight: fills table rows and distances."""
    nx, nz = lattice.rows.shape
    # nodes are at the centres of cells, hence the half; the two nearest on either side
    i0 = int(np.floor((x - lattice.origin[0]) / lattice.step - 0.5)) - 1
    j0 = int(np.floor((z - lattice.origin[1]) / lattice.step - 0.5)) - 1
    count = 0
    for i in range(max(i0, 0), min(i0 + 4, nx)):
        for j in range(max(j0, 0), min(j0 + 4, nz)):
            row = lattice.rows[i, j]
            if row < 0:
                continue
            px = lattice.origin[0] + (i + 0.5) * lattice.step
            pz = lattice.origin[1] + (j + 0.5) * lattice.step
            if line_of_sight(sdf, origin, cell, radius, x, z, px, pz):
                found[count] = row
                away[count] = np.hypot(px - x, pz - z)
                count += 1
    return count


@kernel()
def lattice_distance(
    sdf: NDArray,
    origin: NDArray,
    cell: float,
    radius: float,
    lattice: Lattice,
    ax: float,
    az: float,
    bx: float,
    bz: float,
) -> float:
    """Return the approximate length of the shortest path from a to b [m].

    The length is never too short by more than the slack of the line of sight. Its median error is 0.1%, and the largest
    errors occur next to corners at short range. It is infinite if the table does not connect a and b, although the
    exact graph may do so.
    """
    if line_of_sight(sdf, origin, cell, radius, ax, az, bx, bz):
        return np.hypot(bx - ax, bz - az)
    seen_a = np.empty(16, np.int64)
    away_a = np.empty(16)
    seen_b = np.empty(16, np.int64)
    away_b = np.empty(16)
    count_a = _seen_nodes(sdf, origin, cell, radius, lattice, ax, az, seen_a, away_a)
    count_b = _seen_nodes(sdf, origin, cell, radius, lattice, bx, bz, seen_b, away_b)
    best = np.inf
    for p in range(count_a):
        for q in range(count_b):
            best = min(best, away_a[p] + lattice.table[seen_a[p], seen_b[q]] + away_b[q])
    return best


@kernel()
def quick_distance(
    graph: Graph,
    sdf: NDArray,
    origin: NDArray,
    cell: float,
    radius: float,
    lattice: Lattice,
    ax: float,
    az: float,
    bx: float,
    bz: float,
    max_snap: float,
) -> float:
    """Return the length of the shortest path from a to b [m], by the lattice, or exactly where its error could be large."""
    length = lattice_distance(sdf, origin, cell, radius, lattice, ax, az, bx, bz)
    if (length < NEAR_M and length > np.hypot(bx - ax, bz - az)) or length == np.inf:
        return geodesic_pair(graph, ax, az, bx, bz, max_snap)[0]
    return length


@kernel()
def quick_distance_many(
    graph: Graph,
    sdf: NDArray,
    origin: NDArray,
    cell: float,
    radius: float,
    lattice: Lattice,
    starts: NDArray,
    ends: NDArray,
    max_snap: float,
) -> NDArray:
    """Return lengths [N] [m] of shortest paths between points [N, 2], as `quick_distance` does."""
    out = np.empty(len(starts))
    for k in range(len(starts)):
        out[k] = quick_distance(
            graph, sdf, origin, cell, radius, lattice, starts[k, 0], starts[k, 1], ends[k, 0], ends[k, 1], max_snap
        )
    return out
