"""Motion kernels: exact in the open, never through a wall, the same for one world and for many."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, quat_from_heading
from h3data.scene import Asset, Box, FreeSpace, Instance, Mesh, Room, Scene
from sim_kinematic.motion import gait
from sim_kinematic.motion import step as kernels
from sim_kinematic.motion.spec import STEP_S, BaseSpec, WalkerSpec
from sim_kinematic.motion.state import HumanState, RobotState

SPEC = BaseSpec()
OFFSETS = np.asarray(SPEC.disc_offsets_m)


def empty_mesh() -> Mesh:
    return Mesh(
        vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32), colors=np.zeros((0, 3), np.uint8)
    )


@pytest.fixture(scope="module")
def free() -> FreeSpace:
    """A 6 x 5 m room with a table and a slanted shelf."""
    turned = np.array([0.0, 0.5, 0.0, 0.0, np.sin(0.3), 0.0, np.cos(0.3)])
    block = Asset(
        name="block", mesh=empty_mesh(), shapes=(Box(pose=IDENTITY_POSE, half_extents=np.array([0.6, 0.5, 0.4])),)
    )
    shelf = Asset(name="shelf", mesh=empty_mesh(), shapes=(Box(pose=turned, half_extents=np.array([0.8, 0.5, 0.1])),))
    scene = Scene(
        name="room",
        assets={"block": block, "shelf": shelf},
        instances=(
            Instance(name="table", asset="block", pose=np.array([2.0, 0.5, 2.0, 0, 0, 0, 1.0])),
            Instance(name="shelf", asset="shelf", pose=np.array([4.3, 0.0, 3.2, 0, 0, 0, 1.0])),
        ),
        rooms=(Room(name="room", category="living", rectangles=np.array([[0.0, 0.0, 6.0, 5.0]])),),
    )
    return FreeSpace.from_scene(scene, radius_m=0.25, cache=False)


def clearance(free: FreeSpace, xz: np.ndarray, heading: float) -> float:
    return kernels.least_clearance(free.sdf, free.origin, free.cell_m, *xz, heading, OFFSETS)


def random_starts(free: FreeSpace, rng: np.random.Generator, count: int) -> RobotState:
    state = RobotState.zeros(count)
    for w in range(count):
        while True:
            xz, heading = free.sample(rng, 1)[0], rng.uniform(-np.pi, np.pi)
            if clearance(free, xz, heading) >= SPEC.disc_radius_m:
                break
        state.xz[w], state.heading[w] = xz, heading
    return state


def test_free_motion_is_the_formula(free: FreeSpace) -> None:
    """Habitat's rule: first move along the old heading, then turn (spec/habitat.md 0)."""
    state = RobotState.zeros(1)
    state.xz[0], state.heading[0] = (3.5, 1.0), 0.3
    kernels.drive_robots(state, free, np.array([[0.5, -0.4]]), SPEC)
    expected = np.array([3.5, 1.0]) + 0.5 * 2.5 * STEP_S * np.array([np.cos(0.3), -np.sin(0.3)])
    np.testing.assert_allclose(state.xz[0], expected, atol=1e-12)
    np.testing.assert_allclose(state.heading[0], 0.3 - 0.4 * 2.5 * STEP_S, atol=1e-12)
    assert not state.contact[0]


def test_ten_habitat_units_are_two_and_a_half_metres_per_second(free: FreeSpace) -> None:
    state = RobotState.zeros(1)
    state.xz[0], state.heading[0] = (3.0, 0.8), 0.0
    kernels.drive_robots(state, free, np.array([[1.0, 0.0]]), SPEC)
    assert state.xz[0, 0] - 3.0 == pytest.approx(10 / 120)


def test_commands_are_clipped(free: FreeSpace) -> None:
    a, b = RobotState.zeros(1), RobotState.zeros(1)
    for state, action in ((a, [[1.0, 1.0]]), (b, [[50.0, 7.0]])):
        state.xz[0] = (3.0, 0.8)
        kernels.drive_robots(state, free, np.array(action), SPEC)
    np.testing.assert_array_equal(a.xz, b.xz)


@pytest.mark.parametrize("action", [[[np.nan, 0.0]], [[0.0, np.inf]], [1.0, 0.0], np.zeros((2, 2)), np.zeros((1, 3))])
def test_actions_that_are_none_are_refused(free: FreeSpace, action: object) -> None:
    state = RobotState.zeros(1)
    state.xz[0] = (3.0, 0.8)
    with pytest.raises(InputError, match=r"H3-SIM-03(4|5)"):
        kernels.drive_robots(state, free, np.array(action), SPEC)
    np.testing.assert_array_equal(state.xz, [[3.0, 0.8]])


def test_no_command_changes_nothing(free: FreeSpace) -> None:
    state = random_starts(free, np.random.default_rng(3), 5)
    before = state.copy()
    kernels.drive_robots(state, free, np.zeros((5, 2)), SPEC)
    np.testing.assert_array_equal(state.xz, before.xz)
    np.testing.assert_array_equal(state.heading, before.heading)


