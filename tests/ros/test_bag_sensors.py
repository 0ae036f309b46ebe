"""Scans, clouds, joint states and bodies of robots in bags of others, and what is not read of a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason='needs the extra: pip install "h3data[ros]"')

import h3data
from h3data.bodies import load_robot
from h3data.errors import InputError
from h3data.formats import ImportRequest
from h3data.recording import Recording
from h3data.recording.scans import scans_of
from h3data.replay import Replay
from h3data_pipelines.cli import main
from h3data_ros.bag_export import write_rosbag2
from h3data_ros.bag_import import read_rosbag2
from tests.ros import bags

LASER, CLOUD = "sensor_msgs/LaserScan", "sensor_msgs/PointCloud2"
TIMES = np.arange(0, 2.01, 0.1)
WALL_X = 6.0
"""A wall across the map, 5 m in front of the robot's start."""


def stamp(seconds: float) -> int:
    return bags.T0 + int(seconds * 1e9)


def wall_scan(seconds: float) -> Any:
    """A scan of half a turn from the right to the left by a scanner 20 cm before the robot's middle."""
    angles = np.radians(np.arange(-90, 91))
    ahead = WALL_X - bags.robot_at(seconds)[0] - 0.2
    with np.errstate(divide="ignore"):
        ranges = np.where(np.abs(angles) < np.radians(60), ahead / np.cos(angles), np.inf)
    return bags.laser_scan(stamp(seconds), "base_scan", ranges, first=-np.pi / 2, step=np.radians(1.0))


def wall_cloud(seconds: float, **options: Any) -> Any:
    y, z = (a.ravel() for a in np.meshgrid(np.linspace(-3, 3, 301), (0.02, 0.5, 1.0, 2.4)))
    x = np.full(len(y), WALL_X - bags.robot_at(seconds)[0] - 0.2)
    x[z < 0.1] = 0.4  # the floor is no obstacle
    return bags.cloud(stamp(seconds), "base_scan", np.stack([x, y, z], 1), **options)


def imported(tmp_path: Path, more: list[tuple[float, str, str, Any]], **options: Any) -> Recording:
    path = bags.real_robot(tmp_path / "bag", seconds=2.0, more=more)
    return read_rosbag2(path, tracks=ImportRequest(**options))


def test_a_scan_is_around_the_middle_of_the_robot(tmp_path: Path) -> None:
    back = imported(tmp_path, [(s, "/scan", LASER, wall_scan(s)) for s in TIMES])
    (scan,) = scans_of(back)
    assert scan.max_m == pytest.approx(10.0)
    base = back.columns["agent_0.base_pose"][:, 0]
    np.testing.assert_allclose(scan.ranges[:, 0], WALL_X - base, atol=1e-3)
    points = scan.points(back)
    hit = np.isfinite(points[..., 0])
    np.testing.assert_allclose(points[hit][:, 0], WALL_X, atol=0.06)  # half a degree
    assert (hit.sum(1) > 90).all()
    assert np.isnan(scan.ranges[:, 120:240]).all(), "nobody measured behind the robot"
    assert (scan.ranges[:, 80] == 10.0).all(), "a ray that met nothing"
    assert "/scan" in back.episode.info["imported"]["scans"]


@pytest.mark.parametrize("options", [{}, {"big": True}, {"kind": "f8"}])
def test_a_cloud_is_its_nearest_points_above_the_floor(tmp_path: Path, options: dict[str, Any]) -> None:
    back = imported(tmp_path, [(s, "/points", CLOUD, wall_cloud(s, **options)) for s in TIMES])
    (scan,) = scans_of(back)
    np.testing.assert_allclose(scan.ranges[:, 0], WALL_X - back.columns["agent_0.base_pose"][:, 0], atol=1e-3)
    assert np.isnan(scan.ranges[:, 90:270]).all()


def test_our_own_cloud_and_the_scan_that_is_read_of_it_agree(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    made = h3data.simulate("wander", "small:1", roster="robot,human", max_steps=20, sensors=("lidar_3d",))
    write_rosbag2(made, tmp_path / "bag")
    back = read_rosbag2(tmp_path / "bag", tracks=ImportRequest(hz=30))
    (scan,) = scans_of(back)
    level = made.columns["metrics.agent_0.lidar_3d"][:, 7:9].min(axis=1)
    both = np.isfinite(scan.ranges) & (level < 30)
    assert both.mean() > 0.9
    assert (scan.ranges[both] <= level[both] + 1e-3).all(), "the nearest of all lasers"


@pytest.mark.parametrize(
    "wrong",
    [
        {"point_step": 0},
        {"point_step": 2**32 - 1},
        {"row_step": 3},
        {"width": 2**32 - 1},
        {"height": 0},
        {"height": 2**31},
        {"data": np.zeros(5, np.uint8)},
        {"fields": []},
    ],
)
def test_clouds_whose_layout_does_not_fit_are_empty(tmp_path: Path, wrong: dict[str, Any]) -> None:
    back = imported(tmp_path, [(s, "/points", CLOUD, wall_cloud(s, **wrong)) for s in TIMES])
    assert all(np.isnan(scan.ranges).all() for scan in scans_of(back))
    assert len(back) == 21


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 3e37])
def test_scans_of_no_numbers_are_empty(tmp_path: Path, number: float) -> None:
    scan = bags.laser_scan(stamp(1), "base_scan", np.full(9, number), first=0.0, step=number, most=number)
    points = bags.cloud(stamp(1), "base_scan", np.full((9, 3), number))
    for topic, kind, message in (("/scan", LASER, scan), ("/points", CLOUD, points)):
        back = imported(tmp_path / kind[-5:], [(1.0, topic, kind, message)])
        assert not any(np.isfinite(found.met()).any() for found in scans_of(back))


