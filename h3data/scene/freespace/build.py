"""Builders of `FloorMap`: from the collision shapes and rooms of a scene, or only from its meshes."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon
from shapely.geometry.base import BaseGeometry

from h3data.errors import InputError, SceneError
from h3data.geometry import transform_points
from h3data.scene.floor_heights import LEVEL, STEPS, flight_rectangle, room_heights
from h3data.scene.freespace._footprints import rooms_level, walkable_from_shapes, walkable_on_storeys
from h3data.scene.freespace._sdf import sdf_from_edges
from h3data.scene.freespace._visibility import Graph
from h3data.scene.freespace._visibility_build import area_edges, build_graph, polygon_parts
from h3data.scene.freespace._voxels import flood_surfaces, mark_standable, mask_rectangles, voxel_columns
from h3data.scene.records import Box, Capsule, Cylinder, Scene, Shape, instance_matrix


@dataclass(frozen=True, kw_only=True, eq=False)
class FloorMap:
    """Free floor for a disc of one radius: polygons, distances to obstacles, and visibility graph."""

    key: str
    """SHA-256 of the geometry and the parameters from which it was built; empty if it was not built from a scene."""
    floor_y: float
    """Height of the floor [m]; if there are several storeys, of the lowest one."""
    radius_m: float
    height_m: float
    """Height above the floor up to which objects are obstacles; lower objects up to ``max_climb_m`` are not [m]."""
    max_climb_m: float
    cell_m: float
    """Side of a cell of ``sdf`` [m]."""
    origin: NDArray[np.float64]
    """Lower corner (x, z) [m] of cell [0, 0]; the centre of cell [i, j] is ``origin + (i + 0.5, j + 0.5) * cell_m``."""
    sdf: NDArray[np.float32]
    """Distance from cell centres to the nearest obstacle or border of the floor, not inflated: an agent fits where it is
    at least ``radius_m``; negative in obstacles and off the floor. Shape [nx, nz] [m]."""
    polygon: MultiPolygon
    """Area in which an agent's centre may be: floor minus obstacles, shrunk by the radius. Its polygons are the islands,
    largest first."""
    graph: Graph
    """Visibility graph over the corners of ``polygon``, with all shortest paths."""
    heights: NDArray[np.float64] = field(default_factory=LEVEL.copy)
    """Table of floor heights if stairs join storeys (`h3data.scene.floor_heights`), shape [K, 10]; K = 0 if the floor
    is at ``floor_y`` everywhere."""


@dataclass(frozen=True)
class BuildSpec:
    """Version and resolutions of the free floor."""

    version: int = 4
    """Version of the builders, part of every key. It must be raised when results change, so that stale cache entries
    are not found."""
    arc_segments: int = 8
    """Number of segments per quarter of an inflated corner: at a radius of 0.25 m a path cuts 1.2 mm into it (with 4
    segments: 4.8 mm)."""
    smooth_m: float = 1e-4
    """Distance from a straight line below which corners are dropped [m]: such corners are artefacts of unions."""
    island_min_m2: float = 0.01
    """Area below which patches of floor are rounding errors [m2]."""
    voxel_m: float = 0.025
    """Side and height of a voxel [m]. With 5 cm the largest errors of geodesic distances were 12% to 24%, with 2.5 cm
    below 1% (research/navigation-and-stepping.md 2.4)."""


BUILD = BuildSpec()


Method = Literal["auto", "shapes", "mesh"]


def choose_method(scene: Scene, method: Method) -> Literal["shapes", "mesh"]:
    """Choose the builder for a scene: exact shapes if there are rooms and shapes of the building, else voxels."""
    static = [scene.assets[i.asset] for i in scene.static_instances]
    # a stage without shapes is a scanned building: its furniture may have shapes, but its walls do not
    shapes = any(a.shapes for a in static) and not any(a.category == "stage" and not a.shapes for a in static)
    if method == "shapes" and not scene.rooms:
        raise SceneError(
            f"Scene {scene.name!r} has no rooms, so nothing says where the floor is. Hint: method='mesh'.",
            code="H3-SCENE-009",
        )
    if method != "auto":
        return method
    return "shapes" if shapes and scene.rooms else "mesh"


def scene_key(
    scene: Scene,
    *,
    radius_m: float,
    height_m: float,
    max_climb_m: float,
    cell_m: float,
    floor_y: float | None,
    method: Method,
) -> str:
    """Return the SHA-256 (hex) of all inputs of a builder, geometry and parameters: equal keys mean equal free space."""
    used = choose_method(scene, method)
    digest = hashlib.sha256(f"freespace {BUILD.version} {used}".encode())
    numbers = (radius_m, height_m, max_climb_m, cell_m, np.nan if floor_y is None else floor_y)
    digest.update(np.array(numbers, np.float64).tobytes())
    for instance in scene.static_instances:
        digest.update(instance_matrix(instance).astype("<f8").tobytes())
        asset = scene.assets[instance.asset]
        if used == "mesh":
            # only what the chosen builder reads: another colour or a new name must not build the floor again
            digest.update(np.ascontiguousarray(asset.mesh.vertices).tobytes())
            digest.update(np.ascontiguousarray(asset.mesh.faces).tobytes())
        else:
            for shape in asset.shapes:
                digest.update(_shape_bytes(shape))
    if used == "shapes":
        for room in scene.rooms:
            digest.update(np.asarray(room.rectangles, "<f8").tobytes() + np.float64(room.floor_y).tobytes())
            if room.ramp is not None:
                digest.update(repr(room.ramp).encode())
    return digest.hexdigest()


def build_from_scene(
    scene: Scene,
    *,
    radius_m: float,
    height_m: float,
    max_climb_m: float,
    cell_m: float,
    floor_y: float | None = None,
    method: Method = "auto",
) -> FloorMap:
    """Return the free space of one floor of a scene, or of all storeys that stairs join.

    The arguments are described in `h3data.scene.FreeSpace.from_scene`.
    """
    sizes = {"radius_m": radius_m, "height_m": height_m, "max_climb_m": max_climb_m, "cell_m": cell_m}
    wrong = [f"{k}={v}" for k, v in sizes.items() if not np.isfinite(v) or v <= 0]
    if wrong or max_climb_m >= height_m:
        raise InputError(
            f"Sizes of an agent must be positive, and its climb below its height, got {', '.join(wrong) or sizes}.",
            code="H3-SCENE-010",
        )
    key = scene_key(scene, **sizes, floor_y=floor_y, method=method)
    used = choose_method(scene, method)
    heights = room_heights(scene.rooms) if used == "shapes" and floor_y is None else LEVEL
    if len(heights):
        level = min(room.floor_y for room in scene.rooms)
        walkable = walkable_on_storeys(scene, climb_m=max_climb_m, height_m=height_m)
    elif used == "shapes":
        level = rooms_level(scene.rooms) if floor_y is None else float(floor_y)
        walkable = walkable_from_shapes(scene, level, climb_m=max_climb_m, height_m=height_m)
    else:
        triangles = scene_triangles(scene)
        if not len(triangles):
            raise SceneError(
                f"Scene {scene.name!r} has no static triangles: there is no floor to stand on.", code="H3-SCENE-015"
            )
        walkable, level = walkable_from_triangles(
            triangles, radius_m=radius_m, climb_m=max_climb_m, height_m=height_m, floor_y=floor_y
        )
    if used == "shapes":
        return build_from_walkable(walkable, **sizes, floor_y=level, key=key, heights=heights)
    # Of voxels a slanting wall is a staircase, whose inflated outline is scalloped by about 1 mm. Small islands are the
    # insides of wardrobes and tubs; Habitat leaves out regions below 20 x 20 cells of 5 cm (``regionMinSize``,
    # spec/habitat.md 6.7).
    rough = {"smooth_m": 2e-3, "island_min_m2": 1.0}
    return build_from_walkable(walkable, **sizes, **rough, floor_y=level, key=key, heights=heights)


def build_from_walkable(
    walkable: BaseGeometry,
    *,
    radius_m: float,
    height_m: float,
    max_climb_m: float,
    cell_m: float,
    floor_y: float = 0.0,
    smooth_m: float = BUILD.smooth_m,
    island_min_m2: float = BUILD.island_min_m2,
    key: str = "",
    heights: NDArray[np.float64] = LEVEL,
) -> FloorMap:
    """Return the free space of a disc of ``radius_m`` on a floor given as polygons (x, z), obstacles already cut out.

    Islands smaller than ``island_min_m2`` are left out, except the largest one.
    """
    # before it is inflated: each needless corner would become an arc of eight segments and as many nodes of the graph
    walkable = MultiPolygon(polygon_parts(walkable.simplify(BUILD.smooth_m)))
    if walkable.is_empty:
        raise SceneError(
            "Nothing of the floor is free. Hint: check the rooms, and the height of the floor.", code="H3-SCENE-011"
        )
    free = walkable.buffer(-radius_m, quad_segs=BUILD.arc_segments).simplify(smooth_m)
    islands = [p for p in polygon_parts(free) if p.area >= BUILD.island_min_m2]
    # the largest stays whatever its size, as agents need some place
    islands = [p for k, p in enumerate(islands) if k == 0 or p.area >= island_min_m2]
    if not islands:
        raise SceneError(
            f"An agent of radius {radius_m} m fits nowhere on the floor ({walkable.area:.2f} m2).", code="H3-SCENE-012"
        )
    x0, z0, x1, z1 = walkable.bounds
    border = 0.3  # of the distance grid, around the floor [m]
    origin = np.array([x0 - border, z0 - border])
    nx, nz = (int(np.ceil((hi - lo + 2 * border) / cell_m)) for lo, hi in ((x0, x1), (z0, z1)))
    polygon = MultiPolygon(islands)
    return FloorMap(
        key=key,
        floor_y=floor_y,
        radius_m=radius_m,
        height_m=height_m,
        max_climb_m=max_climb_m,
        cell_m=cell_m,
        origin=origin,
        sdf=sdf_from_edges(area_edges(walkable)[0], origin, cell_m, nx, nz),
        polygon=polygon,
        graph=build_graph(polygon),
        heights=heights,
    )


def without_stairs(floor: FloorMap) -> FloorMap:
    """Return the floor for agents that cannot climb: flights of stairs are obstacles, so that storeys are islands."""
    heights = floor.heights.copy()
    flights = [shapely.box(*flight_rectangle(row)) for row in heights if row[STEPS]]
    heights[:, STEPS] = 0  # nobody sets a foot on them
    free = floor.polygon.difference(shapely.union_all(flights).buffer(floor.radius_m, quad_segs=BUILD.arc_segments))
    polygon = MultiPolygon([p for p in polygon_parts(free.simplify(BUILD.smooth_m)) if p.area >= BUILD.island_min_m2])
    nx, nz = floor.sdf.shape
    # the distance to obstacles now counts the flights too; outside a ring it is negative, hence the sign
    outside = [
        -sdf_from_edges(area_edges(MultiPolygon([flight]))[0], floor.origin, floor.cell_m, nx, nz) for flight in flights
    ]
    sdf = np.minimum.reduce([floor.sdf, *outside])
    # without a key: that of ``floor`` stands for the floor with stairs
    return replace(floor, key="", sdf=sdf, polygon=polygon, graph=build_graph(polygon), heights=heights)


def scene_triangles(scene: Scene) -> NDArray[np.float64]:
    """Return the world triangles [F, 3, 3] of all static instances."""
    found = []
    for instance in scene.static_instances:
        mesh = scene.assets[instance.asset].mesh
        found.append(transform_points(instance_matrix(instance), mesh.vertices.astype(np.float64))[mesh.faces])
    return np.concatenate([np.zeros((0, 3, 3)), *found])


def walkable_from_triangles(
    triangles: NDArray[np.float64],
    *,
    radius_m: float,
    climb_m: float,
    height_m: float,
    floor_y: float | None = None,
    voxel_m: float = BUILD.voxel_m,
) -> tuple[MultiPolygon, float]:
    """Return floor polygons (x, z), not yet inflated, and the floor's height [m], from world triangles [F, 3, 3].

    The floor is the lowest large connected surface (or the one nearest to ``floor_y``), together with all other
    surfaces at its height.
    """
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    size = high - low
    # at most 300 million voxels, of one byte each; roots before products, which might overflow
    cell = max(voxel_m, float(np.prod(np.cbrt(np.maximum(size, voxel_m))) / np.cbrt(300_000_000)))
    if not cell <= radius_m:  # NaN is not either
        raise SceneError(
            f"The scene is {' x '.join(f'{s:.3g}' for s in size)} m large, too large to find its floor: voxels would be "
            f"{cell:.3g} m, the agent's radius is {radius_m:g} m. Hint: wrong unit, or a thing that is far away?",
            code="H3-SCENE-013",
        )
    if cell > voxel_m:
        logging.getLogger(__name__).warning(
            "The scene is %s m large: voxels of %.3f m instead of %.3f m.", np.round(size, 1), cell, voxel_m
        )
    origin = low - cell * 1.5  # no geometry on the faces of voxels, for scenes on a round grid
    shape = tuple(int(s) for s in np.ceil(size / cell).astype(int) + 3)
    steep = float(np.cos(np.radians(45.0)))  # habitat-sim's default
    columns = voxel_columns(triangles, steep, origin, cell, cell, (shape[0], shape[2], shape[1]))
    head, climb = int(np.floor(height_m / cell)), int(round(climb_m / cell))
    total = mark_standable(columns, head, climb)
    if total == 0:
        raise SceneError(
            f"No surface of the scene is flat and has {height_m} m of headroom. Hint: is +Y up?", code="H3-SCENE-014"
        )
    voxel, component, sizes = flood_surfaces(columns, total, climb, head)
    heights = origin[1] + (voxel[:, 1 + 1] + 0.5) * cell
    level = _floor_level(heights, component, sizes, floor_y)
    mean = np.bincount(component, heights) / sizes
    # surfaces more than 1 m above or below the floor belong to another storey
    near = (np.abs(mean - level) <= climb_m)[component] & (np.abs(heights - level) <= 1.0)
    mask = np.zeros(columns.shape[:2], bool)
    mask[voxel[near, 0], voxel[near, 1]] = True
    return _mask_outline(mask, origin, cell, radius_m), _exact_level(triangles, level, cell)


def _mask_outline(mask: NDArray[np.bool_], origin: NDArray, cell: float, radius_m: float) -> MultiPolygon:
    """Return the outline of the cells of a mask, expanded by nearly half a cell.

    A wall blocks whole cells, so it is half a cell too thick on average; the expansion is less than half a cell, so
    that a wall of one cell is thin but still there. Patches in which the agent does not fit are the insides of walls
    and furniture, and are left out.
    """
    rectangles = mask_rectangles(mask) * cell + np.array([origin[0], origin[2]] * 2)
    cells = shapely.union_all(shapely.box(*rectangles.T))
    parts = [p.buffer(0.49 * cell, join_style="mitre") for p in polygon_parts(cells)]
    return MultiPolygon([q for p in parts if not p.buffer(-radius_m).is_empty for q in polygon_parts(p)])


def _floor_level(heights: NDArray, component: NDArray, sizes: NDArray, floor_y: float | None) -> float:
    """Return the height of the floor: of the surface nearest to the wanted height, else of the lowest large component."""
    # no height is wanted: the floor has to be told from roofs, tables and beds
    if floor_y is None:
        order = np.argsort(component, kind="stable")
        middle = np.array([np.median(h) for h in np.split(heights[order], np.cumsum(sizes)[:-1])])
        # the lowest of those with a quarter of the largest one, which may be the roof
        return float(middle[np.flatnonzero(sizes >= 0.25 * sizes.max())].min())
    chosen = int(component[np.argmin(np.abs(heights - floor_y))])
    return float(np.median(heights[component == chosen]))


def _exact_level(triangles: NDArray, level: float, cell: float) -> float:
    """Return the mean height, by area, of the flat triangles within a voxel of ``level``: that of the floor itself."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    y = triangles[:, :, 1].mean(1)
    weight = np.where((np.abs(y - level) <= cell) & (np.ptp(triangles[:, :, 1], 1) <= cell), np.abs(normal[:, 1]), 0.0)
    return float(np.average(y, weights=weight)) if weight.sum() > 0 else level


def _shape_bytes(shape: Shape) -> bytes:
    """Return a shape as bytes for hashing, its kind first."""
    if isinstance(shape, Box):
        parts = (b"b", shape.pose, shape.half_extents)
    elif isinstance(shape, Cylinder):
        parts = (b"y", shape.pose, [shape.radius, shape.half_height])
    elif isinstance(shape, Capsule):
        parts = (b"c", shape.start, shape.end, [shape.radius])
    else:
        parts = (b"h", shape.points)
    return b"".join([parts[0], *(np.asarray(p, "<f8").tobytes() for p in parts[1:])]) + b";"
