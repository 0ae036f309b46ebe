"""Hands that handle things: palms are led to places, and the trunk leans as far as reaching them takes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.arms import CARRY_JOINTS, bend_arms
from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.kernels.attention import curl_fingers
from h3data.bodies.people.reach import Hand, grasp_point, reach_poses
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, Array, quat_nlerp

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
            code="H3-BODY-181",
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
