"""Doors in the doorways of a home, which swing into a room if nothing obstructs them, or else slide into the wall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import heading_from_quat, quat_from_heading
from h3data.scene.articulation import posed
from h3data.scene.kinds import KINDS
from h3data.scene.records import Articulation, Instance, Joint, Room, Scene, instance_bounds
from h3data_homes.furnishing.furniture import box_part
from h3data_homes.furnishing.opening.placing import MovingPart, Opening, opening_assets, placed_opening
from h3data_homes.layout import DOOR_HEIGHT, WALL_THICKNESS, Layout, RoomPlan
from h3data_homes.layout import Opening as Doorway
from h3data_homes.solids import Color, MeshBuilder, shade
from h3data_homes.structure import plan_box, wall_runs
from h3data_homes.style import Style

THICK_M, GAP_M = 0.04, 0.012
"""Thickness of a door leaf, and width of the gap around it [m]."""
GRIP_M = 0.09
"""Width of a sliding leaf that stays out of the wall, so that a hand can pull it out again [m]."""
HANDLE_M = 1.02
"""Height of door handles above the floor [m]."""
WIDTH_M = (0.6, 1.2)
"""Least and greatest width of doorways that get a door [m]."""
BESIDE_M = 0.35
"""Least distance of an open door from other doorways [m]."""
SWING_RAD = np.pi / 2
ALONG_M = 0.3
"""Distance from a wall below which an open door stands along it [m]."""
SWINGS_M = (np.inf, ALONG_M, -1.0)
"""Greatest distances of open doors from a wall [m], tried in this order until a home has no faults."""
PRIVATE = ("bathroom", "bedroom", "child", "office", "laundry", "den", "library", "pantry")
"""Kinds of rooms into which doors preferably swing, the most private first."""
CLOSED: dict[str, float] = {"bathroom": 0.6, "bedroom": 0.5, "child": 0.4, "office": 0.4, "laundry": 0.6, "pantry": 0.7}
"""Probability that a door is closed, by kind of room; `OTHERS_CLOSED` for other kinds."""
OTHERS_CLOSED = 0.15
LEAF = "leaf"
"""Name of the moving part of a door."""
STRUCTURE = ("wall", "floor", "ceiling", "trim", "rug")
"""Parts of the structure through which an open door may pass."""
FLAT_M = 0.03
"""Greatest height of objects over which doors can swing [m]."""


@dataclass(frozen=True)
class _Place:
    """A doorway seen from one of its rooms, and the side on which the leaf is hinged or vanishes.

    The frame of the leaf has its origin on that side, on the face of the wall: +Z points into the room, and the leaf lies
    towards ``side`` times +X.
    """

    room: RoomPlan
    pose: NDArray[np.float64]
    side: int
    width: float
    height: float


def with_doors(scene: Scene, layout: Layout, style: Style, rng: np.random.Generator, *, swing_m: float) -> Scene:
    """Return the scene with an open door in each of its suitable doorways.

    A door swings if the open door is within ``swing_m`` [m] of a wall and nothing obstructs its motion; otherwise it
    slides. Wide doorways, and those next to walls that are too short to slide into, stay without a door.
    """
    boxes = _furniture(scene)
    swept: list[NDArray[np.float64]] = []
    assets, instances, things = dict(scene.assets), list(scene.instances), list(scene.articulations)
    doorways = [o for o in layout.openings if o.kind == "door" and WIDTH_M[0] <= o.span[1] - o.span[0] <= WIDTH_M[1]]
    for doorway in doorways:
        order = rng.permutation(2).tolist()
        places = [p for end in order for p in _places(layout, doorway, end)]
        color = style.trim if rng.random() < 0.6 else style.wood
        near = [p for p in _by_room(places) if _to_corner(p) <= swing_m]
        place = next((p for p in near if _swings(p, layout, doorway, [*boxes, *swept])), None)
        if place is not None:
            swept.append(_square(place))
            opening = _leaf(place, color, style.metal, slides=False)
        elif (place := next((p for p in places if _slides(p, layout, doorway)), None)) is not None:
            opening = _leaf(place, color, style.metal, slides=True)
        else:
            continue
        name = f"door_{len(things) - len(scene.articulations)}"
        assets |= opening_assets(opening, name)
        semantic_id = KINDS[opening.category].semantic_id
        body = Instance(name=name, asset=name, pose=place.pose, semantic_id=semantic_id)
        leaves, thing = placed_opening(opening, body)
        instances += [body, *leaves]
        things.append(thing)
    hung = replace(scene, assets=assets, instances=tuple(instances), articulations=tuple(things))
    return doors_open(hung)


def closed_by_chance(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the scene with some of its doors closed, most often those of private rooms."""
    closed = {}
    for name, thing in _doors(scene).items():
        near = sorted(scene.rooms, key=lambda room: _distance(room, thing.pose[:3]))[:2]
        if rng.random() < max(CLOSED.get(room.category, OTHERS_CLOSED) for room in near):
            closed[name] = thing.parts[0].joint.closed
    return posed(scene, closed)


