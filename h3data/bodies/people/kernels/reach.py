"""Compiled kernels that solve a reaching posture: the trunk from a table, legs and arm in closed form, and a check for faults.

Everything is in the body frame (+Z forward, +Y up, +X left) with the origin at the agent's root on the floor. Vectors
and quaternions (xyzw) are tuples here. The table is for the right hand; the left hand is its mirror image in the plane
x = 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.kernels.legs import KNEES, solve_leg
from h3data.bodies.people.kernels.tuple_math import (
    cross,
    dot,
    from_axes,
    from_vector,
    inverse,
    multiply,
    plus,
    put,
    row3,
    row4,
    segments_apart,
    to_vector,
    turned,
    unit,
)
from h3data.bodies.people.legs import LEG_MAX
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array
from h3data.kernels import kernel, kernel_part

# --- the parameters of a posture, in units of `ReachBody.scale` and radians, relative to standing -----------------------
SHIFT, PELVIS, SPINE, COLLAR, POLE, PARAMETER_COUNT = 0, 3, 6, 9, 11, 14
"""First columns of the parameters of a posture: pelvis shift (3), pelvis turn (3), turn of the whole spine (3), collar
about y and z (2), and the direction in which the elbow sticks out, in the chest frame (3)."""

# --- the measures of a posture -----------------------------------------------------------------------------------------
MISS, ELBOW, KNEE, SHANK, BALANCE, CLEARANCE, STRETCH, SPREAD, SHOULDER, MEASURE_COUNT = 0, 1, 2, 3, 4, 5, 6, 7, 8, 11
"""Columns of a posture's measures: the length by which the arm is too short or too long [m], flexion of elbow and knees [rad],
forward lean of the shanks [rad], how far the centre of mass is outside the feet [m] (negative: inside), clearance of forearm
and hand [m], how far the pelvis had to sink for the legs to be long enough [m], sine between elbow direction and arm, rotation
vector of the shoulder from hanging down (3) [rad]."""

ELBOW_MIN, ELBOW_MAX = math.radians(12.0), math.radians(145.0)
KNEE_MAX, SHANK_MAX = math.radians(132.0), math.radians(37.0)
CLEARANCE_MIN_M, STRETCH_MAX_M, SPREAD_MIN = -0.012, 0.03, 0.25
REACHED, OUTSIDE_BOX, INVALID_POSTURE, TOO_FAR = 0, 1, 2, 3

_SPINE = (JOINT_INDEX["spine1"], JOINT_INDEX["spine2"], JOINT_INDEX["spine3"])
_NECK, _HEAD = JOINT_INDEX["neck"], JOINT_INDEX["head"]
_GAZE_YAW, _GAZE_PITCH, _NECK_SHARE = 0.9, 0.75, 0.4
"""Turn of the head towards a target straight to the side or below [rad]."""
_COM_AHEAD_M, _COM_BEHIND_M, _COM_ASIDE_M = -0.01, 0.01, 0.02
"""Smallest distances [m] of the centre of mass behind the toe joints, ahead of the heels, and outside the ankles."""


class ReachBody(NamedTuple):
    """Measures of one body and one of its hands, for the kernel."""

    scale: float
    """Height of the standing shoulder [m], the unit of the table."""
    sign: float
    """Side of the hand: +1 for the left, -1 for the right."""
    stand: Array
    """Local rotations of the standing pose, with the pelvis in the body frame, shape [55, 4]."""
    pelvis: Array
    """Position of the pelvis joint in the standing pose, shape [3] [m]."""
    pole: Array
    """Elbow direction of the hanging arm in the chest frame, shape [3]."""
    offsets: Array
    """Positions of the joints in their parents' frames, shape [55, 3] [m]."""
    ankles: Array
    """Positions at which the ankles stay: left, right, shape [2, 3] [m]."""
    support: Array
    """Positions of the heels and balls of the feet along z [m]."""
    bones: Array
    """Lengths of thigh and shank [m]."""
    joints: NDArray[np.int64]
    """Indices of joints: collar, shoulder, elbow and wrist of the hand, the other shoulder, and left and right hip,
    knee and ankle."""
    palm: Array
    """Position of the grasp point in the wrist frame, shape [3] [m]."""
    obstacles: Array
    """Capsules that forearm and hand must not enter: start, end, radius in joint frames, shape [C, 7] [m]."""
    obstacle_joints: NDArray[np.int64]
    """Index of the body part of each obstacle capsule: 0 pelvis, 1-3 spine, 4 head, 5-6 thighs, shape [C]."""
    arm_radius: float
    """Radius of the forearm and of the hand [m]."""


