"""Retargeting of any person's motion to a body: rotations by joint, distances by leg length, and feet on the floor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.soles import sole_points
from h3data.geometry import Array, quat_sign_continuous
from h3data_motion.clip import Motion
from h3data_motion.contacts import find_contacts, leg_frames, planted

ADULT_LEG_M = 0.80
"""Length of thigh plus shank of an adult [m], for motions from which the length cannot be found."""
SCALES = (0.5, 2.0)
"""Range of accepted scale factors that are estimated from planted feet."""
FLOOR_PERCENTILE = 20.0


@dataclass(frozen=True, kw_only=True)
class FootReport:
    """Quality of the feet's floor contact, over all frames in which they touch the floor."""

    touching: float
    """Share of frames with a foot on the floor."""
    slide_mm: float
    """Mean distance that a touching foot slides along the floor per 1/30 s [mm]."""
    slide_max_mm: float
    """Largest distance that a touching foot slides along the floor per 1/30 s [mm]."""
    lowest_mm: float
    """Height of the lowest point of any sole [mm]; negative values are below the floor."""


def retarget(motion: Motion, body: Humanoid, *, plant: bool = True) -> Motion:
    """Return the motion fitted to a body, standing on the floor at y = 0.

    Rotations apply by joint. The path of the pelvis is scaled by leg length. If the motion does not state it, the scale
    is the one that keeps planted feet in place. The floor is at the height of resting soles. With ``plant``, leg joints
    are then recomputed so that feet on the floor stand still (`h3data_motion.contacts`).
    """
    if motion.body == body.name:
        return motion
    scale = _scale(motion, body)
    quats, pelvis = motion.quats, motion.pelvis * scale
    pelvis = pelvis - (0, _floor(sole_points(body, leg_frames(body, quats, pelvis)), motion.fps), 0)
    if plant:
        quats, pelvis = planted(body, quats, pelvis, motion.fps)
    return replace(
        motion, quats=quat_sign_continuous(quats), pelvis=pelvis, leg_m=body.gaits.legs.length, body=body.name
    )


def foot_report(motion: Motion, body: Humanoid) -> FootReport:
    """Measure how much the feet of a fitted motion slide and sink."""
    points = sole_points(body, leg_frames(body, motion.quats, motion.pelvis))
    contacts = find_contacts(points, motion.fps)
    slides = 1000 * contacts.slide_m[1:][contacts.touching[1:]] * motion.fps / 30
    return FootReport(
        touching=float(contacts.touching.any(axis=1).mean()),
        slide_mm=float(slides.mean()) if len(slides) else 0.0,
        slide_max_mm=float(slides.max(initial=0.0)),
        lowest_mm=1000 * float(points[..., 1].min()),
    )


def _scale(motion: Motion, body: Humanoid) -> float:
    legs = body.gaits.legs.length
    if motion.leg_m is not None:
        return legs / motion.leg_m
    nominal = legs / ADULT_LEG_M
    found = _scale_of_planted_feet(motion, body)
    return found if found is not None and SCALES[0] * nominal < found < SCALES[1] * nominal else nominal


def _scale_of_planted_feet(motion: Motion, body: Humanoid) -> float | None:
    """Return the factor s by which the pelvis must move, so that s v + u = 0 for the lower foot's velocity u relative to it.

    Least squares over the floor plane, repeated without the worst half (feet in the air); None if nobody walks.
    """
    points = sole_points(body, leg_frames(body, motion.quats, np.zeros_like(motion.pelvis)))
    heights = points[..., 1].reshape(len(points), -1)
    if len(points) < 3:
        return None
    lower = np.argmin(heights[1:] + heights[:-1], axis=1)
    flat = points[..., ::2].reshape(len(points), -1, 2)
    u = np.diff(flat, axis=0)[np.arange(len(lower)), lower] * motion.fps
    v = np.diff(motion.pelvis[:, ::2], axis=0) * motion.fps
    moving = np.linalg.norm(v, axis=1) > 0.2
    if moving.sum() < 0.3 * motion.fps:
        return None
    u, v = u[moving], v[moving]
    keep, scale = np.ones(len(u), bool), 1.0
    for _ in range(8):
        scale = -float(np.sum(u[keep] * v[keep]) / np.sum(v[keep] ** 2))
        rest = np.linalg.norm(scale * v + u, axis=1)
        keep = rest <= np.median(rest)
    return scale


def _floor(points: Array, fps: float) -> float:
    """Return the height of the floor below `sole_points` [T, 2, 3, 3]: where the lowest points are that hardly move."""
    heights = points[..., 1].reshape(len(points), -1)
    lowest = np.argmin(heights, axis=1)
    rows = np.arange(len(points))
    if len(points) < 3:
        return float(heights.min())
    flat = points.reshape(len(points), -1, 3)
    speed = np.linalg.norm(np.gradient(flat, axis=0), axis=-1)[rows, lowest] * fps
    resting = speed <= max(float(np.percentile(speed, 50)), 0.1)
    return float(np.percentile(heights[rows, lowest][resting], FLOOR_PERCENTILE))
