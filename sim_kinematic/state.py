"""The state of W worlds with one robot and one humanoid each: a struct of arrays, worlds first. One world is W = 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class WorldState:
    """Everything that a step reads and writes. The arrays are changed in place; `copy` keeps a moment."""

    robot_xz: NDArray[np.float64]
    """Base position on the floor [m], shape [W, 2]."""
    robot_heading: NDArray[np.float64]
    """[rad], shape [W]. Headings are never wrapped: the quaternion of h + 2 pi is minus that of h, so recorded quaternions
    keep their signs continuous in time."""
    robot_contact: NDArray[np.bool_]
    """The base touched an obstacle in the last step, shape [W]."""
    human_xz: NDArray[np.float64]
    """[m], shape [W, 2]."""
    human_heading: NDArray[np.float64]
    """[rad], shape [W]."""
    human_distance: NDArray[np.float64]
    """Distance walked since the start [m], drives the phase of the walking cycle; shape [W]."""
    human_set_off: NDArray[np.float64]
    """What `human_distance` was when she last set off from standing [m]: there the cycle began anew; shape [W]."""
    human_blend: NDArray[np.float64]
    """0 = standing, 1 = walking, shape [W]."""

    @classmethod
    def zeros(cls, worlds: int) -> WorldState:
        """W worlds with everything at the origin."""
        return cls(
            robot_xz=np.zeros((worlds, 2)),
            robot_heading=np.zeros(worlds),
            robot_contact=np.zeros(worlds, np.bool_),
            human_xz=np.zeros((worlds, 2)),
            human_heading=np.zeros(worlds),
            human_distance=np.zeros(worlds),
            human_set_off=np.zeros(worlds),
            human_blend=np.zeros(worlds),
        )

    def copy(self) -> WorldState:
        """The same state in arrays of its own."""
        return WorldState(**{name: array.copy() for name, array in vars(self).items()})