@kernel_part()
def _solve_leg(body, k, pelvis_turn, hip, quats):
    """Solve one leg from its hip to its ankle, the foot flat, and return knee flexion, lean of the shank and the knee."""
    ankle, out = row3(body.ankles, k), KNEES[k]
    flexion, bone, thigh_turn, hip_turn, knee_turn, ankle_turn, _ = solve_leg(
        body.bones[0], body.bones[1], out, pelvis_turn, hip, ankle, 0.0, 0.0
    )
    put(quats, body.joints[5 + k], hip_turn)
    put(quats, body.joints[7 + k], knee_turn)
    put(quats, body.joints[9 + k], ankle_turn)
    knee = plus(hip, bone, body.bones[0])
    return flexion, math.atan2(knee[2] - ankle[2], knee[1] - ankle[1]), knee, thigh_turn


@kernel_part()
def _bend(body, x, trunk, k, turn, at, quats):
    """Return one joint of the spine: frame and place from those of the one below."""
    share, m, joint = trunk * (0.30, 0.35, 0.35)[k], -body.sign, _SPINE[k]
    local = multiply(
        from_vector(share * x[SPINE], share * m * x[SPINE + 1], share * m * x[SPINE + 2]), row4(body.stand, joint)
    )
    put(quats, joint, local)
    return multiply(turn, local), plus(at, turned(turn, row3(body.offsets, joint)), 1.0)


@kernel_part()
def pose_arm(body, palm, collar, shoulder, target, pole, quats):
    """Turn shoulder and elbow so that the ``palm`` is at ``target`` and the elbow points towards ``pole``.

    The palm is given in the frame of the forearm, from the wrist; target and pole are in the frame of ``collar`` and
    ``shoulder``. The elbow is a hinge about the shoulder frame's y axis, so the distance of the target determines its
    angle. The plane of the arm determines the other angles.

    Returns the length by which the arm is too short or too long [m], the flexion of the elbow [rad], the turn of the
    shoulder, and the sine of the angle between pole and arm.
    """
    upper, lower = row3(body.offsets, body.joints[2]), row3(body.offsets, body.joints[3])
    lower = (lower[0] + palm[0], lower[1] + palm[1], lower[2] + palm[2])
    way = plus(target, shoulder, -1.0)
    distance = math.sqrt(dot(way, way))
    # |upper + R_y(angle) lower|^2 = distance^2 is a cos(angle) + b sin(angle) = c
    a = upper[0] * lower[0] + upper[2] * lower[2]
    b = upper[0] * lower[2] - upper[2] * lower[0]
    squares = dot(upper, upper) + dot(lower, lower)
    c = (distance * distance - squares) / 2 - upper[1] * lower[1]
    size = math.sqrt(a * a + b * b)
    flexion = math.acos(min(max(c / size, -1.0), 1.0))
    miss = 0.0
    if flexion < ELBOW_MIN or flexion > ELBOW_MAX:
        flexion = min(max(flexion, ELBOW_MIN), ELBOW_MAX)
        longest = squares + 2 * (size * math.cos(flexion) + upper[1] * lower[1])
        miss = distance - math.sqrt(longest)
    hinge = from_vector(0.0, math.atan2(b, a) - body.sign * flexion, 0.0)
    along = unit(plus(upper, turned(hinge, lower), 1.0))
    axis = unit(plus((0.0, 1.0, 0.0), along, -along[1]))
    toward = unit(way)
    sideways = cross(pole, toward)
    spread = math.sqrt(dot(sideways, sideways))
    normal = unit((-body.sign * sideways[0], -body.sign * sideways[1], -body.sign * sideways[2]))
    # one frame on the bent arm, one on the way to the target: the shoulder turns the first onto the second
    here, there = from_axes(along, axis, cross(along, axis)), from_axes(toward, normal, cross(toward, normal))
    turn = multiply(there, inverse(here))
    put(quats, body.joints[1], multiply(inverse(collar), turn))
    put(quats, body.joints[2], hinge)
    return miss, flexion, turn, spread


