"""A robot picks and places only where no wall or furniture is between its shoulder and the thing."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.bodies import load_robot
from h3data.geometry import pose_to_matrix
from h3data.scene import FreeSpace, Scene
from h3data.scene.records import Box, instance_matrix
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.robots.arm_clearance import CLEARANCE, ArmClearance, arm_clearance
from sim_kinematic.agents.robots.hand_reach import HAND_REACH
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.skills import Action, Objects
from sim_kinematic.agents.stands import robot_stands
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.motion.state import NOBODY, WorldState
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from tests.simulated import rearrange_episode, simulate_rearrange


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=1))


@pytest.fixture(scope="module")
def world(home: Scene) -> RearrangeEpisode:
    return rearrange_episode(home, seed=3, free=FreeSpace.from_scene(home, radius_m=0.25, cache=False))


def behind_walls(free: FreeSpace, way: ArmClearance, height: float) -> tuple[np.ndarray, np.ndarray]:
    """A stand and a point that its hand would reach on the free floor of the other side of something."""
    rng = np.random.default_rng(0)
    while True:
        stand = np.append(free.sample(rng, 1)[0], rng.uniform(-np.pi, np.pi))
        distance = HAND_REACH.distances_m[6]
        xz = stand[:2] + distance * np.array([np.cos(stand[2]), -np.sin(stand[2])])
        point = np.array([xz[0], free.floor_y + height, xz[1]])
        if (
            free.is_navigable(xz[None])[0]
            and free.geodesic(stand[:2], xz) > 2 * distance
            and not way.is_open(stand, point)
        ):
            return stand, point


def inside_boxes(scene: Scene, points: np.ndarray) -> bool:
    """Whether any point [N, 3] is more than a millimetre deep in a box of the static scene."""
    for instance in scene.static_instances:
        for shape in scene.assets[instance.asset].shapes:
            if isinstance(shape, Box):
                frame = instance_matrix(instance) @ pose_to_matrix(shape.pose)
                local = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(frame).T
                if (np.abs(local[:, :3]) < shape.half_extents - 1e-3).all(1).any():
                    return True
    return False


def test_what_is_open_is_what_no_box_of_the_home_is_in_the_way_of(home: Scene, world: RearrangeEpisode) -> None:
    robot, free = world.robot, world.free
    way = arm_clearance(home, robot, free.floor_y)
    rng = np.random.default_rng(1)
    found = {True: 0, False: 0}
    for place in free.sample(rng, 60):
        stand = np.append(place, rng.uniform(-np.pi, np.pi))
        c, s = np.cos(stand[2]), np.sin(stand[2])
        ahead, height = rng.uniform(0.5, 1.1), rng.uniform(0.3, 1.2)
        point = np.array([place[0] + c * ahead, free.floor_y + height, place[1] - s * ahead])
        from_x = 0.292  # the shoulder of quad_arm
        level = np.linspace(from_x, ahead, 400)
        line = np.stack(
            [place[0] + c * level, np.full(400, point[1] + CLEARANCE.approach_m), place[1] - s * level], axis=1
        )
        column = np.tile(line[0], (400, 1))
        column[:, 1] = np.linspace(free.floor_y + 0.608, line[0, 1], 400)
        samples = np.vstack([line, column])
        is_open = way.is_open(stand, point)
        found[is_open] += 1
        if is_open:
            assert not inside_boxes(home, samples)
    assert min(found.values()) > 10


def test_who_stands_behind_a_wall_does_not_pick(home: Scene, world: RearrangeEpisode) -> None:
    body, free = load_robot("quad_arm"), world.free
    way = arm_clearance(home, body, free.floor_y)
    stand, point = behind_walls(free, way, 0.9)
    state = WorldState.zeros(1, robots=1, people=1, joints=len(body.rest), objects=1)
    state.robots[0].joints[0] = body.rest
    state.robots[0].xz[0], state.robots[0].heading[0] = stand[:2], stand[2]
    state.object_pose[0, 0] = [*point, 0, 0, 0, 1]
    objects = Objects(("cup",), point[None], state)
    for clearance, reason in ((way, "no_room"), (None, "")):
        robot = RobotActor(body, free, BaseSpec(), objects, 0.15, 8.0, arm_clearance=clearance)
        assert robot.infeasible(Action("pick", 0)) == reason
        objects.held_by[0] = robot.number
        state.grip_pose[0, 0] = [0, 0, 0, 0, 0, 0, 1]
        assert robot.infeasible(Action("place", 0)) == reason
        objects.held_by[0] = NOBODY


@pytest.mark.parametrize("seed", [3, 4])
def test_episodes_are_picked_and_placed_on_the_same_side(home: Scene, world: RearrangeEpisode, seed: int) -> None:
    played = world if seed == world.seed else rearrange_episode(home, seed=seed, free=world.free)
    way = arm_clearance(home, played.robot, played.free.floor_y)
    for target in played.targets:
        for point in (target.start[:3], target.goal):
            stands = robot_stands(played.free, played.robot, played.spec.robot, point)
            assert any(way.is_clear(stand, point) for stand in stands)
    recording = simulate_rearrange(played.played_by("robot"), policy="both", solo_steps=1)
    names = [t.name for t in played.targets]
    moves = [e for e in recording.events if e.kind in ("pick", "place")]
    assert {e.kind for e in moves} == {"pick", "place"}
    for event in moves:
        pose = recording.columns["agent_0.base_pose"][event.step].astype(np.float64)
        heading = 2 * np.arctan2(pose[4], pose[6])
        there = recording.columns["object_pose"][event.step, names.index(event.target), :3]
        assert way.is_open(np.array([pose[0], pose[2], heading]), there.astype(np.float64))
