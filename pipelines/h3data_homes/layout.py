"""Plan of a home: rooms that tile its footprint, doors by rules for pairs of room types, and windows.

Plan coordinates are floor points (x, z) of the world [m]. Rooms extend to the middle of inner walls and to the inner
face of outer walls, so that their areas add up to the area of the home. Algorithm: research/navigation-and-stepping.md
6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from h3data.errors import SceneError
from h3data_homes.spec import HomeSpec, stage_rng
from h3data_homes.zoning import Rect, Tile, Zoning, plan_zoning, rect_area, rounded, shared_wall
from h3data_homes.zoning_large import LARGE_FROM_BEDROOMS, LARGE_FROM_M2, plan_large_zoning

WALL_THICKNESS = 0.12
WALL_HEIGHT = 2.6
DOOR_HEIGHT = 2.1


@dataclass(frozen=True, kw_only=True)
class RoomPlan:
    """Room in the plan of a home."""

    name: str
    category: str
    rect: Rect
    """Rectangle up to the middle of inner walls and to the inner face of outer walls [m]."""
    interior: Rect
    """Rectangle of floor between the wall faces [m]."""

    @property
    def area(self) -> float:
        """Area of the room [m^2]."""
        return rect_area(self.rect)


OpeningKind = Literal["door", "wide", "window", "entrance", "gate", "parapet", "passage"]
"""Kind of opening in a wall. A ``gate`` is the closed door of a garage, a ``parapet`` is the open side of a balcony
above its balustrade, and a ``passage`` is the doorway to a stairwell."""


@dataclass(frozen=True, kw_only=True)
class Opening:
    """Opening in one wall, such as a door or window."""

    kind: OpeningKind
    axis: Literal[0, 1]
    """Plan axis along which the wall runs: 0 = x, 1 = z."""
    line: float
    """Coordinate of the wall on the other axis [m]: the middle of an inner wall, or the inner face of an outer one."""
    span: tuple[float, float]
    """Both ends of the clear opening along the wall's axis [m]."""
    height: tuple[float, float]
    """Bottom and top of the clear opening [m]."""
    rooms: tuple[str, ...]
    """Names of the rooms on its sides: one for outer walls, two for inner walls."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Complete plan of a home, whose footprint is the rectangle ``0 0 width depth`` minus the notches."""

    width: float
    depth: float
    rooms: tuple[RoomPlan, ...]
    openings: tuple[Opening, ...]
    notches: tuple[Rect, ...] = ()
    """Corners of the bounding box that lie outdoors. Walls that face them are centred on their line, like inner walls."""
    open_plan: bool = False
    """True if openings may be as wide as a room, so that furniture may stand near them."""

    def room(self, name: str) -> RoomPlan:
        """Return the room with a given name."""
        return next(r for r in self.rooms if r.name == name)


# --- rooms ------------------------------------------------------------------------------------------------------------
def _oriented(rng: np.random.Generator, plan: Zoning) -> Zoning:
    """Return the plan, mirrored and rotated at random."""
    flip_x, flip_z, swap = (rng.random(3) < 0.5).tolist()

    def moved(rect: Rect) -> Rect:
        x0, z0, x1, z1 = rect
        if flip_x:
            x0, x1 = plan.width - x1, plan.width - x0
        if flip_z:
            z0, z1 = plan.depth - z1, plan.depth - z0
        return rounded((z0, x0, z1, x1) if swap else (x0, z0, x1, z1))

    return Zoning(
        width=plan.depth if swap else plan.width,
        depth=plan.width if swap else plan.depth,
        tiles=tuple((kind, moved(rect)) for kind, rect in plan.tiles),
        notches=tuple(moved(rect) for rect in plan.notches),
    )


def _named(tiles: Sequence[Tile], width: float, depth: float) -> tuple[RoomPlan, ...]:
    kinds = [kind for kind, _ in tiles]
    numbers: dict[str, int] = {}
    rooms = []
    for kind, rect in tiles:
        numbers[kind] = numbers.get(kind, 0) + 1
        name = f"{kind}_{numbers[kind]}" if kinds.count(kind) > 1 else kind
        rooms.append(RoomPlan(name=name, category=kind, rect=rect, interior=interior_of(rect, width, depth)))
    return tuple(rooms)


