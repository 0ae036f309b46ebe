"""The search for places: along walls, in corners, free in a room; the first good one of some is taken."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from h3data.scene.homes.place import (
    Member,
    Placed,
    RoomState,
    around,
    at,
    commit,
    fits,
    footprint,
    gap,
    overlap,
    side_span,
    strip,
    walkable,
    wall_point,
)


def _extent(members: Sequence[Member]) -> tuple[float, float]:
    """Smallest and largest x of a group in its own frame."""
    rects = [around(m.x, m.z, m.piece.size[0], m.piece.size[2], m.quarter) for m in members if m.piece.solid]
    return min(r[0] for r in rects), max(r[2] for r in rects)


def _positions(
    rng: np.random.Generator,
    state: RoomState,
    side: int,
    low: float,
    high: float,
    *,
    corner: bool,
    middle: bool,
    only_corner: bool,
) -> list[tuple[float, float]]:
    """(cost, u) of promising places of a group's origin along a wall; ``low`` and ``high`` are its ends about u."""
    a, b = side_span(state.interior, side)
    first, last = a - low + 0.02, b - high - 0.02
    if last < first:
        return []
    found = [(0.0 if corner else 0.5, first), (0.0 if corner else 0.5, last)]
    if only_corner:
        return found
    found.append((0.0 if middle else 0.8, (first + last) / 2))
    found += [(0.6, float(u)) for u in rng.uniform(first, last, 6)]
    axis = side % 2
    along = strip(state.interior, side, a, b, 0.5)
    for rect in (*state.solids, *(k for k in state.keep)):
        if overlap(rect, along):
            found += [(0.3, rect[axis] - high - 0.01), (0.3, rect[axis + 2] - low + 0.01)]
    return [(cost, u) for cost, u in found if first <= u <= last]


def mirrored(side: int) -> bool:
    """Whether a group's +x points to lower u on this side."""
    return side in (1, 2)


def place_at_wall(
    rng: np.random.Generator,
    state: RoomState,
    members: Sequence[Member],
    *,
    corner: bool = False,
    middle: bool = False,
    only_corner: bool = False,
    left_corner: bool = False,
    sides: Sequence[int] = (0, 1, 2, 3),
    tries: int = 6,
) -> list[Placed] | None:
    """Puts a group against some wall and gives it back, or None if no place is good.

    ``corner`` or ``middle`` of a wall is preferred; ``only_corner`` refuses the rest of the wall; ``left_corner`` insists
    on a wall at the group's left.
    """
    x0, x1 = _extent(members)
    options = []
    for side in sides:
        low, high = (-x1, -x0) if mirrored(side) else (x0, x1)
        places = _positions(rng, state, side, low, high, corner=corner, middle=middle, only_corner=only_corner)
        if left_corner:
            a, b = side_span(state.interior, side)
            end = b - high - 0.015 if mirrored(side) else a - low + 0.015
            places = [(0.0, end)] if places else []
        options += [(cost + rng.uniform(0, 0.5), side, u) for cost, u in places]
    for _, side, u in sorted(options):
        group = at(state, members, wall_point(state.interior, side, u), side)
        if not fits(state, group):
            continue
        if walkable(state, group):
            commit(state, group)
            return group
        tries -= 1
        if tries <= 0:
            break
    return None


def place_free(
    rng: np.random.Generator, state: RoomState, members: Sequence[Member], *, tries: int = 5
) -> list[Placed] | None:
    """Puts a group (given about its own middle) where most room is left round it, or gives None."""
    x0, z0, x1, z1 = state.interior
    options = []
    for _ in range(40):
        origin, side = (float(rng.uniform(x0, x1)), float(rng.uniform(z0, z1))), int(rng.integers(4))
        group = at(state, members, origin, side)
        if not fits(state, group):
            continue
        rects = [footprint(p) for p in group]
        room = min(
            min((gap(r, s) for r in rects for s in (*state.solids, *state.keep)), default=2.0),
            min(min(r[0] - x0, r[1] - z0, x1 - r[2], z1 - r[3]) for r in rects),
        )
        options.append((-min(room, 1.2), len(options), group))
    for _, _, group in sorted(options)[:tries]:
        if walkable(state, group):
            commit(state, group)
            return group
    return None
