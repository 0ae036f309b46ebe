"""Extraction of cyclic clips from a free motion: the best loop is found, straightened and closed, and feet are planted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.clips import CLIP_FRAMES, Clip
from h3data.bodies.people.gait import STAND_ANKLE_Z_M
from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.soles import ANKLE, LEG_JOINTS, TOE, runs, sole_points
from h3data.errors import InputError
from h3data.geometry import (
    IDENTITY_POSE,
    Array,
    normalized,
    quat_conjugate,
    quat_from_heading,
    quat_multiply,
    quat_nlerp,
    quat_rotate,
    quat_sign_continuous,
    wrap_angle,
)
from h3data_motion.clip import Motion, pelvis_heading
from h3data_motion.contacts import find_contacts, leg_frames, planted
from h3data_motion.retarget import retarget

COMPARED = 22
"""Number of joints that are compared: all except fingers and face."""
VELOCITY_S = 0.15
"""Weight of a velocity difference when poses are compared [s]: 1 m/s counts as this many metres."""
SEARCH_FPS = 60.0
ALIKE = 0.1
"""Share of the variation of poses by which a shorter loop may close worse than the best one, so that one cycle is
preferred to two."""
WALKS_M, TURNS_RAD = 0.15, np.radians(20.0)
"""Distance per cycle above which a clip is played by distance [m], and turn per cycle above which it is played by turn
[rad]."""


@dataclass(frozen=True, kw_only=True)
class Loop:
    """Part of a motion whose end fits its start."""

    start_s: float
    end_s: float
    gap_m: float
    """Root mean square distance of the joints at the seam, including velocities with a weight of 0.15 s [m]."""
    spread_m: float = 0.0
    """Mean distance from all poses to their mean [m]."""


def find_loop(motion: Motion, body: Humanoid, *, min_s: float = 0.5, max_s: float = 2.5) -> Loop:
    """Find the best loop of a motion with a duration from ``min_s`` to ``max_s`` [s].

    At the two ends of a loop, all joints have nearly the same positions and velocities relative to the pelvis.

    Raises:
        InputError: the motion is shorter than ``min_s``.
    """
    if not 0 < min_s < max_s:
        raise InputError(f"Expected 0 < min_s < max_s, got {min_s} and {max_s}.", code="H3-BODY-043")
    if motion.duration_s < min_s:
        raise InputError(
            f"Motion {motion.name!r} lasts {motion.duration_s:.2f} s; a cycle needs at least {min_s} s.",
            code="H3-BODY-044",
        )
    searched = motion if motion.fps <= SEARCH_FPS else motion.resampled(SEARCH_FPS)
    features = _features(searched, body)
    first, last = max(2, round(min_s * searched.fps)), min(round(max_s * searched.fps), len(searched) - 1)
    found = []
    for lag in range(first, max(last, first) + 1):
        apart = np.mean(np.sum((features[lag:] - features[:-lag]) ** 2, axis=-1), axis=-1)
        if len(apart):
            found.append((float(apart.min()), int(np.argmin(apart)), lag))
    best = min(gap for gap, _, _ in found)
    differ = np.sqrt(np.mean(np.sum((features - features.mean(axis=0)) ** 2, axis=-1)))
    shortest = min(lag for gap, _, lag in found if np.sqrt(gap) <= np.sqrt(best) + ALIKE * differ)
    gap, start, lag = min(entry for entry in found if shortest <= entry[2] <= 1.15 * shortest)
    return Loop(
        start_s=start / searched.fps,
        end_s=(start + lag) / searched.fps,
        gap_m=float(np.sqrt(gap)),
        spread_m=float(differ),
    )


def _features(motion: Motion, body: Humanoid) -> Array:
    """Return the joint places and velocities seen from the pelvis' place and heading, shape [T, 22, 6]."""
    at_origin = np.tile(IDENTITY_POSE, (len(motion), 1))
    frames = body.joint_matrices(at_origin, motion.quats, motion.pelvis)[:, :COMPARED, :3, 3]
    back = quat_from_heading(-pelvis_heading(motion.quats[:, 0]))[:, None]
    velocity = np.gradient(frames, axis=0) * motion.fps
    places = quat_rotate(back, frames - motion.pelvis[:, None] * (1, 0, 1))
    return np.concatenate([places, VELOCITY_S * quat_rotate(back, velocity)], axis=-1)


def trim_to_cycle(motion: Motion, body: Humanoid, *, min_s: float = 0.5, max_s: float = 2.5) -> Clip:
    """Return one cycle of a motion as a seamless clip that ``body`` can play.

    The best loop (`find_loop`) is straightened by removing its net turn evenly. The remaining difference between its
    ends is distributed over the cycle, and feet are planted around the seam. A cycle that travels is played by
    distance: it moves along x of the root, phase 0 is the strike of the left foot, and ``stride_m`` is the distance per
    cycle. A cycle that turns on the spot is played by the turn (``turn_rad``), and any other by time (``period_s``).

    Raises:
        InputError: the motion is too short.
    """
    fitted = retarget(motion, body)
    loop = find_loop(fitted, body, min_s=min_s, max_s=max_s)
    period = loop.end_s - loop.start_s
    share = np.arange(CLIP_FRAMES + 1) / CLIP_FRAMES
    quats, pelvis = fitted.pose(loop.start_s + period * share)
    turn = float(wrap_angle(np.diff(pelvis_heading(quats[[0, -1], 0]))[0]))
    quats, pelvis, stride = _straightened(quats, pelvis, turn, share)
    walks = stride > WALKS_M
    quats, pelvis = _closed(quats, pelvis, share)
    turns = abs(turn) > TURNS_RAD and not walks
    advance = stride if walks else 0.0
    quats, pelvis, touching = _planted_round(body, quats, pelvis, advance, turn if turns else 0.0, CLIP_FRAMES / period)
    strikes = [start for start, _ in runs(_unrolled(touching[:, 0])) if 0 < start <= CLIP_FRAMES]
    roll = strikes[0] % CLIP_FRAMES if strikes and walks else 0
    return _as_clip(
        body,
        Clip(
            name=motion.name,
            speed_mps=advance / period,
            stride_m=stride if walks else 1.0,
            period_s=period,
            stance=float(touching[:, 0].mean()),
            turn_rad=turn if turns else 0.0,
            quats=quat_sign_continuous(np.roll(quats, -roll, axis=0)),
            pelvis=np.roll(pelvis, -roll, axis=0),
            ankle=np.zeros((CLIP_FRAMES, 2, 3)),
            foot=np.zeros((CLIP_FRAMES, 2, 3)),
        ),
    )


