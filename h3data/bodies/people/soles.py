"""Legs and soles of people: positions of their joints, and points of their feet that touch the floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array

SIDES = ("left", "right")
LEG_JOINTS = np.array([[JOINT_INDEX[f"{s}_{j}"] for j in ("hip", "knee", "ankle", "foot")] for s in SIDES])
HIP, KNEE, ANKLE, TOE = range(4)
"""Columns of `LEG_JOINTS` for each joint of a leg."""


def sole_points(body: Humanoid, frames: Array) -> Array:
    """Return the heel, the point below the ball, and the toe tip of both feet, [T, 2, 3, 3] [m], from `leg_frames`."""
    legs = body.gaits.legs
    points = np.empty((len(frames), 2, 3, 3))
    for k in range(2):
        heel, ball, tip = legs.feet[k]
        ankle, toe = frames[:, k, ANKLE], frames[:, k, TOE]
        sole = np.array([0.0, -(legs.ankle_height + ball[1]), 0.0])
        points[:, k, 0] = ankle[:, :3, 3] + ankle[:, :3, :3] @ heel
        points[:, k, 1] = toe[:, :3, 3] + toe[:, :3, :3] @ sole
        points[:, k, 2] = toe[:, :3, 3] + toe[:, :3, :3] @ (tip - ball)
    return points


def runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return start and end (exclusive) of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
