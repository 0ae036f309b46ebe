"""Feet of a person who turns on the spot: recordings hold the root, which turns rigidly; here the feet step round with it.

The motion columns say when the person comes from walking to standing (`h3data.bodies.people.kernels.legs.settle`): each foot
goes to its standing place, one after the other. The foot that stands meanwhile is kept where it is in the world, and one that
lands does so turned towards where the person will look. Then they go on by turns, until the person is straight again. As in
`h3data.bodies.robots.trot` whole recordings are looked at, so any step can be posed alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.people.foot_planting import ANKLE, HIP, LEG_JOINTS, leg_frames, legs_to, runs
from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.legs import LEG_MAX, SIDES
from h3data.geometry import (
    Array,
    heading_from_quat,
    quat_conjugate,
    quat_from_heading,
    quat_multiply,
    quat_rotate,
    wrap_angle,
)

MOVED_M, TURNED_RAD = 1e-4, 1e-3
"""A root that moves or turns less than this from one step to the next rests (recorded places are float32)."""
SWING_STEPS, LIFT_M = 5, 0.05
"""A foot that is set anew on the spot is in the air for about so many steps of the recording, and so high."""
FEWEST_STEPS = 2
"""A foot is not set anew in fewer steps."""
RELEASE_STEPS = 4
"""Over so many steps a foot that still stands turned is put straight when the person walks off."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TurningFeet:
    """Differences of the feet from those of the motion clips while the person turns on the spot."""

    yaw: Array
    """Turn of each foot to the left about the root, shape [T, 2] [rad]."""
    lift: Array
    """Height of each foot above its own, shape [T, 2] [m]."""


@dataclass
class _Swing:
    """A foot that is in the air after ``start`` and lands at step ``end``."""

    foot: int
    start: int
    end: int
    lift: float


def turning_feet(base: ArrayLike, phase: ArrayLike, blend: ArrayLike) -> TurningFeet:
    """From roots [T, 7] and the motion columns phase and blend [T], for all T steps of a recording."""
    base, phase, blend = (np.asarray(a, np.float64) for a in (base, phase, blend))
    yaw, lift = np.zeros((2, len(base), 2))
    if len(base) < 2:
        return TurningFeet(yaw=yaw, lift=lift)
    turn = wrap_angle(np.diff(heading_from_quat(base[:, 3:])))
    heading = np.concatenate([[0.0], np.cumsum(np.nan_to_num(turn))])
    rests = np.hypot(*np.diff(base[:, [0, 2]], axis=0).T) < MOVED_M  # not where the person is absent (NaN)
    for before, last in runs(rests):  # of steps between: the root is at one place from `before` to `last`
        turns = [(a + before, b + before) for a, b in runs(np.abs(np.diff(heading[before : last + 1])) > TURNED_RAD)]
        if not turns:
            continue
        swings = _settling(phase, blend, before, last)
        for k, (start, end) in enumerate(turns):
            free = turns[k + 1][0] if k + 1 < len(turns) else last
            landed = [swing.end for swing in swings]
            swings += _stepping(max([start, *landed]), end, free, swings[-1].foot if swings else 1)
        for foot in range(2):
            own = [swing for swing in swings if swing.foot == foot]
            at, steps = heading[before], np.arange(before, last + 1)
            world = np.full(len(steps), at)
            for k, swing in enumerate(own):
                leaves = own[k + 1].start if k + 1 < len(own) else last
                to = _stance_heading(heading, turns, swing.end, leaves)
                u = np.clip((steps - swing.start) / (swing.end - swing.start), 0, 1)
                world += (to - at) * u * u * (3 - 2 * u)
                lift[steps, foot] += swing.lift * np.sin(np.pi * u) ** 2
                at = to
            yaw[steps, foot] = world - heading[steps]
        after = np.arange(last + 1, min(last + RELEASE_STEPS, len(base)))
        yaw[after] = yaw[last] * (1 - (after - last) / RELEASE_STEPS)[:, None]
    return TurningFeet(yaw=yaw, lift=lift)


