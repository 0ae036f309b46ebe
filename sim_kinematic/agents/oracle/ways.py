"""Shortest paths to fixed places as tables: the first point from each cell of the floor, and from each corner of the paths.

A path is then a few look-ups, which a GPU does as well as a CPU: from the cell to a first corner, from corner to
corner, and to the nearest place. The result is exact except for the first leg, which is chosen for the middle of a cell
(tests/sim/agents/test_oracle.py: lengths within 1% of `FreeSpace.geodesic`, at the median 0.01%).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.geometry import Array
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace._visibility import Graph, sees, visible_nodes

CELL_M = 0.2
"""Side of a cell [m]; with 0.1 m, paths would be at most 0.1% shorter and the tables four times as large."""
NONE = -1
SKIP_M, DETOUR_M, SPREAD = 0.25, 0.05, 4
"""Constants of the tables of paths. Corners of a path that are nearer than `SKIP_M` [m] to the one before are skipped:
an inflated corner is an arc of many points, whose chord leaves the free area by at most 3 cm where the radius of the
agent is 25 cm. A first point that is visible from the whole cell is preferred to one that is visible from its middle
only if the path is longer by at most `DETOUR_M` [m], because from the rest of the cell the second path may touch
obstacles, along which bases slide. A cell that is not free uses the path of the nearest free cell up to `SPREAD` cells
away."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FloorCells:
    """Cells of a floor, and the corners of paths that are visible from the whole cell."""

    origin: Array
    """Lower corner of the first cell (x, z), [2] [m]."""
    shape: tuple[int, int]
    """Number of cells along x and z."""
    middles: Array
    """Free point of each cell, its middle where that is free, [C, 2]; NaN where no point is free."""
    samples: Array
    """Middle of each cell and points on its border, [C, 9, 2] [m]; NaN for points that are not free."""
    start: NDArray[np.int64]
    """Index of the first corner of each cell, [C + 1]: cell c has ``corners[start[c]:start[c + 1]]``."""
    corners: NDArray[np.int32]
    away: Array
    """Distance from the middle of the cell to each corner [m]."""
    whole: NDArray[np.bool_]
    """True if the corner is visible from all of the cell."""

    # made once for each floor
    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, free: FreeSpace) -> FloorCells:
        """Return the cells of a free floor, with the corners of paths that are visible from the whole of each cell."""
        x0, z0, x1, z1 = free.polygon.bounds
        # one cell more, as the first begins half a cell before the border
        shape = int(np.ceil((x1 - x0) / CELL_M)) + 1, int(np.ceil((z1 - z0) / CELL_M)) + 1
        origin = np.array([x0, z0]) - 0.5 * CELL_M
        # the middle first, as `argmax` below finds the first free sample
        steps = np.array([(0, 0), *((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j)]) * (0.5 * CELL_M)
        index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 2)
        samples = (origin + (index + 0.5) * CELL_M)[:, None] + steps
        samples[~free.is_navigable(samples)] = np.nan
        seen = np.isfinite(samples[..., 0])
        # where no sample is free `argmax` is 0, and the middle is NaN as documented
        middles = samples[np.arange(len(samples)), seen.argmax(1)]
        start, corners, away, whole = _cell_corners(free.graph, middles, samples)
        return cls(
            origin=origin,
            shape=shape,
            middles=middles,
            samples=samples,
            start=start,
            corners=corners,
            away=away,
            whole=whole,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PathTable:
    """Shortest paths to the nearest of several places; corners of the floor are numbered first, then the places."""

    points: Array
    """Nodes of the graph: corners, then places, [n + S, 2] [m]."""
    corners: int
    """Number n of corners."""
    origin: Array
    shape: tuple[int, int]
    first: NDArray[np.int16]
    """Number of the first point of the path from each cell, [C]; -1: there is no path."""
    after: NDArray[np.int16]
    """Number of the next point of the path from each corner, [n]; -1: there is no path."""
    left: Array
    """Length of the path from each point, [n + S] [m]; infinity if there is no path."""

    @property
    def ends(self) -> Array:
        """Places at the ends of paths, [S, 2]."""
        return self.points[self.corners :]

    def cell(self, xz: ArrayLike) -> NDArray[np.int64]:
        """Return the number of the cell of points [..., 2] [m], or of the nearest cell for points beside the floor."""
        at = np.floor((np.asarray(xz, np.float64) - self.origin) / CELL_M).astype(np.int64)
        i, j = (at[..., k].clip(0, self.shape[k] - 1) for k in (0, 1))
        return i * self.shape[1] + j

    def start(self, xz: ArrayLike) -> int:
        """Return the number of the point to go to first from a point [2]; -1: there is no path."""
        return int(self.first[self.cell(xz)])

    def length(self, xz: ArrayLike) -> Array:
        """Return the length [...] [m] of the path from points [..., 2]; infinity if there is no path."""
        xz = np.asarray(xz, np.float64)
        number = self.first[self.cell(xz)].astype(np.int64)
        # where there is no path, -1 reads the last point, and the result is thrown away
        gap = self.points[number] - xz
        return np.where(number < 0, np.inf, np.sqrt(gap[..., 0] ** 2 + gap[..., 1] ** 2) + self.left[number])


def paths_to(free: FreeSpace, places: ArrayLike | Sequence[Array]) -> PathTable:
    """Return the paths on a floor to the nearest of some free places [S, 2]."""
    ends = np.ascontiguousarray(np.asarray(places, np.float64).reshape(-1, 2))
    cells, nodes = FloorCells.of(free), free.graph.nodes
    left, after = _from_corners(free.graph, ends, SKIP_M)
    first = _from_cells(
        free.graph,
        cells.middles,
        cells.samples,
        cells.start,
        cells.corners,
        cells.away,
        cells.whole,
        left,
        ends,
        DETOUR_M,
    )
    return PathTable(
        points=np.concatenate([nodes, ends]),
        corners=len(nodes),
        origin=cells.origin,
        shape=cells.shape,
        first=_spread(first.reshape(cells.shape)).ravel().astype(np.int16),
        after=after.astype(np.int16),
        left=np.append(left, np.zeros(len(ends))),
    )


def _spread(first: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the way of a neighbour for cells [nx, nz] that have none themselves."""
    for _ in range(SPREAD):
        padded, near = np.pad(first, 1, constant_values=NONE), first.copy()
        # neighbours across a side before those across a corner, which are farther away
        for i, j in ((0, 1), (2, 1), (1, 0), (1, 2), (0, 0), (0, 2), (2, 0), (2, 2)):
            moved = padded[i : i + first.shape[0], j : j + first.shape[1]]
            near = np.where(near == NONE, moved, near)
        first = near
    return first


@kernel()
def _sees_all(graph: Graph, samples: NDArray, x: float, z: float) -> bool:
    """Return whether (x, z) is seen from all free samples [9, 2] of a cell."""
    for s in range(len(samples)):
        if np.isfinite(samples[s, 0]) and not sees(graph, samples[s, 0], samples[s, 1], x, z):
            return False
    return True


@kernel()
def _cell_corners(graph: Graph, middles: NDArray, samples: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return `FloorCells.start`, ``corners``, ``away`` and ``whole``."""
    start = np.zeros(len(middles) + 1, np.int64)
    corners, away, whole = np.empty(4096, np.int32), np.empty(4096), np.empty(4096, np.bool_)
    for c in range(len(middles)):
        start[c + 1] = start[c]
        if not np.isfinite(middles[c, 0]):
            continue
        found, length = visible_nodes(graph, middles[c, 0], middles[c, 1])
        # how many corners all cells see is known only afterwards, so the arrays double
        while start[c] + len(found) > len(corners):
            corners, away = np.concatenate((corners, corners)), np.concatenate((away, away))
            whole = np.concatenate((whole, whole))
        for k in range(len(found)):
            at = start[c] + k
            corners[at], away[at] = found[k], length[k]
            x, z = graph.nodes[found[k]]
            whole[at] = _sees_all(graph, samples[c], x, z)
        start[c + 1] = start[c] + len(found)
    total = start[len(middles)]
    return start, corners[:total], away[:total], whole[:total]


@kernel()
def _from_corners(graph: Graph, ends: NDArray, skip: float) -> tuple[NDArray, NDArray]:
    """Return the length of the path from every corner to the nearest end, and the point to go to from there."""
    n = len(graph.nodes)
    left, before, after = np.full(n, np.inf), np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    for e in range(len(ends)):
        found, away = visible_nodes(graph, ends[e, 0], ends[e, 1])
        for k in range(len(found)):
            for v in range(n):
                length = away[k] + graph.distance[found[k], v]
                if length < left[v]:
                    left[v] = length
                    # the point before v on the way from the end is the one after v on the way there
                    before[v] = n + e if found[k] == v else graph.previous[found[k], v]
    for v in range(n):
        u = before[v]
        # numbers from n on are ends, which are never passed over
        while 0 <= u < n and before[u] >= 0:
            dx, dz = graph.nodes[u, 0] - graph.nodes[v, 0], graph.nodes[u, 1] - graph.nodes[v, 1]
            if np.hypot(dx, dz) >= skip:
                break
            u = before[u]
        after[v] = u
    return left, after


@kernel()
def _from_cells(
    graph: Graph,
    middles: NDArray,
    samples: NDArray,
    start: NDArray,
    corners: NDArray,
    away: NDArray,
    whole: NDArray,
    left: NDArray,
    ends: NDArray,
    detour: float,
) -> NDArray:
    """Return the point to go to first from each cell on the shortest path.

    It is the best point that is visible from the whole cell, unless the path through it is more than ``detour`` longer
    than the best from the cell's middle, which is taken then.
    """
    n = len(graph.nodes)
    first = np.full(len(middles), -1, np.int64)
    for c in range(len(middles)):
        x, z = middles[c]
        if not np.isfinite(x):
            continue
        safe, safest, best, nearest = np.inf, -1, np.inf, -1
        for k in range(start[c], start[c + 1]):
            length = away[k] + left[corners[k]]
            if whole[k] and length < safe:
                safe, safest = length, corners[k]
            if length < best:
                best, nearest = length, corners[k]
        for e in range(len(ends)):
            length = np.hypot(ends[e, 0] - x, ends[e, 1] - z)
            # the length first: what is no shorter need not be looked for through the home
            if length < max(best, safe) and sees(graph, x, z, ends[e, 0], ends[e, 1]):
                if length < best:
                    best, nearest = length, n + e
                if length < safe and _sees_all(graph, samples[c], ends[e, 0], ends[e, 1]):
                    safe, safest = length, n + e
        if np.isfinite(best):
            first[c] = safest if safe <= best + detour else nearest
    return first
