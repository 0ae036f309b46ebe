"""Ways on the floor round those who stand there, and places to which somebody can go to be out of others' way.

A flood (Dijkstra 1959) over a grid of the free floor, from where somebody is, stops at obstacles and at discs. It is run only
when agents are in each other's way: the shortest paths of `FreeSpace` know of no agents.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace.free_space import line_of_sight

CELL_M = 0.1
SPARE_M = 0.01
"""Free way beyond the agent's radius in every cell that a way leads through."""
NEAR_M = 0.15
"""A way ends where its last cell is this near to the goal."""
LEAVES_M = 0.05
"""Who is in a disc already may move away from its middle, by steps of this."""


@kernel(error_model="numpy")
def _flood(room, least, discs, origin, cell, si, sj):
    """Distances [nx, nz] [m] over the grid from cell (si, sj), infinite where no way leads, and the cells before."""
    nx, nz = room.shape
    distance = np.full((nx, nz), np.inf)
    before = np.full((nx, nz), -1, np.int64)
    distance[si, sj] = 0.0
    heap = [(0.0, si * nz + sj)]
    while len(heap) > 0:
        far, at = heapq.heappop(heap)
        i, j = at // nz, at % nz
        if far > distance[i, j]:
            continue
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a, b = i + di, j + dj
                if (di == 0 and dj == 0) or a < 0 or b < 0 or a >= nx or b >= nz or room[a, b] < least:
                    continue
                new = far + cell * math.sqrt(di * di + dj * dj)
                if new >= distance[a, b]:
                    continue
                x, z = origin[0] + (a + 0.5) * cell, origin[1] + (b + 0.5) * cell
                fits = True
                for d in range(len(discs)):
                    if math.hypot(x - discs[d, 0], z - discs[d, 1]) < discs[d, 2]:
                        fits = False
                if fits:
                    distance[a, b] = new
                    before[a, b] = at
                    heapq.heappush(heap, (new, a * nz + b))
    return distance, before


@dataclass(frozen=True, eq=False)
class FloorRoutes:
    """The grid of one home."""

    free: FreeSpace
    origin: NDArray[np.float64]
    """Lower corner of cell [0, 0]."""
    centres: NDArray[np.float64]
    """Middle of each cell, [nx, nz, 2] [m]."""
    room: NDArray[np.float64]
    """Distance from there to the nearest obstacle, [nx, nz] [m]."""

    @staticmethod
    @lru_cache(maxsize=16)
    def of(free: FreeSpace) -> FloorRoutes:
        """The grid of a home, made once."""
        count = np.ceil(np.array(free.sdf.shape) * free.cell_m / CELL_M).astype(int)
        axes = [free.origin[k] + (np.arange(count[k]) + 0.5) * CELL_M for k in (0, 1)]
        centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        return FloorRoutes(free, np.asarray(free.origin, np.float64), centres, free.signed_distance(centres))

    def flood(self, start: NDArray, discs: NDArray) -> Flood:
        """All ways from ``start`` [2] that keep out of ``discs`` ``(x, z, radius)`` [N, 3]; out of one in which it starts
        they lead."""
        discs = np.array(discs, np.float64).reshape(-1, 3)
        gaps = np.hypot(*(discs[:, :2] - start).T)
        discs[:, 2] = np.minimum(discs[:, 2], gaps - LEAVES_M)
        i, j = np.clip(((start - self.origin) / CELL_M).astype(int), 0, np.array(self.room.shape) - 1).tolist()
        least = self.free.radius_m + SPARE_M
        distance, before = _flood(self.room, least, discs, self.origin, CELL_M, i, j)
        return Flood(self, np.array(start, np.float64), discs, distance, before)


@dataclass(frozen=True, eq=False)
class Flood:
    """All ways from one place."""

    grid: FloorRoutes
    start: NDArray[np.float64]
    discs: NDArray[np.float64]
    distance: NDArray[np.float64]
    """Length of the way to each cell, [nx, nz] [m]."""
    before: NDArray[np.int64]

    def way_to(self, goal: NDArray) -> NDArray[np.float64] | None:
        """Floor points [N, 2] from the start to ``goal`` [2], straight lines between them free; None: there is no way."""
        gap = np.hypot(*(self.grid.centres - goal).transpose(2, 0, 1))
        near = np.where(gap <= NEAR_M, self.distance + gap, np.inf)
        best = int(near.argmin())
        return self._way(best, goal) if np.isfinite(near.flat[best]) else None

    def nearest(self, fits: NDArray[np.bool_]) -> NDArray[np.float64] | None:
        """The way, as of `way_to`, to the nearest of the cells [nx, nz] that fit."""
        lengths = np.where(fits, self.distance, np.inf)
        best = int(lengths.argmin())
        return self._way(best, self.grid.centres.reshape(-1, 2)[best]) if np.isfinite(lengths.flat[best]) else None

    def _way(self, cell: int, goal: NDArray) -> NDArray[np.float64]:
        cells = [cell]
        while self.before.flat[cells[-1]] >= 0:
            cells.append(int(self.before.flat[cells[-1]]))
        points = [self.start, *self.grid.centres.reshape(-1, 2)[cells[-2:0:-1]], np.asarray(goal, np.float64)]
        way, k = [points[0]], 0
        while k < len(points) - 1:
            ahead = next((n for n in range(len(points) - 1, k + 1, -1) if self._sees(points[k], points[n])), k + 1)
            # where a cell's corner is cut, the shortest path goes round it
            leg = self.grid.free.path(points[k], points[ahead], max_snap_m=1.0)
            way += list(leg[1:]) if len(leg) else [points[ahead]]
            k = ahead
        return np.array(way)

    def _sees(self, a: NDArray, b: NDArray) -> bool:
        free = self.grid.free
        if not line_of_sight(free.sdf, free.origin, free.cell_m, free.radius_m + SPARE_M, a[0], a[1], b[0], b[1]):
            return False
        return not len(self.discs) or bool(
            (distance_to_way(self.discs[:, :2], np.stack([a, b])) >= self.discs[:, 2]).all()
        )


def distance_to_way(points: NDArray, way: NDArray) -> NDArray[np.float64]:
    """Distance [...] [m] of points [..., 2] to a line through floor points [N, 2]; infinite where there is none."""
    points = np.asarray(points, np.float64)
    if len(way) == 0:
        return np.full(points.shape[:-1], np.inf)
    least = np.hypot(*np.moveaxis(points - way[0], -1, 0))
    for a, b in pairwise(way):
        leg = b - a
        along = np.clip(((points - a) @ leg) / max(float(leg @ leg), 1e-12), 0.0, 1.0)
        least = np.minimum(least, np.hypot(*np.moveaxis(points - a - along[..., None] * leg, -1, 0)))
    return least


def first_of_way(way: NDArray, length: float) -> NDArray[np.float64]:
    """The beginning of a way [N, 2], so long [m]."""
    if len(way) < 2:
        return way
    legs = np.hypot(*np.diff(way, axis=0).T)
    done = np.concatenate([[0.0], np.cumsum(legs)])
    if done[-1] <= length:
        return way
    k = max(int(np.searchsorted(done, length)) - 1, 0)
    share = (length - done[k]) / max(legs[k], 1e-12)
    return np.vstack([way[: k + 1], way[k] + share * (way[k + 1] - way[k])])
