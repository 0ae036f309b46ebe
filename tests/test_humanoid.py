"""Baked people: what their files hold, skinning against the plain definition, capsules around the skin."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from h3data.bodies import JOINT_INDEX, JOINT_NAMES, Humanoid, load_humanoid
from h3data.bodies.skinning import apply_skin_dense
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data.geometry import ground_pose, normalized, pose_from_matrix, quat_from_heading, quat_to_matrix

BODIES = ("female_0", "male_0")
ROOT = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
UNIT = np.array([0, 0, 0, 1.0])


@pytest.fixture(params=BODIES)
def body(request: pytest.FixtureRequest) -> Humanoid:
    return load_humanoid(request.param)


def _random_free_pose(count: int, *, spread: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    root = np.concatenate([rng.uniform(-3, 3, (count, 3)), normalized(rng.normal(size=(count, 4)))], axis=1)
    return root, normalized(UNIT + spread * rng.normal(size=(count, 54, 4)))


def _standing(body: Humanoid) -> np.ndarray:
    quats, pelvis = body.clip_pose([0], [0.0])
    return body.joint_matrices(ROOT, quats, pelvis)


@pytest.mark.parametrize("lod", [True, False])
def test_sparse_skinning_equals_the_plain_definition(body: Humanoid, lod: bool) -> None:
    joints = body.joint_matrices_free(*_random_free_pose(35 if lod else 3))  # 35: more than one chunk
    part = body.lod if lod else body.full
    expected = apply_skin_dense(part.mesh.vertices, part.joints, part.weights, joints @ body.inverse_bind)
    np.testing.assert_allclose(body.skin(joints, lod=lod), expected, atol=5e-6)


def test_bind_pose_gives_the_rest_mesh_back(body: Humanoid) -> None:
    bind = np.linalg.inv(body.inverse_bind)[None]
    np.testing.assert_allclose(body.skin(bind, lod=False)[0], body.mesh.vertices, atol=2e-6)
    np.testing.assert_allclose(body.skin_normals(bind)[0], body.lod_mesh.normals, atol=1e-5)


def test_zero_pose_is_a_t_pose_in_the_body_frame(body: Humanoid) -> None:
    quats = np.tile(UNIT, (1, 54, 1))
    joints = body.joint_matrices_free(np.array([[0, 1.0, 0, 0, 0, 0, 1]]), quats)[0]
    np.testing.assert_allclose(joints[:, :3, :3], np.tile(np.eye(3), (55, 1, 1)), atol=1e-12)
    place = {name: joints[k, :3, 3] for k, name in enumerate(JOINT_NAMES)}
    for near, far in (("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist")):
        np.testing.assert_allclose(normalized(place[far] - place[near]), [1, 0, 0], atol=1e-6)  # +X is left
    np.testing.assert_allclose(normalized(place["right_wrist"] - place["right_elbow"]), [-1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(normalized(place["left_ankle"] - place["left_hip"]), [0, -1, 0], atol=1e-6)
    assert place["left_foot"][2] > place["left_ankle"][2] + 0.05  # +Z is forward


def test_standing_person_faces_x_and_stands_on_the_floor(body: Humanoid) -> None:
    joints = _standing(body)[0]
    vertices = body.skin(joints[None], lod=False)[0]
    left, right = joints[JOINT_INDEX["left_hip"], :3, 3], joints[JOINT_INDEX["right_hip"], :3, 3]
    assert left[2] < -0.05 < 0.05 < right[2]  # z is right
    assert joints[JOINT_INDEX["left_foot"], 0, 3] > joints[JOINT_INDEX["left_ankle"], 0, 3]  # x is forward
    assert abs(vertices[:, 1].min()) < 0.005
    assert 0.97 * body.height_m < vertices[:, 1].max() < body.height_m + 0.05  # soles and hair on top
    assert abs(joints[0, 0, 3]) < 0.05
    assert abs(joints[0, 2, 3]) < 1e-6


def test_agent_root_moves_the_whole_person_rigidly(body: Humanoid) -> None:
    quats, pelvis = body.clip_pose([2], [0.3])
    here = body.skin(body.joint_matrices(ROOT, quats, pelvis))[0]
    there = body.skin(body.joint_matrices(ground_pose(np.array([[2.0, -1.0]]), np.array([0.7]), 0.5), quats, pelvis))[0]
    turn = quat_to_matrix(quat_from_heading(0.7))
    np.testing.assert_allclose(there, here @ turn.T + [2, 0.5, -1], atol=1e-5)


def test_free_form_repeats_a_clip_pose(body: Humanoid) -> None:
    quats, pelvis = body.clip_pose([1, 3], [0.2, 0.9])
    base = ground_pose(np.array([[1.0, 2.0], [0.0, 0.5]]), np.array([1.1, -2.0]))
    driven = body.joint_matrices(base, quats, pelvis)
    free = body.joint_matrices_free(pose_from_matrix(driven[:, 0]), quats[:, 1:])
    np.testing.assert_allclose(free, driven, atol=1e-12)


def test_rest_mesh_is_sound(body: Humanoid) -> None:
    for part in (body.full, body.lod):
        mesh = part.mesh
        np.testing.assert_allclose(part.weights.sum(1), 1, atol=1e-6)
        assert part.joints.max() < len(JOINT_NAMES)
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
        a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
        volume = np.sum(a * np.cross(b, c)) / 6
        assert 0.03 < volume < 0.12  # positive: the faces look outward
    assert 2500 < len(body.lod_mesh.vertices) < 3600


def test_every_garment_is_there_and_hems_are_level(body: Humanoid) -> None:
    regions, vertices = body.full.regions, body.mesh.vertices
    index = {name: k for k, name in enumerate(body.region_names)}
    for name in ("skin", "shirt", "trousers", "socks", "shoes", "soles", "hair", "sclera", "iris"):
        assert np.count_nonzero(regions == index[name]) > 30, name
    trousers, shirt = vertices[regions == index["trousers"], 1], vertices[regions == index["shirt"], 1]
    assert abs(trousers.max() - shirt.min()) < 0.02
    assert vertices[regions == index["hair"], 1].max() == vertices[:, 1].max()


def test_lod_lies_on_the_full_mesh(body: Humanoid) -> None:
    from scipy.spatial import KDTree

    joints = _standing(body)
    distance, _ = KDTree(body.skin(joints, lod=False)[0]).query(body.skin(joints, lod=True)[0])
    assert np.median(distance) < 0.004
    assert distance.max() < 0.03


def test_capsules_enclose_most_of_the_skin(body: Humanoid) -> None:
    quats, pelvis = body.clip_pose([0, 2, 5], [0, 0.15, 0.6])
    joints = body.joint_matrices(np.tile(ROOT, (3, 1)), quats, pelvis)
    vertices = body.skin(joints, lod=False).astype(np.float64)
    start, end, radius = body.capsules_world(joints)
    assert start.shape == (3, 18, 3)
    way = end - start
    for t in range(3):
        along = np.einsum("vcj,cj->vc", vertices[t][:, None] - start[t], way[t]) / np.maximum(
            np.sum(way[t] ** 2, -1), 1e-12
        )
        nearest = start[t] + np.clip(along, 0, 1)[..., None] * way[t]
        outside = (np.linalg.norm(vertices[t][:, None] - nearest, axis=-1) - radius).min(axis=1)
        assert np.mean(outside > 0.01) < 0.20
        assert np.percentile(outside, 99) < 0.035
        assert outside.max() < 0.08  # a bun, a finger tip
    assert radius.min() > 0.02
    assert radius.max() < 0.25


def test_loading_is_shared_and_light() -> None:
    assert load_humanoid("female_0") is load_humanoid("female_0")
    assert builtin_path("bodies/female_0.npz").stat().st_size < 700_000
    code = (
        "import sys; from h3data.bodies import load_humanoid, load_robot; load_humanoid('female_0'); load_robot('quad_arm');"
        "sys.exit(len({'trimesh', 'numba', 'torch', 'scipy'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_phenotype_is_stored(body: Humanoid) -> None:
    assert body.phenotype["gender"] in (0, 1)
    assert 0 < body.phenotype["height"] < 1


def test_unknown_body_names_what_there_is() -> None:
    with pytest.raises(InputError, match=r"No built-in humanoid 'nobody'.*female_0"):
        load_humanoid("nobody")


def test_files_of_another_kind_are_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="found none"):
        load_humanoid(tmp_path / "none.npz")
    garbage = tmp_path / "garbage.npz"
    garbage.write_bytes(b"PK\x03\x04 not really a zip")
    with pytest.raises(FormatError, match=r"Expected a humanoid file"):
        load_humanoid(garbage)
    other = tmp_path / "other.npz"
    np.savez(other, a=np.zeros(3))
    with pytest.raises(FormatError, match="another npz file"):
        load_humanoid(other)
    with np.load(builtin_path("bodies/female_0.npz")) as file:
        data = {k: file[k] for k in file.files if k != "capsule_joints"}
    partial = tmp_path / "partial.npz"
    np.savez(partial, **data)
    with pytest.raises(FormatError, match="lacks the array 'capsule_joints'"):
        load_humanoid(partial)
    np.savez(tmp_path / "pickled.npz", **(data | {"format": np.array({"a": 1}, dtype=object)}))
    with pytest.raises(FormatError):
        load_humanoid(tmp_path / "pickled.npz")
