"""Compiled kernels that add activities to poses: gestures, hands at given positions, and blends of poses.

Poses are in the agent root frame (x forward, y up, z right).
"""

from __future__ import annotations

import math

import numpy as np

from h3data.bodies.people.kernels.attention import curl_fingers
from h3data.bodies.people.kernels.hands import chest_of
from h3data.bodies.people.kernels.reach import MEASURE_COUNT, PARAMETER_COUNT, pose_arm, reach_one
from h3data.bodies.people.kernels.tuple_math import (
    dot,
    from_vector,
    multiply,
    nlerp,
    plus,
    put,
    row3,
    row4,
    turned,
)
from h3data.bodies.people.skeleton import FINGERS, JOINT_INDEX
from h3data.kernels import kernel, kernel_part

BODY_JOINTS = min(JOINT_INDEX[f"left_{finger}1"] for finger in FINGERS)
"""Number of joints before those of fingers, which neither seats nor reaching change."""
_NECK, _HEAD = JOINT_INDEX["neck"], JOINT_INDEX["head"]


@kernel_part()
def _shoulder(body, quats, pelvis):
    """Return the rotation of the collar and place of the shoulder on the side of a `ReachBody`."""
    chest, at = chest_of(body.offsets, quats, pelvis)
    collar = multiply(chest, row4(quats, body.joints[0]))
    at = plus(at, turned(chest, row3(body.offsets, body.joints[0])), 1.0)
    return collar, plus(at, turned(collar, row3(body.offsets, body.joints[1])), 1.0)


@kernel_part()
def _lead(body, quats, collar, shoulder, place, palm, pole, twist, extension, share):
    """Lead the wrist (``palm`` 0) or the palm (1) of a `ReachBody` to a place by a share, as far as the arm reaches."""
    joints, fore = body.joints, from_vector(twist, 0.0, 0.0)
    own, wrist = (row4(quats, joints[1]), row4(quats, joints[2]), row4(quats, joints[3])), row3(body.offsets, joints[3])
    hand = multiply(fore, from_vector(0.0, 0.0, body.sign * extension))
    # the point by a forearm that is not twisted yet
    grip = plus(wrist, turned(hand, (body.palm[0], body.palm[1], body.palm[2])), palm)
    grip = plus(turned(fore, grip), wrist, -1.0)
    pose_arm(body, grip, collar, shoulder, place, (pole[0], pole[1], -body.sign * pole[2]), quats)
    led = (row4(quats, joints[1]), multiply(row4(quats, joints[2]), fore), hand)
    for k in range(3):
        put(quats, joints[1 + k], nlerp(own[k], led[k], share))


@kernel(error_model="numpy")
def lead_all(left, right, quats, pelvis, hands, palm, pole, twist, extension, curl):
    """Move both arms of poses, in place, to ``hands`` [T, 2, 4]: positions [m], and shares of the motion from 0 to 1.

    The positions are of the wrists (``palm`` 0) or the palms (1). Forearms and wrists are twisted, wrists are extended,
    and fingers are bent by ``curl`` [rad]. `gesture_all` describes the other arguments.
    """
    closed = np.empty(2)
    for t in range(len(quats)):
        for side in range(2):
            share, body = hands[t, side, 3], left if side == 0 else right
            closed[side] = curl * share
            if share > 0.0:
                collar, shoulder = _shoulder(body, quats[t], pelvis[t])
                place = row3(hands[t], side)
                _lead(body, quats[t], collar, shoulder, place, palm, pole, twist, extension, share)
        curl_fingers(quats[t], closed)


