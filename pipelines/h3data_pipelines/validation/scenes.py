"""Detection of scene faults that affect agents, such as tight passages, floating objects and cut-off floor.

Overlapping objects are detected in `h3data_pipelines.validation.overlaps`, which needs FCL.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from h3data.geometry import transform_points
from h3data.scene.freespace.free_space import FreeSpace
from h3data.scene.records import Asset, Hull, Instance, Scene, instance_bounds, instance_matrix

Kind = Literal[
    "missing_asset",
    "no_floor",
    "unreachable_room",
    "island",
    "tight_gap",
    "overlap",
    "floating",
    "sunk",
    "out_of_reach",
]

GAP_BELOW_M, GAP_ABOVE_M = 0.05, 0.10
"""Bounds of passage widths relative to the agent's diameter 2 r, -5 cm and +10 cm, between which rounding decides
whether a passage is open (research/navigation-and-stepping.md 6).
"""
REACH_M = 1.1
"""Largest distance in the floor plane from standing room to the centre of a receptacle, as in the home generator
[m].
"""
ISLAND_MIN_M2 = 0.05
"""Area below which patches of free floor are ignored, such as leftover corners between objects [m2]."""
ROOM_MIN_M2 = 0.1
"""Area of walkable floor below which a room counts as impossible to enter [m2]."""
FLOAT_M, SINK_M = 0.02, 0.01
"""Distance below an object within which something must support it, otherwise it floats, and height of a surface above
the object's underside from which the object counts as sunk [m].
"""
CLIMB_M = 0.2
"""Height up to which agents step over objects [m]."""
FURNITURE_MAX_M2 = 6.0
"""Footprint above which static instances are whole rooms, not furniture [m2]."""
TOUCH_M = 0.05
"""Distance from the rim of an agent's disc within which an object counts as the obstacle that stops the agent [m]."""
_SLACK_M = 0.004
"""Rounding of buffered polygons."""
_HULL_SHARE = 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Fault of a scene."""

    kind: Kind
    subject: str
    """Name of the room, instance or receptacle, or two names joined by " / "."""
    text: str
    """Description of the fault, with numbers."""
    position: NDArray[np.float64] | None = None
    """Position in the world, shape [3] [m]; None for faults without a position (a missing file)."""


def free_space_for_validation(scene: Scene, *, radius_m: float = 0.25, height_m: float = 1.41) -> FreeSpace:
    """Return the free space for a disc smaller by half of `GAP_BELOW_M`, in which tight passages are open."""
    return FreeSpace.from_scene(scene, radius_m=radius_m - GAP_BELOW_M / 2, height_m=height_m)


def find_problems(scene: Scene, loose: FreeSpace, *, radius_m: float = 0.25) -> list[Problem]:
    """Find faults of a scene's floor, its receptacles and the objects on them, in that order.

    Args:
        scene: The scene.
        loose: Free space of the scene from `free_space_for_validation`.
        radius_m: Radius of the agent [m].
    """
    free = shapely.MultiPolygon(loose.polygon).buffer(-GAP_BELOW_M / 2)
    islands = sorted((p for p in shapely.get_parts(free) if p.area >= ISLAND_MIN_M2), key=lambda p: -p.area)
    floor = loose.floor_y
    main = islands[0] if islands else shapely.Polygon()
    on_floor = [
        *_islands(scene, islands, loose, radius_m),
        *_rooms(scene, main, loose),
        *tight_gaps(loose.polygon, floor, radius_m=radius_m),
    ]
    for problem in on_floor:
        if problem.position is not None:
            problem.position[1] = loose.height_at(problem.position[[0, 2]])
    return [*on_floor, *_receptacles(scene, main), *_resting(scene, loose)]


def _islands(scene: Scene, islands: Sequence[BaseGeometry], loose: FreeSpace, radius_m: float) -> Iterable[Problem]:
    for k, island in enumerate(islands[1:], 1):
        point = island.representative_point()
        floor = float(loose.height_at([point.x, point.y]))
        between = _standing_between(scene, islands[0], island, floor, radius_m)
        text = f"{island.area:.2f} m2 of free floor are cut off from the largest island ({islands[0].area:.2f} m2)"
        if between:
            text += f"; between them: {', '.join(between)}"
        position = np.array([point.x, floor, point.y])
        yield Problem(kind="island", subject=f"island {k}", text=text, position=position)


def _standing_between(
    scene: Scene, first: BaseGeometry, second: BaseGeometry, floor: float, radius_m: float
) -> list[str]:
    """Return names of static furniture that an agent touches from both of two islands."""
    names = []
    for instance in scene.static_instances:
        if not len(scene.assets[instance.asset].mesh.vertices) or scene.assets[instance.asset].category == "wall":
            continue
        low, high = instance_bounds(scene, instance)
        foot = shapely.box(low[0], low[2], high[0], high[2])
        around = foot.buffer(radius_m + TOUCH_M)
        obstructs = low[1] < floor + 1.0 and high[1] > floor + CLIMB_M
        if obstructs and foot.area < FURNITURE_MAX_M2 and around.intersects(first) and around.intersects(second):
            names.append(instance.name)
    return names


def _rooms(scene: Scene, main: BaseGeometry, loose: FreeSpace) -> Iterable[Problem]:
    floor = loose.floor_y
    for room in scene.rooms:
        if not len(loose.heights) and abs(room.floor_y - floor) > 0.5:
            continue  # another storey, which this free space does not cover
        area = shapely.union_all([shapely.box(*r) for r in np.asarray(room.rectangles, np.float64)])
        inside = main.intersection(area).area
        if inside < ROOM_MIN_M2:
            yield Problem(
                kind="unreachable_room",
                subject=room.name,
                text=f"{inside:.2f} of its {area.area:.2f} m2 are reachable",
                position=np.array([area.centroid.x, floor, area.centroid.y]),
            )


def tight_gaps(loose: BaseGeometry, floor: float, *, radius_m: float) -> list[Problem]:
    """Find passages between 2 r - 5 cm and 2 r + 10 cm wide, which may be open for one agent and closed for another.

    ``loose`` is the free area for a disc of r - 2.5 cm. A tight passage is a part of it that the wider disc (r + 5 cm)
    cannot enter, while the places on both sides are free for that disc. Niches with one entrance do not count.
    """
    shrink = (GAP_BELOW_M + GAP_ABOVE_M) / 2
    wide = loose.buffer(-shrink)
    reached = wide.buffer(shrink + _SLACK_M)
    problems = []
    for neck in shapely.get_parts(loose.difference(reached)):
        mouths = shapely.get_parts(neck.buffer(2 * _SLACK_M).intersection(reached))
        if sum(m.area > 1e-6 for m in mouths) < 2:
            continue
        point = neck.representative_point()
        width = 2 * (radius_m - GAP_BELOW_M / 2 + _narrowest(loose, neck, shrink))
        problems.append(
            Problem(
                kind="tight_gap",
                subject=f"({point.x:.2f}, {point.y:.2f})",
                text=f"a passage {width:.2f} m wide, close to the agent's {2 * radius_m:.2f} m",
                position=np.array([point.x, floor, point.y]),
            )
        )
    return problems


def _narrowest(loose: BaseGeometry, neck: BaseGeometry, most: float) -> float:
    """Return growth of the disc's radius at which it no longer passes a neck [m], to within 2 mm; at most ``most``."""
    around = loose.intersection(neck.buffer(0.3))
    before = len([p for p in shapely.get_parts(around) if p.intersects(neck)])
    low, high = 0.0, most
    while high - low > 0.002:
        middle = (low + high) / 2
        parts = [p for p in shapely.get_parts(around.buffer(-middle, join_style="mitre")) if p.area > 1e-4]
        low, high = (middle, high) if len(parts) <= before else (low, middle)
    return low


