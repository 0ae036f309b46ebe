"""Arms, grips and what they touch: limits hold, held things are rigid with the hand, one world is as many."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.bodies import Robot, load_robot
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, ground_pose, pose_from_matrix, pose_inverse, pose_multiply
from h3data.scene import Asset, Box, Instance, Mesh, Scene
from h3data_motion.amass import quat_from_rotvec
from h3data_pipelines.machine.arm_contact import ArmContact, touch_events
from sim_kinematic.agents import manipulation
from sim_kinematic.agents.manipulation import carry_objects, grip_objects, move_arms, robot_hands
from sim_kinematic.motion.spec import ArmSpec
from sim_kinematic.motion.state import HUMAN, NOBODY, ROBOT, RobotState, WorldState

SPEC = ArmSpec()
REACH_OUT = np.array([0.0, -1.2, 0.0, 1.6, 0.0, -0.4, 0.0])


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("quad_arm")


def standing(robot: Robot, worlds: int, objects: int = 2, seed: int = 0) -> WorldState:
    """Robots at random with stretched arms; the first object lies in the hand's reach, the others far away."""
    rng = np.random.default_rng(seed)
    state = WorldState.zeros(worlds, joints=len(robot.joint_names), objects=objects)
    state.robots[0].xz[:], state.robots[0].heading[:] = rng.uniform(-3, 3, (worlds, 2)), rng.uniform(-9, 9, worlds)
    state.robots[0].joints[:] = robot.rest
    state.robots[0].joints[:, robot.arm_columns] = REACH_OUT + rng.uniform(-0.2, 0.2, (worlds, 7))
    state.object_pose[..., 3:] = quat_from_rotvec(rng.uniform(-2, 2, (worlds, objects, 3)))
    state.object_pose[..., :3] = [0, 50, 0]
    if objects:
        state.object_pose[:, 0, :3] = robot_hands(state.robots[0], robot)[:, :3, 3] + rng.uniform(
            -0.08, 0.08, (worlds, 3)
        )
    return state


def test_the_arm_is_what_moves_the_hand(robot: Robot) -> None:
    assert [robot.joint_names[c] for c in robot.arm_columns] == [f"arm_{k}" for k in range(7)]
    lift = load_robot("lift_arm")
    names = [lift.joint_names[c] for c in lift.arm_columns]
    assert names == ["lift", "arm_extend", "wrist_yaw", "wrist_pitch", "wrist_roll"]


def test_a_joint_moves_by_its_share_of_a_step(robot: Robot) -> None:
    state = standing(robot, 1)
    before = state.robots[0].joints.copy()
    move_arms(state.robots[0], robot, [[1.0, -1.0, 0.5, 0.0, 7.0, -0.1, 0.0]], SPEC)
    moved = (state.robots[0].joints - before)[0]
    np.testing.assert_allclose(moved[:7], np.array([0.05, -0.05, 0.025, 0.0, 0.05, -0.005, 0.0]), atol=1e-15)
    assert not moved[7:].any()


@given(st.integers(0, 2**32 - 1))
def test_joints_stay_inside_their_limits(seed: int) -> None:
    robot, rng = load_robot("quad_arm"), np.random.default_rng(seed)
    state = standing(robot, 4, seed=seed % 100)
    push = rng.choice([-1.0, 1.0], (4, 7))
    for _ in range(150):
        move_arms(state.robots[0], robot, push, SPEC)
        assert (state.robots[0].joints >= robot.lower).all()
        assert (state.robots[0].joints <= robot.upper).all()
    limit = np.where(push > 0, robot.upper[:7], robot.lower[:7])
    np.testing.assert_array_equal(state.robots[0].joints[:, :7], limit)