def test_the_base_never_enters_an_obstacle(free: FreeSpace) -> None:
    rng = np.random.default_rng(0)
    state = random_starts(free, rng, 50)
    touched = 0
    for _ in range(400):
        before = state.copy()
        # mostly full speed ahead: the worst case
        action = np.stack([rng.choice([1.0, 1.0, -1.0, 0.5], 50), rng.uniform(-1, 1, 50)], -1)
        kernels.drive_robots(state, free, action, SPEC)
        touched += int(state.contact.sum())
        moved = np.hypot(*(state.xz - before.xz).T)
        assert moved.max() < 2.5 * STEP_S + 2 * SPEC.disc_radius_m * 2.5 * STEP_S + 0.01
        least = min(clearance(free, state.xz[w], state.heading[w]) for w in range(50))
        assert least >= SPEC.disc_radius_m - SPEC.clearance_tolerance_m - 1e-9
    assert touched > 100  # it did meet walls


def test_sliding_along_a_wall(free: FreeSpace) -> None:
    state = RobotState.zeros(1)
    state.xz[0], state.heading[0] = (1.0, 0.5), 0.5  # forward and into the wall at z = 0
    for _ in range(20):
        kernels.drive_robots(state, free, np.array([[1.0, 0.0]]), SPEC)
    assert state.xz[0, 0] > 2.0
    assert state.contact[0]


def test_many_worlds_are_one_world_many_times(free: FreeSpace) -> None:
    rng = np.random.default_rng(1)
    robots, people = random_starts(free, rng, 8), HumanState.zeros(8)
    singles = [(robots.take([w]), people.take([w])) for w in range(8)]
    for _ in range(100):
        action = rng.uniform(-1.5, 1.5, (8, 2))
        goal = rng.uniform(0.5, 4.5, (8, 2))
        kernels.drive_robots(robots, free, action, SPEC)
        gait.walk_humans(people, goal, WalkerSpec())
        for w, (robot, person) in enumerate(singles):
            kernels.drive_robots(robot, free, action[w : w + 1], SPEC)
            gait.walk_humans(person, goal[w : w + 1], WalkerSpec())
    for many, alone in zip((robots, people), zip(*singles, strict=True), strict=True):
        for name, array in vars(many).items():
            np.testing.assert_array_equal(array, np.concatenate([getattr(s, name) for s in alone]), err_msg=name)


def test_compiled_is_the_readable_reference(free: FreeSpace) -> None:
    @njit(error_model="numpy")
    def driven(*args):  # no kernel, so Python cannot call it
        return kernels.drive_base(*args)

    rng = np.random.default_rng(2)
    state = random_starts(free, rng, 40)
    for w in range(40):
        args = (
            free.sdf,
            free.origin,
            free.cell_m,
            *state.xz[w],
            state.heading[w],
            rng.uniform(-2.5, 2.5),
            0.5 * (w % 2),
            rng.uniform(-2.5, 2.5),
            0.2,
            OFFSETS,
            0.25,
            3,
            2e-3,
            1e-5,
            0.3 if w % 3 else math.inf,
        )
        np.testing.assert_allclose(driven(*args), kernels.drive_base.py_func(*args), atol=1e-12)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3.1, 3.1))
def test_the_walker_arrives_without_overshoot(x: float, z: float, heading: float) -> None:
    spec = WalkerSpec(speed_mps=1.3)
    state, goal = HumanState.zeros(1), np.array([[x, z]])
    state.heading[0] = heading
    distance = np.hypot(x, z)
    for _ in range(300):
        before = state.copy()
        gait.walk_humans(state, goal, spec)
        left = np.hypot(*(state.xz[0] - goal[0]))
        assert left <= np.hypot(*(before.xz[0] - goal[0])) + 1e-12
        walked = state.distance[0] - before.distance[0]
        assert walked <= spec.speed_mps * STEP_S + 1e-12
        assert 0.0 <= state.blend[0] <= 1.0
    assert left <= spec.arrive_m
    assert state.distance[0] == pytest.approx(max(distance - left, 0.0), abs=1e-9)


def test_quaternions_do_not_jump_where_a_heading_would_wrap(free: FreeSpace) -> None:
    """docs/conventions.md: signs continuous in time, through several whole turns of robot and human."""
    robot, person = RobotState.zeros(1), HumanState.zeros(1)
    robot.xz[0] = person.xz[0] = center = 1.0, 4.0
    quats = []
    for k in range(400):
        kernels.drive_robots(robot, free, np.array([[0.0, -1.0]]), SPEC)
        goal = np.add(center, 5.0 * np.array([np.cos(k / 15), np.sin(k / 15)]))
        gait.walk_humans(person, goal[None], WalkerSpec(speed_mps=0.1))
        quats.append(quat_from_heading([robot.heading[0], person.heading[0]]))
    assert (np.abs([robot.heading[0], person.heading[0]]) > 4 * np.pi).all()
    assert (np.sum(np.array(quats)[1:] * np.array(quats)[:-1], axis=-1) > 0.99).all()
