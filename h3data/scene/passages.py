"""Doors between rooms: parts of a home that block paths when they are closed, and the floor with all of them open."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import Polygon

from h3data.scene.articulation import joints_of, posed
from h3data.scene.floor_heights import floor_heights, room_heights
from h3data.scene.freespace._footprints import shape_footprint
from h3data.scene.freespace.free_space import FreeSpace
from h3data.scene.records import Scene, Shape, instance_matrix
from h3data.scene.shape_bounds import shape_bounds

LEAST_M, FOOT_M = 1.6, 0.3
"""Smallest height of doors over the floor, and largest height of their lower edge [m]."""


@lru_cache(maxsize=64)
def passages(scene: Scene, free: FreeSpace) -> tuple[int, ...]:
    """Return the indices of the joints whose closed part blocks the floor, which are the doors between rooms.

    Args:
        scene: The scene.
        free: Free floor of the scene for the agents that walk there.
    """
    joints = joints_of(scene)
    # the fronts of cupboards and wardrobes enclose receptacles; a door between rooms does not
    tall = [k for k, (_, part) in enumerate(joints.parts) if not part.encloses and _is_tall(scene, k, free.floor_y)]
    if not tall:
        return ()
    # with all of them open, since a closed door may stand in the way of what another one blocks
    wide = joints.rest.copy()
    wide[tall] = joints.opened[tall]
    floor = free.as_in(posed(scene, wide)).polygon
    closed = joints.rest.copy()
    closed[tall] = joints.closed[tall]
    return tuple(k for k in tall if any(floor.intersects(outline) for outline in outlines(scene, k, closed)))


def passable(scene: Scene, free: FreeSpace) -> Scene:
    """Return the scene with the doors between its rooms open; the scene itself if none is closed."""
    doors = list(passages(scene, free))
    joints = joints_of(scene)
    positions = joints.rest.copy()
    positions[doors] = joints.opened[doors]
    return posed(scene, positions)


def outlines(scene: Scene, k: int, positions: ArrayLike) -> list[Polygon]:
    """Return outlines on the floor (x, z) [m] of the parts that joint ``k`` moves, with all joints at ``positions`` [J]."""
    motion = joints_of(scene).motions(positions)[k]
    found = (shape_footprint(shape, motion @ matrix, -np.inf, np.inf) for matrix, shape in _shapes(scene, k))
    return [outline for outline in found if outline is not None]


def _shapes(scene: Scene, k: int) -> list[tuple[NDArray[np.float64], Shape]]:
    """Return the shapes of a part, each with the matrix that puts it into the world with the joints at rest."""
    own = set(joints_of(scene).parts[k][1].instances)
    moved = [i for i in scene.static_instances if i.name in own]
    return [(instance_matrix(i), shape) for i in moved for shape in scene.assets[i.asset].shapes]


def _is_tall(scene: Scene, k: int, floor_y: float) -> bool:
    """Return whether a part reaches from near the floor to over most heads."""
    bounds = np.array([shape_bounds(shape, matrix) for matrix, shape in _shapes(scene, k)]).reshape(-1, 2, 3)
    if not len(bounds):
        return False
    low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
    # of the storey that the door is on
    floor = float(floor_heights(room_heights(scene.rooms), floor_y, (low + high)[[0, 2]] / 2))
    return low[1] < floor + FOOT_M and high[1] > floor + LEAST_M
