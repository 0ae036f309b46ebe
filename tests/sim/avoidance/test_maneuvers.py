"""Maneuvers: they lead on where no single command does, touch nothing, and end."""

from __future__ import annotations

import types

import numba
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.scene import FreeSpace
from h3data.scene.freespace.build import build_from_walkable
from h3data_homes import HomeSpec, build_home
from sim_kinematic.avoidance import maneuvers
from sim_kinematic.avoidance.maneuvers import GAIN_M, plan_maneuver
from sim_kinematic.avoidance.robot_base import hull_of
from sim_kinematic.avoidance.routes import FloorRoutes
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.velocity import least_gap
from sim_kinematic.motion.spec import HOME_BASE
from sim_kinematic.motion.state import RobotState
from sim_kinematic.motion.step import drive_robots, least_clearance

NOBODY = np.zeros((0, 3))
EMPTY = -9


def floor_of(*rooms: shapely.Polygon) -> FreeSpace:
    walkable = shapely.MultiPolygon(shapely.get_parts(shapely.union_all(rooms)).tolist())
    sizes = {"floor_y": 0.0, "radius_m": 0.25, "height_m": 1.4, "max_climb_m": 0.2, "cell_m": 0.05}
    return FreeSpace.from_map(build_from_walkable(walkable, **sizes))


def driven(free: FreeSpace, xz: np.ndarray, heading: float, commands: np.ndarray) -> RobotState:
    """The robot after the commands; none of them touches anything."""
    robot = RobotState.zeros(1)
    robot.xz[0], robot.heading[0] = xz, heading
    for command in commands:
        before = robot.xz.copy()
        drive_robots(robot, free, command[None], HOME_BASE)
        moved = np.hypot(*(robot.xz - before)[0])
        assert abs(moved - abs(command[0]) * HOME_BASE.max_speed_mps / 30) < 2e-3  # nothing pushes it
    return robot


def test_a_robot_backs_out_of_a_dead_end() -> None:
    """A corridor that is too narrow to turn in: it has to be left backwards."""
    free = floor_of(shapely.box(0, 0, 4, 0.8), shapely.box(0, -3, 2, 3))
    start, goal = np.array([3.3, 0.4]), np.array([1.0, 2.2])
    commands = plan_maneuver(free, HOME_BASE, start, 0.0, goal, NOBODY)
    assert commands[0, 0] < 0
    robot = driven(free, start, 0.0, commands)
    assert free.geodesic(robot.xz[0], goal) < free.geodesic(start, goal) - 0.8 * GAIN_M


def test_it_ends_at_the_goal_with_the_heading_that_is_wanted() -> None:
    free = floor_of(shapely.box(0, 0, 3, 3))
    start, goal = np.array([1.0, 1.2]), np.array([1.6, 1.5])
    commands = plan_maneuver(free, HOME_BASE, start, 0.0, goal, NOBODY, bearing=2.0)
    robot = driven(free, start, 0.0, commands)
    assert np.hypot(*(robot.xz[0] - goal)) < 0.15
    assert abs(np.angle(np.exp(1j * (robot.heading[0] - 2.0)))) < np.pi / 15


def test_none_where_there_is_none() -> None:
    free = floor_of(shapely.box(0, 0, 4, 0.8), shapely.box(0, -3, 2, 3))
    start = np.array([3.3, 0.4])
    in_the_way = np.array([[2.3, 0.4, 0.3]])
    assert not len(plan_maneuver(free, HOME_BASE, start, 0.0, np.array([1.0, 2.2]), in_the_way))
    apart = floor_of(shapely.box(0, 0, 3, 3), shapely.box(5, 0, 8, 3))
    assert not len(plan_maneuver(apart, HOME_BASE, np.array([1.5, 1.5]), 0.0, np.array([6.5, 1.5]), NOBODY))


def test_a_search_that_could_not_slide_anywhere_is_not_made_twice() -> None:
    """In the open a first move that slides is the same move, so the second search is over at once, with the same answer."""
    free = floor_of(shapely.box(0, 0, 6, 6))
    # with a gap that is a little too narrow, as one search or none is made where they stand closely
    ring = np.array([(3 + 1.38 * np.cos(a), 3 + 1.38 * np.sin(a), 0.4) for a in np.arange(11) * np.pi / 6])
    searches, search = [], maneuvers._search

    def counted(*arguments):
        arguments[22][:] = EMPTY
        found = search(*arguments)
        searches.append((arguments[19], found, int((arguments[22] != EMPTY).sum())))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(maneuvers, "_search", counted)
        assert not len(plan_maneuver(free, HOME_BASE, np.array([3.0, 3.0]), 0.0, np.array([0.5, 0.5]), ring))
    (first, found, many), (second, again, few) = searches
    assert (first, second) == (False, True)
    assert found == again == -1
    assert few <= 1 + 8 < many


