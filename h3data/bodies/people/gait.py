"""Walking, jogging and turning with planted feet; the legs follow from the feet by closed-form inverse kinematics.

During stance a foot pivots about its heel (toes up) or its ball (heel up, toes bent flat); the pivot rests on the
floor, so nothing slides by construction. In swing the ankle flies along a Hermite curve with bumps. Parameters that are
fitted per body and speed (pelvis height, bumps, pitch offsets) make hip, knee and ankle follow normative curves
(research/humanoids.md 2).

Everything here is in the body frame (+Z forward, +Y up, +X left) with the origin at the agent's root on the floor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.legs import SIDES, Legs, Posture, X, Y, Z, lowest_point, rotation
from h3data.bodies.people.skeleton import FINGERS, JOINT_COUNT, JOINT_INDEX
from h3data.geometry import Array, quat_from_axis_angle, quat_from_matrix

STAND_ANKLE_Z_M = -0.03
"""Distance of a standing person's ankles behind the pelvis [m]."""
TURN_PER_CYCLE_RAD = np.pi / 4
"""Angle of a turn on the spot per cycle [rad]; each foot takes a step every 45 degrees."""
_TURN_STANCE, _TURN_LIFT_M = 0.56, 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class GaitStyle:
    """Parameters that distinguish walking from jogging, with angles in degrees and phases as shares of the cycle."""

    stance: float
    pitch: tuple[tuple[float, float], ...]
    """Foot pitch over the cycle from heel strike on, as pairs of phase and angle [deg] (positive: toes up)."""
    loose: tuple[int, ...]
    """Indices of the rows of ``pitch`` whose offsets are fitted."""
    yaw: float
    list: float
    sway_m: float
    lean: float
    arm_mean: float
    arm_swing: float
    arm_down: float
    elbow_mean: float
    elbow_swing: float


WALK = GaitStyle(
    stance=0.61,
    pitch=(
        (0, 20),
        (0.03, 14),
        (0.08, 0),
        (0.12, 0),
        (0.32, -1),
        (0.42, -12),
        (0.52, -32),
        (0.61, -58),
        (0.68, -66),
        (0.76, -36),
        (0.85, -4),
        (0.92, 16),
        (0.97, 21),
    ),
    loose=(5, 6, 7, 8),
    yaw=4.5,
    list=3.5,
    sway_m=0.018,
    lean=3.0,
    arm_mean=2,
    arm_swing=17,
    arm_down=77,
    elbow_mean=24,
    elbow_swing=9,
)
JOG = GaitStyle(
    stance=0.39,
    pitch=(
        (0, 9),
        (0.04, 3),
        (0.08, 0),
        (0.18, -1),
        (0.26, -14),
        (0.33, -34),
        (0.39, -54),
        (0.48, -78),
        (0.58, -90),
        (0.68, -80),
        (0.76, -48),
        (0.86, -4),
        (0.94, 13),
    ),
    loose=(4, 5, 6, 7, 8, 9, 10),
    yaw=6.0,
    list=3.0,
    sway_m=0.010,
    lean=7.0,
    arm_mean=-4,
    arm_swing=30,
    arm_down=73,
    elbow_mean=88,
    elbow_swing=12,
)
PARAMETERS = ("height", "cos2", "sin2", "cos4", "sin4", "shift", "lift", "lift_skew", "reach", "reach_skew")
"""Names of the fitted gait parameters; the offsets [deg] of the loose pitch knots follow them in arrays of
parameters."""


def walk_stride(legs: Legs, speed_mps: ArrayLike) -> Array:
    """Return the distance walked in a cycle of two steps [...] [m].

    The length of a step is sqrt(WR 60 v), with the walk ratio WR = 0.0062 m per step/min at a leg length of 0.86 m
    (Sekiya et al.: 0.0065).
    """
    ratio = 0.0062 * legs.length / 0.86
    # twice: a cycle is two steps. The walk ratio, step length over cadence, is nearly constant for a person
    return 2 * np.sqrt(ratio * 60 * np.asarray(speed_mps, np.float64))


def jog_stride(height_m: float, speed_mps: ArrayLike) -> Array:
    """Return the distance per cycle of jogging [...] [m].

    A person of 1.72 m takes 160 steps a minute; shorter people step faster.
    """
    return 2 * np.asarray(speed_mps, np.float64) / (160 / 60 * float(np.sqrt(1.72 / height_m)))


