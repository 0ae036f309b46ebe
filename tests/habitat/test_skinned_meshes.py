"""Skinned meshes of files: posed by bones as the definition says, damaged skins refused in words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import SceneError
from h3data.geometry import pose_to_matrix, quat_from_heading
from h3data.mesh.loading import load_mesh
from h3data.recording import AssetRef, Body, Dataset, DatasetWriter, Episode, Recording, open_recording
from h3data.recording.assets.library import AssetLibrary
from h3data.recording.assets.skinned_meshes import load_skinned_mesh
from h3data.recording.mcap.writer import write_mcap
from h3data.replay import Replay, camera_track
from tests.mesh.gltf_builder import FLOAT, SQUARE, U8, Builder

JOINTS = np.array([[0, 1, 0, 0], [0, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]], np.uint8)
WEIGHTS = np.array([[1, 0, 0, 0], [0.5, 0.5, 0, 0], [1, 0, 0, 0], [3, 0, 0, 0]], np.float32)
"""The last row does not sum to 1, as files have it."""


def inverse_binds() -> np.ndarray:
    binds = np.tile(np.eye(4), (2, 1, 1))
    binds[1, :3, 3] = [0, -1, 0]
    return binds


def skinned_square(
    folder: Path, *, joints: np.ndarray = JOINTS, weights: np.ndarray = WEIGHTS, skin: Any = None
) -> Path:
    """A square on the joints "low" and "high", beside it the same square without a skin, two metres to the right."""
    build = Builder()
    build.attribute("JOINTS_0", joints, "VEC4", U8)
    build.attribute("WEIGHTS_0", weights, "VEC4", FLOAT)
    plain = {"attributes": {"POSITION": 0}, "indices": build.primitive["indices"]}
    build.document["meshes"].append({"primitives": [plain]})
    columns = inverse_binds().swapaxes(1, 2).reshape(2, 16).astype(np.float32)
    bind = build.chunk.array(columns, "MAT4", FLOAT)
    build.document |= {
        "scenes": [{"nodes": [0, 1, 3]}],
        "nodes": [
            {"mesh": 0, "skin": 0, "translation": [9, 9, 9]},
            {"name": "low", "children": [2]},
            {"name": "high"},
            {"mesh": 1, "translation": [2, 0, 0]},
        ],
        "skins": [skin or {"joints": [1, 2], "inverseBindMatrices": bind}],
    }
    path = folder / "bent.glb"
    path.write_bytes(build.data())
    return path


def poses(steps: int, seed: int = 0) -> np.ndarray:
    """Random poses of the two bones, [T, 2, 7]."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(steps, 2, 4))
    return np.concatenate([rng.normal(size=(steps, 2, 3)), q / np.linalg.norm(q, axis=-1, keepdims=True)], -1)


def recorded(path: Path, bones: np.ndarray, names: list[str], track: np.ndarray | None = None) -> Recording:
    columns: dict[str, Any] = {"time_ns": np.arange(1, len(bones) + 1, dtype=np.int64), "rig.3": bones}
    if track is not None:
        columns["object_pose"] = track[:, None].astype(np.float32)
    body = Body(
        name="bent_0",
        asset="bent",
        pose=np.array([1, 0, 2, *quat_from_heading(0.4)], np.float32),
        scale=np.full(3, 0.5, np.float32),
        moving=-1 if track is None else 0,
    )
    return Recording(
        episode=Episode(
            uid="u", episode_id="e", task="none", scene="", info={"rigs": [{"id": 3, "bones": names, "body": "bent_0"}]}
        ),
        assets=(AssetRef(name="bent", uri=path.name, up=(0.0, 0.0, 1.0), front=(0.0, 1.0, 0.0)),),
        bodies=(body,),
        columns=columns,
    )


def test_vertices_follow_the_definition(tmp_path: Path) -> None:
    """root F rigid(root)^-1 bone inverse_bind, blended, in plain matrices; parts without a skin follow the root."""
    path, bones = skinned_square(tmp_path), poses(4)
    replay = Replay(recorded(path, bones.astype(np.float32), ["tail", "low", "high"][1:]), assets=[tmp_path])
    found = replay.vertices(0, np.arange(4))
    assert [d.deformable for d in replay.drawables] == [True]
    rigid = pose_to_matrix(np.array([1, 0, 2, *quat_from_heading(0.4)]))
    to_y_up = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # z up, y in front
    outer = rigid @ np.diag([0.5, 0.5, 0.5, 1]) @ to_y_up
    weights = WEIGHTS / WEIGHTS.sum(1, keepdims=True)
    for step in range(4):
        bind_to_root = np.linalg.inv(rigid) @ pose_to_matrix(bones[step]) @ inverse_binds()
        for v, point in enumerate(SQUARE):
            blend = sum(w * bind_to_root[j] for j, w in zip(JOINTS[v], weights[v], strict=True))
            np.testing.assert_allclose(found[step, v], (outer @ blend @ [*point, 1])[:3], atol=2e-6)
            np.testing.assert_allclose(found[step, 4 + v], (outer @ [point[0] + 2, *point[1:], 1])[:3], atol=2e-6)


