"""Compiled kernels that move the arms and head of any pose to targets, also while the body walks.

Targets and poses are in the agent root frame (x forward, y up, z right). Only shoulders, elbows and wrists, neck and
head change, so that planted feet stay where they are.
"""

from __future__ import annotations

import math

import numpy as np

from h3data.bodies.people.kernels.reach import PARAMETER_COUNT, POLE, look_up, pose_arm
from h3data.bodies.people.kernels.tuple_math import (
    from_vector,
    inverse,
    multiply,
    nlerp,
    plus,
    put,
    row3,
    row4,
    to_vector,
    turned,
    unit,
)
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.kernels import kernel, kernel_part

WRIST_MAX = math.radians(70.0)
"""Largest angle between the hand and the forearm [rad]."""
NECK_SHARE = 0.4
"""Share of a turn of the head that comes from the neck."""

_SPINE = (JOINT_INDEX["spine1"], JOINT_INDEX["spine2"], JOINT_INDEX["spine3"])
_NECK, _HEAD = JOINT_INDEX["neck"], JOINT_INDEX["head"]


@kernel_part()
def chest_of(offsets, quats, pelvis):
    """Return the rotation and the position [m] of the uppermost spine joint of a pose in the agent root frame."""
    turn, at = row4(quats, 0), (pelvis[0], pelvis[1], pelvis[2])
    for joint in _SPINE:
        at = plus(at, turned(turn, row3(offsets, joint)), 1.0)
        turn = multiply(turn, row4(quats, joint))
    return turn, at


@kernel_part()
def _clipped_turn(q, most):
    """Return the same rotation, by at most ``most`` [rad]."""
    x, y, z = to_vector(q)
    angle = math.sqrt(x * x + y * y + z * z)
    share = most / angle if angle > most else 1.0
    return from_vector(share * x, share * y, share * z)


@kernel(error_model="numpy")
def lead_arm(body, table, low, step, quats, pelvis, target, turn, has_turn, share):
    """Move one arm of a pose, in place, so that its palm is at ``target`` [3] [m], as far as arm and wrist reach.

    If ``has_turn``, the palm gets the rotation ``turn`` [4]. ``body`` is the `ReachBody` of the hand, ``quats`` [55, 4]
    and ``pelvis`` [3] are the pose. With a ``share`` below 1 the arm is between the pose (0) and the target (1).
    """
    chest, at = chest_of(body.offsets, quats, pelvis)
    collar_turn = multiply(chest, row4(quats, body.joints[0]))
    collar_at = plus(at, turned(chest, row3(body.offsets, body.joints[0])), 1.0)
    shoulder = plus(collar_at, turned(collar_turn, row3(body.offsets, body.joints[1])), 1.0)
    # the table says where the elbow points; its frame is the body's: x left, y up, z forward, mirrored to the right hand
    mirror, goal = -body.sign, (target[0], target[1], target[2])
    x = np.empty(PARAMETER_COUNT)
    u = (mirror * -goal[2] / body.scale, goal[1] / body.scale, goal[0] / body.scale)
    look_up(table, low, step, u, x)
    pole = turned(chest, unit((mirror * x[POLE], x[POLE + 1], x[POLE + 2])))
    # now, because `pose_arm` overwrites shoulder and elbow
    natural = (row4(quats, body.joints[1]), row4(quats, body.joints[2]), row4(quats, body.joints[3]))
    aim = (turn[0], turn[1], turn[2], turn[3])
    wrist, grasp = (0.0, 0.0, 0.0, 1.0), (body.palm[0], body.palm[1], body.palm[2])
    # number of passes in which arm and wrist are solved in turn, as a turned wrist moves the palm. The arm comes
    # last: the place of the palm is exact, its rotation is off by less than 0.1 degrees after four passes.
    turn_passes = 4
    for k in range(turn_passes if has_turn else 1):
        _, _, arm_turn, _ = pose_arm(body, turned(wrist, grasp), collar_turn, shoulder, goal, pole, quats)
        # not in the last pass: a wrist that turned after the arm would move the palm off its place
        if has_turn and k + 1 < turn_passes:
            forearm = multiply(arm_turn, row4(quats, body.joints[2]))
            wrist = _clipped_turn(multiply(inverse(forearm), aim), WRIST_MAX)
    put(quats, body.joints[1], nlerp(natural[0], row4(quats, body.joints[1]), share))
    put(quats, body.joints[2], nlerp(natural[1], row4(quats, body.joints[2]), share))
    put(quats, body.joints[3], nlerp(natural[2], wrist, share))


@kernel(error_model="numpy")
def turn_head(quats, yaw, pitch):
    """Turn the head of a pose, in place, to the left by ``yaw`` and down by ``pitch`` [rad]."""
    for joint, share in ((_NECK, NECK_SHARE), (_HEAD, 1 - NECK_SHARE)):
        put(quats, joint, multiply(from_vector(share * pitch, share * yaw, 0.0), row4(quats, joint)))
