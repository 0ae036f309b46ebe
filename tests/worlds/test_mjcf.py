"""Robots in MJCF: their frames are those of MuJoCo's own forward kinematics, and hostile files are refused by name."""

from __future__ import annotations

import logging
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

mujoco: Any = pytest.importorskip("mujoco")

import h3data  # noqa: E402
from h3data.bodies import load_robot  # noqa: E402
from h3data.bodies.robots.robot_loading import robot_digest  # noqa: E402
from h3data.errors import H3DataError, MissingAssetError  # noqa: E402
from h3data.geometry import IDENTITY_POSE  # noqa: E402
from h3data.scene.records import Box, Capsule, Cylinder, Hull  # noqa: E402
from h3data_worlds import mjcf  # noqa: E402
from h3data_worlds.mjcf import read_mjcf  # noqa: E402
from tests.paths import ROOT  # noqa: E402

BARROW, PORTER = (ROOT / "tests" / "data" / "mjcf" / f"{name}.xml" for name in ("barrow", "porter"))
BODY = '<body name="a"><joint name="j"/><geom size="0.1"/>{}</body>'


def model(inside: str, *, beside: str = "") -> str:
    return f"<mujoco>{beside}<worldbody>{inside}</worldbody></mujoco>"


def written(folder: Path, text: str | bytes, name: str = "a.xml") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def errors_in_frames(path: Path, root: str, postures: int = 20) -> float:
    """Largest difference of a frame between our kinematics and MuJoCo's, relative to the body ``root``."""
    robot, model = load_robot(path), mujoco.MjModel.from_xml_path(str(path))
    data, rng, worst = mujoco.MjData(model), np.random.default_rng(0), 0.0
    for _ in range(postures):
        joints = np.zeros(len(robot.joint_names))
        data.qpos[:] = model.qpos0
        for j in range(model.njnt):
            at, kind, name = int(model.jnt_qposadr[j]), int(model.jnt_type[j]), model.jnt(j).name
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                data.qpos[at : at + 7] = [*rng.uniform(-1, 1, 3), *rng.standard_normal(4)]
            elif kind == mujoco.mjtJoint.mjJNT_BALL:
                q = rng.standard_normal(4)
                q /= np.linalg.norm(q)
                data.qpos[at : at + 4] = q
                for part, value in zip("xyzw", (*q[1:], q[0]), strict=True):
                    joints[robot.joint_names.index(f"{name}.{part}")] = value
            elif name in robot.joint_names:
                data.qpos[at] = rng.uniform(*model.jnt_range[j]) if model.jnt_limited[j] else rng.uniform(-3, 3)
                joints[robot.joint_names.index(name)] = data.qpos[at]
        for e in range(model.neq):
            one, two = (int(model.jnt_qposadr[k]) for k in (model.eq_obj1id[e], model.eq_obj2id[e]))
            moved = data.qpos[two] - model.qpos0[two]
            data.qpos[one] = model.qpos0[one] + np.polyval(model.eq_data[e][:5][::-1], moved)
        mujoco.mj_kinematics(model, data)
        ours = robot.link_matrices(IDENTITY_POSE[None], joints[None])[0]
        frames = dict(zip((link.name for link in robot.links), ours, strict=True))

        def of_mujoco(name: str, data: Any = data) -> np.ndarray:
            out = np.eye(4)
            out[:3, :3], out[:3, 3] = data.body(name).xmat.reshape(3, 3), data.body(name).xpos
            return out

        for name in frames:
            if "/" not in name and name != "world":
                mine = np.linalg.inv(frames[root]) @ frames[name]
                theirs = np.linalg.inv(of_mujoco(root)) @ of_mujoco(name)
                worst = max(worst, float(np.abs(mine - theirs).max()))
    return worst


# --- a robot as MuJoCo has it -----------------------------------------------------------------------------------------
def test_frames_are_those_of_mujoco() -> None:
    assert errors_in_frames(BARROW, "chassis") < 1e-6