def test_bones_find_their_joints_by_name(tmp_path: Path) -> None:
    path, bones = skinned_square(tmp_path), poses(2).astype(np.float32)
    one = Replay(recorded(path, bones, ["low", "high"]), assets=[tmp_path]).vertices(0, np.arange(2))
    other = Replay(recorded(path, bones[:, ::-1], ["high", "low"]), assets=[tmp_path]).vertices(0, np.arange(2))
    np.testing.assert_array_equal(one, other)
    unnamed = Replay(recorded(path, bones, ["x", "y"]), assets=[tmp_path]).vertices(0, np.arange(2))
    np.testing.assert_allclose(unnamed[0], unnamed[1], atol=1e-6)  # no bone moves it: it stands with its root


def test_a_rigged_body_that_leaves_is_gone(tmp_path: Path) -> None:
    path, track = skinned_square(tmp_path), np.tile([0, 0, 0, 0, 0, 0, 1.0], (6, 1))
    bones = np.tile([0, 0, 0, 0, 0, 0, 1.0], (6, 2, 1)).astype(np.float32)
    track[3:5], bones[3:5] = np.nan, np.nan
    replay = Replay(recorded(path, bones, ["low", "high"], track), assets=[tmp_path])
    shown = [
        (view["instance"] >= 0).any()
        for _, (view,) in replay.frames([camera_track(replay, "top_down")], range(6), outputs=("instance",))
    ]
    assert shown == [True, True, True, False, False, True]


def test_without_bones_or_skin_it_is_a_rigid_body(tmp_path: Path) -> None:
    path = skinned_square(tmp_path)
    rec = recorded(path, poses(2).astype(np.float32), ["low", "high"])
    without = Recording(episode=rec.episode, assets=rec.assets, bodies=rec.bodies, columns={"time_ns": np.arange(2)})
    assert not Replay(without, assets=[tmp_path]).drawables[0].deformable
    build = Builder()
    path.write_bytes(build.data())
    assert load_skinned_mesh(path) is None
    assert not Replay(rec, assets=[tmp_path]).drawables[0].deformable


@pytest.mark.parametrize(
    ("skin", "word"),
    [
        ({"joints": [1, 99]}, r"(?s)nodes\[99\].*H3-MESH-021"),
        ({"joints": [], "name": "x"}, r"(?s)skins\[0\]\.joints.*H3-MESH-021"),
        ({"joints": [1]}, r"(?s)JOINTS_0 goes up to 1.*H3-MESH-021"),
        (
            {"joints": [1, 2], "inverseBindMatrices": 0},
            r"(?s)inverseBindMatrices is not an accessor.*2 MAT4.*H3-MESH-021",
        ),
    ],
)
def test_damaged_skins_are_refused(tmp_path: Path, skin: dict[str, Any], word: str) -> None:
    path = skinned_square(tmp_path, skin=skin)
    assert len(load_mesh(path).faces) == 4  # the rest shape can still be had
    with pytest.raises(SceneError, match=word):
        load_skinned_mesh(path)
    library = AssetLibrary([tmp_path])
    assert library.skinned(AssetRef(name="bent", uri=path.name)) is None
    assert path.name in library.unreadable


def test_a_vertex_without_weight_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"(?s)WEIGHTS_0 leaves a vertex without weight.*H3-MESH-021"):
        load_skinned_mesh(skinned_square(tmp_path, weights=0 * WEIGHTS))


def test_rigs_survive_both_stores(tmp_path: Path) -> None:
    path = skinned_square(tmp_path)
    rec = recorded(path, poses(5).astype(np.float32), ["low", "high"])
    write_mcap(rec, tmp_path / "r.mcap")
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(rec)
    expected = Replay(rec, assets=[tmp_path]).vertices(0, np.arange(5))
    dataset = open_recording(tmp_path / "ds")
    assert isinstance(dataset, Dataset)
    for stored in (open_recording(tmp_path / "r.mcap"), dataset.recording(0)):
        assert isinstance(stored, Recording)
        np.testing.assert_array_equal(Replay(stored, assets=[tmp_path]).vertices(0, np.arange(5)), expected)


def test_a_rigid_body_of_the_same_file_keeps_its_shape(tmp_path: Path) -> None:
    path = skinned_square(tmp_path)
    rec = recorded(path, poses(3).astype(np.float32), ["low", "high"])
    stands = Body(name="stands", asset="bent", pose=np.array([5, 0, 0, 0, 0, 0, 1], np.float32))
    replay = Replay(replace(rec, bodies=(*rec.bodies, stands)), assets=[tmp_path])
    assert [d.deformable for d in replay.drawables] == [True, False]
    scene = replay.stage.scene
    assert scene.instances[0].mesh in scene.deformable
    assert scene.instances[1].mesh not in scene.deformable
