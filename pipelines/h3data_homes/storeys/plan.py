"""Plan of a home with two storeys: the positions of the stairwell and of the upper storey next to the ground floor.

Both storeys are plans of `h3data_homes.layout`. The ground floor keeps its place, the stairwell adjoins its wall at x =
width, and the upper storey lies beyond, so that no two of them share any floor: `h3data.scene.floor_heights` gives the
reason.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from h3data.errors import SceneError
from h3data.scene.records import Ramp
from h3data_homes.layout import (
    DOOR_HEIGHT,
    NEED_LIGHT,
    WALL_THICKNESS,
    Layout,
    Opening,
    RoomPlan,
    interior_of,
    outer_walls,
    plan_layout,
)
from h3data_homes.spec import HomeSpec
from h3data_homes.zoning import Rect, rounded

RISE_M, GOING_M, RISERS = 0.17, 0.28, 16
STOREY_M = RISE_M * RISERS
"""Height from the ground floor to the upper floor [m]."""
RUN_M = GOING_M * RISERS
WELL_WIDTH_M = 1.25
"""Width between the walls of the stairwell [m]; the handrails leave 1.1 m."""
LANDING_M = 1.35
"""Depth of the landings at both ends of the stairs [m]."""
PASSAGE_M = 1.0
"""Width of the doorways to the stairwell [m]."""
_STRETCH_M = 1.24
"""Least length of a wall for a doorway to a stairwell [m]."""
_UPSTAIRS: Mapping[str, str] = {"living": "den", "kitchen": "library", "garage": "office"}
"""Kinds of rooms upstairs in the places of some kinds of rooms of a plan."""
_DARK_ROOM, _THROUGH_ROOM = 10.0, 1.5
"""Penalties, beside 1 for each window lost: for a room that needs light and loses its last window, and for a doorway from
another room than a hall."""


@dataclass(frozen=True, kw_only=True)
class Well:
    """Straight stairwell along z between two storeys."""

    rect: Rect
    """Rectangle of floor between the walls of the stairwell, including landings [m]."""
    ramp: Ramp
    doors: tuple[tuple[float, float], tuple[float, float]]
    """Spans of the doorways along z [m]: to the ground floor at the lower x, and to the upper storey at the higher x."""


@dataclass(frozen=True, kw_only=True)
class StoreyPlan:
    """Plans of both storeys and of the stairs between them; the ground floor is at (0, 0)."""

    ground: Layout
    upper: Layout
    offset: tuple[float, float]
    """Position of the upper plan's corner (0, 0) in the home (x, z) [m]."""
    well: Well


def upper_seed(seed: int) -> int:
    """Return the seed of the upper storey's plan."""
    return int.from_bytes(hashlib.sha256(f"h3data.homes/upper/{int(seed)}".encode()).digest()[:4], "little")


def plan_storeys(ground: HomeSpec, upper: HomeSpec, attempt: int) -> StoreyPlan:
    """Return the plan of a home with two storeys; each ``attempt`` uses different random numbers.

    Raises:
        SceneError: no acceptable plan was found, or one of the plans has no wall with room for the stairwell.
    """
    below, low_door = _turned_to_well(plan_layout(ground, attempt), high=True)
    above, high_door = _turned_to_well(_upstairs(plan_layout(upper, attempt)), high=False)
    return min((_joined(below, low_door, above, high_door, sign) for sign in (1, -1)), key=_depth)


def _depth(plan: StoreyPlan) -> float:
    z = (
        0.0,
        plan.ground.depth,
        plan.offset[1],
        plan.offset[1] + plan.upper.depth,
        plan.well.rect[1],
        plan.well.rect[3],
    )
    return max(z) - min(z)


def _joined(
    below: Layout, low_door: tuple[str, float], above: Layout, high_door: tuple[str, float], sign: int
) -> StoreyPlan:
    """Return both plans with a stairwell that rises towards higher (``sign`` 1) or lower z."""
    middle = low_door[1]
    start = round(middle + sign * LANDING_M / 2, 3)
    end = round(start + sign * RUN_M, 3)
    top = round(end + sign * LANDING_M / 2, 3)
    near = below.width + WALL_THICKNESS
    low, high = sorted((middle - sign * LANDING_M / 2, top + sign * LANDING_M / 2))
    rect = tuple(round(v, 3) for v in (near, low, near + WELL_WIDTH_M, high))
    offset = (round(rect[2] + WALL_THICKNESS, 3), round(top - high_door[1], 3))
    half = PASSAGE_M / 2
    return StoreyPlan(
        ground=_with_passage(below, low_door, below.width, (rect[1], rect[3])),
        upper=_with_passage(above, high_door, 0.0, (rect[1] - offset[1], rect[3] - offset[1])),
        offset=offset,
        well=Well(
            rect=(rect[0], rect[1], rect[2], rect[3]),
            ramp=Ramp(axis=1, start=start, end=end, top_y=STOREY_M, steps=RISERS),
            doors=((middle - half, middle + half), (top - half, top + half)),
        ),
    )


