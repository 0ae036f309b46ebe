"""Motion of a person as frames of poses, from any source; `h3data.bodies.Clip` has cycles for walking."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.skeleton import JOINT_COUNT
from h3data.errors import FormatError, InputError
from h3data.geometry import (
    Array,
    normalized,
    quat_conjugate,
    quat_from_heading,
    quat_multiply,
    quat_rotate,
    quat_sign_continuous,
)

UNIT_WITHIN = 1e-3
"""Tolerance to which quaternions of records have unit length; readers normalise what files round."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Poses of the 55-joint skeleton over time, in the start frame (x forward, y up, z right).

    The origin is below the pelvis of the first frame, which faces along x. Heights are as recorded, and the height of
    the floor is found when the motion is fitted to a body (`h3data_motion.retarget.retarget`).

    Raises:
        FormatError: shapes do not fit, a number is not finite, or a rotation is not a unit quaternion.
    """

    name: str
    fps: float
    """Number of frames per second."""
    quats: Array
    """Local joint rotations xyzw in SMPL-X order, shape [T, 55, 4], sign-continuous. The pelvis rotation is relative to
    the start frame (its own axes are +Z forward, +Y up, +X left)."""
    pelvis: Array
    """Position of the pelvis joint in the start frame, shape [T, 3] [m]."""
    leg_m: float | None = None
    """Length of thigh plus shank of the person who performed the motion [m]; None if the file does not state it."""
    body: str = ""
    """Body to which the motion was fitted; empty for motion as recorded."""
    source: str = ""
    """Origin and licence of the motion."""

    def __post_init__(self) -> None:
        faults = _faults(self)
        if faults:
            raise FormatError(f"Motion {self.name!r}: {'; '.join(faults)}.", code="H3-BODY-039")

    def __len__(self) -> int:
        return len(self.quats)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last frame [s]."""
        return (len(self) - 1) / self.fps

    @property
    def path_m(self) -> float:
        """Length of the pelvis' path along the floor, without jitter shorter than 0.1 s [m]."""
        step = max(1, round(0.1 * self.fps))
        return float(np.linalg.norm(np.diff(self.pelvis[::step, ::2], axis=0), axis=1).sum())

    def pose(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Return local rotations [N, 55, 4] and pelvis positions [N, 3] [m] at times [N] [s].

        Before and after the motion, its first and last pose are returned.

        Between frames rotations are blended along the shorter arc.
        """
        place = np.clip(np.atleast_1d(np.asarray(time_s, np.float64)) * self.fps, 0, len(self) - 1)
        if not np.isfinite(place).all():
            raise InputError("Expected finite times [s], got NaN.", code="H3-BODY-040")
        nearest = np.rint(place)
        place = np.where(np.abs(place - nearest) < 1e-9 * len(self), nearest, place)
        lower = np.minimum(place.astype(np.intp), max(len(self) - 2, 0))
        upper = np.minimum(lower + 1, len(self) - 1)
        share = place - lower
        mixed = self.quats[lower] + share[:, None, None] * (self.quats[upper] - self.quats[lower])
        return normalized(mixed), self.pelvis[lower] + share[:, None] * (self.pelvis[upper] - self.pelvis[lower])

    def resampled(self, fps: float) -> Motion:
        """Return the motion with a different number of frames per second."""
        if not 0 < fps < 1e4:
            raise InputError(f"Expected frames per second above 0 and below 10000, got {fps}.", code="H3-BODY-041")
        quats, pelvis = self.pose(np.arange(int(self.duration_s * fps + 1e-6) + 1) / fps)
        return replace(self, fps=float(fps), quats=quats, pelvis=pelvis)

    def part(self, start_s: float, end_s: float) -> Motion:
        """Return the motion from ``start_s`` to ``end_s`` [s], in its own start frame."""
        first, last = (round(float(np.clip(t, 0, self.duration_s)) * self.fps) for t in (start_s, end_s))
        if last <= first:
            raise InputError(
                f"Expected a start before the end within 0..{self.duration_s:.2f} s, got {start_s}..{end_s}.",
                code="H3-BODY-042",
            )
        return in_start_frame(replace(self, quats=self.quats[first : last + 1], pelvis=self.pelvis[first : last + 1]))

    def __repr__(self) -> str:
        fitted = f", fitted to {self.body}" if self.body else ""
        return f"Motion({self.name!r}, {len(self)} frames at {self.fps:g}/s, way {self.path_m:.2f} m{fitted})"


def _faults(motion: Motion) -> list[str]:
    quats, pelvis = motion.quats, motion.pelvis
    faults = []
    if not 0 < motion.fps < 1e4:
        faults.append(f"fps: expected frames per second above 0 and below 10000, got {motion.fps}")
    if quats.ndim != 3 or quats.shape[1:] != (JOINT_COUNT, 4) or not len(quats):
        faults.append(f"quats: expected [T, {JOINT_COUNT}, 4] with at least one frame, got {list(quats.shape)}")
    elif not np.isfinite(quats).all():
        faults.append("quats: expected finite numbers, got NaN or infinity")
    elif (error := np.abs(np.linalg.norm(quats, axis=-1) - 1).max()) > UNIT_WITHIN:
        faults.append(f"quats: expected unit quaternions, one is off by {error:.3g}")
    if pelvis.shape != (len(quats), 3):
        faults.append(f"pelvis: expected [{len(quats)}, 3], got {list(pelvis.shape)}")
    elif not np.isfinite(pelvis).all():
        faults.append("pelvis: expected finite numbers, got NaN or infinity")
    if motion.leg_m is not None and not 0.1 < motion.leg_m < 10:
        faults.append(f"leg_m: expected the length of a leg in metres, got {motion.leg_m}")
    return faults


def in_start_frame(motion: Motion) -> Motion:
    """Return a motion moved along the floor into its start frame, with sign-continuous rotations."""
    heading = float(pelvis_heading(motion.quats[:1, 0])[0])
    turn = quat_from_heading(-heading)
    origin = motion.pelvis[0] * (1, 0, 1)
    quats = motion.quats.copy()
    quats[:, 0] = quat_multiply(turn, quats[:, 0])
    return replace(motion, quats=quat_sign_continuous(quats), pelvis=quat_rotate(turn, motion.pelvis - origin))


def pelvis_heading(quats: Array) -> Array:
    """Return headings [T] [rad] of pelvis frames [T, 4] (+Z forward), or those of the head for a person who lies flat."""
    front = quat_rotate(quats, np.array([0.0, 0, 1]))
    head = quat_rotate(quats, np.array([0.0, 1, 0]))
    lying = np.hypot(front[:, 0], front[:, 2]) < 0.2
    aim = np.where(lying[:, None], -np.sign(front[:, 1:2]) * head, front)
    return np.arctan2(-aim[:, 2], aim[:, 0])


def turned_frames(turn: Array, quats: Array, pelvis: Array) -> tuple[Array, Array]:
    """Return pelvis rotations [T, 4] and positions [T, 3] in a world that is rotated by the quaternion ``turn`` [4]."""
    out = np.array(quats, np.float64)
    out[:, 0] = quat_multiply(turn, out[:, 0])
    return out, quat_rotate(turn, pelvis)


def same_motion(a: Motion, b: Motion) -> tuple[float, float]:
    """Return the largest differences of two motions of equal length in rotations [rad] and pelvis positions [m]."""
    between = quat_multiply(quat_conjugate(a.quats), b.quats)
    angle = 2 * np.arctan2(np.linalg.norm(between[..., :3], axis=-1), np.abs(between[..., 3]))
    return float(angle.max()), float(np.abs(a.pelvis - b.pelvis).max())
