"""URDF: Habitat's own files with its forward kinematics, every kind of geometry, and hostile input."""

from __future__ import annotations

import json
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import load_robot, read_urdf
from h3data.bodies.robots.urdf import Urdf
from h3data.errors import FormatError, H3DataError, InputError, MissingAssetError
from h3data.geometry import pose_from_matrix, pose_inverse, pose_multiply
from h3data.scene.records import Box, Capsule, Cylinder, Hull
from tests.paths import HABITAT_SIM
from tests.random_cases import examples

needs_real = pytest.mark.skipif(not HABITAT_SIM.is_dir(), reason="Habitat's real files are not beside the checkout")
FILES = {
    "fridge": "data/test_assets/urdf/fridge/fridge.urdf",
    "kuka": "data/test_assets/urdf/kuka_iiwa/model_free_base.urdf",
    "prim_chain": "data/test_assets/urdf/prim_chain.urdf",
    "skinned_prism": "data/test_assets/urdf/skinned_prism.urdf",
    "amass_male": "data/test_assets/urdf/amass_male.urdf",
}

load_plain = partial(load_robot, fill_in=False)
"""As the files say, without guesses."""


ROOT = np.array([[0, 0, 0, 0, 0, 0, 1.0]])


def _write(folder: Path, body: str, *, head: str = '<?xml version="1.0"?>') -> Path:
    path = folder / "robot.urdf"
    path.write_text(f'{head}<robot name="test">{body}</robot>')
    return path


