"""Foot-planted walking and jogging: the feet are given, the legs follow by closed-form inverse kinematics.

During stance a foot pivots about its heel (toes up) or its ball (heel up, toes bent flat); the pivot is at rest on the
floor, so nothing slides by construction. In swing the ankle flies along a Hermite curve with bumps. Pelvis height, bumps
and pitch offsets are fitted so that hip, knee and ankle angles follow normative curves (research/humanoids.md 2). Those
curves were entered from memory, good to about 3 degrees for walking and less for jogging: a shape, not data.

Everything here is in the body frame (+Z forward, +Y up, +X left) until `to_clip` turns it into the agent root frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.motion import Clip
from h3data.bodies.skeleton import JOINT_COUNT, JOINT_INDEX
from h3data.geometry import (
    Array,
    quat_from_axis_angle,
    quat_from_matrix,
    quat_multiply,
    quat_rotate,
    quat_sign_continuous,
    quat_to_matrix,
)
from h3data_pipelines.bake.rig import Rig

X, Y, Z = np.eye(3)
SIDES = (("left", 1.0, 0.0), ("right", -1.0, 0.5))
"""Name, sign of x, phase of the heel strike."""
LEG_MAX = 0.9985
"""A leg is never stretched further than this share of its length."""

WALK_ANGLES = np.array([
    [0, 30, 5, 0], [.05, 29, 10, -4], [.1, 27, 16, -5], [.15, 24, 18, -1], [.2, 19, 17, 3], [.3, 8, 11, 7],
    [.4, -3, 6, 9], [.5, -10, 10, 9], [.55, -9, 22, 2], [.6, -4, 38, -14], [.65, 6, 53, -18], [.7, 17, 61, -12],
    [.75, 26, 60, -5], [.8, 32, 52, 0], [.85, 35, 36, 2], [.9, 34, 18, 2], [.95, 32, 6, 1],
])  # fmt: skip
"""Phase, thigh to the vertical, knee flexion, ankle dorsiflexion [deg] at natural walking speed."""
JOG_ANGLES = np.array([
    [0, 27, 18, 4], [.08, 24, 30, 12], [.18, 12, 41, 20], [.3, -8, 28, 12], [.4, -22, 20, -16], [.48, -23, 38, -18],
    [.58, -8, 72, -10], [.68, 18, 92, -4], [.76, 33, 82, 0], [.86, 40, 46, 2], [.94, 35, 19, 2],
])  # fmt: skip
"""The same for easy jogging at about 2.5 m/s."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GaitStyle:
    """What distinguishes walking from jogging. Angles in degrees, phases as shares of the cycle."""

    stance: float
    pitch: tuple[tuple[float, float], ...]
    """Foot pitch over the cycle from heel strike: (phase, degrees, positive = toes up)."""
    loose: tuple[int, ...]
    """Rows of ``pitch`` that the fit may change."""
    angles: Array
    """Joint angles to be followed."""
    start: Mapping[str, float]
    """First guess of some fitted parameters."""
    bounce_weight: float
    """How firmly the fit keeps the first guess of the pelvis' rise and fall."""
    yaw: float
    list: float
    sway_m: float
    lean: float
    width: float
    """Half step width as a share of the hip joints' half distance."""
    arm_mean: float
    arm_swing: float
    arm_down: float
    elbow_mean: float
    elbow_swing: float


