"""Zoning of small and medium homes into rooms that tile the footprint, with penalties for bad plans.

Public rooms are on one side, and private ones are along a corridor on the other. L- and T-shaped footprints lack
rectangles at corners of their bounding box (notches). `zoning_large` is for large homes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from h3data.errors import SceneError
from h3data.geometry import add_up
from h3data_homes.spec import HomePreset, HomeSpec, stage_rng

CORRIDOR_WIDTH = (1.3, 1.42)
NOTCH_SHARE = (0.15, 0.30)
"""Range of the share of the bounding box that an L- or T-shaped footprint omits."""
_SQUARE_BELOW_M2 = 90.0
"""Area below which homes are rectangles, because they have too few rooms to go around a corner [m2]."""
_SHAPES, _TRIALS, _WORST = 4, 100, 2.0
"""Footprint shapes tried, plans tried per shape, and the largest acceptable penalty."""

Rect = tuple[float, float, float, float]
"""Rectangle in the plan as x0, z0, x1, z1 [m]."""
Tile = tuple[str, Rect]
"""Room of a zoning as its kind and its rectangle."""


@dataclass(frozen=True, kw_only=True)
class Zoning:
    """Zoning of a home: rooms without doors, which together with the notches tile the rectangle ``0 0 width depth``."""

    width: float
    depth: float
    tiles: tuple[Tile, ...]
    notches: tuple[Rect, ...] = ()


def rect_area(rect: Rect) -> float:
    """Return the area of a rectangle [m^2]."""
    return (rect[2] - rect[0]) * (rect[3] - rect[1])


def rounded(rect: Rect) -> Rect:
    """Return the rectangle rounded to centimetres, so that neighbours share exactly the same edge."""
    a, b, c, d = (round(v, 2) for v in rect)
    return a, b, c, d


def shared_wall(a: Rect, b: Rect) -> tuple[int, float, float, float] | None:
    """Return the wall between two rooms as (axis along which it runs, line, low, high), or None if they share none."""
    for axis in (0, 1):
        across = 1 - axis
        for first, second in ((a, b), (b, a)):
            if abs(first[across + 2] - second[across]) < 1e-9:
                low, high = max(a[axis], b[axis]), min(a[axis + 2], b[axis + 2])
                if high - low > 1e-6:
                    return axis, first[across + 2], low, high
    return None


# --- penalties --------------------------------------------------------------------------------------------------------
Limits = Mapping[str, tuple[float, float, float, float]]
"""Limits of rooms by kind: smallest side [m], smallest and largest area [m2], and largest aspect ratio."""

_LIMITS: Limits = {
    "living": (3.5, 15.0, 38.0, 1.9),
    "kitchen": (2.5, 8.0, 22.0, 2.1),
    "bedroom": (2.9, 9.5, 24.0, 1.8),
    "bathroom": (1.85, 4.2, 10.5, 2.3),
    "hall": (1.3, 2.0, 18.0, 9.0),
    "child": (2.7, 8.5, 19.0, 1.9),
    "office": (2.4, 6.5, 19.0, 2.1),
    "laundry": (1.8, 3.6, 9.5, 2.6),
    "garage": (3.2, 16.0, 44.0, 2.2),
    "den": (3.0, 11.0, 40.0, 2.1),
    "balcony": (1.4, 3.0, 24.0, 9.0),
}
_LIMITS_2 = {**_LIMITS, "living": (3.5, 15.0, 38.0, 1.9)}
_MUST_TOUCH = {
    ("living", "kitchen"): 2.0,
    ("living", "hall"): 1.3,
    ("hall", "bedroom"): 1.3,
    ("hall", "bathroom"): 1.3,
    ("hall", "child"): 1.3,
    ("hall", "office"): 1.3,
    ("hall", "laundry"): 1.3,
    ("hall", "garage"): 1.3,
    ("hall", "den"): 1.3,
    ("living", "balcony"): 2.0,
}
"""Length of wall [m] that every room of the second kind must share with one of the first."""


def size_penalty(tiles: Sequence[Tile], limits: Limits, roomy: float = 1.0) -> float:
    """Return the penalty for rooms outside their limits (0 if there are none); ``roomy`` scales the largest areas."""
    total = 0.0
    for kind, rect in tiles:
        side, least, most, aspect = limits[kind]
        a, b = sorted((rect[2] - rect[0], rect[3] - rect[1]))
        if a <= 0:
            return 1e9
        total += 4 * max(0, side - a) + 0.5 * max(0, least - a * b) + 0.5 * max(0, a * b - roomy * most)
        total += max(0, b / a - aspect * (1 if kind != "hall" else roomy))
    return total


def _touch_penalty(tiles: Sequence[Tile]) -> float:
    total = 0.0
    for (kind, other), needed in _MUST_TOUCH.items():
        hosts = [r for k, r in tiles if k == kind]
        for rect in (r for k, r in tiles if k == other):
            walls = [w for w in (shared_wall(h, rect) for h in hosts) if w]
            longest = max((w[3] - w[2] for w in walls), default=0.0)
            total += 20 * max(0.0, needed - longest)
    return total


def with_balcony(rng: np.random.Generator, tiles: list[Tile], width: float, depth: float) -> list[Tile]:
    """Return the tiles with a balcony cut off the outer side of the living room, or unchanged if there is no space."""
    k = next(i for i, (kind, _) in enumerate(tiles) if kind == "living")
    rect = tiles[k][1]
    x0, z0, x1, z1 = rect
    deep = float(rng.uniform(1.55, 1.95))
    options = []
    for side, (outside, spare) in enumerate(
        ((x0 == 0, x1 - x0), (z0 == 0, z1 - z0), (abs(x1 - width) < 0.006, x1 - x0), (abs(z1 - depth) < 0.006, z1 - z0))
    ):
        long = rect_area(rect) / spare
        if outside and spare - deep > 3.5 and 2.6 < long < 12:
            options.append(side)
    if not options:
        return tiles
    side = options[int(rng.random() * len(options))]
    living, balcony = list(rect), list(rect)
    living[side] = balcony[(side + 2) % 4] = round(rect[side] + (deep if side < 2 else -deep), 2)
    out = list(tiles)
    out[k] = ("living", (living[0], living[1], living[2], living[3]))
    return [*out, ("balcony", (balcony[0], balcony[1], balcony[2], balcony[3]))]


# --- small and medium homes -------------------------------------------------------------------------------------------
def _split(rng: np.random.Generator, low: float, high: float, weights: Sequence[float]) -> list[float]:
    shares = np.asarray(weights) * rng.uniform(0.85, 1.18, len(weights))
    return [low, *(low + (high - low) * np.cumsum(shares) / shares.sum())[:-1].tolist(), high]


def _public(rng: np.random.Generator, rect: Rect) -> list[Tile]:
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


_WEIGHT = {"bathroom": 0.52, "laundry": 0.4, "office": 0.75, "child": 0.85, "garage": 1.6}
"""Length of wall of a room beside the corridor, relative to a bedroom's; 1 for kinds that are not listed."""