def _with_passage(layout: Layout, door: tuple[str, float], line: float, covered: tuple[float, float]) -> Layout:
    """Return a plan with a doorway to the stairwell in the wall at x = ``line``, without windows behind it."""
    room, middle = door
    kept = [
        o
        for o in layout.openings
        if not (_is_on(o, line) and o.span[1] > covered[0] - WALL_THICKNESS and o.span[0] < covered[1] + WALL_THICKNESS)
    ]
    passage = Opening(
        kind="passage",
        axis=1,
        line=line,
        span=(round(middle - PASSAGE_M / 2, 3), round(middle + PASSAGE_M / 2, 3)),
        height=(0.0, DOOR_HEIGHT),
        rooms=(room,),
    )
    return replace(layout, openings=(*kept, passage))


def _is_on(opening: Opening, line: float) -> bool:
    return opening.axis == 1 and len(opening.rooms) == 1 and abs(opening.line - line) < 1e-9


def _upstairs(layout: Layout) -> Layout:
    """Return the plan with the rooms of an upper storey, and no door to the street."""
    kinds = [_UPSTAIRS.get(r.category, r.category) for r in layout.rooms]
    count: dict[str, int] = {}
    names = {}
    for room, kind in zip(layout.rooms, kinds, strict=True):
        count[kind] = count.get(kind, 0) + 1
        names[room.name] = f"upper_{kind}_{count[kind]}" if kinds.count(kind) > 1 else f"upper_{kind}"
    rooms = tuple(replace(r, name=names[r.name], category=k) for r, k in zip(layout.rooms, kinds, strict=True))
    openings = (o for o in layout.openings if o.kind not in ("entrance", "gate"))
    return replace(
        layout, rooms=rooms, openings=tuple(replace(o, rooms=tuple(names[r] for r in o.rooms)) for o in openings)
    )


def _turned_to_well(layout: Layout, *, high: bool) -> tuple[Layout, tuple[str, float]]:
    """Plan turned and mirrored so that its best wall for the doorway is at x = width (``high``) or x = 0.

    Also returns the doorway: (room, middle in z).

    Raises:
        SceneError: no wall has room for the stairwell.
    """
    found = []
    for swap in (False, True):
        for flip in (False, True):
            plan = _turned(layout, swap=swap, flip=flip)
            line = plan.width if high else 0.0
            found += [(penalty, plan, door) for penalty, door in _doors(plan, line)]
    if not found:
        raise SceneError("No outer wall of a hall or living room has room for the stairwell.", code="H3-SCENE-035")
    _, plan, door = min(found, key=lambda option: option[0])
    return plan, door


def _doors(layout: Layout, line: float) -> list[tuple[float, tuple[str, float]]]:
    """Return the doorways that the wall at x = ``line`` has room for, each with its penalty."""
    on_wall = [o for o in layout.openings if _is_on(o, line)]
    if any(o.kind != "window" for o in on_wall):  # a front door, a garage or a balcony would be walled up
        return []
    lost = {room for o in on_wall for room in o.rooms}
    lit = {room for o in layout.openings if o not in on_wall and o.kind in ("window", "parapet") for room in o.rooms}
    dark = [r for r in layout.rooms if r.category in NEED_LIGHT and r.name in lost - lit]
    penalty = len(on_wall) + _DARK_ROOM * len(dark)
    return [
        (penalty + (0.0 if room.category == "hall" else _THROUGH_ROOM), (room.name, middle))
        for room in layout.rooms
        if room.category in ("hall", "living", "den")
        for middle in _places(room, layout.rooms, line)
    ]


def _places(room: RoomPlan, rooms: Sequence[RoomPlan], line: float) -> list[float]:
    """Return middles of doorways in a room's outer wall at x = ``line``, at an end of a long wall to leave room."""
    places = []
    for wall in outer_walls(room, rooms):
        if wall.axis == 1 and abs(wall.line - line) < 1e-9 and wall.high - wall.low >= _STRETCH_M:
            inset = min(0.75, (wall.high - wall.low) / 2)
            places += [round(wall.low + inset, 3), round(wall.high - inset, 3)]
    return places


def _turned(layout: Layout, *, swap: bool, flip: bool) -> Layout:
    """Return the plan with its axes swapped, then mirrored in x."""
    width, depth = (layout.depth, layout.width) if swap else (layout.width, layout.depth)

    def rect(r: Rect) -> Rect:
        x0, z0, x1, z1 = (r[1], r[0], r[3], r[2]) if swap else r
        return rounded((width - x1, z0, width - x0, z1) if flip else (x0, z0, x1, z1))

    def opening(o: Opening) -> Opening:
        axis = 1 - o.axis if swap else o.axis
        line, span = o.line, o.span
        if flip and axis == 1:
            line = round(width - line, 2)
        if flip and axis == 0:
            span = (round(width - span[1], 3), round(width - span[0], 3))
        return replace(o, axis=axis, line=line, span=span)

    rooms = []
    for r in layout.rooms:
        place = rect(r.rect)
        rooms.append(replace(r, rect=place, interior=interior_of(place, width, depth)))
    return replace(
        layout,
        width=width,
        depth=depth,
        rooms=tuple(rooms),
        openings=tuple(opening(o) for o in layout.openings),
        notches=tuple(rect(n) for n in layout.notches),
    )
