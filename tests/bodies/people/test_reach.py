"""Reaching: the hand is there, the feet are not elsewhere, nothing breaks, and a refusal says what to do."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.bodies import JOINT_INDEX, Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.kernels import reach as kernel
from h3data.bodies.people.reach import (
    HANDS,
    STATUSES,
    Hand,
    hand_points,
    reach,
    reach_poses,
    reach_table,
    reacher,
)
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, pose_inverse, pose_to_matrix, transform_points
from tests.bodies.people.everybody import EVERYBODY

BODIES = humanoid_names()
ROOT = IDENTITY_POSE[None]
MIRROR = np.array([1.0, 1.0, -1.0])
POINTS = st.tuples(st.floats(0.0, 0.65), st.floats(0.03, 1.45), st.floats(-0.2, 0.58))
"""Forward, up and towards the hand's side, in heights of the shoulder."""


def _target(body: Humanoid, hand: Hand, point: tuple[float, float, float]) -> np.ndarray:
    return np.array(point) * (1, 1, 1 if hand == "right" else -1) * reacher(body, hand).body.scale


@cache
def _many(name: str, hand: Hand) -> np.ndarray:
    """3,000 points of the box."""
    low, table = reach_table().low, reach_table()
    high = low + table.step * (np.array(table.values.shape[:3]) - 1)
    left, up, forward = np.random.default_rng(3).uniform(low, high, (3000, 3)).T
    side = -left if hand == "right" else left
    return np.stack([forward, up, side], axis=1) * reacher(load_humanoid(name), hand).body.scale


@pytest.mark.parametrize("name", EVERYBODY)
@pytest.mark.parametrize("hand", HANDS)
def test_hand_is_at_the_target_and_feet_stay(name: str, hand: Hand) -> None:
    body, targets = load_humanoid(name), _many(name, hand)
    poses = reach_poses(body, targets, hand)
    good = poses.status == kernel.REACHED
    assert good.mean() > (0.58 if name.startswith("older") else 0.62)  # who stoops reaches less
    joints = body.joint_matrices(ROOT, poses.quats, poses.pelvis)
    assert np.linalg.norm(hand_points(joints, body, hand) - targets, axis=1)[good].max() < 1e-6
    standing = body.joint_matrices(ROOT, *body.clip_pose([0], [0.0]))
    for side in ("left", "right"):  # whatever the status
        for part in ("ankle", "foot"):
            joint = JOINT_INDEX[f"{side}_{part}"]
            np.testing.assert_allclose(
                joints[:, joint, :3], np.broadcast_to(standing[0, joint, :3], (3000, 3, 4)), atol=1e-5
            )
    np.testing.assert_allclose(np.linalg.norm(poses.quats, axis=-1), 1, atol=1e-9)


@pytest.mark.parametrize("name", EVERYBODY)
def test_joints_stay_within_their_limits(name: str) -> None:
    body = load_humanoid(name)
    poses = reach_poses(body, _many(name, "right"))
    quats = poses.quats[poses.status == kernel.REACHED]
    elbow = quats[:, JOINT_INDEX["right_elbow"]]
    flexion = np.degrees(2 * np.arctan2(elbow[:, 1], elbow[:, 3]))
    assert flexion.min() > 1.9
    assert flexion.max() < 146
    for side in ("left", "right"):
        knee = quats[:, JOINT_INDEX[f"{side}_knee"]]
        assert np.abs(knee[:, 1:3]).max() < 1e-12  # a hinge
        flexion = np.degrees(2 * np.arctan2(knee[:, 0], knee[:, 3]))
        assert flexion.min() > 0
        assert flexion.max() < 132.1
    for joint, limit in (
        ("spine1", 33),
        ("spine2", 33),
        ("spine3", 33),
        ("right_collar", 36),
        ("neck", 36),
        ("head", 42),
    ):
        q = quats[:, JOINT_INDEX[joint]]
        assert np.degrees(2 * np.arccos(np.minimum(np.abs(q[:, 3]), 1))).max() < limit


