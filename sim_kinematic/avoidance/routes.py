"""Paths on the floor around agents that stand there, and to places off other agents' paths.

Dijkstra's algorithm (1959) over a grid of the free floor, which stops at obstacles and at discs. It runs only when agents are
in each other's way: the shortest paths of `FreeSpace` know of no agents.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace.free_space import line_of_sight
from sim_kinematic.avoidance.spec import AVOIDANCE

NOWHERE = np.full(2, np.nan)


@kernel(error_model="numpy")
def _flood(room, least, discs, origin, cell, si, sj, goal, near, farthest):
    """Return grid distances [nx, nz] [m] from cell (si, sj), infinite without a path, and each cell's predecessor.

    It ends where distances exceed ``farthest`` [m], and where no other cell can be on the shortest path to within ``near`` of
    ``goal`` [2], if that is finite; all distances up to there are final. If no cell there is free, it does not begin.
    """
    nx, nz = room.shape
    shut = room < least
    for d in range(len(discs)):
        x, z, radius = discs[d, 0], discs[d, 1], discs[d, 2]
        first, last = (x - radius - origin[0]) / cell - 1.0, (x + radius - origin[0]) / cell + 1.0
        for a in range(max(int(first), 0), min(int(last) + 1, nx)):
            for b in range(max(int((z - radius - origin[1]) / cell - 1.0), 0), nz):
                at_z = origin[1] + (b + 0.5) * cell
                if at_z > z + radius + cell:
                    break
                shut[a, b] |= math.hypot(x - (origin[0] + (a + 0.5) * cell), z - at_z) < radius
    distance = np.full((nx, nz), np.inf)
    before = np.full((nx, nz), -1, np.int64)
    distance[si, sj] = 0.0
    heap = [(0.0, si * nz + sj)]
    # somebody who stands at the goal shuts all cells there, and a search for it would cover the whole home
    is_open = math.isnan(goal[0])
    # margin for rounding errors within which `_flood` goes on, although it is where it has to get [m]
    rounding_m = 1e-6
    for a in range(nx if not is_open else 0):
        for b in range(nz if abs(origin[0] + (a + 0.5) * cell - goal[0]) < near + cell else 0):
            gap = math.hypot(origin[0] + (a + 0.5) * cell - goal[0], origin[1] + (b + 0.5) * cell - goal[1])
            is_open |= gap <= near + rounding_m and (not shut[a, b] or (a == si and b == sj))
    while is_open and len(heap) > 0:
        far, at = heapq.heappop(heap)
        if far > farthest:
            break
        i, j = at // nz, at % nz
        # an entry from before a shorter path was found: heapq cannot change an entry, so outdated ones stay in
        # the heap
        if far > distance[i, j]:
            continue
        gap = math.hypot(origin[0] + (i + 0.5) * cell - goal[0], origin[1] + (j + 0.5) * cell - goal[1])
        if gap <= near - rounding_m:
            farthest = min(farthest, far + gap + rounding_m)
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a, b = i + di, j + dj
                if (di == 0 and dj == 0) or a < 0 or b < 0 or a >= nx or b >= nz or shut[a, b]:
                    continue
                new = far + cell * math.sqrt(di * di + dj * dj)
                if new < distance[a, b]:
                    distance[a, b] = new
                    before[a, b] = at
                    heapq.heappush(heap, (new, a * nz + b))
    return distance, before


@kernel(error_model="numpy")
def _last_seen(sdf, origin, cell, room, discs, points, k):
    """Return the number of the last of some points [N, 2] with a free line from point ``k``; k + 1 if there is none."""
    leg = np.empty((2, 2))
    leg[0] = points[k]
    for n in range(len(points) - 1, k + 1, -1):
        if line_of_sight(sdf, origin, cell, room, points[k, 0], points[k, 1], points[n, 0], points[n, 1]):
            # it knows the obstacles only, so discs are measured here
            leg[1] = points[n]
            if (_distances(discs[:, :2], leg) >= discs[:, 2]).all():
                return n
    return k + 1


@dataclass(frozen=True, eq=False)
class FloorRoutes:
    """Grid of the floor of one home, on which routes are searched."""

    free: FreeSpace
    origin: NDArray[np.float64]
    """Lower corner ``(x, z)`` of cell [0, 0] [m]."""
    centres: NDArray[np.float64]
    """Centre of each cell, [nx, nz, 2] [m]."""
    room: NDArray[np.float64]
    """Distance from each cell's centre to the nearest obstacle, [nx, nz] [m]."""

    @staticmethod
    @lru_cache(maxsize=16)
    def of(free: FreeSpace) -> FloorRoutes:
        """Return the grid of a home, which is computed once."""
        cell = AVOIDANCE.cell_m
        count = np.ceil(np.array(free.sdf.shape) * free.cell_m / cell).astype(int)
        axes = [free.origin[k] + (np.arange(count[k]) + 0.5) * cell for k in (0, 1)]
        centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        return FloorRoutes(free, np.asarray(free.origin, np.float64), centres, free.signed_distance(centres))

    def flood(
        self, start: NDArray, discs: NDArray, *, goal: NDArray = NOWHERE, farthest_m: float = math.inf
    ) -> DistanceMap:
        """Return distances and shortest paths from ``start`` [2] to all of the floor outside of some discs.

        The discs are ``(x, z, radius)`` [N, 3]; a path may lead out of discs that contain the start. With a ``goal``
        [2] or a distance ``farthest_m`` [m], the map is computed only as far as these need.
        """
        cell = AVOIDANCE.cell_m
        discs = np.array(discs, np.float64).reshape(-1, 3)
        gaps = np.hypot(*(discs[:, :2] - start).T)
        # an agent inside a disc would have no path at all; a smaller disc lets it move away from the centre only
        discs[:, 2] = np.minimum(discs[:, 2], gaps - AVOIDANCE.leaves_m)
        i, j = np.clip(((start - self.origin) / cell).astype(int), 0, np.array(self.room.shape) - 1).tolist()
        least = self.free.radius_m + AVOIDANCE.spare_m
        goal = np.asarray(goal, np.float64)
        distance, before = _flood(
            self.room, least, discs, self.origin, cell, i, j, goal, AVOIDANCE.near_m, float(farthest_m)
        )
        return DistanceMap(self, np.array(start, np.float64), discs, distance, before)


