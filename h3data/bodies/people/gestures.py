"""Gestures of a standing or sitting person: movements of the hands through a few positions of the wrists.

Positions are relative to the shoulder and in arm lengths, so one gesture fits all bodies. The arms follow by
closed-form inverse kinematics (`h3data.bodies.people.kernels.postures`). A gesture repeats until it ends; each movement
between two positions starts and stops at rest, as human gestures do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.people.arms import CARRY_JOINTS
from h3data.bodies.people.kernels.postures import gesture_all, lead_all, lean_all
from h3data.bodies.people.reach import ROOT_OF_BODY, Hand, reacher
from h3data.errors import InputError
from h3data.geometry import Array

if TYPE_CHECKING:
    from h3data.bodies.people.humanoid import Humanoid

Place = tuple[float, float, float] | None
"""Position of a wrist relative to its shoulder (ahead, above, outwards) in arm lengths; None if the hand is not
used."""


class Gesture(NamedTuple):
    """Repeating movement of the hands."""

    seconds: float
    """Duration of one repetition [s]."""
    left: tuple[Place, ...]
    """Positions of the left wrist, equally spaced in time."""
    right: tuple[Place, ...]
    head_deg: float = 0.0
    """Angle by which the head is lowered [deg]."""
    least_m: float = 0.0
    """Lowest height of the wrists above the floor [m], which keeps them above the surface on which the hands work."""
    twist_deg: float = 35.0
    """Twist of the forearm, and the same twist of the wrist [deg]; positive angles turn the palm down."""
    seated: bool = False
    """True if only seated people make the gesture."""


_BOOK = ((0.52, -0.42, -0.22),)
_TYPING = (0.72, -0.56, -0.12), (0.72, -0.53, -0.15)
GESTURES: dict[str, Gesture] = {
    "cook": Gesture(
        2.4,
        ((0.62, -0.6, -0.1),),
        ((0.62, -0.55, -0.33), (0.74, -0.55, -0.2), (0.62, -0.55, -0.02), (0.52, -0.55, -0.2)),
        head_deg=18.0,
        least_m=1.02,
    ),
    "wash": Gesture(
        1.6, ((0.66, -0.6, -0.3), (0.74, -0.6, -0.26)), ((0.74, -0.57, -0.26), (0.66, -0.57, -0.3)), 20.0, 0.99, 10.0
    ),
    "dress": Gesture(
        5.0,
        (None, (0.55, -0.35, -0.1), (0.62, -0.1, 0.0), None),
        ((0.52, -0.2, -0.1), (0.62, 0.1, 0.05), (0.52, -0.2, -0.1), (0.58, -0.4, 0.0)),
        twist_deg=8.0,
    ),
    "fetch": Gesture(4.0, (None,), ((0.5, -0.3, -0.1), (0.58, -0.16, -0.1), (0.48, -0.36, -0.25), None), 6.0, 0.0, 8.0),
    "eat": Gesture(
        4.5,
        ((0.6, -0.45, -0.1),),
        ((0.7, -0.45, -0.2), (0.42, 0.03, -0.36), (0.42, 0.03, -0.36), (0.7, -0.45, -0.2)),
        8.0,
        0.84,
        seated=True,
    ),
    "work": Gesture(1.1, _TYPING, _TYPING[::-1], 8.0, 0.82, 42.0, seated=True),
    "read": Gesture(
        9.0, (*_BOOK, *_BOOK), (*_BOOK, *_BOOK, *_BOOK, (0.56, -0.32, -0.3)), 22.0, 0.0, -12.0, seated=True
    ),
    "talk": Gesture(
        7.0,
        (None, None, (0.58, -0.5, 0.05), (0.66, -0.42, 0.2), (0.58, -0.5, 0.0), None, None, None),
        (None, (0.6, -0.45, -0.05), (0.72, -0.3, 0.15), (0.58, -0.5, -0.1), (0.72, -0.38, 0.1), None, None, None),
        twist_deg=-15.0,
    ),
    "phone": Gesture(5.0, (None,), (*((0.5, -0.28, -0.3),) * 5, (0.5, -0.24, -0.3)), 20.0, 0.0, -25.0),
    "wave": Gesture(0.9, (None,), ((0.3, 0.2, 0.2), (0.28, 0.16, 0.45)), twist_deg=-45.0),
    "knock": Gesture(
        1.2, (None,), ((0.5, -0.05, -0.1), (0.62, 0.0, -0.1), (0.5, -0.05, -0.1), (0.62, 0.0, -0.1)), twist_deg=5.0
    ),
    "dishes": Gesture(
        3.2,
        ((0.62, -0.6, -0.25), (0.62, -0.52, -0.25)),
        ((0.66, -0.57, -0.28), (0.72, -0.52, -0.16), (0.76, -0.57, -0.28), (0.7, -0.6, -0.36)),
        20.0,
        1.06,
        0.0,
    ),
}
"""Gestures by name; most are those of the activities of people who live in a home (`h3data_crowds.routines`)."""
NAMES = tuple(GESTURES)
POLE = np.array([-0.35, -0.8, 0.45])
"""Direction of the elbows: back, down and outwards."""
RAISED = 0.38
"""Distance below the shoulder above which no gesture lifts a wrist for a work surface, in arm lengths."""


def _keys() -> tuple[Array, NDArray[np.int64], Array]:
    """Return the places, counts and numbers of all gestures as the kernel takes them."""
    sides = [side for gesture in GESTURES.values() for side in (gesture.left, gesture.right)]
    places = np.zeros((len(sides), max(map(len, sides)), 4))
    for row, side in zip(places, sides, strict=True):
        # a hand that is not used stays at the first place, so that only its share changes
        first = next(filter(None, side), (0.6, -0.5, 0.0))
        row[: len(side)] = [[*(place or first), float(place is not None)] for place in side]
    numbers = [[g.seconds, np.radians(g.head_deg), g.least_m, np.radians(g.twist_deg)] for g in GESTURES.values()]
    counts = np.array([len(side) for side in sides]).reshape(-1, 2)
    return places.reshape(len(counts), 2, -1, 4), counts, np.array(numbers)


_KEYS = _keys()


def add_gestures(body: Humanoid, quats: Array, pelvis: Array, gestures: ArrayLike) -> None:
    """Add gestures to poses of people who stand or sit, in place.

    Args:
        body: Body of the people.
        quats: Local rotations [T, 55, 4]; those of arms, neck and head change.
        pelvis: Positions of the pelvis in the agent root frame [T, 3] [m].
        gestures: Number of the gesture in `NAMES`, seconds since it began, and its weight from 0 (none) to 1, [T, 3].

    Raises:
        InputError: there are not three finite numbers for each pose, or no gesture has one of the numbers.
    """
    gestures = np.asarray(gestures, np.float64)
    fits = gestures.shape == (len(quats), 3) and np.isfinite(gestures).all()
    if not fits or ((kinds := gestures[:, 0]) != np.clip(np.floor(kinds), 0, len(NAMES) - 1)).any():
        raise InputError(
            f"Expected the number of a gesture, 0 to {len(NAMES) - 1}, seconds and a weight for {len(quats)} poses, got shape "
            f"{list(gestures.shape)}.",
            code="H3-BODY-180",
        )
    left, right = (reacher(body, hand).body for hand in BOTH)
    gesture_all(left, right, quats, pelvis, gestures, *_KEYS, POLE, RAISED)


# --- hands that handle things ----------------------------------------------------------------------------------------------
BOTH: tuple[Hand, Hand] = ("left", "right")
"""Left and right hand, in the order in which arrays of hands hold them."""
CURL_RAD, HAND_TWIST_RAD = 0.55, 0.1
"""Bend of the fingers around a held object, and the twist of the forearm, to which the wrist adds the same twist [rad].
"""
ARMS = CARRY_JOINTS[:, 1:]
"""Joint indices of shoulder, elbow and wrist of the left and the right arm, [2, 3]."""


def lead_hands(body: Humanoid, quats: Array, pelvis: Array, hands: ArrayLike) -> None:
    """Move the hands of standing or walking people to given positions, in place.

    Args:
        body: Body of the people.
        quats: Local rotations [T, 55, 4].
        pelvis: Positions of the pelvis in the agent root frame [T, 3] [m].
        hands: Four rows for each pose, [T, 4, 4]: positions of the left and right palm in the agent root frame [m],
            each with the share, 0 to 1, by which the arm moves there; then positions that the left and right hand reach
            for, each with the share, 0 to 1, of the reaching posture in trunk and legs. The sum of the last two is at
            most 1.

    Raises:
        InputError: the shape is wrong, a number is not finite, a share is below 0, or a sum of shares is above 1.
    """
    hands = np.asarray(hands, np.float64)
    fits = hands.shape == (len(quats), 4, 4) and np.isfinite(hands).all() and (hands[..., 3] >= 0).all()
    if not fits or (hands[:, :2, 3] > 1).any() or (hands[:, 2:, 3].sum(1) > 1 + 1e-6).any():
        raise InputError(
            f"Expected places and shares of two palms and two postures of reaching for {len(quats)} poses, "
            f"[{len(quats)}, 4, 4], with shares from 0 to 1, got shape {list(hands.shape)}.",
            code="H3-BODY-182",
        )
    left, right = (reacher(body, hand) for hand in BOTH)
    table = (left.table.values, left.table.low, left.table.step, ROOT_OF_BODY)
    lean_all(left.body, right.body, *table, quats, pelvis, hands[:, 2:])
    _lead(body, quats, pelvis, hands[:, :2], 1.0, POLE, HAND_TWIST_RAD, 0.0, CURL_RAD)


def lead_wrists(
    body: Humanoid,
    quats: Array,
    pelvis: Array,
    wrists: Array,
    share: Array,
    *,
    pole: Sequence[float],
    twist_deg: float,
    wrist_deg: float = 0.0,
) -> None:
    """Move the wrists of poses [T] to target positions, in place, as far as the arms reach.

    Args:
        body: Body of the people.
        quats: Local rotations [T, 55, 4].
        pelvis: Positions of the pelvis in the agent root frame [T, 3] [m].
        wrists: Target positions of the left and the right wrist in the agent root frame [T, 2, 3] [m].
        share: Shares, 0 (unchanged) to 1 (at the target), by which the arms move [T].
        pole: Direction of the elbows: ahead, up and outwards.
        twist_deg: Twist of the forearm, and the same twist of the wrist [deg], which turns the palm down.
        wrist_deg: Extension of the wrist [deg].
    """
    hands = np.concatenate([wrists, np.broadcast_to(share[:, None, None], (*wrists.shape[:2], 1))], 2)
    _lead(body, quats, pelvis, hands, 0.0, np.array(pole), *np.radians([twist_deg, wrist_deg]).tolist(), 0.0)


def _lead(body: Humanoid, quats: Array, pelvis: Array, hands: Array, *rest: Any) -> None:
    """Call the kernel, whose last arguments are ``rest``."""
    left, right = (reacher(body, hand).body for hand in BOTH)
    lead_all(left, right, quats, pelvis, hands, *rest)
