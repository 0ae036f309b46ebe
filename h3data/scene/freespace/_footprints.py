"""Outlines on the floor of the part of each collision shape within a range of heights, as polygons."""

from __future__ import annotations

import itertools

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon, box
from shapely.geometry.base import BaseGeometry

from h3data.errors import SceneError
from h3data.geometry import transform_points
from h3data.scene.records import Capsule, Instance, Room, Scene, Shape, instance_matrix
from h3data.scene.shape_bounds import PRISM_SIDES, shape_corners

WALL_HALF_M = 0.06
"""Half the thickness of walls around stairwells [m]: the floors of the stairwell and of the rooms beyond both end in
the middle of the wall."""
WALL_GAP_M = 0.3
"""Largest width of gaps between the rectangles of rooms that are walls or doorways and count as floor [m]; walls are
then removed as obstacles."""


def shape_footprint(shape: Shape, matrix: NDArray[np.float64], low: float, high: float) -> Polygon | None:
    """Return the outline (x, z) of the part of a shape between two heights [m], or None if no part is in the range.

    Args:
        shape: A convex shape in its asset frame.
        matrix: 4x4 from asset frame to world, scale included.
        low: Lower end of the range of heights [m].
        high: Upper end of the range of heights [m].
    """
    if not isinstance(shape, Capsule):
        return _hull_polygon(_clip_to_band(transform_points(matrix, shape_corners(shape)), low, high))
    # the hull of circles about the part of the core within reach of the band: a little large where the band cuts
    radius = shape.radius * float(np.linalg.norm(matrix[:3, :3], axis=0).max())
    core = transform_points(matrix, np.stack([shape.start, shape.end]).astype(np.float64))
    core = _clip_to_band(core, low - radius, high + radius)
    if not len(core):
        return None
    # the polygon around a circle, 0.5% of the radius too large at its corners
    angle = np.arange(PRISM_SIDES) * (2 * np.pi / PRISM_SIDES)
    circle = np.stack([np.cos(angle), np.sin(angle)], -1) * (radius / np.cos(np.pi / PRISM_SIDES))
    return _hull_polygon((core[:, None, [0, 2]] + circle).reshape(-1, 2))


def scene_obstacles(scene: Scene, low: float, high: float) -> list[Polygon]:
    """Return the outlines of all shapes of static instances that reach into a range of heights [m]."""
    return [o for instance in scene.static_instances for o in _instance_footprints(scene, instance, low, high)]


def _instance_footprints(scene: Scene, instance: Instance, low: float, high: float) -> list[Polygon]:
    matrix = instance_matrix(instance)
    outlines = (shape_footprint(s, matrix, low, high) for s in scene.assets[instance.asset].shapes)
    return [o for o in outlines if o is not None]


def rooms_floor(rooms: tuple[Room, ...]) -> BaseGeometry:
    """Return the floor under some rooms: their rectangles, joined through walls and doorways (a morphological closing)."""
    rectangles = [box(*r) for room in rooms for r in np.asarray(room.rectangles, np.float64)]
    if not rectangles:
        raise SceneError(
            "The rooms of the scene have no rectangles, so there is no floor. Hint: Room.rectangles [R, 4].",
            code="H3-SCENE-004",
        )
    half = WALL_GAP_M / 2
    return shapely.union_all(rectangles).buffer(half, join_style="mitre").buffer(-half, join_style="mitre")


def rooms_level(rooms: tuple[Room, ...]) -> float:
    """Return the height of the floor with the largest total area of rooms [m]."""
    area: dict[float, float] = {}
    for room in rooms:
        r = np.asarray(room.rectangles, np.float64)
        area[room.floor_y] = area.get(room.floor_y, 0.0) + float(np.sum((r[:, 2] - r[:, 0]) * (r[:, 3] - r[:, 1])))
    # the lower one of two that are equally large
    return max(area, key=lambda y: (area[y], -y))


def walkable_from_shapes(scene: Scene, floor_y: float, *, climb_m: float, height_m: float) -> MultiPolygon:
    """Return the floor of the rooms at one height minus everything between climb and head height above it."""
    rooms = tuple(r for r in scene.rooms if abs(r.floor_y - floor_y) <= climb_m)
    if not rooms:
        levels = sorted({r.floor_y for r in scene.rooms})
        raise SceneError(
            f"Scene {scene.name!r} has no room whose floor is at {floor_y} m. Its floors: {levels}.",
            code="H3-SCENE-005",
        )
    obstacles = shapely.union_all(scene_obstacles(scene, floor_y + climb_m, floor_y + height_m))
    free = rooms_floor(rooms).difference(obstacles)
    return MultiPolygon([p for p in shapely.get_parts(free) if isinstance(p, Polygon)])