@pytest.mark.parametrize("name", EVERYBODY)
def test_nobody_falls_over_or_reaches_through_herself(name: str) -> None:
    """By the body's own capsules and an own sum of segment masses, not by the kernel's measures."""
    body = load_humanoid(name)
    poses = reach_poses(body, _many(name, "right"))
    good = poses.status == kernel.REACHED
    joints = body.joint_matrices(ROOT, poses.quats[good], poses.pelvis[good])
    start, end, radius = body.capsules_world(joints)
    volume = np.pi * radius**2 * np.linalg.norm(end - start, axis=-1) + 4 / 3 * np.pi * radius**3
    mass_center = np.einsum("tc,tcx->tx", volume, (start + end) / 2) / volume.sum(axis=1)[:, None]
    toes, heels = joints[0, JOINT_INDEX["left_foot"], 0, 3] + 0.04, joints[0, JOINT_INDEX["left_ankle"], 0, 3] - 0.06
    assert mass_center[:, 0].max() < toes
    assert mass_center[:, 0].min() > heels
    share = np.linspace(0, 1, 9)[:, None]
    elbow, wrist = (joints[:, None, JOINT_INDEX[f"right_{part}"], :3, 3] for part in ("elbow", "wrist"))
    forearm = elbow + share * (wrist - elbow)
    for k, capsule in enumerate(body.capsules):
        if capsule.name in ("pelvis", "abdomen", "chest_low", "chest_high", "left_thigh", "right_thigh", "head"):
            a, b = start[:, None, k], end[:, None, k]
            along = np.clip(np.sum((forearm - a) * (b - a), -1) / np.sum((b - a) ** 2, -1).clip(1e-12), 0, 1)
            assert (np.linalg.norm(forearm - a - along[..., None] * (b - a), axis=-1) - radius[k]).min() > 0.005


@pytest.mark.parametrize("name", EVERYBODY)
def test_left_is_the_mirror_image_of_right(name: str) -> None:
    body, targets = load_humanoid(name), _many(name, "right")[:300]
    right, left = reach_poses(body, targets, "right"), reach_poses(body, targets * MIRROR, "left")
    good = (right.status == kernel.REACHED) & (left.status == kernel.REACHED)
    assert np.mean(right.status == left.status) > 0.98  # the fitted capsules differ by a millimetre
    there = body.joint_matrices(ROOT, right.quats, right.pelvis)[..., :3, 3]
    here = body.joint_matrices(ROOT, left.quats, left.pelvis)[..., :3, 3]
    here, there = here[good], there[good]
    for joint in ("pelvis", "spine3", "head"):
        np.testing.assert_allclose(here[:, JOINT_INDEX[joint]], there[:, JOINT_INDEX[joint]] * MIRROR, atol=1e-4)
    for joint in ("knee", "elbow", "wrist", "index3"):
        mirrored = there[:, JOINT_INDEX[f"right_{joint}"]] * MIRROR
        np.testing.assert_allclose(here[:, JOINT_INDEX[f"left_{joint}"]], mirrored, atol=1e-4)


@given(st.sampled_from(BODIES), st.sampled_from(HANDS), POINTS, POINTS)
def test_straight_lines_are_smooth(name: str, hand: Hand, start: tuple, end: tuple) -> None:
    body = load_humanoid(name)
    a, b = _target(body, hand, start), _target(body, hand, end)
    steps = max(int(np.linalg.norm(b - a) / 0.01), 2)  # a centimetre a step
    poses = reach_poses(body, a + np.linspace(0, 1, steps)[:, None] * (b - a), hand)
    good = poses.status == kernel.REACHED
    both = good[1:] & good[:-1]
    turn = 2 * np.degrees(np.arccos(np.minimum(np.abs(np.sum(poses.quats[1:] * poses.quats[:-1], axis=-1)), 1)))
    assert turn[both].max(initial=0) < 18  # 9 in 95 % of all lines; most where hand and shoulder are near
    assert np.linalg.norm(np.diff(poses.pelvis, axis=0), axis=1)[both].max(initial=0) < 0.02


@pytest.mark.parametrize("name", EVERYBODY)
@pytest.mark.parametrize("hand", HANDS)
def test_the_hanging_hand_is_the_standing_pose(name: str, hand: Hand) -> None:
    body = load_humanoid(name)
    rest = reacher(body, hand).rest
    poses = reach_poses(body, rest[None], hand, trunk=0.0, arm=0.0)
    quats, pelvis = body.clip_pose([0], [0.0])
    np.testing.assert_allclose(np.abs(np.sum(poses.quats * quats, axis=-1)), 1, atol=1e-9)
    np.testing.assert_allclose(poses.pelvis, pelvis, atol=1e-9)
    if name != "child_0":  # whose hand hangs 2 cm within the capsule of the hip; 1.2 are let pass
        assert reach(body, rest, hand).reached