def test_a_robot_rests_as_its_keyframe_says(tmp_path: Path) -> None:
    robot = load_robot(PORTER)
    assert errors_in_frames(PORTER, "pelvis", 5) < 1e-6
    home = {
        "hip": -0.4,
        "knee": 0.8,
        "ankle": -0.4,
        "neck": 0.2,
        "shoulder_pitch": 0.35,
        "shoulder_roll": 0.1,
        "elbow": -1.2,
    }
    for name, resting in zip(robot.joint_names, robot.rest, strict=True):
        assert resting == pytest.approx(home.get(re.sub("_(left|right)$", "", name), 0.0))
    links = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0]
    feet = [links[[link.name for link in robot.links].index(f"foot_{side}")] for side in ("left", "right")]
    for foot in feet:  # soles on the floor and level
        assert foot[1, 3] == pytest.approx(0.05, abs=2e-3)
        assert foot[:3, 2] == pytest.approx([0, 1, 0], abs=1e-6)
    without = written(tmp_path, re.sub('<key name="home".*', "", PORTER.read_text()))
    folded = load_robot(without)  # at the references, but for the arm of the hand
    assert dict(zip(folded.joint_names, folded.rest, strict=True))["knee_left"] == 0
    assert folded.rest.any()


def test_several_joints_of_a_body_and_bases_on_rails(tmp_path: Path) -> None:
    inside = """<body name="rail" pos="3 1 0.2" euler="0 0 30"><joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/><joint name="yaw" axis="0 0 1" pos="0.1 0 0" ref="20"/><geom size="0.1"/>
      <body name="b" pos="0.3 0 0.1"><joint name="p" axis="1 1 0" pos="0 0 -0.1"/><joint name="q" axis="0 1 0" pos="0.1 0 0"/>
      <joint type="ball" name="r"/><geom size="0.1"/></body></body>"""
    assert errors_in_frames(written(tmp_path, model(inside)), "rail") < 1e-6


def test_shapes_limits_and_couplings() -> None:
    robot = load_robot(BARROW)
    links = {link.name: link for link in robot.links}
    kinds = {name: type(link.shapes[0]) for name, link in links.items() if link.shapes}
    assert kinds["chassis"] is kinds["plate"] is Box
    assert (kinds["wheel_left"], kinds["column"], kinds["arm"], kinds["wrist"]) == (Cylinder, Capsule, Hull, Capsule)
    assert all(link.mesh is not None for name, link in links.items() if "/" not in name)
    assert "finger_right" not in robot.joint_names
    at = robot.joint_names.index("lift")
    assert (robot.lower[at], robot.upper[at]) == (0.0, 0.5)
    wheel = robot.joint_names.index("wheel_left")
    assert robot.upper[wheel] == np.inf
    wedge = links["chassis"].mesh
    assert wedge is not None
    assert (wedge.colors == (229, 128, 26)).all(1).any()
    assert read_mjcf(BARROW, warn=False).rest["lift"] == 0.2


def test_it_plays_and_is_recorded_like_any_robot(tmp_path: Path) -> None:
    folder = shutil.copytree(BARROW.parent, tmp_path / "bot")
    (folder / "LICENSE").write_text("A licence of our own\n\nmore")
    path = folder / "barrow.xml"
    recording = h3data.simulate("wander", roster=f"robot:{path},human", max_steps=20, record=tmp_path / "a.mcap")
    digest = recording.episode.info["robots_sha256"]
    assert digest == {str(path): robot_digest(path)}
    picture = h3data.render_frame(recording, camera="third_person", step=10)["rgb"]
    assert picture.std() > 10
    (folder / "barrow_assets.xml").write_text((folder / "barrow_assets.xml").read_text() + "<!-- -->")
    assert robot_digest(path) != digest[str(path)]
    assert "A licence of our own" in mjcf.licence_of(path)


def test_what_is_left_out_is_told(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        read_mjcf(BARROW)
    assert "1 other bodies" in caplog.text
    assert "1 tendons" in caplog.text


def test_large_meshes_are_thinned_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path / "cache"))
    trimesh.creation.icosphere(subdivisions=6, radius=0.2).export(tmp_path / "ball.stl")
    asset = '<asset><mesh name="ball" file="ball.stl"/></asset>'
    path = written(tmp_path, model('<body><joint/><geom type="mesh" mesh="ball"/></body>', beside=asset))
    robot = load_robot(path)
    mesh = robot.links[-1].mesh
    assert mesh is not None
    assert 2000 < len(mesh.faces) <= mjcf.MAX_TRIANGLES
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.2, atol=0.002)
    (stored,) = (tmp_path / "cache" / "robots").iterdir()
    monkeypatch.setattr(mjcf, "_thin", lambda *_: pytest.fail("thinned again"))
    assert len(read_mjcf(path).links[-1].visuals[0].geometry.mesh.faces) == len(mesh.faces)  # type: ignore[union-attr]
    stored.write_bytes(b"cut")
    monkeypatch.undo()
    monkeypatch.setenv("H3DATA_CACHE", "off")
    assert read_mjcf(path).links[-1].visuals[0].geometry.mesh is not None


