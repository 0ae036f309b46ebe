"""The last word on a home, from its collision shapes alone: everybody can walk everywhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import quat_rotate
from h3data.scene.homes.place import WALK_RADIUS
from h3data.scene.records import Box, Capsule, Hull, Scene, Shape, instance_matrix

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_BAND = (0.05, 1.8)
"""Heights that stand in a walker's way [m]."""
_CRUMB = 0.01
"""Cut-off floor below this is rounding [m2]."""
_CIRCLE = np.linspace(0, 2 * np.pi, 17)[:-1]


def _corners(shape: Shape) -> NDArray[np.float64]:
    """Points [N, 3] whose convex hull is the shape (circles: 16 corners just outside), in the asset frame."""
    if isinstance(shape, Hull):
        return shape.points
    if isinstance(shape, Capsule):
        offsets = shape.radius * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return np.concatenate([shape.start + offsets, shape.end + offsets])
    if isinstance(shape, Box):
        local = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * shape.half_extents
    else:
        r, h = shape.radius / np.cos(np.pi / 16), shape.half_height
        ring = np.stack([r * np.sin(_CIRCLE), np.zeros(16), r * np.cos(_CIRCLE)], 1)
        local = np.concatenate([ring - np.array([0, h, 0]), ring + np.array([0, h, 0])])
    return quat_rotate(shape.pose[3:], local) + shape.pose[:3]


def obstacle_polygons(scene: Scene) -> list[BaseGeometry]:
    """Plan polygons (x, z) of all static collision shapes between ankle and head."""
    import shapely

    out = []
    for instance in scene.static_instances:
        matrix = instance_matrix(instance)
        for shape in scene.assets[instance.asset].shapes:
            points = _corners(shape) @ matrix[:3, :3].T + matrix[:3, 3]
            if points[:, 1].max() > _BAND[0] and points[:, 1].min() < _BAND[1]:
                out.append(shapely.convex_hull(shapely.multipoints(points[:, [0, 2]])))
    return out


def walkable_area(scene: Scene, radius: float = WALK_RADIUS) -> BaseGeometry:
    """Where the middle of a disc can be on the floor of all rooms, as a (multi)polygon in (x, z)."""
    import shapely

    floor = shapely.union_all([shapely.box(*r) for room in scene.rooms for r in room.rectangles])
    return floor.difference(shapely.union_all(obstacle_polygons(scene))).buffer(-radius, quad_segs=8)


def faults(scene: Scene) -> list[str]:
    """What keeps a walker of `WALK_RADIUS` from rooms or furniture; empty if all is well."""
    import shapely

    parts = shapely.get_parts(walkable_area(scene))
    if not len(parts):
        return ["nobody can stand anywhere"]
    main = max(parts, key=lambda part: part.area)
    found = []
    total = sum(part.area for part in parts)
    if total - main.area > _CRUMB:
        found.append(f"{total - main.area:.3f} m2 of walkable floor are cut off")
    for room in scene.rooms:
        floor = shapely.union_all([shapely.box(*r) for r in room.rectangles])
        if main.intersection(floor).area < 0.1 * floor.area:
            found.append(f"{room.name} cannot be entered")
    for instance, receptacle in scene.receptacles():
        matrix = instance_matrix(instance)
        x, _, z = matrix[:3, :3] @ receptacle.center + matrix[:3, 3]
        if main.distance(shapely.Point(x, z)) > 1.1:
            found.append(f"{instance.name}|{receptacle.name} is out of reach")
    return found