@kernel_part()
def pose_for(body, x, target, trunk, arm, quats, pelvis, measures):
    """Write the posture with parameters ``x`` whose palm is at ``target``: local ``quats`` [55, 4], ``pelvis`` [3].

    ``trunk`` and ``arm`` (0 to 1) interpolate from the standing trunk and the elbow of a hanging arm to the parameters
    ``x``; the palm is at the target in any case, as far as the arm reaches. ``measures`` is filled in the columns that
    are named in this module.
    """
    m = -body.sign
    quats[:] = body.stand
    pelvis_turn = multiply(
        from_vector(trunk * x[PELVIS], trunk * m * x[PELVIS + 1], trunk * m * x[PELVIS + 2]), row4(body.stand, 0)
    )
    place = (
        body.pelvis[0] + trunk * m * x[SHIFT] * body.scale,
        body.pelvis[1] + trunk * x[SHIFT + 1] * body.scale,
        body.pelvis[2] + trunk * x[SHIFT + 2] * body.scale,
    )
    # --- legs: the pelvis sinks where they would be too short
    stretch = 0.0
    longest = LEG_MAX * (body.bones[0] + body.bones[1])
    for k in range(2):
        hip = plus(place, turned(pelvis_turn, row3(body.offsets, body.joints[5 + k])), 1.0)
        x_gap, z_gap = hip[0] - body.ankles[k, 0], hip[2] - body.ankles[k, 2]
        highest = body.ankles[k, 1] + math.sqrt(max(longest * longest - x_gap * x_gap - z_gap * z_gap, 0.0))
        # for both legs, so the pelvis sinks as far as the one that needs more
        stretch = max(stretch, hip[1] - highest)
    place = (place[0], place[1] - stretch, place[2])
    hips = (
        plus(place, turned(pelvis_turn, row3(body.offsets, body.joints[5])), 1.0),
        plus(place, turned(pelvis_turn, row3(body.offsets, body.joints[6])), 1.0),
    )
    knee_left, lean_left, left, left_thigh = _solve_leg(body, 0, pelvis_turn, hips[0], quats)
    knee_right, lean_right, right, right_thigh = _solve_leg(body, 1, pelvis_turn, hips[1], quats)
    # --- trunk
    turn1, at1 = _bend(body, x, trunk, 0, pelvis_turn, place, quats)
    turn2, at2 = _bend(body, x, trunk, 1, turn1, at1, quats)
    chest, at3 = _bend(body, x, trunk, 2, turn2, at2, quats)
    neck = plus(at3, turned(chest, row3(body.offsets, _NECK)), 1.0)
    # --- the arm
    collar = multiply(
        from_vector(0.0, trunk * m * x[COLLAR], trunk * m * x[COLLAR + 1]), row4(body.stand, body.joints[0])
    )
    put(quats, body.joints[0], collar)
    collar_at = plus(at3, turned(chest, row3(body.offsets, body.joints[0])), 1.0)
    collar_turn = multiply(chest, collar)
    shoulder = plus(collar_at, turned(collar_turn, row3(body.offsets, body.joints[1])), 1.0)
    pole = (
        (1 - arm) * body.pole[0] + arm * m * x[POLE],
        (1 - arm) * body.pole[1] + arm * x[POLE + 1],
        (1 - arm) * body.pole[2] + arm * x[POLE + 2],
    )
    grasp = (body.palm[0], body.palm[1], body.palm[2])
    miss, flexion, arm_turn, spread = pose_arm(
        body, grasp, collar_turn, shoulder, target, turned(chest, unit(pole)), quats
    )
    elbow = plus(shoulder, turned(arm_turn, row3(body.offsets, body.joints[2])), 1.0)
    fore_turn = multiply(arm_turn, row4(quats, body.joints[2]))
    wrist = plus(elbow, turned(fore_turn, row3(body.offsets, body.joints[3])), 1.0)
    palm = plus(wrist, turned(fore_turn, grasp), 1.0)
    # --- the head looks at the target, the other arm hangs
    head_at = plus(neck, turned(multiply(chest, row4(body.stand, _NECK)), row3(body.offsets, _HEAD)), 1.0)
    # seen from the head before it turns: how far it turns depends on this
    look = turned(inverse(chest), unit(plus(target, head_at, -1.0)))
    for joint, share in ((_NECK, _NECK_SHARE), (_HEAD, 1 - _NECK_SHARE)):
        gaze = from_vector(-trunk * share * _GAZE_PITCH * look[1], trunk * share * _GAZE_YAW * look[0], 0.0)
        put(quats, joint, multiply(gaze, row4(body.stand, joint)))
    neck_turn = multiply(chest, row4(quats, _NECK))
    head_turn, head_at = (
        multiply(neck_turn, row4(quats, _HEAD)),
        plus(neck, turned(neck_turn, row3(body.offsets, _HEAD)), 1.0),
    )
    upright = turned(inverse(chest), (0.0, 1.0, 0.0))
    tilt = cross((0.0, 1.0, 0.0), upright)
    lean = math.sqrt(dot(tilt, tilt))
    # by most of the angle between the vertical and the chest, about the axis of that lean
    # 0.85: share of the trunk's lean that the other arm does not follow: it hangs
    amount = trunk * 0.85 * math.atan2(lean, upright[1]) / max(lean, 1e-9)
    other = body.joints[4]
    hang = from_vector(amount * tilt[0], amount * tilt[1], amount * tilt[2])
    put(quats, other, multiply(hang, row4(body.stand, other)))
    put(quats, 0, pelvis_turn)
    pelvis[0], pelvis[1], pelvis[2] = place
    # --- what can be wrong; the shares of the mass are Winter's (research/humanoids.md 3)
    weight = (0.142 * place[0], 0.142 * place[1], 0.142 * place[2])
    weight = plus(weight, plus(at2, neck, 1.0), 0.355 / 2)
    weight = plus(weight, head_at, 0.081 + 0.050)  # with the other arm
    weight = plus(weight, plus(shoulder, elbow, 1.0), 0.028 / 2)
    weight = plus(weight, plus(elbow, wrist, 1.0), 0.016 / 2)
    weight = plus(weight, palm, 0.006)
    weight = plus(weight, plus(hips[0], hips[1], 1.0), 0.100 / 2)
    weight = plus(weight, plus(left, right, 1.0), 0.100 / 2 + 0.061 / 2)
    weight = plus(weight, plus(row3(body.ankles, 0), row3(body.ankles, 1), 1.0), 0.061 / 2)
    behind, ahead = body.support[0] + _COM_BEHIND_M - weight[2], weight[2] - body.support[1] + _COM_AHEAD_M
    aside = max(weight[0] - body.ankles[0, 0], body.ankles[1, 0] - weight[0]) - _COM_ASIDE_M
    turns = (pelvis_turn, turn1, turn2, chest, head_turn, left_thigh, right_thigh)
    places = (place, at1, at2, at3, head_at, hips[0], hips[1])
    # more than any clearance that matters, for bodies without obstacles
    gap = 1.0
    for k in range(len(body.obstacle_joints)):
        q, p, o = turns[body.obstacle_joints[k]], places[body.obstacle_joints[k]], body.obstacles[k]
        start, end = plus(p, turned(q, (o[0], o[1], o[2])), 1.0), plus(p, turned(q, (o[3], o[4], o[5])), 1.0)
        near = min(segments_apart(elbow, wrist, start, end), segments_apart(wrist, palm, start, end))
        gap = min(gap, near - o[6] - body.arm_radius)
    measures[MISS] = miss
    measures[ELBOW] = flexion
    measures[KNEE] = max(knee_left, knee_right)
    measures[SHANK] = max(lean_left, lean_right)
    measures[BALANCE] = max(behind, max(ahead, aside))
    measures[CLEARANCE] = gap
    measures[STRETCH] = stretch
    measures[SPREAD] = spread
    hanging = multiply(row4(quats, body.joints[1]), inverse(row4(body.stand, body.joints[1])))
    measures[SHOULDER], measures[SHOULDER + 1], measures[SHOULDER + 2] = to_vector(hanging)


