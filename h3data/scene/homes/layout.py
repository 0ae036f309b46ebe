"""The plan of a home: rooms that tile a rectangle, doors by room-type rules, windows.

Plan coordinates are the world's floor points (x, z) [m]. Rooms reach to the middle of inner walls and to the inner face
of outer walls, so their areas add up to the area of the home. Algorithm: research/navigation-and-stepping.md 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from h3data.errors import SceneError
from h3data.scene.homes.spec import HOME_PRESETS, HomePreset, HomeSpec, stage_rng

WALL_THICKNESS = 0.12
WALL_HEIGHT = 2.6
DOOR_HEIGHT = 2.1
CORRIDOR_WIDTH = (1.3, 1.42)

Rect = tuple[float, float, float, float]
"""x0 z0 x1 z1 [m]."""


@dataclass(frozen=True, kw_only=True)
class RoomPlan:
    """One room of the plan."""

    name: str
    category: str
    rect: Rect
    """To the middle of inner walls and to the inner face of outer walls."""
    interior: Rect
    """The floor between the wall faces."""

    @property
    def area(self) -> float:
        return rect_area(self.rect)


OpeningKind = Literal["door", "wide", "window", "entrance"]


@dataclass(frozen=True, kw_only=True)
class Opening:
    """A hole in one wall."""

    kind: OpeningKind
    axis: Literal[0, 1]
    """The plan axis along which the wall runs: 0 = x, 1 = z."""
    line: float
    """Where the wall's line cuts the other axis: its middle if inner, its inner face if outer [m]."""
    span: tuple[float, float]
    """Clear opening along the axis [m]."""
    height: tuple[float, float]
    """Bottom and top of the clear opening [m]."""
    rooms: tuple[str, ...]
    """The room or the two rooms it belongs to."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A whole plan; its footprint is ``0 0 width depth``."""

    width: float
    depth: float
    rooms: tuple[RoomPlan, ...]
    openings: tuple[Opening, ...]

    def room(self, name: str) -> RoomPlan:
        return next(r for r in self.rooms if r.name == name)


def rect_area(rect: Rect) -> float:
    return (rect[2] - rect[0]) * (rect[3] - rect[1])


# --- rooms ------------------------------------------------------------------------------------------------------------
_LIMITS = {  # smallest side, smallest and largest area, longest aspect
    "living": (3.5, 15.0, 38.0, 1.9),
    "kitchen": (2.5, 8.0, 22.0, 2.1),
    "bedroom": (2.9, 9.5, 24.0, 1.8),
    "bathroom": (1.85, 4.2, 10.5, 2.3),
    "hall": (1.3, 2.0, 18.0, 9.0),
}
_MUST_TOUCH = {  # metres of shared wall, for every room of the second kind
    ("living", "kitchen"): 2.0,
    ("living", "hall"): 1.3,
    ("hall", "bedroom"): 1.3,
    ("hall", "bathroom"): 1.3,
}

_Tile = tuple[str, Rect]


def _split(rng: np.random.Generator, low: float, high: float, weights: Sequence[float]) -> list[float]:
    shares = np.asarray(weights) * rng.uniform(0.85, 1.18, len(weights))
    return [low, *(low + (high - low) * np.cumsum(shares) / shares.sum())[:-1].tolist(), high]


def _public(rng: np.random.Generator, rect: Rect) -> list[_Tile]:
    x0, z0, x1, z1 = rect
    share = rng.uniform(0.34, 0.44)
    if (x1 - x0) > 1.25 * (z1 - z0):
        cut = x0 + (x1 - x0) * share
        return [("kitchen", (x0, z0, cut, z1)), ("living", (cut, z0, x1, z1))]
    if rng.random() < 0.5:
        cut = z0 + (z1 - z0) * share
        return [("kitchen", (x0, z0, x1, cut)), ("living", (x0, cut, x1, z1))]
    cut = z1 - (z1 - z0) * share
    return [("living", (x0, z0, x1, cut)), ("kitchen", (x0, cut, x1, z1))]


