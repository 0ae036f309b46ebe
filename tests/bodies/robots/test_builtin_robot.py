"""The built-in robot: posture, feet on the floor, cameras that see past the robot, and its description files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import Robot, load_robot, robot_names
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data.geometry import ground_pose, quat_from_axis_angle, quat_to_matrix
from h3data.mesh.loading import load_mesh
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
    np.testing.assert_allclose(size, [1.1, 0.85, 0.4], atol=0.05)
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


def test_places_and_limits_are_spots(robot: Robot) -> None:
    """spec/habitat.md 4 (base offset); limits as published (hip 45 deg to both sides, knee 14 to 160 deg bent)."""
    assert robot.base_height_m == pytest.approx(0.48, abs=1e-3)
    assert {name: discs.tolist() for name, discs in robot.base_profiles.items()} == {
        "habitat": [0, 0.225],
        "three": [0, 0.25, -0.25],
    }
    assert [c.pose[0] for c in robot.base_cylinders("three")] == [0, 0.25, -0.25]
    with pytest.raises(InputError, match=r"(?s)'four'.*three.*H3-BODY-094"):
        robot.base_cylinders("four")
    degrees = np.degrees(np.stack([robot.lower, robot.upper], -1)).round()
    assert degrees[:8].tolist() == [
        [-150, 180],
        [-180, 30],
        [-160, 160],
        [0, 180],
        [-160, 160],
        [-105, 105],
        [-165, 165],
        [-90, 0],
    ]
    for leg in range(4):
        assert degrees[8 + 3 * leg : 11 + 3 * leg].tolist() == [[-45, 45], [-52, 131], [-160, -14]]


def test_the_arm_reaches_as_far_as_spots(robot: Robot) -> None:
    """0.984 m from the shoulder to the end of the hand, arm straight; hand and arm are then at the shoulder's height."""
    straight = robot.rest.copy()
    straight[[1, 3]] = 0
    frames = robot.link_matrices(ROOT, straight[None])[0]
    shoulder, hand = (frames[robot.link_index(n)] for n in ("arm_upper", "arm_hand"))
    np.testing.assert_allclose(shoulder[:3, 3], [0.292, robot.base_height_m + 0.188, 0], atol=1e-6)
    tip = (hand @ [0.17, 0, 0, 1])[:3]
    assert np.linalg.norm(tip - shoulder[:3, 3]) == pytest.approx(0.984, abs=0.03)


@pytest.mark.parametrize(
    ("name", "size", "hfov"),
    [("robot_arm", (224, 171), 55), ("robot_arm_habitat", (171, 224), 55), ("robot_arm_rgb", (640, 480), 47)],
)
def test_hand_cameras_look_along_the_hand(robot: Robot, name: str, size: tuple[int, int], hfov: float) -> None:
    """As in Habitat: the stowed hand, and with it the picture's middle, points 0.14 rad upwards."""
    camera = robot.camera(name)
    assert (camera.width, camera.height, camera.hfov_deg) == (*size, hfov)
    pose = robot.camera_poses(name, robot.link_matrices(ROOT, robot.rest[None]))[0]
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose[:3, 2], [np.cos(0.14), np.sin(0.14), 0], atol=1e-6)
    np.testing.assert_allclose(pose[:3, 0], [0, 0, 1], atol=1e-6)  # the picture's right is the robot's right


def test_five_cameras_look_around(robot: Robot) -> None:
    """Front ones from Habitat's Euler angles (spec/habitat.md 4): Rz Ry Rx in the root frame, a camera that looks along -z."""
    frames = robot.link_matrices(ROOT, robot.rest[None])
    poses = {
        n: robot.camera_poses(f"robot_{n}", frames)[0] for n in ("front_left", "front_right", "left", "right", "back")
    }
    given = {
        "front_right": ((0.41648, 0, 0.036148), (0.0290787, -0.940569, -0.38998877)),
        "front_left": ((0.41648, 0, -0.037403), (-3.1125141, -0.940569, 2.751605)),
    }
    for name, (position, angles) in given.items():
        x, y, z = (quat_to_matrix(quat_from_axis_angle(np.eye(3)[k], angles[k])) for k in range(3))
        np.testing.assert_allclose(poses[name][:3, :3], z @ y @ x @ np.diag([1, -1, -1]), atol=2e-3)
        np.testing.assert_allclose(poses[name][:3, 3] - [0, robot.base_height_m, 0], position, atol=1e-3)
    bearing = {n: np.degrees(np.arctan2(-p[2, 2], p[0, 2])) for n, p in poses.items()}
    expected = {"front_left": -38, "front_right": 38, "left": 90, "right": -90, "back": 180}
    for name, angle in expected.items():
        assert (bearing[name] - angle + 180) % 360 - 180 == pytest.approx(0, abs=0.5), name
        assert -0.5 < poses[name][1, 2] < -0.2  # down
    sizes = {(c.width, c.height, c.hfov_deg) for c in robot.cameras if c.name.removeprefix("robot_") in poses}
    assert sizes == {(120, 212, 58.0)}


