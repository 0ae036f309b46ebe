"""Navigation mesh of convex polygons in space that share edges, as baked by Recast, and its relation to `FreeSpace`."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from h3data.errors import InputError, SceneError
from h3data.scene.floor_heights import STEPS, flight_rectangle
from h3data.scene.freespace._sdf import sdf_from_edges
from h3data.scene.freespace._visibility_build import area_edges, build_graph, polygon_parts
from h3data.scene.freespace.free_space import FreeSpace
from h3data_habitat.navmesh.merging import CORNERS_MAX, merged_polygons, plain_outline

ZERO_AREA_M2 = 1e-5
"""Area below which Habitat disables polygons, as its queries would fail on them (spec/habitat.md 6.7) [m2]."""
DISABLED = 4
"""Bit of ``flags`` that marks polygons that cannot be walked on."""
SLIT_M = 3e-4
"""Half the width of walls without thickness, so that no path goes through [m]: more than the 0.1 mm that the blocking
edges of a `FreeSpace` lie outside its area."""
CELLS_MAX = 50_000_000
"""Largest number of cells of a distance grid (200 MB)."""


@dataclass(frozen=True, kw_only=True)
class NavMeshSettings:
    """Settings that a navmesh was baked with; the defaults are habitat-sim's (spec/habitat.md 6.7)."""

    cell_size: float = 0.05
    """Side of a voxel [m]."""
    cell_height: float = 0.2
    """Height of a voxel [m]; heights on the mesh are multiples of it."""
    agent_height: float = 1.5
    agent_radius: float = 0.1
    agent_max_climb: float = 0.2
    agent_max_slope: float = 45.0
    """Largest slope of ground that can be walked on [degrees]."""
    region_min_size: float = 20.0
    region_merge_size: float = 20.0
    edge_max_len: float = 12.0
    edge_max_error: float = 1.3
    verts_per_poly: float = 6.0
    detail_sample_dist: float = 6.0
    detail_sample_max_error: float = 1.0
    filter_low_hanging_obstacles: bool = True
    filter_ledge_spans: bool = True
    filter_walkable_low_height_spans: bool = True
    include_static_objects: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class NavMesh:
    """Places at which the centre of an agent may be: convex polygons, already shrunk by its radius, in world metres, y up.

    Polygon p has the corners ``polygon_start[p]:polygon_start[p + 1]``. Islands are numbered as Habitat does: by the first
    polygon of each.
    """

    settings: NavMeshSettings
    vertices: NDArray[np.float32]
    """Positions of the vertices, shape [V, 3] [m]."""
    polygon_start: NDArray[np.int32]
    """First corner of each polygon, shape [P + 1]."""
    polygon_vertices: NDArray[np.int32]
    """Index of the vertex at each corner, shape [S]."""
    polygon_neighbours: NDArray[np.int32]
    """Polygon beyond the edge from each corner to the next of its polygon, -1 at a wall, shape [S]."""
    areas: NDArray[np.uint8]
    """Area type of each polygon, shape [P]."""
    flags: NDArray[np.uint16]
    """Flags of each polygon: 1 walk, 2 door, 4 disabled, shape [P]."""
    detail_start: NDArray[np.int32]
    """First detail triangle of each polygon, shape [P + 1]: polygon p has ``detail_start[p]:detail_start[p + 1]``."""
    detail_triangles: NDArray[np.float32]
    """Triangles of the same ground with finer heights, shape [T, 3, 3] [m]."""
    bounds: NDArray[np.float32]
    """Lower and upper corner of the baked volume, shape [2, 3] [m]."""

    @cached_property
    def enabled(self) -> NDArray[np.bool_]:
        """Return which polygons can be walked on [P]: those of some area that are not disabled."""
        return ((self.flags & DISABLED) == 0) & (self.polygon_areas >= ZERO_AREA_M2)

    @cached_property
    def polygon_areas(self) -> NDArray[np.float64]:
        """Area of each polygon's detail triangles in space [P] [m2]."""
        t = self.detail_triangles.astype(np.float64)
        area = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1) / 2
        # differences of running sums, because `reduceat` gives polygons without triangles the area of the next
        summed = np.concatenate([[0.0], np.cumsum(area)])
        return summed[self.detail_start[1:]] - summed[self.detail_start[:-1]]

    @property
    def area_m2(self) -> float:
        """Area of all polygons that can be walked on [m2]; Habitat's ``navigable_area``."""
        return float(self.polygon_areas[self.enabled].sum())

    @cached_property
    def islands(self) -> NDArray[np.int32]:
        """Island of each polygon [P], -1 for polygons that cannot be walked on."""
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import connected_components

        count = len(self.flags)
        owner = np.repeat(np.arange(count), np.diff(self.polygon_start))
        inner = self.polygon_neighbours >= 0
        a, b = owner[inner], self.polygon_neighbours[inner]
        joined = self.enabled[a] & self.enabled[b]
        pairs = csr_matrix((np.ones(int(joined.sum()), np.int8), (a[joined], b[joined])), shape=(count, count))
        label = connected_components(pairs, directed=False)[1]
        used = label[self.enabled]
        _, first = np.unique(used, return_index=True)
        rank = np.full(count + 1, -1, np.int32)
        # numbered by the first polygon of each, as Habitat does; the labels of SciPy have any order
        rank[used[np.sort(first)]] = np.arange(len(first))
        return np.where(self.enabled, rank[label], -1).astype(np.int32)

    @property
    def island_areas(self) -> NDArray[np.float64]:
        """Area of each island [K] [m2]."""
        return np.bincount(self.islands[self.enabled], self.polygon_areas[self.enabled]).astype(np.float64)

    def island_polygons(self, island: int) -> NDArray[np.int64]:
        """Return the indices of the polygons of an island."""
        self._check(island)
        return np.flatnonzero(self.islands == island)

    def triangles(self, *, island: int | None = None) -> NDArray[np.float32]:
        """Return the detail triangles [T, 3, 3] [m] of the polygons that can be walked on, or of one island."""
        if island is not None:
            self._check(island)
        wanted = self.enabled if island is None else self.islands == island
        return self.detail_triangles[np.repeat(wanted, np.diff(self.detail_start))]

    def corners(self, polygon: int) -> NDArray[np.float32]:
        """Return corners [k, 3] of a polygon [m]."""
        return self.vertices[self.polygon_vertices[self.polygon_start[polygon] : self.polygon_start[polygon + 1]]]

    def _check(self, island: int) -> None:
        count = int(self.islands.max(initial=-1)) + 1
        if not 0 <= island < count:
            raise InputError(f"There is no island {island}. This navmesh has {count}, from 0.", code="H3-HABITAT-086")

    def __repr__(self) -> str:
        return (
            f"NavMesh({len(self.flags)} polygons, {len(self.vertices)} vertices, {len(self.detail_triangles)} triangles, "
            f"{int(self.islands.max(initial=-1)) + 1} islands, {self.area_m2:.2f} m2, "
            f"radius {self.settings.agent_radius:.3g} m)"
        )