def interior_of(rect: Rect, width: float, depth: float) -> Rect:
    """Return the floor rectangle between the wall faces of a room, in a plan of the given size [m]."""
    x0, z0, x1, z1 = rect
    half = WALL_THICKNESS / 2
    return (
        x0 + (half if x0 > 0 else 0),
        z0 + (half if z0 > 0 else 0),
        x1 - (half if x1 < width else 0),
        z1 - (half if z1 < depth else 0),
    )


# --- doors ------------------------------------------------------------------------------------------------------------
def _pairs(values: Mapping[str, float]) -> dict[frozenset[str], float]:
    """Return values by pair of room types, from keys such as ``living-kitchen``; ``hall`` alone stands for two halls."""
    return {frozenset(pair.split("-")): value for pair, value in values.items()}


_DOOR_COST = _pairs(
    {
        "living-kitchen": 0,
        "living-dining": 0,
        "dining-kitchen": 0,
        "hall": 0,
        "living-hall": 1,
        "hall-dining": 2,
        "hall-bedroom": 2,
        "hall-bathroom": 2,
        "hall-den": 2,
        "hall-office": 2,
        "hall-library": 2,
        "kitchen-pantry": 3,
        "kitchen-laundry": 3,
        "hall-laundry": 4,
        "hall-pantry": 5,
        "hall-kitchen": 5,
        "living-den": 6,
        "living-library": 6,
        "living-office": 6,
        "bedroom-bathroom": 7,
        "living-balcony": 2,
        "hall-child": 2,
        "hall-garage": 4,
        "kitchen-garage": 6,
        "laundry-garage": 6,
        "living-garage": 9,
    }
)
"""Preference for a door between two types of rooms, lower is better; other pairs never get one."""
_EXTRA_DOORS = _pairs(
    {
        "hall-kitchen": 0.3,
        "hall-dining": 0.5,
        "living-den": 0.3,
        "living-library": 0.3,
        "dining-kitchen": 0.8,
        "living-dining": 1.0,
    }
)
"""Probability of a door that closes a loop, in addition to the spanning tree."""
_WIDE = tuple(_pairs({"living-kitchen": 0, "living-dining": 0, "dining-kitchen": 0, "living-balcony": 0}))
"""Pairs joined by a wide opening without a door leaf."""
_OPEN_PLAN = tuple(_pairs({"living-kitchen": 0, "living-dining": 0, "dining-kitchen": 0}))
"""Pairs between which there is only a beam, in homes of the second generation."""
_BEAM = 2.42
_DEAD_ENDS = ("bathroom", "bedroom", "pantry", "child", "balcony", "garage")
"""Private rooms, which never lead to other rooms, except a bedroom to its own bathroom."""


def _narrow(room: RoomPlan) -> float:
    return min(room.rect[2] - room.rect[0], room.rect[3] - room.rect[1])


def _door(
    rng: np.random.Generator, a: RoomPlan, b: RoomPlan, wall: tuple[int, float, float, float], generation: int
) -> Opening:
    axis, line, _, _ = wall
    low = max(a.interior[axis], b.interior[axis]) + 0.1
    high = min(a.interior[axis + 2], b.interior[axis + 2]) - 0.1
    kinds = {a.category, b.category}
    if kinds == {"hall"}:
        kind: OpeningKind = "wide"
        width, top, start = high - low, 2.4, low
    elif generation > 1 and kinds in _OPEN_PLAN:
        kind = "wide"
        width, top, start = high - low, _BEAM, low
    elif kinds in _WIDE or (kinds == {"living", "hall"} and min(high - low, _narrow(b), _narrow(a)) > 1.8):
        width, top = float(np.clip(0.55 * (high - low), 1.3, 2.4)), 2.3
        start = low + (high - low - width) * rng.uniform(0.3, 0.7)
        kind = "wide"
    else:
        kind, width, top = "door", 0.95, DOOR_HEIGHT
        slack = high - low - width
        if slack < 0:
            width, slack = high - low, 0.0
        start = low + slack * float(rng.choice([0.0, 1.0]) if slack > 0.4 else 0.5)
        start += (0.04 if start <= low + 0.01 else -0.04) if slack > 0.4 else 0.0
    return Opening(
        kind=kind,
        axis=0 if axis == 0 else 1,
        line=line,
        span=(start, start + width),
        height=(0.0, top),
        rooms=(a.name, b.name),
    )