@dataclass(frozen=True, eq=False)
class DistanceMap:
    """Shortest paths from one place to all cells of a grid."""

    grid: FloorRoutes
    start: NDArray[np.float64]
    discs: NDArray[np.float64]
    distance: NDArray[np.float64]
    """Length of the path to each cell, [nx, nz] [m]."""
    before: NDArray[np.int64]
    """Flat index of the cell before each cell on its path, -1 for the first, [nx, nz]."""

    def path_to(self, goal: NDArray) -> NDArray[np.float64] | None:
        """Return floor points [N, 2] from the start to ``goal`` [2] with free straight legs; None if there is no path."""
        # cells near the goal are few: distances to all of them took longer than the search
        i, j = (max(int((goal[k] - self.grid.origin[k]) / AVOIDANCE.cell_m) - 3, 0) for k in (0, 1))
        part = slice(i, i + 7), slice(j, j + 7)
        gap = np.hypot(*(self.grid.centres[part] - goal).transpose(2, 0, 1))
        near = np.where(gap <= AVOIDANCE.near_m, self.distance[part] + gap, np.inf)
        if not np.isfinite(near).any():
            return None
        a, b = np.unravel_index(near.argmin(), near.shape)
        return self._path(int((i + a) * self.distance.shape[1] + j + b), goal)

    def reaches(self, places: NDArray) -> NDArray[np.bool_]:
        """Return whether `path_to` finds a path to each of some floor points [N, 2], as bool [N]."""
        # imported here: few episodes ask for this, and it would make every start slower
        from scipy.spatial import KDTree

        open_cells = self.grid.centres[np.isfinite(self.distance)]
        return KDTree(open_cells).query(places)[0] <= AVOIDANCE.near_m

    def path_to_nearest(self, fits: NDArray[np.bool_]) -> NDArray[np.float64] | None:
        """Return the path [N, 2] [m] to the nearest of the cells [nx, nz] that fit; None if there is none."""
        lengths = np.where(fits, self.distance, np.inf)
        # the nearest along the floor, not through walls
        best = int(lengths.argmin())
        return self._path(best, self.grid.centres.reshape(-1, 2)[best]) if np.isfinite(lengths.flat[best]) else None

    def _path(self, cell: int, goal: NDArray) -> NDArray[np.float64]:
        """Return the path [N, 2] to a cell, by its flat index, with ``goal`` in place of its centre, and straightened."""
        cells, before = [cell], self.before.ravel()
        while before.item(cells[-1]) >= 0:
            cells.append(before.item(cells[-1]))
        centres, free = self.grid.centres.reshape(-1, 2)[cells[-2:0:-1]], self.grid.free
        points = np.vstack([self.start, centres, np.asarray(goal, np.float64)])
        path, k, room = [points[0]], 0, free.radius_m + AVOIDANCE.spare_m
        # a path over cells knows eight directions only, and would lead in zigzags across an open room
        while k < len(points) - 1:
            ahead = _last_seen(free.sdf, free.origin, free.cell_m, room, self.discs, points, k)
            # where a cell's corner is cut, the exact shortest path goes around it
            leg = free.path(points[k], points[ahead], max_snap_m=1.0)
            path += list(leg[1:]) if len(leg) else [points[ahead]]
            k = ahead
        return np.array(path)


