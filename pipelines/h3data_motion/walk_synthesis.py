"""Synthesis of people for recordings with little data: a gait from a path of roots, or a body that fits postures.

A walk consists of clips that are played by distance and by turn.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, load_humanoid
from h3data.bodies.people.clips import STAND_BELOW_MPS
from h3data.bodies.people.humanoid_file import ADULTS
from h3data.bodies.people.skeleton import HUMAN_ROOT_HEIGHT_M, JOINT_INDEX
from h3data.geometry import Array, heading_from_quat, wrap_angle

SYNTHETIC_BODY = "neutral_0"
"""Body for people of whom only the root pose is known."""
SAME_FLOOR_M = 0.15
"""Height difference from the robot's floor below which people are on the same floor [m]."""
WINDOW_S = 0.5
"""Time over which speeds are averaged [s]."""
TURN_ABOVE_RAD_S = 0.4
JUMP_MPS = 8.0
"""Speed above which a step counts as a jump to another place, faster than any person walks [m/s]."""
BLEND_S = 0.25
"""Duration of the transition from standing to the clip and back [s]."""


def walk_columns(body: Humanoid, base_pose: Array, time_ns: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Return the walking motion of a person whose agent root follows ``base_pose`` [T, 7].

    The columns are ``motion_id``, ``motion_phase`` and ``motion_blend`` [T].

    The path is cut into spans of standing, walking and turning on the spot. Each span plays one clip. For walking it is
    the clip of the typical speed, played by distance (backwards if the person walks backwards). For turning it is the
    clip of the side, played by angle.
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
    """Return the distance since the step before [T] [m] and the turn to the left [T] [rad].

    Backward distances are negative; both are 0 at jumps and gaps.
    """
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
    """Return the mean change per second [T] over the window around each step."""
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


def fitting_body(roots: Array, joints: Array, floor: Array) -> str:
    """Return the built-in body whose standing foot height fits the lower foot of the recorded joints best (median)."""
    rows = np.flatnonzero(np.isfinite(roots).all(1) & np.isfinite(joints).all((1, 2)) & np.isfinite(floor))
    rows = rows[:: max(1, len(rows) // 32)]
    if not len(rows):
        return SYNTHETIC_BODY
    feet = [JOINT_INDEX["left_foot"], JOINT_INDEX["right_foot"]]

    def gap(name: str) -> float:
        body = load_humanoid(name)
        standing = body.joint_matrices_free(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), np.tile([0, 0, 0, 1.0], (1, 54, 1)))
        rest = body.joint_offsets[0, 1] + standing[0, feet, 1, 3].min()
        low = body.joint_matrices_free(roots[rows], joints[rows])[:, feet, 1, 3].min(axis=1)
        return abs(float(np.median(low - floor[rows])) - float(rest))

    return min(ADULTS, key=gap)


def floor_below(height: Array, robot_floor: Array | None, window: int = 31) -> Array:
    """Return the height of the floor [T] under roots at heights [T] [m].

    The vertical motion of walking is filtered out. On the robot's storey the result is the robot's floor.
    """
    if not len(height):
        return height
    padded = np.pad(height, window // 2, mode="edge")
    known = np.lib.stride_tricks.sliding_window_view(padded, window)
    middle = np.where(np.isfinite(known).any(1), _nanmedian(known), np.nan) - HUMAN_ROOT_HEIGHT_M
    if robot_floor is None:
        return middle
    return np.where(np.abs(robot_floor - middle) < SAME_FLOOR_M, robot_floor, middle)


def _nanmedian(values: Array) -> Array:
    filled = np.where(np.isfinite(values).any(axis=1, keepdims=True), values, 0.0)
    return np.nanmedian(filled, axis=1)