def doors_open(scene: Scene) -> Scene:
    """Return the scene with all doors between rooms open."""
    return posed(scene, {name: thing.parts[0].joint.opened for name, thing in _doors(scene).items()})


def _doors(scene: Scene) -> dict[str, Articulation]:
    """Return the doors between rooms, by the names of their joints."""
    return {f"{t.name}/{t.parts[0].name}": t for t in scene.articulations if t.parts[0].name == LEAF}


def _distance(room: Room, point: NDArray[np.float64]) -> float:
    """Return the distance [m] of a point [3] from a room, far for one of another storey."""
    low, high = np.asarray(room.rectangles)[:, :2], np.asarray(room.rectangles)[:, 2:]
    off = np.maximum(np.maximum(low - point[[0, 2]], point[[0, 2]] - high), 0.0)
    return float(np.hypot(*off.T).min()) + 10.0 * abs(room.floor_y - float(point[1]))


# --- where a leaf goes --------------------------------------------------------------------------------------------------
def _places(layout: Layout, doorway: Doorway, end: int) -> list[_Place]:
    """Return the doorway with its hinge at one end, as both of its rooms see it."""
    found = []
    for name in doorway.rooms:
        room = layout.room(name)
        across = 1 - doorway.axis
        low = room.rect[across] == doorway.line
        face, inward = (room.interior[across], 1) if low else (room.interior[across + 2], -1)
        at = doorway.span[end]
        x, z = (at, face) if doorway.axis == 0 else (face, at)
        heading = {(0, 1): 0.0, (0, -1): np.pi, (1, 1): np.pi / 2, (1, -1): -np.pi / 2}[doorway.axis, inward]
        ahead = (np.cos(heading), -np.sin(heading))[doorway.axis]  # of the frame's +X along the wall
        into = 1 if end == 0 else -1
        pose = np.concatenate([[x, 0.0, z], quat_from_heading(heading)])
        side = 1 if ahead * into > 0 else -1
        found.append(_Place(room, pose, side, doorway.span[1] - doorway.span[0], doorway.height[1]))
    return found


def _by_room(places: Sequence[_Place]) -> list[_Place]:
    """Return private rooms first, then those where the leaf comes to stand along a wall."""
    return sorted(places, key=lambda p: (p.room.category not in PRIVATE, _to_corner(p) > ALONG_M))


def _to_corner(place: _Place) -> float:
    """Return the distance [m] from the hinge to the wall along which the leaf stands when it is open."""
    x0, z0, x1, z1 = _square(place)
    a0, b0, a1, b1 = place.room.interior
    hinge = place.pose[[0, 2]]
    gaps = (hinge[0] - a0, a1 - hinge[0]) if _along(place) == 0 else (hinge[1] - b0, b1 - hinge[1])
    opens_up = (x0 + x1) / 2 > hinge[0] if _along(place) == 0 else (z0 + z1) / 2 > hinge[1]
    return float(gaps[0] if opens_up else gaps[1])


def _along(place: _Place) -> int:
    """Return the plan axis along which the wall of a doorway runs."""
    return 0 if abs(_axes(place)[0][0]) > 0.5 else 1


