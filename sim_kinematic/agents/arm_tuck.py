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

HANDS: tuple[Hand, ...] = ("left", "right")
"""In the order of `HumanState.arms`."""


@kernel(error_model="numpy")
def arm_need(sdf, origin, cell, x, z, heading, side, aside, free, tight, within, fade, step):
    """How far the arm of one ``side`` (1 right, -1 left) should be drawn in, 0..1; see `ArmRoomSpec`.

    Distances differ by no more than the way between two points: where there is room it goes on by as much.
    """
    c, s = math.cos(heading), math.sin(heading)
    line_x, line_z = x + s * side * aside, z + c * side * aside
    end = within + fade
    along, most = -end, 0.0
    while along <= end:
        room = sample_sdf(sdf, origin, cell, line_x + c * along, line_z - s * along)
        if room < free:
            need = min((free - room) / (free - tight), 1.0)
            most = max(most, need - max(abs(along) - within, 0.0) / fade)
        along += max(room - free, step)
    return most


@kernel(error_model="numpy")
def _draw_in_worlds(sdf, origin, cell, xz, heading, arms, busy, rate, aside, free, tight, within, fade, step):
    for w in range(len(heading)):
        for k in range(2):
            need = 0.0
            if k != busy:
                need = arm_need(
                    sdf, origin, cell, xz[w, 0], xz[w, 1], heading[w], 2.0 * k - 1.0, aside, free, tight, within, fade,
                    step,
                )  # fmt: skip
            arms[w, k] += min(max(need - arms[w, k], -rate), rate)


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