def free_space_from_navmesh(navmesh: NavMesh, *, island: int | None = None, cell_m: float = 0.05) -> FreeSpace:
    """Return the free space of one floor of a navmesh.

    Its polygon is the union of the navmesh's, so shortest paths are exact on it.

    Without ``island``: the largest island with the others at its height (within the agent's climb) that do not lie above
    or below it. ``sdf`` is the signed distance to the border of the polygon *plus the radius*: a navmesh knows where the
    centre may be, not where the obstacles are. So ``sdf >= radius`` holds exactly on the navmesh, and elsewhere the
    distance is never overstated: true along walls, up to 0.41 radius too small at the corners of obstacles.

    Raises:
        SceneError: nothing can be walked on, the island lies above itself (stairs), or polygons are damaged.
        InputError: the grid would be too large.
    """
    try:
        return _one_floor(navmesh, island, cell_m)
    # only now the polygons are checked: it takes long, and hardly any navmesh is damaged
    except shapely.errors.GEOSException as error:
        outlines = [Polygon(navmesh.corners(int(p))[:, [0, 2]]) for p in np.flatnonzero(navmesh.enabled)]
        crossed = sum(not outline.is_valid for outline in outlines)
        raise SceneError(
            f"Expected polygons that do not cross themselves, {crossed} of {len(outlines)} do: "
            f"the navmesh is damaged ({error}).",
            code="H3-HABITAT-087",
        ) from None


