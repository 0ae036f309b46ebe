"""Compiled kernels of legs: two bones from hip to ankle, feet on the floor, and the transition from standing to moving.

Positions are in the body frame (+Z forward, +Y up, +X left) with the origin at the agent's root on the floor. Angles of
feet are in degrees, as in `h3data.bodies.people.legs.Posture`. For one frame, NumPy needs 40 times as long, because its
calls cost more than the arithmetic.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from h3data.bodies.people.kernels.tuple_math import (
    cross,
    dot,
    from_axes,
    from_vector,
    inverse,
    multiply,
    nlerp,
    plus,
    positive,
    put,
    row3,
    row4,
    turned,
    unit,
)
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array
from h3data.kernels import kernel, kernel_part

LEG_JOINTS = np.array(
    [[JOINT_INDEX[f"{side}_{part}"] for side in ("left", "right")] for part in ("hip", "knee", "ankle", "foot")]
)
KNEES = (0.10, -0.10)
"""Components to the left of the directions in which the left and the right knee point, if the component in the direction of
the foot is 1: a little outwards, as those of people do."""


class LegMeasures(NamedTuple):
    """Lengths and limits of legs (`h3data.bodies.people.legs.Legs`) as arrays for kernels."""

    hips: Array
    thigh: float
    shank: float
    longest: float
    """Largest distance from hip to ankle [m]."""
    feet: Array


@kernel_part()
def solve_leg(thigh, shank, knee_out, pelvis_turn, hip, ankle, pitch, yaw):
    """Solve one leg from its hip to its ankle; the knee points where the foot does and ``knee_out`` to the body's left.

    Returns flexion of the knee, the thigh's direction and turn, local rotations of hip, knee and ankle, and how far the ankle
    is from the hip.
    """
    path = plus(ankle, hip, -1.0)
    distance = math.sqrt(dot(path, path))
    # a straight knee has no direction to point in, and its angle an infinite slope
    reach = min(distance, (thigh + shank) * 0.9999)
    down = (path[0] / distance, path[1] / distance, path[2] / distance)
    pitch, yaw = math.radians(pitch), math.radians(yaw)
    forward = (math.sin(yaw) + knee_out, 0.0, math.cos(yaw))
    # the part of the direction that is square to the leg: the knee turns about the line from hip to ankle
    pole = unit(plus(forward, down, -dot(forward, down)))
    # law of cosines, twice: at the hip and at the knee; clamped, since rounding leaves -1..1
    c = min(max((thigh * thigh + reach * reach - shank * shank) / (2 * thigh * reach), -1.0), 1.0)
    s = math.sqrt(1 - c * c)
    inner = min(max((thigh * thigh + shank * shank - reach * reach) / (2 * thigh * shank), -1.0), 1.0)
    flexion = math.pi - math.acos(inner)
    bone = plus((c * down[0], c * down[1], c * down[2]), pole, s)
    front = plus((c * pole[0], c * pole[1], c * pole[2]), down, -s)
    up = (-bone[0], -bone[1], -bone[2])
    thigh_turn = from_axes(cross(up, front), up, front)
    knee_turn = from_vector(flexion, 0.0, 0.0)
    foot_turn = multiply(from_vector(0.0, yaw, 0.0), from_vector(-pitch, 0.0, 0.0))
    hip_turn = multiply(inverse(pelvis_turn), thigh_turn)
    ankle_turn = multiply(inverse(multiply(thigh_turn, knee_turn)), foot_turn)
    return flexion, bone, thigh_turn, hip_turn, knee_turn, ankle_turn, distance


@kernel_part()
def sinking(hips, longest, pelvis_turn, pelvis, ankles):
    """Return how far the pelvis must sink [m] for both ankles [2, 3] to be within a distance ``longest`` [m] of their hips."""
    sink = 0.0
    for k in range(2):
        hip = plus(pelvis, turned(pelvis_turn, row3(hips, k)), 1.0)
        x, z = hip[0] - ankles[k, 0], hip[2] - ankles[k, 2]
        # highest hip from which the leg reaches the ankle, a sphere about it
        highest = ankles[k, 1] + math.sqrt(max(longest * longest - x * x - z * z, 0.0))
        sink = max(sink, hip[1] - highest)
    return sink


@kernel_part()
def lowest(feet, height, pitch, bend):
    """Return the height [m] of the lowest point of a sole.

    The point is the heel or the tip of the toes. ``feet`` [3, 3] are the points of the foot relative to the ankle,
    which is at ``height`` [m].
    """
    turn, toes = math.radians(-pitch), math.radians(-pitch - bend)
    c, s = math.cos(turn), math.sin(turn)
    heel = c * feet[0, 1] - s * feet[0, 2]
    ball = c * feet[1, 1] - s * feet[1, 2]
    tip = math.cos(toes) * (feet[2, 1] - feet[1, 1]) - math.sin(toes) * (feet[2, 2] - feet[1, 2])
    return height + min(heel, ball + tip)


@kernel(error_model="numpy")
def lowest_points(feet, ankle, foot, out):
    """Fill ``out`` [T, 2] with heights [m] of the soles' lowest points, from ankles [T, 2, 3] [m] and feet [T, 2, 3] [deg]."""
    for t in range(len(out)):
        for k in range(2):
            out[t, k] = lowest(feet[k], ankle[t, k, 1], foot[t, k, 0], foot[t, k, 2])


@kernel(error_model="numpy")
def sink_pelvis(legs, quats, pelvis, ankle):
    """Lower the pelvis positions [T, 3] [m], in place, of frames in which a foot would be out of reach."""
    for t in range(len(pelvis)):
        pelvis[t, 1] -= sinking(legs.hips, legs.longest, row4(quats[t], 0), row3(pelvis, t), ankle[t])


