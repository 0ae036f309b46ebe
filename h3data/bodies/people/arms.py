"""Arms drawn in towards the body: how a person who walks along a wall, or through a narrow place, carries them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.legs import SIDES, X, Z, rotation
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.errors import InputError
from h3data.geometry import Array, quat_from_matrix

HANG_DEG, FORWARD_DEG, TWIST_DEG = 83.0, 10.0, 28.0
"""A drawn-in upper arm: so far down from the T-pose, swung forward, and turned inwards about itself, which brings a bent
forearm in front of the body."""

_SHOULDERS = np.array([JOINT_INDEX[f"{side}_shoulder"] for side, _, _ in SIDES])
_IN = np.stack(
    [
        quat_from_matrix(rotation(X, -FORWARD_DEG) @ rotation(Z, -sign * HANG_DEG) @ rotation(X, TWIST_DEG))
        for _, sign, _ in SIDES
    ]
)
"""Rotations of the two shoulders then, [2, 4]."""


def draw_in(quats: Array, arms: ArrayLike) -> None:
    """Draw the arms of poses in, in place.

    Args:
        quats: Local rotations [T, 55, 4] of arms that hang or swing. Only the shoulders change: elbows keep what they do.
        arms: How far the left and the right arm are drawn in, 0 (as they are) to 1 (close to the body), [T, 2] or [2].

    Raises:
        InputError: there are not two finite numbers for each pose; then nothing has changed.
    """
    from h3data.bodies.people.kernels.clips import tuck_all

    shares = every = np.asarray(arms, np.float64)
    if shares.shape == (2,):
        every = np.tile(shares, (len(quats), 1))
    if every.shape != (len(quats), 2) or not tuck_all(quats, every, _SHOULDERS, _IN):
        raise InputError(
            f"Expected how far two arms are drawn in, [{len(quats)}, 2] finite numbers, got shape {list(shares.shape)}."
        )