def distance_to_path(points: NDArray, path: NDArray) -> NDArray[np.float64]:
    """Return distances [...] [m] of points [..., 2] to the line through points [N, 2]; infinite if it is empty."""
    points = np.asarray(points, np.float64)
    if len(path) == 0:
        return np.full(points.shape[:-1], np.inf)
    flat = np.ascontiguousarray(points.reshape(-1, 2)), np.ascontiguousarray(path, np.float64)
    return _distances(*flat).reshape(points.shape[:-1])


@kernel(error_model="numpy")
def _distances(points, path):
    """Return distances [P] of points [P, 2] to the line through floor points [N, 2]."""
    least = np.empty(len(points))
    for p in range(len(points)):
        x, z = points[p]
        least[p] = math.hypot(x - path[0, 0], z - path[0, 1])
        for k in range(len(path) - 1):
            a_x, a_z = path[k]
            leg_x, leg_z = path[k + 1, 0] - a_x, path[k + 1, 1] - a_z
            # a leg may have no length: any share of it is the same place, but it must be a number
            along = ((x - a_x) * leg_x + (z - a_z) * leg_z) / max(leg_x * leg_x + leg_z * leg_z, 1e-12)
            along = min(max(along, 0.0), 1.0)
            least[p] = min(least[p], math.hypot(x - a_x - along * leg_x, z - a_z - along * leg_z))
    return least


@kernel(error_model="numpy")
def _distance_to_part(x, z, path, begin, end):
    """Return the distance of (x, z) to a path [N, 2] between two of its lengths.

    If the path is shorter than ``begin``, this is the distance to its end.
    """
    done, least, last = 0.0, math.inf, len(path) - 1
    for k in range(last):
        leg_x, leg_z = path[k + 1, 0] - path[k, 0], path[k + 1, 1] - path[k, 1]
        length = math.hypot(leg_x, leg_z)
        first, most = max((begin - done) / max(length, 1e-12), 0.0), min((end - done) / max(length, 1e-12), 1.0)
        if most < 0.0:
            break
        if first <= 1.0:
            along = ((x - path[k, 0]) * leg_x + (z - path[k, 1]) * leg_z) / max(length * length, 1e-12)
            along = min(max(along, first), most)
            least = min(least, math.hypot(x - path[k, 0] - along * leg_x, z - path[k, 1] - along * leg_z))
        done += length
    return least if least < math.inf or last < 0 else math.hypot(x - path[last, 0], z - path[last, 1])


@kernel(error_model="numpy")
def is_ahead(points, path, begin, end, within, x, z):
    """Return whether one of the points [P, 2] is near a path [N, 2] between two of its lengths [m], but not beside (x, z).

    A point is near the path if it is ``within`` a distance [m] of it, and beside (x, z) if it is nearer to (x, z) than
    to the path.
    """
    for p in range(len(points)):
        gap = _distance_to_part(points[p, 0], points[p, 1], path, begin, end)
        if gap < within and gap < math.hypot(points[p, 0] - x, points[p, 1] - z):
            return True
    return False


@kernel(error_model="numpy")
def distance_of_paths(x, z, mine, length, other, other_length, apart):
    """Return the distance [m] between the first parts, of given lengths [m], of two paths [N, 2] and [M, 2].

    The first path, that of an agent at (x, z), is sampled by points on its legs that are at most ``apart`` [m] from
    each other.
    """
    least, done = _distance_to_part(x, z, other, 0.0, other_length), 0.0
    for k in range(len(mine) - 1):
        a_x, a_z = mine[k, 0], mine[k, 1]
        leg_x, leg_z = mine[k + 1, 0] - a_x, mine[k + 1, 1] - a_z
        leg = math.hypot(leg_x, leg_z)
        share = min((length - done) / max(leg, 1e-12), 1.0)
        if share < 0.0:
            break
        count = 1 + int(share * leg / apart)
        for n in range(count + 1):
            at = share * n / count
            least = min(least, _distance_to_part(a_x + at * leg_x, a_z + at * leg_z, other, 0.0, other_length))
        done += leg
    return least


def first_of_path(path: NDArray, length_m: float) -> NDArray[np.float64]:
    """Return the first part of a path [N, 2] up to a length [m]."""
    k, share = _leg_at(np.ascontiguousarray(path, np.float64), length_m) if len(path) > 1 else (-1, 0.0)
    return path if k < 0 else np.vstack([path[: k + 1], path[k] + share * (path[k + 1] - path[k])])


@kernel(error_model="numpy")
def _leg_at(path, length):
    """Return the number of the leg of a path [N, 2] on which a length [m] ends, and the share of it.

    The number is -1 if the path is not that long.
    """
    done, end, last, share = 0.0, -1, 0.0, 0.0
    for k in range(len(path) - 1):
        leg = math.hypot(path[k + 1, 0] - path[k, 0], path[k + 1, 1] - path[k, 1])
        if end < 0 and (k == 0 or done < length):
            last, share = k, (length - done) / max(leg, 1e-12)
        elif end < 0:
            end = last
        done += leg
    return (-1, 0.0) if done <= length else (int(last), share)