@kernel_part()
def write_legs(legs, quats, pelvis, ankle, foot, knees, angles):
    """Compute the local rotations of the leg joints of one pose, in place.

    ``knees`` are the components to the left of the directions of both knees, as in `KNEES`. ``angles`` [2, 3] are filled
    with the lean of each thigh, the flexion of the knee [rad] and the distance from hip to ankle [m].
    """
    pelvis_turn = row4(quats, 0)
    for k in range(2):
        hip = plus((pelvis[0], pelvis[1], pelvis[2]), turned(pelvis_turn, row3(legs.hips, k)), 1.0)
        flexion, bone, _, hip_turn, knee_turn, ankle_turn, distance = solve_leg(
            legs.thigh, legs.shank, knees[k], pelvis_turn, hip, row3(ankle, k), foot[k, 0], foot[k, 1]
        )
        # one sign for each rotation, so that blends take the shorter way
        put(quats, LEG_JOINTS[0, k], positive(hip_turn))
        put(quats, LEG_JOINTS[1, k], positive(knee_turn))
        put(quats, LEG_JOINTS[2, k], positive(ankle_turn))
        half = math.radians(-foot[k, 2]) / 2
        bend = math.sin(half)
        put(quats, LEG_JOINTS[3, k], (bend, 0.0 * bend, 0.0 * bend, math.cos(half)))  # zeros with the sign of the bend
        angles[k, 0], angles[k, 1], angles[k, 2] = math.atan2(bone[2], -bone[1]), flexion, distance


@kernel(error_model="numpy")
def write_all_legs(legs, quats, pelvis, ankle, foot, angles):
    """Apply `write_legs` to all frames: quats [T, 55, 4], pelvis [T, 3], ankle and foot [T, 2, 3], angles [T, 2, 3]."""
    for t in range(len(quats)):
        write_legs(legs, quats[t], pelvis[t], ankle[t], foot[t], KNEES, angles[t])


@kernel_part()
def settle(legs, stand, quats, pelvis, ankle, foot, phase, blend):
    """Blend one pose, in place, from moving (``blend`` 1) at its ``phase`` to standing (0) by steps instead of sliding feet.

    From 1 to 0.5 the foot that is up, or about to leave the floor, goes to its standing place; below 0.5 the other one
    does. A moving foot is lifted, so no foot slides when the person stops. When a person starts to walk, the blend
    jumps to more than 0.5 and the phase starts at the clip's start phase, at which the left foot need not move. The
    legs are not solved here.
    """
    still_quats, still_pelvis, still_ankle, still_foot = stand
    for j in range(len(quats)):
        put(quats, j, nlerp(row4(still_quats, j), row4(quats, j), blend))
    for i in range(3):
        pelvis[i] = still_pelvis[i] + blend * (pelvis[i] - still_pelvis[i])
    for k in range(2):
        # the right foot strikes the floor half a cycle after the left one
        first = (phase - 0.5 * k) % 1.0 >= 0.5
        s = min(max(2 * blend - 1 if first else 2 * blend, 0.0), 1.0)
        # smoothstep: no foot starts or stops with a jerk
        s = s * s * (3 - 2 * s)
        apart = math.hypot(ankle[k, 0] - still_ankle[k, 0], ankle[k, 2] - still_ankle[k, 2])
        # a turn counts as the toes move, about 0.2 m from the ankle
        apart += 0.2 * math.radians(abs(foot[k, 1] - still_foot[k, 1]))
        for i in range(3):
            ankle[k, i] = still_ankle[k, i] + s * (ankle[k, i] - still_ankle[k, i])
            foot[k, i] = still_foot[k, i] + s * (foot[k, i] - still_foot[k, i])
        # 0.3: height of a foot's path to its standing place, as a share of the distance
        lift = 0.3 * min(apart, 0.3) + 0.015 * min(apart / 0.004, 1.0)
        # a parabola of height `lift`, 0 at both ends
        ankle[k, 1] += lift * 4 * (s * (1 - s))
        ankle[k, 1] += max(-lowest(legs.feet[k], ankle[k, 1], foot[k, 0], foot[k, 2]), 0.0)
    pelvis[1] -= sinking(legs.hips, legs.longest, row4(quats, 0), (pelvis[0], pelvis[1], pelvis[2]), ankle)


@kernel_part()
def stand_on(legs, quats, pelvis, ankle, ground):
    """Raise one pose, in place, to the heights of the floor ``ground`` [2] [m] under its left and right foot."""
    for k in range(2):
        ankle[k, 1] += ground[k]
    # the mean of both floors, then as low as the lower foot needs
    pelvis[1] += (ground[0] + ground[1]) / 2
    pelvis[1] -= sinking(legs.hips, legs.longest, row4(quats, 0), (pelvis[0], pelvis[1], pelvis[2]), ankle)


@kernel(error_model="numpy")
def settle_all(legs, stand, quats, pelvis, ankle, foot, phase, blend, ground):
    """Apply `settle`, `stand_on` (where ``ground`` [T, 2] has rows) and `write_legs` to all frames, in place."""
    angles = np.empty((2, 3))
    for t in range(len(quats)):
        settle(legs, stand, quats[t], pelvis[t], ankle[t], foot[t], phase[t], min(max(blend[t], 0.0), 1.0))
        if len(ground):
            stand_on(legs, quats[t], pelvis[t], ankle[t], ground[t])
        write_legs(legs, quats[t], pelvis[t], ankle[t], foot[t], KNEES, angles)
