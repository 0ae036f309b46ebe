"""Zoning of large homes: a gallery with rows of rooms on both sides, and branch corridors within the rows.

A row is a list of cells: single rooms, suites (a bedroom with its bathroom behind it), or a kitchen with its pantry and
laundry. Cells too small to span the depth of a row are arranged along a branch corridor at right angles to it. The rows
may differ in length, which gives L- and T-shaped footprints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np

from h3data.errors import SceneError
from h3data.geometry import add_up
from h3data_homes.spec import HomePreset, HomeSpec, stage_rng
from h3data_homes.zoning import (
    NOTCH_SHARE,
    Limits,
    Rect,
    Tile,
    Zoning,
    rect_area,
    rounded,
    size_penalty,
    with_balcony,
)

LARGE_FROM_M2, LARGE_FROM_BEDROOMS = 215.0, 6
_GALLERY, _BRANCH, _NARROW = (2.0, 2.5), (1.5, 1.7), (1.4, 1.6)
_SERVICE_FROM_M2 = 420.0
"""Area above which kitchens have a pantry and a laundry, and galleries are wide [m2]."""
_TRIALS, _WORST, _WORST_2, _GOOD_2 = 250, 3.0, 6.0, 2.0
"""Plans tried per footprint shape, and the largest acceptable penalty by generation: homes of the second have more
rooms, and their search ends at a plan below the last number."""

_LIMITS: Limits = {
    "living": (4.5, 24.0, 125.0, 2.1),
    "dining": (3.5, 15.0, 70.0, 2.1),
    "kitchen": (3.2, 14.0, 70.0, 2.1),
    "bedroom": (3.2, 12.0, 62.0, 2.0),
    "den": (3.2, 13.0, 75.0, 2.1),
    "office": (3.0, 11.0, 70.0, 2.1),
    "library": (3.2, 13.0, 75.0, 2.1),
    "bathroom": (1.95, 5.5, 30.0, 2.9),
    "laundry": (1.9, 4.5, 26.0, 2.8),
    "pantry": (1.7, 3.5, 24.0, 2.8),
    "hall": (1.3, 2.0, 200.0, 40.0),
    "child": (2.8, 9.0, 40.0, 2.0),
    "garage": (3.6, 18.0, 80.0, 2.2),
    "balcony": (1.4, 3.0, 60.0, 12.0),
}
_AREA = {
    "living": 80.0,
    "dining": 42.0,
    "kitchen": 40.0,
    "bedroom": 33.0,
    "bathroom": 13.5,
    "den": 42.0,
    "office": 32.0,
    "library": 40.0,
    "laundry": 10.0,
    "pantry": 9.0,
}
"""Desired area of each kind of room [m2], before all are scaled together to fill the home."""
_AREA_2 = {
    "living": (30.0, 118.0),
    "dining": (14.0, 46.0),
    "kitchen": (15.0, 52.0),
    "bedroom": (14.5, 34.0),
    "child": (13.5, 24.0),
    "bathroom": (8.0, 12.5),
    "den": (16.0, 44.0),
    "office": (12.0, 20.0),
    "library": (15.0, 34.0),
    "laundry": (7.5, 12.0),
    "pantry": (5.0, 7.0),
    "garage": (24.0, 52.0),
}
"""The same for the second generation, in homes of `_SIZES`: the larger a home, the less equal are its rooms."""
_SIZES = (140.0, 840.0)
_FILL = ("dining", "office", "living", "den", "library", "living", "office", "den", "library", "living", "office")
"""Rooms added, in this order, while area is left."""
_FILL_2 = ("dining", "office", "garage", "library", "den", "child", "office", "bathroom", "den", "library", "office")


@dataclass(frozen=True)
class _Cell:
    """One or more rooms, of which the first is entered from the corridor."""

    rooms: tuple[str, ...]
    desired: Mapping[str, float] = field(default_factory=lambda: _AREA)

    @property
    def areas(self) -> list[float]:
        return [self.desired[r] for r in self.rooms]

    @cached_property
    def area(self) -> float:
        return add_up(self.areas)


@dataclass(frozen=True)
class _Zone:
    """A rectangle and the side on which its corridor lies: 0 = low z, 1 = low x, 2 = high z, 3 = high x.

    The zone's own frame has u along the corridor (increasing with x or z) and v away from it.
    """

    rect: Rect
    side: int

    @property
    def size(self) -> tuple[float, float]:
        a, b = self.rect[2] - self.rect[0], self.rect[3] - self.rect[1]
        return (a, b) if self.side % 2 == 0 else (b, a)

    def part(self, u0: float, v0: float, u1: float, v1: float) -> Rect:
        """Plan rectangle of a rectangle in the zone's own frame."""
        x0, z0, x1, z1 = self.rect
        if self.side == 0:
            return x0 + u0, z0 + v0, x0 + u1, z0 + v1
        if self.side == 2:
            return x0 + u0, z1 - v1, x0 + u1, z1 - v0
        if self.side == 1:
            return x0 + v0, z0 + u0, x0 + v1, z0 + u1
        return x1 - v1, z0 + u0, x1 - v0, z0 + u1


