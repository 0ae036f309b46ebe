"""Walking to a point of the floor by commands of speed and turn, as a player would steer."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely.ops import nearest_points

from h3data.errors import InputError
from h3data.geometry import Array, wrap_angle
from h3data.scene import FreeSpace

STEPS_PER_S = 30
ARRIVED_M = 0.01
AHEAD_RAD = 0.1
"""Walks while the next corner is at most this far off the heading, else turns on the spot: the path clears obstacles only
along its straight legs."""
STUCK_STEPS, STUCK_M = 45, 0.05
"""Gives up after this many steps without getting on by this distance."""
FLOOR_SNAP_M = 0.6
"""A point this far off the free floor is moved onto it: people click on the foot of a cupboard and mean the place before it."""
NEAR_M = 2.0
"""Who clicks on floor that cannot be reached is led as near as possible, if that is at most this far from it."""


@dataclass
class Guide:
    """The path of one body to one place."""

    corners: list[Array]
    """Points (x, z) still to be reached."""
    heading: float | None
    """Direction to face at the end [rad]; None: any."""
    speed_mps: float
    turn_rad_s: float
    failed: bool = False
    _best: float = math.inf
    _idle: int = 0
    _last: Array = field(default_factory=lambda: np.zeros(2))

    @classmethod
    def to(
        cls, free: FreeSpace, xz: Array, goal: ArrayLike, *, speed_mps: float, turn_rad_s: float,
        heading: float | None = None,
    ) -> Guide:  # fmt: skip
        """The shortest path over a floor; to the nearest point within `NEAR_M` of a goal that cannot be reached.

        Raises:
            InputError: no path leads there; the text is for the player.
        """
        path = free.path(xz, np.asarray(goal, np.float64), max_snap_m=FLOOR_SNAP_M)
        if len(path) == 0:  # what was clicked on lies on an island of the floor, or in the middle of something large
            path = free.path(xz, _nearest_reachable(free, xz, goal))
        if len(path) == 0:
            raise InputError("No path leads there.")
        return cls(list(path[1:]), heading, speed_mps, turn_rad_s, _last=np.array(xz))

    def velocity(self, xz: Array, heading: float) -> tuple[float, float] | None:
        """Forward and turn, -1..1 each, for the next step; None: it has arrived, or has `failed`."""
        while self.corners and np.hypot(*(self.corners[0] - xz)) <= ARRIVED_M:
            self.corners.pop(0)
        if not self.corners:
            return self._turned(heading)
        if self._is_stuck(xz):
            self.failed = True
            return None
        gap = self.corners[0] - xz
        left = float(wrap_angle(math.atan2(-gap[1], gap[0]) - heading))
        turn = _share(left, self.turn_rad_s)
        if abs(left) > AHEAD_RAD:
            return 0.0, turn
        return _share(float(np.hypot(*gap)), self.speed_mps), turn

    def _turned(self, heading: float) -> tuple[float, float] | None:
        left = 0.0 if self.heading is None else float(wrap_angle(self.heading - heading))
        return None if abs(left) < ARRIVED_M else (0.0, _share(left, self.turn_rad_s))

    def _is_stuck(self, xz: Array) -> bool:
        moved = float(np.hypot(*(xz - self._last)))
        if moved > STUCK_M:
            self._last, self._idle = np.array(xz), 0
        self._idle += 1
        return self._idle > STUCK_STEPS


def _share(rest: float, per_s: float) -> float:
    """The share of a speed that covers ``rest`` in one step, at most all of it."""
    return max(-1.0, min(1.0, rest * STEPS_PER_S / per_s))


def _nearest_reachable(free: FreeSpace, xz: Array, goal: ArrayLike) -> Array:
    """The point (x, z) nearest to ``goal`` that can be reached from ``xz``; NaN if it is farther away than `NEAR_M`."""
    island = int(free.island(free.snap(xz)))
    there = shapely.Point(np.asarray(goal, np.float64))
    if island < 0 or free.polygon.geoms[island].distance(there) > NEAR_M:
        return np.full(2, np.nan)
    nearest, _ = nearest_points(free.polygon.geoms[island], there)
    return np.array([nearest.x, nearest.y])
