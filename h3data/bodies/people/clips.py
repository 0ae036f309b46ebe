"""Motion clips: cycles that are played by the distance walked, not by the clock, so that planted feet stay put."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.people.gait import (
    JOG,
    PARAMETERS,
    STAND_ANKLE_Z_M,
    TURN_PER_CYCLE_RAD,
    TURN_START_PHASE,
    WALK,
    gait_posture,
    jog_stride,
    stand_posture,
    strike_ahead,
    turn_posture,
    walk_stride,
)
from h3data.bodies.people.legs import Legs, Posture, solve_legs, within_reach
from h3data.errors import InputError
from h3data.geometry import Array, quat_from_axis_angle, quat_multiply, quat_rotate
from h3data.geometry import quat_sign_continuous as sign_continuous

if TYPE_CHECKING:
    from h3data.bodies.people.kernels.clips import ClipArrays

STAND_BELOW_MPS = 0.15
"""Speed below which a person takes no steps and the standing clip plays [m/s]."""
WALK_SPEEDS_MPS = (0.6, 1.0, 1.3, 1.6)
JOG_SPEED_MPS = 2.5
"""Speed of people in the social-navigation task [m/s] (spec/habitat.md: 10 units)."""
JOG_ABOVE_MPS = 2.0
CLIP_FRAMES = 128
"""Number of frames of a clip; poses between frames are interpolated linearly, which moves planted feet by less than 0.1
mm."""
_FLAT = np.zeros((0, 2))
"""Heights of a floor that is level with the root."""
TO_ROOT = quat_from_axis_angle(np.array([0.0, 1.0, 0.0]), np.pi / 2)
"""Rotation from the body frame (+Z forward) to the agent root frame (x forward), as a quaternion xyzw."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Clip:
    """One cycle of a motion, in the agent root frame (x forward, y up, z right)."""

    name: str
    speed_mps: float
    """Walking speed of the clip [m/s]; 0 for a motion on the spot."""
    stride_m: float
    """Distance per cycle of two steps [m], by which the phase advances; 1 for clips on the spot."""
    period_s: float
    """Duration of a cycle at ``speed_mps`` [s]."""
    stance: float
    """Share of the cycle that each foot spends on the floor, starting at its heel strike (left: phase 0, right: phase
    0.5)."""
    start_phase: float = 0.0
    """Phase, 0 to 1, at which a walk starts from standing: the left foot is at its standing position, the right foot in
    the air beside it."""
    turn_rad: float = 0.0
    """Turn of the root to the left per cycle [rad], for clips that turn on the spot; their phase advances by turn /
    turn_rad."""
    quats: Array
    """Local joint rotations xyzw, shape [F, 55, 4]; frame k is at phase k / F; the signs are continuous round the cycle."""
    pelvis: Array
    """Position of the pelvis joint relative to the root, shape [F, 3] [m]."""
    ankle: Array
    """Positions of the ankles in the body frame, shape [F, 2, 3] [m]; see `h3data.bodies.people.legs.Posture`."""
    foot: Array
    """Pitch, yaw and toe bend of the feet, shape [F, 2, 3] [deg]."""

    def __len__(self) -> int:
        return len(self.quats)

    def __repr__(self) -> str:
        return f"Clip({self.name!r}, {self.speed_mps} m/s, stride {self.stride_m:.3f} m, {len(self)} frames)"


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaits:
    """Walking gait of one body: its legs and the gait parameters fitted to them (`h3data.bodies.people.gait.PARAMETERS`)."""

    legs: Legs
    height_m: float
    walk: Array
    """Fitted gait parameters at the four `WALK_SPEEDS_MPS`, shape [4, P]."""
    jog: Array
    """Fitted gait parameters of jogging at `JOG_SPEED_MPS`, shape [P']."""

    def stride_m(self, speed_mps: ArrayLike) -> Array:
        """Return the distance per cycle [...] [m] at speeds [...] [m/s]."""
        speed = np.abs(np.asarray(speed_mps, np.float64))
        return np.where(
            speed > JOG_ABOVE_MPS, jog_stride(self.height_m, speed), walk_stride(self.legs, np.minimum(speed, 2.0))
        )

    def posture(self, speed_mps: Array, phase: Array) -> Posture:
        """Return postures for moving at speeds [T] [m/s]; parameters are interpolated between the fitted speeds."""
        # callers ask for walking and jogging apart, since each has fitted values of its own
        if np.all(speed_mps > JOG_ABOVE_MPS):
            return gait_posture(JOG, self.legs, self.stride_m(speed_mps), self.jog, phase)
        return gait_posture(WALK, self.legs, self.stride_m(speed_mps), self.walk_values(speed_mps), phase)

    def stance(self, speed_mps: float) -> float:
        """Return the share of the cycle that a foot spends on the floor at a speed [m/s]."""
        return (JOG if speed_mps > JOG_ABOVE_MPS else WALK).stance

    def strike(self, speed_mps: float) -> float:
        """Return the distance ahead of the pelvis at which a foot strikes, in strides, at a speed [m/s]."""
        jogs = speed_mps > JOG_ABOVE_MPS
        values = self.jog if jogs else self.walk_values(speed_mps)
        return float(strike_ahead(JOG if jogs else WALK, values[PARAMETERS.index("shift")]))

    def start_phase(self, speed_mps: float) -> float:
        """Return the phase at which a walk starts: the left foot is exactly where it is in the standing pose."""
        # a planted foot is stride * (strike - phase) ahead of the pelvis; solved for the ankle of a standing person
        return self.strike(speed_mps) - STAND_ANKLE_Z_M / float(self.stride_m(speed_mps))

    def walk_values(self, speed_mps: ArrayLike) -> Array:
        """Return gait parameters [..., P] for walking at speeds [...] [m/s], interpolated between the fitted speeds."""
        speed = np.asarray(speed_mps, np.float64)
        # beyond the fitted speeds `interp` keeps the values of the nearest one
        return np.stack([np.interp(speed, WALK_SPEEDS_MPS, column) for column in self.walk.T], axis=-1)