@kernel_part()
def look_up(table, low, step, u, x):
    """Interpolate ``table`` [X, Y, Z, P] trilinearly at ``u`` into ``x`` [P].

    Returns whether ``u`` is inside the table. Outside, ``u`` is clamped to the table.
    """
    inside = True
    cell, share = np.empty(3, np.int64), np.empty(3)
    for k in range(3):
        place, last = (u[k] - low[k]) / step[k], table.shape[k] - 1
        # a margin for rounding, as targets may lie on the border of the box
        inside = inside and -1e-9 <= place <= last + 1e-9
        place = min(max(place, 0.0), float(last))
        # the last grid point belongs to the cell before it
        cell[k] = min(int(place), last - 1)
        share[k] = place - cell[k]
    x[:] = 0.0
    for corner in range(8):
        a, b, c = corner >> 2, corner >> 1 & 1, corner & 1
        weight = share[0] if a else 1 - share[0]
        weight *= share[1] if b else 1 - share[1]
        weight *= share[2] if c else 1 - share[2]
        for p in range(len(x)):
            x[p] += weight * table[cell[0] + a, cell[1] + b, cell[2] + c, p]
    return inside


@kernel_part()
def fault(measures):
    """Return the fault of a posture: `TOO_FAR`, `INVALID_POSTURE`, or `REACHED` for a posture without a fault."""
    if abs(measures[MISS]) > 1e-6:
        return TOO_FAR
    bad = measures[KNEE] > KNEE_MAX or measures[SHANK] > SHANK_MAX or measures[BALANCE] > 0.0
    bad = (
        bad
        or measures[CLEARANCE] < CLEARANCE_MIN_M
        or measures[STRETCH] > STRETCH_MAX_M
        or measures[SPREAD] < SPREAD_MIN
    )
    return INVALID_POSTURE if bad else REACHED


