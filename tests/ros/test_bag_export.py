"""Bags of ROS 2 that recordings become, read by rosbags and by a reader of other authors."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason='needs the extra: pip install "h3data[ros]"')

from hypothesis import given
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

import h3data
from h3data.errors import InputError, MissingExtraError
from h3data.geometry import heading_from_quat, quat_rotate
from h3data.recording import Recording, read_mcap
from h3data.render.camera import pinhole
from h3data.scene import FreeSpace, load_scene
from h3data_pipelines.cli import main
from h3data_ros import messages
from h3data_ros.bag_export import START_NS, BagCamera, write_rosbag2
from h3data_ros.frames import pose_from_ros, pose_to_ros, safe_names
from h3data_ros.scans import cast_scans
from tests.ros.recordings import crossing

STEPS = 40


@pytest.fixture(scope="module")
def recording() -> Recording:
    return crossing(STEPS)


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def bag(request: pytest.FixtureRequest, recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "bag"
    write_rosbag2(recording, path, storage=request.param, lidar_rays=90)
    return path


def read(path: Path) -> tuple[dict[str, list[tuple[int, Any]]], dict[str, Any]]:
    """Messages with their times by topic, and connections by topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, t, data in reader.messages():
            found.setdefault(connection.topic, []).append((t, reader.deserialize(data, connection.msgtype)))
        return found, {connection.topic: connection for connection in reader.connections}


@given(st.lists(st.floats(width=32, allow_infinity=False), min_size=7, max_size=7))
def test_frames_convert_exactly_both_ways(numbers: list[float]) -> None:
    pose = np.array(numbers, np.float32)
    assert pose_from_ros(pose_to_ros(pose)).astype(np.float32).tobytes() == pose.tobytes() or np.isnan(pose).any()
    np.testing.assert_array_equal(pose_from_ros(pose_to_ros(pose)), pose)


def test_frames_are_those_of_rep_103() -> None:
    from h3data.geometry import ground_pose

    pose = ground_pose(np.array([2.0, -3.0]), 0.7)
    x, y, z, *quat = pose_to_ros(pose).tolist()
    assert (x, y, z) == (2.0, 3.0, 0.0)
    w_axis = 2 * np.arctan2(quat[2], quat[3])
    assert w_axis == pytest.approx(heading_from_quat(pose[3:]))  # a turn to the left is positive about z
    up = quat_rotate(np.array(quat), np.array([0, 0, 1.0]))
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-12)


def test_names_are_safe_and_different() -> None:
    assert safe_names(["a b", "a/b", "", "é"], "agent") == ["a_b", "a_b_2", "agent", "agent_2"]


def test_a_bag_holds_the_topics_of_a_robot(recording: Recording, bag: Path) -> None:
    found, connections = read(bag)
    kinds = {
        "/clock": "rosgraph_msgs/msg/Clock",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/odom": "nav_msgs/msg/Odometry",
        "/joint_states": "sensor_msgs/msg/JointState",
        "/cmd_vel": "geometry_msgs/msg/Twist",
        "/map": "nav_msgs/msg/OccupancyGrid",
        "/scan": "sensor_msgs/msg/LaserScan",
        "/people": "people_msgs/msg/People",
        "/humans/persons/tracked": "hri_msgs/msg/IdsList",
        "/humans/bodies/tracked": "hri_msgs/msg/IdsList",
        "/robot_description": "std_msgs/msg/String",
        "/h3data/episode": "std_msgs/msg/String",
        "/h3data/columns": "std_msgs/msg/Float64MultiArray",
    }
    assert {topic: connection.msgtype for topic, connection in connections.items()} == kinds
    latched = {"/tf_static", "/map", "/robot_description", "/h3data/episode"}
    for topic, connection in connections.items():
        (qos,) = connection.ext.offered_qos_profiles
        assert (qos.durability == QosDurability.TRANSIENT_LOCAL) is (topic in latched)
        assert len(found[topic]) == (1 if topic in latched else STEPS)
    times = START_NS + recording.columns["time_ns"]
    assert [t for t, _ in found["/odom"]] == times.tolist()
    assert [m.clock.sec * 10**9 + m.clock.nanosec for _, m in found["/clock"]] == times.tolist()
    assert found["/robot_description"][0][1].data.startswith("<?xml")