def _aspect(a: float, b: float) -> float:
    return max(a, b) / max(min(a, b), 1e-6)


def _cut_in_two(rng: np.random.Generator, zone: _Zone, share: float) -> tuple[Rect, Rect]:
    """Return the zone cut into a part at the corridor and a second part, of ``share`` of the area, behind or beside it.

    Behind only if the second part is less elongated there, and even then by a coin toss (unless beside would be longer
    than 2.9:1), because a part behind takes the outer wall, and with it the windows, from the first.
    """
    length, depth = zone.size
    cut = depth * (1 - share)
    behind, beside = _aspect(length, depth - cut), _aspect(length * share, depth)
    if behind < beside and (beside > 2.9 or rng.random() < 0.5):
        return zone.part(0, 0, length, cut), zone.part(0, cut, length, depth)
    cut = length * (1 - share)
    return zone.part(0, 0, cut, depth), zone.part(cut, 0, length, depth)


def _fill_cell(rng: np.random.Generator, zone: _Zone, cell: _Cell) -> list[Tile]:
    """Return the zone divided among the one to three rooms of a cell."""
    first, *rest = cell.rooms
    if not rest:
        return [(first, zone.rect)]
    front, back = _cut_in_two(rng, zone, add_up(cell.areas[1:]) / cell.area)
    tiles: list[Tile] = [(first, front)]
    if len(rest) == 1:
        return [*tiles, (rest[0], back)]
    x0, z0, x1, z1 = back
    share = cell.areas[1] / (cell.areas[1] + cell.areas[2])
    if x1 - x0 > z1 - z0:
        cut = x0 + (x1 - x0) * share
        return [*tiles, (rest[0], (x0, z0, cut, z1)), (rest[1], (cut, z0, x1, z1))]
    cut = z0 + (z1 - z0) * share
    return [*tiles, (rest[0], (x0, z0, x1, cut)), (rest[1], (x0, cut, x1, z1))]


_Unit = _Cell | tuple["_Cell", ...]
"""Element of a row: a cell, or several cells around a branch corridor."""


def _unit_area(unit: _Unit) -> float:
    """Return the area of a unit [m2]; a branch corridor takes about 17% of its cells' area in addition."""
    return unit.area if isinstance(unit, _Cell) else 1.17 * add_up(c.area for c in unit)


