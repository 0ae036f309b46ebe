"""Acceptance test of a home by its collision shapes: agents must be able to reach every room and receptacle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from h3data.geometry import add_up, transform_points
from h3data.scene.records import Scene, instance_matrix
from h3data_homes.furnishing.furniture import HEAD_BAND
from h3data_homes.furnishing.place import CRUMB_M2, WALK_RADIUS, pockets, reach_m, used_from_front

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_HAND_M = 1.1
"""Greatest distance from the centre of a receptacle to walkable floor [m]."""
_HANGS_M = 1.2
"""Height of the lowest shape of furniture above which agents need not be able to walk up to it [m]."""
_REACH_SLACK = 0.01
"""Error of the polygons that stand for circles [m]."""


def open_floor(scene: Scene) -> BaseGeometry:
    """Return the floor of all rooms without obstacles as a (multi)polygon in (x, z) [m], not shrunk by any radius."""
    import shapely

    from h3data.scene.freespace._footprints import scene_obstacles

    floor = shapely.union_all([shapely.box(*r) for room in scene.rooms for r in room.rectangles])
    return floor.difference(shapely.union_all(scene_obstacles(scene, *HEAD_BAND)))


def walkable_area(scene: Scene, radius: float = WALK_RADIUS) -> BaseGeometry:
    """Return the positions that the centre of a disc can take on the floor, as a (multi)polygon in (x, z) [m]."""
    return open_floor(scene).buffer(-radius, quad_segs=8)


def use_edges(scene: Scene) -> tuple[list[str], list[BaseGeometry], list[float]]:
    """Return furniture with receptacles: its names, the edges from which it is used, and their distances [m]."""
    import shapely

    from h3data.scene.freespace._footprints import shape_footprint

    names, edges, near = [], [], []
    for instance in scene.static_instances:
        asset = scene.assets[instance.asset]
        if not asset.receptacles or instance.pose[1] > 0:
            continue
        if not any(shape_footprint(s, np.eye(4), HEAD_BAND[0], _HANGS_M) for s in asset.shapes):
            continue  # it hangs over a counter
        hulls = [shape_footprint(s, np.eye(4), *HEAD_BAND) for s in asset.shapes]
        x0, z0, x1, z1 = shapely.total_bounds([h for h in hulls if h is not None]).tolist()
        front = [(x0, z1), (x1, z1)]
        corners = front if used_from_front(asset.category) else [*front, (x1, z0), (x0, z0), (x0, z1)]
        world = transform_points(instance_matrix(instance), np.array([(x, 0.0, z) for x, z in corners]))
        names.append(instance.name)
        edges.append(shapely.LineString(world[:, [0, 2]]))
        near.append(reach_m(asset.category) + _REACH_SLACK)
    return names, edges, near


def faults(scene: Scene) -> list[str]:
    """Return descriptions of rooms and furniture that cannot be reached, and of gaps of ambiguous width.

    Reachable means for a walker of radius `WALK_RADIUS`.
    """
    import shapely

    floor = open_floor(scene)
    parts = shapely.get_parts(floor.buffer(-WALK_RADIUS, quad_segs=8))
    if not len(parts):
        return ["there is no room to stand anywhere"]
    main = max(parts, key=lambda part: part.area)
    problems = []
    total = add_up(part.area for part in parts)
    if total - main.area > CRUMB_M2:
        problems.append(f"{total - main.area:.3f} m2 of walkable floor are cut off")
    for room in scene.rooms:
        area = shapely.union_all([shapely.box(*r) for r in room.rectangles])
        if main.intersection(area).area < 0.1 * area.area:
            problems.append(f"{room.name} cannot be entered")
    names, edges, limits = use_edges(scene)
    distances = shapely.distance(main, edges)
    for name, distance, limit in zip(names, distances.tolist(), limits, strict=True):
        if distance > limit:
            problems.append(f"the front of {name} is {distance:.2f} m away from walkable floor")
    surfaces = list(scene.receptacles())
    if surfaces:
        middles = [transform_points(instance_matrix(i), receptacle.center[None])[0] for i, receptacle in surfaces]
        far = shapely.distance(main, shapely.points(np.array(middles)[:, [0, 2]])) > _HAND_M
        problems += [f"{surfaces[k][0].name}|{surfaces[k][1].name} is out of reach" for k in np.flatnonzero(far)]
    for pocket in pockets(floor, main):
        point = pocket.representative_point()
        problems.append(f"a tight gap of {pocket.area:.3f} m2 at ({point.x:.2f}, {point.y:.2f})")
    return problems
