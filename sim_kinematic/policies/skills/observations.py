"""What a learned skill is shown, on the CPU: `h3data_training.torch.skills.worlds` shows the same on a device."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.scene import FreeSpace
from sim_kinematic.sensing.sensor import egomotion, gps_compass, in_frame, range_scan, way

Floats = NDArray[np.floating]


class SkillView(NamedTuple):
    """A moment of a robot that has one thing to do."""

    free: FreeSpace
    """The floor for its base."""
    xz: Array
    """[2] [m]."""
    heading: float
    before: tuple[Array, float]
    """Where it was a step ago."""
    point: Array
    """Where the object lies, or is to go, [3] [m]."""
    stand_xz: Array
    """A place from which the hand reaches that, [2] [m]."""
    hand: Array
    """pose7 of the hand in the world."""
    resting: Array
    """Where the hand would be at rest, [3] [m]."""
    arm: Array
    """Positions of the arm's joints [n]."""
    holds: bool
    """The hand holds something."""
    beyond_m: float
    """Way points nearer than this are passed over."""

    @property
    def path_m(self) -> float:
        """Length of the shortest path to the stand [m]."""
        return float(self.free.geodesic(self.xz, self.stand_xz, max_snap_m=1.0))


def _way(view: SkillView) -> Floats:
    return way(view.free, view.xz, view.heading, view.stand_xz, view.path_m, beyond_m=view.beyond_m)


SENSES: Mapping[str, Callable[[SkillView], Floats]] = {
    "way": _way,
    "target_gps_compass": lambda view: gps_compass(view.xz, view.heading, view.point[[0, 2]]),
    "target_sensor": lambda view: in_frame(view.hand, view.point[None])[0],
    "resting_sensor": lambda view: in_frame(view.hand, view.resting[None])[0],
    "arm_joints": lambda view: view.arm,
    "is_holding": lambda view: np.array([view.holds], np.float64),
    "range_scan": lambda view: range_scan(view.free, view.xz, view.heading),
    "egomotion": lambda view: egomotion(*view.before, view.xz, view.heading),
}


def observe(view: SkillView, names: Sequence[str]) -> dict[str, NDArray[np.float32]]:
    """The named observations, float32."""
    return {name: np.asarray(SENSES[name](view), np.float32) for name in names}
