"""Import of ROS 2 bags: those of real robots with tracked people, and exported ones (needs ``h3data[ros]``)."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, H3DataError, InputError
from h3data.files import path_inside
from h3data.formats import ImportRequest
from h3data.recording.records import Recording
from h3data.scene import Scene, load_scene
from h3data_ros.bag_sensors import CLOUD, JOINTS, LASER, JointLog, with_joints, with_scans
from h3data_ros.frames import message_time, pose_from_ros
from h3data_ros.messages import message_types, require_rosbags
from h3data_ros.occupancy import OccupancyMap, read_map, scene_of_map
from h3data_ros.stored_columns import COLUMNS_TOPIC, EPISODE_TOPIC, RECORDS, columns_from, read_episode
from h3data_ros.track_recording import GAP_S, Import, Track, on_floor, parse_goal, record_tracks
from h3data_ros.transforms import TransformTree

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader

METADATA, FILES = "metadata.yaml", "h3data"
TF, ODOMETRY, GRID = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry", "nav_msgs/msg/OccupancyGrid"
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
TRACKED, IDS, PEOPLE, MARKERS = (
    "spencer_tracking_msgs/msg/TrackedPersons",
    "hri_msgs/msg/IdsList",
    "people_msgs/msg/People",
    "visualization_msgs/msg/MarkerArray",
)
OF_PEOPLE = (IDS, TRACKED, PEOPLE, MARKERS)
"""Types of topics with people, the preferred first. Markers are used only if the user names them, because any topic may
have markers."""
BASES = ("base_footprint", "base_link")
ROOTS = ("map", "odom")
_SOLID = (1, 2, 3, 10)
"""Markers that show a body: cubes, spheres, cylinders, meshes; texts, arrows and lines are beside it."""
Pose = tuple[float, float, float, float, float, float, float]
UNTURNED = (math.nan, math.nan, math.nan, math.nan)
"""Quaternion for objects whose rotation a message does not state."""


def read_rosbag2(file: str | os.PathLike[str], *, tracks: ImportRequest) -> Recording:
    """Read a ROS 2 bag from its folder, its metadata.yaml, or one of its .mcap or .db3 files.

    A bag that `h3data_ros.bag_export.write_rosbag2` made becomes the same recording again, unless ``tracks`` has other
    options. In other bags, the robot's poses come from tf, Odometry or PoseStamped, people from ``tracks.people`` or
    the first topic of `OF_PEOPLE`, and walls from ``tracks.map`` or the last OccupancyGrid. `record_tracks` describes
    the rows.

    Raises:
        InputError: an option is wrong, or names a missing topic or frame.
        FormatError: the bag is damaged, or lacks what a recording needs.
        MissingExtraError: the extra ``ros`` is not installed.
    """
    require_rosbags()
    from rosbags.rosbag2 import Reader

    path = Path(os.fspath(file))
    folder = path.parent if path.name == METADATA else path
    refuse = [name for name in ("columns", "unit", "rate") if getattr(tracks, name)]
    if refuse:
        raise InputError(
            f"--{refuse[0]} is for files of tracks, not for bags. Leave it out: {folder}", code="H3-ROS-026"
        )
    try:
        with Reader(folder) as reader:
            return _read(_Bag(reader, folder), tracks)
    except (H3DataError, KeyboardInterrupt, MemoryError):
        raise
    except Exception as fault:  # rosbags raises whatever its parsers run into
        raise FormatError(
            f"The bag is damaged or unfinished ({type(fault).__name__}: {str(fault)[:120]}). Hint: `ros2 bag reindex` makes a "
            f"missing metadata.yaml, `mcap recover` saves what is sound: {folder}",
            code="H3-ROS-027",
        ) from fault


class _Bag:
    """The messages of a bag that is open, by topic."""

    def __init__(self, reader: Reader, path: Path) -> None:
        self._reader, self.path = reader, path
        self.kinds = {connection.topic: connection.msgtype for connection in reader.connections}
        self.counts: dict[str, int] = {}
        for connection in reader.connections:
            self.counts[connection.topic] = self.counts.get(connection.topic, 0) + connection.msgcount
        self._stores: dict[str, Any] = {}

    def topics(self, *kinds: str) -> list[str]:
        """Return the topics with messages of some types, those of the first type first."""
        return [topic for kind in kinds for topic, its in sorted(self.kinds.items()) if its == kind]

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording [ns] and message, in the order of the bag."""
        chosen = [connection for connection in self._reader.connections if connection.topic in topics]
        if not chosen:
            return
        for connection, t, data in self._reader.messages(connections=chosen):
            try:
                message = self._store(connection).deserialize_cdr(data, connection.msgtype)
            except Exception as fault:  # of code that is generated from the definition in the bag
                raise FormatError(
                    f"A message of type {connection.msgtype} on {connection.topic} is damaged or does not fit its definition "
                    f"({type(fault).__name__}). Hint: leave this topic out of the bag: {self.path}",
                    code="H3-ROS-028",
                ) from None
            yield connection.topic, t, message

    def last(self, topic: str) -> Any:
        """Return the last message on a topic, None if there is none."""
        message = None
        for _, _, message in self.messages([topic]):  # noqa: B007 - the last is wanted
            pass
        return message

    def _store(self, connection: Connection) -> Any:
        """Return the types by the definition in the bag, or those of Humble where it has none, as bags before Iron."""
        from rosbags.interfaces import MessageDefinitionFormat
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        if connection.msgtype not in self._stores:
            store = message_types()
            if connection.msgdef.format == MessageDefinitionFormat.MSG:
                store = get_typestore(Stores.EMPTY)
                store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
            elif connection.msgtype not in store.types:
                raise KeyError(connection.msgtype)
            self._stores[connection.msgtype] = store
        return self._stores[connection.msgtype]