def make_clips(gaits: Gaits) -> tuple[Clip, ...]:
    """Compute the clips of a body, which takes 30 ms: standing, the walks, the jog and the two turns on the spot."""
    legs, phase = gaits.legs, np.arange(CLIP_FRAMES) / CLIP_FRAMES
    clips = [_clip("stand", legs, stand_posture(legs))]
    for speed in (*WALK_SPEEDS_MPS, JOG_SPEED_MPS):
        stride, name = float(gaits.stride_m(speed)), "jog" if speed > JOG_ABOVE_MPS else "walk"
        clips.append(
            _clip(
                f"{name}_{speed}",
                legs,
                gaits.posture(np.full(CLIP_FRAMES, speed), phase),
                speed_mps=speed,
                stride_m=stride,
                period_s=stride / speed,
                stance=gaits.stance(speed),
                start_phase=gaits.start_phase(speed),
            )
        )
    for side in ("left", "right"):
        turn = TURN_PER_CYCLE_RAD if side == "left" else -TURN_PER_CYCLE_RAD
        posture = turn_posture(legs, phase, left=side == "left")
        clips.append(_clip(f"turn_{side}", legs, posture, start_phase=TURN_START_PHASE, turn_rad=turn))
    return tuple(clips)


def _clip(
    name: str,
    legs: Legs,
    posture: Posture,
    *,
    speed_mps: float = 0.0,
    stride_m: float = 1.0,
    period_s: float = 1.0,
    stance: float = 1.0,
    start_phase: float = 0.0,
    turn_rad: float = 0.0,
) -> Clip:
    posture = within_reach(legs, posture)
    quats = solve_legs(legs, posture).quats
    quats[:, 0] = quat_multiply(TO_ROOT, quats[:, 0])
    return Clip(
        name=name,
        speed_mps=speed_mps,
        stride_m=stride_m,
        period_s=period_s,
        stance=stance,
        start_phase=start_phase,
        turn_rad=turn_rad,
        # so that neighbouring frames can be mixed linearly, the last one with the first one too
        quats=sign_continuous(quats),
        pelvis=quat_rotate(TO_ROOT, posture.pelvis),
        ankle=posture.ankle,
        foot=posture.foot,
    )


def pose_at_speed(
    gaits: Gaits, speed_mps: ArrayLike, phase: ArrayLike, blend: ArrayLike, ground: ArrayLike | None
) -> tuple[Array, Array]:
    """Return local rotations [T, 55, 4] and pelvis positions [T, 3] [m] in the agent root frame for speeds [T] [m/s].

    The arguments ``phase`` [T], ``blend`` [T] and ``ground`` are described in `sample_clips`.
    """
    from h3data.bodies.people.kernels.legs import settle_all

    speed, phase, blend = (
        np.array(a, np.float64)
        for a in np.broadcast_arrays(np.atleast_1d(speed_mps), np.atleast_1d(phase), np.atleast_1d(blend))
    )
    if not np.isfinite(speed).all() or (speed.size and speed.min() < 0):
        raise InputError(f"Expected speeds of 0 m/s or more, got {speed.min()} to {speed.max()}.", code="H3-BODY-068")
    quats, pelvis = np.empty((len(speed), 55, 4)), np.empty((len(speed), 3))
    jogs = speed > JOG_ABOVE_MPS
    for rows in (np.nonzero(jogs)[0], np.nonzero(~jogs)[0]):
        if len(rows):
            moving = gaits.posture(speed[rows], phase[rows])
            floor = _FLAT if ground is None else _floor_heights(ground, len(speed))[rows]
            # copies, because the kernel works in place and postures may share arrays
            own, place, ankle, foot = (a.copy() for a in (moving.quats, moving.pelvis, moving.ankle, moving.foot))
            still = _standing_arrays(gaits.legs)
            settle_all(gaits.legs.measures, still, own, place, ankle, foot, phase[rows], blend[rows], floor)
            own[:, 0] = quat_multiply(TO_ROOT, own[:, 0])
            quats[rows], pelvis[rows] = own, quat_rotate(TO_ROOT, place)
    return quats, pelvis