def walkable_on_storeys(scene: Scene, *, climb_m: float, height_m: float) -> MultiPolygon:
    """Return the floor of all storeys and their stairs, minus everything between climb and head height above it."""
    whole, parts = rooms_floor(scene.rooms), []
    stairs = [room for room in scene.rooms if room.ramp is not None]
    wells = shapely.union_all([box(*r) for room in stairs for r in room.rectangles.tolist()])
    wells = wells.buffer(WALL_HALF_M, join_style="mitre")
    for level in sorted({room.floor_y for room in scene.rooms if room.ramp is None}):
        rooms = tuple(room for room in scene.rooms if room.ramp is None and room.floor_y == level)
        around = rooms_floor(rooms).buffer(WALL_GAP_M / 2, join_style="mitre").intersection(whole).difference(wells)
        parts.append(around.difference(shapely.union_all(scene_obstacles(scene, level + climb_m, level + height_m))))
    # once for all treads, each of which would otherwise look at every instance of the home
    near = _instances_near(scene, wells)
    for room in stairs:
        for piece, level in _stretches(room):
            found = [_instance_footprints(scene, i, level + climb_m, level + height_m) for i in near]
            outlines = [outline for outlines in found for outline in outlines]
            parts.append(piece.intersection(whole).difference(shapely.union_all(outlines)))
    # half width of a seam between the pieces of a floor that is closed
    seam_m = 1e-4
    # grown and shrunk again: pieces that share an edge may miss each other by the last digit, and a path could not pass
    free = shapely.union_all(parts).buffer(seam_m, join_style="mitre").buffer(-seam_m, join_style="mitre")
    return MultiPolygon([p for p in shapely.get_parts(free) if isinstance(p, Polygon)])


def _stretches(room: Room) -> list[tuple[BaseGeometry, float]]:
    """Return a stairwell in pieces on which a foot stands at one height, up to the middle of its walls."""
    ramp = room.ramp
    assert ramp is not None
    x0, z0, x1, z1 = shapely.union_all([box(*r) for r in np.asarray(room.rectangles, np.float64)]).bounds
    ends = ((x0, x1), (z0, z1))[ramp.axis]
    going = (ramp.end - ramp.start) / ramp.steps
    risers = [ramp.start + (k + 0.5) * going for k in range(ramp.steps)]
    # the stairs may rise towards lower coordinates
    first, last = (ends[0], ends[1]) if going > 0 else (ends[1], ends[0])
    outward = WALL_HALF_M if going > 0 else -WALL_HALF_M
    cuts = [first - outward, *risers, last + outward]
    rise = (ramp.top_y - room.floor_y) / ramp.steps
    pieces = []
    for k, (a, b) in enumerate(itertools.pairwise(cuts)):
        low, high = min(a, b), max(a, b)
        wide = ((z0 if ramp.axis == 0 else x0) - WALL_HALF_M, (z1 if ramp.axis == 0 else x1) + WALL_HALF_M)
        rectangle = (low, wide[0], high, wide[1]) if ramp.axis == 0 else (wide[0], low, wide[1], high)
        pieces.append((box(*rectangle), room.floor_y + k * rise))
    return pieces


def _instances_near(scene: Scene, area: BaseGeometry) -> list[Instance]:
    """Return the static instances whose collision shapes may reach into an area of the plan."""
    x0, z0, x1, z1 = area.bounds
    found = []
    for instance in scene.static_instances:
        corners = [c for c in map(_shape_points, scene.assets[instance.asset].shapes) if len(c)]
        if corners:
            points = transform_points(instance_matrix(instance), np.concatenate(corners))
            (low_x, _, low_z), (high_x, _, high_z) = points.min(0).tolist(), points.max(0).tolist()
            if low_x < x1 and high_x > x0 and low_z < z1 and high_z > z0:
                found.append(instance)
    return found


def _shape_points(shape: Shape) -> NDArray[np.float64]:
    if not isinstance(shape, Capsule):
        return shape_corners(shape)
    ends = np.stack([shape.start, shape.end]).astype(np.float64)
    return np.concatenate([ends - shape.radius, ends + shape.radius])


def _clip_to_band(points: NDArray, low: float, high: float) -> NDArray:
    """Return points [M, 3] whose hull is the hull of ``points`` [N, 3] between two heights.

    They are the points inside the band, and where lines between points cross its two planes. For a convex body all
    pairs of points may be connected.
    """
    for plane, sign in ((low, 1.0), (high, -1.0)):
        side = (points[:, 1] - plane) * sign
        inside, outside = points[side > 0], points[side <= 0]
        if not len(inside) or not len(outside):
            points = inside
            continue
        a, b = np.repeat(inside, len(outside), 0), np.tile(outside, (len(inside), 1))
        t = (plane - a[:, 1]) / (b[:, 1] - a[:, 1])
        points = np.concatenate([inside, a + t[:, None] * (b - a)])
    return points


def _hull_polygon(points: NDArray) -> Polygon | None:
    """Return the convex outline of points [N, 2 or 3] in the floor plane, None when it has no area."""
    if len(points) < 3:
        return None
    hull = shapely.MultiPoint(points[:, [0, -1]]).convex_hull
    return hull if isinstance(hull, Polygon) and hull.area > 1e-9 else None