def _plan_doors(rng: np.random.Generator, rooms: tuple[RoomPlan, ...], generation: int = 1) -> list[Opening]:
    """Return a minimum spanning tree of doors by `_DOOR_COST` (Kruskal), plus occasional `_EXTRA_DOORS`."""
    links = []
    for a, b in combinations(rooms, 2):
        wall = shared_wall(a.rect, b.rect)
        cost = _DOOR_COST.get(frozenset({a.category, b.category}))
        if wall is not None and cost is not None and wall[3] - wall[2] >= 0.95 + 0.2 + WALL_THICKNESS - 0.03:
            links.append((cost, rng.random(), a, b, wall))
    links.sort(key=lambda link: link[:2])
    group = {room.name: room.name for room in rooms}
    doors = []
    for _, chance, a, b, wall in links:
        joined = group[a.name] == group[b.name]
        if joined and chance >= _EXTRA_DOORS.get(frozenset({a.category, b.category}), 0.0):
            continue
        if not joined:
            old, new = group[b.name], group[a.name]
            group = {name: new if g == old else g for name, g in group.items()}
        doors.append(_door(rng, a, b, wall, generation))
    if len(set(group.values())) > 1:
        raise SceneError("This plan leaves rooms without a door.", code="H3-SCENE-023")
    kinds = {room.name: room.category for room in rooms}
    for room in rooms:
        others = [kinds[n] for o in doors if room.name in o.rooms for n in o.rooms if n != room.name]
        through = [k for k in others if not (room.category == "bedroom" and k == "bathroom")]
        if room.category in _DEAD_ENDS and len(through) != 1:
            raise SceneError("This plan leads through a private room.", code="H3-SCENE-025")
    return doors


# --- windows and the entrance -----------------------------------------------------------------------------------------
_WINDOWS = {
    "living": (2, (1.5, 2.2), 0.85, 2.2),
    "dining": (2, (1.4, 2.0), 0.85, 2.2),
    "kitchen": (1, (1.0, 1.4), 1.1, 2.15),
    "bedroom": (1, (1.1, 1.6), 0.95, 2.15),
    "den": (1, (1.2, 1.7), 0.95, 2.15),
    "office": (1, (1.2, 1.7), 0.95, 2.15),
    "library": (1, (1.0, 1.4), 0.95, 2.15),
    "bathroom": (1, (0.55, 0.7), 1.5, 2.15),
    "laundry": (1, (0.6, 0.8), 1.2, 2.15),
    "pantry": (0, (0.5, 0.6), 1.5, 2.15),
    "hall": (1, (0.6, 0.8), 1.2, 2.15),
    "child": (1, (1.1, 1.6), 0.95, 2.15),
    "garage": (1, (0.8, 1.1), 1.5, 2.15),
    "balcony": (3, (0.0, 0.0), 1.05, 2.35),
}
"""Windows per kind of room: largest number of sides, range of widths, bottom, top [m]. Its order is also that of a plan's
rooms."""
NEED_LIGHT = ("living", "bedroom", "dining", "child")
"""Kinds of rooms that must have an outer wall that is long enough for a window."""


@dataclass(frozen=True)
class OuterWall:
    """Part of a room's wall that faces outdoors, between the wall faces at its ends."""

    axis: Literal[0, 1]
    line: float
    low: float
    high: float


def outer_walls(room: RoomPlan, rooms: Sequence[RoomPlan]) -> list[OuterWall]:
    """Return the parts of a room's walls that no other room shares."""
    walls = [w for r in rooms if r is not room and (w := shared_wall(room.rect, r.rect)) is not None]
    stretches = []
    axes: tuple[Literal[0, 1], ...] = (1, 0)
    for axis in axes:
        across = 1 - axis
        for end in (across, across + 2):
            line, at = room.rect[end], room.interior[axis]
            shared = sorted((w[2], w[3]) for w in walls if w[0] == axis and abs(w[1] - line) < 1e-9)
            # A neighbour that only touches this line beyond a corner of the room must not cut the wall.
            for low, high in [*shared, (room.interior[axis + 2] + WALL_THICKNESS / 2, np.inf)]:
                stop = min(low - WALL_THICKNESS / 2, room.interior[axis + 2])
                if stop - at > 0.9:
                    stretches.append(OuterWall(axis, line, at, stop))
                at = max(at, high + WALL_THICKNESS / 2)
    return stretches


