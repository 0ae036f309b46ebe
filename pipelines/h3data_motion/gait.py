"""Gaits from imported motion: a captured cycle is decomposed into the parts of a gait and scaled to any speed.

Pelvis, trunk, arms and head move as captured. Captured feet may slide or sink into the floor, so only their curves are
used, as means of left and right: pitch, strike position, and swing. The feet roll on the floor about heel and ball, and
the legs follow, as in the gaits of `h3data.bodies.people.gait`. Start, stop and turn are therefore planted steps at
every speed. Step length is proportional to the square root of the speed, as for people, and slower walks have smaller
movements.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.clips import JOG_ABOVE_MPS, TO_ROOT, Clip, Gaits
from h3data.bodies.people.gait import stand_posture
from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.legs import SIDES, Legs, Posture, X, lowest_point, rotation
from h3data.bodies.people.skeleton import FINGERS, JOINT_INDEX
from h3data.errors import InputError
from h3data.geometry import Array, quat_conjugate, quat_multiply, quat_nlerp, quat_rotate, quat_sign_continuous
from h3data_motion.clip import Motion
from h3data_motion.cycle import trim_to_cycle

SPEEDS_MPS = (0.3, 4.0)
LEAST_STRIDE_M = 0.35
"""Least distance covered in a cycle of two steps [m]; below it, the person stands or steps on the spot."""
HALF = (0.3, 0.7)
"""Range of phases in which the right foot must strike for a cycle to count as walking."""
STANCES = {False: (0.58, 0.70), True: (0.25, 0.5)}
"""Range of the share of the cycle during which a foot is on the floor, for walking and running."""
FLAT = (0.25, 0.55)
"""Part of the stance during which a foot is flat."""
TILT_DEG, LEVEL_DEG = 20.0, 1.5
"""Largest apparent tilt of a flat foot, which is removed, and tilt below which the rest is noise [deg]."""
SMOOTH_FRAMES = 1.5
TWITCH_M = 0.15
"""Largest movement of a joint relative to the pelvis in 1/30 s [m], except for the legs, which are recomputed."""
STILL_RAD = 0.03
"""Motion of fingers below which they count as not captured [rad]."""

_LEGS = {f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle", "foot")}
_FINGERS = [JOINT_INDEX[f"{side}_{finger}{k}"] for side in ("left", "right") for finger in FINGERS for k in (1, 2, 3)]
_SEEN = [JOINT_INDEX[name] for name in list(JOINT_INDEX)[1:22] if name not in _LEGS]


@dataclass(frozen=True, kw_only=True, eq=False)
class Cycle:
    """Captured cycle of walking on one body, in the body frame (+Z forward, +Y up, +X left).

    Phase 0 is the strike of the left foot, 0.5 that of the right one.
    """

    speed_mps: float
    stride_m: float
    stance: float
    """Share of the cycle during which a foot is on the floor."""
    strike: float
    """Distance ahead of the pelvis at which a foot strikes, in strides."""
    quats: Array
    """Local joint rotations xyzw, shape [F, 55, 4]; those of the legs are not used."""
    pelvis: Array
    """Positions of the pelvis in the body frame, shape [F, 3] [m]."""
    pitch: Array
    """Pitch of a foot over its own phase, positive with toes up, shape [F] [deg]."""
    flight: Array
    """Offset of the ankle of a swinging foot, forward of and above the line between its two stance positions, at equal
    intervals of the swing and 0 at both ends, shape [S, 2] [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionGaits(Gaits):
    """Gaits of a body that walks or runs like a captured cycle."""

    cycle: Cycle

    def plays(self, speed_mps: ArrayLike) -> bool:
        """Return whether the captured cycle is used at these speeds [m/s]."""
        return bool(np.all((np.asarray(speed_mps) > JOG_ABOVE_MPS) == (self.cycle.speed_mps > JOG_ABOVE_MPS)))

    def stride_m(self, speed_mps: ArrayLike) -> Array:
        """Return the length of a cycle [...] [m] at speeds [...] [m/s], scaled from the captured cycle."""
        speed = np.abs(np.asarray(speed_mps, np.float64))
        jogs = self.cycle.speed_mps > JOG_ABOVE_MPS
        captured = self.cycle.stride_m * np.sqrt((speed if jogs else np.minimum(speed, 2.0)) / self.cycle.speed_mps)
        return np.where((speed > JOG_ABOVE_MPS) == jogs, captured, Gaits.stride_m(self, speed))

    def stance(self, speed_mps: float) -> float:
        """Return the share of a cycle in which a foot is on the floor at a speed [m/s].

        At speeds at which the captured cycle is used, the share is that of the cycle.
        """
        return self.cycle.stance if self.plays(speed_mps) else Gaits.stance(self, speed_mps)

    def strike(self, speed_mps: float) -> float:
        """Return the distance of a foot ahead of the pelvis at its strike, in strides, at a speed [m/s].

        At speeds at which the captured cycle is used, the distance is that of the cycle.
        """
        return self.cycle.strike if self.plays(speed_mps) else Gaits.strike(self, speed_mps)

    def posture(self, speed_mps: Array, phase: Array) -> Posture:
        """Return the posture at speeds [m/s] and phases, from the captured cycle at speeds at which it is used."""
        if not self.plays(speed_mps):
            return Gaits.posture(self, speed_mps, phase)
        return cycle_posture(self.cycle, self.legs, self.stride_m(speed_mps), np.asarray(phase, np.float64))


def walks_as(body: Humanoid, motion: Motion, *, name: str = "") -> Humanoid:
    """Return the body with a motion's cycle as its gait.

    Raises:
        InputError: the motion has no walking cycle that can be played.
    """
    clip = trim_to_cycle(motion, body)
    gaits = {field.name: getattr(body.gaits, field.name) for field in fields(Gaits)}
    walker = replace(body, name=name or body.name, gaits=MotionGaits(**gaits, cycle=cycle_of(clip, body)))
    _refuse_twitches(walker, motion.name)
    return walker


def cycle_of(clip: Clip, body: Humanoid) -> Cycle:
    """Return the walking cycle of a clip that was fitted to a body.

    Raises:
        InputError: the clip is not a forward walk with both feet on one floor.
    """
    if clip.speed_mps <= 0 or clip.stride_m < LEAST_STRIDE_M:
        gets = f"{clip.stride_m if clip.speed_mps > 0 else 0:.2f} m in its best cycle of {clip.period_s:.2f} s"
        raise InputError(
            f"Motion {clip.name!r}: expected somebody who walks, this one gets {gets}.", code="H3-BODY-054"
        )
    if not SPEEDS_MPS[0] <= clip.speed_mps <= SPEEDS_MPS[1]:
        raise InputError(
            f"Motion {clip.name!r}: expected a walk of {SPEEDS_MPS[0]} to {SPEEDS_MPS[1]} m/s, this is one of "
            f"{clip.speed_mps:.2f} m/s. Hint: is the unit of the file right (--unit-m of h3data motion import)?",
            code="H3-BODY-055",
        )
    quats, pelvis, ankle = _in_body_frame(clip)
    front = quat_rotate(quats[:, 0], np.array([0.0, 0, 1])).mean(axis=0)
    if front[2] < 0.8 * np.hypot(front[0], front[2]):
        raise InputError(
            f"Motion {clip.name!r}: expected somebody who walks where they face, this one goes "
            f"{np.degrees(np.arctan2(abs(front[0]), front[2])):.0f} degrees off it.",
            code="H3-BODY-056",
        )
    half = _right_strike(ankle, clip.name)
    quats, pelvis, ankle, pitch = (_warped(a, half) for a in (quats, pelvis, ankle, clip.foot[:, :, 0]))
    own = np.stack([ankle[:, 0], np.roll(ankle[:, 1], -len(ankle) // 2, axis=0)], axis=1).mean(axis=1)
    pitch = _rolled(pitch)
    least, most = STANCES[clip.speed_mps > JOG_ABOVE_MPS]
    stance = min(max(clip.stance, least), most)
    phase = np.arange(len(own)) / len(own)
    flat = (phase > FLAT[0] * stance) & (phase < FLAT[1] * stance)
    tilt = float(np.median(pitch[flat]))
    if abs(tilt) > TILT_DEG:
        raise InputError(
            f"Motion {clip.name!r}: expected feet that lie flat in mid-stance, they are tilted by {tilt:.0f} degrees.",
            code="H3-BODY-057",
        )
    pitch = _smoothed(pitch - tilt)
    pitch = np.sign(pitch) * np.maximum(np.abs(pitch) - LEVEL_DEG, 0)
    legs = body.gaits.legs
    rolling = _roll(legs, pitch)
    stands = (phase > 0.05) & (phase < stance - 0.05)
    strike = float(np.mean((own[stands, 2] - rolling[stands, 1]) / clip.stride_m + phase[stands]))
    return Cycle(
        speed_mps=clip.speed_mps,
        stride_m=clip.stride_m,
        stance=stance,
        strike=strike,
        quats=_with_fingers(quats, legs),
        pelvis=pelvis,
        pitch=pitch,
        flight=_flight(own, stance, clip.stride_m * strike, clip.stride_m),
    )


def cycle_posture(cycle: Cycle, legs: Legs, stride_m: Array, phase: Array) -> Posture:
    """Return postures at phases [T] with strides [T] [m]; shorter strides make all movements smaller."""
    stride = np.broadcast_to(np.asarray(stride_m, np.float64), phase.shape)
    share = np.minimum(stride / cycle.stride_m, 1.0)
    stand = stand_posture(legs, len(phase))
    quats = quat_nlerp(stand.quats, _sampled(cycle.quats, phase, unit=True), np.repeat(share[:, None], 55, axis=1))
    pelvis = stand.pelvis + share[:, None] * (_sampled(cycle.pelvis, phase) - stand.pelvis)
    ankle, foot = np.zeros((len(phase), 2, 3)), np.zeros((len(phase), 2, 3))
    for k, (_, sign, start) in enumerate(SIDES):
        own = (phase - start) % 1.0
        u = np.clip((own - cycle.stance) / (1 - cycle.stance), 0, 1)
        swings = own >= cycle.stance
        pitch = share * _sampled(cycle.pitch, own)
        ends = [_roll(legs, share * _sampled(cycle.pitch, np.full(len(own), at))) for at in (cycle.stance, 0.0)]
        onward = cycle.strike - np.where(swings, cycle.stance * (1 - u * u * (3 - 2 * u)), own)
        off = np.where(
            swings[:, None],
            (1 - u)[:, None] * ends[0] + u[:, None] * ends[1] + share[:, None] * _between(cycle.flight, u),
            _roll(legs, pitch),
        )
        ankle[:, k] = np.stack(
            [np.full(len(own), sign * legs.half_width), legs.ankle_height + off[:, 0], stride * onward + off[:, 1]],
            axis=1,
        )
        relaxing = np.clip(u / 0.35, 0, 1)
        foot[:, k, 0] = pitch
        foot[:, k, 2] = (1 - 0.85 * relaxing * relaxing * (3 - 2 * relaxing)) * np.maximum(-pitch, 0)
    ankle[..., 1] += np.maximum(-lowest_point(legs, ankle, foot), 0)
    return Posture(quats=quats, pelvis=pelvis, ankle=ankle, foot=foot)


# --- taking a clip apart ------------------------------------------------------------------------------------------------
def _in_body_frame(clip: Clip) -> tuple[Array, Array, Array]:
    """Return rotations [F, 55, 4], pelvis [F, 3] and ankles [F, 2, 3], the pelvis in the middle over the root."""
    back = quat_conjugate(TO_ROOT)
    quats, pelvis = clip.quats.copy(), quat_rotate(back, clip.pelvis)
    quats[:, 0] = quat_multiply(back, quats[:, 0])
    middle = pelvis.mean(axis=0) * (1, 0, 1)
    return quat_sign_continuous(quats), pelvis - middle, clip.ankle - middle


def _right_strike(ankle: Array, name: str) -> float:
    """Return the phase at which the right foot does what the left one does at 0."""
    left, right = (ankle[:, k, 2] - ankle[:, k, 2].mean() for k in (0, 1))
    alike = [float(np.dot(left, np.roll(right, -shift))) for shift in range(len(left))]
    half = int(np.argmax(alike)) / len(left)
    if not HALF[0] <= half <= HALF[1] or max(alike) < 0.7 * float(np.dot(left, left)):
        raise InputError(
            f"Motion {name!r}: expected left and right steps in turn, the right foot does what the left one does "
            f"{half:.2f} cycles later.",
            code="H3-BODY-058",
        )
    return half


def _warped(values: Array, half: float) -> Array:
    """Return values over a cycle [F, ...] whose second half begins at ``half``, so that it begins at 0.5."""
    phase = np.arange(len(values)) / len(values)
    at = np.where(phase < 0.5, 2 * half * phase, half + 2 * (1 - half) * (phase - 0.5))
    unit = values.shape[-1] == 4
    return _sampled(values, at, unit=unit)


def _rolled(pitch: Array) -> Array:
    """Return the mean over both feet [F, 2], each from its own strike on."""
    return (pitch[:, 0] + np.roll(pitch[:, 1], -len(pitch) // 2)) / 2


def _smoothed(values: Array) -> Array:
    """Return values over a cycle [F] without what lasts about `SMOOTH_FRAMES`."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(values, SMOOTH_FRAMES, mode="wrap")


def _sampled(values: Array, phase: Array, *, unit: bool = False) -> Array:
    """Return values over a cycle [F, ...] at phases [T], between frames linearly."""
    place = (phase % 1.0) * len(values)
    low = np.floor(place).astype(np.intp) % len(values)
    share = (place - np.floor(place)).reshape(-1, *[1] * (values.ndim - 1))
    a, b = values[low], values[(low + 1) % len(values)]
    if unit:
        return quat_nlerp(a, b, np.broadcast_to(share[..., 0], a.shape[:-1]))
    return a + share * (b - a)


def _between(values: Array, share: Array) -> Array:
    """Return values at even shares 0..1 [S, K] at shares [T]."""
    at = np.linspace(0, 1, len(values))
    return np.stack([np.interp(share, at, column) for column in values.T], axis=1)


def _roll(legs: Legs, pitch: Array) -> Array:
    """Return the displacement of an ankle, up and forward from a flat foot's, [T, 2] [m].

    The foot pitches by [T] [deg] about its heel or ball.
    """
    pivot = np.where((pitch > 0)[:, None], legs.feet[0, 0], legs.feet[0, 1])
    off = pivot - (rotation(X, -pitch) @ pivot[..., None])[..., 0]
    return off[:, 1:]


def _flight(own: Array, stance: float, strike_m: float, stride_m: float) -> Array:
    """Return `Cycle.flight` of a foot's ankle over its own phase [F, 3] [m]."""
    u = np.linspace(0, 1, 49)
    place = _sampled(own, stance + u * (1 - stance) * (1 - 1e-9))
    line = strike_m - stride_m * stance * (1 - u * u * (3 - 2 * u))
    off = np.stack([place[:, 1], place[:, 2] - line], axis=1)
    return off - (1 - u)[:, None] * off[0] - u[:, None] * off[-1]


def _with_fingers(quats: Array, legs: Legs) -> Array:
    """Return the rotations, with the fingers of a standing person if fingers have not been captured."""
    still = 2 * np.arccos(np.clip(np.abs(quats[:, _FINGERS, 3]), 0, 1)).max() < STILL_RAD
    if still:
        quats = quats.copy()
        quats[:, _FINGERS] = stand_posture(legs).quats[0, _FINGERS]
    return quats


def _refuse_twitches(body: Humanoid, name: str) -> None:
    """Raise an `InputError` if a joint jumps while the captured cycle is played at its speed."""
    gaits = body.gaits
    assert isinstance(gaits, MotionGaits)
    cycle, count = gaits.cycle, 128
    phase = np.arange(count) / count
    step = cycle.speed_mps / 30 / cycle.stride_m
    places = []
    for at in (phase, phase + step):
        frames = body.joint_matrices(np.tile([0.0, 0, 0, 0, 0, 0, 1], (count, 1)), *body.walk_pose(cycle.speed_mps, at))
        places.append(frames[:, _SEEN][..., :3, 3] - frames[:, :1, :3, 3])
    moved = np.linalg.norm(places[1] - places[0], axis=-1)
    if moved.max() > TWITCH_M:
        joint = list(JOINT_INDEX)[_SEEN[int(moved.max(axis=0).argmax())]]
        raise InputError(
            f"Motion {name!r}: expected joints that move smoothly, {joint} jumps by {100 * moved.max():.0f} cm in 1/30 s. "
            "Hint: clean the capture, or take another part of it.",
            code="H3-BODY-059",
        )