def _read(bag: _Bag, tracks: ImportRequest) -> Recording:
    asked = tracks.people or tracks.robot or tracks.hz or tracks.map or tracks.goal or tracks.model
    if EPISODE_TOPIC in bag.kinds and COLUMNS_TOPIC in bag.kinds and not asked:
        return _read_own(bag)
    told = Import(source={"format": "rosbag2", "file": bag.path.name})
    told.goal = None if not tracks.goal else parse_goal(tracks.goal)
    people_topic = _people_topic(bag, tracks.people)
    log = _Log.of(bag, people_topic, joints=bag.topics(JOINTS) if tracks.model else [])
    root, frame = _robot_frame(log, tracks.robot, bag)
    told.facts |= {"people_topic": people_topic, "root": root, "robot": frame}
    if root != "map":
        told.warnings.append(f"there is no frame map: poses are in {root}, and drift of odometry is not corrected")
    gap = int(GAP_S * 1e9)
    stamps = log.tree.times_of(frame, root)
    poses = pose_from_ros(log.tree.poses(frame, root, stamps, gap))
    # base_link may be raised and tilted; base_footprint is the projection on the floor already (REP 120)
    if frame != "base_footprint":
        poses = on_floor(poses)
    robot = Track(name="robot", time_ns=stamps, poses=poses)
    people = _people_tracks(log, root, told, bag)
    offsets = np.array(log.offsets or [0])
    told.facts |= {"clock_offset_s": round(float(np.median(offsets)) * 1e-9, 6)}
    scene = _scene(bag, tracks, told)
    scans = bag.topics(LASER, CLOUD)[:1]
    used = {people_topic, *scans, *bag.topics(TF, ODOMETRY, *POSES), *([told.facts.get("map_topic")])}
    used |= set(bag.topics(JOINTS)) if tracks.model else set()
    if unread := [
        f"{topic} ({kind}, {bag.counts[topic]})" for topic, kind in sorted(bag.kinds.items()) if topic not in used
    ]:
        told.facts["not_read"] = unread
    recording = record_tracks(people, robot, told, scene=scene, hz=tracks.hz, task="rosbag2", model=tracks.model)
    rows = recording.columns["time_ns"] + recording.episode.info["t0_unix_ns"]
    if tracks.model:
        recording = with_joints(recording, log.joints, rows)
    for topic in scans:
        near = max(gap // 5, recording.episode.dt_ns)
        recording, count = with_scans(recording, bag.messages([topic]), log.tree, frame, rows, near)
        told.facts["scans"] = f"{topic} ({bag.kinds[topic]}): {count} rows of {bag.counts[topic]} messages"
    return recording


@dataclass
class _Log:
    """Transforms and people as the messages tell them."""

    tree: TransformTree
    places: list[tuple[str, str, int, Pose]] = field(default_factory=list)
    """Id, frame of reference, stamp and pose of a person; the quaternion is NaN if unknown."""
    listed: list[tuple[str, str, int]] = field(default_factory=list)
    """Id, name of the frame and stamp of people who have frames of their own."""
    offsets: list[int] = field(default_factory=list)
    """Time of recording less stamp of messages about people [ns]."""
    joints: JointLog = field(default_factory=JointLog)
    """Positions of joints."""
    odometry: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Frame of reference and frame of the robot by topic of odometry and poses."""

    @classmethod
    def of(cls, bag: _Bag, people: str, joints: Sequence[str]) -> _Log:
        """Read transforms, odometry, poses, and the topics of people and joints."""
        log = cls(tree=TransformTree())
        moving = bag.topics(TF)
        others = bag.topics(ODOMETRY, *POSES)
        odometry: list[tuple[str, str, int, Pose]] = []
        for topic, t, message in bag.messages([*moving, *others, people, *joints]):
            kind = bag.kinds[topic]
            if kind == JOINTS:
                log.joints.add(message, t)
                continue
            if kind == TF:
                for one in message.transforms:
                    x, q = one.transform.translation, one.transform.rotation
                    pose = (x.x, x.y, x.z, q.x, q.y, q.z, q.w)
                    still = topic.endswith("tf_static")
                    log.tree.add(
                        _frame(one.header),
                        one.child_frame_id.lstrip("/"),
                        message_time(one.header, t),
                        pose,
                        still=still,
                    )
            elif topic == people:
                log._add_people(kind, topic, t, message)
            else:
                pose = message.pose if kind == POSES[0] else message.pose.pose
                child = message.child_frame_id.lstrip("/") if kind == ODOMETRY else topic
                log.odometry[topic] = (_frame(message.header), child)
                odometry.append((_frame(message.header), child, message_time(message.header, t), _pose(pose)))
        # most drivers publish odometry as a topic and as a transform; only where there is no transform the topic is one
        told = {child for _, child, _, _ in odometry if child in log.tree}
        for parent, child, t, pose in odometry:
            if child not in told:
                log.tree.add(parent, child, t, pose)
        return log

    def _add_people(self, kind: str, topic: str, t: int, message: Any) -> None:
        if kind == MARKERS:
            seen: set[str] = set()
            for marker in message.markers:
                name = f"{marker.ns}_{marker.id}" if marker.ns else str(marker.id)
                # texts and arrows often have the id of the person that they stand beside; action 0 adds or moves, others delete
                if marker.action != 0 or marker.type not in _SOLID or name in seen:
                    continue
                seen.add(name)
                self._add(name, marker.header, t, (*_pose(marker.pose)[:3], *UNTURNED))
            return
        stamp = message_time(message.header, t)
        self.offsets.append(t - stamp)
        if kind == IDS:
            part = "body_" if "bodies" in topic else "face_" if "faces" in topic else "person_"
            self.listed += [(name, f"{part}{name}", stamp) for name in message.ids]
        elif kind == TRACKED:
            for one in message.tracks:
                self._add(str(one.track_id), message.header, t, _pose(one.pose.pose))
        else:
            for number, one in enumerate(message.people):
                p = one.position
                self._add(one.name or f"unnamed_{number}", message.header, t, (p.x, p.y, p.z, *UNTURNED))

    def _add(self, name: str, header: Any, t: int, pose: Pose) -> None:
        self.places.append((name, _frame(header), message_time(header, t), pose))


def _people_topic(bag: _Bag, asked: str) -> str:
    if asked:
        if asked not in bag.kinds:
            here = ", ".join(bag.topics(*OF_PEOPLE)) or "none of people"
            raise InputError(f"There is no topic {asked} in the bag; it has {here}: {bag.path}", code="H3-ROS-029")
        if bag.kinds[asked] not in OF_PEOPLE:
            raise InputError(
                f"Expected one of {', '.join(OF_PEOPLE)} on {asked}, whose people have ids, got {bag.kinds[asked]}: {bag.path}",
                code="H3-ROS-030",
            )
        return asked
    found = bag.topics(*OF_PEOPLE[:-1])
    # hri_msgs lists faces, bodies and voices by the same type; a person is what all of these belong to (REP 155)
    found = [topic for topic in found if bag.kinds[topic] != IDS or "persons" in topic]
    if not found:
        raise FormatError(
            f"The bag has no topic of people that is known ({', '.join(OF_PEOPLE[:-1])}). Hint: name one of markers with "
            f"--people TOPIC: {', '.join(bag.topics(MARKERS)) or 'there is none'}: {bag.path}",
            code="H3-ROS-031",
        )
    if len(found) > 1 and bag.kinds[found[0]] == bag.kinds[found[1]]:
        raise InputError(
            f"The bag has several topics of people. Choose one with --people: {', '.join(found)}: {bag.path}",
            code="H3-ROS-032",
        )
    return found[0]


def _robot_frame(log: _Log, asked: str, bag: _Bag) -> tuple[str, str]:
    """Return the frame of reference and the frame of the robot."""
    if asked in log.odometry:
        frame = log.odometry[asked][1]
    elif asked:
        frame = asked.lstrip("/")
        if frame not in log.tree:
            raise InputError(f"There is no frame or topic of poses {asked!r} in the bag: {bag.path}", code="H3-ROS-033")
    else:
        frames = [frame for frame in BASES if frame in log.tree] or [child for _, child in log.odometry.values()]
        if not frames:
            raise FormatError(
                "The bag has no pose of the robot: no frame base_footprint or base_link, Odometry or PoseStamped. Hint: "
                f"--robot FRAME: {bag.path}",
                code="H3-ROS-034",
            )
        frame = frames[0]
    roots = [root for root in ROOTS if root in log.tree and root != frame and log.tree.connected(frame, root)]
    roots += [parent for parent, child in log.odometry.values() if child == frame]
    if not roots:
        raise FormatError(
            f"The frame {frame!r} hangs neither in map nor in odom, so nobody knows where the robot is. Hint: record /tf and "
            f"/tf_static from the beginning: {bag.path}",
            code="H3-ROS-035",
        )
    return roots[0], frame


def _people_tracks(log: _Log, root: str, told: Import, bag: _Bag) -> list[Track]:
    gap = int(GAP_S * 1e9)
    tracks: dict[str, list[tuple[NDArray[np.int64], NDArray[np.float64]]]] = {}
    lost: set[str] = set()
    by_frame: dict[str, list[tuple[str, int, Pose]]] = {}
    for name, frame, t, pose in log.places:
        by_frame.setdefault(frame, []).append((name, t, pose))
    for frame, places in by_frame.items():
        times = np.array([t for _, t, _ in places], np.int64)
        poses = np.array([pose for _, _, pose in places], np.float64)
        if frame != root:
            if frame not in log.tree or not log.tree.connected(frame, root):
                lost.add(frame)
                continue
            poses = _in_root(log.tree.poses(frame, root, times, gap), poses)
        names = np.array([name for name, _, _ in places])
        for name in dict.fromkeys(names.tolist()):
            mine = names == name
            tracks.setdefault(name, []).append((times[mine], _upright(poses[mine])))
    by_name: dict[tuple[str, str], list[int]] = {}
    for name, frame, t in log.listed:
        by_name.setdefault((name, frame), []).append(t)
    for (name, frame), stamps in by_name.items():
        if frame not in log.tree or not log.tree.connected(frame, root):
            lost.add(frame)
            continue
        times = np.array(stamps, np.int64)
        tracks.setdefault(name, []).append((times, on_floor(pose_from_ros(log.tree.poses(frame, root, times, gap)))))
    if lost and not tracks:
        raise FormatError(
            f"People are in the frame {sorted(lost)[0]!r}, which hangs in no tree with {root!r}. Hint: record /tf and "
            f"/tf_static from the beginning: {bag.path}",
            code="H3-ROS-036",
        )
    if lost:
        told.warnings.append(f"frames that hang nowhere are left out: {', '.join(sorted(lost)[:4])}")
    if not tracks:
        told.warnings.append(f"nobody is ever on {told.facts['people_topic']}")
    return [
        Track(name=name, time_ns=np.concatenate([t for t, _ in parts]), poses=np.concatenate([p for _, p in parts]))
        for name, parts in tracks.items()
        if name != "robot"
    ]


def _in_root(frames: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    from h3data.geometry import pose_multiply, quat_rotate

    moved = pose_multiply(frames, poses)
    moved[:, :3] = frames[:, :3] + quat_rotate(frames[:, 3:], poses[:, :3])  # also where the quaternion is NaN
    return np.asarray(moved, np.float64)


def _upright(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the world poses at the floor of poses in the root; unknown quaternions stay so."""
    world = pose_from_ros(poses)
    known = np.isfinite(world[:, 3:]).all(axis=1) & (np.abs(world[:, 3:]).sum(axis=1) > 0.5)
    upright = np.full(world.shape, np.nan)
    upright[:, [0, 2]], upright[:, 1] = world[:, [0, 2]], 0.0
    if known.all() and len(known):
        upright[:, 3:] = on_floor(world)[:, 3:]
    return upright


def _scene(bag: _Bag, tracks: ImportRequest, told: Import) -> Scene | None:
    if tracks.map is not None:
        return scene_of_map(read_map(tracks.map), Path(tracks.map).stem)
    own = bag.path / FILES / "scene.glb"
    if own.is_file() and not own.is_symlink():
        return load_scene(own.read_bytes())
    for topic in bag.topics(GRID):
        # costmaps of nav2 have the type of a map, but their walls are inflated
        if "costmap" in topic or (grid := bag.last(topic)) is None:
            continue
        info, data = grid.info, np.asarray(grid.data, np.int8)
        rows, columns = int(info.height), int(info.width)
        turned = abs(info.origin.orientation.x) + abs(info.origin.orientation.y) + abs(info.origin.orientation.z)
        if rows * columns != len(data) or not len(data) or turned > 1e-6 or not info.resolution > 0:
            told.warnings.append(f"the map on {topic} is empty, damaged or turned, and is left out")
            continue
        shares = data.reshape(rows, columns)
        # the default thresholds of nav2's map_server, for maps that hold probabilities
        cells = np.where(shares < 0, -1, np.where(shares >= 65, 100, np.where(shares <= 25, 0, -1))).astype(np.int8)
        origin = (float(info.origin.position.x), float(info.origin.position.y))
        resolution = round(float(info.resolution), 7)  # float32 in the message: 0.05 is meant, not 0.0500000007
        told.facts["map_topic"] = topic
        return scene_of_map(OccupancyMap(cells=cells, resolution=resolution, origin=origin), topic.strip("/"))
    return None


# --- our own bags -----------------------------------------------------------------------------------------------------
def _read_own(bag: _Bag) -> Recording:
    """Return the recording that the bag was made of: poses from /tf, everything else from our own topics."""
    document = bag.last(EPISODE_TOPIC)
    if document is None:
        raise FormatError(f"There is no message on {EPISODE_TOPIC}: {bag.path}", code="H3-ROS-037")
    values = read_episode(document.data, path=bag.path)
    frames = {frame: number for number, frame in values["robots"].items()}
    frames |= {f"person_{name}": number for number, name in values["people"].items()}
    times: list[int] = []
    rows: list[NDArray[np.float64]] = []
    poses: dict[int, list[tuple[int, Pose]]] = {number: [] for number in frames.values()}
    for topic, t, message in bag.messages([COLUMNS_TOPIC, *bag.topics(TF)]):
        if topic == COLUMNS_TOPIC:
            times.append(t)
            rows.append(np.asarray(message.data, np.float64))
            continue
        for one in message.transforms:
            if one.child_frame_id in frames:
                x, q = one.transform.translation, one.transform.rotation
                place = (x.x, x.y, x.z, q.x, q.y, q.z, q.w)
                poses[frames[one.child_frame_id]].append((message_time(one.header, t), place))
    if len({len(row) for row in rows}) > 1 or not rows:
        raise FormatError(
            f"Messages on {COLUMNS_TOPIC} are missing or of different lengths: {bag.path}", code="H3-ROS-038"
        )
    columns: dict[str, Any] = {"time_ns": np.array(times, np.int64) - values["start_ns"]}
    for number, told in sorted(poses.items()):
        base = np.full((len(times), 7), np.nan)
        at = np.searchsorted(times, [t for t, _ in told])
        for row, (t, pose) in zip(at.tolist(), told, strict=True):
            if row < len(times) and times[row] == t:
                base[row] = pose
        columns[f"agent_{number}.base_pose"] = pose_from_ros(base).astype(np.float32)
    columns |= columns_from(np.stack(rows), values["columns"])
    attachments = {}
    folder = bag.path / FILES
    for file in sorted(folder.rglob("*")) if folder.is_dir() else ():
        name = path_inside(file.relative_to(folder).as_posix())
        if file.is_file() and not file.is_symlink() and name:  # a link may point at any file of whoever imports the bag
            attachments[name] = file.read_bytes()
    records = {name: values[name] for name in RECORDS}
    return Recording(episode=values["episode"], columns=columns, attachments=attachments, **records)


def _frame(header: Any) -> str:
    return header.frame_id.lstrip("/")


def _pose(pose: Any) -> Pose:
    p, q = pose.position, pose.orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