# --- hostile files ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "text",
    [
        "",
        "<mujoco>",
        "<robot name='a'/>",
        "<mujoco/>",
        b"\xff\xfe<\0m\0",
        '<!DOCTYPE mujoco [<!ENTITY a "aaaa">]>' + model(BODY.format("")),
        '<!doctype mujoco SYSTEM "file:///etc/passwd">' + model(BODY.format("")),
        model(BODY.format('<body name="b" pos="0 0 1"><freejoint/><geom size="0.1"/></body>')),
        model(f'<replicate count="1000000000">{BODY.format("")}</replicate>'),
        model('<body><composite type="cable" count="100000 1 1"/></body>'),
        model('<body><flexcomp type="grid" count="900 900 900" name="f"/></body>'),
        model(BODY.format(""), beside='<extension><plugin plugin="a.b"/></extension>'),
        model(BODY.format(""), beside='<asset><texture builtin="flat" width="100000" height="100000" name="t"/></asset>'),
        model(BODY.format(""), beside='<asset><hfield name="h" nrow="1e9" ncol="9" size="1 1 1 1"/></asset>'),
        model(BODY.format('<body name="a"><geom size="1"/></body>')),
        model('<body><joint type="hinge" axis="0 0 0"/><geom size="1"/></body>'),
        model('<body><joint range="nan inf"/><geom size="-1"/></body>'),
        model(BODY.format(""), beside="<option gravity='a'/>"),
        model(BODY.format(""), beside='<size nuserdata="2000000000"/>'),
        model(BODY.format('<body name="b" pos="inf 0 0"><joint/><geom size="0.1"/></body>')),
        model(BODY.format('<body name="b" pos="1e300 0 0"><joint/><geom size="0.1"/></body>')),
        model('<body name="a"><joint/><geom size="1000000"/></body>'),
    ],
)  # fmt: skip
def test_what_is_no_robot_is_refused(tmp_path: Path, text: str | bytes) -> None:
    with pytest.raises(H3DataError, match="H3-BODY-"):
        load_robot(written(tmp_path, text))


@pytest.mark.parametrize("include", ["a.xml", "b.xml", "gone.xml", "../../../../up.xml", "/etc/hostname", ""])
def test_includes_that_lead_nowhere_or_back_are_refused(tmp_path: Path, include: str) -> None:
    deep = tmp_path / "1" / "2" / "3" / "4"
    deep.mkdir(parents=True)
    written(tmp_path, "<mujocoinclude/>", "up.xml")
    written(deep, '<mujocoinclude><include file="a.xml"/></mujocoinclude>', "b.xml")
    path = written(deep, model(BODY.format(""), beside=f'<include file="{include}"/>'))
    with pytest.raises(H3DataError, match="H3-BODY-"):
        load_robot(path)


def test_missing_meshes_are_named(tmp_path: Path) -> None:
    asset = '<compiler meshdir="parts"/><asset><mesh name="m" file="gone.stl"/></asset>'
    path = written(tmp_path, model('<body><joint/><geom type="mesh" mesh="m"/></body>', beside=asset))
    with pytest.raises(MissingAssetError, match=r"gone\.stl"):
        load_robot(path)


def test_huge_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, model(BODY.format(f"<!--{'x' * 3000}-->")))
    monkeypatch.setattr(mjcf, "MAX_BYTES", 2000)
    with pytest.raises(H3DataError, match="H3-BODY-"):
        read_mjcf(path)


@pytest.mark.parametrize(
    "actuator",
    [
        '<muscle joint="j" lengthrange="0 1"/>',
        '<adhesion body="a" ctrlrange="0 1"/>',
        '<intvelocity joint="j" actrange="-1 1"/>',
    ],
)
def test_actuators_of_any_kind_are_not_needed(tmp_path: Path, actuator: str) -> None:
    text = model(BODY.format("")).replace("</mujoco>", f"<actuator>{actuator}</actuator></mujoco>")
    assert load_robot(written(tmp_path, text)).joint_names == ("j",)


def test_without_mujoco_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(H3DataError, match="H3-BODY-171"):
        read_mjcf(BARROW)
