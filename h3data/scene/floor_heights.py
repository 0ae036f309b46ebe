"""Floor heights of homes whose storeys lie side by side in the plan and are joined by stairs.

The floor is one height field over the plan. For the motion of agents, a flight of stairs is a ramp (`height_at`); feet
stand on its treads (`tread_at`). A point belongs to the room whose rectangle is nearest, so points in doorways and
walls have a height too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.kernels import kernel, kernel_part
from h3data.scene.records import Room

X0, Z0, X1, Z1, LOW, HIGH, AXIS, START, END, STEPS = range(10)
"""Columns of a table of heights: the rectangle [m]; heights at both ends of its ramp [m], equal if it is level; axis (0 = x,
1 = z) and coordinates of the ramp's ends [m]; number of risers."""
COLUMNS = 10
LEVEL: NDArray[np.float64] = np.zeros((0, COLUMNS))
"""Table of heights of a floor that is level everywhere, at the height `FloorMap.floor_y`."""


def room_heights(rooms: Iterable[Room]) -> NDArray[np.float64]:
    """Return the table of heights [K, 10] of rooms that stairs join; `LEVEL` if there are no stairs."""
    rooms = tuple(rooms)
    # rooms at several heights without stairs are separate floors, of which an agent stays on one
    if all(room.ramp is None for room in rooms):
        return LEVEL
    rows = []
    for room in rooms:
        ramp = room.ramp
        # a room without a ramp has equal heights at both ends, which lie 0 to 1 so that nothing divides by zero
        tail = (
            (room.floor_y, 0, 0.0, 1.0, 0)
            if ramp is None
            else (ramp.top_y, ramp.axis, ramp.start, ramp.end, ramp.steps)
        )
        rows += [(*rectangle, room.floor_y, *tail) for rectangle in np.asarray(room.rectangles, np.float64).tolist()]
    return np.array(rows, np.float64)