def test_a_hand_takes_what_is_near_and_carries_it_rigidly(robot: Robot) -> None:
    state = standing(robot, 8)
    turned = state.object_pose[:, 0, 3:].copy()
    grip_objects(state, robot_hands(state.robots[0], robot), np.ones(8), SPEC)
    assert (state.held_by[:, 0] == ROBOT).all()
    assert (state.held_by[:, 1] == NOBODY).all()
    hands = robot_hands(state.robots[0], robot)
    np.testing.assert_allclose(state.object_pose[:, 0, :3], hands[:, :3, 3], atol=1e-12)  # it snapped
    np.testing.assert_allclose(np.abs(np.sum(turned * state.object_pose[:, 0, 3:], -1)), 1.0, atol=1e-12)
    in_hand = pose_multiply(pose_inverse(pose_from_matrix(hands)), state.object_pose[:, 0])
    rng = np.random.default_rng(1)
    for _ in range(30):
        state.robots[0].xz[:] += rng.uniform(-0.1, 0.1, (8, 2))
        state.robots[0].heading[:] += rng.uniform(-0.1, 0.1, 8)
        move_arms(state.robots[0], robot, rng.uniform(-1, 1, (8, 7)), SPEC)
        carry_objects(state, robot_hands(state.robots[0], robot))
    hands = pose_from_matrix(robot_hands(state.robots[0], robot))
    now = pose_multiply(pose_inverse(hands), state.object_pose[:, 0])
    np.testing.assert_allclose(now[:, :3], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(now[:, 3:] * in_hand[:, 3:], -1)), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(state.object_pose[:, 0, 3:], axis=-1), 1.0, atol=1e-9)


def test_what_is_let_go_stays_where_it_is(robot: Robot) -> None:
    state = standing(robot, 3)
    grip_objects(state, robot_hands(state.robots[0], robot), [1.0, 1.0, 1.0], SPEC)
    grip_objects(state, robot_hands(state.robots[0], robot), [0.0, -1.0, 1.0], SPEC)
    assert state.held_by[:, 0].tolist() == [ROBOT, NOBODY, ROBOT]
    left = state.object_pose[1].copy()
    state.robots[0].xz[:] += 1.0
    carry_objects(state, robot_hands(state.robots[0], robot))
    np.testing.assert_array_equal(state.object_pose[1], left)
    assert (np.abs(state.object_pose[[0, 2], 0] - left[0]) > 1e-3).any()


def test_out_of_reach_or_in_anothers_hand_it_is_not_taken(robot: Robot) -> None:
    state = standing(robot, 2)
    hands = robot_hands(state.robots[0], robot)
    state.object_pose[0, 0, :3] = hands[0, :3, 3] + [0, SPEC.grasp_m + 1e-6, 0]
    state.held_by[1, 0] = HUMAN
    grip_objects(state, hands, [1.0, 1.0], SPEC)
    assert state.held_by[:, 0].tolist() == [NOBODY, HUMAN]
    state.object_pose[0, 0, :3] = hands[0, :3, 3] + [0, SPEC.grasp_m - 1e-6, 0]
    grip_objects(state, hands, [1.0, 1.0], SPEC)
    assert state.held_by[:, 0].tolist() == [ROBOT, HUMAN]


def test_one_hand_holds_one_thing_and_takes_the_nearest(robot: Robot) -> None:
    state = standing(robot, 1, objects=3)
    hand = robot_hands(state.robots[0], robot)
    state.object_pose[0, :, :3] = hand[0, :3, 3] + np.array([[0.0, 0.12, 0.0], [0.0, 0.05, 0.0], [0.1, 0.0, 0.0]])
    for _ in range(2):
        grip_objects(state, hand, [1.0], SPEC)
        assert state.held_by[0].tolist() == [NOBODY, ROBOT, NOBODY]


def test_one_world_is_as_many(robot: Robot) -> None:
    many = standing(robot, 64, objects=3)
    singles = [many.take([w]) for w in range(64)]
    rng = np.random.default_rng(5)
    for _ in range(20):
        arm, grip = rng.uniform(-1, 1, (64, 7)), rng.choice([-1.0, 0.0, 1.0], 64)
        for state, rows in [(many, slice(None)), *((s, slice(w, w + 1)) for w, s in enumerate(singles))]:
            move_arms(state.robots[0], robot, arm[rows], SPEC)
            grip_objects(state, robot_hands(state.robots[0], robot), grip[rows], SPEC)
    assert (many.held_by == ROBOT).any()
    for array, *alone in zip(many.arrays(), *(s.arrays() for s in singles), strict=True):
        np.testing.assert_array_equal(array, np.concatenate(alone))


@pytest.mark.parametrize("action", [np.full((2, 7), np.nan), np.zeros((2, 6)), np.zeros(7), np.zeros((1, 7))])
def test_arm_actions_that_are_none_are_refused(robot: Robot, action: np.ndarray) -> None:
    state = standing(robot, 2)
    before = state.robots[0].joints.copy()
    with pytest.raises(InputError, match=r"H3-SIM-0(07|10)"):
        move_arms(state.robots[0], robot, action, SPEC)
    np.testing.assert_array_equal(state.robots[0].joints, before)


