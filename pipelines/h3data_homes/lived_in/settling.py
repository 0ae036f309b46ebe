"""Correction of furniture positions that overlap a wall or other furniture by a centimetre or two.

Positions are searched for models that stand parallel to the walls. A chair that is rotated by some degrees is wider,
and so are collision boxes that are larger than the model. Only pieces that overlap too deeply are moved.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from h3data.scene.records import Box
from h3data_homes.furnishing.place import Placed, Rect, RoomState, footprint, gap

DEPTH_M = 0.01
"""Depth above which overlapping boxes are moved apart [m]; `h3data scenes validate` admits this depth."""
_ROUNDS = 4
_NEAR_M = 0.1


def settle(state: RoomState) -> None:
    """Move the pieces of a room out of its walls, and rotated ones out of their neighbours."""
    for k, placed in enumerate(state.placed):
        if not placed.piece.solid or placed.y:
            continue
        placed = state.placed[k] = _off_the_walls(placed, state.interior)
        if not placed.yaw:
            continue
        rect = footprint(placed)
        near = [p for p in state.placed if p is not placed and p.piece.solid and gap(footprint(p), rect) < _NEAR_M]
        others = [box for p in near for box in _boxes(p)]
        if _deepest(placed, others)[0] > DEPTH_M:
            state.placed[k] = _moved(replace(placed, yaw=0.0), others)


def _off_the_walls(placed: Placed, interior: Rect) -> Placed:
    corners = [
        c + sx * h[0] * a[0] + sz * h[1] * a[1] for c, h, a, _, _ in _boxes(placed) for sx in (-1, 1) for sz in (-1, 1)
    ]
    if not corners:
        return placed
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    x, z = np.maximum(np.array(interior[:2]) - low, 0) - np.maximum(high - np.array(interior[2:]), 0)
    return replace(placed, x=placed.x + float(x), z=placed.z + float(z)) if max(abs(x), abs(z)) > DEPTH_M else placed


def _moved(placed: Placed, others: list[_UprightBox]) -> Placed:
    for _ in range(_ROUNDS):
        depth, (x, z) = _deepest(placed, others)
        if depth <= DEPTH_M:
            break
        placed = replace(placed, x=placed.x + depth * x, z=placed.z + depth * z)
    return placed


_UprightBox = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float, float]
"""Centre (x, z), half sizes, unit vectors along its sides [2, 2], lower and upper end."""


def _boxes(placed: Placed) -> Iterator[_UprightBox]:
    """Yield the upright boxes among the collision shapes of a piece, in the world."""
    heading = placed.quarter * np.pi / 2 + placed.yaw
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s], [s, c]])
    for shape in placed.piece.shapes:
        if isinstance(shape, Box) and shape.pose[6] == 1:
            centre = shape.pose[[0, 2]] @ turn + (placed.x, placed.z)
            y, half = placed.y + float(shape.pose[1]), shape.half_extents
            yield centre, half[[0, 2]], turn, y - float(half[1]), y + float(half[1])


def _deepest(placed: Placed, others: list[_UprightBox]) -> tuple[float, NDArray[np.float64]]:
    """Return the depth of a piece in others, and the direction (x, z) of the shortest path out."""
    found = [_depth(own, other) for own in _boxes(placed) for other in others]
    return max(found, key=lambda one: one[0], default=(0.0, np.zeros(2)))


def _depth(own: _UprightBox, other: _UprightBox) -> tuple[float, NDArray[np.float64]]:
    """Return the least overlap of two boxes along the sides of either, 0 where they are apart, and the way out on the floor."""
    best, way = np.inf, np.zeros(2)
    between = own[0] - other[0]
    for axis in (*own[2], *other[2]):
        reach = sum(float(np.abs(box[2] @ axis) @ box[1]) for box in (own, other))
        along = float(between @ axis)
        overlap = reach - abs(along)
        if overlap < best:
            best, way = overlap, axis if along >= 0 else -axis
    upright = min(own[4], other[4]) - max(own[3], other[3])
    return max(min(best, upright), 0.0), way