def _strip(rng: np.random.Generator, kinds: Sequence[str], low: float, high: float) -> list[tuple[str, float, float]]:
    weights = [0.52 if kind == "bathroom" else 1.0 for kind in kinds]
    cuts = _split(rng, low, high, weights)
    return list(zip(kinds, cuts[:-1], cuts[1:], strict=True))


def _spine_along(rng: np.random.Generator, width: float, depth: float, preset: HomePreset) -> list[_Tile]:
    """Public rooms | corridor running away from them, with private rooms on both of its sides."""
    cut = width * rng.uniform(0.40, 0.62)
    corridor = rng.uniform(*CORRIDOR_WIDTH)
    private = rng.permutation(["bedroom"] * preset.bedrooms + ["bathroom"] * preset.bathrooms).tolist()
    first = int(rng.integers(1, len(private)))
    below, above = private[:first], private[first:]
    load = [sum(0.5 if kind == "bathroom" else 1.0 for kind in side) for side in (below, above)]
    share = 0.5 if preset.bedrooms > 1 else load[0] / sum(load)
    z0 = (depth - corridor) * float(np.clip(share + rng.uniform(-0.06, 0.06), 0.2, 0.8))
    tiles: list[_Tile] = [("hall", (cut, z0, width, z0 + corridor))]
    tiles += [(kind, (a, 0.0, b, z0)) for kind, a, b in _strip(rng, below, cut, width)]
    tiles += [(kind, (a, z0 + corridor, b, depth)) for kind, a, b in _strip(rng, above, cut, width)]
    return tiles + _public(rng, (0.0, 0.0, cut, depth))


def _spine_across(rng: np.random.Generator, width: float, depth: float, preset: HomePreset) -> list[_Tile]:
    """Public rooms | corridor between | one row of private rooms."""
    cut = width * rng.uniform(0.42, 0.56)
    corridor = rng.uniform(*CORRIDOR_WIDTH)
    private = rng.permutation(["bedroom"] * preset.bedrooms + ["bathroom"] * preset.bathrooms).tolist()
    tiles: list[_Tile] = [("hall", (cut, 0.0, cut + corridor, depth))]
    tiles += [(kind, (cut + corridor, a, width, b)) for kind, a, b in _strip(rng, private, 0.0, depth)]
    return tiles + _public(rng, (0.0, 0.0, cut, depth))


def shared_wall(a: Rect, b: Rect) -> tuple[int, float, float, float] | None:
    """(axis along which it runs, line, low, high) of the wall between two rooms, or None."""
    for axis in (0, 1):
        across = 1 - axis
        for first, second in ((a, b), (b, a)):
            if abs(first[across + 2] - second[across]) < 1e-9:
                low, high = max(a[axis], b[axis]), min(a[axis + 2], b[axis + 2])
                if high - low > 1e-6:
                    return axis, first[across + 2], low, high
    return None


def _penalty(tiles: Sequence[_Tile]) -> float:
    """0 for a plan without faults; rooms of bad size or shape and missing neighbours add to it."""
    total = 0.0
    for kind, rect in tiles:
        side, least, most, aspect = _LIMITS[kind]
        a, b = sorted((rect[2] - rect[0], rect[3] - rect[1]))
        total += (
            4 * max(0, side - a) + 0.5 * max(0, least - a * b) + 0.5 * max(0, a * b - most) + max(0, b / a - aspect)
        )
    for (kind, other), needed in _MUST_TOUCH.items():
        hosts = [r for k, r in tiles if k == kind]
        for rect in (r for k, r in tiles if k == other):
            walls = [w for w in (shared_wall(h, rect) for h in hosts) if w]
            longest = max((w[3] - w[2] for w in walls), default=0.0)
            total += 20 * max(0.0, needed - longest)
    return total


