"""Legs: where the feet are is given, hips and knees follow by closed-form inverse kinematics.

In the body frame (+Z forward, +Y up, +X left) with the origin at the agent's root on the floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array, cross, normalized, quat_from_axis_angle, quat_from_matrix, quat_to_matrix

X, Y, Z = np.eye(3)
SIDES = (("left", 1.0, 0.0), ("right", -1.0, 0.5))
"""Name, sign of x, phase of the heel strike."""
LEG_MAX = 0.9985
"""A leg is never stretched further than this share of its length."""
_LEG_JOINTS = np.array(
    [[JOINT_INDEX[f"{side}_{part}"] for side, *_ in SIDES] for part in ("hip", "knee", "ankle", "foot")]
)
_OUT = 0.10 * np.array([sign for _, sign, _ in SIDES])
"""How far knees point out, to the x of the body."""
HALF_WIDTH = 0.55
"""Half step width as a share of the hip joints' half distance, the same standing and moving: a first step needs no shuffle."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Legs:
    """Measures of one body. Rows: left, right."""

    hips: Array
    """Hip joints from the pelvis joint, shape [2, 3] [m]."""
    thigh: float
    shank: float
    ankle_height: float
    """Of the ankle joint above the sole [m]."""
    feet: Array
    """Heel, ball and toe tip from the ankle joint with the foot flat, shape [2, 3, 3] [m]. The ball is the toe joint itself:
    toes held flat rest while the heel rises."""

    @property
    def length(self) -> float:
        """Thigh and shank together [m]."""
        return self.thigh + self.shank

    @property
    def half_width(self) -> float:
        """Of the steps [m]."""
        return HALF_WIDTH * float(abs(self.hips[0, 0]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Posture:
    """What a pose is solved from: everything but the legs, and where the feet are."""

    quats: Array
    """Local rotations xyzw, shape [T, 55, 4]; those of the legs are solved."""
    pelvis: Array
    """Pelvis joint, shape [T, 3] [m]."""
    ankle: Array
    """Ankle joints, shape [T, 2, 3] [m]."""
    foot: Array
    """Pitch (toes up), yaw (to the left) and bend of the toe joint of each foot, shape [T, 2, 3] [deg]."""


def rotation(axis: Array, angle_deg: ArrayLike) -> Array:
    """Rotation matrices [..., 3, 3] about a fixed axis, angles [...] in degrees."""
    return quat_to_matrix(quat_from_axis_angle(axis, np.radians(np.asarray(angle_deg, np.float64))))


@dataclass(frozen=True, kw_only=True, eq=False)
class SolvedLegs:
    """Angles of solved legs; what the fit looks at."""

    quats: Array
    """All local rotations, shape [T, 55, 4]."""
    thigh_deg: Array
    """To the vertical, forward positive, shape [T, 2]."""
    knee_deg: Array
    """Flexion, shape [T, 2]."""
    overreach: Array
    """How far each leg would have to be stretched, as a share of its length, shape [T, 2]."""


def solve_legs(legs: Legs, posture: Posture) -> SolvedLegs:
    """Two-bone legs from the hips to the ankles in closed form; knees point where the feet do and a little out."""
    pelvis_turn = quat_to_matrix(posture.quats[:, 0])[:, None]
    hip = posture.pelvis[:, None] + (pelvis_turn @ legs.hips[..., None])[..., 0]
    way = posture.ankle - hip
    distance = np.linalg.norm(way, axis=-1)
    reach = np.minimum(distance, legs.length * 0.9999)
    down = way / distance[..., None]
    pitch, yaw, bend = (posture.foot[..., k] for k in range(3))
    forward = np.stack([np.sin(np.radians(yaw)) + _OUT, 0 * yaw, np.cos(np.radians(yaw))], axis=-1)
    pole = normalized(forward - np.sum(forward * down, axis=-1)[..., None] * down)
    a, b = legs.thigh, legs.shank
    lift = np.arccos(np.clip((a**2 + reach**2 - b**2) / (2 * a * reach), -1, 1))[..., None]
    knee = np.degrees(np.pi - np.arccos(np.clip((a**2 + b**2 - reach**2) / (2 * a * b), -1, 1)))
    bone = np.cos(lift) * down + np.sin(lift) * pole
    front = np.cos(lift) * pole - np.sin(lift) * down
    thigh_turn = np.stack([cross(-bone, front), -bone, front], axis=-1)
    knee_turn = rotation(X, knee)
    foot_turn = rotation(Y, yaw) @ rotation(X, -pitch)
    shank_turn = thigh_turn @ knee_turn
    quats = posture.quats.copy()
    turns = [np.swapaxes(pelvis_turn, -1, -2) @ thigh_turn, knee_turn, np.swapaxes(shank_turn, -1, -2) @ foot_turn]
    quats[:, _LEG_JOINTS[:3]] = quat_from_matrix(np.stack(turns, axis=1))
    quats[:, _LEG_JOINTS[3]] = quat_from_axis_angle(X, np.radians(-bend))
    thigh_deg = np.degrees(np.arctan2(bone[..., 2], -bone[..., 1]))
    return SolvedLegs(
        quats=quats, thigh_deg=thigh_deg, knee_deg=knee, overreach=np.maximum(distance / legs.length - LEG_MAX, 0)
    )


def within_reach(legs: Legs, posture: Posture) -> Posture:
    """The pelvis lowered where a foot would be out of reach."""
    hips = posture.pelvis[:, None] + (quat_to_matrix(posture.quats[:, 0])[:, None] @ legs.hips[..., None])[..., 0]
    aside = np.sum((hips - posture.ankle)[..., [0, 2]] ** 2, axis=-1)
    highest = posture.ankle[..., 1] + np.sqrt(np.maximum((LEG_MAX * legs.length) ** 2 - aside, 0.0))
    drop = np.maximum(hips[..., 1] - highest, 0).max(axis=1)
    return replace(posture, pelvis=posture.pelvis - drop[:, None] * Y)


def lowest_point(legs: Legs, ankle: Array, foot: Array) -> Array:
    """Height [T, 2] [m] of each sole's lowest point, heel or toe tip, for ankles and angles as in `Posture`."""
    turn = rotation(X, -foot[..., 0])
    toe_turn = turn @ rotation(X, -foot[..., 2])
    heel, ball, tip = (legs.feet[:, k][..., None] for k in range(3))
    toe_y = (turn @ ball)[..., 1, 0] + (toe_turn @ (tip - ball))[..., 1, 0]
    return ankle[..., 1] + np.minimum((turn @ heel)[..., 1, 0], toe_y)
