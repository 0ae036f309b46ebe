"""Arm poses of a person that fold the arms in narrow places."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.legs import SIDES, X, Y, Z, rotation
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.errors import InputError
from h3data.geometry import Array, quat_from_matrix

HANG_DEG, FORWARD_DEG, TWIST_DEG = 83.0, 10.0, 28.0
"""Angles of a folded upper arm [deg]: downwards from the T-pose, forwards, and inwards about its own axis, which brings
a bent forearm in front of the body."""

CLOSE_HANG_DEG, COLLAR_DEG = 88.0, 20.0
"""Angles of the folded upper arm and collar for people with planted feet [deg]. Their shoulders also move forward, so
that broad bodies are 2.5 cm narrower on each side and fit between walls 50 cm apart. Poses from clips, on which contact
tests are based, use `HANG_DEG`."""
CARRY_FORWARD_DEG, CARRY_TWIST_DEG, CARRY_COLLAR_DEG, CARRY_ELBOW_DEG = -22.0, 18.0, 10.0, 118.0
"""Angles of an arm that holds something close to the body [deg]: the elbow is at the side and slightly back, the
forearm across the belly."""

ARM_JOINTS = ("shoulder", "elbow", "wrist")
"""Joints of an arm that turn when its hand follows a given path."""


def _shoulders(forward: float, hang: float, twist: float) -> Array:
    """Return rotations of the two shoulders, [2, 4]."""
    return np.stack(
        [
            quat_from_matrix(rotation(X, -forward) @ rotation(Z, -sign * hang) @ rotation(X, twist))
            for _, sign, _ in SIDES
        ]
    )


def _about_y(degrees: float) -> Array:
    """Return rotations of two joints about the body's vertical in the T-pose, forward on both sides, [2, 4]."""
    return np.stack([quat_from_matrix(rotation(Y, -sign * degrees)) for _, sign, _ in SIDES])


COLLARS, SHOULDERS, _ELBOWS, _WRISTS = (
    np.array([JOINT_INDEX[f"{side}_{joint}"] for side, _, _ in SIDES])
    for joint in ("collar", "shoulder", "elbow", "wrist")
)
# Made once: arms are drawn in for each person in each step.
_IN = _shoulders(FORWARD_DEG, HANG_DEG, TWIST_DEG)
CLOSE_SHOULDERS = _shoulders(FORWARD_DEG, CLOSE_HANG_DEG, TWIST_DEG)
CLOSE_COLLARS = _about_y(COLLAR_DEG)
CARRY_JOINTS = np.stack([COLLARS, SHOULDERS, _ELBOWS, _WRISTS], axis=1)
"""Joints of an arm, left and right, [2, 4]."""
CARRY_CLOSE = np.stack(
    [
        _about_y(CARRY_COLLAR_DEG),
        _shoulders(CARRY_FORWARD_DEG, CLOSE_HANG_DEG, CARRY_TWIST_DEG),
        _about_y(CARRY_ELBOW_DEG),
        np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)),  # the wrist keeps to the forearm
    ],
    axis=1,
)
"""Rotations of the arm joints for holding something close to the body, [2, 4, 4]."""


def draw_in(quats: Array, arms: ArrayLike, *, shoulders_forward: bool = False) -> None:
    """Fold the arms of poses towards the body, in place.

    Args:
        quats: Local rotations [T, 55, 4] of arms that hang or swing. Shoulders and collars change; the bend of the
            elbows does not.
        arms: Degree to which the left and right arm are folded, 0 (unchanged) to 1 (close to the body), [T, 2] or [2].
        shoulders_forward: True for the closer fold of people with planted feet; False for the fold of poses from clips,
            on which contact tests are based.

    Raises:
        InputError: there are not two finite numbers for each pose; then nothing has changed.
    """
    from h3data.bodies.people.kernels.clips import tuck_all

    shares = every = np.asarray(arms, np.float64)
    if shares.shape == (2,):
        every = np.tile(shares, (len(quats), 1))
    close = CLOSE_SHOULDERS if shoulders_forward else _IN
    if every.shape != (len(quats), 2) or not tuck_all(quats, every, SHOULDERS, close):
        raise InputError(
            f"Expected how far two arms are drawn in, [{len(quats)}, 2] finite numbers, got shape {list(shares.shape)}.",
            code="H3-BODY-067",
        )
    # collars last, and only here: poses by clips, on which contact is based, keep their shoulders back
    if shoulders_forward:
        tuck_all(quats, every, COLLARS, CLOSE_COLLARS)