def _plan_rooms(spec: HomeSpec, attempt: int) -> tuple[float, float, list[_Tile]]:
    preset = HOME_PRESETS[spec.preset]
    rng = stage_rng(spec, "rooms", attempt)
    best: tuple[float, float, float, list[_Tile]] | None = None
    for _ in range(200):
        aspect = rng.uniform(1.15, 1.6)
        width = round(float(np.sqrt(preset.area_m2 * aspect)), 2)
        depth = round(preset.area_m2 / width, 2)
        across = preset.bedrooms == 1 and rng.random() < 0.5
        tiles = (_spine_across if across else _spine_along)(rng, width, depth, preset)
        tiles = [(kind, _rounded(rect)) for kind, rect in tiles]
        penalty = _penalty(tiles)
        if best is None or penalty < best[0]:
            best = (penalty, width, depth, tiles)
        if penalty == 0:
            break
    if best is None or best[0] > 2.0:
        raise SceneError(f"No acceptable plan for {spec} after 200 trials. Hint: use another seed.")
    return best[1], best[2], best[3]


def _rounded(rect: Rect) -> Rect:
    a, b, c, d = (round(v, 2) for v in rect)
    return a, b, c, d


def _oriented(
    rng: np.random.Generator, width: float, depth: float, tiles: list[_Tile]
) -> tuple[float, float, list[_Tile]]:
    """The plan mirrored and turned at random."""
    flip_x, flip_z, swap = rng.random(3) < 0.5
    out: list[_Tile] = []
    for kind, (x0, z0, x1, z1) in tiles:
        if flip_x:
            x0, x1 = width - x1, width - x0
        if flip_z:
            z0, z1 = depth - z1, depth - z0
        out.append((kind, _rounded((z0, x0, z1, x1) if swap else (x0, z0, x1, z1))))
    return (depth, width, out) if swap else (width, depth, out)


def _named(tiles: list[_Tile], width: float, depth: float) -> tuple[RoomPlan, ...]:
    kinds = [kind for kind, _ in tiles]
    seen: dict[str, int] = {}
    rooms = []
    half = WALL_THICKNESS / 2
    for kind, rect in tiles:
        seen[kind] = seen.get(kind, 0) + 1
        name = f"{kind}_{seen[kind]}" if kinds.count(kind) > 1 else kind
        x0, z0, x1, z1 = rect
        interior = (
            x0 + (half if x0 > 0 else 0),
            z0 + (half if z0 > 0 else 0),
            x1 - (half if x1 < width else 0),
            z1 - (half if z1 < depth else 0),
        )
        rooms.append(RoomPlan(name=name, category=kind, rect=rect, interior=interior))
    return tuple(rooms)


# --- doors ------------------------------------------------------------------------------------------------------------
_DOOR_COST = {  # which rooms would rather be joined; missing pairs are never joined
    frozenset({"living", "kitchen"}): 0,
    frozenset({"living", "hall"}): 1,
    frozenset({"hall", "bedroom"}): 2,
    frozenset({"hall", "bathroom"}): 2,
    frozenset({"hall", "kitchen"}): 5,
}
_EXTRA_DOORS = {frozenset({"hall", "kitchen"}): 0.3}
"""Chance of a door that closes a loop, beside the spanning tree."""


def _door(rng: np.random.Generator, a: RoomPlan, b: RoomPlan, wall: tuple[int, float, float, float]) -> Opening:
    axis, line, _, _ = wall
    low = max(a.interior[axis], b.interior[axis]) + 0.1
    high = min(a.interior[axis + 2], b.interior[axis + 2]) - 0.1
    kinds = {a.category, b.category}
    if kinds == {"living", "kitchen"}:
        width, top = float(np.clip(0.55 * (high - low), 1.3, 2.4)), 2.3
        start = low + (high - low - width) * rng.uniform(0.3, 0.7)
        kind: OpeningKind = "wide"
    else:
        kind, width, top = "door", 0.95, DOOR_HEIGHT
        room = high - low - width
        if room < 0:
            width, room = high - low, 0.0
        start = low + room * float(rng.choice([0.0, 1.0]) if room > 0.4 else 0.5)
        start += (0.04 if start <= low + 0.01 else -0.04) if room > 0.4 else 0.0
    return Opening(
        kind=kind,
        axis=0 if axis == 0 else 1,
        line=line,
        span=(start, start + width),
        height=(0.0, top),
        rooms=(a.name, b.name),
    )