def test_poses_and_speeds_are_those_of_the_recording(recording: Recording, bag: Path) -> None:
    found, _ = read(bag)
    base = recording.columns["agent_0.base_pose"].astype(np.float64)
    at = np.array([[m.pose.pose.position.x, m.pose.pose.position.y] for _, m in found["/odom"]])
    np.testing.assert_array_equal(at, np.stack([base[:, 0], -base[:, 2]], axis=1))
    ahead = np.array([m.twist.twist.linear.x for _, m in found["/odom"]])
    aside = np.array([m.twist.twist.linear.y for _, m in found["/odom"]])
    step = np.hypot(*np.diff(base[:, [0, 2]], axis=0).T) * 30
    np.testing.assert_allclose(np.hypot(ahead, aside)[1:], step, atol=1e-6)
    persons = [{p.name: (p.position.x, p.position.y) for p in m.people} for _, m in found["/people"]]
    for number, agent in enumerate(recording.agents[1:], 1):
        pose = recording.columns[f"agent_{number}.base_pose"].astype(np.float64)
        for step_, row in enumerate(persons):
            if np.isnan(pose[step_]).any():
                assert agent.name not in row
            else:
                assert row[agent.name] == (pose[step_, 0], -pose[step_, 2])
    frames = Counter(t.child_frame_id for _, m in found["/tf"] for t in m.transforms)
    assert frames["base_footprint"] == STEPS
    assert {t.child_frame_id for t in found["/tf_static"][0][1].transforms} == {"odom", "base_link", "base_scan"}


def test_the_map_is_within_a_cell_of_the_floor(recording: Recording, bag: Path) -> None:
    grid = read(bag)[0]["/map"][0][1]
    free = FreeSpace.from_scene(load_scene(recording.attachments["scene.glb"]))
    cells = grid.data.reshape(grid.info.height, grid.info.width)
    rows, columns = np.nonzero(np.ones_like(cells))
    x = grid.info.origin.position.x + (columns + 0.5) * grid.info.resolution
    y = grid.info.origin.position.y + (rows + 0.5) * grid.info.resolution
    distance = free.signed_distance(np.stack([x, -y], axis=1)).reshape(cells.shape)
    assert (distance[cells == 0] > 0).all()
    assert (distance[cells != 0] <= 0).all()
    assert (cells == 0).sum() > 1000


def test_a_recorded_scan_is_exported_with_its_angles(tmp_path: Path) -> None:
    recording = h3data.simulate("wander", "small:0", seed=2, max_steps=12, sensors=("lidar",))
    write_rosbag2(recording, tmp_path / "bag")
    scan = [m for _, m in read(tmp_path / "bag")[0]["/scan"]][-1]
    own = recording.columns["metrics.agent_0.lidar"][-1].astype(np.float32)
    ahead = round(-scan.angle_min / scan.angle_increment)
    assert scan.ranges[ahead] == own[0]
    assert scan.ranges[ahead + 90] == own[90], "a quarter turn to the left"
    assert scan.ranges[ahead - 90] == own[-90]
    assert scan.range_max == np.float32(12.0)


def test_a_scan_sees_walls_and_people(recording: Recording, bag: Path) -> None:
    free = FreeSpace.from_scene(load_scene(recording.attachments["scene.glb"]))
    base = recording.columns["agent_0.base_pose"][-1:].astype(np.float64)
    heading = heading_from_quat(base[:, 3:]).reshape(-1)
    empty = cast_scans(free, base[:, [0, 2]], heading, np.zeros((1, 0, 2)), rays=90, radius_m=0.25)[0]
    (clear,) = free.signed_distance(base[:, [0, 2]])
    assert clear - 0.01 <= empty.min() <= clear + 0.1
    ray = int(np.argmax(empty))
    angle = heading[0] - np.pi + ray * 2 * np.pi / 90
    person = base[:, [0, 2]] + empty[ray] / 2 * np.array([np.cos(angle), -np.sin(angle)])
    seen = cast_scans(free, base[:, [0, 2]], heading, person[:, None], rays=90, radius_m=0.25)[0]
    assert seen[ray] == pytest.approx(empty[ray] / 2 - 0.25, abs=1e-5)
    assert (seen <= empty).all()
    scans = [m for _, m in read(bag)[0]["/scan"]]
    assert {len(m.ranges) for m in scans} == {90}
    assert all(m.ranges.min() > 0 for m in scans)