def _receptacles(scene: Scene, main: BaseGeometry) -> Iterable[Problem]:
    for instance, receptacle in scene.receptacles():
        center = transform_points(instance_matrix(instance), np.asarray(receptacle.center, np.float64)[None])[0]
        distance = main.distance(shapely.Point(center[0], center[2])) if not main.is_empty else np.inf
        if distance > REACH_M:
            yield Problem(
                kind="out_of_reach",
                subject=f"{instance.name}|{receptacle.name}",
                text=f"its centre is {distance:.2f} m from standing room (reach {REACH_M} m)",
                position=center,
            )


def hull_fills_hollows(asset: Asset) -> bool:
    """Return whether the single collision hull of an asset fills hollows of its mesh, so that overlaps may not be real.

    This is the case if less than `_HULL_SHARE` of the mesh's surface lies within 1 cm of the hull.
    """
    from scipy.spatial import ConvexHull, QhullError

    if len(asset.shapes) != 1 or not isinstance(asset.shapes[0], Hull):
        return False
    try:
        planes = ConvexHull(asset.shapes[0].points).equations
    except (QhullError, ValueError):
        return False
    corners = asset.mesh.vertices.astype(np.float64)[asset.mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    inside = np.concatenate([c @ planes[:, :3].T + planes[:, 3] for c in np.array_split(corners.mean(1), 64)]).max(1)
    return float(area[inside > -0.01].sum()) < _HULL_SHARE * float(area.sum())


# --- objects that do not rest on anything -----------------------------------------------------------------------------
def _resting(scene: Scene, loose: FreeSpace) -> Iterable[Problem]:
    """Yield findings about kinematic objects without support, or partly below the surface of their receptacle."""
    movable = [i for i in scene.instances if i.motion == "kinematic" and len(scene.assets[i.asset].mesh.vertices)]
    if not movable:
        return
    boxes = [instance_bounds(scene, i) for i in scene.instances]
    surfaces = [(instance_matrix(i), i, r) for i, r in scene.receptacles()]
    for thing in movable:
        matrix = instance_matrix(thing)
        points = transform_points(matrix, scene.assets[thing.asset].mesh.vertices.astype(np.float64))
        low, high = points.min(0), points.max(0)
        middle = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
        sunk = _sunk(surfaces, thing, middle, float(high[1]))
        if sunk is not None:
            depth, name = sunk
            text = f"its underside is {100 * depth:.1f} cm below the surface of {name}"
            yield Problem(kind="sunk", subject=thing.name, text=text, position=middle)
            continue
        gap = float(low[1] - _support(scene, boxes, thing, points, low))
        above_floor = float(low[1] - loose.height_at(middle[[0, 2]]))
        if -SINK_M > above_floor > -0.5 and gap > FLOAT_M:
            text = f"its underside is {-100 * above_floor:.1f} cm below the floor"
            yield Problem(kind="sunk", subject=thing.name, text=text, position=middle)
        elif gap > FLOAT_M:
            text = f"the next surface below is {100 * gap:.1f} cm away" if np.isfinite(gap) else "nothing is below it"
            yield Problem(kind="floating", subject=thing.name, text=text, position=middle)


def _sunk(surfaces: Sequence, thing: Instance, foot: NDArray[np.float64], top: float) -> tuple[float, str] | None:
    """Return the height of a receptacle's surface above the foot of an object on it, and the receptacle's name."""
    for matrix, owner, receptacle in surfaces:
        local = np.linalg.solve(matrix[:3, :3], foot - matrix[:3, 3]) - receptacle.center
        level = (matrix[:3, :3] @ receptacle.center + matrix[:3, 3])[1]
        inside = abs(local[0]) <= receptacle.half_size[0] and abs(local[2]) <= receptacle.half_size[1]
        if owner.name != thing.name and inside and foot[1] + SINK_M < level < top:
            return float(level - foot[1]), f"{owner.name}|{receptacle.name}"
    return None


def _support(
    scene: Scene, boxes: Sequence[NDArray[np.float64]], thing: Instance, points: NDArray, low: NDArray
) -> float:
    """Return the height of the highest surface below an object [m]; -inf if there is none.

    Probed straight below the middle of the footprint and a ring of points on it.
    """
    high = points.max(0)
    foot = points[points[:, 1] < low[1] + 0.02]
    ring = foot[:: max(1, len(foot) // 12)][:, [0, 2]]
    middle = np.array([[(low[0] + high[0]) / 2, (low[2] + high[2]) / 2]])
    below = np.concatenate([middle, middle + 0.8 * (ring - middle)])
    best = -np.inf
    for other, box in zip(scene.instances, boxes, strict=True):
        apart = (box[0] > high).any() or box[1][0] < low[0] or box[1][2] < low[2]
        if other.name == thing.name or apart or box[1][1] < best:
            continue
        mesh = scene.assets[other.asset].mesh
        triangles = transform_points(instance_matrix(other), mesh.vertices.astype(np.float64))[mesh.faces]
        best = max(best, _height_below(triangles, below, float(low[1]) + SINK_M))
    return best


def _height_below(triangles: NDArray, points: NDArray, level: float) -> float:
    """Return the greatest height up to ``level`` at which verticals at points [N, 2] (x, z) hit triangles [F, 3, 3]."""
    flat = triangles[..., [0, 2]]
    near = (flat.min(1) <= points.max(0)).all(1) & (flat.max(1) >= points.min(0)).all(1)
    near &= triangles[..., 1].min(1) <= level
    triangles, flat = triangles[near], flat[near]
    u, v = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    keep = np.abs(area) > 1e-12
    triangles, flat, u, v, area = (x[keep] for x in (triangles, flat, u, v, area))
    best = -np.inf
    for point in points:
        d = point - flat[:, 0]
        s = (d[:, 0] * v[:, 1] - d[:, 1] * v[:, 0]) / area
        t = (u[:, 0] * d[:, 1] - u[:, 1] * d[:, 0]) / area
        inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
        y = (
            triangles[:, 0, 1]
            + s * (triangles[:, 1, 1] - triangles[:, 0, 1])
            + t * (triangles[:, 2, 1] - triangles[:, 0, 1])
        )
        hits = y[inside & (y <= level)]
        best = max(best, float(hits.max(initial=-np.inf)))
    return best
