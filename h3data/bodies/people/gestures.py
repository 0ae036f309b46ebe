"""Gestures: movements of the hands of somebody who stands or sits, from a few places that the wrists go to.

A place is relative to the shoulder and in lengths of the arm, so one gesture fits all bodies. The arms follow by closed-form
inverse kinematics (`h3data.bodies.people.arms.bend_arms`). A gesture repeats until it ends; each movement from place to place
starts and stops at rest, as the strokes of human gestures do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.arms import ARM_JOINTS, CARRY_JOINTS, bend_arms
from h3data.bodies.people.kernels.attention import curl_fingers
from h3data.bodies.people.legs import SIDES, X, rotation
from h3data.bodies.people.reach import Hand, grasp_point, reach_poses
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, Array, minimum_jerk, quat_from_matrix, quat_multiply, quat_nlerp

if TYPE_CHECKING:
    from h3data.bodies.people.humanoid import Humanoid

Place = tuple[float, float, float] | None
"""Place of a wrist, ahead of its shoulder, above it and outwards, in lengths of the arm; None: the hand is not used."""


class Gesture(NamedTuple):
    """A movement of the hands that repeats."""

    seconds: float
    """Duration of one repetition [s]."""
    left: tuple[Place, ...]
    """Places of the left wrist, equally spaced in time."""
    right: tuple[Place, ...]
    head_deg: float = 0.0
    """Angle by which the head is lowered."""
    least_m: float = 0.0
    """Lowest height of the wrists above the floor, over what the hands work on [m]."""
    twist_deg: float = 35.0
    """Twist of the forearm and again of the wrist; positive turns the palm down."""
    seated: bool = False
    """True if only seated people do it."""


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
    "fetch": Gesture(4.0, (None,), ((0.5, -0.3, -0.1), (0.62, -0.16, -0.1), (0.48, -0.36, -0.25), None), 6.0, 0.0, 8.0),
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
    "wave": Gesture(0.9, (None,), ((0.42, 0.2, 0.15), (0.4, 0.16, 0.45)), twist_deg=-45.0),
    "knock": Gesture(
        1.2, (None,), ((0.5, -0.05, -0.1), (0.62, 0.0, -0.1), (0.5, -0.05, -0.1), (0.62, 0.0, -0.1)), twist_deg=5.0
    ),
}
"""Gestures by name; most are those of the activities of people who live in a home (`h3data_crowds.routines`)."""
NAMES = tuple(GESTURES)
RAISED = 0.38
"""Distance below the shoulder above which no work lifts a wrist, in lengths of the arm."""


def wrists_at(gesture: Gesture, seconds: ArrayLike) -> Array:
    """Places of both wrists, and whether each is used (0 to 1), at times [T] since a gesture began, [T, 2, 4]."""
    seconds = np.asarray(seconds, np.float64)
    out = np.zeros((len(seconds), 2, 4))
    for side, keys in enumerate((gesture.left, gesture.right)):
        at = (seconds / gesture.seconds % 1.0) * len(keys)
        k = np.minimum(at.astype(np.intp), len(keys) - 1)
        share = minimum_jerk(at - k)[:, None]
        used = [key for key in keys if key is not None]
        # a hand that is not used stays at the place of the nearest movement, so that only its weight changes
        places = np.array([[*(key or (used or [(0.6, -0.5, 0.0)])[0]), float(key is not None)] for key in keys])
        out[:, side] = (1 - share) * places[k] + share * places[(k + 1) % len(keys)]
    return out


def add_gestures(body: Humanoid, quats: Array, pelvis: Array, gestures: ArrayLike) -> None:
    """Adds gestures to poses of people who stand or sit, in place.

    Args:
        body: Their body.
        quats: Local rotations [T, 55, 4]; those of arms, neck and head change.
        pelvis: Places of the pelvis in the agent root frame [T, 3].
        gestures: Number of the gesture in `NAMES`, seconds since it began, and its weight from 0 (none) to 1, [T, 3].

    Raises:
        InputError: there are not three finite numbers for each pose, or a number is that of no gesture.
    """
    gestures = np.asarray(gestures, np.float64)
    fits = gestures.shape == (len(quats), 3) and np.isfinite(gestures).all()
    if not fits or not np.isin(gestures[:, 0], np.arange(len(NAMES))).all():
        raise InputError(
            f"Expected the number of a gesture, 0 to {len(NAMES) - 1}, seconds and a weight for {len(quats)} poses, got shape "
            f"{list(gestures.shape)}.",
            code="H3-BODY-180",
        )
    joints = np.array([[JOINT_INDEX[f"{side}_{name}"] for name in ARM_JOINTS] for side, _, _ in SIDES])
    lengths = [np.linalg.norm(body.joint_offsets[pair[1:]], axis=1).sum() for pair in joints]
    # direction of the elbows: back, down and outwards
    pole = (-0.35, -0.8, 0.45)
    for number in np.unique(gestures[gestures[:, 2] > 0, 0]).astype(np.intp).tolist():
        gesture = GESTURES[NAMES[number]]
        rows = np.flatnonzero((gestures[:, 0] == number) & (gestures[:, 2] > 0))
        weight = np.clip(gestures[rows, 2], 0.0, 1.0)
        # parts of the joints in the lowering of the head
        for name, part in (("neck", 0.45), ("head", 0.55)):
            lowered = quat_from_matrix(rotation(X, part * gesture.head_deg))
            turned = np.broadcast_to(quat_multiply(lowered, quats[rows, JOINT_INDEX[name]]), (len(rows), 4))
            quats[rows, JOINT_INDEX[name]] = quat_nlerp(quats[rows, JOINT_INDEX[name]], turned, weight)
        frames = body.joint_matrices(np.tile(IDENTITY_POSE, (len(rows), 1)), quats[rows], pelvis[rows])
        wrists = wrists_at(gesture, gestures[rows, 1])
        shares = weight[:, None] * wrists[..., 3]
        wrists[..., 0] *= shares  # a hand is drawn back before it is lowered, not through the edge of a table
        targets = frames[:, joints[:, 0]][..., :3, 3].copy()
        for side, (_, sign, _) in enumerate(SIDES):  # in the agent root frame, z points to the right
            # small bodies raise the hands to the chest at most
            least = np.minimum(gesture.least_m, targets[:, side, 1] - RAISED * lengths[side])
            targets[:, side] += lengths[side] * wrists[:, side, :3] * (1.0, 1.0, -sign)
            targets[:, side, 1] = np.maximum(targets[:, side, 1], least)
        bent = bend_arms(body.joint_offsets, frames, targets, pole=pole, twist_deg=gesture.twist_deg)
        for side in range(2):
            share = np.repeat(shares[:, side], len(ARM_JOINTS))
            at = np.ix_(rows, joints[side])
            quats[at] = quat_nlerp(quats[at].reshape(-1, 4), bent[:, side].reshape(-1, 4), share).reshape(-1, 3, 4)


# --- hands that handle things ----------------------------------------------------------------------------------------------
BOTH: tuple[Hand, Hand] = ("left", "right")
"""Both hands, in the order of arrays of hands."""
CURL_RAD = 0.55
"""Bend of the fingers around what a hand holds."""
ARMS = CARRY_JOINTS[:, 1:]
"""Shoulder, elbow and wrist of the left and the right arm, [2, 3]."""


def lead_hands(body: Humanoid, quats: Array, pelvis: Array, hands: ArrayLike) -> None:
    """Leads the hands of poses of people who stand or walk, in place.

    Args:
        body: Their body.
        quats: Local rotations [T, 55, 4].
        pelvis: Places of the pelvis in the agent root frame [T, 3].
        hands: Four rows for each pose, [T, 4, 4]: the places of the left and the right palm in the agent root frame [m], each
            with the share, 0 to 1, by which the arm is led there; then the places that the left and the right hand reach for,
            each with the share of that posture of reaching in trunk and legs. The sum of the last two is at most 1.

    Raises:
        InputError: There are not as many finite numbers, or a share is below 0 or a sum of shares above 1.
    """
    hands = np.asarray(hands, np.float64)
    fits = hands.shape == (len(quats), 4, 4) and np.isfinite(hands).all() and (hands[..., 3] >= 0).all()
    if not fits or (hands[:, :2, 3] > 1).any() or (hands[:, 2:, 3].sum(1) > 1 + 1e-6).any():
        raise InputError(
            f"Expected places and shares of two palms and two postures of reaching for {len(quats)} poses, "
            f"[{len(quats)}, 4, 4], with shares from 0 to 1, got shape {list(hands.shape)}.",
            code="H3-BODY-182",
        )
    leans = hands[:, 2:, 3].sum(1)
    rows = np.flatnonzero(leans > 0)
    if len(rows):
        left, right = (reach_poses(body, hands[rows, 2 + k, :3], hand) for k, hand in enumerate(BOTH))
        share, lean = hands[rows, 3, 3] / leans[rows], np.minimum(leans[rows], 1.0)
        quats[rows] = blend_quats(quats[rows], blend_quats(left.quats, right.quats, share), lean)
        place = left.pelvis + share[:, None] * (right.pelvis - left.pelvis)
        pelvis[rows] += lean[:, None] * (place - pelvis[rows])
    rows = np.flatnonzero(hands[:, :2, 3].any(1))
    if not len(rows):
        return
    palms, own, here = hands[rows, :2, :3], quats[rows], np.tile(IDENTITY_POSE, (len(rows), 1))
    frames = body.joint_matrices(here, own, pelvis[rows])
    grips, wrists = [grasp_point(body, hand) for hand in BOTH], palms.copy()
    # the wrist is behind the palm by an offset that turns with it
    for _ in range(5):
        # the elbows point back, down and outwards
        own[:, ARMS] = bend_arms(body.joint_offsets, frames, wrists, pole=(-0.35, -0.8, 0.45), twist_deg=6.0)
        led = body.joint_matrices(here, own, pelvis[rows])[:, ARMS[:, 2], :3, :3]
        wrists = palms - np.stack([led[:, side] @ grip for side, grip in enumerate(grips)], 1)
    for side, joints in enumerate(ARMS):
        at = np.ix_(rows, joints)
        quats[at] = blend_quats(quats[at], own[:, joints], hands[rows, side, 3])
    for row in rows.tolist():
        curl_fingers(quats[row], CURL_RAD * hands[row, :2, 3])


def blend_quats(one: Array, other: Array, share: Array) -> Array:
    """Rotations [T, J, 4] blended by shares [T]."""
    return quat_nlerp(one.reshape(-1, 4), other.reshape(-1, 4), np.repeat(share, one.shape[1])).reshape(one.shape)
