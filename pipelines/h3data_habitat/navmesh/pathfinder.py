"""Habitat's PathFinder, name for name, over a `FreeSpace` or a `NavMesh`: points (x, y, z) in, points out.

Semantics are habitat-sim's (spec/habitat.md 1.3 and 6.7); paths are shortest where Habitat's are the taut string
through the polygons that A* chose. Deliberate differences are listed in h3data docs navigation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.scene.freespace.free_space import FreeSpace
from h3data_habitat.navmesh._surface import REACH_M, Surface, height, island_map, navigable, nearest, try_step, wall
from h3data_habitat.navmesh._surface_build import build_surface, with_graph
from h3data_habitat.navmesh._surface_paths import way
from h3data_habitat.navmesh.navmesh import NavMesh, NavMeshSettings, navmesh_from_free_space

ENDS_TOUCH_M = 0.01
"""Largest distance of points on the surface from the polygons of a `FreeSpace` [m], as one is float32 and the other float64."""
PIXELS_MAX = 1 << 26
"""Largest number of pixels of a top-down map."""
_ANY = -1


@dataclass(kw_only=True)
class ShortestPath:
    """Query of a path and, after `PathFinder.find_path`, its result. Fields can be set one by one, as in habitat-sim."""

    requested_start: ArrayLike = field(default_factory=lambda: np.zeros(3))
    requested_end: ArrayLike = field(default_factory=lambda: np.zeros(3))
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """Waypoints [k, 3] from start to end, as projected; none if there is no path."""
    geodesic_distance: float = np.inf
    """Length of the path [m]; inf if there is none."""


@dataclass(kw_only=True)
class MultiGoalShortestPath:
    """Path to the nearest of several ends."""

    requested_start: ArrayLike = field(default_factory=lambda: np.zeros(3))
    requested_ends: ArrayLike = field(default_factory=lambda: np.zeros((0, 3)))
    """Possible ends of the path, shape [k, 3]; ends without a path are passed over."""
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    geodesic_distance: float = np.inf
    closest_end_point_index: int = -1
    """Index of the end that the path leads to; -1 if there is none."""


@dataclass(frozen=True, kw_only=True)
class HitRecord:
    """The wall nearest to a point."""

    hit_pos: NDArray[np.float64]
    """Point of the wall [3]; NaN if none is in reach."""
    hit_normal: NDArray[np.float64]
    """Unit vector [3] on the floor from the wall to the point; NaN if none, or if the point lies on the wall."""
    hit_dist: float
    """Distance on the floor [m]; the search radius if none is in reach, inf if the point is not near the navmesh."""


class PathFinder:
    """Path queries on one navmesh, all floors. Immutable; safe to share between threads."""

    def __init__(self, source: FreeSpace | NavMesh) -> None:
        self.free_space = source if isinstance(source, FreeSpace) and not len(source.heights) else None
        """Set if made from one that is level: shortest paths are then its own. On stairs they are strings in space."""
        self.navmesh: NavMesh = source if isinstance(source, NavMesh) else navmesh_from_free_space(source, merge=False)
        if not self.navmesh.enabled.any():
            raise InputError("The navmesh has no polygon that can be walked on.", code="H3-HABITAT-095")
        self._surface = build_surface(self.navmesh)

    @property
    def surface(self) -> Surface:
        """Polygons as flat arrays, for kernels (`h3data_habitat.navmesh._surface`)."""
        return self._surface

    @cached_property
    def _graph(self) -> Surface:
        return with_graph(self._surface)

    # --- shortest paths -------------------------------------------------------------------------------------------------
    def find_path(self, path: ShortestPath | MultiGoalShortestPath) -> bool:
        """Fill ``points`` and ``geodesic_distance`` of the path; return False if there is none."""
        several = isinstance(path, MultiGoalShortestPath)
        ends = _points(path.requested_ends) if several else _point(path.requested_end)[None]
        found = self._paths(path.requested_start, ends)
        # `argmin` of infinities is the first, which is then not reached
        best = int(np.argmin([length for length, _ in found])) if found else -1
        reached = best >= 0 and bool(np.isfinite(found[best][0]))
        path.geodesic_distance, path.points = found[best] if reached else (np.inf, np.zeros((0, 3)))
        if several:
            path.closest_end_point_index = best if reached else -1
        return reached

    def path(self, start: ArrayLike, end: ArrayLike) -> NDArray[np.float64]:
        """Return waypoints [k, 3] of the shortest path from start [3] to end [3], both as projected; k = 0 if none."""
        return self._paths(start, _point(end)[None])[0][1]

    def geodesic_distance(self, start: ArrayLike, end: ArrayLike) -> float:
        """Return the length [m] of the shortest path from start [3] to end [3], or to the nearest of ends [k, 3].

        The length is infinite if there is no path.
        """
        ends = np.asarray(end, np.float64)
        # the usual question, one end on a level floor, needs no polygons
        if self.free_space is not None and ends.ndim == 1:
            length = self._over_free_floor(_point(start), _point(ends))
            if length is not None:
                return length
        found = self._paths(start, _points(ends) if ends.ndim == 2 else _point(ends)[None])
        return min((length for length, _ in found), default=np.inf)

    def _over_free_floor(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> float | None:
        """Return the distance if both points project vertically to the `FreeSpace`, without a search for polygons."""
        assert self.free_space is not None
        y = self.free_space.floor_y
        if abs(a[1] - y) > REACH_M[1] or abs(b[1] - y) > REACH_M[1]:
            return None
        length = float(self.free_space.geodesic(a[::2], b[::2], max_snap_m=0.0))
        return length if length < np.inf else None

    def _paths(self, start: ArrayLike, ends: NDArray[np.float64]) -> list[tuple[float, NDArray[np.float64]]]:
        """Return the length and waypoints to each end."""
        a = _point(start)
        if self.free_space is None:
            return [way(self._graph, a, end) for end in ends]
        p = self._nearest(a)[1:]
        return [self._flat_path(p, self._nearest(end)[1:]) for end in ends]

    def _flat_path(self, p: tuple[float, ...], q: tuple[float, ...]) -> tuple[float, NDArray[np.float64]]:
        """Return length and waypoints over the `FreeSpace` between points of its surface, NaN where there is none."""
        assert self.free_space is not None
        flat = self.free_space.path(p[::2], q[::2], max_snap_m=ENDS_TOUCH_M)
        points = np.stack([flat[:, 0], np.full(len(flat), self.free_space.floor_y), flat[:, 1]], axis=1)
        length = float(np.linalg.norm(np.diff(flat, axis=0), axis=1).sum()) if len(flat) else np.inf
        return length, points

    # --- where one may be -----------------------------------------------------------------------------------------------
    def snap_point(self, point: ArrayLike, island_index: int = _ANY) -> NDArray[np.float64]:
        """Return the nearest point [3] of the navmesh (or of one island), NaN if no polygon is within (2, 4, 2) m."""
        return np.array(self._nearest(point, self._island(island_index))[1:])

    def is_navigable(self, point: ArrayLike, max_y_delta: float = 0.5) -> bool:
        """Return whether the navmesh is within 1 cm beside and ``max_y_delta`` [m] above or below a point [3]."""
        x, y, z = _point(point)
        return navigable(self._surface, x, y, z, float(max_y_delta)) >= 0

    def get_random_navigable_point(
        self, rng: np.random.Generator, *, island_index: int = _ANY, n: int | None = None
    ) -> NDArray[np.float64]:
        """Return a random point [3], uniform by area, or n points [n, 3]; each point consumes 3 random numbers."""
        triangles, summed = self._sampling(self._island(island_index))
        u = rng.random((1 if n is None else n, 3))
        # clipped, because rounding may put a number beyond the last sum
        chosen = triangles[np.searchsorted(summed, u[:, 0] * summed[-1], side="right").clip(0, len(triangles) - 1)]
        root = np.sqrt(u[:, 1])  # uniform on a triangle: Osada et al., Shape Distributions (2002), eq. 1
        weights = np.stack([1 - root, root * (1 - u[:, 2]), root * u[:, 2]], axis=-1)
        points = np.einsum("nk,nkd->nd", weights, chosen)
        return points[0] if n is None else points

    def get_random_navigable_point_near(
        self,
        rng: np.random.Generator,
        circle_center: ArrayLike,
        radius: float,
        *,
        max_tries: int = 100,
        island_index: int = _ANY,
    ) -> NDArray[np.float64]:
        """Return a random point [3] on the floor within ``radius`` [m] of a point, uniform there.

        The point is NaN if no try fell into this radius.
        """
        centre = _point(circle_center)
        points = self.get_random_navigable_point(rng, island_index=island_index, n=max_tries)
        # all tries at once: as many random numbers whichever of them fits
        hit = np.flatnonzero(np.linalg.norm(points - centre, axis=1) <= radius)
        return points[hit[0]] if len(hit) else np.full(3, np.nan)

    # --- steps ----------------------------------------------------------------------------------------------------------
    def try_step(self, start: ArrayLike, end: ArrayLike) -> NDArray[np.float64]:
        """Return the end [3] of a step from start [3] towards end [3] that slides along walls.

        The result is start if start or end is off the navmesh.
        """
        return np.array(try_step(self._surface, *_point(start), *_point(end), True))

    def try_step_no_sliding(self, start: ArrayLike, end: ArrayLike) -> NDArray[np.float64]:
        """Return the end [3] of a step from start [3] towards end [3] that stops at the first wall."""
        return np.array(try_step(self._surface, *_point(start), *_point(end), False))

    # --- walls ----------------------------------------------------------------------------------------------------------
    def closest_obstacle_surface_point(self, point: ArrayLike, max_search_radius: float = 2.0) -> HitRecord:
        """Return the border of the navmesh nearest to a point [3], as reached along the floor."""
        polygon, x, _, z = self._nearest(point)
        nothing = np.full(3, np.nan)
        if polygon < 0:
            return HitRecord(hit_pos=nothing, hit_normal=nothing, hit_dist=np.inf)
        distance, hit = wall(self._surface, polygon, x, z, float(max_search_radius))
        away = np.array([x - hit[0], 0.0, z - hit[2]])
        length = np.hypot(away[0], away[2])
        normal = away / length if length > 0 else nothing
        return HitRecord(hit_pos=hit, hit_normal=normal, hit_dist=float(distance))

    def distance_to_closest_obstacle(self, point: ArrayLike, max_search_radius: float = 2.0) -> float:
        """Return the distance [m] on the floor from a point [3] to the border of the navmesh, at most ``max_search_radius``."""
        return self.closest_obstacle_surface_point(point, max_search_radius).hit_dist

    # --- islands, areas, maps -------------------------------------------------------------------------------------------
    @property
    def nav_mesh_settings(self) -> NavMeshSettings:
        """Settings that the navmesh was baked with."""
        return self.navmesh.settings

    @property
    def navigable_area(self) -> float:
        """Area of all islands [m2]."""
        return self.navmesh.area_m2

    @property
    def num_islands(self) -> int:
        """Number of islands, between which there are no paths."""
        return len(self.navmesh.island_areas)

    def island_area(self, island_index: int = _ANY) -> float:
        """Return the area of an island [m2], or of all islands for -1."""
        k = self._island(island_index)
        return self.navigable_area if k < 0 else float(self.navmesh.island_areas[k])

    def get_island(self, point: ArrayLike) -> int:
        """Return the island of the polygon nearest to a point [3], -1 if there is none near."""
        polygon = self._nearest(point)[0]
        return int(self._surface.island[polygon]) if polygon >= 0 else -1

    def island_radius(self, point: ArrayLike | int) -> float:
        """Return the largest distance [m] of a corner of an island from the mean of its corners, by point [3] or index.

        The distance is 0 if there is no such island.

        Corners count once per polygon that they belong to, as in habitat-sim.
        """
        index = (
            self._island(int(point)) if isinstance(point, int | np.integer) else self.get_island(cast(ArrayLike, point))
        )
        # by corner of a polygon, so that a vertex of three polygons counts three times
        own = np.repeat(self._surface.island == index, np.diff(self._surface.start))
        if not own.any():
            return 0.0
        corners = self._surface.corner[own]
        return float(np.linalg.norm(corners - corners.mean(0), axis=1).max())

    def get_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lower and upper corner [3] of the baked volume, as stated in the file."""
        low, high = self.navmesh.bounds.astype(np.float64)
        return low, high

    def get_topdown_view(self, meters_per_pixel: float, height: float, eps: float = 0.5) -> NDArray[np.bool_]:
        """Return which points at a height are navigable, bool [rows along z, columns along x] from the lower bounds."""
        return self.get_topdown_island_view(meters_per_pixel, height, eps) >= 0

    def get_topdown_island_view(self, meters_per_pixel: float, height: float, eps: float = 0.5) -> NDArray[np.int32]:
        """Return the island at each point of a height, int32 [rows along z, columns along x], -1 where there is none."""
        low, high = self.get_bounds()
        if not meters_per_pixel > 0:
            raise InputError(f"meters_per_pixel must be positive, got {meters_per_pixel}.", code="H3-HABITAT-096")
        rows, columns = ((high - low)[[2, 0]] / meters_per_pixel).astype(np.int64)
        if rows * columns > PIXELS_MAX:
            raise InputError(
                f"A map of {columns} x {rows} pixels is too large. Hint: more meters_per_pixel.", code="H3-HABITAT-097"
            )
        out = np.empty((rows, columns), np.int32)
        island_map(self._surface, low[0], low[2], float(meters_per_pixel), float(height), float(eps), out)
        return out

    def get_height(self, point: ArrayLike) -> float:
        """Return the height of the floor [m] nearest to a point [3]; NaN off the navmesh."""
        polygon, x, _, z = self._nearest(point)
        return float(height(self._surface, polygon, x, z)) if polygon >= 0 else float("nan")

    def _nearest(self, point: ArrayLike, island: int = _ANY) -> tuple[int, float, float, float]:
        x, y, z = _point(point)
        return nearest(self._surface, x, y, z, island)

    def _island(self, index: int) -> int:
        if not -1 <= index < self.num_islands:
            raise InputError(
                f"There is no island {index}. This navmesh has {self.num_islands}, from 0; -1 means all.",
                code="H3-HABITAT-098",
            )
        return index

    def _sampling(self, island: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return triangles [M, 3, 3] to sample from and their summed areas [M]."""
        known = self._sampling_cache
        if island not in known:
            t = self.navmesh.triangles(island=None if island < 0 else island).astype(np.float64)
            area = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1) / 2
            known[island] = t, np.cumsum(area)
        return known[island]

    @cached_property
    def _sampling_cache(self) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        return {}

    def __repr__(self) -> str:
        source = "FreeSpace" if self.free_space is not None else "NavMesh"
        return f"PathFinder({source}, {self.num_islands} islands, {self.navigable_area:.2f} m2)"


def _point(point: ArrayLike) -> NDArray[np.float64]:
    p = np.ascontiguousarray(point, np.float64)
    if p.shape != (3,):
        raise InputError(f"Expected one point (x, y, z), shape [3], got {list(p.shape)}.", code="H3-HABITAT-093")
    return p


def _points(points: ArrayLike) -> NDArray[np.float64]:
    p = np.asarray(points, np.float64)
    p = p.reshape(0, 3) if p.size == 0 else p
    if p.ndim != 2 or p.shape[1] != 3:
        raise InputError(f"Expected points (x, y, z), shape [k, 3], got {list(p.shape)}.", code="H3-HABITAT-094")
    return p