def _plan_outer(rng: np.random.Generator, rooms: tuple[RoomPlan, ...]) -> list[Opening]:
    """Return the entrance and the windows."""
    openings: list[Opening] = []
    halls = sorted((r for r in rooms if r.category == "hall"), key=lambda r: -_narrow(r))
    host = next((r for r in (*halls, *rooms) if _entrances(r, rooms)), None)
    if host is None:
        raise SceneError("This plan has no place for an entrance.", code="H3-SCENE-024")
    sides = _entrances(host, rooms)
    door = sides[int(rng.integers(len(sides)))]
    middle = (door.low + door.high) / 2
    openings.append(
        Opening(
            kind="entrance",
            axis=door.axis,
            line=door.line,
            span=(middle - 0.475, middle + 0.475),
            height=(0.0, DOOR_HEIGHT),
            rooms=(host.name,),
        )
    )
    for room in rooms:
        most, widths, bottom, top = _WINDOWS[room.category]
        sides = [s for s in outer_walls(room, rooms) if room is not host or s != door]
        if room.category == "balcony":
            openings += [_opening(room, "parapet", s, (s.low + 0.06, s.high - 0.06), (bottom, top)) for s in sides]
            continue
        if room.category == "garage" and any(s.high - s.low > 2.9 for s in sides):
            side = max(sides, key=lambda s: s.high - s.low)
            middle = (side.low + side.high) / 2
            openings.append(_opening(room, "gate", side, (middle - 1.2, middle + 1.2), (0.0, DOOR_HEIGHT)))
            sides.remove(side)
        for index in rng.permutation(len(sides))[:most].tolist():
            side = sides[index]
            count = max(1, int((side.high - side.low) / 4.2))
            each = (side.high - side.low) / count
            for k in range(count):
                size = float(min(rng.uniform(*widths), each - 0.5))
                start = side.low + k * each + (each - size) * rng.uniform(0.4, 0.6)
                openings.append(
                    Opening(
                        kind="window",
                        axis=side.axis,
                        line=side.line,
                        span=(start, start + size),
                        height=(bottom, top),
                        rooms=(room.name,),
                    )
                )
    return openings


def _opening(
    room: RoomPlan, kind: OpeningKind, side: OuterWall, span: tuple[float, float], height: tuple[float, float]
) -> Opening:
    return Opening(kind=kind, axis=side.axis, line=side.line, span=span, height=height, rooms=(room.name,))


def _entrances(room: RoomPlan, rooms: Sequence[RoomPlan]) -> list[OuterWall]:
    return [s for s in outer_walls(room, rooms) if s.high - s.low > 1.15] if room.category in ("hall", "living") else []


def plan_layout(spec: HomeSpec, attempt: int = 0) -> Layout:
    """Plan rooms, doors and windows of a home; each ``attempt`` uses different random numbers.

    Raises:
        SceneError: no acceptable plan was found.
    """
    program = spec.program
    large = program.area_m2 >= LARGE_FROM_M2 or program.bedrooms >= LARGE_FROM_BEDROOMS
    if program.generation > 1:  # one corridor has room for five private rooms; further ones would become slits
        large = large or program.bedrooms + program.bathrooms + len(program.extra) > 5
    try:
        plan = plan_large_zoning(spec, attempt, _sound) if large else plan_zoning(spec, attempt)
    except SceneError:
        # Unusual numbers of rooms: the other planner may still succeed.
        plan = plan_zoning(spec, attempt) if large else plan_large_zoning(spec, attempt, _sound)
    plan = _oriented(stage_rng(spec, "orientation", attempt), plan)
    rooms = _rooms(plan)
    doors = _plan_doors(stage_rng(spec, "doors", attempt), rooms, spec.generation)
    outer = _plan_outer(stage_rng(spec, "outer", attempt), rooms)
    openings = tuple(replace(o, span=(round(o.span[0], 3), round(o.span[1], 3))) for o in doors + outer)
    return Layout(
        width=plan.width,
        depth=plan.depth,
        rooms=rooms,
        openings=openings,
        notches=plan.notches,
        open_plan=spec.generation > 1,
    )


def _rooms(plan: Zoning) -> tuple[RoomPlan, ...]:
    return _named(sorted(plan.tiles, key=lambda t: list(_WINDOWS).index(t[0])), plan.width, plan.depth)


def _sound(plan: Zoning) -> bool:
    """Return whether a plan allows a door for every room and a window for every room that needs light."""
    rooms = _rooms(plan)
    try:
        _plan_doors(np.random.Generator(np.random.Philox(key=0)), rooms)
    except SceneError:
        return False
    return all(any(s.high - s.low > 1.7 for s in outer_walls(r, rooms)) for r in rooms if r.category in NEED_LIGHT)