@pytest.mark.parametrize("gripper", [0.0, -1.56])
def test_nothing_of_the_robot_is_in_its_own_pictures(robot: Robot, gripper: float) -> None:
    """Points all over every triangle: none is before a camera and inside its picture."""
    joints = robot.rest.copy()
    joints[7] = gripper
    frames = robot.link_matrices(ROOT, joints[None])
    parts = _vertices(robot, frames[0])
    grid = np.array([(i, j, 9 - i - j) for i in range(10) for j in range(10 - i)]) / 9
    meshes = [(link.name, link.mesh.faces) for link in robot.links if link.mesh is not None]
    points = {name: np.einsum("gk,fkc->fgc", grid, parts[name][faces]) for name, faces in meshes}
    for camera in robot.cameras:
        pose = robot.camera_poses(camera.name, frames)[0]
        tan_x = np.tan(np.radians(camera.hfov_deg / 2))
        tan_y = tan_x * camera.height / camera.width
        for name, where in points.items():
            x, y, z = np.moveaxis((where - pose[:3, 3]) @ pose[:3, :3], -1, 0)
            assert not np.any((z > 1e-4) & (np.abs(x) < z * tan_x) & (np.abs(y) < z * tan_y)), (camera.name, name)


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
    cylinders = robot.base_cylinders("habitat")
    front = cylinders[1]
    assert [s.pose[0] for s in cylinders] == [0, 0.225]
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
        ours = load_mesh(path)
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
    with pytest.raises(InputError, match=r"(?s)\[1, 20\].*quad_arm.*\[1, 7\].*H3-BODY-098"):
        robot.link_matrices(ROOT, np.zeros((1, 7)))


def test_unknown_names_say_what_there_is(robot: Robot) -> None:
    with pytest.raises(InputError, match=r"(?s)'spot'.*quad_arm.*H3-BODY-102"):
        load_robot("spot")
    with pytest.raises(InputError, match=r"(?s)'x'.*robot_arm.*H3-BODY-093"):
        robot.camera("x")


