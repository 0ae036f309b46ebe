"""Motion clips: cycles that are played by the distance walked, not by the clock, so that planted feet stay put."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import Array, normalized, quat_nlerp

STAND_BELOW_MPS = 0.15
"""Slower than this nobody steps: the standing clip plays."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Clip:
    """One cycle of a motion, in the agent root frame (x forward, y up, z right)."""

    name: str
    speed_mps: float
    """Speed at which it was made; 0 = standing."""
    stride_m: float
    """Way per cycle (two steps): the phase advances by distance / stride. 1 for clips that stand."""
    period_s: float
    """Duration of a cycle at ``speed_mps``."""
    stance: float
    """Share of the cycle that one foot spends on the floor, from its heel strike on (left 0, right 0.5)."""
    quats: Array
    """Local joint rotations xyzw, shape [F, 55, 4]; frame k is at phase k / F; the signs are continuous round the cycle."""
    pelvis: Array
    """Pelvis joint relative to the root, shape [F, 3] [m]."""

    def __len__(self) -> int:
        return len(self.quats)

    def __repr__(self) -> str:
        return f"Clip({self.name!r}, {self.speed_mps} m/s, stride {self.stride_m:.3f} m, {len(self)} frames)"


@dataclass(frozen=True, kw_only=True, eq=False)
class ClipTable:
    """All clips of a body in one array, so that frames of different clips are read by one gather."""

    first: NDArray[np.int64]
    """Row of each clip's first frame."""
    frames: NDArray[np.int64]
    """Number of frames of each clip."""
    quats: Array
    """Shape [sum of frames, 55, 4]."""
    pelvis: Array
    """Shape [sum of frames, 3]."""


def clip_table(clips: Sequence[Clip]) -> ClipTable:
    """The clips, one below the other; the first one must be the standing pose."""
    frames = np.array([len(c) for c in clips])
    return ClipTable(
        first=np.concatenate([[0], np.cumsum(frames)[:-1]]),
        frames=frames,
        quats=np.concatenate([c.quats for c in clips]),
        pelvis=np.concatenate([c.pelvis for c in clips]),
    )


def sample_clips(table: ClipTable, motion_id: ArrayLike, phase: ArrayLike, blend: ArrayLike) -> tuple[Array, Array]:
    """Local rotations [T, 55, 4] and pelvis places [T, 3] in the agent root frame.

    ``motion_id`` [T] picks clips, ``phase`` [T] is the place in the cycle (any real number, its fraction counts) and
    ``blend`` [T] mixes from the standing pose (0) to the clip (1). Frames are interpolated: the motion is continuous.
    """
    motion, phase, blend = np.broadcast_arrays(
        np.atleast_1d(motion_id), np.atleast_1d(np.asarray(phase, np.float64)), np.atleast_1d(blend)
    )
    if motion.size and (motion.min() < 0 or motion.max() >= len(table.frames)):
        raise InputError(f"Expected motion ids 0..{len(table.frames) - 1}, got {motion.min()}..{motion.max()}.")
    place = (phase - np.floor(phase)) * table.frames[motion]
    lower = np.floor(place)
    weight = place - lower
    index = lower.astype(np.int64) % table.frames[motion]
    upper = table.first[motion] + (index + 1) % table.frames[motion]
    index = table.first[motion] + index
    # neighbouring frames share a hemisphere (checked at bake), so a plain mix and one normalisation are enough
    mixed = table.quats[index] + weight[:, None, None] * (table.quats[upper] - table.quats[index])
    pelvis = table.pelvis[index] + weight[:, None] * (table.pelvis[upper] - table.pelvis[index])
    if np.any(blend < 1):
        mixed = quat_nlerp(table.quats[0], mixed, np.broadcast_to(blend[:, None], mixed.shape[:-1]))
        pelvis = table.pelvis[0] + blend[:, None] * (pelvis - table.pelvis[0])
        return mixed, pelvis
    return normalized(mixed), pelvis


def nearest_clip(clips: Sequence[Clip], speed_mps: float) -> int:
    """Index of the clip whose speed is nearest in ratio; a standing clip below `STAND_BELOW_MPS`."""
    speeds = np.array([c.speed_mps for c in clips])
    speed = abs(speed_mps)
    if speed < STAND_BELOW_MPS or not np.any(speeds > 0):
        return int(np.argmin(speeds))
    ratio = np.abs(np.log(np.where(speeds > 0, speeds, 1e-9) / speed))
    return int(np.argmin(ratio))
