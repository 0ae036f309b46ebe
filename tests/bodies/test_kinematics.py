"""Kinematics as laws: what inverse kinematics finds, forward kinematics confirms; numba is torch; a batch is its rows."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import Robot, load_robot, solve_ik
from h3data.errors import InputError
from h3data.geometry import (
    ground_pose,
    pose_from_matrix,
    pose_multiply,
    pose_to_matrix,
    quat_from_axis_angle,
)

ROOT = np.array([0, 0, 0, 0, 0, 0, 1.0])
LINKS = {"quad_arm": "arm_hand", "lift_arm": "hand"}
seeds = st.integers(0, 2**32 - 1)


@lru_cache
def every_joint_robot(folder: Path) -> Robot:
    """Turns, slides, follows, a ball and fixed ones, with frames that are turned against each other."""
    joints = [
        ("a", "continuous", '<axis xyz="0 1 1"/>'),
        ("b", "prismatic", '<axis xyz="1 0 0.5"/><limit lower="-1" upper="1"/>'),
        ("c", "fixed", ""),
        (
            "d",
            "revolute",
            '<axis xyz="1 2 3"/><limit lower="-2" upper="2"/><mimic joint="ja" multiplier="-0.5" offset="0.3"/>',
        ),
        ("e", "prismatic", '<axis xyz="0 0 1"/><mimic joint="jb" multiplier="2"/>'),
        ("f", "spherical", ""),
        ("g", "revolute", '<axis xyz="0 0 1"/><limit lower="-3" upper="3"/>'),
    ]
    body = '<link name="root"/>'
    parent = "root"
    for k, (name, kind, more) in enumerate(joints):
        body += (
            f'<link name="{name}"/><joint name="j{name}" type="{kind}"><parent link="{parent}"/><child link="{name}"/>'
        )
        body += f'<origin xyz="0.1 {0.05 * k} -0.2" rpy="{0.3 * k} 0.2 -0.1"/>{more}</joint>'
        parent = name if k != 3 else "b"  # a branch
    path = folder / "every.urdf"
    path.write_text(f'<robot name="every">{body}</robot>')
    return load_robot(path, fill_in=False)


def _postures(robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(np.maximum(robot.lower, -3), np.minimum(robot.upper, 3), (count, len(robot.joint_names)))


def _bases(rng: np.random.Generator, count: int) -> np.ndarray:
    return ground_pose(rng.uniform(-5, 5, (count, 2)), rng.uniform(-3, 3, count), rng.uniform(-1, 1, count))


# --- forward ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["quad_arm", "lift_arm", "every"])
def test_torch_equals_numba(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    robot = every_joint_robot(tmp_path_factory.getbasetemp()) if name == "every" else load_robot(name)
    rng = np.random.default_rng(1)
    joints, bases = _postures(robot, rng, 12), _bases(rng, 12)
    expected = robot.link_matrices(bases, joints)
    roots = torch.from_numpy(pose_to_matrix(bases))
    found = robot.link_matrices_torch(roots, torch.from_numpy(joints))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)
    single = robot.link_matrices_torch(roots.float(), torch.from_numpy(joints).float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), expected, atol=2e-5)
    shaped = robot.link_matrices_torch(roots.reshape(3, 4, 4, 4), torch.from_numpy(joints).reshape(3, 4, -1))
    np.testing.assert_allclose(shaped.reshape(expected.shape), expected, atol=1e-12)


@pytest.mark.slow
def test_torch_knows_the_derivative(tmp_path_factory: pytest.TempPathFactory) -> None:
    robot = every_joint_robot(tmp_path_factory.getbasetemp())
    joints = torch.from_numpy(_postures(robot, np.random.default_rng(2), 1)[0]).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda q: robot.link_matrices_torch(torch.eye(4, dtype=torch.float64), q), (joints,)
    )


def test_torch_refuses_other_shapes() -> None:
    with pytest.raises(InputError, match=r"(?s)\[\.\.\., 20\].*quad_arm.*H3-BODY-099"):
        load_robot("quad_arm").link_matrices_torch(torch.eye(4), torch.zeros(7))


@settings(derandomize=True, max_examples=20, deadline=None)
@given(seeds)
def test_a_batch_is_its_rows(seed: int) -> None:
    robot, rng = load_robot("lift_arm"), np.random.default_rng(seed)
    joints, bases = _postures(robot, rng, 3), _bases(rng, 3)
    together = robot.link_matrices(bases, joints)
    for k in range(3):
        np.testing.assert_array_equal(robot.link_matrices(bases[k : k + 1], joints[k : k + 1])[0], together[k])


@settings(derandomize=True, max_examples=20, deadline=None)
@given(seeds, st.floats(1e-7, 1e-3))
def test_links_move_no_faster_than_joints_and_levers_allow(seed: int, step: float) -> None:
    robot, rng = load_robot("quad_arm"), np.random.default_rng(seed)
    joints = _postures(robot, rng, 1)
    near = joints + rng.uniform(-step, step, joints.shape)
    frames = robot.link_matrices(np.stack([ROOT, ROOT]), np.concatenate([joints, near]))
    assert np.abs(frames[1] - frames[0]).max() < 20 * 2 * step  # no lever is longer than 2 m
    turns = frames[..., :3, :3]
    np.testing.assert_allclose(turns @ np.swapaxes(turns, -1, -2) - np.eye(3), 0, atol=1e-12)


# --- inverse ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", sorted(LINKS))
@settings(derandomize=True, max_examples=40, deadline=None)
@given(seed=seeds, heading=st.floats(-3, 3))
def test_a_pose_that_the_hand_can_have_is_found(name: str, seed: int, heading: float) -> None:
    """From the resting posture, wherever the robot stands: within 1 mm and 0.5 deg, inside the limits."""
    robot, link, rng = load_robot(name), LINKS[name], np.random.default_rng(seed)
    joints = robot.clamp(_postures(robot, rng, 1)[0]).positions
    base = ground_pose(rng.uniform(-5, 5, 2), np.float64(heading))
    index = robot.link_index(link)
    target = robot.link_matrices(base[None], joints[None])[0, index]
    found = solve_ik(robot, link, pose_from_matrix(target), base_pose=base)
    assert found.reached
    assert not robot.clamp(found.joint_pos).clamped.any()
    there = robot.link_matrices(base[None], found.joint_pos[None])[0, index]
    assert np.linalg.norm(there[:3, 3] - target[:3, 3]) < 1e-3
    cosine = (np.trace(there[:3, :3].T @ target[:3, :3]) - 1) / 2
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 0.5
    np.testing.assert_allclose(np.linalg.norm(there[:3, 3] - target[:3, 3]), found.position_error_m, atol=1e-9)


@settings(derandomize=True, max_examples=20, deadline=None)
@given(seed=seeds)
def test_many_targets_are_solved_as_one_by_one(seed: int) -> None:
    robot, rng = load_robot("quad_arm"), np.random.default_rng(seed)
    joints = _postures(robot, rng, 4)
    frames = robot.link_matrices(np.tile(ROOT, (4, 1)), joints)
    targets = pose_from_matrix(frames[:, robot.link_index("arm_hand")])
    targets[3, :3] = [9, 9, 9]
    together = solve_ik(robot, "arm_hand", targets.reshape(2, 2, 7), joints[0])
    assert together.joint_pos.shape == (2, 2, 20)
    for k in range(4):
        alone = solve_ik(robot, "arm_hand", targets[k], joints[0])
        np.testing.assert_array_equal(alone.joint_pos, together.joint_pos[k // 2, k % 2])
        assert alone.reached == together.reached[k // 2, k % 2]


@settings(derandomize=True, max_examples=20, deadline=None)
@given(seed=seeds)
def test_where_the_hand_is_already_nothing_moves(seed: int) -> None:
    robot, rng = load_robot("quad_arm"), np.random.default_rng(seed)
    joints = _postures(robot, rng, 1)
    frame = robot.link_matrices(ROOT[None], joints)[0, robot.link_index("arm_hand")]
    np.testing.assert_array_equal(solve_ik(robot, "arm_hand", pose_from_matrix(frame), joints[0]).joint_pos, joints[0])


def test_a_hand_that_is_led_along_a_line_moves_without_jumps() -> None:
    """Each answer starts the next question, without restarts: 1 cm of the hand is a few degrees of the arm."""
    robot = load_robot("quad_arm")
    joints = robot.rest.copy()
    joints[[1, 3, 5]] = [-1.5, 2.0, 0.6]
    hand = robot.link_index("arm_hand")
    pose = pose_from_matrix(robot.link_matrices(ROOT[None], joints[None])[0, hand])
    for _ in range(25):
        pose[:3] += [0.006, -0.004, 0.007]
        found = solve_ik(robot, "arm_hand", pose, joints, restarts=0)
        assert found.reached
        assert np.abs(found.joint_pos - joints).max() < 0.12
        joints = found.joint_pos


def test_a_point_of_the_link_goes_to_a_position() -> None:
    robot = load_robot("quad_arm")
    target = np.array([0.8, 0.5, 0.1])
    found = solve_ik(robot, robot.links[robot.hand_link].name, target, offset=robot.hand_position)
    frame = robot.link_matrices(ROOT[None], found.joint_pos[None])[0, robot.hand_link]
    np.testing.assert_allclose(frame[:3, :3] @ robot.hand_position + frame[:3, 3], target, atol=1e-4)
    assert found.rotation_error_rad == 0
    np.testing.assert_array_equal(found.joint_pos[7:], robot.rest[7:])  # legs and gripper stay


def test_only_the_joints_that_may_move_do() -> None:
    robot = load_robot("lift_arm")
    wrist = robot.link_matrices(ROOT[None], robot.rest[None])[0, robot.link_index("wrist_yaw"), :3, 3]
    found = solve_ik(robot, "wrist_yaw", wrist + np.array([0, 0.2, 0.4]), joints=["lift", "arm_extend"])
    assert found.reached
    assert np.flatnonzero(found.joint_pos != robot.rest).tolist() == [2, 3]
    np.testing.assert_allclose(found.joint_pos[2:4], [0.8, 0.1], atol=1e-3)  # four stages of 0.1 m


@pytest.mark.parametrize("half_turn", [0, 1, 2])
def test_half_a_turn_is_an_error_like_others(half_turn: int) -> None:
    robot = load_robot("quad_arm")
    joints = robot.rest.copy()
    joints[[1, 3]] = [-1.5, 2.0]
    frame = pose_from_matrix(robot.link_matrices(ROOT[None], joints[None])[0, robot.link_index("arm_hand")])
    turned = pose_multiply(frame, np.array([0, 0, 0, *quat_from_axis_angle(np.eye(3)[half_turn], np.pi)]))
    found = solve_ik(robot, "arm_hand", turned, joints, iterations=1, restarts=0)
    assert np.isfinite(found.joint_pos).all()
    assert found.rotation_error_rad <= np.pi + 1e-9


def test_what_is_out_of_reach_is_approached_and_told() -> None:
    robot = load_robot("quad_arm")
    found = solve_ik(robot, "arm_hand", np.array([[5.0, 0.668, 0], [0.6, 0.6, 0]]))
    assert found.reached.tolist() == [False, True]
    straight = 0.3385 + 0.05 + np.hypot(0.4033, 0.075)  # shoulder to elbow to wrist to hand, as far as they stretch
    assert 5.0 - 0.292 - straight - 1e-3 < found.position_error_m[0] < 5.0 - 0.292 - straight + 0.02
    assert found.position_error_m[1] < 1e-4
    lift = solve_ik(load_robot("lift_arm"), "wrist_yaw", np.array([-0.067, 3.0, 0.3]), joints=["lift"])
    assert not lift.reached
    assert np.flatnonzero(lift.clamped).tolist() == [2]
    assert lift.joint_pos[2] == 1.0


BAD = {
    "NaN": ({"target": [np.nan, 0, 0]}, "H3-BODY-087"),
    "shape": ({"target": [0.0, 0]}, r"(?s)\[\.\.\., 3\] or \[\.\.\., 7\].*H3-BODY-087"),
    "quaternion": ({"target": [0, 0, 0, 0, 0, 0, 0.0]}, "H3-BODY-088"),
    "link": ({"link": "tail"}, "(?s)no link 'tail'.*arm_hand.*H3-BODY-096"),
    "base link": ({"link": "base_link"}, "(?s)joints that move base_link.*H3-BODY-089"),
    "joints": ({"joints": ["arm_0", "front_left_knee"]}, "(?s)got front_left_knee.*H3-BODY-089"),
    "q0": ({"q0": np.zeros(7)}, r"(?s)\[\.\.\., 20\].*H3-BODY-100"),
    "q0 NaN": ({"q0": np.full(20, np.nan)}, "H3-BODY-097"),
    "q0 batch": (
        {"q0": np.zeros((3, 20)), "target": np.zeros((2, 3))},
        r"(?s)q0 for \[2\] targets, got \[3\].*H3-BODY-090",
    ),
    "offset": ({"offset": [0, 0]}, "H3-BODY-085"),
    "base": ({"base_pose": [0, 0, 0]}, "H3-BODY-091"),
    "tolerance": ({"tolerance_m": 0.0}, "H3-BODY-086"),
    "iterations": ({"iterations": 0}, "H3-BODY-086"),
}


@pytest.mark.parametrize("case", BAD)
def test_questions_that_make_no_sense_are_refused(case: str) -> None:
    change, message = BAD[case]
    question = {"link": "arm_hand", "target": [0.5, 0.5, 0.0], **change}
    with pytest.raises(InputError, match=message):
        solve_ik(load_robot("quad_arm"), **question)


def test_spherical_joints_are_not_solved_for(tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.raises(InputError, match="H3-BODY-089"):
        solve_ik(every_joint_robot(tmp_path_factory.getbasetemp()), "g", [0, 0, 0.0])
