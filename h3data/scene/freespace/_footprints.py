"""Outlines on the floor of collision shapes: what of each convex shape reaches into a band of heights, as polygons."""

from __future__ import annotations

import itertools

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon, box
from shapely.geometry.base import BaseGeometry

from h3data.errors import SceneError
from h3data.geometry import pose_to_matrix, transform_points
from h3data.scene.records import Box, Capsule, Cylinder, Hull, Room, Scene, Shape, instance_matrix

CIRCLE_SIDES = 32
"""Round shapes become polygons of this many sides around them (0.5 % of the radius too large at the corners)."""
WALL_GAP_M = 0.3
"""Gaps up to this wide between the rectangles of rooms are wall or doorway, and belong to the floor; walls then cut it."""


def shape_footprint(shape: Shape, matrix: NDArray[np.float64], low: float, high: float) -> Polygon | None:
    """Outline (x, z) of the part of a shape between two heights [m], None when nothing is there.

    Args:
        shape: A convex shape in its asset frame.
        matrix: 4x4 from asset frame to world, scale included.
        low: Lower end of the band of heights.
        high: Upper end.
    """
    if isinstance(shape, Capsule):
        return _capsule_footprint(shape, matrix, low, high)
    corners = transform_points(matrix, shape_corners(shape))
    return _hull_polygon(_clip_to_band(corners, low, high))


def shape_corners(shape: Box | Cylinder | Hull) -> NDArray[np.float64]:
    """Points [N, 3] in the asset frame whose convex hull is the shape; a cylinder becomes a prism around it."""
    if isinstance(shape, Hull):
        return np.asarray(shape.points, np.float64)
    if isinstance(shape, Box):
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        local = signs * shape.half_extents
    else:
        ring = _circle(shape.radius)
        y = np.array([-shape.half_height, shape.half_height])
        local = np.concatenate([np.stack([ring[:, 0], np.full(len(ring), h), ring[:, 1]], -1) for h in y])
    return transform_points(pose_to_matrix(shape.pose), local).astype(np.float64)


def scene_obstacles(scene: Scene, low: float, high: float) -> list[Polygon]:
    """Outlines of every shape of the static instances that reaches into the band of heights [m]."""
    found = []
    for instance in scene.static_instances:
        matrix = instance_matrix(instance)
        outlines = (shape_footprint(s, matrix, low, high) for s in scene.assets[instance.asset].shapes)
        found += [o for o in outlines if o is not None]
    return found


def rooms_floor(rooms: tuple[Room, ...]) -> BaseGeometry:
    """The floor under some rooms: their rectangles, joined through walls and doorways (a morphological closing)."""
    rectangles = [box(*r) for room in rooms for r in np.asarray(room.rectangles, np.float64)]
    if not rectangles:
        raise SceneError(
            "The rooms of the scene have no rectangles, so there is no floor. Hint: Room.rectangles [R, 4]."
        )
    half = WALL_GAP_M / 2
    return shapely.union_all(rectangles).buffer(half, join_style="mitre").buffer(-half, join_style="mitre")


def rooms_level(rooms: tuple[Room, ...]) -> float:
    """Height of the floor on which the most room area lies [m]."""
    area: dict[float, float] = {}
    for room in rooms:
        r = np.asarray(room.rectangles, np.float64)
        area[room.floor_y] = area.get(room.floor_y, 0.0) + float(np.sum((r[:, 2] - r[:, 0]) * (r[:, 3] - r[:, 1])))
    return max(area, key=lambda y: (area[y], -y))


def walkable_from_shapes(scene: Scene, floor_y: float, *, climb_m: float, height_m: float) -> MultiPolygon:
    """Floor of the rooms at one height minus everything between climb and head height above it: not yet inflated."""
    rooms = tuple(r for r in scene.rooms if abs(r.floor_y - floor_y) <= climb_m)
    if not rooms:
        levels = sorted({r.floor_y for r in scene.rooms})
        raise SceneError(f"Scene {scene.name!r} has no room whose floor is at {floor_y} m. Its floors: {levels}.")
    obstacles = shapely.union_all(scene_obstacles(scene, floor_y + climb_m, floor_y + height_m))
    free = rooms_floor(rooms).difference(obstacles)
    return MultiPolygon([p for p in shapely.get_parts(free) if isinstance(p, Polygon)])


def _circle(radius: float) -> NDArray[np.float64]:
    """Corners [32, 2] of the regular polygon around a circle."""
    angle = np.arange(CIRCLE_SIDES) * (2 * np.pi / CIRCLE_SIDES)
    return np.stack([np.cos(angle), np.sin(angle)], -1) * (radius / np.cos(np.pi / CIRCLE_SIDES))


def _capsule_footprint(shape: Capsule, matrix: NDArray, low: float, high: float) -> Polygon | None:
    """Hull of the circles about the part of the core within reach of the band (a little large where the band cuts)."""
    radius = shape.radius * float(np.linalg.norm(matrix[:3, :3], axis=0).max())
    core = transform_points(matrix, np.stack([shape.start, shape.end]).astype(np.float64))
    core = _clip_to_band(core, low - radius, high + radius)
    if not len(core):
        return None
    return _hull_polygon((core[:, None, [0, 2]] + _circle(radius)).reshape(-1, 2))


def _clip_to_band(points: NDArray, low: float, high: float) -> NDArray:
    """Points [M, 3] whose hull is the hull of ``points`` [N, 3] between two heights: those inside, and where the
    connecting lines cross the two planes (for a convex body, all pairs may be joined)."""
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
    """Convex outline of points [N, 2 or 3] in the floor plane, None when it has no area."""
    if len(points) < 3:
        return None
    hull = shapely.MultiPoint(points[:, [0, -1]]).convex_hull
    return hull if isinstance(hull, Polygon) and hull.area > 1e-9 else None
