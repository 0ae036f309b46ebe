"""Bags like those of real robots, made up: odometry that drifts, a slow localization, people in the frame of the robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from h3data_ros.messages import message_types

STORE = message_types()


def make(kind: str, **fields: Any) -> Any:
    return STORE.types[kind.replace("/", "/msg/")](**fields)


def header(t: int, frame: str) -> Any:
    return make(
        "std_msgs/Header", stamp=make("builtin_interfaces/Time", sec=t // 10**9, nanosec=t % 10**9), frame_id=frame
    )


def pose(x: float, y: float, yaw: float = 0.0) -> Any:
    return make(
        "geometry_msgs/Pose",
        position=make("geometry_msgs/Point", x=float(x), y=float(y), z=0.0),
        orientation=make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2))),
    )


def transform(t: int, parent: str, child: str, x: float, y: float, yaw: float = 0.0) -> Any:
    at = pose(x, y, yaw)
    return make(
        "geometry_msgs/TransformStamped",
        header=header(t, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/Transform",
            translation=make("geometry_msgs/Vector3", x=at.position.x, y=at.position.y, z=0.0),
            rotation=at.orientation,
        ),
    )


def tf(*transforms: Any) -> Any:
    return make("tf2_msgs/TFMessage", transforms=list(transforms))


def people(t: int, frame: str, places: dict[str, tuple[float, float]]) -> Any:
    nowhere = make("geometry_msgs/Point", x=0.0, y=0.0, z=0.0)
    found = [
        make(
            "people_msgs/Person",
            name=name,
            position=make("geometry_msgs/Point", x=float(x), y=float(y), z=0.9),
            velocity=nowhere,
            reliability=0.8,
            tagnames=[],
            tags=[],
        )
        for name, (x, y) in places.items()
    ]
    return make("people_msgs/People", header=header(t, frame), people=found)


def spencer(t: int, frame: str, places: dict[int, tuple[float, float, float]]) -> Any:
    zero = make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
    still = make("geometry_msgs/Twist", linear=zero, angular=zero)
    tracks = [
        make(
            "spencer_tracking_msgs/TrackedPerson",
            track_id=number,
            is_occluded=False,
            is_matched=True,
            detection_id=0,
            age=make("builtin_interfaces/Duration", sec=0, nanosec=0),
            pose=make("geometry_msgs/PoseWithCovariance", pose=pose(*place), covariance=np.zeros(36)),
            twist=make("geometry_msgs/TwistWithCovariance", twist=still, covariance=np.zeros(36)),
        )
        for number, place in places.items()
    ]
    return make("spencer_tracking_msgs/TrackedPersons", header=header(t, frame), tracks=tracks)


def markers(t: int, frame: str, places: dict[int, tuple[float, float]]) -> Any:
    found = []
    for number, place in places.items():
        for kind in (9, 3):  # a text and a cylinder
            found.append(  # noqa: PERF401
                make(
                    "visualization_msgs/Marker",
                    header=header(t, frame),
                    ns="people",
                    id=number,
                    type=kind,
                    action=0,
                    pose=pose(*place) if kind == 3 else pose(50, 50),
                    scale=make("geometry_msgs/Vector3", x=1.0, y=1.0, z=1.0),
                    color=make("std_msgs/ColorRGBA", r=1.0, g=0.0, b=0.0, a=1.0),
                    lifetime=make("builtin_interfaces/Duration", sec=0, nanosec=0),
                    frame_locked=False,
                    points=[],
                    colors=[],
                    texture_resource="",
                    texture=make(
                        "sensor_msgs/CompressedImage", header=header(t, ""), format="", data=np.zeros(0, np.uint8)
                    ),
                    uv_coordinates=[],
                    text="",
                    mesh_resource="",
                    mesh_file=make("visualization_msgs/MeshFile", filename="", data=np.zeros(0, np.uint8)),
                    mesh_use_embedded_materials=False,
                )
            )
    return make("visualization_msgs/MarkerArray", markers=found)


def write(path: Path, messages: list[tuple[int, str, str, Any]], *, storage: str = "sqlite3") -> Path:
    """A bag of (time, topic, type, message), in the order of their times."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
    with Writer(path, version=8, storage_plugin=plugin) as bag:
        known: dict[str, Any] = {}
        for t, topic, kind, message in sorted(messages, key=lambda m: m[0]):
            name = kind.replace("/", "/msg/")
            if topic not in known:
                known[topic] = bag.add_connection(topic, name, typestore=STORE)
            bag.write(known[topic], t, STORE.serialize_cdr(message, name))
    return path


