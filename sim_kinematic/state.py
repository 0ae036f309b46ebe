"""The state of W worlds with one robot, one humanoid and O objects each: a struct of arrays, worlds first. One world is
W = 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import IDENTITY_POSE

ROBOT, HUMAN, NOBODY = 0, 1, -1
"""Who holds an object: numbers of agents, as in recordings."""


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
    robot_joints: NDArray[np.float64]
    """Joint positions of the robot [rad or m], shape [W, J]; J = 0 where no arm moves."""
    object_pose: NDArray[np.float64]
    """pose7 of what can be taken, shape [W, O, 7]."""
    held_by: NDArray[np.int64]
    """Agent that holds each object (`ROBOT`, `HUMAN`), `NOBODY` where none does, shape [W, O]."""
    grip_pose: NDArray[np.float64]
    """pose7 of each held object in the frame of the hand that holds it, shape [W, O, 7]."""

    @classmethod
    def zeros(cls, worlds: int, *, joints: int = 0, objects: int = 0) -> WorldState:
        """W worlds with everything at the origin, nothing held."""
        nowhere = np.tile(IDENTITY_POSE, (worlds, objects, 1))
        return cls(
            robot_xz=np.zeros((worlds, 2)),
            robot_heading=np.zeros(worlds),
            robot_contact=np.zeros(worlds, np.bool_),
            human_xz=np.zeros((worlds, 2)),
            human_heading=np.zeros(worlds),
            human_distance=np.zeros(worlds),
            human_set_off=np.zeros(worlds),
            human_blend=np.zeros(worlds),
            robot_joints=np.zeros((worlds, joints)),
            object_pose=nowhere,
            held_by=np.full((worlds, objects), NOBODY),
            grip_pose=nowhere.copy(),
        )

    def copy(self) -> WorldState:
        """The same state in arrays of its own."""
        return WorldState(**{name: array.copy() for name, array in vars(self).items()})