def _joint(name: str, parent: str, child: str, kind: str = "fixed", more: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{more}</joint>'


# --- Habitat's files --------------------------------------------------------------------------------------------------
@needs_real
@pytest.mark.parametrize("name", FILES)
def test_forward_kinematics_equals_habitat(name: str) -> None:
    """Habitat's link pose is the centre-of-mass frame, and so is its object pose (reference/README.md, physics)."""
    golden = json.loads((HABITAT_SIM / "reference/physics/forward_kinematics.json").read_text())[name]
    robot = load_plain(HABITAT_SIM / FILES[name], up="y")  # Habitat does not turn the base frame
    order = [
        j["joint"] + part
        for j in golden["joints"]
        for part in {0: (), 1: ("",), 4: (".x", ".y", ".z", ".w")}[j["num_pos"]]
    ]
    base_inertial = pose_from_matrix(robot.links[0].inertial)
    bases, positions = [], []
    for sample in golden["samples"]:
        w, x, y, z = sample["base_rotation_wxyz"]
        com = np.array([*sample["base_translation"], x, y, z, w])
        bases.append(pose_multiply(com, pose_inverse(base_inertial)))
        values = dict(zip(order, sample["joint_positions"], strict=True))
        positions.append([values[j] for j in robot.joint_names])
    matrices = robot.link_matrices(np.array(bases), np.array(positions))
    inertial = np.stack([link.inertial for link in robot.links])
    found = matrices @ inertial
    expected = np.array([[sample["links"][link] for link in robot.link_names] for sample in golden["samples"]])
    assert expected.shape == found.shape
    assert len(found) == 40
    assert np.abs(found - expected).max() < 6e-6


@needs_real
def test_real_files_load_with_meshes_and_shapes() -> None:
    robots = {name: load_plain(HABITAT_SIM / path) for name, path in FILES.items()}
    counts = {"fridge": 2, "kuka": 7, "prim_chain": 2, "skinned_prism": 16, "amass_male": 68}
    assert {name: len(r.joint_names) for name, r in robots.items()} == counts
    kuka, fridge, chain = robots["kuka"], robots["fridge"], robots["prim_chain"]
    assert all(link.mesh is not None for link in kuka.links)
    assert tuple(kuka.links[1].mesh.colors[0]) == (128, 178, 255)  # material Blue: 0.5 0.7 1.0
    assert len(fridge.links[1].shapes) == 9
    assert isinstance(kuka.links[0].shapes[0], Hull)
    kinds = [type(link.shapes[0]) for link in chain.links]
    assert kinds == [Box, Capsule, Cylinder, Capsule]
    np.testing.assert_allclose(fridge.upper, [2.3, 2.5])  # in the order of the file: top door, bottom door
    assert len(np.unique(fridge.links[1].mesh.colors, axis=0)) >= 1


@needs_real
def test_every_real_urdf_loads() -> None:
    files = sorted(HABITAT_SIM.parent.rglob("*.urdf"))
    assert len(files) == 10
    for path in files:
        robot = load_plain(path)
        assert np.isfinite(robot.link_matrices(ROOT, robot.rest[None])).all(), path


@needs_real
def test_reading_does_not_write_or_depend_on_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert isinstance(read_urdf(str(HABITAT_SIM / FILES["kuka"])), Urdf)
    assert list(tmp_path.iterdir()) == []


# --- geometry and joints ----------------------------------------------------------------------------------------------
def test_shapes_lie_where_the_file_says(tmp_path: Path) -> None:
    shapes = (
        '<collision><origin xyz="1 2 3" rpy="0 1.5707963267948966 0"/>'
        '<geometry><capsule radius="0.1" length="0.6"/></geometry></collision>'
        '<collision><geometry><cylinder radius="0.2" length="0.5"/></geometry></collision>'
        '<collision><origin xyz="0 0 1"/><geometry><box size="1 2 4"/></geometry></collision>'
        '<collision><geometry><sphere radius="0.3"/></geometry></collision>'
    )
    capsule, cylinder, box, sphere = load_robot(_write(tmp_path, f'<link name="a">{shapes}</link>')).links[0].shapes
    np.testing.assert_allclose(capsule.end, [1.3, 2, 3], atol=1e-12)  # its z axis turned to x
    np.testing.assert_allclose(capsule.start, [0.7, 2, 3], atol=1e-12)
    np.testing.assert_allclose(cylinder.pose, [0, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)  # y to z
    assert cylinder.half_height == 0.25
    np.testing.assert_allclose(box.half_extents, [0.5, 1, 2])
    np.testing.assert_allclose(sphere.start, sphere.end)


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        ('<box size="1 2 3"/>', 6.0),
        ('<cylinder radius="0.5" length="2"/>', np.pi / 2),
        ('<sphere radius="0.5"/>', np.pi / 6),
        ('<capsule radius="0.5" length="1"/>', np.pi / 6 + np.pi / 4),
    ],
)
def test_primitive_meshes_are_closed_and_outward(tmp_path: Path, shape: str, volume: float) -> None:
    material = '<material name="m"><color rgba="1 0 0.5 1"/></material>'
    visual = f'<visual><origin xyz="5 0 0"/><geometry>{shape}</geometry>{material}</visual>'
    mesh = load_robot(_write(tmp_path, f'<link name="a">{visual}</link>')).links[0].mesh
    assert mesh is not None
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) - [5, 0, 0] for k in range(3))
    assert np.sum(a * np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.06)
    outward = np.sum((mesh.vertices - [5, 0, 0]) * mesh.normals, axis=1)
    assert outward.min() > 0
    assert tuple(mesh.colors[0]) == (255, 0, 128)


def test_joint_kinds(tmp_path: Path) -> None:
    body = "".join(f'<link name="{n}"/>' for n in "abcd")
    body += _joint("slide", "a", "b", "prismatic", '<axis xyz="0 0 2"/><limit lower="-1" upper="1"/>')
    body += _joint("spin", "b", "c", "continuous", '<origin xyz="1 0 0"/><axis xyz="0 0 1"/>')
    body += _joint("weld", "c", "d", "fixed", '<origin xyz="0 1 0"/>')
    robot = load_plain(_write(tmp_path, body), up="y")
    assert robot.joint_names == ("slide", "spin")
    assert list(robot.upper) == [1, np.inf]
    frames = robot.link_matrices(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), np.array([[0.5, np.pi / 2]]))[0]
    np.testing.assert_allclose(frames[3, :3, 3], [0, 0, 0.5], atol=1e-12)  # 1 forward, then 1 along the turned y
    np.testing.assert_allclose(frames[2, :3, 3], [1, 0, 0.5], atol=1e-12)