def _settling(phase: Array, blend: Array, before: int, last: int) -> list[_Swing]:
    """Swings of the feet between two steps while the person changes from walking to standing.

    They are those of `h3data.bodies.people.kernels.legs.settle`.
    """
    b = blend[before : last + 1]
    swings = []
    for foot, (_, _, start) in enumerate(SIDES):
        first = (phase[before] - start) % 1.0 >= 0.5
        share = np.clip(2 * b - 1 if first else 2 * b, 0, 1)
        moving = np.flatnonzero(np.diff(share) < -1e-3)  # blends are rounded
        if len(moving):
            swings.append(_Swing(foot, before + int(moving[0]), before + int(moving[-1]) + 1, 0.0))
    return sorted(swings, key=lambda swing: swing.end)


def _stepping(start: int, end: int, free: int, last_foot: int) -> list[_Swing]:
    """Swings of both feet in turn while the person turns on the spot until ``end``; who stands on until ``free`` may end later.

    The right foot is the last one: a walk begins with the left foot on the floor.
    """
    room = free - start
    if end <= start or room < 2 * FEWEST_STEPS:
        return []
    foot = 1 - last_foot
    count = max(round((end - start) / SWING_STEPS), 1)
    count += (foot + count) % 2  # an even number from the left foot on, an odd one from the right foot
    if count == 1 and end - start > FEWEST_STEPS:
        count = 3
    while count > 1 and room < count * FEWEST_STEPS:
        count -= 2
    if count < 1:
        return []
    span = min(max(end - start, count * FEWEST_STEPS if count * SWING_STEPS > room else count * SWING_STEPS), room)
    edges = np.round(np.linspace(start, start + span, count + 1)).astype(int)
    return [_Swing((foot + k) % 2, int(edges[k]), int(edges[k + 1]), LIFT_M) for k in range(count)]


def _stance_heading(heading: Array, turns: list[tuple[int, int]], lands: int, leaves: int) -> float:
    """Heading of a foot that stands from step ``lands`` to ``leaves``.

    It is the heading of the root in the middle of its turn, or at its end if the root does not turn any further after
    that.
    """
    ends = [end for start, end in turns if start < leaves]
    if ends and ends[-1] <= leaves:
        return float(heading[leaves])
    return float((heading[lands] + heading[leaves]) / 2)


def turned(
    body: Humanoid, quats: Array, pelvis: Array, yaw: NDArray[np.floating], lift: NDArray[np.floating]
) -> tuple[Array, Array]:
    """Local rotations [T, 55, 4] and pelvis places [T, 3] in the agent root frame, with feet of `TurningFeet` [T, 2]."""
    rows = np.flatnonzero((yaw != 0).any(axis=1) | (lift != 0).any(axis=1))
    if not len(rows):
        return quats, pelvis
    turned_quats, places = quats[rows].copy(), pelvis[rows].copy()
    ankles = leg_frames(body, turned_quats, places)[:, :, ANKLE, :3, 3]
    root = turned_quats[:, 0]
    for foot, joint in enumerate(LEG_JOINTS[:, HIP].tolist()):
        turn = quat_from_heading(yaw[rows, foot])
        local = quat_multiply(quat_conjugate(root), quat_multiply(turn, root))
        turned_quats[:, joint] = quat_multiply(local, turned_quats[:, joint])
        ankles[:, foot] = quat_rotate(turn, ankles[:, foot])
    ankles[..., 1] += lift[rows]
    hips = leg_frames(body, turned_quats, places)[:, :, HIP, :3, 3]
    aside = np.sum((hips - ankles)[..., ::2] ** 2, axis=-1)
    room = np.sqrt(np.maximum((LEG_MAX * body.gaits.legs.length) ** 2 - aside, 0.0))
    places[:, 1] -= np.maximum(hips[..., 1] - ankles[..., 1] - room, 0.0).max(axis=1)  # down to feet out of reach
    out, low = np.array(quats, np.float64), np.array(pelvis, np.float64)
    out[rows], low[rows] = legs_to(body, turned_quats, places, ankles), places
    return out, low