@given(
    st.sampled_from(BODIES),
    st.sampled_from(HANDS),
    st.tuples(st.floats(-3, 3), st.floats(-0.5, 3), st.floats(-3, 3)),
)
def test_refusals_come_with_advice(name: str, hand: Hand, target: tuple) -> None:
    body = load_humanoid(name)
    answer = reach(body, target, hand)
    joints = body.joint_matrices(ROOT, answer.quats[None], answer.pelvis[None])
    palm = hand_points(joints, body, hand)[0]
    assert answer.status in STATUSES
    np.testing.assert_allclose(palm, answer.nearest_valid, atol=1e-6)
    assert np.linalg.norm(palm - target) == pytest.approx(answer.hand_error_m, abs=1e-6)
    assert reach(body, answer.nearest_valid, hand).reached
    if answer.base_motion is None:
        assert not 0.05 * body.height_m < target[1] < 1.1 * body.height_m
    else:
        moved = pose_to_matrix(pose_inverse(answer.base_motion.of(IDENTITY_POSE)))
        assert reach(body, transform_points(moved, np.array([target]))[0], hand).reached


@given(st.sampled_from(BODIES), POINTS)
def test_nearest_valid_is_near(name: str, point: tuple) -> None:
    """No sampled valid point is much nearer."""
    body = load_humanoid(name)
    target = _target(body, "right", point)
    answer = reach(body, target)
    others = _many(name, "right")[reach_poses(body, _many(name, "right")).status == kernel.REACHED]
    assert answer.hand_error_m < np.linalg.norm(others - target, axis=1).min() + 0.03


def test_each_refusal_has_its_name() -> None:
    body = load_humanoid("female_0")
    found = {
        reach(body, target).status
        for target in ([0.4, 1.0, 0.2], [2.0, 1.0, 0.0], [0.0, 1.05, 0.0], [0.85, 1.2, 0.4], [-1.0, 1.0, 0.0])
    }
    assert found == set(STATUSES)
    assert reach(body, [0.3, 4.0, 0.0]).base_motion is None
    near = reach(body, [0.4, 1.0, 0.2])
    assert near.hand_error_m == 0
    assert near.base_motion == (0, 0, 0)


def test_the_head_looks_where_the_hand_goes() -> None:
    body = load_humanoid("neutral_0")
    for target in ([0.5, 0.3, 0.2], [0.5, 1.2, -0.2], [0.2, 1.3, 0.6]):
        result = reach(body, target)
        head = body.joint_matrices(ROOT, result.quats[None], result.pelvis[None])[0, JOINT_INDEX["head"]]
        standing = body.joint_matrices(ROOT, *body.clip_pose([0], [0.0]))[0, JOINT_INDEX["head"]]
        way, before = target - head[:3, 3], target - standing[:3, 3]
        assert head[:3, 2] @ way / np.linalg.norm(way) > standing[:3, 2] @ before / np.linalg.norm(before) + 0.05


def test_bad_input_is_refused() -> None:
    body = load_humanoid("female_0")
    with pytest.raises(InputError, match="H3-BODY-083"):
        reach(body, [np.nan, 1, 0])
    with pytest.raises(InputError, match="H3-BODY-083"):
        reach_poses(body, [[1, 2]])
    with pytest.raises(InputError, match="H3-BODY-080"):
        reach(body, [[0.3, 1, 0]])
    with pytest.raises(InputError, match="H3-BODY-081"):
        reach(body, [0.3, 1, 0], "both")  # type: ignore[arg-type]


def test_palms_face_each_other_side() -> None:
    """The grasp point is on the inner side of the hanging hand."""
    body = load_humanoid("male_1")
    joints = body.joint_matrices(ROOT, *body.clip_pose([0], [0.0]))
    for hand, sign in (("right", -1), ("left", 1)):
        wrist = joints[0, JOINT_INDEX[f"{hand}_wrist"]]
        middle = joints[0, JOINT_INDEX[f"{hand}_middle1"], :3, 3]
        offset = hand_points(joints, body, hand)[0] - (wrist[:3, 3] + 0.9 * (middle - wrist[:3, 3]))
        assert offset[2] * sign > 0.01


@pytest.mark.slow
def test_the_table_is_what_the_bake_solves() -> None:
    from bake.people.reach import SOLVED_FOR, solve_table
    from h3data.bodies.people.reach import reach_body

    solved = solve_table(tuple(reach_body(load_humanoid(name), "right") for name in SOLVED_FOR))
    shipped = reach_table()
    assert solved.values.shape == shipped.values.shape
    assert np.quantile(np.abs(solved.values - shipped.values), 0.99) < 0.02  # rounding differs between machines
