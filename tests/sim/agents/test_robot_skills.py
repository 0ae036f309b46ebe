"""How a robot's base gets to a place, and out of a person's way."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.bodies import load_robot
from h3data.scene import FreeSpace, HomeSpec, build_home
from sim_kinematic.agents.robot_skills import ARRIVED_M, RobotActor
from sim_kinematic.agents.skills import Action, Objects
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.yielding import Seen
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.motion.state import WorldState


@pytest.fixture(scope="module")
def free() -> FreeSpace:
    return FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)), radius_m=0.25)


def robot_at(free: FreeSpace, xz: np.ndarray, heading: float) -> RobotActor:
    body = load_robot("quad_arm")
    state = WorldState.zeros(1, robots=1, people=1, joints=len(body.rest), objects=1)
    state.robots[0].joints[0] = body.rest
    state.robots[0].xz[0], state.robots[0].heading[0] = xz, heading
    return RobotActor(body, free, BaseSpec(), Objects(("cup",), np.zeros((1, 3), np.float64), state), 0.15, 8.0)


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
            error = robot._error_to(goal)
            robot._step(min(robot._no_faster_than(goal, error), left / robot._stride_m), robot._turn(error), goal)
            steps, left = steps + 1, float(np.hypot(*(goal - robot.xz)))
        assert left <= ARRIVED_M


def seen(xz: np.ndarray, *, settled: bool = True) -> Seen:
    return Seen(1, xz, np.zeros(2), settled, False)


def test_who_waits_gets_out_of_the_way_of_a_person_who_is_near(free: FreeSpace) -> None:
    at = roomiest(free)
    near, far = (at + np.array([d, 0.0]) for d in (1.0, AVOIDANCE.retreat_m + 0.5))
    for person, moves in ((near, True), (far, False)):
        robot = robot_at(free, at, 0.0)
        robot.others = (seen(person),)
        for _ in robot.start(Action("wait", steps=90)):
            pass
        assert (np.hypot(*(robot.xz - at)) > 0.3) == moves
        assert np.hypot(*(robot.xz - person)) >= np.hypot(*(at - person))


def test_who_holds_something_has_not_settled(free: FreeSpace) -> None:
    robot = robot_at(free, roomiest(free), 0.0)
    robot.others = (seen(robot.xz + 1.0),)
    assert robot._seen()[0].settled
    robot.objects.held_by[0] = 1
    assert not robot._seen()[0].settled


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