def test_a_scan_in_a_frame_that_hangs_nowhere_is_left_out(tmp_path: Path) -> None:
    lost = bags.laser_scan(stamp(1), "attic", np.ones(9), first=0, step=0.1)
    back = imported(tmp_path, [(1.0, "/scan", LASER, lost)])
    assert not scans_of(back)
    assert "0 rows of 1 messages" in back.episode.info["imported"]["scans"]


def test_topics_that_are_not_read_are_listed(tmp_path: Path) -> None:
    more = [(s, "/scan", LASER, wall_scan(s)) for s in TIMES[:5]]
    more += [(s, "/velodyne_points", CLOUD, wall_cloud(s)) for s in TIMES[:3]]
    back = imported(tmp_path, more)
    assert back.episode.info["imported"]["not_read"] == ["/velodyne_points (sensor_msgs/msg/PointCloud2, 3)"]


# --- bodies -----------------------------------------------------------------------------------------------------------
def test_a_robot_gets_a_body_and_the_joints_of_its_log(tmp_path: Path) -> None:
    robot = load_robot("quad_arm")
    name = robot.joint_names[0]
    low, high = float(robot.lower[0]), float(robot.upper[0])
    states = [
        (s, "/joint_states", "sensor_msgs/JointState",
         bags.joint_state(stamp(s), {name: low + (high - low) * s / 2, "wheel": 7.0, robot.joint_names[1]: np.nan}))
        for s in TIMES
    ]  # fmt: skip
    back = imported(tmp_path, states, model="quad_arm")
    agent = back.agents[0]
    assert (agent.model, agent.joint_names) == ("robot/quad_arm", robot.joint_names)
    joints = back.columns["agent_0.joint_pos"]
    np.testing.assert_allclose(joints[:, 0], np.interp(back.columns["time_ns"] * 1e-9, [0, 2], [low, high]), atol=1e-5)
    np.testing.assert_array_equal(joints[:, 1:], np.tile(robot.rest[1:].astype(np.float32), (len(back), 1)))
    assert back.episode.info["synthesised"]["robot"][0].startswith("joints ")
    assert not any(body.name == "robot" for body in back.bodies)
    assert Replay(back).link_matrices(0).shape == (len(back), len(robot.links), 4, 4)
    write_rosbag2(back, tmp_path / "again")


def test_a_body_may_be_a_file_of_the_user_s(tmp_path: Path) -> None:
    from tests.ros.test_robot_links import robot_of

    file = robot_of(tmp_path, ("base_link", "a", "b", "c")).file
    back = imported(tmp_path, [], model=str(file))
    assert back.agents[0].model == f"robot/{file}"
    assert back.episode.info["synthesised"]["robot"] == ["posture"]
    assert list(back.episode.info["robots_sha256"]) == [str(file)]
    next(iter(Replay(back).frames([], [0])))


def test_a_body_may_be_in_mjcf(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    file = tmp_path / "cart.xml"
    file.write_text(
        '<mujoco><worldbody><body name="cart" pos="0 0 .1"><geom type="box" size=".2 .2 .1"/><body name="mast">'
        '<joint name="up" type="slide" axis="0 0 1" range="0 .5"/><geom type="box" size=".02 .02 .2" pos="0 0 .3"/>'
        "</body></body></worldbody></mujoco>"
    )
    back = imported(tmp_path, [], model=str(file))
    assert back.agents[0].joint_names == ("up",)
    assert Replay(back).link_matrices(0).shape[0] == len(back)


def test_a_body_that_is_not_there_or_has_nobody_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="H3-BODY-"):
        imported(tmp_path, [], model="no_such_robot")
    table = tmp_path / "tracks.csv"
    table.write_text("t,id,x,y\n" + "".join(f"{k / 10},1,{k / 20},0\n{k / 10},2,3,{k / 20}\n" for k in range(20)))
    with pytest.raises(InputError, match="H3-ROS-"):
        h3data.import_([table], tmp_path / "rec", model="quad_arm", strict=True)
    assert main(["import", str(table), "--robot", "2", "--model", "quad_arm", "-o", str(tmp_path / "rec")]) == 0
    back = h3data.load_recording(tmp_path / "rec" / "tracks.csv.mcap")
    assert back.agents[0].model == "robot/quad_arm"