@kernel(error_model="numpy")
def gesture_all(left, right, quats, pelvis, gestures, places, counts, numbers, pole, raised):
    """Add gestures to poses, in place, as `h3data.bodies.people.gestures.add_gestures` does.

    Args:
        left: `ReachBody` of the left hand.
        right: `ReachBody` of the right hand.
        quats: Local rotations [T, 55, 4].
        pelvis: Positions of the pelvis in the agent root frame [T, 3] [m].
        gestures: Number of the gesture, seconds since its start, and weight from 0 to 1, [T, 3].
        places: Positions of both wrists in each of G gestures, in arm lengths, and whether they are used (0 or 1), [G,
            2, K, 4].
        counts: Number of positions of the left and right wrist [G, 2].
        numbers: Duration [s], angle by which the head is lowered [rad], least height of wrists [m], and twist [rad],
            [G, 4].
        pole: Direction of the elbows: ahead, up and outwards [3].
        raised: Distance below the shoulder above which no gesture lifts a wrist for a work surface, in arm lengths.
    """
    for t in range(len(quats)):
        weight, k = min(max(gestures[t, 2], 0.0), 1.0), int(gestures[t, 0])
        if weight == 0.0:
            continue
        seconds, lowered, least, twist = row4(numbers, k)
        # parts of the joints in the lowering of the head
        for joint, part in ((_NECK, 0.45 * lowered), (_HEAD, 0.55 * lowered)):
            own = row4(quats[t], joint)
            put(quats[t], joint, nlerp(own, multiply(from_vector(part, 0.0, 0.0), own), weight))
        for side in range(2):
            body, count = left if side == 0 else right, counts[k, side]
            moment = gestures[t, 1] / seconds % 1.0 * count
            low = min(int(moment), count - 1)
            u = (moment - low) ** 3 * (10 - 15 * (moment - low) + 6 * (moment - low) ** 2)
            here, there = places[k, side, low], places[k, side, (low + 1) % count]
            share = weight * ((1 - u) * here[3] + u * there[3])
            if share > 0.0:
                upper, lower = row3(body.offsets, body.joints[2]), row3(body.offsets, body.joints[3])
                arm = math.sqrt(dot(upper, upper)) + math.sqrt(dot(lower, lower))
                # a hand is drawn back before it is lowered, not through the edge of a table
                ahead, up = (
                    arm * share**2 * ((1 - u) * here[0] + u * there[0]),
                    arm * ((1 - u) * here[1] + u * there[1]),
                )
                aside = -body.sign * arm * ((1 - u) * here[2] + u * there[2])
                collar, shoulder = _shoulder(body, quats[t], pelvis[t])
                # small bodies raise the hands to the chest at most
                up = max(up, min(least - shoulder[1], -raised * arm))
                place = plus(shoulder, (ahead, up, aside), 1.0)
                _lead(body, quats[t], collar, shoulder, place, 0.0, pole, twist, 0.0, share)


@kernel(error_model="numpy")
def lean_all(left, right, table, low, step, root, quats, pelvis, hands):
    """Blend trunks and legs of poses, in place, with poses that reach for ``hands``.

    ``hands`` [T, 2, 4] holds positions [m], and shares from 0 to 1.

    `reach_many` describes the other arguments.
    """
    x, measures = np.empty(PARAMETER_COUNT), np.empty(MEASURE_COUNT)
    leant, places = np.empty((2, quats.shape[1], 4)), np.empty((2, 3))
    for t in range(len(quats)):
        lean = hands[t, 0, 3] + hands[t, 1, 3]
        for k in range(2):
            if hands[t, k, 3] > 0.0:
                body, goal = left if k == 0 else right, (-hands[t, k, 2], hands[t, k, 1], hands[t, k, 0])
                reach_one(body, table, low, step, goal, 1.0, 1.0, root, x, leant[k], places[k], measures)
        if lean > 0.0:
            # a posture without a share was not computed
            one, share = 0 if hands[t, 0, 3] > 0.0 else 1, hands[t, 1, 3] / lean if hands[t, 0, 3] > 0.0 else 0.0
            other, lean = 1 if share > 0.0 else one, min(lean, 1.0)
            for j in range(BODY_JOINTS):
                both = nlerp(row4(leant[one], j), row4(leant[other], j), share)
                put(quats[t], j, nlerp(row4(quats[t], j), both, lean))
            for i in range(3):
                place = places[one, i] + share * (places[other, i] - places[one, i])
                pelvis[t, i] += lean * (place - pelvis[t, i])


@kernel(error_model="numpy")
def blend_rows(quats, rows, others, shares):
    """Blend poses ``rows`` [N] of [T, 55, 4] with ``others`` [N, 55, 4] by ``shares`` [N], in place, without the fingers."""
    for n in range(len(rows)):
        for j in range(BODY_JOINTS):
            put(quats[rows[n]], j, nlerp(row4(quats[rows[n]], j), row4(others[n], j), shares[n]))