def flight_rectangle(row: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return the plan rectangle ``x0 z0 x1 z1`` of the ramp in a row of a table of heights, without the landings [m]."""
    low, high = sorted((float(row[START]), float(row[END])))
    x0, z0, x1, z1 = row[:4].tolist()
    return (low, z0, high, z1) if row[AXIS] == 0 else (x0, low, x1, high)


@kernel_part()
def _nearest(heights, x, z):
    """Return the row whose rectangle is nearest to a place."""
    best, least = 0, math.inf
    for k in range(len(heights)):
        dx = max(heights[k, X0] - x, x - heights[k, X1], 0.0)
        dz = max(heights[k, Z0] - z, z - heights[k, Z1], 0.0)
        far = dx * dx + dz * dz
        if far < least:
            best, least = k, far
            # inside, and nothing is nearer
            if far == 0.0:
                break
    return best


@kernel_part()
def height_at(heights, floor_y, x, z):
    """Return the height of the floor at (x, z) [m], with stairs as ramps, or ``floor_y`` where the table is empty."""
    if heights.shape[0] == 0:
        return floor_y
    k = _nearest(heights, x, z)
    low, high = heights[k, LOW], heights[k, HIGH]
    if low == high:
        return low
    along = x if heights[k, AXIS] == 0.0 else z
    # clipped: beyond its ends a stairwell has level landings
    share = (along - heights[k, START]) / (heights[k, END] - heights[k, START])
    return low + (high - low) * min(max(share, 0.0), 1.0)


@kernel_part()
def step_at(heights, x, z):
    """Return the flight of stairs and tread at (x, z).

    Returns the row of the flight, -1 if there is none; the number of the tread, which is how many risers are below the
    point; and the position along the flight, in treads from the ramp's lower end.
    """
    if heights.shape[0] == 0:
        return -1, 0, 0.0
    k = _nearest(heights, x, z)
    if heights[k, STEPS] == 0.0:
        return -1, 0, 0.0
    along = x if heights[k, AXIS] == 0.0 else z
    place = (along - heights[k, START]) / (heights[k, END] - heights[k, START]) * heights[k, STEPS]
    return k, int(min(max(math.floor(place + 0.5), 0.0), heights[k, STEPS])), place


@kernel_part()
def way_to_stairs(heights, x, z):
    """Return the distance [m] along a stairwell from (x, z) to its stairs; 0 on them, infinite anywhere else."""
    k, _, place = step_at(heights, x, z)
    if k < 0:
        return math.inf
    beyond = max(-place, place - heights[k, STEPS], 0.0)
    return beyond * abs(heights[k, END] - heights[k, START]) / heights[k, STEPS]


@kernel_part()
def tread_at(heights, floor_y, x, z):
    """Return the height [m] of the floor or tread under a foot at (x, z)."""
    k, tread, _ = step_at(heights, x, z)
    if k < 0:
        return height_at(heights, floor_y, x, z)
    return heights[k, LOW] + (heights[k, HIGH] - heights[k, LOW]) * tread / heights[k, STEPS]


@kernel_part()
def nose_at(heights, floor_y, x, z):
    """Return the height [m] of the plane through the noses of the steps at (x, z), no lower than a tread.

    Off the stairs this is the height of the floor.
    """
    k, tread, place = step_at(heights, x, z)
    if k < 0:
        return height_at(heights, floor_y, x, z)
    rise = (heights[k, HIGH] - heights[k, LOW]) / heights[k, STEPS]
    level = heights[k, LOW] + rise * tread
    # within half a tread of the first riser the plane begins
    return max(level, heights[k, LOW] + rise * min(place + 0.5, heights[k, STEPS])) if place > 0.0 else level


_RAMPS, _TREADS, _NOSES = range(3)


@kernel()
def _all_heights(heights, floor_y, points, what, out):
    for n in range(len(points)):
        x, z = points[n, 0], points[n, 1]
        if what == _TREADS:
            out[n] = tread_at(heights, floor_y, x, z)
        elif what == _NOSES:
            out[n] = nose_at(heights, floor_y, x, z)
        else:
            out[n] = height_at(heights, floor_y, x, z)


@kernel()
def _off_risers(heights, points, gap):
    for n in range(len(points)):
        k, tread, place = step_at(heights, points[n, 0], points[n, 1])
        if k < 0:
            continue
        going = (heights[k, END] - heights[k, START]) / heights[k, STEPS]
        # away from the lower riser, then from the upper one, which wins where a tread is too short for both
        to = place
        if tread > 0:
            to = max(to, tread - 0.5 + gap / abs(going))
        if tread < heights[k, STEPS]:
            to = min(to, tread + 0.5 - gap / abs(going))
        points[n, 0 if heights[k, AXIS] == 0.0 else 1] += (to - place) * going


def _measured(heights: NDArray[np.float64], floor_y: float, points: ArrayLike, what: int) -> NDArray[np.float64]:
    places = np.asarray(points, np.float64)
    if not len(heights):
        return np.full(places.shape[:-1], floor_y)
    out = np.empty(places.shape[:-1])
    _all_heights(heights, float(floor_y), np.ascontiguousarray(places.reshape(-1, 2)), what, out.reshape(-1))
    return out


def floor_heights(
    heights: NDArray[np.float64], floor_y: float, points: ArrayLike, *, treads: bool = False
) -> NDArray[np.float64]:
    """Return heights [...] [m] of the floor at points (x, z) [..., 2], with stairs as ramps, or as steps with ``treads``.

    Args:
        heights: A table of heights [K, 10] (`room_heights`).
        floor_y: Height of the floor where the table is empty [m].
        points: Floor points (x, z) [..., 2] [m]; points with NaN get the height of any room.
        treads: True for the height of the tread under a foot; False for the height of the ramp through the stairs.
    """
    return _measured(heights, floor_y, points, _TREADS if treads else _RAMPS)


def nose_heights(heights: NDArray[np.float64], floor_y: float, points: ArrayLike) -> NDArray[np.float64]:
    """Return heights [...] [m] of the plane through the noses of the steps at points (x, z) [..., 2].

    Off the stairs these are the heights of the floor.
    """
    return _measured(heights, floor_y, points, _NOSES)


def off_risers(heights: NDArray[np.float64], points: ArrayLike, *, gap_m: float = 0.05) -> NDArray[np.float64]:
    """Move points (x, z) [N, 2] along the stairs so that they are at least ``gap_m`` from every riser."""
    places = np.array(points, np.float64)
    if len(heights):
        _off_risers(heights, places, gap_m)
    return places