def _strip(rng: np.random.Generator, kinds: Sequence[str], low: float, high: float) -> list[tuple[str, float, float]]:
    weights = [_WEIGHT.get(kind, 1.0) for kind in kinds]
    cuts = _split(rng, low, high, weights)
    return list(zip(kinds, cuts[:-1], cuts[1:], strict=True))


def _private(rng: np.random.Generator, program: HomePreset) -> list[str]:
    kinds = program.bedroom_kinds + ["bathroom"] * program.bathrooms
    if program.generation > 1:
        kinds += program.extra
    return rng.permutation(kinds).tolist()


def _wing(rng: np.random.Generator, shape: str, part: float, depth: float, share: float) -> tuple[float, float]:
    """Return both ends in z of the public wing, which takes ``part`` of the width; shorter than the home in L and T shapes."""
    missing = share * depth / part if shape in ("L", "T") else 0.0
    below = missing * {"L": float(rng.integers(2)), "T": rng.uniform(0.4, 0.6)}.get(shape, 0.0)
    return below, depth - (missing - below)


def _notches(ends: tuple[float, float], cut: float, depth: float) -> list[Rect]:
    pairs = ((0.0, ends[0]), (ends[1], depth))
    return [(0.0, a, cut, b) for a, b in pairs if b - a > 0.005]


