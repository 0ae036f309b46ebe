"""Tracks of agents: who has been standing for long, by the kernel and by NumPy."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_kinematic.agents.giving_way import _note
from sim_kinematic.avoidance.spec import AVOIDANCE


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_the_kernel_finds_those_who_stand(seed: int) -> None:
    rng = np.random.default_rng(seed)
    agents, count, still = 3, AVOIDANCE.still_steps, AVOIDANCE.still_m
    steps = rng.normal(0, rng.choice([0.0, 3e-4, 1e-3]), (agents, 2 * count, 2))
    track, places, settled = np.cumsum(steps, axis=1), np.zeros((agents, 2 * count, 2)), np.zeros(agents, np.bool_)
    for moments in range(1, 2 * count + 1):
        _note(places, moments, track[:, moments - 1].copy(), settled, count, still)
        last = track[:, max(moments - count, 0) : moments]
        np.testing.assert_array_equal(settled, (np.ptp(last, axis=1).max(-1) < still) & (moments >= count))
    np.testing.assert_array_equal(places, track)