def _axes(place: _Place) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the floor directions (x, z) of the leaf from its hinge, and into the room."""
    heading = float(heading_from_quat(place.pose[3:]))
    cos, sin = np.round([np.cos(heading), np.sin(heading)])
    return place.side * np.array([cos, -sin]), np.array([sin, cos])


def _square(place: _Place) -> NDArray[np.float64]:
    """Return the part of the room (x0, z0, x1, z1) through which a leaf swings [m]."""
    along, inward = _axes(place)
    corners = place.pose[[0, 2]] + np.array([np.zeros(2), along * place.width, inward * place.width])
    return np.concatenate([corners.min(0), corners.max(0)])


def _swings(place: _Place, layout: Layout, doorway: Doorway, taken: Sequence[NDArray[np.float64]]) -> bool:
    """Return whether a leaf swings into a room without meeting anything, and leave other doorways free when it is open."""
    square, (a0, b0, a1, b1) = _square(place), place.room.interior
    if square[0] < a0 - 1e-6 or square[1] < b0 - 1e-6 or square[2] > a1 + 1e-6 or square[3] > b1 + 1e-6:
        return False
    if any(_meet(square, box) for box in taken):
        return False
    for other in layout.openings:
        if other is not doorway and other.height[0] == 0 and place.room.name in other.rooms:
            x0, z0, x1, z1 = plan_box(other.axis, other.span, (other.line - BESIDE_M, other.line + BESIDE_M))
            if _meet(square, np.array([x0, z0, x1, z1])):
                return False
    return True


def _slides(place: _Place, layout: Layout, doorway: Doorway) -> bool:
    """Return whether the wall on the side of the hinge is long enough to slide into, and without another opening there."""
    along = _axes(place)[0][doorway.axis]
    low, high = doorway.span
    pocket = (low - place.width, low) if along > 0 else (high, high + place.width)
    inside = any(
        axis == doorway.axis and abs(line - doorway.line) < 1e-9 and run[0] <= pocket[0] and pocket[1] <= run[1]
        for axis, line, run, _ in wall_runs(layout)
    )
    cuts = [o for o in layout.openings if o.axis == doorway.axis and abs(o.line - doorway.line) < 1e-9]
    return inside and all(o.span[1] <= pocket[0] or o.span[0] >= pocket[1] for o in cuts if o is not doorway)


def _meet(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    return bool(a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3])


def _furniture(scene: Scene) -> list[NDArray[np.float64]]:
    """Plan rectangles (x0, z0, x1, z1) of what stands or hangs where leaves swing."""
    found = []
    for instance in scene.instances:
        if scene.assets[instance.asset].category in STRUCTURE or instance.layer:
            continue
        low, high = instance_bounds(scene, instance)
        if low[1] < DOOR_HEIGHT and high[1] > FLAT_M:
            found.append(np.array([low[0], low[2], high[0], high[2]]))
    return found


# --- the leaf -----------------------------------------------------------------------------------------------------------
def _leaf(place: _Place, color: Color, metal: Color, *, slides: bool) -> Opening:
    """Return a leaf with its fittings, in the frame of its place."""
    side, width = place.side, place.width
    across = -(WALL_THICKNESS + THICK_M) / 2 if slides else -THICK_M
    ends = (GAP_M, width - GAP_M)
    x0, x1 = sorted(side * v for v in ends)
    y, z = (GAP_M, place.height - GAP_M), (across, across + THICK_M)
    mesh = MeshBuilder()
    mesh.span((x0, y[0], z[0]), (x1, y[1], z[1]), color, bevel=0.003)
    for low, high in ((0.16, 0.86), (1.16, place.height - 0.16)):
        for face, out in ((z[0], -1), (z[1], 1)):
            a, b = sorted((face - out * 0.004, face + out * 0.006))
            mesh.span((x0 + 0.13, low, a), (x1 - 0.13, high, b), shade(color, 1.04), bevel=0.004)
    grip = side * (width - 0.06)
    for face, out in ((z[0], -1), (z[1], 1)):
        if slides:  # a flat grip, which goes into the wall
            a, b = sorted((face, face + out * 0.004))
            mesh.span((grip - 0.02, HANDLE_M - 0.09, a), (grip + 0.02, HANDLE_M + 0.09, b), metal)
        else:
            a, b = sorted((face, face + out * 0.05))
            mesh.span((grip - 0.01, HANDLE_M - 0.01, a), (grip + 0.01, HANDLE_M + 0.01, b), metal)
            lever = sorted((grip, grip - side * 0.12))
            a, b = sorted((face + out * 0.04, face + out * 0.056))
            mesh.span((lever[0], HANDLE_M - 0.01, a), (lever[1], HANDLE_M + 0.01, b), metal, bevel=0.003)
    if slides:
        joint = Joint(kind="prismatic", axis=np.array([-side, 0.0, 0.0]), lower=0.0, upper=width - GRIP_M)
    else:
        joint = Joint(kind="revolute", axis=np.array([0.0, -side, 0.0]), lower=0.0, upper=SWING_RAD)
        joint = replace(joint, origin=np.array([side * GAP_M, 0.0, 0.0]))
    part = MovingPart(
        name=LEAF,
        builder=mesh,
        shapes=(box_part(((x0 + x1) / 2, sum(y) / 2, sum(z) / 2), (x1 - x0, y[1] - y[0], THICK_M)),),
        joint=joint,
        handle=np.array([grip, HANDLE_M, sum(z) / 2]),
    )
    fittings = MeshBuilder()
    for height in (0.25, place.height / 2, place.height - 0.25):
        a, b = sorted((0.0, side * 0.006))
        fittings.span((a, height - 0.05, -WALL_THICKNESS / 2 - 0.015), (b, height + 0.05, 0.0), metal)
    return Opening(kind="door", category="door", builder=fittings, shapes=(), receptacles=(), parts=(part,))
