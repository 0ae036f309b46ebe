"""Baked people: what their files hold, skinning against the plain definition, capsules around the skin."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from h3data.bodies import JOINT_INDEX, JOINT_NAMES, Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.humanoid_file import ADULTS, from_planes, to_planes
from h3data.bodies.people.look.colors import SLOTS
from h3data.bodies.people.look.patches import vertex_normals
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data.geometry import ground_pose, normalized, pose_from_matrix, quat_from_heading, quat_to_matrix
from h3data_gpu.skinning import TorchSkin
from tests.bodies.people.everybody import EVERYBODY

BODIES = humanoid_names()
FEW = ("female_0", "male_1", "neutral_2")
"""A short, a tall and a heavy one."""
ROOT = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
UNIT = np.array([0, 0, 0, 1.0])


def apply_skin_dense(
    vertices: np.ndarray,
    joints: np.ndarray,
    weights: np.ndarray,
    matrices: np.ndarray,
) -> np.ndarray:
    """The plain definition in float64, frame by frame, [T, V, 3]."""
    homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
    frames = []
    for frame in matrices.astype(np.float64):
        blended = np.sum(frame[joints] * weights.astype(np.float64)[..., None, None], axis=1)
        frames.append(np.einsum("vij,vj->vi", blended, homogeneous)[:, :3])
    return np.stack(frames)


@pytest.fixture(params=EVERYBODY)
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
    expected = apply_skin_dense(part.mesh.vertices, *part.influences, body.skin_frames(joints) @ body.skin_bind)
    np.testing.assert_allclose(body.skin(joints, lod=lod), expected, atol=5e-6)


def test_bind_pose_gives_the_rest_mesh_back(body: Humanoid) -> None:
    bind = np.linalg.inv(body.inverse_bind)[None]
    np.testing.assert_allclose(body.skin(bind, lod=False)[0], body.mesh.vertices, atol=2e-6)
    assert body.lod_mesh.normals is not None
    shared = np.abs(body.lod_mesh.normals - [0, 1, 0]).max(axis=1) > 0  # degenerate hems point up whatever the pose
    np.testing.assert_allclose(body.skin_normals(bind)[0][shared], body.lod_mesh.normals[shared], atol=1e-5)


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
    assert 0.97 * body.height_m < vertices[:, 1].max() < body.height_m + 0.075  # soles and hair on top
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
        assert mesh.normals is not None
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
        a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
        facing = np.sum(np.cross(b - a, c - a) * mesh.normals[mesh.faces].mean(axis=1), axis=1)
        assert np.mean(facing > 0) > 0.96  # normals and faces look to the same side
        volume = np.sum(a * np.cross(b, c)) / 6
        assert 0.01 < volume < 0.2  # positive: that is outward
    assert 2200 < len(body.lod_mesh.vertices) < 3600
    assert len(body.mesh.vertices) < 28_500


def test_lod_lies_on_the_full_mesh(body: Humanoid) -> None:
    from scipy.spatial import KDTree

    joints = _standing(body)
    distance, _ = KDTree(body.skin(joints, lod=False)[0]).query(body.skin(joints, lod=True)[0])
    assert np.median(distance) < 0.004
    assert np.percentile(distance, 97) < 0.02
    assert distance.max() < 0.08  # the light mesh keeps more of the skin below hems


def _outside(points: np.ndarray, start: np.ndarray, end: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """How far points [V, 3] are outside the nearest of some capsules [V] [m]."""
    way = end - start
    along = np.einsum("vcj,cj->vc", points[:, None] - start, way) / np.maximum(np.sum(way**2, -1), 1e-12)
    nearest = start + np.clip(along, 0, 1)[..., None] * way
    return (np.linalg.norm(points[:, None] - nearest, axis=-1) - radius).min(axis=1)


def test_capsules_enclose_the_skin(body: Humanoid) -> None:
    quats, pelvis = body.clip_pose([0, 2, 5], [0, 0.15, 0.6])
    joints = body.joint_matrices(np.tile(ROOT, (3, 1)), quats, pelvis)
    vertices = body.skin(joints).astype(np.float64)
    start, end, radius = body.capsules_world(joints)
    assert start.shape == (3, 18, 3)
    for t in range(3):
        outside = _outside(vertices[t], start[t], end[t], radius)
        assert np.mean(outside[body.lod.regions == SLOTS.index("skin")] > 0.02) < 0.055
        assert np.mean(outside > 0.02) < 0.11  # wide clothes, hair
        assert outside.max() < 0.12  # a bun, a tail, a finger tip
    assert radius.min() > 0.02
    assert radius.max() < 0.25


def test_bone_boxes_are_thin_and_lie_on_the_bones(body: Humanoid) -> None:
    joints = body.joint_matrices_free(*_random_free_pose(2))
    frames, sizes = body.bone_boxes_world(joints)
    assert frames.shape == (2, len(sizes), 4, 4)
    turn = frames[..., :3, :3]
    np.testing.assert_allclose(turn @ np.swapaxes(turn, -1, -2), np.broadcast_to(np.eye(3), turn.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(turn), 1, atol=1e-9)
    np.testing.assert_allclose(sizes[:, [0, 2]], 0.02)
    length = np.where(sizes[:, 1] > 0.46, sizes[:, 1] + 0.04, sizes[:, 1] / (1 - 2 / 25))
    ends = frames[..., :3, 3] + turn[..., 1] * length[:, None] / 2
    distance = np.linalg.norm(ends[:, :, None] - joints[:, None, :, :3, 3], axis=-1).min(axis=2)
    assert distance.max() < 1e-6  # padded they reach to a joint
    assert len(sizes) >= 53  # the joint of the jaw may be that of the head


def test_loading_is_shared_and_light() -> None:
    assert load_humanoid("female_0") is load_humanoid("female_0")
    code = (
        "import sys; from h3data.bodies import load_humanoid, load_robot; load_humanoid('female_0'); load_robot('quad_arm');"
        "sys.exit(len({'trimesh', 'numba', 'torch', 'scipy'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_twelve_different_people() -> None:
    people = [load_humanoid(name) for name in ADULTS]
    assert [b.name for b in people] == [f"{kind}_{k}" for kind in ("female", "male", "neutral") for k in range(4)]
    assert set(ADULTS) < set(BODIES)
    heights = sorted(b.height_m for b in people)
    assert heights[0] < 1.60 < 1.85 < heights[-1]
    assert min(np.diff(heights)) >= 0.005
    looks = {tuple(map(tuple, np.unique(b.mesh.colors, axis=0))) for b in people}
    assert len(looks) == 12
    assert len({tuple(b.mesh.vertices[:2000:100, 0].round(3)) for b in people}) == 12


def test_skin_weights_and_pattern_are_mirror_images() -> None:
    body = load_humanoid("neutral_0")
    other = np.array([JOINT_INDEX[_mirrored(n)] for n in JOINT_NAMES])
    from scipy.spatial import KDTree

    part, skin = body.full, body.full.regions == 0
    dense = np.zeros((len(part.joints), 55))
    np.add.at(dense, (np.arange(len(dense))[:, None], part.joints), part.weights)
    distance, mirror = KDTree(part.mesh.vertices).query(part.mesh.vertices[skin] * [-1, 1, 1])
    close = distance < 5e-4
    assert close.mean() > 0.97
    np.testing.assert_allclose(dense[skin][close], dense[mirror][close][:, other], atol=0.03)


def _mirrored(name: str) -> str:
    if name.startswith("left_"):
        return "right_" + name[5:]
    return "left_" + name[6:] if name.startswith("right_") else name


@settings(derandomize=True, max_examples=30, deadline=None)
@given(arrays(np.int16, st.tuples(st.integers(0, 40), st.just(3))))
def test_planes_of_bytes_round_trip(vertices: np.ndarray) -> None:
    np.testing.assert_array_equal(from_planes(to_planes(vertices)), vertices)


def test_normals_across_a_surface_are_equal() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(12, 3)).astype(np.float32)
    faces = rng.permutation(12).reshape(4, 3).astype(np.int32)
    surface = np.arange(12) // 2  # pairs of vertices that are shaded as one
    normals = vertex_normals(points, faces, surface)
    np.testing.assert_array_equal(normals[::2], normals[1::2])
    np.testing.assert_array_equal(vertex_normals(points, faces, np.arange(12)), vertex_normals(points, faces))
    flat = vertex_normals(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32))
    np.testing.assert_array_equal(flat, np.tile([0, 1, 0], (3, 1)))


@pytest.mark.parametrize("lod", [True, False])
def test_worlds_and_frames_are_one_product_and_torch_agrees(lod: bool) -> None:
    import torch

    body = load_humanoid("male_1")
    joints = body.joint_matrices_free(*_random_free_pose(6)).reshape(2, 3, 55, 4, 4)
    skin = body.skin(joints, lod=lod)
    assert skin.shape[:2] == (2, 3)
    np.testing.assert_allclose(skin[1, 2], body.skin(joints[1, 2:], lod=lod)[0], atol=1e-6)
    found = TorchSkin(body, lod=lod)(torch.from_numpy(joints))
    np.testing.assert_allclose(found.numpy(), skin, atol=1e-5)
    chunks = {rows.start: part for rows, part in body.skin_chunks(joints[0], lod=lod)}
    np.testing.assert_array_equal(chunks[0], body.skin(joints[0], lod=lod))


@pytest.mark.gpu
def test_torch_skin_on_cuda() -> None:
    import torch

    body = load_humanoid("male_1")
    joints = body.joint_matrices_free(*_random_free_pose(40))
    found = TorchSkin(body, device="cuda")(torch.from_numpy(joints)).cpu().numpy()
    np.testing.assert_allclose(found, body.skin(joints), atol=1e-5)


def test_light_mesh_is_chosen_by_projected_size() -> None:
    body = load_humanoid("female_0")
    focal = 640 / 2 / np.tan(np.radians(90) / 2)
    assert not body.light_enough(focal, 1.0)
    assert body.light_enough(focal, 3.0)
    assert not body.light_enough(focal, 0.0)


def test_phenotype_is_stored(body: Humanoid) -> None:
    assert 0 <= body.phenotype["gender"] <= 1
    assert 0 < body.phenotype["height"] < 1


def test_unknown_body_names_what_there_is() -> None:
    with pytest.raises(InputError, match=r"(?s)'nobody'.*female_0.*H3-BODY-072"):
        load_humanoid("nobody")


def test_files_of_another_kind_are_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="H3-BODY-076"):
        load_humanoid(tmp_path / "none.npz")
    garbage = tmp_path / "garbage.npz"
    garbage.write_bytes(b"PK\x03\x04 not really a zip")
    with pytest.raises(FormatError, match="H3-BODY-077"):
        load_humanoid(garbage)
    other = tmp_path / "other.npz"
    np.savez(other, a=np.zeros(3))
    with pytest.raises(FormatError, match=r"(?s)another npz.*H3-BODY-070"):
        load_humanoid(other)
    with np.load(builtin_path("bodies/female_0.npz")) as file:
        data: dict[str, Any] = {k: file[k] for k in file.files if k != "capsule_start"}
    partial = tmp_path / "partial.npz"
    np.savez(partial, **data)
    with pytest.raises(FormatError, match=r"(?s)'capsule_start'.*H3-BODY-074"):
        load_humanoid(partial)
    elsewhere: dict[str, Any] = data | {"common": np.array("0" * 16)}
    np.savez(tmp_path / "elsewhere.npz", **elsewhere)
    with pytest.raises(FormatError, match="H3-BODY-073"):
        load_humanoid(tmp_path / "elsewhere.npz")
    np.savez(tmp_path / "short.npz", **(data | {"base_delta": data["base_delta"][:, :, :-1]}))
    with pytest.raises(FormatError, match="H3-BODY-075"):
        load_humanoid(tmp_path / "short.npz")
    pickled: dict[str, Any] = data | {"format": np.array({"a": 1}, dtype=object)}
    np.savez(tmp_path / "pickled.npz", **pickled)
    with pytest.raises(FormatError):
        load_humanoid(tmp_path / "pickled.npz")


@pytest.mark.parametrize("lod", [False, True])
def test_a_few_frames_are_skinned_to_the_same_bits_as_many(body: Humanoid, lod: bool) -> None:
    frames = body.joint_matrices_free(*_random_free_pose(12))
    together = body.skin(frames, lod=lod)
    few = np.concatenate([body.skin(frames[:1], lod=lod), body.skin(frames[1:4], lod=lod)])
    np.testing.assert_array_equal(few, together[:4])


@pytest.mark.parametrize("lod", [False, True])
def test_bounding_spheres_hold_every_vertex_in_the_hull_of_its_group(body: Humanoid, lod: bool) -> None:
    frames = body.joint_matrices_free(*_random_free_pose(4))
    bounds, vertices = body.bounds[int(lod)], body.skin(frames, lod=lod).astype(np.float64)
    centers = bounds.posed(body.skin_matrices(frames))
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(20, 3)):  # a support function of the hulls is nowhere below that of the mesh
        direction /= np.linalg.norm(direction)
        reach = (centers @ direction + bounds.radii).max(-1)
        assert (reach > (vertices @ direction).max(-1) - 1e-4).all()
        assert (reach < (vertices @ direction).max(-1) + 0.4).all()
