"""Bags that are damaged, incomplete or contradict themselves: each is refused with its code, or imported with a warning."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason='needs the extra: pip install "h3data[ros]"')

from h3data.errors import H3DataError
from h3data.formats import ImportRequest
from h3data.recording import Recording
from h3data_ros.bag_export import write_rosbag2
from h3data_ros.bag_import import read_rosbag2
from h3data_ros.stored_columns import COLUMNS_TOPIC, EPISODE_TOPIC
from tests.ros import bags
from tests.ros.recordings import crossing

Message = tuple[int, str, str, Any]


def at(seconds: float) -> int:
    return bags.T0 + int(seconds * 1e9)


def driving(frame: str = "base_link", root: str = "odom", *, seconds: float = 4.0) -> list[Message]:
    """A robot that drives along x at 0.5 m/s, by tf at 10 Hz."""
    return [
        (at(k / 10), "/tf", "tf2_msgs/TFMessage", bags.tf(bags.transform(at(k / 10), root, frame, 0.05 * k, 0.0)))
        for k in range(int(seconds * 10) + 1)
    ]


def walking(
    frame: str = "odom",
    *,
    topic: str = "/people",
    seconds: float = 4.0,
    place: Callable[[float], tuple[float, float]] = lambda s: (6.0 - s, 1.0),
) -> list[Message]:
    """One tracked person, at 10 Hz."""
    found = []
    for k in range(int(seconds * 10) + 1):
        t = at(k / 10)
        found.append((t, topic, "people_msgs/People", bags.people(t, frame, {"ada": place(k / 10)})))
    return found


def refused(bag: Path, code: str, **options: Any) -> None:
    with pytest.raises(H3DataError) as caught:
        read_rosbag2(bag, tracks=ImportRequest(**options))
    assert caught.value.code == code


def rewritten(bag: Path, out: Path, topic: str, change: Callable[[int, Any], Any]) -> Path:
    """A copy of a bag; ``change(number, message)`` gives the messages of one topic, None leaves one out."""
    from rosbags.rosbag2 import Reader, Writer

    number = 0
    with Reader(bag) as reader, Writer(out, version=8) as writer:
        known = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=bags.STORE) for c in reader.connections}
        for connection, t, data in reader.messages():
            if connection.topic == topic:
                message = change(number, bags.STORE.deserialize_cdr(data, connection.msgtype))
                number += 1
                if message is None:
                    continue
                data = bags.STORE.serialize_cdr(message, connection.msgtype)
            writer.write(known[connection.topic], t, data)
    return out


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return bags.write(tmp_path / "bag", [*driving(), *walking()])


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("own") / "bag"
    write_rosbag2(crossing(), path)
    return path


# --- options ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("options", [{"columns": "t,id,x,y"}, {"unit": "mm"}, {"rate": 10.0}])
def test_options_of_tracks_are_refused(bag: Path, options: dict[str, Any]) -> None:
    refused(bag, "H3-ROS-026", **options)


def test_a_topic_that_is_not_there(bag: Path) -> None:
    refused(bag, "H3-ROS-029", people="/pedestrians")


def test_a_topic_of_another_type(bag: Path) -> None:
    refused(bag, "H3-ROS-030", people="/tf")


def test_a_robot_that_is_not_there(bag: Path) -> None:
    refused(bag, "H3-ROS-033", robot="turtle")


# --- files ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("keep", [0.0, 0.1, 0.5, 0.9])
def test_a_truncated_file(tmp_path: Path, storage: str, keep: float) -> None:
    """Every cut is refused, none crashes or is half read."""
    path = bags.write(tmp_path / "bag", [*driving(), *walking()], storage=storage)
    (file,) = [*path.glob("*.mcap"), *path.glob("*.db3")]
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * keep)])
    refused(path, "H3-ROS-027")


@pytest.mark.parametrize("text", ["", "{", "rosbag2_bagfile_information: 3", "a: &a [*a]", "\x00\xff"])
def test_a_damaged_metadata_yaml(bag: Path, text: str) -> None:
    (bag / "metadata.yaml").write_text(text, encoding="utf-8")
    refused(bag, "H3-ROS-027")


def test_a_bag_without_its_file(bag: Path) -> None:
    next(bag.glob("*.db3")).unlink()
    refused(bag, "H3-ROS-027")


def test_bytes_that_are_no_message_of_their_type(tmp_path: Path) -> None:
    from rosbags.rosbag2 import Writer

    path = tmp_path / "bag"
    with Writer(path, version=8) as writer:
        connection = writer.add_connection("/people", "people_msgs/msg/People", typestore=bags.STORE)
        writer.write(connection, at(0), b"\x00\x01\x00\x00\xff\xff\xff\xff\xff")
    refused(path, "H3-ROS-028")


def test_a_message_of_another_type_than_the_topic_says(tmp_path: Path) -> None:
    from rosbags.rosbag2 import Writer

    path = tmp_path / "bag"
    text = bags.STORE.serialize_cdr(bags.make("std_msgs/String", data="x" * 3), "std_msgs/msg/String")
    with Writer(path, version=8) as writer:
        writer.write(writer.add_connection("/tf", "tf2_msgs/msg/TFMessage", typestore=bags.STORE), at(0), text)
        writer.write(writer.add_connection("/people", "people_msgs/msg/People", typestore=bags.STORE), at(0), text)
    refused(path, "H3-ROS-028")


# --- topics and frames ------------------------------------------------------------------------------------------------
def test_no_topic_of_people(tmp_path: Path) -> None:
    refused(bags.write(tmp_path / "bag", driving()), "H3-ROS-031")


def test_two_topics_of_people(tmp_path: Path) -> None:
    path = bags.write(tmp_path / "bag", [*driving(), *walking(), *walking(topic="/others")])
    refused(path, "H3-ROS-032")
    assert read_rosbag2(path, tracks=ImportRequest(people="/others")).agents[1].name == "ada"


def test_no_pose_of_a_robot(tmp_path: Path) -> None:
    refused(bags.write(tmp_path / "bag", walking()), "H3-ROS-034")


def test_a_robot_that_hangs_in_no_tree(tmp_path: Path) -> None:
    refused(bags.write(tmp_path / "bag", [*driving(root="dock"), *walking()]), "H3-ROS-035")


def test_frames_that_hang_in_a_circle(tmp_path: Path) -> None:
    circle = bags.tf(
        bags.transform(at(0), "base_link", "arm", 1.0, 0.0), bags.transform(at(0), "arm", "base_link", 1.0, 0.0)
    )
    path = bags.write(tmp_path / "bag", [(at(0), "/tf", "tf2_msgs/TFMessage", circle), *walking()])
    refused(path, "H3-ROS-035")


def test_people_in_a_frame_without_transforms(tmp_path: Path) -> None:
    refused(bags.write(tmp_path / "bag", [*driving(), *walking("camera")]), "H3-ROS-036")


# --- bags of our own --------------------------------------------------------------------------------------------------
def test_no_episode_in_a_bag_of_ours(own: Path, tmp_path: Path) -> None:
    refused(rewritten(own, tmp_path / "bag", EPISODE_TOPIC, lambda k, m: None), "H3-ROS-037")


@pytest.mark.parametrize("text", ["", "[]", "{", '{"version": 1}', "[" * 9999])
def test_a_damaged_episode_in_a_bag_of_ours(own: Path, tmp_path: Path, text: str) -> None:
    changed = bags.make("std_msgs/String", data=text)
    refused(rewritten(own, tmp_path / "bag", EPISODE_TOPIC, lambda k, m: changed), "H3-ROS-004")


def test_an_episode_of_a_newer_version(own: Path, tmp_path: Path) -> None:
    def newer(_: int, message: Any) -> Any:
        return bags.make("std_msgs/String", data=json.dumps({**json.loads(message.data), "version": 99}))

    refused(rewritten(own, tmp_path / "bag", EPISODE_TOPIC, newer), "H3-ROS-003")


def test_rows_of_columns_that_are_missing_or_of_other_lengths(own: Path, tmp_path: Path) -> None:
    def shortened(number: int, message: Any) -> Any:
        data = message.data[:-1] if number == 3 else message.data
        return bags.make("std_msgs/Float64MultiArray", layout=message.layout, data=data)

    refused(rewritten(own, tmp_path / "none", COLUMNS_TOPIC, lambda k, m: None), "H3-ROS-038")
    refused(rewritten(own, tmp_path / "short", COLUMNS_TOPIC, shortened), "H3-ROS-038")
    shorter = rewritten(
        own,
        tmp_path / "all",
        COLUMNS_TOPIC,
        lambda k, m: bags.make("std_msgs/Float64MultiArray", layout=m.layout, data=m.data[:-1]),
    )
    refused(shorter, "H3-ROS-002")


# --- values -----------------------------------------------------------------------------------------------------------
def test_a_clock_that_goes_back(tmp_path: Path) -> None:
    """A simulator that was started again: the same stamps twice, of which the earlier observations stay."""
    again = [(t + 10 * 10**9, topic, kind, message) for t, topic, kind, message in [*driving(), *walking()]]
    path = bags.write(tmp_path / "bag", [*driving(), *walking(), *again])
    back = read_rosbag2(path, tracks=ImportRequest())
    assert (np.diff(back.columns["time_ns"]) > 0).all()
    assert len(back) == 41
    assert any("come twice" in warning for warning in back.episode.info["warnings"])


def test_stamps_that_are_all_the_same(tmp_path: Path) -> None:
    messages = [
        (t, topic, kind, bags.people(at(0), "odom", {"ada": (6.0, 1.0)}) if topic == "/people" else message)
        for t, topic, kind, message in [*driving(), *walking()]
    ]
    back = read_rosbag2(bags.write(tmp_path / "bag", messages), tracks=ImportRequest())
    assert int(back.columns["agent_1.recorded"].sum()) == 1
    assert back.episode.info["imported"]["clock_offset_s"] == pytest.approx(2.0)


def test_a_stamp_years_away_makes_no_endless_recording(tmp_path: Path) -> None:
    stray = (at(4), "/people", "people_msgs/People", bags.people(10**9, "odom", {"ada": (6.0, 1.0)}))
    path = bags.write(tmp_path / "bag", [*driving(), *walking(), stray])
    assert len(read_rosbag2(path, tracks=ImportRequest())) < 60
    refused(path, "H3-ROS-013", hz=10.0)


def test_tracks_that_teleport(tmp_path: Path) -> None:
    """One jump makes two people of a track, tracks that only jump are refused."""
    once = bags.write(
        tmp_path / "once", [*driving(), *walking(place=lambda s: (6.0 - s + (20.0 if s > 2 else 0.0), 1.0))]
    )
    back = read_rosbag2(once, tracks=ImportRequest())
    assert len(back.agents) == 3
    assert any("jump" in warning for warning in back.episode.info["warnings"])
    always = walking(place=lambda s: (100.0 * (round(s * 10) % 2), 1.0))
    refused(bags.write(tmp_path / "always", [*driving(), *always]), "H3-ROS-010")


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e300])
def test_places_that_are_no_numbers(tmp_path: Path, wrong: float) -> None:
    path = bags.write(
        tmp_path / "bag", [*driving(), *walking(place=lambda s: (wrong if 1 < s < 1.25 else 6.0 - s, 1.0))]
    )
    back = read_rosbag2(path, tracks=ImportRequest())
    known = back.columns["agent_1.base_pose"]
    assert np.abs(known[np.isfinite(known)]).max() < 50
    assert back.episode.info["warnings"]


def test_a_robot_of_no_numbers(tmp_path: Path) -> None:
    nowhere = [
        (t, "/tf", "tf2_msgs/TFMessage", bags.tf(bags.transform(t, "odom", "base_link", np.nan, 0.0)))
        for t in (at(k / 10) for k in range(40))
    ]
    refused(bags.write(tmp_path / "bag", [*nowhere, *walking()]), "H3-ROS-014")


def test_a_map_that_lies_about_its_size(tmp_path: Path) -> None:
    info = bags.make(
        "nav_msgs/MapMetaData",
        map_load_time=bags.header(at(0), "").stamp,
        resolution=0.05,
        width=4_000_000_000,
        height=4_000_000_000,
        origin=bags.pose(0, 0),
    )
    grid = bags.make("nav_msgs/OccupancyGrid", header=bags.header(at(0), "map"), info=info, data=np.zeros(4, np.int8))
    path = bags.write(tmp_path / "bag", [(at(0), "/map", "nav_msgs/OccupancyGrid", grid), *driving(), *walking()])
    back = read_rosbag2(path, tracks=ImportRequest())
    assert back.episode.scene == ""
    assert any("/map" in warning for warning in back.episode.info["warnings"])


def test_files_of_a_bag_stay_inside_it(own: Path, tmp_path: Path) -> None:
    """A link out of the folder of attachments is not followed into the recording."""
    secret = tmp_path / "secret.txt"
    secret.write_text("secret")
    path = Path(shutil.copytree(own, tmp_path / "bag"))
    (path / "h3data" / "scene.txt").symlink_to(secret)
    back: Recording = read_rosbag2(path, tracks=ImportRequest())
    assert b"secret" not in back.attachments.values()