@kernel_part()
def reach_one(body, table, low, step, target, trunk, arm, root, x, quats, pelvis, measures):
    """Compute the posture for one target [3] [m], as `reach_many` does for many, and return its status.

    ``x`` [P] is space for its parameters.
    """
    # the table is for the right hand: the left one looks its mirror image up
    u = (-body.sign * target[0] / body.scale, target[1] / body.scale, target[2] / body.scale)
    inside, turn = look_up(table, low, step, u, x), (root[0], root[1], root[2], root[3])
    pose_for(body, x, target, trunk, arm, quats, pelvis, measures)
    # after `pose_for`, which judges balance in the body frame
    put(quats, 0, multiply(turn, row4(quats, 0)))
    pelvis[0], pelvis[1], pelvis[2] = turned(turn, (pelvis[0], pelvis[1], pelvis[2]))
    return fault(measures) if inside else OUTSIDE_BOX


@kernel(error_model="numpy")
def reach_many(body, table, low, step, targets, trunk, arm, root, quats, pelvis, measures, status):
    """Compute postures with the palm at ``targets`` [T, 3] [m] in the body frame.

    They are written to ``quats`` [T, 55, 4], ``pelvis`` [T, 3], ``measures`` [T, M] and ``status`` [T].

    The quaternion ``root`` [4] rotates the pelvis from the body frame into the frame of the caller.
    """
    x = np.empty(PARAMETER_COUNT)
    for t in range(len(targets)):
        target = row3(targets, t)
        status[t] = reach_one(
            body, table, low, step, target, trunk[t], arm[t], root, x, quats[t], pelvis[t], measures[t]
        )