def test_joint_targets_beyond_limits_are_clamped_and_named(robot: Robot) -> None:
    wanted = np.stack([robot.rest, robot.rest])
    wanted[1, [1, 3, 10]] = [-4, 9, 0.1]
    targets = robot.clamp(wanted)
    assert np.argwhere(targets.clamped).tolist() == [[1, 1], [1, 3], [1, 10]]
    np.testing.assert_allclose(targets.positions[1, [1, 3, 10]], [robot.lower[1], robot.upper[3], robot.upper[10]])
    np.testing.assert_array_equal(targets.positions[0], robot.rest)
    assert not robot.clamp(targets.positions).clamped.any()


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ([np.nan] + [0.0] * 19, r"(?s)arm_0.*H3-BODY-097"),
        ([0.0] * 19 + [np.inf], r"(?s)rear_right_knee.*H3-BODY-097"),
        ([0.0] * 7, r"(?s)\[\.\.\., 20\].*quad_arm.*\[7\].*H3-BODY-100"),
        (0.0, r"(?s)\[\].*H3-BODY-100"),
        (["a"] * 20, "H3-BODY-101"),
    ],
)
def test_joint_targets_that_are_none_are_refused(robot: Robot, wanted: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        robot.clamp(wanted)  # pyright: ignore[reportArgumentType]


# --- the other one ----------------------------------------------------------------------------------------------------
def test_the_arm_of_lift_arm_goes_out_in_four_stages_alike() -> None:
    robot = load_robot("lift_arm")
    assert robot.joint_names == (
        "wheel_left",
        "wheel_right",
        "lift",
        "arm_extend",
        "wrist_yaw",
        "wrist_pitch",
        "wrist_roll",
        "gripper",
        "head_pan",
        "head_tilt",
    )
    joints = np.tile(robot.rest, (3, 1))
    joints[1, 3], joints[2, [2, 3]] = 0.13, [1.0, 0.13]
    frames = robot.link_matrices(np.tile(ROOT, (3, 1)), joints)
    wrist = frames[:, robot.link_index("wrist_yaw"), :3, 3]
    np.testing.assert_allclose(wrist[1] - wrist[0], [0, 0, 0.52], atol=1e-9)  # to the right
    np.testing.assert_allclose(wrist[2] - wrist[1], [0, 0.4, 0], atol=1e-9)
    stages = [frames[1, robot.link_index(f"arm_stage_{k}"), 2, 3] for k in range(4)]
    np.testing.assert_allclose(np.diff(stages), 0.13, atol=1e-9)
    parts = np.concatenate(list(_vertices(robot, frames[0]).values()))
    assert abs(parts[:, 1].min()) < 1e-3
    assert 1.35 < parts[:, 1].max() < 1.47


def test_fingers_of_lift_arm_close_together() -> None:
    robot = load_robot("lift_arm")
    joints = np.tile(robot.rest, (2, 1))
    joints[1, 7] = 0.4
    frames = robot.link_matrices(np.tile(ROOT, (2, 1)), joints)
    hand = np.linalg.inv(frames[:, robot.link_index("hand")])
    left, right = (
        (hand @ frames[:, robot.link_index(f"finger_{side}")] @ np.array([0, -0.18, 0, 1]))[:, :3]
        for side in ("left", "right")
    )
    np.testing.assert_allclose(left * [-1, 1, 1], right, atol=1e-9)
    assert left[1, 0] - right[1, 0] > left[0, 0] - right[0, 0] + 0.1


@pytest.mark.parametrize("name", robot_names())
def test_every_built_in_robot_stands_inside_its_limits_with_shapes_and_a_hand(name: str) -> None:
    robot = load_robot(name)
    assert robot.name == name
    assert not robot.clamp(robot.rest).clamped.any()
    assert all(link.mesh is not None and link.shapes for link in robot.links)
    assert robot.hand_link >= 0
    assert {"robot_arm"} <= {c.name for c in robot.cameras}


@pytest.mark.parametrize(
    ("settings_text", "message"),
    [
        ("base_hight_m = 1.0", r"(?s)base_hight_m.*H3-BODY-111"),
        ("rest = [0.0, 1.0]", r"(?s)rest has 2 positions.*1.*H3-BODY-110"),
        ("base_height_m = 'high'", "H3-BODY-111"),
        ("not toml at all [", "H3-BODY-111"),
        ('hand_link = "z"', r"(?s)hand_link is 'z'.*H3-BODY-110"),
        ("base_discs_m = []", r"(?s)no discs.*H3-BODY-110"),
        ("rest = [nan]", "H3-BODY-109"),
        ("[base_profiles]\nwide = [inf]", "H3-BODY-109"),
        ('[[legs]]\njoints=["j", "j", "k"]\nfoot=[0,0,0]', r"(?s)joint 'k', which is no movable one.*H3-BODY-110"),
        (
            '[[cameras]]\nname="c"\nlink="b"\nposition=[0,0,0]\nforward=[0,0,1]\nwidth=4\nheight=3\nhfov_deg=60',
            r"(?s)camera c has no picture.*H3-BODY-110",
        ),
        (
            '[[cameras]]\nname="c"\nlink="z"\nposition=[0,0,0]\nforward=[1,0,0]\nwidth=4\nheight=3\nhfov_deg=60',
            r"(?s)camera c is fixed to 'z'.*H3-BODY-110",
        ),
    ],
)
def test_bad_descriptions_are_refused(tmp_path: Path, settings_text: str, message: str) -> None:
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    (tmp_path / "robot.urdf").write_text(f'<robot name="t"><link name="a"/><link name="b"/>{joint}</robot>')
    (tmp_path / "robot.toml").write_text(settings_text)
    with pytest.raises(FormatError, match=message):
        load_robot(tmp_path / "robot.urdf")
