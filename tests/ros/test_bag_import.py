"""Bags as recordings: our own come back as they were, those of robots are measured like any other."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason='needs the extra: pip install "h3data[ros]"')

from h3data.errors import FormatError, InputError
from h3data.formats import ImportRequest
from h3data.metrics.registry import measure
from h3data.recording import Recording, read_mcap, recordings_equal
from h3data_pipelines.cli import main
from h3data_ros.bag_export import write_rosbag2
from h3data_ros.bag_import import read_rosbag2
from tests.ros import bags
from tests.ros.recordings import crossing

PLAIN = ImportRequest()


def values_of(recording: Recording, profile: str) -> dict[str, float]:
    return dict(measure(recording, profile).values)


def without(bag: Path, out: Path, *topics: str) -> Path:
    """A copy of a bag without some topics, and without our files."""
    from rosbags.rosbag2 import Reader, Writer

    with Reader(bag) as reader, Writer(out, version=8) as writer:
        known = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=bags.STORE)
            for c in reader.connections
            if c.topic not in topics
        }
        for connection, t, data in reader.messages():
            if connection.topic in known:
                writer.write(known[connection.topic], t, data)
    return out


@pytest.fixture(scope="module")
def recording() -> Recording:
    return crossing()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_our_own_bags_come_back_as_they_were(recording: Recording, storage: Any, tmp_path: Path) -> None:
    write_rosbag2(recording, tmp_path / "bag", storage=storage)
    back = read_rosbag2(tmp_path / "bag", tracks=PLAIN)
    assert recordings_equal(recording, back) == []
    assert back.attachments == recording.attachments


def test_standard_messages_alone_tell_every_place_exactly(recording: Recording, tmp_path: Path) -> None:
    write_rosbag2(recording, tmp_path / "bag")
    plain = without(tmp_path / "bag", tmp_path / "plain", "/h3data/episode", "/h3data/columns")
    for topic in ("/people", "/humans/persons/tracked"):
        back = read_rosbag2(plain, tracks=ImportRequest(people=topic))
        assert [agent.name for agent in back.agents] == ["robot", "human_1", "human_2"]
        np.testing.assert_array_equal(np.diff(back.columns["time_ns"]), np.diff(recording.columns["time_ns"]))
        np.testing.assert_array_equal(back.columns["agent_0.base_pose"], recording.columns["agent_0.base_pose"])
        for n in (1, 2):
            column, known = f"agent_{n}.base_pose", recording.columns[f"agent_{n}.base_pose"]
            seen = np.isfinite(known[:, 0])
            np.testing.assert_array_equal(back.columns[column][seen, :3], known[seen, :3])
            np.testing.assert_array_equal(back.columns[f"agent_{n}.recorded"], seen)
        assert back.episode.scene == "map"  # extruded from the topic


def test_metrics_of_the_copy_are_equal(recording: Recording, tmp_path: Path) -> None:
    write_rosbag2(recording, tmp_path / "bag")
    back = read_rosbag2(tmp_path / "bag", tracks=PLAIN)
    for profile in ("field", "social"):
        ours, theirs = (values_of(one, profile) for one in (recording, back))
        assert {k: v for k, v in ours.items() if v == v} == {k: v for k, v in theirs.items() if v == v}
        assert len(ours) > 10


def test_a_real_robot_s_log_is_in_the_map(tmp_path: Path) -> None:
    bag = bags.real_robot(tmp_path / "bag")
    back = read_rosbag2(bag, tracks=ImportRequest(goal="11,2"))
    seconds = back.columns["time_ns"] * 1e-9
    assert len(back) == 201
    base = back.columns["agent_0.base_pose"]
    truth = np.array([bags.robot_at(s) for s in seconds])
    np.testing.assert_allclose(base[:, [0, 2]], np.stack([truth[:, 0], -truth[:, 1]], 1), atol=1e-5)
    for n in (0, 1):
        place = np.array([bags.person_at(n, s) for s in seconds])
        track = back.columns[f"agent_{n + 1}.base_pose"]
        np.testing.assert_allclose(track[:, [0, 2]], np.stack([place[:, 0], -place[:, 1]], 1), atol=1e-5)
        assert back.columns[f"agent_{n + 1}.recorded"].all()
    facts = back.episode.info["imported"]
    assert facts["rate_hz"] == 10
    assert facts["gaps"] == 0
    assert facts["clock_offset_s"] == pytest.approx(0.02)
    assert back.episode.info["goal"] == [11.0, -2.0]
    values = values_of(back, "social")
    assert values["V_mean"] == pytest.approx(0.5, abs=1e-3)
    assert values["A_max"] < 0.05
    assert values["J_max"] < 1.0
    assert values["DH_min"] == pytest.approx(0.8, abs=0.02)
    assert np.isnan(values["HC"])  # nobody recorded contacts


def test_gaps_stay_gaps(tmp_path: Path) -> None:
    def silent(name: str, s: float) -> bool:
        return {"p0": 4 < s < 4.35, "p1": 6 < s < 8, "people": 10 < s < 12, "tf": 11 < s < 13}.get(name, False)

    back = read_rosbag2(bags.real_robot(tmp_path / "bag", silent=silent), tracks=PLAIN)
    seconds = back.columns["time_ns"] * 1e-9
    robot, p0, p1 = (back.columns[f"agent_{n}.base_pose"][:, 0] for n in range(3))
    short = (seconds > 4.05) & (seconds < 4.3)
    assert np.isfinite(p0[short]).all()  # three observations missing: joined
    assert not back.columns["agent_1.recorded"][short].any()
    assert np.isnan(p1[(seconds > 6.05) & (seconds < 7.95)]).all()
    nobody = (seconds > 10.05) & (seconds < 11)
    assert nobody.sum() >= 8  # rows at times at which the robot was
    assert np.isfinite(robot[nobody]).all()
    assert np.isnan(p0[nobody]).all()
    dark = (seconds > 11.05) & (seconds < 12.95)  # people are seen by the robot, whose place nobody knows
    assert dark.sum() == 1  # one row, empty
    assert np.isnan(robot[dark]).all()
    assert back.episode.info["imported"]["gaps"] == 1
    at_rate = read_rosbag2(tmp_path / "bag", tracks=ImportRequest(hz=10))
    assert at_rate.episode.info["imported"]["gaps"] == 1
    assert "1 gap " in at_rate.episode.info["imported"]["summary"]
    values = values_of(back, "social")
    assert values["V_max"] == pytest.approx(0.5, abs=0.01)  # nothing is joined across the gap


def test_a_fixed_rate_can_be_asked_for(tmp_path: Path) -> None:
    back = read_rosbag2(bags.real_robot(tmp_path / "bag"), tracks=ImportRequest(hz=4))
    assert set(np.diff(back.columns["time_ns"]).tolist()) == {250_000_000}
    assert back.episode.info["imported"]["rate_hz"] == 4
    assert back.episode.info["imported"]["gaps"] == 0
    with pytest.raises(InputError, match="H3-ROS-012"):
        read_rosbag2(tmp_path / "bag", tracks=ImportRequest(hz=0))


@pytest.mark.parametrize("kind", ["spencer_tracking_msgs/TrackedPersons", "visualization_msgs/MarkerArray"])
def test_other_messages_of_people(kind: str, tmp_path: Path) -> None:
    messages: list[Any] = []
    for k in range(50):
        t = bags.T0 + k * 100_000_000
        place = (3.0 + 0.1 * k, 1.0)
        message = (
            bags.spencer(t, "odom", {7: (*place, 0.5)}) if "spencer" in kind else bags.markers(t, "odom", {7: place})
        )
        messages.append((t, "/tracks", kind, message))
        odometry = bags.make(
            "nav_msgs/Odometry",
            header=bags.header(t, "odom"),
            child_frame_id="base_link",
            pose=bags.make("geometry_msgs/PoseWithCovariance", pose=bags.pose(0.05 * k, 0), covariance=np.zeros(36)),
            twist=bags.make(
                "geometry_msgs/TwistWithCovariance",
                twist=bags.make(
                    "geometry_msgs/Twist",
                    linear=bags.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0),
                    angular=bags.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0),
                ),
                covariance=np.zeros(36),
            ),
        )
        messages.append((t, "/odometry", "nav_msgs/Odometry", odometry))
    bag = bags.write(tmp_path / "bag", messages, storage="mcap")
    asked = "" if "spencer" in kind else "/tracks"
    if not asked:
        assert read_rosbag2(bag / "bag.mcap", tracks=PLAIN).agents[1].name == "7"
    else:
        with pytest.raises(FormatError, match="H3-ROS-031"):
            read_rosbag2(bag, tracks=PLAIN)
    back = read_rosbag2(bag, tracks=ImportRequest(people=asked))
    np.testing.assert_allclose(back.columns["agent_1.base_pose"][:, 0], 3.0 + 0.1 * np.arange(50), atol=1e-6)
    np.testing.assert_allclose(back.columns["agent_1.base_pose"][:, 2], -1.0)
    assert any("drift" in warning for warning in back.episode.info["warnings"])


def test_an_import_is_measured_and_validated_like_any_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bags.real_robot(tmp_path / "bags" / "morning")
    bags.real_robot(tmp_path / "bags" / "evening", storage="mcap")
    assert main(["import", str(tmp_path / "bags"), "-o", str(tmp_path / "rec"), "--goal", "11,2"]) == 0
    stated = "10 Hz (times of observations), 1 robot, 2 people, 0 gaps in which nobody is observed"
    assert capsys.readouterr().out.count(stated) == 2
    assert {p.name for p in (tmp_path / "rec").iterdir()} == {"morning.mcap", "evening.mcap"}
    one = str(tmp_path / "rec" / "morning.mcap")
    capsys.readouterr()
    assert main(["metrics", one, "--profile", "social", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)
    assert main(["metrics", one, "--json"]) == 0  # the robot among people, although no task tells what to measure
    assert "PSC" in capsys.readouterr().out
    assert main(["validate", one]) == 0, capsys.readouterr().out
    assert read_mcap(one).episode.info["source"]["format"] == "rosbag2"
    assert main(["report", one, "-o", str(tmp_path / "report.html"), "--pictures", "0"]) == 0
    assert stated in (tmp_path / "report.html").read_text(encoding="utf-8")
    shutil.rmtree(tmp_path / "bags")
