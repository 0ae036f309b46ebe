"""Synthesises a walk for people of whom only the path is known: clips played by distance and by turn."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.bodies.people.clips import STAND_BELOW_MPS
from h3data.geometry import Array, heading_from_quat, wrap_angle

WINDOW_S = 0.5
"""Speeds are means over this time."""
TURN_ABOVE_RAD_S = 0.4
JUMP_MPS = 8.0
"""Faster than anybody walks: such a step is a jump to another place."""
BLEND_S = 0.25
"""Transition from standing to the clip and back."""


def walk_columns(body: Humanoid, base_pose: Array, time_ns: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """``motion_id``, ``motion_phase`` and ``motion_blend`` [T] of a person whose agent root follows ``base_pose`` [T, 7].

    The path is cut into spans of standing, walking and turning on the spot. Each span plays one clip: the one of its
    typical speed, by distance (backwards if they walk backwards), or the one of the side, by angle.
    """
    steps = len(base_pose)
    motion, phase, blend = np.zeros(steps, np.int32), np.zeros(steps), np.zeros(steps)
    time = np.asarray(time_ns, np.float64) * 1e-9
    way, turn = _changes(base_pose, time)
    speed, rate = _rate(np.abs(way), time), _rate(turn, time)
    doing = np.where(speed > STAND_BELOW_MPS, 1, np.where(np.abs(rate) > TURN_ABOVE_RAD_S, 2 + (rate < 0), 0))
    edges = np.flatnonzero(np.diff(doing, prepend=-1, append=-1))
    for start, end in pairwise(edges.tolist()):
        what = int(doing[start])
        if what == 0:
            continue
        rows = slice(start, end)
        if what == 1:
            walked = speed[rows][way[rows] != 0]
            usual = float(np.median(walked)) if len(walked) else 0.0
            clip = body.clip_for_speed(max(usual, 2 * STAND_BELOW_MPS))
            cycles = np.cumsum(way[rows]) / body.clips[clip].stride_m
        else:
            clip = body.motion_names.index("turn_left" if what == 2 else "turn_right")
            cycles = np.cumsum(turn[rows]) / body.clips[clip].turn_rad
        motion[rows] = clip
        phase[rows] = body.clips[clip].start_phase + cycles
        blend[rows] = _ramps(time[rows], opens=start > 0, closes=end < steps)
    return {
        "motion_id": motion,
        "motion_phase": (phase % 1.0).astype(np.float32) % np.float32(1),
        "motion_blend": blend.astype(np.float32),
    }


def _changes(base_pose: Array, time: Array) -> tuple[Array, Array]:
    """Distance since the step before [T] [m], negative backwards, and turn to the left [T] [rad]; 0 at jumps and gaps."""
    way, turn = np.zeros(len(base_pose)), np.zeros(len(base_pose))
    if len(base_pose) < 2:
        return way, turn
    heading = heading_from_quat(base_pose[:, 3:])
    step = np.diff(base_pose[:, [0, 2]], axis=0)
    distance = np.hypot(step[:, 0], step[:, 1])
    ahead = step[:, 0] * np.cos(heading[1:]) - step[:, 1] * np.sin(heading[1:])
    walked = np.isfinite(distance) & (distance <= JUMP_MPS * np.maximum(np.diff(time), 1 / 120))
    way[1:] = np.where(walked, np.where(ahead < 0, -distance, distance), 0.0)
    turn[1:] = np.where(walked, wrap_angle(np.diff(heading)), 0.0)
    return way, turn


def _rate(change: Array, time: Array) -> Array:
    """Mean change per second [T] over the window around each step."""
    if len(time) < 2:
        return np.zeros(len(time))
    total = np.cumsum(change)
    late, early = (np.clip(time + s * WINDOW_S / 2, time[0], time[-1]) for s in (1, -1))
    return (np.interp(late, time, total) - np.interp(early, time, total)) / np.maximum(late - early, 1e-3)


def _ramps(time: Array, *, opens: bool, closes: bool) -> Array:
    ramp = np.ones(len(time))
    if opens:
        ramp = np.minimum(ramp, (time - time[0]) / BLEND_S)
    if closes:
        ramp = np.minimum(ramp, (time[-1] - time) / BLEND_S)
    return ramp
