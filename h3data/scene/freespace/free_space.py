"""Free space of a round agent on one floor: exact polygons, distances to obstacles, and shortest paths.

Navigation, step kernels, rewards and metrics all use this object. Step kernels read the plain arrays ``sdf``,
``origin`` and ``cell_m`` by the kernels `sample_sdf`, `sdf_gradient` and `line_of_sight`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import Array, ground_pose, sloped_pose
from h3data.kernels.entries import Entries
from h3data.scene.floor_heights import STEPS, floor_heights
from h3data.scene.freespace import store
from h3data.scene.freespace._distance_field import corner_distances, field_many
from h3data.scene.freespace._geodesic import first_leg, geodesic_many, path_pair
from h3data.scene.freespace._lattice import Lattice, build_lattice, lattice_step, quick_distance_many
from h3data.scene.freespace._points import SNAP_M, each_pair, each_point, floor_points, one_point
from h3data.scene.freespace._sdf import (
    line_of_sight,
    sample_sdf,
    sample_sdf_many,
    sdf_gradient,
    sdf_gradient_many,
    trace_rays,
)
from h3data.scene.freespace._visibility import Graph, locate_many, snap_many
from h3data.scene.freespace.build import FloorMap, build_from_scene, scene_key, without_stairs
from h3data.scene.records import Scene

__all__ = ["FreeSpace", "line_of_sight", "sample_sdf", "sdf_gradient"]


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeSpace(FloorMap):
    """Free space of one floor for a disc of one radius, with floor points (x, z) in the world [m]."""

    @classmethod
    def from_map(cls, floor: FloorMap, lattice: Lattice | None = None) -> FreeSpace:
        """Return the free space with the geometry of ``floor``, and its lattice if it is known."""
        space = cls(**{one.name: getattr(floor, one.name) for one in fields(FloorMap)})
        if lattice is not None:
            # where `cached_property` keeps it, so that it is not built again
            space.__dict__["lattice"] = lattice
        return space

    @classmethod
    def from_scene(
        cls,
        scene: Scene,
        *,
        radius_m: float = 0.25,
        height_m: float = 1.41,
        max_climb_m: float = 0.2,
        cell_m: float = 0.05,
        floor_y: float | None = None,
        method: Literal["auto", "shapes", "mesh"] = "auto",
        cache: bool = True,
    ) -> FreeSpace:
        """Return the free space of one floor of a scene.

        Static instances are obstacles, kinematic ones are not (as in Habitat).

        Args:
            scene: The scene; only its geometry is read.
            radius_m: Radius of the agent [m]; the default is Spot's, and the humanoid uses the same (spec/habitat.md).
            height_m: Headroom that the agent needs [m].
            max_climb_m: Largest height of steps and objects over which the agent can walk [m].
            cell_m: Side of a cell of the distance grid [m].
            floor_y: Height of the floor [m]; None for the floor with the largest area, or all storeys if stairs join
                them.
            method: ``shapes`` is exact and needs collision shapes and rooms, ``mesh`` finds the floor among triangles
                by voxels of 2.5 cm, ``auto`` uses ``shapes`` if possible.
            cache: True if a result on disk may be used and stored (see `h3data.scene.freespace.store`).
        """
        sizes = {"radius_m": radius_m, "height_m": height_m, "max_climb_m": max_climb_m, "cell_m": cell_m}

        def build() -> FloorMap:
            return build_from_scene(scene, **sizes, floor_y=floor_y, method=method)

        if not cache:
            return cls.from_map(build())
        return cls.from_map(*store.cached(scene_key(scene, **sizes, floor_y=floor_y, method=method), build))

    def as_in(self, scene: Scene, *, radius_m: float | None = None) -> FreeSpace:
        """Return the free space for the same agent, or another radius, in the same home with doors in another state."""
        return FreeSpace.from_scene(
            scene,
            radius_m=self.radius_m if radius_m is None else radius_m,
            height_m=self.height_m,
            max_climb_m=self.max_climb_m,
            cell_m=self.cell_m,
            floor_y=None if len(self.heights) else self.floor_y,
        )

    @classmethod
    def load(cls, path: str | Path) -> FreeSpace:
        """Read a free space from a file that `save` has written."""
        return cls.from_map(*store.load(Path(path)))

    def save(self, path: str | Path) -> None:
        """Write one npz file (no pickle) atomically, with the lattice table if it was built."""
        store.save(self, Path(path), lattice=self.__dict__.get("lattice"))  # only if it was built

    # --- how high the floor is -----------------------------------------------------------------------------------------
    def height_at(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the height [...] [m] of the floor at points [..., 2].

        A flight of stairs counts as a ramp, so the height is continuous on all free floor.
        """
        return floor_heights(self.heights, self.floor_y, points)

    def treads_at(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the height [...] [m] of the surface under a foot at points [..., 2]: stairs have steps."""
        return floor_heights(self.heights, self.floor_y, points, treads=True)

    def root_pose(self, xz: ArrayLike, heading_rad: ArrayLike, *, pitch_over_m: float = 0.0) -> Array:
        """Return poses (pose7) [..., 7] of agent roots on the floor at points [..., 2] with headings [...].

        With ``pitch_over_m`` [m], roots pitch with the floor under both ends of a base of that length, at their mean
        height. Otherwise they stay upright.
        """
        if not len(self.heights):
            return ground_pose(xz, heading_rad, self.floor_y)
        return sloped_pose(self.height_at, xz, heading_rad, pitch_over_m)

    @cached_property
    def entries(self) -> Entries:
        """Compiled kernels bound to the arrays of this floor."""
        return Entries()

    @cached_property
    def has_stairs(self) -> bool:
        """Return whether stairs connect storeys of the floor."""
        return bool(self.heights[:, STEPS].any())

    @cached_property
    def without_stairs(self) -> FreeSpace:
        """Return the floor for agents that cannot climb: flights of stairs are obstacles, and each storey is an island.

        For a level floor, the object itself is returned.
        """
        return FreeSpace.from_map(without_stairs(self)) if self.has_stairs else self

    # --- distance to obstacles ------------------------------------------------------------------------------------------
    def signed_distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the distance [...] [m] of points [..., 2] to the nearest obstacle or border of the floor (bilinear)."""
        return each_point(lambda p: sample_sdf_many(self.sdf, self.origin, self.cell_m, p), points)

    def gradient(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the gradient [..., 2] of `signed_distance`, which points away from the nearest obstacle, length about 1."""
        return each_point(lambda p: sdf_gradient_many(self.sdf, self.origin, self.cell_m, p), points)

    def clearance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the distance [...] [m] of the agent's rim at points [..., 2] to the nearest obstacle.

        It is negative if they overlap.
        """
        return self.signed_distance(points) - self.radius_m

    def free_along(self, points: ArrayLike, headings: ArrayLike, *, max_m: float) -> NDArray[np.float64]:
        """Return the distance [..., R] [m] from points [..., 2] along headings [..., R] [rad] to an obstacle.

        It is at most ``max_m``, as an ideal planar laser scanner measures it. The outlines are those of the map, in
        which all obstacles of agents count as solid between ``max_climb_m`` and ``height_m``.
        """
        p, angles = floor_points(points), np.asarray(headings, np.float64)
        if angles.shape[:-1] != p.shape[:-1]:
            raise InputError(
                f"Expected headings [..., R] of points [..., 2], got shapes {list(angles.shape)} and {list(p.shape)}.",
                code="H3-SCENE-069",
            )
        rays = np.ascontiguousarray(angles.reshape(-1, angles.shape[-1]))
        grid = self.sdf, self.origin, self.cell_m
        return trace_rays(*grid, np.ascontiguousarray(p.reshape(-1, 2)), rays, float(max_m)).reshape(angles.shape)

    # --- where one may be -----------------------------------------------------------------------------------------------
    @property
    def island_areas(self) -> NDArray[np.float64]:
        """Area of each island [K] [m2], largest first."""
        return np.array([p.area for p in self.polygon.geoms])

    def is_navigable(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return whether the agent may stand at points [..., 2], bool [...]; exact to 0.1 mm."""
        return self.island(points) >= 0

    def island(self, points: ArrayLike) -> NDArray[np.int32]:
        """Return the index of the island of points [..., 2], int [...]; -1 where the agent may not stand."""
        return each_point(lambda p: self.entries(locate_many, self.graph, p), points)

    def snap(self, points: ArrayLike, *, max_distance_m: float = np.inf) -> NDArray[np.float64]:
        """Return the free points [..., 2] nearest to points [..., 2]; NaN where none is within ``max_distance_m``."""
        return each_point(lambda p: self.entries(snap_many, self.graph, p, float(max_distance_m)), points)

    def sample(self, rng: np.random.Generator, n: int, *, island: int = 0) -> NDArray[np.float64]:
        """Sample free points [n, 2] of one island uniformly; each call consumes 3 n random numbers."""
        triangles, cumulative = self._triangles(island)
        # which triangle, and two coordinates in it
        u = rng.random((n, 3))
        chosen = triangles[
            np.searchsorted(cumulative, u[:, 0] * cumulative[-1], side="right").clip(0, len(triangles) - 1)
        ]
        root = np.sqrt(u[:, 1])  # uniform on a triangle: Osada et al., Shape Distributions (2002), eq. 1
        weights = np.stack([1 - root, root * (1 - u[:, 2]), root * u[:, 2]], -1)
        return np.einsum("nk,nkd->nd", weights, chosen)

    # --- shortest paths -------------------------------------------------------------------------------------------------
    def geodesic(self, a: ArrayLike, b: ArrayLike, *, max_snap_m: float = SNAP_M) -> NDArray[np.float64]:
        """Return the length [...] [m] of the shortest path from a [..., 2] to b [..., 2], exact.

        The length is infinite where there is no path.

        Ends off the free area are moved to it first; if they are farther from it than ``max_snap_m``, there is no path.
        """
        return each_pair(lambda p, q: self.entries(geodesic_many, self.graph, p, q, float(max_snap_m)), a, b)

    def path(self, a: ArrayLike, b: ArrayLike, *, max_snap_m: float = SNAP_M) -> NDArray[np.float64]:
        """Return waypoints [k, 2] of the shortest path from a [2] to b [2], including both ends.

        If there is no path, k is 0.

        ``path[1]`` corresponds to Habitat's ``points[1]``, the point towards which its agents walk.
        """
        p, q = one_point(a), one_point(b)
        return self.entries(path_pair, self.graph, p[0], p[1], q[0], q[1], float(max_snap_m))

    def next_waypoint(
        self, a: ArrayLike, b: ArrayLike, *, beyond_m: float = 0.0, max_snap_m: float = SNAP_M
    ) -> NDArray[np.float64]:
        """Return the point [2] to walk to from a [2] on the shortest path to b [2]; NaN if there is no path.

        Waypoints nearer than ``beyond_m`` are skipped (an inflated corner is an arc of points 5 cm apart).
        """
        return self.first_leg(a, b, beyond_m=beyond_m, max_snap_m=max_snap_m)[1]

    def first_leg(
        self, a: ArrayLike, b: ArrayLike, *, beyond_m: float = 0.0, max_snap_m: float = SNAP_M
    ) -> tuple[float, NDArray[np.float64]]:
        """Return `geodesic` [m] and `next_waypoint` [2] of two points [2] by one search.

        Without a path, the results are infinity and NaN.
        """
        (ax, az), (bx, bz) = one_point(a).tolist(), one_point(b).tolist()
        length, x, z = self.entries(first_leg, self.graph, ax, az, bx, bz, float(max_snap_m), float(beyond_m))
        return length, np.array([x, z])

    def distance_field(self, goals: ArrayLike, *, max_snap_m: float = SNAP_M) -> DistanceField:
        """Return the field of exact distances from any point to one goal [2], or to the nearest of several goals [K, 2]."""
        moved = self.snap(goals, max_distance_m=max_snap_m).reshape(-1, 2)
        # goals out of reach are left out, because they were moved to NaN
        return DistanceField.to(self.graph, moved[np.isfinite(moved).all(-1)])

    def geodesic_lattice(self, a: ArrayLike, b: ArrayLike, *, max_snap_m: float = SNAP_M) -> NDArray[np.float64]:
        """Return the length [...] [m] of the shortest path by look-ups in a lattice, within about 0.1% (p95 below 1%).

        This is the reference for back ends that can gather but not search, such as GPUs; on a CPU `geodesic` is faster.
        The result is exact for straight paths and paths shorter than 3 m. The table is built at the first call.
        """
        table = (self.graph, self.sdf, self.origin, self.cell_m, self.radius_m, self.lattice)
        return each_pair(lambda p, q: quick_distance_many(*table, p, q, max_snap_m), a, b)

    @cached_property
    def lattice(self) -> Lattice:
        """Lattice (0.15 to 0.25 m) with all pairs of shortest distances, for `geodesic_lattice` and step kernels."""
        return build_lattice(self.graph, self.polygon.bounds, step=lattice_step(self.polygon.area))

    def _triangles(self, island: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return triangles [M, 3, 2] that make up an island, and their summed areas [M]."""
        known = self._triangle_cache
        if island not in known:
            if not 0 <= island < len(self.polygon.geoms):
                raise InputError(
                    f"There is no island {island}. This free space has {len(self.polygon.geoms)}, from 0.",
                    code="H3-SCENE-016",
                )
            parts = shapely.get_parts(shapely.constrained_delaunay_triangles(self.polygon.geoms[island]))
            # rings of triangles repeat their first corner
            t = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
            u, v = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
            known[island] = t, np.cumsum(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2)
        return known[island]

    @cached_property
    def _triangle_cache(self) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        return {}

    def __repr__(self) -> str:
        nx, nz = self.sdf.shape
        return (
            f"FreeSpace(radius {self.radius_m} m, floor {self.floor_y:.3f} m, {len(self.polygon.geoms)} islands, "
            f"{self.polygon.area:.2f} m2, grid {nx} x {nz}, {len(self.graph.nodes)} corners)"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceField:
    """Shortest-path distance from any floor point to the nearest of some fixed goals, without a grid.

    The distance equals `FreeSpace.geodesic` within 1e-5 m (float32 tables) and takes about half its time per point.
    `FreeSpace.distance_field` creates it.
    """

    graph: Graph
    goals: NDArray[np.float64]
    """Goals as moved to the free area, shape [K, 2] [m]."""
    corner: NDArray[np.float64] = field(repr=False)
    """Distance from every corner of the visibility graph, shape [n] [m]."""

    @classmethod
    def to(cls, graph: Graph, goals: NDArray[np.float64]) -> DistanceField:
        """Return the field of goals [K, 2] [m] on a free area; without goals, all distances are infinite."""
        goals = np.ascontiguousarray(goals, np.float64)
        return cls(graph=graph, goals=goals, corner=corner_distances(graph, goals))

    def distance(self, points: ArrayLike, *, max_snap_m: float = SNAP_M) -> NDArray[np.float64]:
        """Return the length [...] [m] of the shortest path from points [..., 2] to the nearest goal.

        Lengths are infinite where there is no path.
        """
        return self.distance_and_direction(points, max_snap_m=max_snap_m)[0]

    def direction(self, points: ArrayLike, *, max_snap_m: float = SNAP_M) -> NDArray[np.float64]:
        """Return the unit vector [..., 2] along the shortest path from points [..., 2]: minus the gradient of `distance`.

        The vector is NaN where there is no path, and zero at a goal. Points off the free area are moved to it first.
        """
        return self.distance_and_direction(points, max_snap_m=max_snap_m)[1]

    def distance_and_direction(
        self, points: ArrayLike, *, max_snap_m: float = SNAP_M
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return `distance` [...] [m] and `direction` [..., 2] together, in the time of one of them."""
        graph, corner, goals = self.graph, self.corner, self.goals
        both = each_point(lambda p: field_many(graph, corner, goals, p, max_snap_m), points)
        return both[..., 0], both[..., 1:]