def amplitude(legs: Legs, stride_m: Array) -> Array:
    """Return the scale of all joint angles, which is 1 for a step of 0.82 leg lengths and smaller for shorter steps."""
    return np.minimum(1.0, stride_m / 2 / (0.82 * legs.length))


TURN_START_PHASE = _TURN_STANCE / 2


def gait_posture(
    style: GaitStyle, legs: Legs, stride_m: ArrayLike, values: Array, phase: Array, *, floored: bool = True
) -> Posture:
    """Return postures at ``phase`` [T] of a gait with fitted ``values`` [T, P] or [P] and strides [T] or one [m].

    ``floored`` lifts a swinging foot whose heel or toes would pierce the floor.
    """
    phase = np.asarray(phase, np.float64)
    stride = np.broadcast_to(np.asarray(stride_m, np.float64), phase.shape)
    table = np.broadcast_to(values, (len(phase), values.shape[-1]))
    p = {name: table[:, k] for k, name in enumerate(PARAMETERS)}
    loose, scale, wave = table[:, len(PARAMETERS) :], amplitude(legs, stride), 2 * np.pi * phase
    # the pelvis goes with the leg ahead, and lists to the side of the swinging leg
    yaw = -style.yaw * scale * np.cos(wave)
    listing = style.list * scale * np.sin(wave + 0.35)
    pelvis_turn = rotation(Y, yaw) @ rotation(Z, listing) @ rotation(X, np.full(len(phase), style.lean))
    height = legs.length + legs.ankle_height - (rotation(X, style.lean) @ legs.hips[0])[1] + p["height"]
    # twice a cycle, once for each leg; the higher harmonic lets the fit shape that dip
    height = height + p["cos2"] * np.cos(2 * wave) + p["sin2"] * np.sin(2 * wave)
    height = height + p["cos4"] * np.cos(4 * wave) + p["sin4"] * np.sin(4 * wave)
    sway = style.sway_m * scale * np.sin(wave - 0.04 * np.pi)
    quats = np.tile([0.0, 0, 0, 1], (len(phase), JOINT_COUNT, 1))
    quats[:, 0] = quat_from_matrix(pelvis_turn)
    _set_trunk(quats, yaw, listing, style.lean)
    ankle, foot = np.zeros((len(phase), 2, 3)), np.zeros((len(phase), 2, 3))
    for k, (side, sign, start) in enumerate(SIDES):
        own = (phase - start) % 1.0
        ankle[:, k], foot[:, k, 0] = _foot_path(style, legs.feet[k], legs.ankle_height, stride, scale, own, p, loose)
        ankle[:, k, 0] = sign * legs.half_width
        # toe joints are flat on the floor while the heel is up, and relax over the first third of the swing
        pitch = foot[:, k, 0]
        u = np.clip((own - style.stance) / (0.35 * (1 - style.stance)), 0, 1)
        foot[:, k, 2] = (1 - 0.85 * u * u * (3 - 2 * u)) * np.maximum(-pitch, 0)
        # arms swing against the leg of their side, a little late
        swing = -np.cos(2 * np.pi * (phase - start) - 0.15)
        flexion = (style.arm_mean + style.arm_swing * swing) * scale
        _set_arm(quats, side, sign, flexion, style.elbow_mean + style.elbow_swing * swing * scale, style.arm_down)
    # the fit works without it: a lift that hides a fault would leave nothing to fit
    if floored:
        ankle[..., 1] += np.maximum(-lowest_point(legs, ankle, foot), 0)
    return Posture(quats=quats, pelvis=np.stack([sway, height, 0 * sway], axis=1), ankle=ankle, foot=foot)


def strike_ahead(style: GaitStyle, shift: Array | float) -> Array | float:
    """Return the distance ahead of the pelvis at which a foot strikes the floor, in strides."""
    return style.stance / 2 - 0.045 + shift


def _pitch_curve(style: GaitStyle, loose: Array, phase: Array, scale: Array) -> Array:
    """Return foot pitch [T] [deg] at phases [T], from a curve through knots, some of which ``loose`` [T, L] moves.

    The curve is monotone between knots. A cubic spline would overshoot, which would lift a flat foot's toes by 5 mm.
    """
    x = np.array([knot[0] for knot in style.pitch])
    y = np.tile(np.array([knot[1] for knot in style.pitch], np.float64), (len(phase), 1))
    rows = list(style.loose)
    y[:, rows] = np.minimum(y[:, rows] + loose, -1)  # heel up: only so the pivot stays at the ball
    return scale * _periodic_pchip(x, y, phase)


