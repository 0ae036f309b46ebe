"""Numba kernels of distances from any point to fixed goals, by a table of all corners and a check of the nearest ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene.freespace._visibility import Graph, locate, nearest_free, sees, tangent_nodes, visible_nodes

TOUCH_M = 1e-7
"""Distance below which a point counts as being on a corner [m]."""


@kernel()
def corner_distances(graph: Graph, goals: NDArray) -> NDArray:
    """Return the length [n] [m] of the shortest taut path from every node to the nearest of free goals [K, 2].

    Lengths are infinite where there is no path.
    """
    out = np.full(len(graph.nodes), np.inf)
    for g in range(len(goals)):
        found, away = visible_nodes(graph, goals[g, 0], goals[g, 1])
        for k in range(len(found)):
            row = graph.distance[found[k]]
            for v in range(len(out)):
                out[v] = min(out[v], away[k] + row[v])
    return out


@kernel()
def field_at(
    graph: Graph, corner: NDArray, goals: NDArray, x: float, z: float, max_snap: float
) -> tuple[float, float, float]:
    """Return the distance [m] from (x, z) to the nearest goal, and the unit direction (dx, dz) of the shortest path to it.

    ``corner`` holds the `corner_distances` of the goals. Without a path, the distance is infinite and the direction
    NaN. At a goal the direction is zero.
    """
    island = locate(graph, x, z)
    if island < 0:
        x, z, island = nearest_free(graph, x, z, max_snap)
    if island < 0:
        return np.inf, np.nan, np.nan
    # the goals in sight first: a straight way is often the shortest, and its length ends the search below early
    best, tx, tz = np.inf, np.nan, np.nan
    for g in range(len(goals)):
        gx, gz = goals[g]
        away = np.hypot(gx - x, gz - z)
        if away < best and sees(graph, x, z, gx, gz):
            best, tx, tz = away, gx, gz
    near, away_near = tangent_nodes(graph, x, z)
    for k in range(len(near)):  # standing on a corner, its next one is as good
        away_near[k] = away_near[k] + corner[near[k]] if away_near[k] > TOUCH_M else np.inf
    while True:  # best first, as `geodesic_pair`
        least, p = best, -1
        for k in range(len(near)):
            if away_near[k] < least:
                least, p = away_near[k], k
        if p < 0:
            break
        vx, vz = graph.nodes[near[p]]
        if sees(graph, x, z, vx, vz):
            best, tx, tz = least, vx, vz
            break
        away_near[p] = np.inf
    if best == 0.0:
        return 0.0, 0.0, 0.0
    length = np.hypot(tx - x, tz - z)
    return best, (tx - x) / length, (tz - z) / length


@kernel()
def field_many(graph: Graph, corner: NDArray, goals: NDArray, points: NDArray, max_snap: float) -> NDArray:
    """Return distances [m] and unit directions (dx, dz) to the nearest goal, [N, 3], at points [N, 2] [m]."""
    out = np.empty((len(points), 3))
    for k in range(len(points)):
        out[k, 0], out[k, 1], out[k, 2] = field_at(graph, corner, goals, points[k, 0], points[k, 1], max_snap)
    return out