def _plan_doors(rng: np.random.Generator, rooms: tuple[RoomPlan, ...]) -> list[Opening]:
    """A spanning tree of doors, cheapest pairs of room types first, and now and then one more."""
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
        doors.append(_door(rng, a, b, wall))
    if len(set(group.values())) > 1:
        raise SceneError("This plan leaves rooms without a door.")
    return doors


# --- windows and the entrance -----------------------------------------------------------------------------------------
_WINDOWS = {  # how many at most, width, bottom, top
    "living": (2, (1.5, 2.2), 0.85, 2.2),
    "kitchen": (1, (1.0, 1.4), 1.1, 2.15),
    "bedroom": (1, (1.1, 1.6), 0.95, 2.15),
    "bathroom": (1, (0.55, 0.7), 1.5, 2.15),
    "hall": (1, (0.6, 0.8), 1.2, 2.15),
}


def outer_sides(room: RoomPlan, width: float, depth: float) -> list[tuple[Literal[0, 1], float]]:
    """(axis, line) of the room's sides that lie on the footprint's edge."""
    x0, z0, x1, z1 = room.rect
    sides: list[tuple[Literal[0, 1], float]] = []
    sides.extend((1, x) for x in (x0, x1) if x in (0.0, width))
    sides.extend((0, z) for z in (z0, z1) if z in (0.0, depth))
    return sides


def _plan_outer(rng: np.random.Generator, rooms: tuple[RoomPlan, ...], width: float, depth: float) -> list[Opening]:
    openings: list[Opening] = []
    hall = next(r for r in rooms if r.category == "hall")
    host = hall if outer_sides(hall, width, depth) else next(r for r in rooms if r.category == "living")
    sides = outer_sides(host, width, depth)
    axis, line = sides[int(rng.integers(len(sides)))]
    middle = (host.interior[axis] + host.interior[axis + 2]) / 2
    entrance = Opening(
        kind="entrance",
        axis=axis,
        line=line,
        span=(middle - 0.475, middle + 0.475),
        height=(0.0, DOOR_HEIGHT),
        rooms=(host.name,),
    )
    openings.append(entrance)
    for room in rooms:
        most, widths, bottom, top = _WINDOWS[room.category]
        sides = [s for s in outer_sides(room, width, depth) if room is not host or s != (axis, line)]
        for index in rng.permutation(len(sides))[:most].tolist():
            side_axis, side_line = sides[index]
            low, high = room.interior[side_axis], room.interior[side_axis + 2]
            size = float(min(rng.uniform(*widths), high - low - 0.5))
            start = low + (high - low - size) * rng.uniform(0.4, 0.6)
            openings.append(
                Opening(
                    kind="window",
                    axis=side_axis,
                    line=side_line,
                    span=(start, start + size),
                    height=(bottom, top),
                    rooms=(room.name,),
                )
            )
    return openings


def plan_layout(spec: HomeSpec, attempt: int = 0) -> Layout:
    """Rooms, doors and windows of a home; ``attempt`` gives other random numbers for the same spec."""
    width, depth, tiles = _plan_rooms(spec, attempt)
    width, depth, tiles = _oriented(stage_rng(spec, "orientation", attempt), width, depth, tiles)
    rooms = _named(sorted(tiles, key=lambda t: list(_LIMITS).index(t[0])), width, depth)
    doors = _plan_doors(stage_rng(spec, "doors", attempt), rooms)
    outer = _plan_outer(stage_rng(spec, "outer", attempt), rooms, width, depth)
    openings = tuple(replace(o, span=(round(o.span[0], 3), round(o.span[1], 3))) for o in doors + outer)
    return Layout(width=width, depth=depth, rooms=rooms, openings=openings)
