"""Frames of a robot's links and point clouds in bags, compared with our forward kinematics and scans."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason='needs the extra: pip install "h3data[ros]"')

from h3data.bodies import Robot, load_robot
from h3data.geometry import pose_from_matrix, pose_to_matrix, quat_rotate
from h3data.recording import Recording
from h3data.recording.scans import clouds_of
from h3data_ros.bag_export import write_rosbag2
from h3data_ros.frames import FROM_WORLD, pose_to_ros
from h3data_ros.robot_links import robot_links
from h3data_ros.transforms import TransformTree
from tests.ros.recordings import crossing
from tests.ros.test_bag_export import read

STEPS = 20


@pytest.fixture(scope="module")
def moving() -> Recording:
    """A recording whose robot moves all its joints, and has a scanner of three lasers."""
    recording, robot = crossing(STEPS), load_robot("quad_arm")
    rng = np.random.default_rng(4)
    low, high = np.maximum(robot.lower, -2), np.minimum(robot.upper, 2)
    joints = rng.uniform(low, high, (STEPS, len(low))).astype(np.float32)
    ranges = rng.uniform(0.5, 31.0, (STEPS, 3, 8)).astype(np.float32)
    facts = {"high": 30.0, "elevation_deg": [-10.0, 20.0], "height_m": 0.6}
    info = {**recording.episode.info, "sensors": {"metrics.agent_0.lidar_3d": facts}}
    columns = {**recording.columns, "agent_0.joint_pos": joints, "metrics.agent_0.lidar_3d": ranges}
    return replace(recording, episode=replace(recording.episode, info=info), columns=columns)


@pytest.fixture(scope="module")
def messages(moving: Recording, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[int, Any]]]:
    path = tmp_path_factory.mktemp("links") / "bag"
    write_rosbag2(moving, path)
    return read(path)[0]


def tree_of(messages: dict[str, list[tuple[int, Any]]]) -> TransformTree:
    tree = TransformTree()
    for topic in ("/tf", "/tf_static"):
        for t, message in messages[topic]:
            for one in message.transforms:
                x, q = one.transform.translation, one.transform.rotation
                pose = (x.x, x.y, x.z, q.x, q.y, q.z, q.w)
                tree.add(one.header.frame_id, one.child_frame_id, t, pose, still=topic == "/tf_static")
    return tree


def test_links_are_where_our_kinematics_puts_them(
    moving: Recording, messages: dict[str, list[tuple[int, Any]]]
) -> None:
    robot, tree = load_robot("quad_arm"), tree_of(messages)
    stamps = np.array([t for t, _ in messages["/joint_states"]])
    world = robot.link_matrices(moving.columns["agent_0.base_pose"], moving.columns["agent_0.joint_pos"])
    for k, name in enumerate(robot.link_names):
        found = pose_to_matrix(tree.poses(name, "map", stamps, 10**9))
        np.testing.assert_allclose(found, pose_to_matrix(FROM_WORLD) @ world[:, k], atol=2e-6, err_msg=name)


def test_joint_states_move_the_links_as_a_robot_state_publisher_does(
    messages: dict[str, list[tuple[int, Any]]],
) -> None:
    """The description's own joints, read by their axes, give the transforms that /tf has."""
    import xml.etree.ElementTree as ET

    from scipy.spatial.transform import Rotation

    urdf = ET.fromstring(messages["/robot_description"][0][1].data)
    state = messages["/joint_states"][7][1]
    positions = dict(zip(state.name, state.position.tolist(), strict=True))
    told = {one.child_frame_id: one for one in messages["/tf"][7][1].transforms}
    joints = [j for j in urdf.iter("joint") if j.get("type") in ("revolute", "continuous", "prismatic")]
    assert len(joints) > 15
    for joint in joints:
        child = joint.find("child").get("link")  # type: ignore[union-attr]
        origin, axis = joint.find("origin"), joint.find("axis")
        xyz, rpy = (
            np.array([float(v) for v in (origin.get(key, "0 0 0") if origin is not None else "0 0 0").split()])
            for key in ("xyz", "rpy")
        )
        along = np.array([float(v) for v in (axis.get("xyz") if axis is not None else "1 0 0").split()])  # type: ignore[union-attr]
        assert joint.find("mimic") is None, "this test knows no joints that follow others"
        turn, value = Rotation.from_euler("xyz", rpy), positions[joint.get("name", "")]
        slides = joint.get("type") == "prismatic"
        expected = xyz + (turn.apply(along * value) if slides else 0)
        turned = turn if slides else turn * Rotation.from_rotvec(along / np.linalg.norm(along) * value)
        x, q = told[child].transform.translation, told[child].transform.rotation
        np.testing.assert_allclose([x.x, x.y, x.z], expected, atol=1e-6, err_msg=child)
        assert (Rotation.from_quat([q.x, q.y, q.z, q.w]).inv() * turned).magnitude() < 1e-6, child


ARM = """<robot name="arm">{links}{joints}</robot>"""