def _straightened(quats: Array, pelvis: Array, turn: float, share: Array) -> tuple[Array, Array, float]:
    """Return rotations [F + 1, 55, 4] and places [F + 1, 3] without net ``turn`` [rad] and travel, and stride [m]."""
    back = quat_from_heading(-turn * share)
    quats = quats.copy()
    quats[:, 0] = quat_multiply(back, quats[:, 0])
    middle = quat_from_heading(-turn * (share[1:] + share[:-1]) / 2)
    steps = quat_rotate(middle, np.diff(pelvis, axis=0))
    pelvis = np.concatenate([pelvis[:1] * (0, 1, 0), steps]).cumsum(axis=0)
    stride = float(np.hypot(pelvis[-1, 0], pelvis[-1, 2]))
    heading = np.arctan2(-pelvis[-1, 2], pelvis[-1, 0]) if stride > WALKS_M else pelvis_heading(quats[:1, 0])[0]
    aim = quat_from_heading(-heading)
    quats[:, 0] = quat_multiply(aim, quats[:, 0])
    return quats, quat_rotate(aim, pelvis), stride


def _closed(quats: Array, pelvis: Array, share: Array) -> tuple[Array, Array]:
    """Return [F, 55, 4] and [F, 3] relative to a root that travels evenly; frame F would be frame 0 again."""
    rest = quat_multiply(quat_conjugate(quats[-1]), quats[0])
    identity = np.broadcast_to([0.0, 0, 0, 1], rest.shape)
    spread = quat_nlerp(identity, rest, np.broadcast_to(share[:, None], (len(share), quats.shape[1])))
    closed = normalized(quat_multiply(quats, spread))
    pelvis = pelvis - share[:, None] * (pelvis[-1] - pelvis[0])
    pelvis = pelvis - (pelvis[:-1].mean(axis=0) - pelvis[0]) * (0, 0, 1)
    return closed[:-1], pelvis[:-1]


def _planted_round(
    body: Humanoid, quats: Array, pelvis: Array, advance: float, turn: float, fps: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the cycle with planted feet, and where they touch [F, 2]: the middle one of three rounds."""
    count = len(quats)
    rounds = np.arange(3 * count) / count
    long_quats, long_pelvis = np.tile(quats, (3, 1, 1)), np.tile(pelvis, (3, 1))
    heading = quat_from_heading(turn * rounds)
    long_quats[:, 0] = quat_multiply(heading, long_quats[:, 0])
    long_pelvis = quat_rotate(heading, long_pelvis)
    long_pelvis[:, 0] += advance * rounds
    long_quats, long_pelvis = planted(body, long_quats, long_pelvis, fps)
    touching = find_contacts(sole_points(body, leg_frames(body, long_quats, long_pelvis)), fps).touching
    middle = slice(count, 2 * count)
    back = quat_conjugate(heading[middle])
    out, places = long_quats[middle].copy(), long_pelvis[middle].copy()
    places[:, 0] -= advance * rounds[middle]
    out[:, 0] = quat_multiply(back, out[:, 0])
    return out, quat_rotate(back, places), touching[middle]


def _unrolled(touching: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cycle twice, so that a stance across the seam is one run."""
    return np.concatenate([touching, touching])


def _as_clip(body: Humanoid, clip: Clip) -> Clip:
    """Return the clip with its feet as `h3data.bodies.people.legs.Posture` has them, and with the phase to set off at."""
    frames = leg_frames(body, clip.quats, clip.pelvis)
    ankle, foot = np.empty((len(clip), 2, 3)), np.empty((len(clip), 2, 3))
    for k in range(2):
        frame = frames[:, k, ANKLE]
        x, y, z = frame[:, :3, 3].T
        ankle[:, k] = np.stack([-z, y, x], axis=1)  # root frame to body frame
        toes = frame[:, :3, 2]
        bend = clip.quats[:, LEG_JOINTS[k, TOE]]
        foot[:, k] = np.degrees(
            np.stack(
                [
                    np.arcsin(np.clip(toes[:, 1], -1, 1)),
                    np.arctan2(-toes[:, 2], toes[:, 0]),
                    -2 * np.arctan2(bend[:, 0], bend[:, 3]),
                ],
                axis=1,
            )
        )
    stance = max(1, round(clip.stance * len(clip)))
    start = int(np.argmin(np.abs(ankle[:stance, 0, 2] - STAND_ANKLE_Z_M))) / len(clip) if clip.speed_mps > 0 else 0.0
    return replace(clip, ankle=ankle, foot=foot, start_phase=start)