@pytest.fixture(scope="module")
def home() -> FreeSpace:
    return FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=2)))


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_every_maneuver_can_be_driven(home: FreeSpace, seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, goal = home.sample(rng, 2)
    heading = rng.uniform(-np.pi, np.pi)
    offsets = np.array(HOME_BASE.disc_offsets_m)
    room = least_clearance(home.sdf, home.origin, home.cell_m, *start, heading, offsets)
    if room < HOME_BASE.disc_radius_m:
        return
    commands = plan_maneuver(home, HOME_BASE, start, heading, goal, NOBODY)
    assert (np.abs(commands) <= 1 + 1e-9).all()
    robot = driven(home, start, heading, commands)
    if len(commands):
        assert home.geodesic(robot.xz[0], goal, max_snap_m=1.0) < home.geodesic(start, goal) + 0.1


# --- ends that somebody occupies, or to which somebody stands in the way --------------------------------------------------
def is_near(
    free: FreeSpace, xz: np.ndarray, left: np.ndarray, bearing: float, facing: float, discs: np.ndarray
) -> bool:
    base = HOME_BASE
    sizes = np.array(base.disc_offsets_m), base.disc_radius_m - base.clearance_tolerance_m, np.array(hull_of(base))
    grid = FloorRoutes.of(free)
    floor = free.sdf, free.origin, free.cell_m
    return maneuvers._some_end_is_near(
        *floor, *xz.tolist(), 1, *sizes, discs, left, grid.origin, AVOIDANCE.cell_m, 0.05, bearing, facing
    )


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_an_end_that_a_base_could_take_is_never_ruled_out(home: FreeSpace, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid, facing = FloorRoutes.of(home), np.pi / maneuvers.HEADINGS
    at, bearing = home.sample(rng, 1)[0], rng.uniform(-np.pi, np.pi)
    heading, disc = bearing + rng.uniform(-facing, facing), np.array([[*(at + rng.normal(0, 0.8, 2)), 0.5]])
    offsets, radius = np.array(HOME_BASE.disc_offsets_m), HOME_BASE.disc_radius_m - HOME_BASE.clearance_tolerance_m
    left = np.full(grid.room.shape, 9.0)
    left[tuple(((at - grid.origin) / AVOIDANCE.cell_m).astype(int))] = 0.0
    fits = least_clearance(home.sdf, home.origin, home.cell_m, *at, heading, offsets) >= radius
    fits &= least_gap(*at, heading, *disc[0, :2], np.array(hull_of(HOME_BASE)), disc[0, 2]) >= 0
    assert not fits or is_near(home, at, left, bearing, facing, disc)


def test_a_goal_that_somebody_occupies_needs_no_search() -> None:
    free, goal = floor_of(shapely.box(0, 0, 6, 6)), np.array([4.0, 4.0])
    left = FloorRoutes.of(free).flood(goal, NOBODY).distance
    start, there = np.array([3.0, 3.0]), np.array([[4.0, 4.2, 0.8]])
    assert is_near(free, start, left, 1.0, 0.1, NOBODY)
    assert not is_near(free, start, left, 1.0, 0.1, there)
    assert not len(plan_maneuver(free, HOME_BASE, start, 0.0, goal, there, bearing=1.0))


def test_a_passage_that_somebody_occupies_needs_no_search() -> None:
    free, goal = (
        floor_of(shapely.box(0, 0, 4, 4), shapely.box(4, 1.5, 6, 2.5), shapely.box(6, 0, 9, 4)),
        np.array([8, 2.0]),
    )
    left = FloorRoutes.of(free).flood(goal, NOBODY).distance
    start, there = np.array([3.0, 2.0]), np.array([[5.0, 2.1, 0.8]])
    assert is_near(free, start, left, 0.0, np.inf, NOBODY)
    assert not is_near(free, start, left, 0.0, np.inf, there)
    assert not len(plan_maneuver(free, HOME_BASE, start, 0.0, goal, there))


@pytest.mark.slow
def test_searches_that_are_not_made_would_have_found_nothing(home: FreeSpace) -> None:
    """Parity with the search that looks at all poses in any case; it is compiled here, which takes most of the time."""

    @numba.njit
    def always(*_):
        return True

    code, rng, ruled_out = maneuvers._search.py_func.__code__, np.random.default_rng(0), 0
    search = numba.njit(types.FunctionType(code, {**vars(maneuvers), "_some_end_is_near": always}), error_model="numpy")
    for _ in range(300):
        start, goal = home.sample(rng, 2)
        path, count = home.path(start, goal), int(rng.integers(1, 5))
        at = path[rng.integers(0, len(path), count)] + rng.normal(0, 0.4, (count, 2))
        discs, heading = np.column_stack([at, rng.uniform(0.2, 0.5, count)]), float(rng.uniform(-3, 3))
        bearing = None if rng.random() < 0.5 else float(rng.uniform(-3, 3))
        asked = home, HOME_BASE, start, heading, goal, discs
        found = plan_maneuver(*asked, bearing=bearing)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(maneuvers, "_search", search)
            assert np.array_equal(found, plan_maneuver(*asked, bearing=bearing))
        ruled_out += not len(found)
    assert ruled_out > 50