def _one_floor(navmesh: NavMesh, island: int | None, cell_m: float) -> FreeSpace:
    areas = navmesh.island_areas
    if not len(areas):
        raise SceneError("The navmesh has no polygon that can be walked on.", code="H3-HABITAT-083")
    main = int(np.argmax(areas)) if island is None else island
    outline = _island_outline(navmesh, main)
    level = _island_height(navmesh, main)
    parts = polygon_parts(outline)
    for other in np.argsort(-areas, kind="stable") if island is None else ():
        if other == main or abs(_island_height(navmesh, int(other)) - level) > navmesh.settings.agent_max_climb:
            continue
        more = _island_outline(navmesh, int(other))
        if more.intersection(outline).area < ZERO_AREA_M2:
            # apart by more than a slit: two islands that touch in a point would be one polygon without a path
            touching = shapely.union_all(parts).buffer(2 * SLIT_M)
            parts += [p for p in polygon_parts(more.difference(touching)) if p.area >= ZERO_AREA_M2]
    polygon = MultiPolygon(sorted(parts, key=lambda p: -p.area))
    radius = float(np.round(navmesh.settings.agent_radius, 6))  # stored as float32
    # the border of the polygons is where centres end, a radius before the obstacles
    edges = area_edges(polygon)[0]
    border = radius + 2 * cell_m
    x0, z0, x1, z1 = polygon.bounds
    origin = np.array([x0 - border, z0 - border])
    nx, nz = (int(np.ceil((hi - lo + 2 * border) / cell_m)) for lo, hi in ((x0, x1), (z0, z1)))
    if nx * nz > CELLS_MAX:
        raise InputError(
            f"A grid of {cell_m} m over {x1 - x0:.0f} x {z1 - z0:.0f} m has {nx * nz} cells, more than {CELLS_MAX}. "
            "Hint: a larger cell_m.",
            code="H3-HABITAT-084",
        )
    return FreeSpace(
        key=_key(navmesh, main, island is None, cell_m),
        floor_y=level,
        radius_m=radius,
        height_m=float(np.round(navmesh.settings.agent_height, 6)),
        max_climb_m=float(np.round(navmesh.settings.agent_max_climb, 6)),
        cell_m=cell_m,
        origin=origin,
        sdf=(sdf_from_edges(edges, origin, cell_m, nx, nz) + radius).astype(np.float32),
        polygon=polygon,
        graph=build_graph(polygon),
    )


def navmesh_from_free_space(
    free_space: FreeSpace, *, merge: bool = True, settings: NavMeshSettings | None = None
) -> NavMesh:
    """Return a floor as polygons; islands keep their order.

    Args:
        free_space: The floor.
        merge: True writes few polygons of up to six corners, whose outlines are within 3 cm of the floor's, as
            habitat-sim needs for large homes (`h3data_habitat.navmesh.merging`). False writes exact triangles
            (constrained Delaunay).
        settings: Settings to record; by default those of the floor's agent.
    """
    area = plain_outline(free_space.polygon) if merge else free_space.polygon
    pieces = [(k, piece) for k, p in enumerate(area.geoms) for piece in _slopes_apart(p, free_space.heights)]
    found = [
        shapely.get_coordinates(shapely.constrained_delaunay_triangles(p)).reshape(-1, 4, 2)[:, :3] for _, p in pieces
    ]
    flat = np.concatenate([np.zeros((0, 3, 2)), *found])
    island = np.repeat(np.array([k for k, _ in pieces], int), [len(f) for f in found])
    piece = np.repeat(np.arange(len(found)), [len(f) for f in found])
    keyed = np.concatenate([np.repeat(island, 3)[:, None], flat.reshape(-1, 2)], axis=1)
    unique, corner = np.unique(keyed, axis=0, return_inverse=True)  # by island: where two touch they stay apart
    vertices = np.empty((len(unique), 3), np.float32)
    vertices[:, [0, 2]] = unique[:, 1:]
    vertices[:, 1] = free_space.height_at(unique[:, 1:])
    corner = corner.reshape(-1, 3).astype(np.int32)
    polygons = corner.tolist()
    if merge:  # never across the foot or the head of stairs
        groups = [piece == k for k in range(len(found))] if len(free_space.heights) else [np.ones(len(corner), bool)]
        plan = unique[:, 1:].astype(np.float64)
        polygons = [polygon for group in groups for polygon in merged_polygons(plan, corner[group])]
    start = np.concatenate([[0], np.cumsum([len(p) for p in polygons])]).astype(np.int32)
    flat_corner = np.array([v for p in polygons for v in p], np.int32)
    fans = (
        [[(p[0], p[k], p[k + 1]) for k in range(1, len(p) - 1)] for p in polygons] if merge else [[p] for p in polygons]
    )
    return NavMesh(
        settings=settings
        or NavMeshSettings(
            agent_height=free_space.height_m,
            agent_radius=free_space.radius_m,
            agent_max_climb=free_space.max_climb_m,
            verts_per_poly=float(CORNERS_MAX if merge else 3),
        ),
        vertices=vertices,
        polygon_start=start,
        polygon_vertices=flat_corner,
        polygon_neighbours=_neighbours(start, flat_corner),
        areas=np.zeros(len(polygons), np.uint8),
        flags=np.ones(len(polygons), np.uint16),
        detail_start=np.concatenate([[0], np.cumsum([len(fan) for fan in fans])]).astype(np.int32),
        detail_triangles=vertices[np.array([t for fan in fans for t in fan], np.int32).reshape(-1, 3)],
        bounds=np.stack([vertices.min(0), vertices.max(0) + np.array([0, free_space.height_m, 0], np.float32)]),
    )