def laser_scan(t: int, frame: str, ranges: np.ndarray, *, first: float, step: float, most: float = 10.0) -> Any:
    return make(
        "sensor_msgs/LaserScan",
        header=header(t, frame),
        angle_min=first,
        angle_max=first + step * (len(ranges) - 1),
        angle_increment=step,
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.05,
        range_max=most,
        ranges=np.asarray(ranges, np.float32),
        intensities=np.zeros(0, np.float32),
    )


def cloud(t: int, frame: str, points: np.ndarray, *, big: bool = False, kind: str = "f4", **wrong: Any) -> Any:
    """An unordered cloud of points [N, 3] with an intensity before the coordinates, as drivers write them."""
    size = np.dtype(kind).itemsize
    names = [
        make("sensor_msgs/PointField", name=name, offset=offset, datatype=datatype, count=1)
        for name, offset, datatype in [
            ("intensity", 0, 7), *((axis, 4 + k * size, {4: 7, 8: 8}[size]) for k, axis in enumerate("xyz"))
        ]
    ]  # fmt: skip
    order = ">" if big else "<"
    rows = np.zeros(len(points), [("i", order + "f4"), ("p", order + kind, 3)])
    rows["p"] = points
    told = {
        "height": 1,
        "width": len(points),
        "fields": names,
        "is_bigendian": big,
        "point_step": rows.itemsize,
        "row_step": rows.itemsize * len(points),
        "data": np.frombuffer(rows.tobytes(), np.uint8),
        "is_dense": True,
    }
    return make("sensor_msgs/PointCloud2", header=header(t, frame), **{**told, **wrong})


def joint_state(t: int, positions: dict[str, float]) -> Any:
    values = np.array(list(positions.values()), np.float64)
    return make(
        "sensor_msgs/JointState",
        header=header(t, ""),
        name=list(positions),
        position=values,
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )


T0 = 1_700_000_000 * 10**9


def robot_at(seconds: float) -> tuple[float, float, float]:
    """The true pose of the robot in the map: it drives straight at 0.5 m/s."""
    return 1.0 + 0.5 * seconds, 2.0, 0.0


def real_robot(
    path: Path,
    *,
    seconds: float = 20.0,
    count: int = 2,
    people_hz: float = 10.0,
    kind: str = "people_msgs/People",
    silent: Callable[[str, float], bool] = lambda name, s: False,
    storage: str = "sqlite3",
    more: Sequence[tuple[float, str, str, Any]] = (),
) -> Path:
    """A bag whose robot drives by `robot_at`: tf at 50 Hz with stamps 20 ms before the bag's times, and people in base_link.

    Its odometry starts elsewhere and is turned by 0.3 rad, which map -> odom corrects once a second. ``silent(name, s)``
    leaves out what is called ``tf`` or ``people``, or one person by name, at a time. ``more`` are messages of other topics,
    with their times [s].
    """
    turn, shift = 0.3, np.array([4.0, -1.0])
    back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    messages: list[tuple[int, str, str, Any]] = []

    def put(s: float, topic: str, kind: str, message: Any) -> None:
        messages.append((T0 + int(s * 1e9) + 20_000_000, topic, kind, message))

    put(0, "/tf_static", "tf2_msgs/TFMessage", tf(transform(T0, "base_link", "base_scan", 0.2, 0.0)))
    for k in range(int(seconds * 50) + 1):
        s = k / 50
        t = T0 + int(s * 1e9)
        if k % 50 == 0:
            put(s, "/tf", "tf2_msgs/TFMessage", tf(transform(t, "map", "odom", *shift, turn)))
        if not silent("tf", s):
            x, y, yaw = robot_at(s)
            at = back @ (np.array([x, y]) - shift)
            put(s, "/tf", "tf2_msgs/TFMessage", tf(transform(t, "odom", "base_link", *at, yaw - turn)))
    for k in range(int(seconds * people_hz) + 1):
        s = k / people_hz
        if silent("people", s):
            continue
        t, (x, y, _) = T0 + int(s * 1e9), robot_at(s)
        places = {
            f"p{n}": (person_at(n, s)[0] - x - 0.2, person_at(n, s)[1] - y)
            for n in range(count)
            if not silent(f"p{n}", s)
        }
        put(s, "/people", kind, people(t, "base_scan", places))
    for one in more:
        put(*one)
    return write(path, messages, storage=storage)


def person_at(number: int, seconds: float) -> tuple[float, float]:
    """The true place of a person in the map: they walk towards the robot at 1 m/s, side by side."""
    return 15.0 - 1.0 * seconds, 2.8 + 0.9 * number
