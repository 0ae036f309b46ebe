"""Half joints: their frames and weights, and the shape of bent limbs that they keep."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.bending import ANGLES_DEG, bent, kept
from h3data.bodies import JOINT_INDEX, Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.skeleton import HALF_JOINTS, JOINT_COUNT, PARENTS
from h3data.bodies.people.skinning import with_half_joints

JOINTS = list(HALF_JOINTS.values())


@pytest.fixture(scope="module")
def body() -> Humanoid:
    return load_humanoid("female_1")


def random_frames(body: Humanoid, count: int) -> np.ndarray:
    """Joint frames [N, 55, 4, 4] of random poses whose joints are turned by less than 160 degrees from rest."""
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(count, 54, 3))
    turns *= np.radians(rng.uniform(0, 110, (count, 54, 1))) / np.linalg.norm(turns, axis=-1, keepdims=True)
    quats = Rotation.from_rotvec(turns.reshape(-1, 3)).as_quat().reshape(count, 54, 4)
    return body.joint_matrices_free(np.tile([0, 1.0, 0, 0, 0, 0, 1], (count, 1)), quats)


def test_a_half_joint_is_turned_half_as_far_as_its_joint_from_rest(body: Humanoid) -> None:
    frames = random_frames(body, 20)
    found = body.skin_frames(frames)
    assert found.shape == (20, JOINT_COUNT + len(HALF_JOINTS), 4, 4)
    np.testing.assert_allclose(found[:, :JOINT_COUNT], frames, atol=1e-6)
    for k, joint in enumerate(JOINTS):
        half, rest = found[:, JOINT_COUNT + k], np.linalg.inv(body.inverse_bind)[:, :3, :3]
        straight = frames[:, PARENTS[joint], :3, :3] @ rest[PARENTS[joint]].T @ rest[joint]
        bend = Rotation.from_matrix(frames[:, joint, :3, :3] @ straight.swapaxes(1, 2)).as_rotvec()
        expected = Rotation.from_rotvec(bend / 2).as_matrix() @ straight
        np.testing.assert_allclose(half[:, :3, :3], expected, atol=1e-6)
        np.testing.assert_allclose(half[:, :3, 3], frames[:, joint, :3, 3], atol=1e-6)


def test_joints_bent_by_180_degrees_and_absent_people_have_frames_of_their_own(body: Humanoid) -> None:
    frames = bent(body, "elbow", 180 - 37)  # the rest mesh has bent elbows
    assert np.isfinite(body.skin_frames(frames)).all()
    assert np.isfinite(body.skin_frames(bent(body, "knee", 180))).all()
    assert np.isnan(body.skin(frames * np.nan)).all()


def test_weights_of_two_neighbours_go_to_the_joint_between_them() -> None:
    knee, hip = JOINT_INDEX["left_knee"], JOINT_INDEX["left_hip"]
    half = JOINT_COUNT + list(HALF_JOINTS).index("left_knee_half")
    joints = np.tile([hip, knee, 0, 0], (4, 1))
    weights = np.array([[0.75, 0.25, 0, 0], [0.5, 0.5, 0, 0], [0.25, 0.75, 0, 0], [0, 1, 0, 0]], np.float32)
    found = with_half_joints(joints, weights)
    dense = np.zeros((4, JOINT_COUNT + len(HALF_JOINTS)))
    np.add.at(dense, (np.arange(4)[:, None], found.joints), found.weights)
    np.testing.assert_allclose(
        dense[:, [hip, half, knee]], [[0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]], atol=1e-6
    )


def test_skirts_between_both_legs_keep_their_weights() -> None:
    legs = [JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]
    weights = np.array([[0.5, 0.25, 0.25, 0]], np.float32)
    found = with_half_joints(np.array([[0, *legs, 0]]), weights)
    np.testing.assert_array_equal(found.weights[found.weights > 0], weights[weights > 0])
    assert found.joints.max() < JOINT_COUNT


@pytest.mark.parametrize("name", humanoid_names())
def test_bodies_have_whole_weights_and_move_rigidly_where_one_joint_moves_them(name: str) -> None:
    part = load_humanoid(name).lod
    found = part.influences
    np.testing.assert_allclose(found.weights.sum(1), 1, atol=1e-6)
    assert (found.weights >= 0).all()
    alone = (part.weights > 1 - 1e-6).any(1)
    assert (found.weights[alone].max(1) > 1 - 1e-6).all()
    assert (found.joints[alone, found.weights[alone].argmax(1)] == part.owners[alone]).all()
    # each half joint has skin to move
    assert set(range(JOINT_COUNT, JOINT_COUNT + len(HALF_JOINTS))) <= set(found.joints[found.weights > 0.2].tolist())


def test_bent_knees_and_shoulders_keep_more_of_their_section_than_plain_skin(body: Humanoid) -> None:
    for joint, least in (("knee", 0.85), ("elbow", 0.75), ("shoulder", 0.6)):
        plain, new = (kept(body, joint, plain=plain)[:, 0] for plain in (True, False))
        assert len(new) == len(ANGLES_DEG)
        assert (new > plain).all(), joint
        assert (new > least).all(), joint
