"""The built-in robot: posture, feet on the floor, cameras that see past the robot, and its description files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import Robot, load_robot
from h3data.bodies.meshes import read_plain_glb
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data.geometry import ground_pose, quat_from_axis_angle, quat_to_matrix
from h3data.scene.records import Capsule
from h3data.srgb import bytes_to_linear, linear_to_bytes

ROOT = np.array([[0, 0, 0, 0, 0, 0, 1.0]])


@pytest.fixture
def robot() -> Robot:
    return load_robot("quad_arm")


def _vertices(robot: Robot, frames: np.ndarray) -> dict[str, np.ndarray]:
    return {
        link.name: link.mesh.vertices @ frames[k, :3, :3].T + frames[k, :3, 3]
        for k, link in enumerate(robot.links)
        if link.mesh is not None
    }


def test_joints_have_habitats_order_and_posture(robot: Robot) -> None:
    """spec/habitat.md 4: arm 0-6, gripper 7, legs 8-19."""
    names = robot.joint_names
    assert len(names) == 20
    assert names[:8] == (*(f"arm_{k}" for k in range(7)), "gripper")
    assert [n.rsplit("_", 2)[-1] for n in names[8:]] == ["roll", "pitch", "knee"] * 4
    np.testing.assert_allclose(robot.rest, [0, -3.14, 0, 3.0, 0, 0, 0, 0, *[0, 0.7, -1.5] * 4])
    assert (robot.rest >= robot.lower).all()
    assert (robot.rest <= robot.upper).all()
    for k, joint in enumerate(robot.joint_links):
        assert robot.kinds[joint] == 1, names[k]


def test_feet_stand_on_the_floor(robot: Robot) -> None:
    parts = _vertices(robot, robot.link_matrices(ROOT, robot.rest[None])[0])
    feet = {name: v for name, v in parts.items() if name.endswith("shank")}
    assert len(feet) == 4
    for vertices in feet.values():
        assert abs(vertices[:, 1].min()) < 2e-3
    everything = np.concatenate(list(parts.values()))
    size = np.ptp(everything, axis=0)
    np.testing.assert_allclose(size, [1.1, 0.93, 0.5], atol=0.05)
    front = np.mean([v[:, 0].mean() for n, v in feet.items() if n.startswith("front")])
    left = np.mean([v[:, 2].mean() for n, v in feet.items() if "left" in n])
    assert front > 0.2  # x is forward
    assert left < -0.1  # z is right


def test_stowed_arm_does_not_touch_the_body(robot: Robot) -> None:
    parts = _vertices(robot, robot.link_matrices(ROOT, robot.rest[None])[0])
    top = parts["base_link"][:, 1].max()
    for name in ("arm_upper_end", "arm_elbow", "arm_forearm", "arm_wrist", "arm_hand", "gripper_jaw"):
        assert parts[name][:, 1].min() > top - 0.005, name
    assert parts["arm_forearm"][:, 1].min() > parts["arm_upper"][:, 1].max() - 0.03


@pytest.mark.parametrize("name", ["robot_arm", "robot_arm_habitat"])
def test_arm_camera_looks_forward_and_a_little_down(robot: Robot, name: str) -> None:
    camera = robot.camera(name)
    assert (camera.width, camera.height) == ((224, 171) if name == "robot_arm" else (171, 224))
    pose = robot.camera_poses(name, robot.link_matrices(ROOT, robot.rest[None]))[0]
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    down = np.degrees(np.arcsin(-pose[1, 2]))
    assert 5 < down < 15
    assert pose[0, 2] > 0.95
    np.testing.assert_allclose(pose[:3, 0], [0, 0, 1], atol=1e-6)  # the picture's right is the robot's right


@pytest.mark.parametrize("name", ["robot_arm", "robot_arm_habitat"])
@pytest.mark.parametrize("gripper", [0.0, -1.56])
def test_nothing_of_the_robot_is_in_its_own_picture(robot: Robot, name: str, gripper: float) -> None:
    """Points all over every triangle: none is before the camera and inside its picture."""
    joints = robot.rest.copy()
    joints[7] = gripper
    frames = robot.link_matrices(ROOT, joints[None])
    camera, pose = robot.camera(name), robot.camera_poses(name, frames)[0]
    tan_x = np.tan(np.radians(camera.hfov_deg / 2))
    tan_y = tan_x * camera.height / camera.width
    parts = _vertices(robot, frames[0])
    grid = np.array([(i, j, 9 - i - j) for i in range(10) for j in range(10 - i)]) / 9
    for link in robot.links:
        if link.mesh is None:
            continue
        corners = parts[link.name][link.mesh.faces]
        x, y, z = np.moveaxis((np.einsum("gk,fkc->fgc", grid, corners) - pose[:3, 3]) @ pose[:3, :3], -1, 0)
        assert not np.any((z > 1e-4) & (np.abs(x) < z * tan_x) & (np.abs(y) < z * tan_y)), link.name


def test_link_matrices_against_the_plain_product(robot: Robot) -> None:
    rng = np.random.default_rng(3)
    joints = rng.uniform(np.maximum(robot.lower, -3), np.minimum(robot.upper, 3), (7, 20))
    base = ground_pose(rng.uniform(-5, 5, (7, 2)), rng.uniform(-3, 3, 7), 0.3)
    found = robot.link_matrices(base, joints)
    column = {int(link): k for k, link in enumerate(robot.joint_links)}
    for t in range(7):
        frames: list[np.ndarray] = []
        root = np.eye(4)
        root[:3, :3], root[:3, 3] = quat_to_matrix(base[t, 3:]), base[t, :3]
        for k, link in enumerate(robot.links):
            turn = np.eye(4)
            if k in column:
                turn[:3, :3] = quat_to_matrix(quat_from_axis_angle(robot.axes[k], joints[t, column[k]]))
            parent = root @ robot.to_base if link.parent < 0 else frames[link.parent]
            frames.append(parent @ robot.origins[k] @ turn)
        np.testing.assert_allclose(found[t], np.stack(frames), atol=1e-12)


@settings(derandomize=True, max_examples=25, deadline=None)
@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(-4, 4))
def test_base_pose_moves_the_robot_rigidly(x: float, z: float, heading: float) -> None:
    robot = load_robot("quad_arm")
    home = robot.link_matrices(ROOT, robot.rest[None])[0]
    there = robot.link_matrices(ground_pose(np.array([[x, z]]), np.array([heading])), robot.rest[None])[0]
    between = np.linalg.inv(home) @ home[0]
    np.testing.assert_allclose(np.linalg.inv(there) @ there[0], between, atol=1e-9)
    np.testing.assert_allclose(there[0, :3, 3], [x, robot.base_height_m, z], atol=1e-9)


def test_base_shapes_are_the_papers_two_cylinders(robot: Robot) -> None:
    front = robot.base_shapes[1]
    assert [s.pose[0] for s in robot.base_shapes] == [0, 0.225]
    assert front.radius == 0.25
    assert front.pose[1] - front.half_height == pytest.approx(0)
    assert 0.55 < 2 * front.half_height < 0.7


def test_collision_shapes_cover_their_links(robot: Robot) -> None:
    for link in robot.links:
        assert link.shapes, link.name
        if not link.name.startswith("arm") or link.mesh is None:
            continue
        outside = np.min([_distance(shape, link.mesh.vertices) for shape in link.shapes], axis=0)
        assert np.mean(outside > 0.012) < 0.25, link.name
        assert outside.max() < 0.05, link.name


def _distance(capsule, points: np.ndarray) -> np.ndarray:
    assert isinstance(capsule, Capsule)
    way = capsule.end - capsule.start
    along = np.clip((points - capsule.start) @ way / max(way @ way, 1e-9), 0, 1)
    return np.linalg.norm(points - capsule.start - along[:, None] * way, axis=1) - capsule.radius


def test_meshes_are_plain_glb_that_trimesh_reads_alike(robot: Robot) -> None:
    import trimesh

    total = sum(f.stat().st_size for f in builtin_path("robots/quad_arm").rglob("*") if f.is_file())
    assert total < 400_000
    for name in ("base_link", "arm_hand", "front_left_thigh"):
        path = builtin_path(f"robots/quad_arm/meshes/{name}.glb")
        ours = read_plain_glb(path)
        assert ours is not None
        other = trimesh.load(path, force="mesh", process=False)
        assert len(other.faces) == len(ours.faces)
        np.testing.assert_allclose(other.bounds, ours.bounds, atol=1e-6)
        np.testing.assert_allclose(other.area, _area(ours), rtol=1e-5)


def _area(mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_srgb_bytes_survive_the_way_through_linear() -> None:
    every = np.arange(256)
    np.testing.assert_array_equal(linear_to_bytes(np.round(bytes_to_linear(every), 6)), every)


def test_wrong_joint_count_is_refused(robot: Robot) -> None:
    with pytest.raises(InputError, match=r"Expected joint positions \[1, 20\] of quad_arm, got \[1, 7\]"):
        robot.link_matrices(ROOT, np.zeros((1, 7)))


def test_unknown_names_say_what_there_is(robot: Robot) -> None:
    with pytest.raises(InputError, match=r"No built-in robot 'spot'.*quad_arm"):
        load_robot("spot")
    with pytest.raises(InputError, match=r"no camera 'x'.*robot_arm"):
        robot.camera("x")


@pytest.mark.parametrize(
    ("settings_text", "message"),
    [
        ("base_hight_m = 1.0", "base_hight_m"),
        ("rest = [0.0, 1.0]", "rest has 2 positions, the URDF 1"),
        ("base_height_m = 'high'", "robot description"),
        ("not toml at all [", "robot description"),
        (
            '[[cameras]]\nname="c"\nlink="z"\nposition=[0,0,0]\nforward=[1,0,0]\nwidth=4\nheight=3\nhfov_deg=60',
            "camera c is fixed to 'z'",
        ),
    ],
)
def test_bad_descriptions_are_refused(tmp_path: Path, settings_text: str, message: str) -> None:
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    (tmp_path / "robot.urdf").write_text(f'<robot name="t"><link name="a"/><link name="b"/>{joint}</robot>')
    (tmp_path / "robot.toml").write_text(settings_text)
    with pytest.raises(FormatError, match=message):
        load_robot(tmp_path / "robot.urdf")
