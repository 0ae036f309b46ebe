"""How a robot's base gets to a place, and out of a person's way."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from shapely.geometry import box

from h3data.bodies import load_robot
from h3data.geometry import IDENTITY_POSE
from h3data.scene import FreeSpace
from h3data.scene.freespace.build import build_from_walkable
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.robots.driving import ARRIVED_M
from sim_kinematic.agents.robots.skills import ARM_OUT_M, RobotActor
from sim_kinematic.agents.skills import Action, Objects, SkillResult
from sim_kinematic.agents.stands import robot_stands
from sim_kinematic.avoidance.robot_base import CARRIED_M, base_of, carrying_base_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.yielding import RULES, discs_to_avoid
from sim_kinematic.motion.spec import HOME_BASE, STEP_S, BaseSpec
from sim_kinematic.motion.state import NOBODY, WorldState
from tests.sim.avoidance.commands import Seen, neighbours


@pytest.fixture(scope="module")
def free() -> FreeSpace:
    return FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)), radius_m=0.25)


def robot_at(free: FreeSpace, xz: np.ndarray, heading: float, base: BaseSpec = BaseSpec()) -> RobotActor:  # noqa: B008
    body = load_robot("quad_arm")
    state = WorldState.zeros(1, robots=1, people=1, joints=len(body.rest), objects=1)
    state.robots[0].joints[0] = body.rest
    state.robots[0].xz[0], state.robots[0].heading[0] = xz, heading
    return RobotActor(body, free, base, Objects(("cup",), np.zeros((1, 3), np.float64), state), 0.15, 8.0)


def roomiest(free: FreeSpace) -> np.ndarray:
    places = free.sample(np.random.default_rng(0), 400)
    return places[int(np.argmax(free.signed_distance(places)))]


@pytest.mark.parametrize("distance", [0.06, 0.12, 0.2, 0.35])
def test_it_turns_to_a_near_point_instead_of_driving_round_it(free: FreeSpace, distance: float) -> None:
    at = roomiest(free)
    for bearing in np.linspace(-3.0, 3.0, 9):
        robot = robot_at(free, at, 0.4)
        goal = at + distance * np.array([np.cos(0.4 + bearing), -np.sin(0.4 + bearing)])
        steps, left = 0, distance
        while left > ARRIVED_M and steps < 75:
            robot._drive(goal, left)
            steps, left = steps + 1, float(np.hypot(*(goal - robot.xz)))
        assert left <= ARRIVED_M


def beside(xz: np.ndarray) -> Any:
    """A company of one person who has settled."""
    around = neighbours(Seen(xz, settled=True))
    return SimpleNamespace(agreed=False, around=lambda _: around, meets=lambda _: False)


def test_who_waits_gets_out_of_the_way_of_a_person_who_is_near(free: FreeSpace) -> None:
    at = roomiest(free)
    near, far = (at + np.array([d, 0.0]) for d in (1.0, AVOIDANCE.retreat_m + 0.5))
    for person, moves in ((near, True), (far, False)):
        robot = robot_at(free, at, 0.0)
        robot.company = beside(person)
        for _ in robot.start(Action("wait", steps=90)):
            pass
        assert (np.hypot(*(robot.xz - at)) > 0.3) == moves
        assert np.hypot(*(robot.xz - person)) >= np.hypot(*(at - person))


def test_who_holds_something_has_not_settled(free: FreeSpace) -> None:
    robot = robot_at(free, roomiest(free), 0.0)
    robot.company, held_by = beside(robot.xz + 1.0), robot.objects.held_by
    for holder in (NOBODY, 1):
        held_by[0] = holder
        rows = discs_to_avoid(*robot.xz, *robot.others[:3], held_by, False, 0.3, RULES)
        assert rows[0, 6] == (holder == NOBODY)


def test_an_interrupted_pick_folds_the_arm(free: FreeSpace) -> None:
    robot = robot_at(free, roomiest(free), 0.0)
    robot.objects.poses[0, :3] = [robot.xz[0] + 0.6, free.floor_y + 0.6, robot.xz[1]]
    pick = robot.start(Action("pick", 0))
    for _ in range(5):
        next(pick)
    assert np.abs(robot.joints - robot.robot.rest).max() > 0.1
    pick.close()
    for _ in range(60):
        robot.idle()
    np.testing.assert_allclose(robot.joints, robot.robot.rest, atol=1e-6)


@pytest.mark.parametrize("forward", [1.0, 0.0])
def test_what_it_carries_stays_out_of_walls(free: FreeSpace, forward: float) -> None:
    """It used to get 7 cm into walls that the base drove up to, and 11 cm into those beside which it turned."""
    for heading in np.linspace(-np.pi, np.pi, 12):
        robot = robot_at(free, roomiest(free), float(heading), HOME_BASE)
        robot.objects.held_by[0] = robot.number
        for k in range(240):
            robot._step(forward, 0.3 if k % 60 < 20 else 0.0, avoid=False)
            if forward == 0.0:
                robot._step(1.0 if k % 60 > 30 else 0.0, 1.0, avoid=False)
            assert free.signed_distance(robot.hand_pose[[0, 2]]) >= CARRIED_M - 0.01
        robot.objects.held_by[0] = -1
        robot._step(0.0, 0.0)
        assert robot.base is HOME_BASE


def test_where_there_is_no_room_for_what_it_has_taken_the_base_is_free_to_leave(free: FreeSpace) -> None:
    robot = robot_at(free, roomiest(free), 0.0, HOME_BASE)
    for _ in range(200):  # up to a wall with an empty hand
        robot._step(1.0, 0.0, avoid=False)
    robot.objects.held_by[0] = robot.number
    start = robot.xz.copy()
    for _ in range(30):
        robot._step(-1.0, 0.0, avoid=False)
    assert np.hypot(*(robot.xz - start)) > 0.5
    assert robot.base == carrying_base_of(robot.robot, HOME_BASE)


@pytest.mark.parametrize("name", ["quad_arm", "lift_arm"])
def test_bases_cover_what_robots_carry(name: str) -> None:
    robot = load_robot(name)
    base = base_of(robot, HOME_BASE)
    carrying = carrying_base_of(robot, base)
    hand = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0, robot.hand_link]
    ahead, _, aside = hand[:3, 3] + hand[:3, :3] @ robot.hand_position
    gaps = np.hypot(np.array(carrying.disc_offsets_m) - ahead, aside)
    assert gaps.min() + CARRIED_M <= carrying.disc_radius_m + 0.01
    assert set(base.disc_offsets_m) < set(carrying.disc_offsets_m)


def test_what_it_carries_is_brought_to_where_it_has_room_without_it() -> None:
    """`lift_arm` with a box is 0.44 m long ahead: where it could not turn with it, it said `no_way` for the whole episode."""
    lane = FreeSpace.from_map(
        build_from_walkable(box(0, 0, 5, 0.84), radius_m=0.25, height_m=1.41, max_climb_m=0.2, cell_m=0.05)
    )
    body = load_robot("lift_arm")
    state = WorldState.zeros(1, robots=1, people=1, joints=len(body.rest), objects=1)
    robot = RobotActor(
        body, lane, base_of(body, HOME_BASE), Objects(("box",), np.array([[3.5, 0.6, 0.42]]), state), 0.15, 8.0
    )
    robot.joints[:], robot.xz[:] = body.rest, (1.0, 0.42)
    robot.objects.held_by[0], robot.objects.state.grip_pose[0, 0] = robot.number, IDENTITY_POSE
    robot._choose_base()
    assert not len(robot_stands(lane, body, robot.base, robot.objects.goals[0]))

    def go() -> Iterator[None]:
        ends.append((yield from robot.start(Action("nav_to_goal", 0))))

    ends: list[SkillResult] = []
    for _ in zip(range(300), go(), strict=False):
        pass
    assert [end.outcome for end in ends] == ["done"]


def test_habitats_base_stays_as_it_is() -> None:
    robot = load_robot("quad_arm")
    assert carrying_base_of(robot, BaseSpec()) == BaseSpec()


def test_it_stands_until_its_arm_is_folded(free: FreeSpace) -> None:
    """Robots drove off with the arm out: the hand was 6 cm in the wall that they turned towards."""
    robot = robot_at(free, roomiest(free), 0.0, HOME_BASE)
    thing = [robot.xz[0] + 0.75, free.floor_y + 0.6, robot.xz[1]]
    robot.objects.poses[0] = [*thing, 0, 0, 0, 1]
    for _ in robot.start(Action("pick", 0)):
        pass
    assert robot.objects.held(robot.number) == 0
    robot.objects.goals[0] = [robot.xz[0], free.floor_y + 0.6, robot.xz[1] + 1.5]
    start, out = robot.xz.copy(), []
    for k, _ in enumerate(robot.start(Action("nav_to_goal", 0))):
        far = np.hypot(*(robot.hand_pose[[0, 2]] - robot.xz))
        if far > robot._folded_m + ARM_OUT_M:
            out.append(k)
            np.testing.assert_array_equal(robot.xz, start)
        if k > 40:
            break
    assert out
    assert np.hypot(*(robot.xz - start)) > 0.1


@pytest.mark.parametrize("base", [HOME_BASE, BaseSpec()])
def test_robots_of_our_own_episodes_set_off_and_brake_gradually(base: BaseSpec) -> None:
    """The paper's base is at full speed in one step."""
    hall = FreeSpace.from_map(
        build_from_walkable(box(0, 0, 8, 3), radius_m=0.25, height_m=1.41, max_climb_m=0.2, cell_m=0.05)
    )
    robot, goal = robot_at(hall, np.array([1.0, 1.5]), 0.3, base), np.array([6.5, 1.5])
    places = [robot.xz.copy(), *(robot.xz.copy() for _ in robot.drive_to(goal))]
    speeds = np.hypot(*np.diff(places, axis=0).T) / STEP_S
    assert np.hypot(*(robot.xz - goal)) <= ARRIVED_M
    assert speeds.max() > 2.4
    gradual = np.diff(speeds, prepend=0.0).max() <= AVOIDANCE.accel_mps2 * STEP_S + 1e-3
    assert gradual == (base is HOME_BASE)
    assert (speeds[-1] < 0.7) == (base is HOME_BASE)


def test_primitives_are_as_long_as_habitats(free: FreeSpace) -> None:
    robot = robot_at(free, roomiest(free), 0.0, HOME_BASE)
    start = robot.xz.copy()
    for _ in robot.start(Action("move_forward")):
        pass
    assert np.hypot(*(robot.xz - start)) == pytest.approx(1 / 3, abs=1e-3)
