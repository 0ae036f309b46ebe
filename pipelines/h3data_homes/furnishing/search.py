"""Search for positions of furniture groups along walls, in corners or free-standing; the first good one is used."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from h3data_homes.furnishing.place import (
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
    turned,
    walkable,
    wall_point,
)
from h3data_homes.zoning import Rect

_SLACK = 1e-6
"""Tolerance of overlaps, as in `fits` [m]."""


def _extent(members: Sequence[Member]) -> tuple[float, float]:
    """Return the smallest and largest x of a group in its own frame."""
    rects = [around(m.x, m.z, m.piece.size[0], m.piece.size[2], m.quarter) for m in members if m.piece.solid]
    return min(r[0] for r in rects), max(r[2] for r in rects)


def _floor_rects(members: Sequence[Member]) -> list[list[Rect]]:
    """Plan rectangles of a group's solid pieces relative to its origin, for each quarter turn."""
    pieces = [m for m in members if m.piece.solid and m.y == 0]
    return [
        [around(*turned(side, m.x, m.z), m.piece.size[0], m.piece.size[2], side + m.quarter) for m in pieces]
        for side in range(4)
    ]


def _blocked(state: RoomState, origin: tuple[float, float], rects: Sequence[Rect], taken: Sequence[Rect]) -> bool:
    """Return whether a group leaves the room or overlaps taken floor: the first tests of `fits`, before the group is built."""
    (x, z), (a0, b0, a1, b1) = origin, state.interior
    for low_x, low_z, high_x, high_z in rects:
        x0, z0, x1, z1 = x + low_x + _SLACK, z + low_z + _SLACK, x + high_x - _SLACK, z + high_z - _SLACK
        if x0 < a0 or z0 < b0 or x1 > a1 or z1 > b1:
            return True
        for p0, q0, p1, q1 in taken:
            if x0 < p1 and p0 < x1 and z0 < q1 and q0 < z1:
                return True
    return False


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
    """Return (cost, u) of promising positions of a group's origin along a wall; its ends are ``low`` and ``high``."""
    a, b = side_span(state.interior, side)
    first, last = a - low + 0.02, b - high - 0.02
    if last < first:
        return []
    positions = [(0.0 if corner else 0.5, first), (0.0 if corner else 0.5, last)]
    if only_corner:
        return positions
    positions.append((0.0 if middle else 0.8, (first + last) / 2))
    positions += [(0.6, float(u)) for u in rng.uniform(first, last, 6)]
    axis = side % 2
    along = strip(state.interior, side, a, b, 0.5)
    for rect in (*state.solids, *state.keep):
        if overlap(rect, along):
            positions += [(0.3, rect[axis] - high - 0.01), (0.3, rect[axis + 2] - low + 0.01)]
    return [(cost, u) for cost, u in positions if first <= u <= last]


def mirrored(side: int) -> bool:
    """Return whether a group's +x axis points towards lower ``u`` at this side of a room."""
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
    """Place a group against a wall and return it, or return None if no position passes the tests.

    Args:
        rng: Source of random positions.
        state: State of the room, to which the group is added.
        members: Pieces of the group.
        corner: Prefer corners.
        middle: Prefer the middle of a wall.
        only_corner: Accept corners only.
        left_corner: Accept only corners with a wall on the group's left.
        sides: Walls to try.
        tries: Number of positions that are tested with the expensive function `walkable`.
    """
    x0, x1 = _extent(members)
    rects, taken = _floor_rects(members), (*state.solids, *state.fronts, *state.keep)
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
        origin = wall_point(state.interior, side, u)
        if _blocked(state, origin, rects[side], taken):
            continue
        group = at(state, members, origin, side)
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
    """Place a free-standing group where most space remains around it and return it, or return None.

    ``members`` are given relative to the group's centre.
    """
    x0, z0, x1, z1 = state.interior
    rects, taken = _floor_rects(members), (*state.solids, *state.fronts, *state.keep)
    options = []
    for _ in range(40):
        origin, side = (float(rng.uniform(x0, x1)), float(rng.uniform(z0, z1))), int(rng.integers(4))
        if _blocked(state, origin, rects[side], taken):
            continue
        group = at(state, members, origin, side)
        if not fits(state, group):
            continue
        rectangles = [footprint(p) for p in group]
        space = min(
            min((gap(r, s) for r in rectangles for s in (*state.solids, *state.keep)), default=2.0),
            min(min(r[0] - x0, r[1] - z0, x1 - r[2], z1 - r[3]) for r in rectangles),
        )
        options.append((-min(space, 1.2), len(options), group))
    for _, _, group in sorted(options)[:tries]:
        if walkable(state, group):
            commit(state, group)
            return group
    return None