def _fill_row(rng: np.random.Generator, zone: _Zone, units: Sequence[_Unit]) -> list[Tile]:
    """Return a zone filled with units side by side along its corridor."""
    length, depth = zone.size
    areas = np.array([_unit_area(u) for u in units]) * rng.uniform(0.92, 1.08, len(units))
    cuts = np.concatenate([[0.0], np.cumsum(areas) / areas.sum()]) * length
    tiles: list[Tile] = []
    for unit, a, b in zip(units, cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
        part = _Zone(rounded(zone.part(a, 0, b, depth)), zone.side)
        tiles += _fill_cell(rng, part, unit) if isinstance(unit, _Cell) else _fill_branch(rng, part, unit)
    return tiles


def _fill_branch(rng: np.random.Generator, zone: _Zone, cells: Sequence[_Cell]) -> list[Tile]:
    """Return a zone with a corridor into its middle and a row of cells on each side of that corridor."""
    length, depth = zone.size
    order = [cells[i] for i in rng.permutation(len(cells)).tolist()]
    halves: tuple[list[_Cell], list[_Cell]] = ([], [])
    for cell in sorted(order, key=lambda c: -c.area):
        min(halves, key=lambda half: add_up(c.area for c in half)).append(cell)
    left, right = (half if rng.random() < 0.5 else half[::-1] for half in halves)
    corridor = float(rng.uniform(*_BRANCH))
    weights = [add_up(c.area for c in half) for half in (left, right)]
    cut = (length - corridor) * weights[0] / add_up(weights)
    sides = (3, 1) if zone.side % 2 == 0 else (2, 0)
    tiles: list[Tile] = [("hall", zone.part(cut, 0, cut + corridor, depth))]
    for half, span, side in ((left, (0.0, cut), sides[0]), (right, (cut + corridor, length), sides[1])):
        if half:
            tiles += _fill_row(rng, _Zone(rounded(zone.part(span[0], 0, span[1], depth)), side), half)
    return tiles


def _cells(program: HomePreset) -> tuple[list[_Cell], list[_Cell]]:
    """Return the public cells, which stay adjacent and in order, and all other cells."""
    if program.generation > 1:
        return _cells_2(program)
    rooms = list(program.extra)
    private = [_Cell(("bedroom",))] * max(0, program.bedrooms - program.bathrooms + 1)
    suites = program.bedrooms - len(private)
    private += [_Cell(("bedroom", "bathroom"))] * suites
    private += [_Cell(("bathroom",))] * (program.bathrooms - suites)
    service = ("pantry", "laundry") if program.area_m2 > _SERVICE_FROM_M2 else ()
    public = [_Cell(("living",)), _Cell(("kitchen", *service))]
    used = add_up(c.area for c in (*private, *public)) + add_up(_AREA[r] for r in rooms)
    needed = {room: rooms.count(room) for room in set(rooms)}
    for room in _FILL:
        if needed.get(room, 0):
            needed[room] -= 1  # already among the rooms that the program requires
            continue
        if 1.33 * (used + _AREA[room]) > program.area_m2:
            break
        used += _AREA[room]
        if room == "dining":
            public.insert(1, _Cell((room,)))
        else:
            rooms.append(room)
    return public, [*private, *(_Cell((room,)) for room in rooms)]


def _cells_2(program: HomePreset) -> tuple[list[_Cell], list[_Cell]]:
    """Return the cells of the second generation: children's rooms have no bathroom of their own, parents' may have one."""
    suites = max(0, min(program.bedrooms - program.children, program.bathrooms - 1))
    single = [*["bedroom"] * (program.bedrooms - program.children - suites), *["child"] * program.children]
    single += ["bathroom"] * (program.bathrooms - suites)
    rooms = [r for r in program.extra if r != "laundry"]
    service = ("pantry", "laundry") if program.area_m2 > _SERVICE_FROM_M2 else ()
    single += [] if service else [r for r in program.extra if r == "laundry"]
    share = min(max((program.area_m2 - _SIZES[0]) / (_SIZES[1] - _SIZES[0]), 0.0), 1.0)
    desired = {kind: low + share * (high - low) for kind, (low, high) in _AREA_2.items()}
    used = add_up(
        desired[r] for r in ("living", "kitchen", *service, *single, *rooms, *["bedroom", "bathroom"] * suites)
    )
    missing = list(rooms)
    for room in _FILL_2:
        if room in missing:
            missing.remove(room)
        elif 1.33 * (used + desired[room]) <= program.area_m2:
            used += desired[room]
            rooms.append(room)
    public = [("living",), *([("dining",)] if "dining" in rooms else []), ("kitchen", *service)]
    others = [*[("bedroom", "bathroom")] * suites, *((r,) for r in (*single, *rooms) if r != "dining")]
    return [_Cell(c, desired) for c in public], [_Cell(c, desired) for c in others]


def _grouped(
    rng: np.random.Generator, cells: Sequence[_Cell], depth: float, scale: float, wide: tuple[float, float]
) -> list[_Unit]:
    """Return the cells large enough to span the depth of a row, and groups of the others.

    Groups have a width in the range ``wide`` [m] and lie around branch corridors.
    """
    deep = [c for c in cells if c.area * scale / depth >= 0.52 * depth]
    small = [c for c in cells if c not in deep]
    if not small:
        return list(deep)
    count = max(1, round(add_up(c.area for c in small) * scale / (depth * rng.uniform(*wide))))
    groups: list[list[_Cell]] = [[] for _ in range(count)]
    for i in rng.permutation(len(small)).tolist():
        min(groups, key=lambda g: add_up(c.area for c in g)).append(small[i])
    return [*deep, *(g[0] if len(g) == 1 else tuple(g) for g in groups if g)]


Shape = Literal["rectangle", "L", "T"]


def _gallery_plan(rng: np.random.Generator, program: HomePreset, shape: Shape) -> tuple[float, Zoning]:
    """Return one random plan and its penalty."""
    public, others = _cells(program)
    wide = program.area_m2 > _SERVICE_FROM_M2
    corridor = round(float(rng.uniform(*(_GALLERY if wide else _NARROW))), 2)
    share = float(rng.uniform(NOTCH_SHARE[0] + 0.01, 0.26)) if shape != "rectangle" else 0.0
    width = round(float(np.sqrt(program.area_m2 / (1 - share) * rng.uniform(1.25, 1.8))), 2)
    short = 1.0 if shape == "rectangle" else float(rng.uniform(0.42, 0.66))
    # The row above the gallery may be shorter than the one below; each cell goes where more area is left.
    total = add_up(c.area for c in (*public, *others))
    scale = 0.93 * (program.area_m2 - width * corridor) / total
    depth = (program.area_m2 / (1 - share) / width - corridor) / 2
    rows: list[list[_Cell]] = [[], []]
    capacity = [total * short / (1 + short), total / (1 + short)]
    home = int(rng.random() < (0.8 if short < 1 else 0.5))
    rows[home] += public
    for i in sorted(rng.permutation(len(others)).tolist(), key=lambda i: -others[i].area + rng.uniform(0, 12)):
        free = [capacity[k] - add_up(c.area for c in rows[k]) for k in (0, 1)]
        rows[int(free[1] > free[0])].append(others[i])
    units: list[list[_Unit]] = []
    for k in (0, 1):
        single: list[_Unit] = list(public) if k == home else []
        group_m = (10.0, 15.0) if program.generation == 1 else (7.0, 11.5)
        extra = _grouped(rng, [c for c in rows[k] if c not in public], depth, scale, group_m)
        extra = [extra[i] for i in rng.permutation(len(extra)).tolist()]
        at = int(rng.integers(len(extra) + 1))
        units.append([*extra[:at], *(single if rng.random() < 0.5 else single[::-1]), *extra[at:]])
    if not all(units):
        return 1e9, Zoning(width=width, depth=1.0, tiles=())
    lengths = np.array([short * width, width])
    areas = np.array([add_up(_unit_area(u) for u in row) for row in units])
    depths = areas / areas.sum() * (program.area_m2 - width * corridor) / lengths
    upper, lower = (round(float(d), 2) for d in depths)
    whole = round(upper + corridor + lower, 2)
    start = 0.0
    if shape != "rectangle":
        start = round(width * (1 - short) * (rng.uniform(0.3, 0.7) if shape == "T" else float(rng.integers(2))), 2)
    end = round(start + short * width, 2) if start + short * width < width - 0.02 else width
    notches = [(a, round(lower + corridor, 2), b, whole) for a, b in ((0.0, start), (end, width)) if b - a > 0.005]
    missing = add_up(rect_area(n) for n in notches) / (width * whole)
    if shape != "rectangle" and not NOTCH_SHARE[0] <= missing <= NOTCH_SHARE[1]:
        return 1e9, Zoning(width=width, depth=whole, tiles=())
    tiles = _gallery(rng, (0.0, lower, width, round(lower + corridor, 2)))
    tiles += _fill_row(rng, _Zone((0.0, 0.0, width, lower), 2), units[1])
    tiles += _fill_row(rng, _Zone((start, round(lower + corridor, 2), end, whole), 0), units[0])
    if program.generation > 1:
        tiles = with_balcony(rng, tiles, width, whole)
    tiles = [(kind, rounded(rect)) for kind, rect in tiles]
    limits = {k: (side, min(1.0, scale) * least, most, aspect) for k, (side, least, most, aspect) in _LIMITS.items()}
    if program.generation > 1:  # behind a balcony
        limits["living"] = (3.5, *limits["living"][1:])
    penalty = size_penalty(tiles, limits, max(1.0, scale / 1.35))
    penalty += 50 * max(0.0, abs(add_up(rect_area(r) for _, r in tiles) / program.area_m2 - 1) - 0.004)
    penalty += 30 * max(0.0, whole / width - 1.1, width / whole - 2.3)
    return penalty, Zoning(width=width, depth=whole, tiles=tuple(tiles), notches=tuple(notches))


def _gallery(rng: np.random.Generator, rect: Rect) -> list[Tile]:
    """Return the gallery as one to three halls, depending on its length, that open into each other."""
    x0, z0, x1, z1 = rect
    count = 1 if x1 - x0 < 12 else 2 if x1 - x0 < 26 else 3
    cuts = [x0, *(x0 + (x1 - x0) * (k + rng.uniform(-0.15, 0.15)) / count for k in range(1, count)), x1]
    return [("hall", (round(a, 2), z0, round(b, 2), z1)) for a, b in pairwise(cuts)]


def plan_large_zoning(spec: HomeSpec, attempt: int, sound: Callable[[Zoning], bool]) -> Zoning:
    """Return the best of up to 250 plans around a gallery for which ``sound`` returns True.

    ``sound`` checks the doors and windows of a plan. Rectangles, L and T shapes are tried in random order; the first
    shape with an acceptable plan is taken.

    Raises:
        SceneError: no plan was acceptable.
    """
    rng = stage_rng(spec, "rooms", attempt)
    shapes: tuple[Shape, ...] = ("rectangle", "L", "T")
    worst = _WORST if spec.generation == 1 else _WORST_2
    for k in rng.permutation(3).tolist():
        best: tuple[float, Zoning] | None = None
        for _ in range(_TRIALS):
            penalty, plan = _gallery_plan(rng, spec.program, shapes[k])
            if (best is None or penalty < best[0]) and penalty < worst and sound(plan):
                best = (penalty, plan)
                if penalty == 0 or (spec.generation > 1 and penalty < _GOOD_2):
                    break
        if best is not None:
            return best[1]
    raise SceneError(
        f"No acceptable plan for {spec} after 3 x {_TRIALS} trials. Hint: use another seed.", code="H3-SCENE-037"
    )
