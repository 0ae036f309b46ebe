"""Guided walking to a point of the floor by commands of speed and turn, like those of a player."""

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
from sim_kinematic.avoidance.maneuvers import plan_maneuver
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.motion.spec import BaseSpec

STEPS_PER_S = 30
ARRIVED_M = 0.01
AHEAD_RAD = 0.1
"""Largest angle between the heading and the next corner at which the guide walks forward [rad]. Above it the agent
turns on the spot, because the path clears obstacles only along its straight legs."""
STUCK_STEPS = 45
"""Number of steps without getting nearer to the next corner after which the guide gives up."""
TURN_AS_M = 0.1
"""Distance that is added per radian of angle to the next corner when progress is measured [m]."""
AGAIN_M = 0.05
"""Distance by which an agent must come nearer to the end before it tries a maneuver again [m]."""
FLOOR_SNAP_M = 0.6
"""Distance from the free floor within which a point is moved onto it [m]: people who click on the foot of a cupboard
mean the place before it."""
NEAR_M = 2.0
"""Largest distance from a clicked point that is unreachable to the nearest reachable point, to which the player is then
guided [m]."""


@dataclass
class Guide:
    """Path of one body to one goal, followed by velocity commands.

    Where only the middle of a base could pass, a base that can maneuver does so (`sim_kinematic.avoidance.maneuvers`).
    """

    free: FreeSpace
    base: BaseSpec
    """Discs and limits by which the body moves."""
    goal: Array
    """World point (x, z) at which the path ends [m]."""
    corners: list[Array]
    """Remaining world points (x, z) of the path [m]."""
    heading: float | None
    """Direction to face at the end [rad]; None for any."""
    failed: bool = False
    _commands: list[list[float]] = field(default_factory=list)
    """Rest of a maneuver: forward and turn of each step."""
    _left_m: float = math.inf
    """Length of the path from where it last had to maneuver."""
    _nearest: tuple[int, float] = (0, math.inf)
    """Corners that were left and how far the first was, turn included [m], when the body last came nearer."""
    _idle: int = 0
    """Steps since then."""

    @classmethod
    def to(cls, free: FreeSpace, base: BaseSpec, xz: Array, goal: ArrayLike, *, heading: float | None = None) -> Guide:
        """Return a guide along the shortest path over a floor, or to a point within `NEAR_M` of an unreachable goal.

        Raises:
            InputError: no path leads to the goal; the message is for the player.
        """
        path = free.path(xz, np.asarray(goal, np.float64), max_snap_m=FLOOR_SNAP_M)
        if len(path) == 0:  # what was clicked on lies on an island of the floor, or in the middle of something large
            path = free.path(xz, _nearest_reachable(free, xz, goal))
        if len(path) == 0:
            raise InputError("No path leads there.", code="H3-PLAY-020")
        return cls(free, base, path[-1], list(path[1:]), heading)

    def velocity(self, xz: Array, heading: float) -> tuple[float, float] | None:
        """Return forward velocity and turn for the next step, each from -1 to 1; None if it has arrived or `failed`."""
        if self._commands:
            forward, turn = self._commands.pop(0)
            return forward, turn
        if not self.corners and np.hypot(*(self.goal - xz)) > ARRIVED_M:  # a maneuver has ended
            self.corners = list(self.free.path(xz, self.goal, max_snap_m=FLOOR_SNAP_M)[1:])
        while self.corners and np.hypot(*(self.corners[0] - xz)) <= ARRIVED_M:
            self.corners.pop(0)
        if not self.corners:
            return self._turned(heading)
        gap = self.corners[0] - xz
        left = float(wrap_angle(math.atan2(-gap[1], gap[0]) - heading))
        far = float(np.hypot(*gap))
        self._note_progress(far + TURN_AS_M * abs(left))
        if self._idle == AVOIDANCE.maneuver_after_steps and self._plans_maneuver(xz, heading):
            return self.velocity(xz, heading)
        if self._idle > STUCK_STEPS:
            self.failed = True
            return None
        turn = _share(left, self.base.max_turn_rad_s)
        if abs(left) > AHEAD_RAD:
            return 0.0, turn
        return _share(far, self.base.max_speed_mps), turn

    def _turned(self, heading: float) -> tuple[float, float] | None:
        left = 0.0 if self.heading is None else float(wrap_angle(self.heading - heading))
        return None if abs(left) < ARRIVED_M else (0.0, _share(left, self.base.max_turn_rad_s))

    def _note_progress(self, far_m: float) -> None:
        corners, nearest = self._nearest
        if len(self.corners) != corners or far_m < nearest - 1e-3:
            self._nearest, self._idle = (len(self.corners), far_m), 0
        self._idle += 1

    def _plans_maneuver(self, xz: Array, heading: float) -> bool:
        """Plan a maneuver and the path from its end; return whether there is one.

        It returns False if the base does not maneuver, or has made no progress since its last maneuver.
        """
        if not self.base.maneuvers:
            return False
        left = float(self.free.geodesic(xz, self.goal, max_snap_m=FLOOR_SNAP_M))
        if left > self._left_m - AGAIN_M:
            return False
        self._left_m = left
        commands = plan_maneuver(self.free, self.base, xz, heading, self.goal, _NOBODY)
        if not len(commands):
            return False
        self._commands, self.corners, self._nearest = commands.tolist(), [], (0, math.inf)
        return True


_NOBODY = np.zeros((0, 3))


def _share(rest: float, per_s: float) -> float:
    """Return the share of a speed that covers ``rest`` in one step, at most all of it."""
    return max(-1.0, min(1.0, rest * STEPS_PER_S / per_s))


def _nearest_reachable(free: FreeSpace, xz: Array, goal: ArrayLike) -> Array:
    """Return point (x, z) nearest to ``goal`` that can be reached from ``xz``; NaN if farther away than `NEAR_M`."""
    island = int(free.island(free.snap(xz)))
    there = shapely.Point(np.asarray(goal, np.float64))
    if island < 0 or free.polygon.geoms[island].distance(there) > NEAR_M:
        return np.full(2, np.nan)
    nearest, _ = nearest_points(free.polygon.geoms[island], there)
    return np.array([nearest.x, nearest.y])