WALK = GaitStyle(
    stance=0.61,
    pitch=(
        (0, 20), (.03, 14), (.08, 0), (.12, 0), (.32, -1), (.42, -12), (.52, -32), (.61, -58), (.68, -66), (.76, -36),
        (.85, -4), (.92, 16), (.97, 21),
    ),
    loose=(5, 6, 7, 8),
    angles=WALK_ANGLES,
    start={"height": -0.03, "cos2": -0.018, "lift": 0.05}, bounce_weight=150,
    yaw=4.5, list=3.5, sway_m=0.018, lean=3.0, width=0.60,
    arm_mean=2, arm_swing=17, arm_down=77, elbow_mean=24, elbow_swing=9,
)  # fmt: skip
JOG = GaitStyle(
    stance=0.39,
    pitch=(
        (0, 9), (.04, 3), (.08, 0), (.18, -1), (.26, -14), (.33, -34), (.39, -54), (.48, -78), (.58, -90), (.68, -80),
        (.76, -48), (.86, -4), (.94, 13),
    ),
    loose=(4, 5, 6, 7, 8, 9, 10),
    angles=JOG_ANGLES,
    start={"height": -0.05, "cos2": 0.024, "sin2": -0.018, "lift": 0.28}, bounce_weight=2500,
    yaw=6.0, list=3.0, sway_m=0.010, lean=7.0, width=0.42,
    arm_mean=-4, arm_swing=30, arm_down=73, elbow_mean=88, elbow_swing=12,
)  # fmt: skip

PARAMETERS = ("height", "cos2", "sin2", "cos4", "sin4", "shift", "lift", "lift_skew", "reach", "reach_skew")


@dataclass(frozen=True, kw_only=True, eq=False)
class Foot:
    """The points of one foot about which it rolls, relative to the ankle joint, foot flat."""

    ankle_height: float
    heel: Array
    ball: Array
    toe: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Cycle:
    """One generated cycle in the body frame, with what the fit looks at."""

    quats: Array
    """Shape [T, 55, 4]."""
    pelvis: Array
    """Shape [T, 3]."""
    angles: Array
    """Left thigh, knee, ankle [deg], shape [T, 3]."""
    overreach: Array
    """How far each leg would have to be stretched, as a share of its length, shape [T, 2]."""
    clearance: Array
    """Lowest point of the left foot in swing above its wanted height [m], shape [T]; large in stance."""


def rotation(axis: Array, angle_deg: Array | float) -> Array:
    """Rotation matrices [..., 3, 3] about a fixed axis, angles in degrees."""
    return quat_to_matrix(quat_from_axis_angle(axis, np.radians(np.asarray(angle_deg, np.float64))))


def foot_of(rig: Rig, side: str) -> Foot:
    """Heel, ball and toe of a shod foot: the sole's ends from the mesh; the ball is the toe joint itself, so that toes held
    flat rest while the heel rises (a pivot on the floor below it would drag them 2 cm)."""
    ankle, ball = rig.joint(f"{side}_ankle"), rig.joint(f"{side}_foot")
    weight = rig.weights[:, [JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]].sum(axis=1)
    sole = rig.vertices[(weight > 0.5) & (rig.vertices[:, 1] < 0.02)]
    heel = np.array([0.98 * ankle[0], 0, sole[:, 2].min() + 0.012])
    toe = np.array([ball[0], 0, sole[:, 2].max()])
    return Foot(ankle_height=ankle[1], heel=heel - ankle, ball=ball - ankle, toe=toe - ankle)


