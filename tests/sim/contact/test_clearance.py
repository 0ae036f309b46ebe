"""Contact between robot and person: against points sampled on the robot, and that no gate hides one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.geometry import ground_pose, pose_to_matrix, transform_points
from h3data.scene import Box, Capsule, FreeSpace, Shape
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.contact import MovingShapes, collide
from sim_kinematic.contact.clearance import RobotHumanContact, clip_reach, robot_reach
from sim_kinematic.contact.frames import body_shapes, shape_frames
from sim_kinematic.world import DriveCommand, WaypointCommand, World


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("quad_arm")


@pytest.fixture(scope="module")
def human() -> Humanoid:
    return load_humanoid("female_0")


def surface(shape: Shape, rng: np.random.Generator, n: int = 250) -> np.ndarray:
    """Random points [n, 3] on the surface of a box or capsule, asset frame."""
    if isinstance(shape, Capsule):
        axis = np.asarray(shape.end) - shape.start
        out = rng.normal(size=(n, 3))
        out *= shape.radius / np.linalg.norm(out, axis=1, keepdims=True)
        return shape.start + rng.random((n, 1)) * axis + out
    assert isinstance(shape, Box)
    points = rng.uniform(-1, 1, (n, 3))
    face = rng.integers(0, 3, n)
    points[np.arange(n), face] = np.sign(points[np.arange(n), face])
    return transform_points(pose_to_matrix(shape.pose), points * shape.half_extents)


def capsules(human: Humanoid, base: np.ndarray, frame: tuple[int, float, float]) -> tuple[np.ndarray, ...]:
    pose = human.clip_pose(*([value] for value in frame))
    start, end, radius = human.capsules_world(human.joint_matrices(base[None], *pose))
    return start[0], end[0], radius


def test_contact_is_what_sampled_surfaces_say(robot: Robot, human: Humanoid) -> None:
    rng = np.random.default_rng(0)
    contact = RobotHumanContact(robot, human)
    points = [surface(s, rng) for link in robot.links for s in link.shapes]
    at = [k for k, link in enumerate(robot.links) for _ in link.shapes]
    seen = {True: 0, False: 0}
    for _ in range(100):
        apart, angle, turn, turn_h = rng.uniform(
            [0.3, -np.pi, -np.pi, -np.pi], [contact.gate_m + 0.1, np.pi, np.pi, np.pi]
        )
        robot_base = ground_pose(np.zeros(2), turn, 0.0).astype(np.float32)
        human_base = ground_pose(apart * np.array([np.cos(angle), np.sin(angle)]), turn_h, 0.0).astype(np.float32)
        frame = int(rng.integers(len(human.clips))), rng.random(), rng.random()
        links = robot.link_matrices(robot_base[None], robot.rest[None])[0]
        cloud = np.concatenate([transform_points(links[k], p) for k, p in zip(at, points, strict=True)])
        start, end, radius = capsules(human, human_base, frame)
        axis = end - start
        along = np.einsum("pcj,cj->pc", cloud[:, None] - start, axis) / np.maximum((axis**2).sum(1), 1e-12)
        nearest = start + np.clip(along, 0, 1)[..., None] * axis
        gap = (np.linalg.norm(cloud[:, None] - nearest, axis=-1) - radius).min()
        if -1e-3 < gap < 0.04:  # samples are centimetres apart
            continue
        touching = bool(contact.touching(robot_base[None], human_base[None], *map(np.atleast_1d, frame))[0])
        assert touching == (gap < 0), (apart, gap)
        seen[touching] += 1
    assert min(seen.values()) > 12


def test_the_gate_holds_both_bodies(robot: Robot, human: Humanoid) -> None:
    rng = np.random.default_rng(1)
    home = ground_pose(np.zeros(2), 0.0, 0.0)
    links = robot.link_matrices(home[None], robot.rest[None])[0]
    for link, matrix in zip(robot.links, links, strict=True):
        for shape in link.shapes:
            points = transform_points(matrix, surface(shape, rng))
            assert np.hypot(points[:, 0], points[:, 2]).max() <= robot_reach(robot, robot.rest)
    for _ in range(200):
        frame = int(rng.integers(len(human.clips))), rng.random(), rng.random()
        start, end, radius = capsules(human, home, frame)
        for ends in (start, end):
            assert (np.hypot(ends[:, 0], ends[:, 2]) + radius).max() <= clip_reach(human)


def test_a_stretched_arm_reaches_farther(robot: Robot, human: Humanoid) -> None:
    stretched = robot.rest.copy()
    stretched[:7] = 0.0
    assert RobotHumanContact(robot, human, stretched).gate_m > RobotHumanContact(robot, human).gate_m + 0.2


def test_many_cases_are_those_of_each(robot: Robot, human: Humanoid) -> None:
    contact = RobotHumanContact(robot, human)
    rng = np.random.default_rng(8)
    n = 60
    robots = ground_pose(rng.uniform(-0.1, 0.1, (n, 2)), rng.uniform(-np.pi, np.pi, n))
    people = ground_pose(rng.uniform(-1.2, 1.2, (n, 2)), rng.uniform(-np.pi, np.pi, n))
    clip, phase, blend = np.full(n, human.clip_for_speed(1.3)), rng.random(n), rng.random(n)
    together = contact.touching(robots, people, clip, phase, blend)
    each = [
        bool(contact.touching(*(value[None] for value in case))[0])
        for case in zip(robots, people, clip, phase, blend, strict=True)
    ]
    assert together.tolist() == each
    assert 5 < together.sum() < n - 5
    assert contact.touching(robots[:0], people[:0], clip[:0], phase[:0], blend[:0]).shape == (0,)


def test_bones_touch_less_than_bodies_and_never_alone(robot: Robot, human: Humanoid) -> None:
    body, bones = RobotHumanContact(robot, human), RobotHumanContact(robot, human, person_contact="bones")
    assert bones.gate_m < body.gate_m
    rng, n = np.random.default_rng(3), 400
    robots = ground_pose(np.zeros((n, 2)), rng.uniform(-np.pi, np.pi, n))
    people = ground_pose(rng.uniform(-1.0, 1.0, (n, 2)), rng.uniform(-np.pi, np.pi, n))
    clip, phase, blend = np.full(n, human.clip_for_speed(2.5)), rng.random(n), rng.random(n)
    whole, thin = (contact.touching(robots, people, clip, phase, blend) for contact in (body, bones))
    assert (thin & ~whole).sum() <= 2  # fingers may stand out of the capsule of a hand
    assert 20 < thin.sum() < whole.sum() - 10


@given(away=st.floats(0.0, 1.6), angle=st.floats(-3.2, 3.2), turn=st.floats(-3.2, 3.2), phase=st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_no_gate_hides_a_contact_of_bones(away: float, angle: float, turn: float, phase: float) -> None:
    robot, human = load_robot("quad_arm"), load_humanoid("female_0")
    bases = ground_pose(np.zeros(2), 0.0), ground_pose(away * np.array([np.cos(angle), np.sin(angle)]), turn)
    frame = human.clip_for_speed(2.5), phase, 1.0
    links = robot.link_matrices(bases[0][None], robot.rest[None])[0]
    joints = human.joint_matrices(bases[1][None], *human.clip_pose(*([value] for value in frame)))
    first, second = MovingShapes(body_shapes(robot)), MovingShapes(body_shapes(human, "bones"))
    first.set_transforms(shape_frames(robot, links))
    second.set_transforms(shape_frames(human, joints, "bones")[0])
    contact = RobotHumanContact(robot, human, person_contact="bones")
    assert contact.touching(*(base[None] for base in bases), *map(np.atleast_1d, frame))[0] == collide(first, second)


def test_a_world_asks_the_shapes_that_its_rules_name() -> None:
    home = build_home(HomeSpec(seed=1))
    free = FreeSpace.from_scene(home)
    middle = free.sample(np.random.default_rng(0), 1)[0]
    touched = {}
    for person in ("body", "bones"):
        world = World(make_roster(("robot", "human")), worlds=30, person_contact=person)
        starts = np.zeros((30, 2, 3))
        starts[:, 0, :2], starts[:, 1, :2] = middle, middle + np.linspace(0, 1, 30)[:, None] * [1.0, 0.0]
        world.place(starts, [free] * 30)
        world.step([DriveCommand(np.zeros((30, 2))), WaypointCommand(starts[:, 1, :2])])
        touched[person] = int(world.touching.sum())
    assert 5 < touched["bones"] < touched["body"] < 30
