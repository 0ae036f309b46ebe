"""Tracks of agents: who has been standing for long, by the kernel and by NumPy."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_kinematic.agents.giving_way import _note
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.yielding import AGENT


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_the_kernel_finds_those_who_stand(seed: int) -> None:
    rng = np.random.default_rng(seed)
    agents, count, still = 3, AVOIDANCE.still_steps, AVOIDANCE.still_m
    steps = rng.normal(0, rng.choice([0.0, 3e-4, 1e-3]), (agents, 2 * count, 2))
    track, places, now = np.cumsum(steps, axis=1), np.zeros((agents, 2 * count, 2)), np.zeros(agents, AGENT)
    for moments in range(1, 2 * count + 1):
        now["x"], now["z"] = track[:, moments - 1].T
        near = _note(places, moments, now, np.full(agents, 0.05), count, still)
        gaps = np.hypot(*(track[:, None, moments - 1] - track[None, :, moments - 1]).transpose(2, 0, 1))
        assert near == (gaps[np.triu_indices(agents, 1)] <= 0.1).any()
        last = track[:, max(moments - count, 0) : moments]
        np.testing.assert_array_equal(now["settled"], (np.ptp(last, axis=1).max(-1) < still) & (moments >= count))
    np.testing.assert_array_equal(places, track)
