"""Correction of sliding feet: floor contact is detected by height and speed, and legs follow by inverse kinematics.

A foot on the floor rolls over its heel, the ball below its toe joint, and the tip of its toes, whichever is lowest. The
rotations of the foot are kept, and its lowest point rests while it is the lowest. Between two stances the correction is
interpolated. All coordinates are in a frame with the floor at y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.legs import LEG_MAX
from h3data.bodies.people.soles import ANKLE, HIP, KNEE, LEG_JOINTS, runs, sole_points
from h3data.geometry import (
    Array,
    normalized,
    quat_conjugate,
    quat_from_axis_angle,
    quat_from_matrix,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
)

LOW_M, SLOW_MPS = 0.04, 0.25
"""Height [m] and speed [m/s] that decide contact. A point of a sole touches the floor if height / LOW_M + speed /
SLOW_MPS is below 1. A point on the floor may slide, as on a body of other proportions; in the air, only a resting point
counts."""
SPEED_S = 1 / 60
"""Time before and after a frame over which speeds are measured [s]; the smaller speed is used."""
GAP_S, STANCE_S = 0.06, 0.10
"""Longest interruption of a stance that is ignored, and shortest stance that counts [s]."""
SLIDE_M = 0.20
"""Distance above which a slide of a touching foot is intended and left unchanged [m]."""
SINK_S = 0.12
"""Time over which the pelvis is lowered towards feet out of reach [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Contacts:
    """Contacts of the soles of both feet with the floor over time."""

    touching: NDArray[np.bool_]
    """True if the left or right foot touches the floor, shape [T, 2]."""
    slide_m: Array
    """Distance that the lowest point of a touching sole moved along the floor since the previous frame, shape [T, 2]
    [m]."""


def find_contacts(points: Array, fps: float) -> Contacts:
    """Return the floor contacts of soles, from `sole_points` [T, 2, 3, 3] [m] at ``fps`` frames/s."""
    span = max(1, min(round(SPEED_S * fps), len(points) - 1))
    way = np.linalg.norm(points[span:] - points[:-span], axis=-1)
    ends = np.full((span, *way.shape[1:]), np.inf)
    speed = np.minimum(np.concatenate([way, ends]), np.concatenate([ends, way]))[: len(points)] * fps / span
    if len(points) == 1:
        speed = np.zeros(points.shape[:-1])
    resting = np.maximum(points[..., 1], 0) / LOW_M + speed / SLOW_MPS < 1
    gap, least = round(GAP_S * fps), round(STANCE_S * fps)
    any_point = np.logical_or.reduce(resting, axis=2)
    touching = np.stack([_without_short(any_point[:, k], gap, least) for k in range(2)], axis=1)
    return Contacts(touching=touching, slide_m=_slide(points, touching))


def _slide(points: Array, touching: NDArray[np.bool_]) -> Array:
    """Return how far the point that was lowest in both frames moved along the floor."""
    out = np.zeros(points.shape[:2])
    heights = points[1:, ..., 1] + points[:-1, ..., 1]
    pivot = np.argmin(heights, axis=2)[..., None]
    way = np.linalg.norm(np.diff(points[..., ::2], axis=0), axis=-1)
    out[1:] = np.take_along_axis(way, pivot, axis=2)[..., 0]
    return np.where(touching & np.roll(touching, 1, axis=0), out, 0.0)


def _without_short(mask: NDArray[np.bool_], gap: int, least: int) -> NDArray[np.bool_]:
    """Return gaps of up to ``gap`` frames closed (not at the ends), then runs below ``least`` frames dropped."""
    out = mask.copy()
    for start, end in runs(~mask):
        if end - start <= gap and start > 0 and end < len(mask):
            out[start:end] = True
    for start, end in runs(out):
        if end - start < least and start > 0 and end < len(mask):
            out[start:end] = False
    return out


def planted(body: Humanoid, quats: Array, pelvis: Array, fps: float) -> tuple[Array, Array]:
    """Return rotations [T, 55, 4] and pelvis positions [T, 3] with feet that neither slide nor sink below y = 0."""
    frames = leg_frames(body, quats, pelvis)
    points = sole_points(body, frames)
    touching = find_contacts(points, fps).touching
    ankles = frames[:, :, ANKLE, :3, 3].copy()
    for k in range(2):
        ankles[:, k] += _correction(points[:, k], touching[:, k])
    pelvis = pelvis - _sinking(body, frames, ankles, fps)[:, None] * np.array([0.0, 1, 0])
    return legs_to(body, quats, pelvis, ankles), pelvis


def _correction(points: Array, touching: NDArray[np.bool_]) -> Array:
    """Return the displacement of an ankle, [T, 3] [m], for the sole points [T, 3, 3] of its foot."""
    frames = len(points)
    shift, known = np.zeros((frames, 3)), np.zeros(frames, bool)
    lowest = points[..., 1].min(axis=1)
    for start, end in runs(touching):
        part = points[start:end]
        pivot = np.argmin(part[1:, :, 1] + part[:-1, :, 1], axis=1)
        way = np.diff(part[..., ::2], axis=0)[np.arange(len(pivot)), pivot]
        drift = np.concatenate([np.zeros((1, 2)), -np.cumsum(way, axis=0)])
        drift -= drift.mean(axis=0)
        if np.abs(drift).max() > SLIDE_M / 2:
            continue
        shift[start:end, ::2] = drift
        shift[start:end, 1] = -lowest[start:end]
        known[start:end] = True
    if known.any():
        at = np.flatnonzero(known)
        for start, end in runs(~known):
            before, after = shift[max(start - 1, at[0])], shift[min(end, at[-1])]
            u = (np.arange(start, end) - start + 1) / (end - start + 1)
            u = (u * u * (3 - 2 * u))[:, None]
            shift[start:end] = before + u * (after - before)
    shift[:, 1] = np.maximum(shift[:, 1], -lowest)
    return shift


def _sinking(body: Humanoid, frames: Array, ankles: Array, fps: float) -> Array:
    """Return how far the pelvis must go down, [T] [m], smoothly, so that both ankles [T, 2, 3] are within reach."""
    need = np.zeros(len(frames))
    for k in range(2):
        hip = frames[:, k, HIP, :3, 3]
        aside = np.sum((hip - ankles[:, k])[:, ::2] ** 2, axis=1)
        room = np.sqrt(np.maximum((LEG_MAX * body.gaits.legs.length) ** 2 - aside, 0.0))
        need = np.maximum(need, hip[:, 1] - ankles[:, k, 1] - room)
    reach = max(1, round(SINK_S * fps))
    if len(need) == 1 or not need.any():
        return need
    wide = np.pad(need, 2 * reach, mode="edge")
    highest = np.max(np.lib.stride_tricks.sliding_window_view(wide, 2 * reach + 1), axis=1)
    window = np.hanning(2 * reach + 3)[1:-1]
    return np.convolve(highest, window / window.sum(), mode="valid")


def legs_to(body: Humanoid, quats: Array, pelvis: Array, ankles: Array) -> Array:
    """Return rotations [T, 55, 4] with hips and knees rotated so that the ankles are at ``ankles`` [T, 2, 3] [m].

    The joints rotate as little as possible, and the feet keep their rotations in the world. The solution is the closed
    form for two bones: the knee bends about its own axis, then the leg swings.
    """
    out = np.array(quats, np.float64)
    frames = leg_frames(body, quats, pelvis)
    legs = body.gaits.legs
    root = quats[:, 0]
    for k, (hip, knee, ankle, _) in enumerate(LEG_JOINTS.tolist()):
        top, middle, low = (frames[:, k, joint, :3, 3] for joint in (HIP, KNEE, ANKLE))
        hinge = frames[:, k, HIP, :3, 0]
        thigh, shank = middle - top, low - middle
        across = np.cross(thigh, shank)
        sign = np.where(np.sum(across * hinge, axis=1) < 0, -1.0, 1.0)
        bend = sign * np.arctan2(np.linalg.norm(across, axis=1), np.sum(thigh * shank, axis=1))
        axis = normalized(sign[:, None] * across + 0.02 * legs.thigh * legs.shank * hinge)
        aim = ankles[:, k] - top
        far = np.clip(np.linalg.norm(aim, axis=1), abs(legs.thigh - legs.shank) + 1e-3, 0.9999 * legs.length)
        cosine = (far**2 - legs.thigh**2 - legs.shank**2) / (2 * legs.thigh * legs.shank)
        wanted = np.arccos(np.clip(cosine, -1, 1))
        knee_turn = quat_from_axis_angle(axis, np.where(_at(far, low - top), 0.0, wanted - bend))
        leg_turn = _shortest_turn(thigh + quat_rotate(knee_turn, shank), aim)
        thigh_was, knee_was, foot = (quat_from_matrix(frames[:, k, joint, :3, :3]) for joint in (HIP, KNEE, ANKLE))
        thigh_is = quat_multiply(leg_turn, thigh_was)
        knee_is = quat_multiply(leg_turn, quat_multiply(knee_turn, knee_was))
        out[:, hip] = quat_multiply(quat_conjugate(root), thigh_is)
        out[:, knee] = quat_multiply(quat_conjugate(thigh_is), knee_is)
        out[:, ankle] = quat_multiply(quat_conjugate(knee_is), foot)
    return out


def _at(far: Array, reached: Array) -> NDArray[np.bool_]:
    """Return whether a leg is as long as it shall be: then its knee is left alone, whatever its axis."""
    return np.abs(far - np.linalg.norm(reached, axis=1)) < 1e-12


def _shortest_turn(a: Array, b: Array) -> Array:
    """Return quaternions [T, 4] by the shortest way from directions ``a`` [T, 3] to ``b`` [T, 3]."""
    a, b = normalized(a), normalized(b)
    return normalized(np.concatenate([np.cross(a, b), 1 + np.sum(a * b, axis=1, keepdims=True)], axis=1))


def leg_frames(body: Humanoid, quats: Array, pelvis: Array) -> Array:
    """Return frames [T, 2, 4, 4, 4] of hip, knee, ankle and toe joint of both legs, in the frame of ``pelvis`` [T, 3].

    The function computes the same as `h3data.bodies.people.kernels.clips.joint_frames`, but only for these joints and
    with a seventh of the memory.
    """
    frames = np.zeros((len(quats), 2, 4, 4, 4))
    frames[..., 3, 3] = 1
    turn, place = quat_to_matrix(quats[:, 0])[:, None], pelvis[:, None]
    for k, joints in enumerate(LEG_JOINTS.T):
        place = place + (turn @ body.joint_offsets[joints][..., None])[..., 0]
        turn = turn @ quat_to_matrix(quats[:, joints])
        frames[:, :, k, :3, :3], frames[:, :, k, :3, 3] = turn, place
    return frames