def test_urdf_z_up_becomes_root_y_up(tmp_path: Path) -> None:
    body = '<link name="a"/><link name="b"/>' + _joint("j", "a", "b", "fixed", '<origin xyz="1 2 3"/>')
    frames = load_plain(_write(tmp_path, body)).link_matrices(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), np.zeros((1, 0)))[0]
    np.testing.assert_allclose(frames[1, :3, 3], [1, 3, -2], atol=1e-12)  # forward, up, right


LIMIT = '<limit lower="-1" upper="1"/>'


def test_a_mimic_joint_follows_the_one_that_leads_it(tmp_path: Path) -> None:
    """position = multiplier * leader + offset; a mimic of a mimic follows the first."""
    body = "".join(f'<link name="{n}"/>' for n in "abcd")
    body += _joint("third", "c", "d", "prismatic", '<axis xyz="0 0 1"/><mimic joint="second" multiplier="-2"/>')
    body += _joint(
        "second", "b", "c", "revolute", f'{LIMIT}<axis xyz="0 0 1"/><mimic joint="first" multiplier="3" offset="0.5"/>'
    )
    body += _joint("first", "a", "b", "prismatic", f'{LIMIT}<axis xyz="1 0 0"/>')
    path = _write(tmp_path, body)
    assert [j.name for j in read_urdf(path).movable] == ["first"]
    robot = load_plain(path, up="y")
    assert robot.joint_names == ("first",)
    assert robot.link_names == ("a", "b", "c", "d")
    for x in (-1.0, 0.0, 0.3):
        frames = robot.link_matrices(ROOT, np.array([[x]]))[0]
        angle = 3 * x + 0.5
        np.testing.assert_allclose(frames[2, :2, 0], [np.cos(angle), np.sin(angle)], atol=1e-12)
        np.testing.assert_allclose(frames[3, :3, 3], [x, 0, -2 * angle], atol=1e-12)