def _periodic_pchip(x: Array, y: Array, phase: Array) -> Array:
    """Return the monotone cubic through knots x [K] in [0, 1), y [T, K], with period 1, at one phase [T] per row.

    Its slopes are those of Fritsch and Butland.
    """
    width = np.diff(x, append=x[0] + 1)
    slope = (np.roll(y, -1, axis=1) - y) / width
    before, w0 = np.roll(slope, 1, axis=1), np.roll(width, 1)
    # weighted harmonic mean of the slopes at both sides; 0 where they differ in sign, so that no curve overshoots
    a, b = 2 * width + w0, width + 2 * w0
    product = before * slope
    safe = np.where(product > 0, product, 1.0)
    tangent = np.where(product > 0, (a + b) * safe / np.where(product > 0, a * slope + b * before, 1.0), 0.0)
    place = phase % 1.0
    k = (np.searchsorted(x, place, side="right") - 1) % len(x)
    rows, after = np.arange(len(phase)), (k + 1) % len(x)
    u = ((place - x[k]) % 1.0) / width[k]
    h = width[k]
    return (
        (2 * u**3 - 3 * u**2 + 1) * y[rows, k]
        + (u**3 - 2 * u**2 + u) * h * tangent[rows, k]
        + (3 * u**2 - 2 * u**3) * y[rows, after]
        + (u**3 - u**2) * h * tangent[rows, after]
    )


def _foot_path(
    style: GaitStyle,
    points: Array,
    ankle_height: float,
    stride: Array,
    scale: Array,
    phase: Array,
    p: Mapping[str, Array],
    loose: Array,
) -> tuple[Array, Array]:
    """Return the ankle [T, 3] and pitch [T] [deg] of a foot over its own cycle."""
    stance = style.stance

    def standing(at: Array) -> tuple[Array, Array]:
        """Return the ankle and pitch of a foot on the floor: its pivot moves back exactly as fast as the body forth."""
        pitch = _pitch_curve(style, loose, at, scale)
        # toes up the heel stays on the floor, heel up the ball does
        pivot = np.where((pitch > 0)[:, None], points[0], points[1])
        ankle = pivot - (rotation(X, -pitch) @ pivot[..., None])[..., 0]
        travel = stride * (strike_ahead(style, p["shift"]) - at)
        return np.stack([0 * at, ankle[:, 1] + ankle_height, ankle[:, 2] + travel], axis=1), pitch

    on_floor, pitch = standing(phase)
    step, span = 1e-3, 1 - stance
    zero = np.zeros_like(phase)
    off, on = standing(zero + stance)[0], standing(zero)[0]
    # the swing begins and ends with a share of the speed that the foot has on the floor, so that the path has no
    # corner
    leave = (off - standing(zero + stance - step)[0]) / step * span * 0.6
    arrive = (standing(zero + step)[0] - on) / step * span * 0.5
    u = np.clip((phase - stance) / span, 0, 1)[:, None]
    swing = (2 * u**3 - 3 * u**2 + 1) * off + (u**3 - 2 * u**2 + u) * leave
    swing += (3 * u**2 - 2 * u**3) * on + (u**3 - u**2) * arrive
    # both are 0 with their slopes at the ends, so that they bend the path without moving where it meets the floor
    bump, skew = np.sin(np.pi * u[:, 0]) ** 2, np.sin(2 * np.pi * u[:, 0]) * np.sin(np.pi * u[:, 0])
    swing[:, 1] += scale * (p["lift"] * bump + p["lift_skew"] * skew)
    swing[:, 2] += scale * (p["reach"] * bump + p["reach_skew"] * skew)
    return np.where((phase < stance)[:, None], on_floor, swing), pitch


