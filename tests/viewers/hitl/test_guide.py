"""Where a click on the floor leads."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import InputError
from h3data.scene import FreeSpace, HomeSpec, build_home
from h3data_viewers.hitl.guide import FLOOR_SNAP_M, NEAR_M, Guide

FREE = FreeSpace.from_scene(build_home(HomeSpec(seed=3)))
START = FREE.sample(np.random.default_rng(0), 1)[0]


def guide(goal: tuple[float, float]) -> Guide:
    return Guide.to(FREE, START, goal, speed_mps=1.3, turn_rad_s=2.0)


@given(st.floats(FLOOR_SNAP_M + 0.05, NEAR_M - 0.05), st.integers(0, 3))
def test_a_click_beyond_the_floor_leads_as_near_as_possible(beyond: float, side: int) -> None:
    x0, z0, x1, z1 = FREE.polygon.geoms[0].bounds
    goal = [(x0 - beyond, START[1]), (x1 + beyond, START[1]), (START[0], z0 - beyond), (START[0], z1 + beyond)][side]
    distance = FREE.polygon.geoms[0].distance(shapely.Point(goal))
    if distance > NEAR_M - 0.01:
        with pytest.raises(InputError, match="No path leads there"):
            guide(goal)
        return
    end = guide(goal).corners[-1]
    assert FREE.is_navigable(end) or FREE.clearance(end) > -0.01
    assert np.hypot(*(end - goal)) == pytest.approx(distance, abs=0.05)


def test_a_click_far_from_the_home_is_refused() -> None:
    with pytest.raises(InputError, match="No path leads there"):
        guide((500.0, 500.0))