def _slopes_apart(polygon: Polygon, heights: NDArray[np.float64]) -> list[Polygon]:
    """Return a polygon cut where level floor and stairs meet; they share the vertices there."""
    # ramps between floors are planes of their own: a triangle across their foot would cut through the air
    flights = [shapely.box(*flight_rectangle(row)) for row in heights if row[STEPS]]
    if not flights:
        return [polygon]
    stairs = shapely.union_all(flights)
    return [*polygon_parts(polygon.difference(stairs)), *polygon_parts(polygon.intersection(stairs))]


def _neighbours(start: NDArray[np.int32], corner: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the polygon across each edge, int32 [S], -1: none; polygons are given by `NavMesh.polygon_vertices`."""
    owner = np.repeat(np.arange(len(start) - 1), np.diff(start))
    last = np.arange(len(corner)) == start[owner + 1] - 1
    following = corner[np.where(last, start[owner], np.arange(len(corner)) + 1)]
    # sorted, because neighbours go along their common edge in opposite directions
    ends = np.sort(np.stack([corner, following], axis=1), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    same = np.flatnonzero((ends[order][1:] == ends[order][:-1]).all(1))
    neighbour = np.full(len(ends), -1, np.int32)
    neighbour[order[same]] = owner[order[same + 1]]
    neighbour[order[same + 1]] = owner[order[same]]
    return neighbour


def _island_height(navmesh: NavMesh, island: int) -> float:
    """Return the mean height of an island by area [m]."""
    t = navmesh.triangles(island=island).astype(np.float64)
    weight = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1)
    return float(np.average(t[:, :, 1].mean(1), weights=weight))


def _island_outline(navmesh: NavMesh, island: int) -> BaseGeometry:
    """Return the floor area (x, z) of an island, walls without thickness cut out of it as slits of 0.6 mm."""
    polygons, walls = [], []
    for p in navmesh.island_polygons(island):
        corners = navmesh.corners(p)[:, [0, 2]].astype(np.float64)
        polygons.append(Polygon(corners))
        wall = navmesh.polygon_neighbours[navmesh.polygon_start[p] : navmesh.polygon_start[p + 1]] < 0
        walls += [LineString(ends) for ends in np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)[wall]]
    area = shapely.union_all(polygons)
    overlap = sum(p.area for p in polygons) - area.area
    if overlap > max(1e-3 * area.area, 0.01):
        raise SceneError(
            f"Island {island} of the navmesh lies {overlap:.2f} m2 above itself (stairs): a FreeSpace is one floor. "
            "Hint: PathFinder(navmesh) works on all floors.",
            code="H3-HABITAT-085",
        )
    # walls on the outline are there already; those inside of the area have no thickness
    inner = shapely.union_all(walls).difference(area.boundary.buffer(SLIT_M))
    return area.difference(inner.buffer(SLIT_M)) if inner.length > SLIT_M else area


def _key(navmesh: NavMesh, island: int, all_islands: bool, cell_m: float) -> str:
    """Return the SHA-256 of everything that the free space of a navmesh is built from."""
    digest = hashlib.sha256(f"navmesh 1 {navmesh.settings} {island} {all_islands} {cell_m}".encode())
    for array in (navmesh.vertices, navmesh.polygon_start, navmesh.polygon_vertices, navmesh.polygon_neighbours):
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(navmesh.flags.tobytes() + navmesh.detail_triangles.tobytes())
    return digest.hexdigest()
