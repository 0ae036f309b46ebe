"""Legs of people, whose hips and knees follow from the positions of the feet by closed-form inverse kinematics.

Positions are in the body frame (+Z forward, +Y up, +X left) with the origin at the agent's root on the floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from h3data.geometry import Array, quat_from_axis_angle, quat_to_matrix

if TYPE_CHECKING:
    from h3data.bodies.people.kernels.legs import LegMeasures

X, Y, Z = np.eye(3)
SIDES = (("left", 1.0, 0.0), ("right", -1.0, 0.5))
"""Name, sign of x, and phase of the heel strike of each leg, left and right."""
LEG_MAX = 0.9985
"""Largest stretch of a leg, as a share of its length."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Legs:
    """Measures of one body's legs, with rows for left and right."""

    hips: Array
    """Positions of the hip joints relative to the pelvis joint, shape [2, 3] [m]."""
    thigh: float
    shank: float
    ankle_height: float
    """Height of the ankle joint above the sole [m]."""
    feet: Array
    """Positions of heel, ball and toe tip relative to the ankle with the foot flat, shape [2, 3, 3] [m]. The ball is
    the toe joint itself: toes held flat rest while the heel rises."""

    @cached_property
    def measures(self) -> LegMeasures:
        """Measures as an array, for the kernels in `h3data.bodies.people.kernels.legs`."""
        # at first use, so that bodies can be read without compiling anything
        from h3data.bodies.people.kernels.legs import LegMeasures

        # contiguous float64: the kernels are compiled for exactly that
        return LegMeasures(
            np.ascontiguousarray(self.hips, np.float64),
            float(self.thigh),
            float(self.shank),
            LEG_MAX * self.length,
            np.ascontiguousarray(self.feet, np.float64),
        )

    @property
    def length(self) -> float:
        """Length of thigh and shank together [m]."""
        return self.thigh + self.shank

    @property
    def half_width(self) -> float:
        """Half of the distance between the feet [m]."""
        # 0.55: half step width as a share of the hip joints' half distance, the same standing and moving: a
        # first step needs no shuffle
        return 0.55 * float(abs(self.hips[0, 0]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Posture:
    """Input from which a pose is solved: everything except the legs, together with the positions of the feet."""

    quats: Array
    """Local rotations xyzw, shape [T, 55, 4]; rotations of the legs are solved."""
    pelvis: Array
    """Position of the pelvis joint, shape [T, 3] [m]."""
    ankle: Array
    """Positions of the ankle joints, shape [T, 2, 3] [m]."""
    foot: Array
    """Pitch (toes up), yaw (to the left) and bend of the toe joint of each foot, shape [T, 2, 3] [deg]."""


def rotation(axis: Array, angle_deg: ArrayLike) -> Array:
    """Return the rotation matrices [..., 3, 3] about a fixed axis, angles [...] in degrees."""
    return quat_to_matrix(quat_from_axis_angle(axis, np.radians(np.asarray(angle_deg, np.float64))))


@dataclass(frozen=True, kw_only=True, eq=False)
class SolvedLegs:
    """Rotations and angles of solved legs, by which the fit of a gait is evaluated."""

    quats: Array
    """All local rotations, shape [T, 55, 4]."""
    thigh_deg: Array
    """Angle of each thigh to the vertical, forward positive, shape [T, 2] [deg]."""
    knee_deg: Array
    """Flexion of each knee [deg], shape [T, 2]."""
    overreach: Array
    """Missing length of each leg, as a share of its length, shape [T, 2]."""


def solve_legs(legs: Legs, posture: Posture) -> SolvedLegs:
    """Solve two-bone legs from the hips to the ankles in closed form.

    Knees point in the direction of the feet and slightly outwards."""
    from h3data.bodies.people.kernels.legs import write_all_legs

    quats, angles = posture.quats.copy(), np.empty((*posture.ankle.shape[:2], 3))
    write_all_legs(legs.measures, quats, posture.pelvis, posture.ankle, posture.foot, angles)
    return SolvedLegs(
        quats=quats,
        thigh_deg=np.degrees(angles[..., 0]),
        knee_deg=np.degrees(angles[..., 1]),
        overreach=np.maximum(angles[..., 2] / legs.length - LEG_MAX, 0),
    )


def within_reach(legs: Legs, posture: Posture) -> Posture:
    """Return pelvis positions [T, 3] [m] that are lowered where a foot would be out of reach."""
    from h3data.bodies.people.kernels.legs import sink_pelvis

    pelvis = posture.pelvis.copy()
    sink_pelvis(legs.measures, posture.quats, pelvis, posture.ankle)
    return replace(posture, pelvis=pelvis)


def lowest_point(legs: Legs, ankle: Array, foot: Array) -> Array:
    """Return the height [T, 2] [m] of each sole's lowest point, heel or toe tip, for ankles and angles as in `Posture`."""
    from h3data.bodies.people.kernels.legs import lowest_points

    heights = np.empty(ankle.shape[:2])
    lowest_points(legs.feet, ankle, foot, heights)
    return heights