def test_a_spherical_joint_takes_a_quaternion(tmp_path: Path) -> None:
    body = PAIR + _joint("ball", "a", "b", "spherical", '<origin xyz="0 1 0"/>')
    robot = load_plain(_write(tmp_path, body), up="y")
    assert robot.joint_names == ("ball.x", "ball.y", "ball.z", "ball.w")
    np.testing.assert_array_equal(robot.rest, [0, 0, 0, 1])
    turned = robot.link_matrices(ROOT, np.array([[0, 0, 1.0, 1.0]]))[
        0, 1
    ]  # a quarter about z; its length does not matter
    np.testing.assert_allclose(turned, [[0, -1, 0, 0], [1, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-12)


def test_package_paths_are_found_beside_and_above(tmp_path: Path) -> None:
    from h3data.builtin import builtin_path

    (tmp_path / "urdf").mkdir()
    (tmp_path / "meshes").mkdir()
    source = builtin_path("robots/quad_arm/meshes/arm_wrist.glb")
    (tmp_path / "meshes" / "a.glb").write_bytes(source.read_bytes())
    mesh = '<mesh filename="package://thing/meshes/a.glb" scale="2 2 2"/>'
    body = f'<link name="a"><visual><geometry>{mesh}</geometry></visual></link>'
    small, large = load_robot("quad_arm"), load_robot(_write(tmp_path / "urdf", body)).links[0].mesh
    wrist = small.links[small.link_names.index("arm_wrist")].mesh
    np.testing.assert_allclose(large.vertices, 2 * wrist.vertices, atol=1e-6)


# --- hostile input ----------------------------------------------------------------------------------------------------
LINKS = "".join(f'<link name="{n}"/>' for n in "abc")
PAIR = '<link name="a"/><link name="b"/>'
HOSTILE = {
    "cycle": (LINKS + _joint("1", "b", "c") + _joint("2", "c", "b"), "(?s)cycle.*H3-BODY-114"),
    "closed ring": (PAIR + _joint("1", "a", "b") + _joint("2", "b", "a"), "(?s)cycle.*H3-BODY-114"),
    "two roots": (LINKS + _joint("1", "a", "b"), "(?s)expected one link without a parent, got a, c.*H3-BODY-114"),
    "two parents": (LINKS + _joint("1", "a", "c") + _joint("2", "b", "c"), "(?s)link c has two parents.*H3-BODY-114"),
    "mimic in a circle": (
        LINKS
        + _joint("1", "a", "b", "revolute", '<mimic joint="2"/>')
        + _joint("2", "b", "c", "revolute", '<mimic joint="1"/>'),
        "(?s)mimics itself in a circle.*H3-BODY-114",
    ),
    "mimic of itself": (PAIR + _joint("1", "a", "b", "revolute", '<mimic joint="1"/>'), "(?s)in a circle.*H3-BODY-114"),
    "mimic by NaN": (
        PAIR + _joint("1", "a", "b", "revolute", '<mimic joint="1" offset="nan"/>'),
        "(?s)1 finite.*H3-BODY-114",
    ),
    "negative size": (
        '<link name="a"><visual><geometry><box size="1 -1 1"/></geometry></visual></link>',
        "(?s)no negative.*H3-BODY-114",
    ),
    "unknown joint type": (
        LINKS + _joint("1", "a", "b", "screw"),
        "(?s)expected type revolute.*got 'screw'.*H3-BODY-114",
    ),
    "unknown link": (LINKS + _joint("1", "a", "z"), "(?s)there is no link 'z'.*H3-BODY-114"),
    "twice": ('<link name="a"/><link name="a"/>', "(?s)link a is there twice.*H3-BODY-114"),
    "no links": ("", "(?s)expected one link without a parent.*H3-BODY-114"),
    "no child": (
        '<link name="a"/><joint name="j" type="fixed"><parent link="a"/></joint>',
        "(?s)needs <parent> and <child>.*H3-BODY-114",
    ),
    "not a number": ('<link name="a"><inertial><origin xyz="0 x 0"/></inertial></link>', "(?s)3 finite.*H3-BODY-114"),
    "infinite": (
        '<link name="a"><visual><geometry><sphere radius="inf"/></geometry></visual></link>',
        "(?s)1 finite.*H3-BODY-114",
    ),
    "unknown geometry": (
        '<link name="a"><visual><geometry><torus/></geometry></visual></link>',
        "(?s)got torus.*H3-BODY-114",
    ),
    "zero axis": (PAIR + _joint("1", "a", "b", "revolute", '<axis xyz="0 0 0"/>'), "(?s)axis is zero.*H3-BODY-114"),
    "xacro": ('<xacro:macro xmlns:xacro="http://www.ros.org/wiki/xacro" name="x"/>', "H3-BODY-119"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_urdf_is_refused_in_words(tmp_path: Path, case: str) -> None:
    body, message = HOSTILE[case]
    with pytest.raises(FormatError, match=message):
        read_urdf(_write(tmp_path, body))


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    body = LINKS + _joint("1", "a", "z") + _joint("2", "a", "b", "screw")
    with pytest.raises(FormatError, match=r"(?s)screw.*no link 'z'.*H3-BODY-114"):
        read_urdf(_write(tmp_path, body))


def test_entities_are_refused(tmp_path: Path) -> None:
    bomb = '<?xml version="1.0"?><!DOCTYPE robot [<!ENTITY a "aaaa"><!ENTITY b SYSTEM "file:///etc/passwd">]>'
    with pytest.raises(FormatError, match="H3-BODY-118"):
        read_urdf(_write(tmp_path, '<link name="&b;"/>', head=bomb))
    wide = tmp_path / "wide.urdf"
    wide.write_bytes((bomb + "<robot/>").encode("utf-16"))
    with pytest.raises(FormatError, match="H3-BODY-118"):
        read_urdf(wide)


@pytest.mark.parametrize(
    ("filename", "message"),
    [
        ("../../../../../../../../etc/passwd", "(?s)two folders above.*H3-BODY-114"),
        ("../../../secret.stl", "(?s)two folders above.*H3-BODY-114"),
        ("package://x/../../../../a.stl", "(?s)two folders above.*H3-BODY-114"),
        ("../passwd", r"(?s)expected one of \.glb.*H3-BODY-114"),
        ("http://example.org/a.stl", r"(?s)path of.*H3-BODY-114"),
        ("a" * 5000 + ".stl", r"(?s)at most 1024 characters.*H3-BODY-114"),
    ],
)
def test_meshes_outside_are_refused(tmp_path: Path, filename: str, message: str) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    body = f'<link name="a"><visual><geometry><mesh filename="{filename}"/></geometry></visual></link>'
    with pytest.raises(FormatError, match=message):
        read_urdf(_write(tmp_path / "a" / "b", body))


@pytest.mark.parametrize("filename", ["/etc/hosts.stl", "file:///etc/hosts.stl"])
def test_absolute_paths_are_looked_for_beside_the_urdf(
    tmp_path: Path, filename: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Drafts of some robots name the disk of their author (romeo_laas_small.urdf); nothing outside is ever opened."""
    body = f'<link name="a"><visual><geometry><mesh filename="{filename}"/></geometry></visual></link>'
    (tmp_path / "a" / "b").mkdir(parents=True)
    path = _write(tmp_path / "a" / "b", body)
    link = read_urdf(path, allow_missing=True).links[0]
    assert link.visuals[0].geometry.file == path.parent / "hosts.stl"
    assert "path of another machine" in caplog.text


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def _package(folder: Path, name: str = "") -> Path:
    """A package with the mesh ``meshes/a.obj``; its manifest has ``name``, if that is given."""
    (folder / "meshes").mkdir(parents=True)
    (folder / "urdf").mkdir()
    (folder / "meshes" / "a.obj").write_text(TRIANGLE)
    if name:
        (folder / "package.xml").write_text(f"<package><name>{name}</name></package>")
    return folder


def _named_mesh(folder: Path, filename: str) -> Path | None:
    body = f'<link name="a"><visual><geometry><mesh filename="{filename}"/></geometry></visual></link>'
    return read_urdf(_write(folder, body), allow_missing=True).links[0].visuals[0].geometry.file


@pytest.mark.parametrize("filename", ["package://hand/meshes/a.obj", "model://hand/meshes/A.OBJ"])
@pytest.mark.parametrize(("place", "name"), [("ws/hand", ""), ("ws/clone-2", "hand"), ("ws/group/hand", "hand")])
def test_a_package_is_the_one_of_that_name(tmp_path: Path, filename: str, place: str, name: str) -> None:
    arm, hand = _package(tmp_path / "ws/arm", "arm"), _package(tmp_path / place, name)
    assert _named_mesh(arm / "urdf", filename) == hand / "meshes/a.obj"
    (hand / "meshes/a.obj").unlink()
    assert _named_mesh(arm / "urdf", filename).is_relative_to(hand)  # missing, and never the arm's


@pytest.mark.parametrize("place", ["ws/robots", "ws/robots/arms/arm"])
def test_a_folder_of_the_name_is_taken_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, place: str
) -> None:
    """Its ``package.xml`` has another name, as in example-robot-data; a package of the name itself is taken before."""
    robots = _package(tmp_path / "ws/robots", "robot_descriptions")
    body = '<mesh filename="package://robots/meshes/a.obj"/>'
    shapes = (f"<{kind}><geometry>{body}</geometry></{kind}>" for kind in ("visual", "collision"))
    (tmp_path / place / "urdf").mkdir(parents=True, exist_ok=True)
    read = read_urdf(
        _write(tmp_path / place / "urdf", f'<link name="a">{"".join(shapes)}</link>'), allow_missing=True
    ).links[0]
    assert read.visuals[0].geometry.file == robots / "meshes/a.obj"
    assert caplog.text.count("the folder of that name is taken") == 1
    named = _package((tmp_path / place).parent / "clone", "robots")
    assert _named_mesh(tmp_path / place / "urdf", "package://robots/meshes/a.obj") == named / "meshes/a.obj"


def test_packages_are_found_where_ros_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arm, hand = _package(tmp_path / "a/b/c/d/e/f/g/h/arm"), _package(tmp_path / "opt/share/hand")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "opt"))
    assert _named_mesh(arm / "urdf", "package://hand/meshes/a.obj") == hand / "meshes/a.obj"
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "opt/share"))
    assert _named_mesh(arm / "urdf", "package://hand/meshes/a.obj") == hand / "meshes/a.obj"


def test_a_mesh_of_an_unknown_package_is_taken_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    arm = _package(tmp_path / "arm")
    assert _named_mesh(arm / "urdf", "package://hand/meshes/a.obj") == arm / "meshes/a.obj"
    assert "there is no package 'hand'" in caplog.text


@pytest.mark.parametrize(
    ("filename", "on_disk"),
    [
        ("file:///home/u/ws/share/arm/meshes/a.obj", "meshes/a.obj"),
        ("C:\\ws\\arm\\meshes\\a.obj", "meshes/a.obj"),
        ("..\\meshes\\a.obj", "meshes/a.obj"),
        ("my%20mesh.obj", "urdf/my mesh.obj"),
        ("Meshes/B.obj", "urdf/meshes/b.OBJ"),
        ("Sockel \u00fc.obj", "urdf/Sockel u\u0308.obj"),
    ],
)
def test_paths_of_other_machines_are_read_as_meant(tmp_path: Path, filename: str, on_disk: str) -> None:
    arm = _package(tmp_path / "arm")
    (arm / on_disk).parent.mkdir(exist_ok=True)
    (arm / on_disk).write_text(TRIANGLE)
    assert _named_mesh(arm / "urdf", filename).resolve() == arm / on_disk


@pytest.mark.parametrize(
    "filename", ["%2e%2e/%2e%2e/%2e%2e/a.obj", "package://arm/%2e%2e/a.obj", "package://arm/../a.obj"]
)
def test_decoded_paths_do_not_climb(tmp_path: Path, filename: str) -> None:
    with pytest.raises(FormatError, match=r"(?s)a\.obj.*H3-BODY-114"):
        _named_mesh(_package(tmp_path / "x/y/arm") / "urdf", filename)


# --- files of other simulators, read as their users mean them -----------------------------------------------------------
def _read(folder: Path, body: str, caplog: pytest.LogCaptureFixture) -> tuple[Urdf, str]:
    caplog.clear()
    return read_urdf(_write(folder, body)), caplog.text


@pytest.mark.parametrize(
    ("body", "warning"),
    [
        ('<link name="a"/><sensor:camera name="c"/>', "left out: <sensor:camera>"),
        ('<link name="a"/><x:link name="b"/>', "left out: <x:link>"),
        ('<link name="a"/><gazebo/><gazebo/><transmission/>', r"left out: <gazebo> (2), <transmission>"),
        ('<link name="a"><visual/></link>', "link a, visual: it has no geometry, it is left out"),
        ('<link name="a"><collision><geometry/></collision></link>', "link a, collision: it has no geometry"),
        ('<link name="a"><visual><geometry><mesh filename=" "/></geometry></visual></link>', "has no file name"),
        ('<link name="a"/><material name="m"><color rgba="1 0 0"/></material>', "read as opaque"),
    ],
)
def test_what_cannot_be_read_is_left_out_by_name(
    tmp_path: Path, body: str, warning: str, caplog: pytest.LogCaptureFixture
) -> None:
    urdf, warned = _read(tmp_path, body, caplog)
    assert [link.name for link in urdf.links] == ["a"]
    assert not urdf.links[0].visuals + urdf.links[0].collisions
    assert warning in warned


@pytest.mark.parametrize(
    "head", ["<!-- a -- b -->\n<?xml version='1.0'?>", "\ufeff\n<?xml version='1.0'?><!-- <a> -->"]
)
def test_comments_stand_anywhere(tmp_path: Path, head: str) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(f'{head}<robot name="r"><link name="a"/></robot>', encoding="utf-8")
    assert read_urdf(path).root == "a"


@pytest.mark.parametrize("first", [0, 1])
def test_a_color_given_in_one_link_is_that_of_others_that_name_it(tmp_path: Path, first: int) -> None:
    material = ['<material name="red"><color rgba="1 0 0 1"/></material>', '<material name="red"/>']
    links = [
        f'<link name="{n}"><visual><geometry><sphere radius="1"/></geometry>{m}</visual></link>'
        for n, m in zip("ab", material[first:] + material[:first], strict=True)
    ]
    urdf = read_urdf(_write(tmp_path, "".join(links) + _joint("1", "a", "b")))
    assert [link.visuals[0].color for link in urdf.links] == [(255, 0, 0)] * 2


@pytest.mark.parametrize("axis", ["<axis/>", '<axis xyz=""/>', '<axis xyz="0 0 0"/>', '<axis xyz="0"/>'])
def test_fixed_joints_need_no_axis(tmp_path: Path, axis: str, caplog: pytest.LogCaptureFixture) -> None:
    urdf, warned = _read(tmp_path, PAIR + _joint("1", "a", "b", "fixed", axis), caplog)
    assert urdf.joints[0].kind == "fixed"
    assert not warned


def test_a_lower_limit_above_the_upper_one_is_no_limit(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    limit = '<axis xyz="0 0 1"/><limit lower="1" upper="-1"/>'
    urdf, warned = _read(tmp_path, PAIR + _joint("1", "a", "b", "prismatic", limit), caplog)
    assert (urdf.joints[0].lower, urdf.joints[0].upper) == (-np.inf, np.inf)
    assert "joint 1: its lower limit 1.0 is above the upper one -1.0, read as no limit" in warned
    assert load_robot(tmp_path / "robot.urdf").rest.tolist() == [0.0]


def test_vectors_of_too_many_numbers_lose_the_rest(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    geometry = '<origin rpy="0 0 1.5 0"/><geometry><mesh filename="a.obj" scale="2 3 4 1"/></geometry>'
    urdf, warned = _read(tmp_path, f'<link name="a"><visual>{geometry}</visual></link>', caplog)
    assert urdf.links[0].visuals[0].geometry.scale == (2, 3, 4)
    np.testing.assert_allclose(urdf.links[0].visuals[0].origin[:2, 0], [np.cos(1.5), np.sin(1.5)])
    assert "expected 3 numbers, got 4 (2 3 4 1)" in warned


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 1, 0), (-1, 2, 0.5)])
def test_a_plane_is_a_large_box_below_it(tmp_path: Path, normal: tuple[float, ...]) -> None:
    geometry = f'<geometry><plane normal="{" ".join(map(str, normal))}"/></geometry><origin xyz="0 0 0.5"/>'
    path = _write(tmp_path, f'<link name="a"><collision>{geometry}</collision><visual>{geometry}</visual></link>')
    robot = load_plain(path, up="y")
    up = np.array(normal) / np.linalg.norm(normal)
    heights = (robot.links[0].mesh.vertices - [0, 0, 0.5]) @ up
    assert abs(heights.max()) < 1e-6
    assert abs(heights.min() + 0.1) < 1e-6
    assert isinstance(robot.links[0].shapes[0], Box)


def test_a_namespace_does_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(
        f'\n\n<?xml version="1.0"?><robot name="r" xmlns="http://www.ros.org">{PAIR}{_joint("1", "a", "b")}</robot>\0'
    )
    assert [link.name for link in read_urdf(path).links] == ["a", "b"]
    path.write_text(f'<robot name="r" xmlns="http://ros.org/wiki/xacro"><property name="x" value="1"/>{PAIR}</robot>')
    with pytest.raises(FormatError, match="H3-BODY-119"):
        read_urdf(path)


def test_mimics_of_joints_that_cannot_lead_move_on_their_own(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    body = LINKS + _joint("1", "a", "b") + _joint("2", "b", "c", "revolute", '<mimic joint="1"/>')
    urdf, warned = _read(tmp_path, body, caplog)
    assert [j.name for j in urdf.movable] == ["2"]
    assert "joint 2: '1', which it mimics, is fixed; it moves on its own" in warned
    assert (
        "'z', which it mimics, is not there"
        in _read(tmp_path, PAIR + _joint("1", "a", "b", "revolute", '<mimic joint="z"/>'), caplog)[1]
    )


def test_a_floating_joint_is_held(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    urdf, warned = _read(tmp_path, PAIR + _joint("1", "a", "b", "floating"), caplog)
    assert urdf.movable == ()
    assert "joint 1: a floating joint is held" in warned


def test_too_many_links_are_refused_and_many_are_read(tmp_path: Path) -> None:
    body = "".join(f'<link name="{k}"/>' for k in range(10_001))
    with pytest.raises(FormatError, match=r"(?s)10000.*10001.*H3-BODY-113"):
        read_urdf(_write(tmp_path, body))
    chain = "".join(f'<link name="{k}"/>' for k in range(3000))
    chain += "".join(_joint(f"j{k}", str(k), str(k + 1), "revolute", LIMIT) for k in range(2999))
    assert len(load_plain(_write(tmp_path, chain)).joint_names) == 2999


def test_missing_meshes_are_listed(tmp_path: Path) -> None:
    body = '<link name="a"><visual><geometry><mesh filename="gone/one.glb"/></geometry></visual></link>'
    for load in (read_urdf, load_plain):
        with pytest.raises(MissingAssetError, match=r"(?s)1.*one\.glb.*H3-BODY-115"):
            load(_write(tmp_path, body))


@pytest.mark.parametrize(
    "content", [b"", b"not xml", b"<robot><link", b"<sdf/>", b'{"json": 1}', b"\xff\xfe\x00garbage"]
)
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.urdf"
    path.write_bytes(content)
    with pytest.raises(H3DataError):
        read_urdf(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="H3-BODY-116"):
        read_urdf(tmp_path / "no.urdf")


def test_cut_off_mesh_is_refused(tmp_path: Path) -> None:
    from h3data.builtin import builtin_path

    whole = builtin_path("robots/quad_arm/meshes/arm_wrist.glb").read_bytes()
    body = '<link name="a"><visual><geometry><mesh filename="a.glb"/></geometry></visual></link>'
    path = _write(tmp_path, body)
    for cut in (0, 10, 100, len(whole) // 2, len(whole) - 4):
        (tmp_path / "a.glb").write_bytes(whole[:cut])
        with pytest.raises(H3DataError):  # failures are not kept
            load_plain(path)


def test_a_changed_file_is_read_again(tmp_path: Path) -> None:
    path = _write(tmp_path, '<link name="a"/>')
    before = load_robot(path)
    assert load_robot(path) is before
    _write(tmp_path, '<link name="other"/>')
    assert [link.name for link in load_robot(path).links] == ["other"]


WORDS = (
    "nan",
    "1e308",
    "-1",
    "",
    '"',
    "<",
    ">",
    "&x;",
    "revolute",
    "spherical",
    "a",
    "b",
    "jb",
    "../../../x.stl",
    "\x01",
    "é",
)


@settings(derandomize=True, max_examples=examples(75), deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 30), st.sampled_from(WORDS)), min_size=1, max_size=3))
def test_a_damaged_file_loads_or_is_refused_in_words(damage: list[tuple[int, int, str]]) -> None:
    body = LINKS + _joint("jb", "a", "b", "prismatic", '<origin xyz="1 2 3" rpy="0 1 0"/><axis xyz="0 0 1"/>' + LIMIT)
    body += _joint("jc", "b", "c", "revolute", '<mimic joint="jb" multiplier="2" offset="1"/>')
    text = f'<robot name="test"><material name="m"><color rgba="1 0 0 1"/></material>{body}</robot>'
    for place, length, word in damage:
        place %= len(text)
        text = text[:place] + word + text[place + length :]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(text)
        try:
            robot = load_robot(path)
        except H3DataError:
            return
    assert robot.link_matrices(ROOT, robot.rest[None]).shape == (1, len(robot.links), 4, 4)