def pitch_curve(style: GaitStyle, loose: Array, phase: Array, amplitude: float) -> Array:
    """Foot pitch [deg] at phases [...] through the knots, the loose ones moved: periodic, and without the overshoot of a
    cubic spline, which would lift a flat foot's toes by 5 mm."""
    from scipy.interpolate import PchipInterpolator

    knots = np.array(style.pitch, np.float64)
    rows = list(style.loose)
    knots[rows, 1] = np.minimum(knots[rows, 1] + loose, -1)  # heel up: only so the pivot stays at the ball
    cycle = np.array([1.0, 0.0])
    around = np.concatenate([knots - cycle, knots, knots + cycle])
    return amplitude * PchipInterpolator(around[:, 0], around[:, 1])(phase % 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Gait:
    """A body at one speed: everything but the fitted parameters."""

    rig: Rig
    style: GaitStyle
    speed_mps: float
    stride_m: float

    @property
    def period_s(self) -> float:
        return self.stride_m / self.speed_mps

    @property
    def amplitude(self) -> float:
        """Slow gaits with short steps move less: scale of all angles, 1 for a step of 0.82 leg lengths."""
        return min(1.0, self.stride_m / 2 / (0.82 * leg_length(self.rig)))


def leg_length(rig: Rig) -> float:
    """Thigh and shank together [m]."""
    return float(abs(rig.offsets[JOINT_INDEX["left_knee"], 1]) + abs(rig.offsets[JOINT_INDEX["left_ankle"], 1]))


def walk_gait(rig: Rig, speed_mps: float) -> Gait:
    """A walk with step length sqrt(WR 60 v), walk ratio WR = 0.0062 m per step/min at 0.86 m of leg (Sekiya et al.: 0.0065)."""
    ratio = 0.0062 * leg_length(rig) / 0.86
    return Gait(rig=rig, style=WALK, speed_mps=speed_mps, stride_m=2 * float(np.sqrt(ratio * 60 * speed_mps)))


def jog_gait(rig: Rig, speed_mps: float) -> Gait:
    """An easy jog at about 160 steps a minute (at 1.72 m; shorter people step faster)."""
    steps_per_s = 160 / 60 * float(np.sqrt(1.72 / rig.vertices[:, 1].max()))
    return Gait(rig=rig, style=JOG, speed_mps=speed_mps, stride_m=2 * speed_mps / steps_per_s)


def stance_ankle(gait: Gait, foot: Foot, phase: Array, pitch_deg: Array, shift: float) -> Array:
    """Ankles [T, 3] of a foot on the floor, z from the pelvis: its pivot moves back exactly as fast as the body forth."""
    turn = rotation(X, -pitch_deg)
    pivot = np.where((pitch_deg > 0)[:, None], foot.heel, foot.ball)
    ankle = pivot - np.einsum("tij,tj->ti", turn, pivot)
    travel = gait.stride_m * (gait.style.stance / 2 - 0.045 + shift - phase)
    return np.stack([np.zeros(len(phase)), ankle[:, 1] + foot.ankle_height, ankle[:, 2] + travel], axis=1)


def foot_path(
    gait: Gait, foot: Foot, phase: Array, p: Mapping[str, float], loose: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Ankle [T, 3] and pitch [T] [deg] of a foot over the cycle, and where it stands [T] (bool)."""
    stance = gait.style.stance
    pitch = pitch_curve(gait.style, loose, phase, gait.amplitude)
    stands = phase < stance

    def at(place: float) -> Array:
        one = np.array([place])
        return stance_ankle(gait, foot, one, pitch_curve(gait.style, loose, one, gait.amplitude), p["shift"])[0]

    step, span = 1e-3, 1 - stance
    off, on = at(stance), at(0.0)
    leave, arrive = (off - at(stance - step)) / step * span * 0.6, (at(step) - on) / step * span * 0.5
    u = np.clip((phase - stance) / span, 0, 1)[:, None]
    swing = (2 * u**3 - 3 * u**2 + 1) * off + (u**3 - 2 * u**2 + u) * leave
    swing += (3 * u**2 - 2 * u**3) * on + (u**3 - u**2) * arrive
    bump, skew = np.sin(np.pi * u[:, 0]) ** 2, np.sin(2 * np.pi * u[:, 0]) * np.sin(np.pi * u[:, 0])
    swing[:, 1] += gait.amplitude * (p["lift"] * bump + p["lift_skew"] * skew)
    swing[:, 2] += gait.amplitude * (p["reach"] * bump + p["reach_skew"] * skew)
    return np.where(stands[:, None], stance_ankle(gait, foot, phase, pitch, p["shift"]), swing), pitch, stands


def generate(gait: Gait, values: Array, frames: int) -> Cycle:
    """One cycle from the fitted ``values``: `PARAMETERS`, then the offsets of the loose pitch knots."""
    rig, style, scale = gait.rig, gait.style, gait.amplitude
    p: dict[str, float] = {name: float(values[k]) for k, name in enumerate(PARAMETERS)}
    loose = values[len(PARAMETERS) :]
    phase = np.arange(frames) / frames
    wave = 2 * np.pi * phase
    yaw = -style.yaw * scale * np.cos(wave)
    listing = style.list * scale * np.sin(wave + 0.35)
    pelvis_turn = rotation(Y, yaw) @ rotation(Z, listing) @ rotation(X, np.full(frames, style.lean))
    feet = {side: foot_of(rig, side) for side, _, _ in SIDES}
    hips = {side: pelvis_turn @ (rig.joint(f"{side}_hip") - rig.positions[0]) for side, _, _ in SIDES}
    thigh, shank = abs(rig.offsets[JOINT_INDEX["left_knee"], 1]), abs(rig.offsets[JOINT_INDEX["left_ankle"], 1])
    height = thigh + shank + feet["left"].ankle_height - hips["left"][:, 1].mean() + p["height"]
    height = height + p["cos2"] * np.cos(2 * wave) + p["sin2"] * np.sin(2 * wave)
    height = height + p["cos4"] * np.cos(4 * wave) + p["sin4"] * np.sin(4 * wave)
    sway = style.sway_m * scale * np.sin(wave - 0.04 * np.pi)
    pelvis = np.stack([sway, height, np.zeros(frames)], axis=1)
    quats = np.tile([0.0, 0, 0, 1], (frames, JOINT_COUNT, 1))
    quats[:, 0] = quat_from_matrix(pelvis_turn)
    overreach, angles, clearance = [], np.zeros((frames, 3)), np.zeros(frames)
    for side, sign, start in SIDES:
        own = (phase - start) % 1.0
        ankle, pitch, stands = foot_path(gait, feet[side], own, p, loose)
        ankle[:, 0] = sign * style.width * abs(rig.joint("left_hip")[0])
        toe_bend = _toe_bend(gait, own, pitch)
        leg = solve_leg(hips[side] + pelvis, ankle, thigh, shank, toe_out=sign * 0.10)
        overreach.append(leg.overreach)
        foot_turn = rotation(X, -pitch)
        _set_leg(quats, side, pelvis_turn, leg, foot_turn, toe_bend)
        if side == "left":
            angles = np.stack([leg.thigh_deg, leg.knee_deg, leg.knee_deg - leg.thigh_deg + pitch], axis=1)
            clearance = _clearance(gait, feet[side], ankle, foot_turn, toe_bend, own, stands)
    _set_trunk(quats, yaw, listing, style.lean)
    for side, sign, start in SIDES:
        swing = -np.cos(2 * np.pi * (phase - start) - 0.15)
        flexion = (style.arm_mean + style.arm_swing * swing) * scale
        elbow = style.elbow_mean + style.elbow_swing * swing * scale
        set_arm(quats, side, sign, flexion, elbow, style.arm_down)
    return Cycle(quats=quats, pelvis=pelvis, angles=angles, overreach=np.stack(overreach, axis=1), clearance=clearance)


def _toe_bend(gait: Gait, phase: Array, pitch: Array) -> Array:
    """Toe joint angle [deg]: flat on the floor while the heel is up, relaxing over the first third of the swing."""
    u = np.clip((phase - gait.style.stance) / (0.35 * (1 - gait.style.stance)), 0, 1)
    share = 1 - 0.85 * u * u * (3 - 2 * u)
    return share * np.maximum(-pitch, 0)


def _clearance(
    gait: Gait, foot: Foot, ankle: Array, turn: Array, toe_bend: Array, phase: Array, stands: NDArray[np.bool_]
) -> Array:
    toe_turn = turn @ rotation(X, -toe_bend)
    toe = foot.ball @ np.swapaxes(turn, 1, 2) + (toe_turn @ (foot.toe - foot.ball))
    heel = turn @ foot.heel
    lowest = ankle[:, 1] + np.minimum(heel[:, 1], toe[:, 1])
    u = np.clip((phase - gait.style.stance) / (1 - gait.style.stance), 0, 1)
    return np.where(stands, 1.0, lowest - 0.018 * np.sin(np.pi * u))


@dataclass(frozen=True, kw_only=True, eq=False)
class Leg:
    """A solved leg: the thigh's frame [T, 3, 3] (y up along the bone), the knee flexion, and what was missing."""

    thigh_turn: Array
    knee_deg: Array
    thigh_deg: Array
    overreach: Array


def solve_leg(hip: Array, ankle: Array, thigh: float, shank: float, *, toe_out: float) -> Leg:
    """Closed-form two-bone leg from ``hip`` to ``ankle`` [T, 3]; the knee points forward and a little out."""
    way = ankle - hip
    distance = np.linalg.norm(way, axis=1)
    total = thigh + shank
    reach = np.minimum(distance, total * 0.9999)
    down = way / distance[:, None]
    forward = np.array([toe_out, 0, 1.0])
    pole = forward - (down @ forward)[:, None] * down
    pole /= np.linalg.norm(pole, axis=1, keepdims=True)
    lift = np.arccos(np.clip((thigh**2 + reach**2 - shank**2) / (2 * thigh * reach), -1, 1))[:, None]
    knee = np.pi - np.arccos(np.clip((thigh**2 + shank**2 - reach**2) / (2 * thigh * shank), -1, 1))
    bone = np.cos(lift) * down + np.sin(lift) * pole
    front = np.cos(lift) * pole - np.sin(lift) * down
    return Leg(
        thigh_turn=np.stack([np.cross(-bone, front), -bone, front], axis=-1),
        knee_deg=np.degrees(knee),
        thigh_deg=np.degrees(np.arctan2(bone[:, 2], -bone[:, 1])),
        overreach=np.maximum(distance / total - LEG_MAX, 0),
    )


def _set_leg(quats: Array, side: str, pelvis_turn: Array, leg: Leg, foot_turn: Array, toe_bend: Array) -> None:
    knee = rotation(X, leg.knee_deg)
    shank_turn = leg.thigh_turn @ knee
    quats[:, JOINT_INDEX[f"{side}_hip"]] = quat_from_matrix(np.swapaxes(pelvis_turn, 1, 2) @ leg.thigh_turn)
    quats[:, JOINT_INDEX[f"{side}_knee"]] = quat_from_matrix(knee)
    quats[:, JOINT_INDEX[f"{side}_ankle"]] = quat_from_matrix(np.swapaxes(shank_turn, 1, 2) @ foot_turn)
    quats[:, JOINT_INDEX[f"{side}_foot"]] = quat_from_matrix(rotation(X, -toe_bend))


def _set_trunk(quats: Array, yaw: Array, listing: Array, lean: float) -> None:
    """The trunk turns against the pelvis and the head stays level."""
    for name, share in (("spine1", 0.5), ("spine2", 0.6), ("spine3", 0.6)):
        turn = rotation(Y, -share * yaw) @ rotation(Z, -0.33 * listing) @ rotation(X, np.full(len(yaw), 0.5))
        quats[:, JOINT_INDEX[name]] = quat_from_matrix(turn)
    quats[:, JOINT_INDEX["neck"]] = quat_from_axis_angle(X, np.radians(-0.4 * lean - 0.8))
    quats[:, JOINT_INDEX["head"]] = quat_from_axis_angle(X, np.radians(-0.3 * lean))


def set_arm(quats: Array, side: str, sign: float, flexion: Array, elbow: Array, down: float) -> None:
    """One arm hanging, swung forward by ``flexion`` [T] [deg], elbow bent by ``elbow`` [T] [deg], fingers half curled."""
    hang = rotation(X, -flexion) @ rotation(Z, np.full(len(flexion), -sign * down))
    quats[:, JOINT_INDEX[f"{side}_shoulder"]] = quat_from_matrix(hang)
    quats[:, JOINT_INDEX[f"{side}_elbow"]] = quat_from_axis_angle(Y, np.radians(-sign * elbow))
    quats[:, JOINT_INDEX[f"{side}_collar"]] = quat_from_axis_angle(Z, np.radians(-sign * 4.0))
    for finger, curl in (("index", 14), ("middle", 18), ("ring", 22), ("pinky", 24)):
        for k in (1, 2, 3):
            quats[:, JOINT_INDEX[f"{side}_{finger}{k}"]] = quat_from_axis_angle(Z, np.radians(-sign * curl))


def fit(gait: Gait, *, frames: int = 40) -> Array:
    """Parameters for `generate` by least squares: joint angles, stretched legs, toe clearance, small changes."""
    from scipy.optimize import least_squares

    start = np.array([gait.style.start.get(name, 0.0) for name in PARAMETERS] + [0.0] * len(gait.style.loose))
    phase = np.arange(frames) / frames
    table = gait.style.angles
    target = np.stack([np.interp(phase, table[:, 0], table[:, k], period=1) for k in (1, 2, 3)], axis=1)
    target[:, :2] *= gait.amplitude
    firm = [gait.style.bounce_weight if name in ("cos2", "sin2", "cos4", "sin4") else 20.0 for name in PARAMETERS]
    ease = np.array(firm + [0.3] * len(gait.style.loose))

    def residuals(values: Array) -> Array:
        cycle = generate(gait, values, frames)
        miss = (cycle.angles - target - np.array([0, 4, 0])) * np.array([0.6, 1.0, 0.3])
        stretched, low = 3000 * cycle.overreach, 2000 * np.minimum(cycle.clearance, 0)
        return np.concatenate([miss.ravel(), stretched.ravel(), low, (values - start) * ease])

    return least_squares(residuals, start, max_nfev=30).x


def stand_pose(rig: Rig) -> Cycle:
    """Standing: feet flat below the hips, knees hardly bent, arms hanging. One frame."""
    quats = np.tile([0.0, 0, 0, 1], (1, JOINT_COUNT, 1))
    feet = {side: foot_of(rig, side) for side, _, _ in SIDES}
    thigh, shank = abs(rig.offsets[JOINT_INDEX["left_knee"], 1]), abs(rig.offsets[JOINT_INDEX["left_ankle"], 1])
    pelvis_turn = rotation(X, np.array([2.0]))
    hip_x = abs(rig.joint("left_hip")[0])
    drop = rig.joint("left_hip") - rig.positions[0]
    pelvis = np.array([[0, (thigh + shank) * 0.996 + feet["left"].ankle_height - (pelvis_turn @ drop)[0, 1], 0.0]])
    overreach = []
    for side, sign, _ in SIDES:
        ankle = np.array([[sign * 0.85 * hip_x, feet[side].ankle_height, -0.03]])
        hip = pelvis_turn @ (rig.joint(f"{side}_hip") - rig.positions[0]) + pelvis
        leg = solve_leg(hip, ankle, thigh, shank, toe_out=sign * 0.10)
        overreach.append(leg.overreach)
        _set_leg(quats, side, pelvis_turn, leg, np.eye(3)[None], np.zeros(1))
        set_arm(quats, side, sign, np.array([1.0]), np.array([16.0]), 78)
    _set_trunk(quats, np.zeros(1), np.zeros(1), 2.0)
    return Cycle(
        quats=quats, pelvis=pelvis, angles=np.zeros((1, 3)), overreach=np.stack(overreach, 1), clearance=np.zeros(1)
    )


def to_clip(cycle: Cycle, *, name: str, gait: Gait | None = None) -> Clip:
    """The cycle as a clip in the agent root frame, signs continuous all the way round."""
    turn = quat_from_axis_angle(Y, np.pi / 2)
    quats = cycle.quats.copy()
    quats[:, 0] = quat_multiply(turn, quats[:, 0])
    quats = quat_sign_continuous(quats)
    if np.any(np.sum(quats[-1] * quats[0], axis=-1) < 0):
        raise AssertionError(f"clip {name}: a joint turns by more than half a revolution over the cycle")
    return Clip(
        name=name,
        speed_mps=gait.speed_mps if gait else 0.0,
        stride_m=gait.stride_m if gait else 1.0,
        period_s=gait.period_s if gait else 1.0,
        stance=gait.style.stance if gait else 1.0,
        quats=quats,
        pelvis=quat_rotate(turn, cycle.pelvis),
    )
