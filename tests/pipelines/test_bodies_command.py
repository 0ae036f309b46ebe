"""`h3data bodies`, and bodies from a user's SMPL-X file (here a synthetic one of the same layout)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bake.people.humanoid import write_npz
from bake.people.smplx import read_smplx
from h3data.bodies import JOINT_INDEX, JOINT_NAMES, humanoid_names, load_humanoid
from h3data.bodies.people.skeleton import PARENTS
from h3data.errors import FormatError, InputError
from h3data_pipelines.cli import main


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The layout of SMPLX_NEUTRAL.npz: one of our bodies in its T-pose, with two shape directions (taller, wider)."""
    body = load_humanoid("neutral_0")
    identity = np.tile([0.0, 0, 0, 1], (1, 54, 1))
    pelvis = body.joint_offsets[0]
    joints = body.joint_matrices_free(np.array([[*pelvis, 0, 0, 0, 1]]), identity)
    vertices = body.skin(joints)[0].astype(np.float64) - [0, 0.3, 0]
    weights = np.zeros((len(vertices), 55))
    np.add.at(weights, (np.arange(len(weights))[:, None], body.lod.joints), body.lod.weights)
    # each joint as an affine mix of vertices, as the model's regressor
    homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
    places = np.concatenate([joints[0, :, :3, 3] - [0, 0.3, 0], np.ones((55, 1))], axis=1)
    regressor = places @ np.linalg.pinv(homogeneous)
    shape = np.stack([vertices * [0, 0.1, 0], vertices * [0.1, 0, 0.1]], axis=-1)
    parents = np.array([2**32 - 1, *PARENTS[1:]], np.uint32)
    path = tmp_path_factory.mktemp("smplx") / "SMPLX_NEUTRAL.npz"
    np.savez(
        path,
        v_template=vertices,
        shapedirs=shape,
        J_regressor=regressor,
        weights=weights,
        f=body.lod_mesh.faces,
        kintree_table=np.stack([parents, np.arange(55, dtype=np.uint32)]),
        joint2num=np.array({"Pelvis": 0}, dtype=object),
    )
    return path


def test_smplx_shape_and_joints(model: Path) -> None:
    rig, taller = read_smplx(model), read_smplx(model, [1.0])
    assert rig.vertices[:, 1].min() == pytest.approx(0)
    assert np.ptp(taller.vertices[:, 1]) == pytest.approx(1.1 * np.ptp(rig.vertices[:, 1]))
    assert taller.joint("head")[1] == pytest.approx(1.1 * rig.joint("head")[1], rel=0.02)
    reference = load_humanoid("neutral_0").joint_offsets
    np.testing.assert_allclose(rig.offsets[1:], reference[1:], atol=1e-6)


def test_smplx_files_are_judged(model: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found none"):
        read_smplx(tmp_path / "none.npz")
    with pytest.raises(InputError, match="2 shape coefficients, got 3"):
        read_smplx(model, [0.0, 0.0, 0.0])
    with np.load(model, allow_pickle=False) as file:
        data = {key: file[key] for key in file.files if key not in ("joint2num", "J_regressor")}
    np.savez(tmp_path / "part.npz", **data)
    with pytest.raises(FormatError, match="lacks J_regressor"):
        read_smplx(tmp_path / "part.npz")
    data |= {"J_regressor": np.zeros((24, 5)), "kintree_table": np.zeros((2, 24), np.uint32)}
    np.savez(tmp_path / "smpl.npz", **data)
    with pytest.raises(FormatError, match="55 joints of SMPL-X, this model has 24"):
        read_smplx(tmp_path / "smpl.npz")
    (tmp_path / "text.npz").write_text("no model")
    with pytest.raises(FormatError, match="could not read"):
        read_smplx(tmp_path / "text.npz")


@pytest.mark.slow  # 10 s: fits gaits and capsules
def test_a_body_from_smplx_walks(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "mine.npz"
    arguments = ["bodies", "bake", "-o", str(target), "--smplx", str(model), "--betas", "0.3", "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["name"] == "mine"
    body = load_humanoid(target)
    assert body.joint_names == JOINT_NAMES
    phase = np.arange(0.14, 0.3, 0.01)
    quats, pelvis = body.walk_pose(np.full(len(phase), 1.3), phase)
    base = np.tile([0, 0, 0, 0, 0, 0, 1.0], (len(phase), 1))
    base[:, 0] = phase * body.stride_m(1.3)
    joints = body.joint_matrices(base, quats, pelvis)
    assert np.ptp(joints[:, JOINT_INDEX["left_foot"], :3, 3], axis=0)[[0, 2]].max() < 1e-3
    assert np.abs(body.skin(joints)[:, :, 1].min(axis=1)).max() < 0.01
    assert main(arguments) == 2  # there is one already
    assert "--force" in capsys.readouterr().err


def test_show_lists_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bodies", "show", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["bodies"]
    assert tuple(row["name"] for row in rows) == humanoid_names()
    for view in ("front", "walk", "reach"):
        target = tmp_path / f"{view}.png"
        words = ["bodies", "show", "male_0", "-o", str(target), "--view", view, "--width", "200"]
        assert main(words) == 0
        assert target.stat().st_size > 2_000
    capsys.readouterr()
    for arguments, message in (
        (["bodies", "show", "nobody"], "No built-in humanoid"),
        (["bodies", "show", "-o", str(tmp_path / "a.gif")], "ends in .png or .jpg"),
        (["bodies", "show", "-o", str(tmp_path / "front.png")], "--force"),
        (["bodies", "show", "-o", str(tmp_path / "b.png"), "--speed", "-1"], "--speed"),
        (["bodies", "bake", "-o", str(tmp_path / "b.npz"), "--gender", "2"], "--gender must be from 0 to 1"),
        (["bodies", "bake", "-o", str(tmp_path / "b.npz"), "--skin", "red"], "sRGB"),
        (["bodies", "bake", "-o", str(tmp_path / "b.glb")], "ends in .npz"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err


def test_equal_arrays_are_equal_bytes(tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        write_npz(tmp_path / name, {"z": np.arange(5), "a": np.zeros((2, 3), np.float32)})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert sorted(file.files) == ["a", "z"]
