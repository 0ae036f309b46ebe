"""Selection of the few seconds of a capture that become a gait.

`h3data.bodies.names` finds it by the entry-point group ``h3data.walks``.
"""

from __future__ import annotations

import io
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.humanoid_file import load_humanoid
from h3data.bodies.people.soles import runs
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE
from h3data_motion.clip import Motion
from h3data_motion.cycle import find_loop
from h3data_motion.files import load_motion, motion_bytes, read_motion
from h3data_motion.gait import walks_as
from h3data_motion.retarget import retarget

LEAST_FPS, KEPT_FPS = 20.0, 60.0
"""Least frame rate, which leaves four frames for a swinging foot, and largest frame rate that is stored."""
CUT_M, CUT_MPS2 = 0.02, 25.0
"""Limits above which joints count as jumping: mean change of position per frame [m], and an acceleration [m/s^2]."""
PACE_S, WALKS_SHARE, LEAST_MPS = 0.6, 0.7, 0.3
"""Time over which speeds are measured [s], share of the fastest speed above which a person walks, and smallest accepted
fastest speed [m/s]."""
CYCLE_S, MARGIN_S = (0.6, 2.2), 0.4
"""Range of the duration of a cycle of two steps, and duration of the parts before and after it that are stored [s]."""
GAP_SHARE = 0.75
"""Largest difference between the end and the start of a cycle, as a share of the poses' deviation from their mean;
opposite poses have 1.3."""


def walking(body: Humanoid, data: bytes, *, name: str) -> Humanoid:
    """Return a body called ``name`` with the gait in the contents of a motion file."""
    return walks_as(body, load_motion(io.BytesIO(data)), name=name)


def facts(data: bytes) -> dict[str, str]:
    """Return the facts about a gait that recordings store, from the contents of its file."""
    motion = load_motion(io.BytesIO(data))
    return {"name": motion.name, "source": motion.source}


@lru_cache(maxsize=16)
def walk_file(path: str) -> bytes:
    """Return the contents of a file with the walk that a motion file contains.

    Raises:
        InputError: there is no such file, or it contains no walk.
        FormatError: the file is not a motion file.
    """
    if not Path(path).is_file():
        raise InputError(f"Expected a motion file (.npz, .pkl, .bvh), there is none there: {path}", code="H3-BODY-061")
    return motion_bytes(walk_of(read_motion(path)))


def walk_of(motion: Motion) -> Motion:
    """Return the part of a motion that becomes a gait: its best cycle, with short parts before and after it.

    Raises:
        InputError: the motion has too few frames per second, or no uncut walk of at least one cycle.
    """
    if motion.fps < LEAST_FPS:
        raise InputError(
            f"Motion {motion.name!r}: expected at least {LEAST_FPS:g} frames per second, got {motion.fps:g}: a swinging foot "
            "has too few.",
            code="H3-BODY-062",
        )
    if motion.duration_s < CYCLE_S[0] + 0.1:
        raise InputError(
            f"Motion {motion.name!r} lasts {motion.duration_s:.2f} s; a cycle of two steps needs {CYCLE_S[0] + 0.1:.1f} s.",
            code="H3-BODY-063",
        )
    if motion.fps > KEPT_FPS:
        motion = motion.resampled(KEPT_FPS)
    body = load_humanoid("neutral_0")
    part = _longest_walk(_uncut(replace(motion, body=""), body))
    fitted = retarget(part, body)
    loop = find_loop(fitted, body, min_s=CYCLE_S[0], max_s=CYCLE_S[1])
    if loop.gap_m > GAP_SHARE * loop.spread_m:
        raise InputError(
            f"Motion {motion.name!r}: expected steps that repeat, the best cycle ends {100 * loop.gap_m:.0f} cm from where it "
            f"starts. Hint: take a part with some steps straight ahead.",
            code="H3-BODY-064",
        )
    kept = part.part(max(loop.start_s - MARGIN_S, 0.0), loop.end_s + MARGIN_S)
    walks_as(body, kept)  # refuses what cannot be played
    return kept


def _walked(motion: Motion) -> Motion:
    """Return the longest part of a motion in which the person walks steadily."""
    count = max(2, round(PACE_S * motion.fps))
    pace = np.linalg.norm(motion.pelvis[count:, ::2] - motion.pelvis[:-count, ::2], axis=1) * motion.fps / count
    fastest = float(np.percentile(pace, 95))
    if fastest < LEAST_MPS:
        raise InputError(
            f"Motion {motion.name!r}: expected somebody who walks, this one gets on by {fastest:.2f} m/s at most. Hint: is the "
            "unit of the file right (--unit-m of h3data motion import)?",
            code="H3-BODY-065",
        )
    start, end = max(runs(pace > WALKS_SHARE * fastest), key=lambda run: run[1] - run[0])
    return motion.part(start / motion.fps, (end - 1 + count) / motion.fps)


def _uncut(motion: Motion, body: Humanoid) -> list[Motion]:
    """Return the parts of a motion between its jump cuts that are long enough for a cycle."""
    at = np.tile(IDENTITY_POSE, (len(motion), 1))
    places = body.joint_matrices(at, motion.quats, motion.pelvis)[:, :22, :3, 3]
    jumps = np.linalg.norm(np.diff(places, n=2, axis=0), axis=-1).mean(axis=1)
    whole = np.ones(len(motion), bool)
    whole[1:-1] = jumps < CUT_M + CUT_MPS2 / motion.fps**2
    least = (CYCLE_S[0] + 0.1) * motion.fps
    kept = [(start, end) for start, end in runs(whole) if end - start >= least]
    if not kept:
        raise InputError(
            f"Motion {motion.name!r}: expected {CYCLE_S[0] + 0.1:.1f} s without a jump, there are none. Hint: is it cut "
            "together, or are joints missing in some frames?",
            code="H3-BODY-066",
        )
    return [motion.part(start / motion.fps, (end - 1) / motion.fps) for start, end in kept]


def _longest_walk(parts: list[Motion]) -> Motion:
    """Return the longest walk in any of the parts."""
    walks, faults = [], []
    for part in parts:
        try:
            walks.append(_walked(part))
        except InputError as fault:
            faults.append(fault)
    if not walks:
        raise faults[0]
    return max(walks, key=lambda walk: walk.duration_s)
