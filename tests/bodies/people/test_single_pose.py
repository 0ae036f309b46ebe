"""Kernels for a single pose have the bits of NumPy's functions."""

import numpy as np

from h3data.bodies import JOINT_INDEX, load_humanoid
from h3data.bodies.people.kernels.attention import turn_gaze
from h3data.bodies.people.kernels.single_pose import blend_pose, frame_of_joint, hold
from h3data.bodies.people.reach import grasp_point, hand_points
from h3data.geometry import (
    IDENTITY_POSE,
    ground_pose,
    pose_multiply,
    quat_from_heading,
    quat_from_matrix,
    quat_multiply,
    quat_nlerp,
)
from sim_kinematic.agents.person import ARM_CHAINS, seen_from


def turns(rng: np.random.Generator, *shape: int) -> np.ndarray:
    quats = rng.normal(size=(*shape, 4))
    return quats / np.linalg.norm(quats, axis=-1, keepdims=True)


def test_a_single_pose_has_the_bits_of_the_functions_for_many() -> None:
    rng, body, out, held = np.random.default_rng(0), load_humanoid("male_2"), np.empty((55, 4)), np.empty(7)
    for share in (0.0, 1.0, *rng.random(60).tolist()):
        quats, others, pelvis, frame = turns(rng, 55), turns(rng, 55), rng.normal(size=3), np.empty((1, 4, 4))
        heading, stood = float(rng.normal()), turns(rng)
        base, upright = ground_pose(rng.normal(size=2), heading, 0.1), quat_multiply(quat_from_heading(heading), stood)
        blend_pose(quats, others, share, out)
        np.testing.assert_array_equal(out, quat_nlerp(quats, others, np.full(55, share)))
        every = body.joint_matrices(base, quats[None], pelvis[None])
        for side, chain in ARM_CHAINS.items():
            frame_of_joint(base, quats, pelvis, body.joint_offsets, chain, frame[0])
            np.testing.assert_array_equal(frame, every[:, JOINT_INDEX[f"{side}_wrist"]])
            place = (frame[:, :3, :3] @ grasp_point(body, side) + frame[:, :3, 3])[0]
            np.testing.assert_array_equal(place, hand_points(every, body, side)[0])
            grip = np.concatenate([0.05 * rng.normal(size=3), turns(rng)])
            hold(frame[0], place, grip, heading, stood, share, held)
            rigid = pose_multiply(np.concatenate([place, quat_from_matrix(frame[0, :3, :3])]), grip)
            np.testing.assert_array_equal(held, [*rigid[:3], *quat_nlerp(upright, rigid[3:], share)])


def test_a_face_turns_to_a_world_point_as_to_the_same_point_seen_from_the_root() -> None:
    rng = np.random.default_rng(4)
    body = load_humanoid("female_1")
    for looks in (True, False):
        base = ground_pose(rng.uniform(-5, 5, 2), float(rng.uniform(-9, 9)), 0.3)
        (first,), (pelvis,) = body.clip_pose([1], [0.4], [1.0])
        second, gazes, point = first.copy(), np.zeros((2, 6)), base[:3] + rng.uniform(-2, 2, 3)
        for _ in range(8):
            left = turn_gaze(body.joint_offsets, first, pelvis, base, point, looks, 0.01, gazes[0])
            seen = seen_from(base, point)
            assert left == turn_gaze(body.joint_offsets, second, pelvis, IDENTITY_POSE, seen, looks, 0.01, gazes[1])
        assert first.tobytes() == second.tobytes()
        assert gazes[0].tobytes() == gazes[1].tobytes()