def test_another_reader_decodes_every_message(recording: Recording, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap_ros2.reader", reason="needs mcap-ros2-support, which is in the extra dev")
    cameras = [BagCamera(camera=pinhole(32, 24, hfov_deg=80, name="eye"), poses=np.eye(4)[None])]
    image = np.full((24, 32, 3), 90, np.uint8)
    bag = write_rosbag2(
        recording, tmp_path / "bag", cameras=cameras, pictures=((k, [image]) for k in range(len(recording)))
    )
    read = [(m.channel.topic, m.ros_msg) for m in reader.read_ros2_messages(tmp_path / "bag" / "bag.mcap")]
    assert len(read) == bag.messages
    assert {topic for topic, _ in read} == set(bag.topics) >= {"/eye/camera_info", "/eye/image_raw/compressed"}
    people = next(m for topic, m in read if topic == "/people")
    assert people.people[0].position.x == recording.columns["agent_1.base_pose"][0, 0]


def test_images_are_jpeg_with_their_camera(recording: Recording, tmp_path: Path) -> None:
    import cv2

    camera = pinhole(64, 48, hfov_deg=80, name="eye")
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, :32] = (200, 40, 10)
    write_rosbag2(
        recording,
        tmp_path / "bag",
        cameras=[BagCamera(camera=camera, poses=np.eye(4)[None])],
        pictures=[(0, [image]), (3, [image])],
    )
    found, _ = read(tmp_path / "bag")
    _, message = found["/eye/image_raw/compressed"][1]
    back = cv2.imdecode(message.data, cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(back[:, :24].astype(int) - (200, 40, 10)).max() < 12
    info = found["/eye/camera_info"][0][1]
    assert (info.width, info.height, info.k[0]) == (64, 48, camera.fx)
    pose = next(t.transform for t in found["/tf"][0][1].transforms if t.child_frame_id == "eye_optical_frame")
    q = pose.rotation
    seen = quat_rotate(np.array([q.x, q.y, q.z, q.w]), np.array([0, 0, 1.0]))
    np.testing.assert_allclose(
        seen, [0, -1, 0], atol=1e-12
    )  # the camera looks along the world's z, which is -y of the map


def test_several_robots_have_names_of_their_own(recording: Recording, tmp_path: Path) -> None:
    agents = (recording.agents[0], replace(recording.agents[1], kind="robot", name="second one", model=""))
    two = replace(recording, agents=agents, columns={k: v for k, v in recording.columns.items() if k[:7] != "agent_2"})
    bag = write_rosbag2(two, tmp_path / "bag")
    assert {"/robot/odom", "/second_one/odom", "/robot/joint_states"} <= set(bag.topics)
    assert "/second_one/joint_states" not in bag.topics


def test_what_cannot_be_written_is_refused(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    empty = replace(recording, columns={name: column[:0] for name, column in recording.columns.items()})
    with pytest.raises(InputError, match="H3-ROS-005"):
        write_rosbag2(empty, tmp_path / "bag")
    view = BagCamera(camera=pinhole(8, 6, hfov_deg=80, name="eye"), poses=np.eye(4)[None])
    with pytest.raises(InputError, match="H3-ROS-006"):
        write_rosbag2(recording, tmp_path / "bag", cameras=[view, view])
    image = np.zeros((6, 8, 3), np.uint8)
    with pytest.raises(InputError, match="H3-ROS-007"):
        write_rosbag2(recording, tmp_path / "bag", cameras=[view], pictures=[(2, [image]), (1, [image])])
    with pytest.raises(InputError, match="H3-ROS-008"):
        write_rosbag2(recording, tmp_path / "bag", lidar_rays=-1)
    assert not (tmp_path / "bag" / "metadata.yaml").exists()
    assert not list(tmp_path.rglob(".part"))
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag2", None)
    with pytest.raises(MissingExtraError, match="H3-ROS-001"):
        messages.require_rosbags()


def test_a_recording_without_its_scene_has_no_map(recording: Recording, tmp_path: Path) -> None:
    bag = write_rosbag2(replace(recording, attachments={}), tmp_path / "bag", lidar_rays=8)
    assert "/map" not in bag.topics
    assert "/scan" not in bag.topics
    assert len(bag.notes) == 2


def test_the_command_writes_a_bag(recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from h3data.recording import write_mcap

    write_mcap(recording, tmp_path / "e.mcap")
    out = tmp_path / "bag"
    assert main(["export", str(tmp_path / "e.mcap"), "--to", "rosbag2", "-o", str(out), "--storage", "sqlite3"]) == 0
    assert {file.name for file in out.iterdir()} == {"metadata.yaml", "bag.db3", "h3data"}
    assert main(["export", str(tmp_path / "e.mcap"), "--to", "csv", "-o", str(tmp_path / "t"), "--lidar", "90"]) == 2
    with pytest.raises(SystemExit, match="0"):
        main(["export", "--help"])
    assert "rosbag2" in capsys.readouterr().out
    assert len(read_mcap(tmp_path / "e.mcap")) == STEPS