@pytest.mark.parametrize("action", [[1.0, np.nan], [1.0], [[1.0], [1.0]], [1.0, np.inf]])
def test_grip_actions_that_are_none_are_refused(robot: Robot, action: object) -> None:
    state = standing(robot, 2)
    with pytest.raises(InputError, match=r"H3-SIM-0(07|10)"):
        grip_objects(state, robot_hands(state.robots[0], robot), np.array(action), SPEC)
    assert (state.held_by == NOBODY).all()


def test_states_without_joints_and_robots_without_hands_are_told(robot: Robot) -> None:
    with pytest.raises(InputError, match=r"(?s)joints=20.*H3-SIM-008"):
        move_arms(RobotState.zeros(1), robot, np.zeros((1, 7)), SPEC)


def test_compiled_is_the_readable_reference(robot: Robot) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        args = (*rng.uniform(-3, 3, 2), 0.05, -1.0, 2.0)
        assert manipulation.step_joint(*args) == manipulation.step_joint.py_func(*args)
    state = standing(robot, 20, objects=3)
    for w, hand in enumerate(robot_hands(state.robots[0], robot)):
        args = (hand, state.object_pose[w], state.held_by[w], NOBODY)
        assert manipulation.nearest_free(*args) == pytest.approx(manipulation.nearest_free.py_func(*args))


# --- contact ------------------------------------------------------------------------------------------------------------
def shelf(depth_m: float, hand: np.ndarray) -> Scene:
    """A box whose near side is ``depth_m`` behind the point of a hand that looks along x."""
    mesh = Mesh(
        vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32), colors=np.zeros((0, 3), np.uint8)
    )
    box = Box(pose=IDENTITY_POSE, half_extents=np.array([0.5, 0.5, 0.5]))
    pose = np.array([hand[0] - depth_m + 0.5, hand[1], hand[2], 0, 0, 0, 1.0])
    return Scene(
        name="one",
        assets={"box": Asset(name="box", mesh=mesh, shapes=(box,))},
        instances=(Instance(name="shelf", asset="box", pose=pose),),
    )


def test_a_held_box_in_a_shelf_is_as_deep_as_it_is(robot: Robot) -> None:
    state = standing(robot, 1)
    state.robots[0].xz[:], state.robots[0].heading[:] = 0.0, 0.0
    hand = robot_hands(state.robots[0], robot)[0, :3, 3]
    held = (Box(pose=IDENTITY_POSE, half_extents=np.array([0.6, 0.03, 0.03])),)  # reaches 0.6 m ahead of the hand
    base, joints = ground_pose([0.0, 0.0], 0.0), state.robots[0].joints[0]
    pose = np.array([*hand, 0, 0, 0, 1.0])
    for depth in (-0.05, 0.0005, 0.04, 0.2):  # the shelf's side is 0.6 m - depth ahead
        touches = ArmContact(shelf(depth - 0.6, hand), robot).touches(
            base, joints, held="mug", shapes=held, held_pose=pose
        )
        if depth < 1e-3:
            assert not touches
        else:
            assert [(t.part, t.thing) for t in touches] == [("mug", "shelf")]
            assert touches[0].depth_m == pytest.approx(min(depth, 0.53), abs=1e-9)


def test_an_arm_in_a_shelf_is_told_once(robot: Robot) -> None:
    state = standing(robot, 1)
    state.robots[0].xz[:], state.robots[0].heading[:] = 0.0, 0.0
    hand = robot_hands(state.robots[0], robot)[0, :3, 3]
    contact = ArmContact(shelf(0.1, hand), robot)
    base = ground_pose([0.0, 0.0], 0.0)
    touches = contact.touches(base, state.robots[0].joints[0])
    assert {t.part for t in touches} >= {"arm_hand"}
    assert touches[0].depth_m > 0.05
    assert not contact.touches(ground_pose([-1.0, 0.0], 0.0), state.robots[0].joints[0])
    events = touch_events(touches, [], step=3, agent=ROBOT)
    assert [(e.step, e.kind, e.target) for e in events] == [(3, "contact", "shelf")] * len(touches)
    assert not touch_events(touches, touches, step=4, agent=ROBOT)