def _set_trunk(quats: Array, yaw: Array, listing: Array, lean: float) -> None:
    """Set the trunk, which turns against the pelvis while the head stays level."""
    for name, share in (("spine1", 0.5), ("spine2", 0.6), ("spine3", 0.6)):
        turn = rotation(Y, -share * yaw) @ rotation(Z, -0.33 * listing) @ rotation(X, np.full(len(yaw), 0.5))
        quats[:, JOINT_INDEX[name]] = quat_from_matrix(turn)
    quats[:, JOINT_INDEX["neck"]] = quat_from_axis_angle(X, np.radians(-0.4 * lean - 0.8))
    quats[:, JOINT_INDEX["head"]] = quat_from_axis_angle(X, np.radians(-0.3 * lean))


def _set_arm(quats: Array, side: str, sign: float, flexion: Array, elbow: Array, down: float) -> None:
    """Set a hanging arm, swung by ``flexion`` [T] [deg] and bent by ``elbow`` [T] [deg], fingers half curled."""
    hang = rotation(X, -flexion) @ rotation(Z, np.full(len(flexion), -sign * down))
    quats[:, JOINT_INDEX[f"{side}_shoulder"]] = quat_from_matrix(hang)
    quats[:, JOINT_INDEX[f"{side}_elbow"]] = quat_from_axis_angle(Y, np.radians(-sign * elbow))
    quats[:, JOINT_INDEX[f"{side}_collar"]] = quat_from_axis_angle(Z, np.radians(-sign * 4.0))
    for finger, curl in zip(FINGERS[:4], (14, 18, 24, 22), strict=True):
        for k in (1, 2, 3):
            quats[:, JOINT_INDEX[f"{side}_{finger}{k}"]] = quat_from_axis_angle(Z, np.radians(-sign * curl))


# --- standing and turning on the spot ----------------------------------------------------------------
def stand_posture(legs: Legs, frames: int = 1) -> Posture:
    """Return the standing posture, with flat feet, slightly bent knees and hanging arms."""
    quats = np.tile([0.0, 0, 0, 1], (frames, JOINT_COUNT, 1))
    turn = rotation(X, 2.0)
    quats[:, 0] = quat_from_matrix(turn[None])
    zero = np.zeros(frames)
    _set_trunk(quats, zero, zero, 2.0)
    ankle = np.zeros((frames, 2, 3))
    for k, (side, sign, _) in enumerate(SIDES):
        ankle[:, k] = sign * legs.half_width, legs.ankle_height, STAND_ANKLE_Z_M
        _set_arm(quats, side, sign, zero + 1.0, zero + 16.0, 78)
    pelvis = np.zeros((frames, 3))
    pelvis[:, 1] = legs.length * 0.996 + legs.ankle_height - (turn @ legs.hips[0])[1]
    return Posture(quats=quats, pelvis=pelvis, ankle=ankle, foot=np.zeros((frames, 2, 3)))


def turn_posture(legs: Legs, phase: Array, *, left: bool) -> Posture:
    """Return the posture while turning on the spot by small steps.

    The root turns by `TURN_PER_CYCLE_RAD` per cycle; feet on the floor do not turn.
    """
    stand = stand_posture(legs, len(phase))
    ankle, foot, pelvis = stand.ankle.copy(), stand.foot.copy(), stand.pelvis.copy()
    way = np.degrees(TURN_PER_CYCLE_RAD) * (1 if left else -1)
    for k, (_, _, start) in enumerate(SIDES):
        own, span = (phase - start) % 1.0, 1 - _TURN_STANCE
        u = np.clip((own - _TURN_STANCE) / span, 0, 1)
        swing = (2 * u**3 - 3 * u**2 + 1) * (-_TURN_STANCE / 2) + (3 * u**2 - 2 * u**3) * _TURN_STANCE / 2
        # the foot leaves and lands at the rate at which the root turns beneath it
        swing -= span * ((u**3 - 2 * u**2 + u) + (u**3 - u**2))
        yaw = way * np.where(own < _TURN_STANCE, _TURN_STANCE / 2 - own, swing)
        ankle[:, k] = (rotation(Y, yaw) @ stand.ankle[:, k][..., None])[..., 0]
        ankle[:, k, 1] += _TURN_LIFT_M * np.sin(np.pi * u) ** 2
        foot[:, k, 1] = yaw
    # over the foot that stands
    pelvis[:, 0] += 0.012 * np.cos(2 * np.pi * (phase - TURN_START_PHASE))
    pelvis[:, 1] -= 0.012
    return replace(stand, pelvis=pelvis, ankle=ankle, foot=foot)
