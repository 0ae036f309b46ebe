"""Where a click on the floor leads."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import InputError
from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from h3data_play.guide import FLOOR_SNAP_M, NEAR_M, Guide
from sim_kinematic.motion.spec import HOME_BASE, BaseSpec
from sim_kinematic.motion.state import RobotState
from sim_kinematic.motion.step import drive_robots, least_clearance

FREE = FreeSpace.from_scene(build_home(HomeSpec(seed=3)))
PERSON = BaseSpec(max_speed_mps=1.3, max_turn_rad_s=2.0, disc_offsets_m=(0.0,))
START = FREE.sample(np.random.default_rng(0), 1)[0]


def guide(goal: tuple[float, float]) -> Guide:
    return Guide.to(FREE, PERSON, START, goal)


@given(st.floats(FLOOR_SNAP_M + 0.05, NEAR_M - 0.05), st.integers(0, 3))
def test_a_click_beyond_the_floor_leads_as_near_as_possible(beyond: float, side: int) -> None:
    x0, z0, x1, z1 = FREE.polygon.geoms[0].bounds
    goal = [(x0 - beyond, START[1]), (x1 + beyond, START[1]), (START[0], z0 - beyond), (START[0], z1 + beyond)][side]
    distance = FREE.polygon.geoms[0].distance(shapely.Point(goal))
    if distance > NEAR_M - 0.01:
        with pytest.raises(InputError, match="H3-PLAY-020"):
            guide(goal)
        return
    end = guide(goal).corners[-1]
    assert FREE.is_navigable(end) or FREE.clearance(end) > -0.01
    assert np.hypot(*(end - goal)) == pytest.approx(distance, abs=0.05)


def test_a_click_far_from_the_home_is_refused() -> None:
    with pytest.raises(InputError, match="H3-PLAY-020"):
        guide((500.0, 500.0))


def led(base: BaseSpec, start: np.ndarray, heading: float, goal: np.ndarray, steps: int = 3000) -> np.ndarray:
    """Where a guide leaves a base at the end (x, z)."""
    robot = RobotState.zeros(1)
    robot.xz[0], robot.heading[0] = start, heading
    way = Guide.to(FREE, base, start, goal)
    for _ in range(steps):
        command = way.velocity(robot.xz[0].copy(), float(robot.heading[0]))
        if command is None:
            return robot.xz[0]
        drive_robots(robot, FREE, np.array([command]), base)
    raise AssertionError("it went on and on")


@pytest.mark.parametrize("seed", range(12))
def test_a_long_base_gets_around_the_corners_of_a_home(seed: int) -> None:
    """It comes as near as its discs fit: a point beside a wall is not for the middle of a base 1.2 m long."""
    rng, offsets = np.random.default_rng(seed), np.array(HOME_BASE.disc_offsets_m)
    goal, start, heading = *FREE.sample(rng, 2), 0.0
    while least_clearance(FREE.sdf, FREE.origin, FREE.cell_m, *start, heading, offsets) < HOME_BASE.disc_radius_m:
        start, heading = FREE.sample(rng, 1)[0], rng.uniform(-np.pi, np.pi)
    assert np.hypot(*(led(HOME_BASE, start, heading, goal) - goal)) < np.abs(offsets).max() + 0.05


@given(st.integers(0, 2**32 - 1))
def test_a_disc_arrives_exactly(seed: int) -> None:
    start, goal = FREE.sample(np.random.default_rng(seed), 2)
    np.testing.assert_allclose(led(PERSON, start, 0.0, goal), goal, atol=0.02)