# Legs are compared by identity, and each body has its own.
@lru_cache(maxsize=64)
def _standing_arrays(legs: Legs) -> tuple[Array, Array, Array, Array]:
    """Return the frame of standing that all frames are blended with: quats [55, 4], pelvis [3], ankle and foot [2, 3]."""
    stand = stand_posture(legs)
    return stand.quats[0], stand.pelvis[0], stand.ankle[0], stand.foot[0]


def _floor_heights(ground: ArrayLike, frames: int) -> Array:
    """Return heights [T, 2] [m] of the floor under both feet."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(ground, np.float64), (frames, 2)))


@dataclass(frozen=True, kw_only=True, eq=False)
class ClipTable:
    """Table of the frames of all clips of a body, from which frames of different clips are read in one operation."""

    legs: Legs
    first: NDArray[np.int64]
    """Row of each clip's first frame, shape [C]."""
    frames: NDArray[np.int64]
    """Number of frames of each clip, shape [C]."""
    quats: Array
    """Rotations of the joints in each frame as quaternions xyzw, shape [sum of frames, 55, 4]."""
    pelvis: Array
    """Position of the pelvis in each frame relative to the root, shape [sum of frames, 3] [m]."""
    ankle: Array
    """Position of each ankle in each frame, in the body frame, shape [sum of frames, 2, 3] [m]."""
    foot: Array
    """Pitch, yaw and toe bend of each foot in each frame, shape [sum of frames, 2, 3] [deg]."""

    @cached_property
    def arrays(self) -> ClipArrays:
        """Arrays for the kernels in `h3data.bodies.people.kernels.clips`."""
        from h3data.bodies.people.kernels.clips import ClipArrays

        return ClipArrays(
            legs=self.legs.measures,
            first=self.first,
            frames=self.frames,
            quats=self.quats,
            pelvis=self.pelvis,
            ankle=self.ankle,
            foot=self.foot,
            stand=_standing_arrays(self.legs),
            to_root=TO_ROOT,
        )


def clip_table(clips: Sequence[Clip], legs: Legs) -> ClipTable:
    """Concatenate clips into one table; the first clip must be the standing pose."""
    frames = np.array([len(c) for c in clips])
    return ClipTable(
        legs=legs,
        first=np.concatenate([[0], np.cumsum(frames)[:-1]]),
        frames=frames,
        quats=np.concatenate([c.quats for c in clips]),
        pelvis=np.concatenate([c.pelvis for c in clips]),
        ankle=np.concatenate([c.ankle for c in clips]),
        foot=np.concatenate([c.foot for c in clips]),
    )


def sample_clips(
    table: ClipTable, motion_id: ArrayLike, phase: ArrayLike, blend: ArrayLike, ground: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Return local rotations [T, 55, 4] and pelvis positions [T, 3] [m] of clips in the agent root frame.

    ``motion_id`` [T] selects clips. ``phase`` [T] is the position in the cycle; only its fraction counts. ``blend`` [T]
    interpolates from the standing pose (0) to the clip (1), by steps instead of sliding feet (see
    `h3data.bodies.people.kernels.legs.settle`). ``ground`` [T, 2] is the height of the floor under the left and the
    right foot [m], relative to the root. Frames are interpolated, so the motion is continuous.
    """
    from h3data.bodies.people.kernels.clips import sample_all

    motion = np.array(motion_id, np.int64, ndmin=1)
    phase, blend = np.array(phase, np.float64, ndmin=1), np.array(blend, np.float64, ndmin=1)
    # mostly they are equal, and `broadcast_arrays` costs more than posing one person
    if not len(motion) == len(phase) == len(blend):
        motion, phase, blend = (np.ascontiguousarray(a) for a in np.broadcast_arrays(motion, phase, blend))
    low, high = (motion[0], motion[0]) if len(motion) == 1 else (motion.min(initial=0), motion.max(initial=0))
    if low < 0 or high >= len(table.frames):
        raise InputError(f"Expected motion ids 0..{len(table.frames) - 1}, got {low}..{high}.", code="H3-BODY-069")
    quats, pelvis = np.empty((len(motion), 55, 4)), np.empty((len(motion), 3))
    floor = _FLAT if ground is None else _floor_heights(ground, len(motion))
    sample_all(table.arrays, motion, phase, blend, floor, quats, pelvis)
    return quats, pelvis


def nearest_clip(clips: Sequence[Clip], speed_mps: float) -> int:
    """Return the index of the clip whose speed is nearest in ratio; below `STAND_BELOW_MPS`, of a standing clip."""
    return _nearest_speed(tuple([c.speed_mps for c in clips]), abs(float(speed_mps)))


@lru_cache(maxsize=256)
def _nearest_speed(clip_speeds: tuple[float, ...], speed: float) -> int:
    """Return the same as `nearest_clip`, cached: a walker asks for it in every step."""
    speeds = np.array(clip_speeds)
    if speed < STAND_BELOW_MPS or not np.any(speeds > 0):
        return int(np.argmin(speeds))
    # a standing clip, at speed 0, is very far away in ratio
    return int(np.argmin(np.abs(np.log(np.where(speeds > 0, speeds, 1e-9) / speed))))
