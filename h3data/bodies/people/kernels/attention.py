"""Compiled kernels that close the fingers around a held object and turn the head and eyes to a point.

Poses are in the agent root frame (x forward, y up, z right). Both kernels work on any pose: walking or reaching.
"""

from __future__ import annotations

import math

import numpy as np

from h3data.bodies.people.kernels.tuple_math import (
    from_vector,
    inverse,
    multiply,
    plus,
    put,
    row3,
    row4,
    turned,
)
from h3data.bodies.people.skeleton import FINGERS, JOINT_INDEX
from h3data.kernels import kernel, kernel_part

YAW_MAX, PITCH_MAX = math.radians(70.0), math.radians(50.0)
"""Largest angle of the head to the chest [rad]; a person does not look at points behind them."""
HEAD_SHARE, HEAD_STEP, HEAD_GAIN = 0.2, math.radians(4.0), 0.02
"""Share of the remaining angle by which the head turns in a step, the largest turn in a step [rad] (4 degrees, 120
degrees a second), and the largest change of that turn between steps [rad]."""
EYE_MAX, EYE_STEP = 0.45, math.radians(13.0)
"""Largest yaw and pitch of the eyes, which make up for the remaining turn of the head, and their largest turn in a step
[rad] (13 degrees, 390 degrees a second, as in saccades)."""
NECK_SHARE = 0.4
"""Share of a turn of the head that the neck makes."""
CURL_SHARES = np.array([1.0, 1.0, 0.8])
"""Bend of the three joints of a finger, from its root to its tip, as a share of the curl."""
THUMB_SHARES = np.array([0.7, 0.5, 0.5])

_SPINE = np.array([JOINT_INDEX["spine1"], JOINT_INDEX["spine2"], JOINT_INDEX["spine3"]])
_NECK, _HEAD = JOINT_INDEX["neck"], JOINT_INDEX["head"]
_EYES = np.array([JOINT_INDEX["left_eye_smplhf"], JOINT_INDEX["right_eye_smplhf"]])
_FINGERS = np.array(
    [
        [[JOINT_INDEX[f"{side}_{f}{k}"] for k in (1, 2, 3)] for f in FINGERS if f != "thumb"]
        for side in ("left", "right")
    ]
)
_THUMBS = np.array([[JOINT_INDEX[f"{side}_thumb{k}"] for k in (1, 2, 3)] for side in ("left", "right")])


@kernel(error_model="numpy")
def curl_fingers(quats, curl):
    """Bend each finger joint of a pose [55, 4], in place, by a further ``curl`` [2] (left and right hand) [rad].

    The thumb closes from its side.
    """
    for side in range(2):
        # an open hand keeps the pose, to the bit
        if curl[side] == 0.0:
            continue
        # both hands close towards their palms: left fingers about -z, right ones about +z
        sign = -1.0 if side == 0 else 1.0
        for k in range(3):
            bend = from_vector(0.0, 0.0, sign * CURL_SHARES[k] * curl[side])
            for finger in range(_FINGERS.shape[1]):
                joint = _FINGERS[side, finger, k]
                put(quats, joint, multiply(row4(quats, joint), bend))
            joint = _THUMBS[side, k]
            put(quats, joint, multiply(row4(quats, joint), from_vector(THUMB_SHARES[k] * curl[side], 0.0, 0.0)))


@kernel_part()
def _between(a, b):
    """Return yaw to the left and pitch down of the rotation vector from one direction to another, whose length is 1."""
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    sine, cosine = math.sqrt(x * x + y * y + z * z), a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    scale = math.atan2(sine, cosine) / sine if sine > 1e-9 else 1.0
    return y * scale, x * scale  # the roll about the axis of the face moves no gaze


@kernel_part()
def _turn_head(quats, gaze):
    """Return the local rotations of neck and head, turned beyond the pose."""
    neck = multiply(from_vector(NECK_SHARE * gaze[1], NECK_SHARE * gaze[0], 0.0), row4(quats, _NECK))
    share = 1.0 - NECK_SHARE
    return neck, multiply(from_vector(share * gaze[1], share * gaze[0], 0.0), row4(quats, _HEAD))


@kernel_part()
def _to_target(offsets, at, turn, neck, head, target):
    """Return the unit vector from the middle of the eyes to a point, and the head's rotation.

    ``at`` is the root of the neck, which `turn` turns. The vector is 0 if the eyes are at the point.
    """
    turn = multiply(turn, neck)
    at = plus(at, turned(turn, row3(offsets, _HEAD)), 1.0)
    turn = multiply(turn, head)
    middle = (0.5 * (offsets[_EYES[0], 0] + offsets[_EYES[1], 0]), offsets[_EYES[0], 1], offsets[_EYES[0], 2])
    at = plus(at, turned(turn, middle), 1.0)
    x, y, z = target[0] - at[0], target[1] - at[1], target[2] - at[2]
    scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-6)
    return (x * scale, y * scale, z * scale), turn