def _spine_along(
    rng: np.random.Generator, width: float, depth: float, program: HomePreset, shape: str, share: float
) -> tuple[list[Tile], list[Rect]]:
    """Return the public rooms on one side; a corridor leads away from them, with private rooms on both of its sides."""
    part = rng.uniform(0.40, 0.62)
    cut = width * part
    ends = _wing(rng, shape, part, depth, share)
    corridor = rng.uniform(*CORRIDOR_WIDTH)
    private = _private(rng, program)
    first = int(rng.integers(1, len(private)))
    below, above = private[:first], private[first:]
    load = [sum(0.5 if kind == "bathroom" else 1.0 for kind in side) for side in (below, above)]
    balance = 0.5 if program.bedrooms > 1 else load[0] / sum(load)
    z0 = (depth - corridor) * float(np.clip(balance + rng.uniform(-0.06, 0.06), 0.2, 0.8))
    z1 = z0 + corridor
    tiles: list[Tile] = [("hall", (cut, z0, width, z1))]
    notches = _notches(ends, cut, depth)
    end = width
    if shape == "hook":  # the rooms above the corridor end early
        end = width - share * width * depth / (depth - z1)
        notches.append((end, z1, width, depth))
    tiles += [(kind, (a, 0.0, b, z0)) for kind, a, b in _strip(rng, below, cut, width)]
    tiles += [(kind, (a, z1, b, depth)) for kind, a, b in _strip(rng, above, cut, end)]
    return tiles + _public(rng, (0.0, ends[0], cut, ends[1])), notches


def _spine_across(
    rng: np.random.Generator, width: float, depth: float, program: HomePreset, shape: str, share: float
) -> tuple[list[Tile], list[Rect]]:
    """Return the public rooms, a corridor alongside them, and one row of private rooms behind it."""
    part = rng.uniform(0.42, 0.56)
    cut = width * part
    ends = _wing(rng, shape, part, depth, share)
    corridor = rng.uniform(*CORRIDOR_WIDTH)
    tiles: list[Tile] = [("hall", (cut, 0.0, cut + corridor, depth))]
    tiles += [(kind, (cut + corridor, a, width, b)) for kind, a, b in _strip(rng, _private(rng, program), 0.0, depth)]
    return tiles + _public(rng, (0.0, ends[0], cut, ends[1])), _notches(ends, cut, depth)


def plan_zoning(spec: HomeSpec, attempt: int) -> Zoning:
    """Return the best of up to 400 plans of a home with one corridor.

    Raises:
        SceneError: no plan was acceptable.
    """
    rng = stage_rng(spec, "rooms", attempt)
    shapes = ("rectangle", "rectangle", "rectangle", "L", "T", "hook")
    for _ in range(_SHAPES):
        # The shape is sampled before the plans: choosing the best plan of all shapes would favour the easy ones.
        shape = shapes[int(rng.integers(len(shapes)))] if spec.program.area_m2 >= _SQUARE_BELOW_M2 else "rectangle"
        plan = _best_of(rng, spec.program, shape)
        if plan is not None:
            return plan
    raise SceneError(
        f"No acceptable plan for {spec} after {_SHAPES} x {_TRIALS} trials. Hint: use another seed.",
        code="H3-SCENE-036",
    )


def _best_of(rng: np.random.Generator, program: HomePreset, shape: str) -> Zoning | None:
    usual = 24.0 + 27.0 * program.bedrooms + 13.0 * program.bathrooms
    roomy = max(1.0, program.area_m2 / usual)
    best: tuple[float, Zoning] | None = None
    for _ in range(_TRIALS):
        share = rng.uniform(NOTCH_SHARE[0] + 0.005, 0.24) if shape != "rectangle" else 0.0
        box = program.area_m2 / (1 - share)
        width = round(float(np.sqrt(box * rng.uniform(1.15, 1.6))), 2)
        depth = round(box / width, 2)
        across = program.bedrooms == 1 and shape != "hook" and rng.random() < 0.5
        raw_tiles, notches = (_spine_across if across else _spine_along)(rng, width, depth, program, shape, share)
        if program.generation > 1:
            raw_tiles = with_balcony(rng, raw_tiles, width, depth)
        tiles = tuple((kind, rounded(rect)) for kind, rect in raw_tiles)
        penalty = size_penalty(tiles, _LIMITS if program.generation == 1 else _LIMITS_2, roomy) + _touch_penalty(tiles)
        penalty += 50 * max(0.0, abs(add_up(rect_area(r) for _, r in tiles) / program.area_m2 - 1) - 0.004)
        if best is None or penalty < best[0]:
            plan = Zoning(width=width, depth=depth, tiles=tiles, notches=tuple(rounded(n) for n in notches))
            best = (penalty, plan)
        if penalty == 0:
            break
    return best[1] if best is not None and best[0] <= _WORST else None
