"""Laws of rotations and poses, over random batches and both float types."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from h3data import geometry as g
from h3data_motion.amass import quat_from_rotvec

DTYPES = (np.float32, np.float64)


def random_quats(seed: int, *shape: int) -> np.ndarray:
    return g.normalized(np.random.default_rng(seed).normal(size=(*shape, 4)))


def random_poses(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(-5, 5, (*shape, 3)), random_quats(seed + 1, *shape)], -1)


def same_rotation(a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    return bool(np.all(np.abs(np.abs(np.sum(a * b, -1)) - 1) < tolerance))


@pytest.mark.parametrize("dtype", DTYPES)
def test_matrix_and_quaternion_are_inverse(dtype: type) -> None:
    q = random_quats(0, 1000).astype(dtype)
    m = g.quat_to_matrix(q)
    assert m.dtype == dtype
    back = g.quat_from_matrix(m)
    assert back.dtype == dtype
    assert same_rotation(q, back, 1e-5 if dtype == np.float32 else 1e-12)
    assert np.all(back[..., 3] >= 0)


def test_half_turns_keep_their_axis() -> None:
    # the trace is -1: formulas that divide by w fail here
    for axis in np.eye(3):
        q = np.concatenate([axis, [0.0]])
        assert same_rotation(q, g.quat_from_matrix(g.quat_to_matrix(q)), 1e-12)


def test_product_of_quaternions_is_product_of_matrices() -> None:
    a, b = random_quats(1, 200), random_quats(2, 200)
    np.testing.assert_allclose(
        g.quat_to_matrix(g.quat_multiply(a, b)), g.quat_to_matrix(a) @ g.quat_to_matrix(b), atol=1e-12
    )


def test_rotating_vectors_agrees_with_the_matrix() -> None:
    q, v = random_quats(3, 50), np.random.default_rng(3).normal(size=(50, 3))
    np.testing.assert_allclose(g.quat_rotate(q, v), np.einsum("nij,nj->ni", g.quat_to_matrix(q), v), atol=1e-12)


def test_poses_form_a_group() -> None:
    a, b, c = random_poses(4, 64), random_poses(5, 64), random_poses(6, 64)
    left = g.pose_to_matrix(g.pose_multiply(g.pose_multiply(a, b), c))
    right = g.pose_to_matrix(g.pose_multiply(a, g.pose_multiply(b, c)))
    np.testing.assert_allclose(left, right, atol=1e-11)
    np.testing.assert_allclose(
        g.pose_to_matrix(g.pose_multiply(a, g.pose_inverse(a))), np.broadcast_to(np.eye(4), (64, 4, 4)), atol=1e-12
    )
    np.testing.assert_allclose(
        g.pose_to_matrix(g.pose_from_matrix(g.pose_to_matrix(a))), g.pose_to_matrix(a), atol=1e-12
    )


def test_heading_convention() -> None:
    # 0 faces +X, positive turns left: seen from above with x to the right and z down, left of +X is -Z
    forward = g.quat_rotate(g.quat_from_heading(np.pi / 2), [1.0, 0.0, 0.0])
    np.testing.assert_allclose(forward, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(g.heading_direction(np.pi / 2), [0, -1], atol=1e-12)


@given(st.floats(-3.1, 3.1))
def test_heading_survives_the_quaternion(heading: float) -> None:
    assert abs(float(g.heading_from_quat(g.quat_from_heading(heading))) - heading) < 1e-9


@given(arrays(np.float64, 3, elements=st.floats(-3, 3)))
def test_rotation_vectors(rotvec: np.ndarray) -> None:
    from scipy.spatial.transform import Rotation

    assert same_rotation(quat_from_rotvec(rotvec), Rotation.from_rotvec(rotvec).as_quat(), 1e-9)


def test_signs_are_continuous_and_the_rotation_stays() -> None:
    q = random_quats(7, 1, 3).repeat(50, 0)
    flips = np.random.default_rng(8).choice([-1.0, 1.0], (50, 3, 1))
    out = g.quat_sign_continuous(q * flips)
    assert np.all(np.sum(out[1:] * out[:-1], -1) > 0)
    assert same_rotation(out, q, 1e-12)


def test_blend_takes_the_short_way() -> None:
    a, b = random_quats(9, 40), random_quats(10, 40)
    half = g.quat_nlerp(a, -b, np.full(40, 0.5))
    assert same_rotation(half, g.quat_nlerp(a, b, np.full(40, 0.5)), 1e-12)
    assert same_rotation(g.quat_nlerp(a, b, np.zeros(40)), a, 1e-12)
    assert same_rotation(g.quat_nlerp(a, b, np.ones(40)), b, 1e-12)


@given(st.floats(-100, 100))
def test_wrapped_angles(angle: float) -> None:
    wrapped = float(g.wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert abs(np.sin(wrapped) - np.sin(angle)) < 1e-9


def test_ground_pose_broadcasts() -> None:
    pose = g.ground_pose(np.zeros((4, 5, 2), np.float32), np.zeros((4, 5), np.float32), 0.3)
    assert pose.shape == (4, 5, 7)
    assert pose.dtype == np.float32
    np.testing.assert_allclose(pose[..., 1], 0.3)


def test_cross_products_are_numpys_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    for shape in ((3,), (1, 3), (0, 3), (4, 5, 3)):
        a, b = rng.normal(size=shape), rng.normal(size=3).astype(np.float32)
        np.testing.assert_array_equal(g.cross(a, b), np.cross(a, b))
    with pytest.raises(ValueError, match="unpack"):
        g.cross(np.ones(4), np.ones(4))


@pytest.mark.parametrize(
    "function",
    [
        lambda p, q: g.pose_multiply(p, q),
        lambda p, q: g.pose_inverse(p),
        lambda p, q: g.pose_to_matrix(p),
        lambda p, q: g.quat_multiply(p[..., 3:], q[..., 3:]),
        lambda p, q: g.quat_rotate(p[..., 3:], q[..., :3]),
        lambda p, q: g.quat_from_matrix(g.pose_to_matrix(p)[..., :3, :3]),
        lambda p, q: g.pose_from_matrix(g.pose_to_matrix(p)),
        lambda p, q: g.normalized(p),
        lambda p, q: g.cross(p[..., :3], q[..., :3]),
        lambda p, q: g.heading_from_quat(p[..., 3:]),
    ],
)
def test_one_alone_is_what_it_is_among_many_to_the_bit(function) -> None:
    p, q = random_poses(3, 400), random_poses(5, 400)
    p[::7, 3:], q[::11, :3], p[::13, [3, 5]] = [0, 0, 0, 1], 0, 0
    p[:, 3:] = g.normalized(p[:, 3:])
    many = function(p, q)
    for k in range(len(p)):
        one = np.asarray(function(p[k], q[k]))
        assert one.dtype == many.dtype
        assert one.tobytes() == many[k].tobytes()


def test_one_ground_pose_is_what_it_is_among_many_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    xz, heading = rng.normal(size=(100, 2)), rng.uniform(-9, 9, 100)
    many = g.ground_pose(xz, heading, 0.25)
    for k in range(len(xz)):
        assert g.ground_pose(xz[k], float(heading[k]), 0.25).tobytes() == many[k].tobytes()


@given(st.floats(0, 1))
def test_a_smooth_way_begins_and_ends_at_rest_and_is_symmetric(share: float) -> None:
    assert g.smoothstep(0.0) == 0
    assert g.smoothstep(1.0) == 1
    assert g.smoothstep(share) + g.smoothstep(1 - share) == pytest.approx(1)
    assert g.smoothstep(np.array([share]))[0] == g.smoothstep(share)
    assert abs(g.smoothstep(1e-4)) < 1e-7