@kernel_part()
def _within(value, most):
    return min(max(value, -most), most)


@kernel_part()
def _shortened(a, b, most):
    """Return two angles as one turn of at most ``most`` [rad].

    Limits on each angle alone would let a diagonal turn be 1.4 times as fast.
    """
    length = math.hypot(a, b)
    return (a, b) if length <= most else (a * most / length, b * most / length)


@kernel(error_model="numpy")
def turn_gaze(offsets, quats, pelvis, base, target, looks, turning, gaze):
    """Turn the head and the eyes of a pose, in place, one step towards a world point or back to the original pose.

    The agent root is at ``base`` [7]; ``target`` [3] is the point [m] if ``looks`` is true.

    ``turning`` is the angle by which the pose itself turns the head to the left in this step [rad]; the sum of both
    turns is limited to the speed of a head.

    ``gaze`` [6], updated in place, holds the angles of the head, of the eyes, and of the head's last step, each to the
    left and down, beyond the pose [rad]. Returns the angle that the head has yet to turn [rad].
    """
    turn, at = row4(quats, 0), (pelvis[0], pelvis[1], pelvis[2])
    for joint in _SPINE:
        at = plus(at, turned(turn, row3(offsets, joint)), 1.0)
        turn = multiply(turn, row4(quats, joint))
    at = plus(at, turned(turn, row3(offsets, _NECK)), 1.0)
    yaw, pitch, sees = 0.0, 0.0, False
    back = inverse((base[3], base[4], base[5], base[6]))
    to = plus(turned(back, (target[0], target[1], target[2])), turned(back, (base[0], base[1], base[2])), -1.0)
    if looks:
        # from where the eyes are with the head turned: at arm's length that is up to 8 degrees away from the pose's
        neck, head = _turn_head(quats, gaze)
        world, _ = _to_target(offsets, at, turn, neck, head, to)
        path = turned(inverse(turn), world)
        # -0.3: cosine between the chest's direction and that of a point, below which the point is behind
        sees = path[2] > -0.3
        if sees:
            face = turned(multiply(row4(quats, _NECK), row4(quats, _HEAD)), (0.0, 0.0, 1.0))
            own_yaw, own_pitch = _between((0.0, 0.0, 1.0), face)
            yaw, pitch = _between(face, path)
            # a head is limited against its chest, so the turn that the pose itself has counts too
            yaw = _within(yaw + own_yaw, YAW_MAX) - own_yaw
            pitch = _within(pitch + own_pitch, PITCH_MAX) - own_pitch
    missing = math.hypot(yaw - gaze[0], pitch - gaze[1])
    turn_yaw, turn_pitch = _shortened(HEAD_SHARE * (yaw - gaze[0]) + turning, HEAD_SHARE * (pitch - gaze[1]), HEAD_STEP)
    # this much the pose turns by itself
    turn_yaw -= turning
    more_yaw, more_pitch = _shortened(turn_yaw - gaze[4], turn_pitch - gaze[5], HEAD_GAIN)
    gaze[4] += more_yaw
    gaze[5] += more_pitch
    gaze[0] += gaze[4]
    gaze[1] += gaze[5]
    neck, head = _turn_head(quats, gaze)
    eye_yaw, eye_pitch = 0.0, 0.0
    if sees:
        world, turn = _to_target(offsets, at, turn, neck, head, to)
        eye_yaw, eye_pitch = _between((0.0, 0.0, 1.0), turned(inverse(turn), world))
        eye_yaw, eye_pitch = _within(eye_yaw, EYE_MAX), _within(eye_pitch, EYE_MAX)
    more_yaw, more_pitch = _shortened(eye_yaw - gaze[2], eye_pitch - gaze[3], EYE_STEP)
    gaze[2] += more_yaw
    gaze[3] += more_pitch
    # shares of what is left have no end by themselves
    if not looks and np.abs(gaze).max() < 1e-3:
        gaze[:] = 0.0
    put(quats, _NECK, neck)
    put(quats, _HEAD, head)
    for k in range(2):
        put(quats, _EYES[k], multiply(from_vector(gaze[3], gaze[2], 0.0), row4(quats, _EYES[k])))
    return missing
