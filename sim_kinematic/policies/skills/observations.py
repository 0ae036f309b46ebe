"""Observations of a learned skill on the CPU, equal to those of `h3data_training.torch.skills.worlds` on a device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.scene import FreeSpace
from sim_kinematic.motion.state import NOBODY, ROBOT
from sim_kinematic.sensing.sensor import first_point, in_frame
from sim_kinematic.sensing.table import TABLE, Pose


class SkillView(NamedTuple):
    """State of a robot that carries out a learned skill with an object."""

    free: FreeSpace
    """Floor on which the robot's base moves."""
    xz: Array
    """Position of the base on the floor [2] [m]."""
    heading: float
    before: tuple[Array, float]
    """Position [2] [m] and heading [rad] of the base one step ago."""
    point: Array
    """Point at which the object lies or has to be placed, [3] [m]."""
    stand_xz: Array
    """Position of the base from which the hand reaches the target, [2] [m]."""
    hand: Array
    """Pose (pose7) of the hand in the world, [7]."""
    resting: Array
    """Position of the hand at rest in the world, [3] [m]."""
    arm: Array
    """Positions of the arm's joints, [n] [rad or m]."""
    holds: bool
    """True if the hand holds an object."""
    beyond_m: float
    """Distance from the base within which waypoints are skipped [m]."""

    @property
    def path_m(self) -> float:
        """Length of the shortest path from the base to the stand [m]."""
        return float(self.free.geodesic(self.xz, self.stand_xz, max_snap_m=1.0))


class SkillContext:
    """View of a skill as a `sim_kinematic.sensing.table.Context` of one world, in which the path leads to the stand."""

    xp = np
    agent = ROBOT

    def __init__(self, view: SkillView) -> None:
        self._view, self.arm, self.target, self.resting = view, view.arm, view.point, view.resting
        self.now = Pose(view.xz, np.asarray(view.heading))
        self.before = Pose(*view.before)
        # one object that the agent or nobody holds: `is_holding` asks no more
        self.held_by = np.array([ROBOT if view.holds else NOBODY])

    def path(self) -> tuple[Array, Array]:
        """Return the shortest path to the stand: its length [] [m] and its first waypoint [2] [m]."""
        view, length = self._view, self._view.path_m
        return np.asarray(length), first_point(view.free, view.xz, view.stand_xz, length, beyond_m=view.beyond_m)

    def clearance(self, points: Array) -> Array:
        """Return signed distance [n] [m] of points [n, 2] to the nearest obstacle."""
        return self._view.free.signed_distance(points)

    def in_hand(self, points: Array) -> Array:
        """Return world points [n, 3] [m] in the frame of the hand."""
        return in_frame(self._view.hand, points)


def observe(view: SkillView, names: Sequence[str]) -> dict[str, NDArray[np.float32]]:
    """Return the named observations, some of `sim_kinematic.sensing.table.OF_SKILLS`, each float32 [n]."""
    moment = SkillContext(view)
    return {name: np.asarray(TABLE[name].of(moment), np.float32) for name in names}