def robot_of(tmp_path: Path, names: Sequence[str]) -> Robot:
    """A chain of links: the first joint is fixed, the others turn; every other one follows the first."""
    box = '<visual><origin xyz="0 0 .1"/><geometry><box size=".2 .2 .2"/></geometry></visual>'
    links = "".join(f'<link name="{name}">{box}</link>' for name in names)
    joints = ""
    for k, (parent, child) in enumerate(itertools.pairwise(names)):
        kind = "fixed" if k == 0 else "revolute"
        mimic = '<mimic joint="j1" multiplier="-0.5" offset="0.1"/>' if k > 1 and k % 2 == 0 else ""
        joints += (
            f'<joint name="j{k}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz=".1 0 .2" rpy="0.3 0 0.2"/><axis xyz="0 1 0"/><limit lower="-1" upper="1"/>{mimic}</joint>'
        )
    (tmp_path / "arm.urdf").write_text(ARM.format(links=links, joints=joints))
    return load_robot(tmp_path / "arm.urdf")


@pytest.mark.parametrize(
    ("names", "first"),
    [
        (("base_link", "a", "b", "c"), [("base_footprint", "base_link")]),
        (("trunk", "a", "b", "c"), [("base_footprint", "base_link"), ("base_link", "trunk")]),
        (("base_footprint", "base_link", "b", "c"), []),
        (("world_box", "base_link", "b", "c"), [("base_footprint", "world_box")]),
    ],
)
def test_every_frame_of_a_description_has_one_parent(
    tmp_path: Path, names: Sequence[str], first: list[tuple[str, str]]
) -> None:
    robot = robot_of(tmp_path, names)
    joints = np.array([[0.5], [-0.2], [np.nan]])
    links = robot_links(robot, joints[:, : len(robot.joint_names)], "")
    edges = [(parent, child) for parent, child, _ in links.still]
    assert edges[: len(first)] == first
    children = [child for _, child in [*edges, *links.moving]]
    assert len(children) == len(set(children))
    assert set(children) >= set(names) - {"base_footprint"}
    assert np.isnan(links.poses[2]).all()
    assert np.isfinite(links.poses[:2]).all()
    tree = TransformTree()
    for parent, child, pose in links.still:
        tree.add(parent, child, 0, tuple(pose), still=True)
    for (parent, child), pose in zip(links.moving, links.poses[1], strict=True):
        tree.add(parent, child, 5, tuple(pose))
    root = names[0]
    relative = robot.link_matrices(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), joints[1:2])[0]
    expected = np.linalg.inv(relative[0]) @ relative[-1]
    found = pose_to_matrix(tree.poses(names[-1], root, np.array([5]), 10**9))[0]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(pose_to_matrix(pose_from_matrix(expected)), expected, atol=1e-9)


def points_of(cloud: Any) -> np.ndarray:
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    assert (cloud.point_step, cloud.row_step, len(cloud.data)) == (12, 12 * 8, 3 * 12 * 8)
    return np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 3)


def test_clouds_are_the_points_of_the_scan(moving: Recording, messages: dict[str, list[tuple[int, Any]]]) -> None:
    tree, stamps = tree_of(messages), [t for t, _ in messages["/points"]]
    assert len(stamps) == STEPS
    expected = clouds_of(moving)[0].points(moving)
    for row, (t, cloud) in enumerate(messages["/points"]):
        frame = tree.poses(cloud.header.frame_id, "map", np.array([t]), 10**9)[0]
        world = quat_rotate(frame[3:], points_of(cloud).astype(np.float64)) + frame[:3]
        np.testing.assert_allclose(world, expected[row][:, [0, 2, 1]] * (1, -1, 1), atol=1e-4)
    assert np.isnan(expected).any(), "some rays of the test meet nothing"


def test_another_reader_decodes_links_and_clouds(moving: Recording, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap_ros2.reader", reason="needs mcap-ros2-support, which is in the extra dev")
    write_rosbag2(moving, tmp_path / "bag")
    read = [(m.channel.topic, m.ros_msg) for m in reader.read_ros2_messages(tmp_path / "bag" / "bag.mcap")]
    cloud = next(m for topic, m in read if topic == "/points")
    assert np.isfinite(points_of(cloud)).any()
    moved = next(m for topic, m in read if topic == "/tf")
    names = {one.child_frame_id for one in moved.transforms}
    assert names >= set(load_robot("quad_arm").link_names) - {"base_link"}
    base = next(one for one in moved.transforms if one.child_frame_id == "base_footprint")
    assert base.transform.translation.x == pose_to_ros(moving.columns["agent_0.base_pose"][0])[0]


def test_a_robot_with_other_joints_stands_at_rest(moving: Recording, tmp_path: Path) -> None:
    robot = moving.agents[0]
    other = replace(moving, agents=(replace(robot, joint_names=robot.joint_names[::-1]), *moving.agents[1:]))
    bag = write_rosbag2(other, tmp_path / "bag")
    assert any("at rest" in note for note in bag.notes)
    unknown = replace(moving, agents=(replace(robot, model="robot/nobody"), *moving.agents[1:]))
    bag = write_rosbag2(unknown, tmp_path / "unknown")
    assert any("robot_description" in note for note in bag.notes)
    assert "/robot_description" not in bag.topics
