"""Room for the arms: how far a person draws each arm in towards her body, from the distance field at her sides.

A line runs along each side of her, forward and back. What is near it draws the arm in: wholly where she is, the less the
farther ahead or behind it is. So an arm begins to come in before she is at a door post, and is let go after it.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from h3data.bodies import Humanoid
from h3data.bodies.people.reach import Hand
from h3data.geometry import IDENTITY_POSE
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace.free_space import sample_sdf
from sim_kinematic.motion.spec import ArmRoomSpec
from sim_kinematic.motion.state import HumanState

ROUNDING = 1e-9
"""Far more than rounding can make of a comparison in `_draw_in_worlds`."""
HANDS: tuple[Hand, ...] = ("left", "right")
"""In the order of `HumanState.arms`."""


@kernel(error_model="numpy")
def _draw_in_worlds(sdf, origin, cell, xz, heading, arms, busy, rate, aside, free, tight, within, fade, step):
    """One step of all arms [W, 2], in place: each goes by at most ``rate`` towards how far its line asks for, 0..1.

    Distances differ by no more than the path between two points, so where there is room a line is followed by as much. What
    it asks for is the most of its looks. A line is left as soon as no further look can change the arm.

    All lines advance by one look in turn: on a line each look has to wait for the one before, so one line after the other
    takes 1.7 times as long.
    """
    worlds, end = len(heading), within + fade
    x, z, c, s = np.empty(2 * worlds), np.empty(2 * worlds), np.empty(worlds), np.empty(worlds)
    along, most, enough = np.full(2 * worlds, -end), np.zeros(2 * worlds), np.empty(2 * worlds)
    lines, count = np.empty(2 * worlds, np.intp), 0
    for w in range(worlds):
        c[w], s[w] = math.cos(heading[w]), math.sin(heading[w])
        for k in range(2):
            line, side = 2 * w + k, 2.0 * k - 1.0
            x[line], z[line] = xz[w, 0] + s[w] * side * aside, xz[w, 1] + c[w] * side * aside
            enough[line] = min(arms[w, k] + rate + ROUNDING, 1.0)
            lines[count] = line
            count += k != busy
    while count > 0:
        left = 0
        for n in range(count):
            line = lines[n]
            w, at, before = line >> 1, along[line], most[line]
            room = sample_sdf(sdf, origin, cell, x[line] + c[w] * at, z[line] - s[w] * at)
            need = min((free - room) / (free - tight), 1.0) - max(abs(at) - within, 0.0) / fade
            need = max(need, before)
            at += max(room - free, step)
            along[line], most[line] = at, need
            lines[left] = line
            left += (at <= end) & (need < enough[line]) & (at - within < (1.0 - need) * fade + ROUNDING)
        count = left
    for w in range(worlds):
        for k in range(2):
            arms[w, k] += min(max(most[2 * w + k] - arms[w, k], -rate), rate)


def draw_arms(
    state: HumanState, free: FreeSpace, body: Humanoid, rules: ArmRoomSpec | None, *, busy: Hand | None = None
) -> None:
    """Draw the arms of a person in all her worlds in, or let them go, by one step towards what the room there asks for, in
    place; without rules they stay as they are. An arm whose hand is ``busy`` is let go."""
    if rules is None:
        return
    width = width_m(body) - rules.aside_m
    _draw_in_worlds(
        free.sdf, free.origin, free.cell_m, state.xz, state.heading, state.arms,
        HANDS.index(busy) if busy else -1, rules.rate, rules.aside_m, width + rules.free_m, width + rules.tight_m,
        rules.within_m, rules.fade_m, rules.step_m,
    )  # fmt: skip


@lru_cache(maxsize=64)
def width_m(body: Humanoid) -> float:
    """How far her capsules get to one side of her middle where she stands with both arms drawn in [m]."""
    joints = body.joint_matrices(IDENTITY_POSE[None], *body.clip_pose([0], [0.0], arms=np.ones((1, 2))))
    start, end, radius = body.capsules_world(joints)
    return float((np.abs(np.stack([start, end])[:, 0, :, 2]).max(0) + radius).max())
