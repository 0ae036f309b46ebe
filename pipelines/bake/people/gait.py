"""Fitting `h3data.bodies.people.gait` to a body, so that its joint angles follow normative curves (research/humanoids.md 2).

Those curves were entered from memory, good to about 3 degrees for walking and less for jogging: a shape, not data.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bake.people.rig import Rig
from h3data.bodies.people.clips import JOG_SPEED_MPS, WALK_SPEEDS_MPS, Gaits
from h3data.bodies.people.gait import JOG, PARAMETERS, WALK, GaitStyle, amplitude, gait_posture, jog_stride, walk_stride
from h3data.bodies.people.humanoid_file import legs_from_offsets
from h3data.bodies.people.legs import SIDES, Legs, lowest_point, solve_legs
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array

log = logging.getLogger(__name__)

WALK_ANGLES = np.array(
    [
        [0, 30, 5, 0],
        [0.05, 29, 10, -4],
        [0.1, 27, 16, -5],
        [0.15, 24, 18, -1],
        [0.2, 19, 17, 3],
        [0.3, 8, 11, 7],
        [0.4, -3, 6, 9],
        [0.5, -10, 10, 9],
        [0.55, -9, 22, 2],
        [0.6, -4, 38, -14],
        [0.65, 6, 53, -18],
        [0.7, 17, 61, -12],
        [0.75, 26, 60, -5],
        [0.8, 32, 52, 0],
        [0.85, 35, 36, 2],
        [0.9, 34, 18, 2],
        [0.95, 32, 6, 1],
    ]
)
"""Phase, thigh to the vertical, knee flexion, ankle dorsiflexion [deg] at natural walking speed."""
JOG_ANGLES = np.array(
    [
        [0, 27, 18, 4],
        [0.08, 24, 30, 12],
        [0.18, 12, 41, 20],
        [0.3, -8, 28, 12],
        [0.4, -22, 20, -16],
        [0.48, -23, 38, -18],
        [0.58, -8, 72, -10],
        [0.68, 18, 92, -4],
        [0.76, 33, 82, 0],
        [0.86, 40, 46, 2],
        [0.94, 35, 19, 2],
    ]
)
"""Joint angles of easy jogging at about 2.5 m/s: phase, thigh to the vertical, knee flexion, ankle dorsiflexion [deg]."""
FIT_FRAMES = 40
CLEARANCE_M = 0.018
"""Height by which a foot should clear the floor in the middle of its swing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Aim:
    """Targets for fitting a gait to a body."""

    style: GaitStyle
    angles: Array
    """Target joint angles over the phase [deg]."""
    start: Mapping[str, float]
    """Initial values of some fitted parameters."""
    bounce_weight: float
    """Weight with which the fit stays near the initial vertical motion of the pelvis."""


WALKING = Aim(style=WALK, angles=WALK_ANGLES, start={"height": -0.03, "cos2": -0.018, "lift": 0.05}, bounce_weight=150)
JOGGING = Aim(
    style=JOG,
    angles=JOG_ANGLES,
    start={"height": -0.05, "cos2": 0.024, "sin2": -0.018, "lift": 0.28},
    bounce_weight=2500,
)


def legs_of(rig: Rig) -> Legs:
    """Return the leg measures of a rig; heels and toe tips are the ends of the mesh's soles."""
    feet = np.zeros((2, 3, 3))
    for k, (side, _, _) in enumerate(SIDES):
        ankle, ball = rig.joint(f"{side}_ankle"), rig.joint(f"{side}_foot")
        weight = rig.weights[:, [JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]].sum(axis=1)
        sole = rig.vertices[(weight > 0.5) & (rig.vertices[:, 1] < 0.02)]
        heel = np.array([0.98 * ankle[0], 0, sole[:, 2].min() + 0.012])
        toe = np.array([ball[0], 0, sole[:, 2].max()])
        feet[k] = heel - ankle, ball - ankle, toe - ankle
    return legs_from_offsets(rig.offsets, feet, float(rig.joint("left_ankle")[1]))


def fit_gaits(legs: Legs, height_m: float) -> Gaits:
    """Return the walks and the jog of a body, which take 2 s each to fit."""
    walks = [fit(WALKING, legs, float(walk_stride(legs, speed))) for speed in WALK_SPEEDS_MPS]
    jog = fit(JOGGING, legs, float(jog_stride(height_m, JOG_SPEED_MPS)))
    return Gaits(legs=legs, height_m=height_m, walk=np.stack(walks), jog=jog)


def fit(aim: Aim, legs: Legs, stride_m: float) -> Array:
    """Return parameters of `gait_posture` by least squares.

    The terms are joint angles, stretched legs, toe clearance, and small changes.
    """
    from scipy.optimize import least_squares

    style = aim.style
    start = np.array([aim.start.get(name, 0.0) for name in PARAMETERS] + [0.0] * len(style.loose))
    phase = np.arange(FIT_FRAMES) / FIT_FRAMES
    scale = amplitude(legs, np.array(stride_m))
    target = np.stack([np.interp(phase, aim.angles[:, 0], aim.angles[:, k], period=1) for k in (1, 2, 3)], axis=1)
    target[:, :2] *= scale
    swing = np.clip((phase - style.stance) / (1 - style.stance), 0, 1)
    wanted = CLEARANCE_M * np.sin(np.pi * swing)
    firm = [aim.bounce_weight if name in ("cos2", "sin2", "cos4", "sin4") else 20.0 for name in PARAMETERS]
    ease = np.array(firm + [0.3] * len(style.loose))

    def residuals(values: Array) -> Array:
        posture = gait_posture(style, legs, stride_m, values, phase, floored=False)
        leg = solve_legs(legs, posture)
        thigh, knee, pitch = leg.thigh_deg[:, 0], leg.knee_deg[:, 0], posture.foot[:, 0, 0]
        miss = np.stack([thigh, knee, knee - thigh + pitch], axis=1) - target - np.array([0, 4, 0])
        low = lowest_point(legs, posture.ankle, posture.foot)[:, 0] - wanted
        low = np.where(phase < style.stance, 0, np.minimum(low, 0))
        parts = (miss * np.array([0.6, 1.0, 0.3])).ravel(), 3000 * leg.overreach.ravel(), 2000 * low
        return np.concatenate([*parts, (values - start) * ease])

    best = least_squares(residuals, start, max_nfev=30)
    log.info("stride %.3f m: residual %.2f after %d steps", stride_m, best.cost, best.nfev)
    return best.x
