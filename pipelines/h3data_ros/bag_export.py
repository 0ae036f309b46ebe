"""Export of recordings as ROS 2 bags, for RViz, Foxglove, PlotJuggler and ``ros2 bag play`` (needs ``h3data[ros]``)."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import load_robot
from h3data.bodies.people.skeleton import JOINT_INDEX, JOINT_NAMES
from h3data.errors import H3DataError, InputError
from h3data.files import path_inside, size_text
from h3data.formats import BagStorage, Exported, ExportRequest
from h3data.geometry import heading_from_quat, pose_from_matrix, pose_multiply, wrap_angle
from h3data.recording.mcap.header import log_time, start_time
from h3data.recording.records import Recording
from h3data.recording.scans import Scan, clouds_of, scans_of
from h3data.render.camera import Camera
from h3data.replay import Replay, camera_track
from h3data.replay.posed_recording import PosedRecording
from h3data.scene import FreeSpace, Scene, load_scene
from h3data_exporters.posing import drawn_note
from h3data_ros.frames import FROM_WORLD, pose_to_ros, safe_names
from h3data_ros.messages import delivery, message_types, require_rosbags
from h3data_ros.occupancy import map_of
from h3data_ros.robot_links import BLOCK, RobotLinks, robot_links
from h3data_ros.scans import RANGE_M, cast_scans
from h3data_ros.stored_columns import COLUMNS_TOPIC, EPISODE_TOPIC, carried, episode_text, labels_of, rows_of

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer

MAP, PERSON, THING = "map", "person_", "object_"
TRACKED_JOINTS = JOINT_INDEX["jaw"]
"""Number of people's joints whose frames are written: the body without face and fingers."""
FILES = "h3data"
"""Name of the folder in the bag for files of the recording, such as its scene."""
START_NS = 1_000_000_000
"""Time stamp of time 0 in recordings without a start time [ns]; stamp 0 means "latest" or "never" in ROS."""
METADATA_VERSION = 8
"""Version of metadata.yaml; tools of Humble and Iron cannot read version 9."""
PERSON_RADIUS_M = 0.25
"""Radius of people in scans that are cast [m]."""
LIDAR_HEIGHT_M = 0.3
"""Height of the frame of scans above the floor [m]."""
CLOUD_FRAME = "base_lidar_3d"
"""Frame of the scanner whose scans are point clouds."""
RAYS_MAX = 4096
JPEG_QUALITY = 90
Pictures = Iterable[tuple[int, Sequence[NDArray[np.uint8]]]]
"""Steps in order, each with the sRGB picture [H, W, 3] of every camera."""


class _RobotScan(NamedTuple):
    """Scans of one robot in each step."""

    ranges: NDArray[np.floating]
    """Distances [T, R] [m]; infinite where a ray met nothing."""
    first_rad: float
    """Angle of the first ray from straight ahead, positive to the left; the others follow to the left."""
    most_m: float
    """Greatest distance that the scanner can measure [m]."""


class _Described(NamedTuple):
    """Looks and links of one robot."""

    urdf: str
    links: RobotLinks


@dataclass(frozen=True, kw_only=True, eq=False)
class BagCamera:
    """Camera with its poses, whose images and camera_info are written to a bag."""

    camera: Camera
    """Intrinsics and name of the camera."""
    poses: NDArray[np.floating]
    """Matrices from the camera (OpenCV axes) to the world, [T, 4, 4], or [1, 4, 4] for a static camera."""


@dataclass(frozen=True)
class BagFile:
    """Result of writing a bag."""

    path: Path
    topics: tuple[str, ...]
    messages: int
    notes: tuple[str, ...]
    """Sentences about topics whose data the recording lacks."""


def write_rosbag2(
    recording: Recording,
    path: str | Path,
    *,
    storage: BagStorage = "mcap",
    cameras: Sequence[BagCamera] = (),
    pictures: Pictures = (),
    lidar_rays: int = 0,
) -> BagFile:
    """Write a recording as a ROS 2 bag with message definitions, for Humble to Jazzy.

    Frames follow REP 103 and 105: ``map`` > ``odom`` > ``base_footprint`` > ``base_link``; ``map`` also has
    ``person_<name>``, the joints of people such as ``left_wrist_<name>``, moving objects ``object_<name>``, and
    ``<camera>_optical_frame``. If there are several robots, topics and frames start with their names. Stamps are the
    times of the recording. All poses can be read back exactly with `h3data_ros.bag_import.read_rosbag2`.

    Args:
        recording: Recording to write.
        path: Folder of the bag, which is created if necessary.
        storage: File format. Humble needs a package for ``mcap``, and has ``sqlite3``.
        cameras: Cameras whose images are written as JPEG.
        pictures: Pictures of these cameras.
        lidar_rays: Rays of a simulated planar lidar on each robot without a recorded scan; 0 for none.

    Raises:
        InputError: there is no step, or two cameras have one name.
        MissingExtraError: the extra ``ros`` is not installed.
    """
    path = Path(path)
    require_rosbags()
    from rosbags.rosbag2 import StoragePlugin, Writer

    if not len(recording):
        raise InputError("A recording without steps has nothing to write into a bag.", code="H3-ROS-005")
    names = [view.camera.name for view in cameras]
    if len(set(names)) < len(names):
        raise InputError(f"Each camera is written once, got: {', '.join(names)}.", code="H3-ROS-006")
    if not 0 <= lidar_rays <= RAYS_MAX:
        raise InputError(f"A lidar has 0 to {RAYS_MAX} rays, got {lidar_rays}.", code="H3-ROS-008")
    path.mkdir(parents=True, exist_ok=True)
    # rosbags refuses a folder that is there, and a bag of before must stay whole until the new one is
    work = path / ".part"
    shutil.rmtree(work, ignore_errors=True)
    try:
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        with Writer(work / path.resolve().name, version=METADATA_VERSION, storage_plugin=plugin) as bag:
            export = _Export(recording, bag, cameras, lidar_rays)
            export.write(pictures)
        for old in (*path.glob("*.mcap"), *path.glob("*.db3"), path / "metadata.yaml"):
            old.unlink(missing_ok=True)
        shutil.rmtree(path / FILES, ignore_errors=True)
        for file in (work / path.resolve().name).iterdir():
            file.replace(path / file.name)
        for name, data in recording.attachments.items():
            inside = path_inside(name)
            if inside:
                (path / FILES / inside).parent.mkdir(parents=True, exist_ok=True)
                (path / FILES / inside).write_bytes(data)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return BagFile(path, tuple(sorted(export.counts)), sum(export.counts.values()), tuple(export.notes))


def export_rosbag2(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Export one recording for ``h3data export --to rosbag2``, with the images of each requested camera."""
    require_rosbags()
    (recording,) = recordings
    missing: list[str] = []
    cameras: list[BagCamera] = []
    pictures: Pictures = ()
    if request.cameras:
        replay = Replay(
            recording, assets=request.assets, people=request.people, detail=False, stand_ins=request.stand_ins
        )
        tracks = [camera_track(replay, name) for name in request.cameras]
        frames = replay.frames(tracks, range(len(recording)), threads=request.threads, backend=request.backend)
        shown = request.progress(frames, len(recording), "frame")
        pictures = ((step, [image["rgb"] for image in images]) for step, images in shown)
        cameras = [BagCamera(camera=track.camera, poses=track.poses) for track in tracks]
        missing = sorted(replay.missing)
    bag = write_rosbag2(
        recording,
        request.out,
        storage=request.storage,
        cameras=cameras,
        pictures=pictures,
        lidar_rays=request.lidar,
    )
    size = sum(file.stat().st_size for file in bag.path.rglob("*") if file.is_file())
    lines = [f"{bag.path}: {bag.messages} messages on {len(bag.topics)} topics, {size_text(size)}", *bag.notes]
    data = {
        "messages": bag.messages,
        "topics": list(bag.topics),
        "bytes": size,
        "notes": list(bag.notes),
        "missing": missing,
    }
    return Exported(text="\n".join(lines) + drawn_note(missing, stand_ins=request.stand_ins), data=data)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Mover:
    """A robot or a person."""

    number: int
    name: str
    """Name of the mover in topics and frames."""
    frame: str
    poses: NDArray[np.float64]
    """Poses in the frame ``map`` [T, 7]."""
    velocity: NDArray[np.float64]
    """Velocity in the frame ``map`` since the row before [T, 2] [m/s]; 0 where unknown."""
    turning: NDArray[np.float64]
    """Turn to the left since the row before [T] [rad/s]; 0 where unknown."""
    known: NDArray[np.bool_]
    """Rows in which the mover is present [T]."""


class _Export:
    """Bag that is being written, with messages in the order of their times."""

    def __init__(self, recording: Recording, bag: Writer, cameras: Sequence[BagCamera], lidar_rays: int) -> None:
        self._recording, self._bag, self._cameras = recording, bag, cameras
        self._store = message_types()
        self._type = {name.replace("/msg/", "/"): kind for name, kind in self._store.types.items()}
        self._connections: dict[str, Connection] = {}
        self.counts: dict[str, int] = {}
        self.notes: list[str] = []
        begin = start_time(recording, None) or START_NS
        self._start_ns = begin
        self._times = [log_time(begin, t) for t in recording.columns["time_ns"].tolist()]
        kinds = [agent.kind for agent in recording.agents]
        names = safe_names([agent.name for agent in recording.agents], "agent")
        robots, people = ([k for k, own in enumerate(kinds) if own == kind] for kind in ("robot", "human"))
        self._robots = [self._mover(k, names[k], f"{names[k]}/" if len(robots) > 1 else "") for k in robots]
        self._people = [self._mover(k, names[k], None) for k in people]
        self._camera_names = safe_names([view.camera.name for view in cameras], "camera")
        self._scene = load_scene(recording.attachments["scene.glb"]) if "scene.glb" in recording.attachments else None
        self._free = None if self._scene is None else self._floor(self._scene)
        self._scans = self._find_scans(lidar_rays)
        self._clouds = {scan.agent: scan for scan in clouds_of(recording)}
        self._described = {
            robot.number: found for robot in self._robots if (found := self._describe(robot)) is not None
        }

        self._parts = self._joints() | self._things()

    def write(self, pictures: Pictures) -> None:
        """Write all messages."""
        layout = carried(
            self._recording.columns, [f"agent_{m.number}.base_pose" for m in [*self._robots, *self._people]]
        )
        self._write_latched(layout)
        labels = ",".join(labels_of(layout))
        rows = rows_of(self._recording.columns, layout, len(self._times))
        seen = iter(pictures)
        picture = next(seen, None)
        for step, t in enumerate(self._times):
            stamp = self._stamp(t)
            self._put("/clock", "rosgraph_msgs/Clock", t, best_effort=True, clock=stamp)
            self._write_transforms(step, t)
            for robot in self._robots:
                if robot.known[step]:
                    self._write_robot(robot, step, t)
            self._write_people(step, t)
            dim = self._make(
                "std_msgs/MultiArrayDimension",
                # the first message names the columns for all
                label=labels if step == 0 else "",
                size=rows.shape[1],
                stride=rows.shape[1],
            )
            array = self._make("std_msgs/MultiArrayLayout", dim=[dim], data_offset=0)
            self._put(COLUMNS_TOPIC, "std_msgs/Float64MultiArray", t, layout=array, data=rows[step])
            if picture is not None and picture[0] == step:
                self._write_pictures(step, t, picture[1])
                picture = next(seen, None)
        if picture is not None:
            raise InputError(
                f"Pictures must come in the order of their steps; that of step {picture[0]} fits nowhere.",
                code="H3-ROS-007",
            )

    # --- what is written once -----------------------------------------------------------------------------------------
    def _write_latched(self, layout: Sequence[Any]) -> None:
        t = self._times[0]
        still = []
        for robot in self._robots:
            prefix = robot.frame.removesuffix("base_footprint")
            still.append(self._transform(t, MAP, f"{prefix}odom", _IDENTITY))
            described = self._described.get(robot.number)
            if described is None:
                still.append(self._transform(t, robot.frame, f"{prefix}base_link", _IDENTITY))
            else:
                still += [self._transform(t, *edge) for edge in described.links.still]
                topic = self._topic(robot, "robot_description")
                self._put(topic, "std_msgs/String", t, latched=True, data=described.urdf)
            if robot.number in self._clouds:
                at = np.array([0, 0, self._clouds[robot.number].height_m, 0, 0, 0, 1.0])
                still.append(self._transform(t, robot.frame, f"{prefix}{CLOUD_FRAME}", at))
            if robot.number in self._scans:
                at = np.array([0, 0, LIDAR_HEIGHT_M, 0, 0, 0, 1.0])
                still.append(self._transform(t, robot.frame, f"{prefix}base_scan", at))
        if still:
            self._put("/tf_static", "tf2_msgs/TFMessage", t, latched=True, transforms=still)
        text = episode_text(
            self._recording,
            layout,
            start_ns=self._start_ns,
            robots={robot.number: robot.frame for robot in self._robots},
            people={person.number: person.name for person in self._people},
        )
        self._put(EPISODE_TOPIC, "std_msgs/String", t, latched=True, data=text)
        if self._free is None:
            self.notes.append("No map: the recording does not hold its scene.")
            return
        grid = map_of(self._free)
        rows, columns = grid.cells.shape
        info = self._make(
            "nav_msgs/MapMetaData",
            map_load_time=self._stamp(t),
            resolution=grid.resolution,
            width=columns,
            height=rows,
            origin=self._pose(np.array([*grid.origin, 0, 0, 0, 0, 1.0])),
        )
        data = grid.cells.ravel()
        self._put("/map", "nav_msgs/OccupancyGrid", t, latched=True, header=self._header(t, MAP), info=info, data=data)

    # --- what is written at every step --------------------------------------------------------------------------------
    def _write_transforms(self, step: int, t: int) -> None:
        moved = []
        for robot in self._robots:
            if robot.known[step]:
                odom = robot.frame.removesuffix("base_footprint") + "odom"
                moved.append(self._transform(t, odom, robot.frame, robot.poses[step]))
                if robot.number in self._described:
                    links = self._described[robot.number].links
                    poses = links.poses[step]
                    known = np.isfinite(poses).all(axis=1)
                    moved += [
                        self._transform(t, *edge, pose)
                        for edge, pose, here in zip(links.moving, poses, known, strict=True)
                        if here
                    ]
        moved += [
            self._transform(t, MAP, person.frame, person.poses[step]) for person in self._people if person.known[step]
        ]
        moved += [
            self._transform(t, MAP, name, poses[step])
            for name, poses in self._parts.items()
            if np.isfinite(poses[step]).all()
        ]
        for view, name in zip(self._cameras, self._camera_names, strict=True):
            pose = pose_multiply(
                FROM_WORLD, pose_from_matrix(view.poses[min(step, len(view.poses) - 1)].astype(np.float64))
            )
            if np.isfinite(pose).all():
                moved.append(self._transform(t, MAP, f"{name}_optical_frame", np.asarray(pose, np.float64)))
        if moved:
            self._put("/tf", "tf2_msgs/TFMessage", t, transforms=moved)

    def _write_robot(self, robot: _Mover, step: int, t: int) -> None:
        columns, prefix = self._recording.columns, f"agent_{robot.number}."
        agent = self._recording.agents[robot.number]
        odom = robot.frame.removesuffix("base_footprint") + "odom"
        qx, qy, qz, qw = robot.poses[step, 3:].tolist()
        yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        vx, vy = robot.velocity[step].tolist()
        ahead, aside = vx * np.cos(yaw) + vy * np.sin(yaw), -vx * np.sin(yaw) + vy * np.cos(yaw)
        self._put(
            self._topic(robot, "odom"),
            "nav_msgs/Odometry",
            t,
            header=self._header(t, odom),
            child_frame_id=robot.frame,
            pose=self._make(
                "geometry_msgs/PoseWithCovariance", pose=self._pose(robot.poses[step]), covariance=_NO_COVARIANCE
            ),
            twist=self._make(
                "geometry_msgs/TwistWithCovariance",
                twist=self._twist(ahead, aside, float(robot.turning[step])),
                covariance=_NO_COVARIANCE,
            ),
        )
        joints = columns.get(prefix + "joint_pos")
        if joints is not None and joints.shape[1:] == (len(agent.joint_names),):
            self._put(
                self._topic(robot, "joint_states"),
                "sensor_msgs/JointState",
                t,
                header=self._header(t, ""),
                name=list(agent.joint_names),
                position=joints[step].astype(np.float64),
                velocity=_NOTHING,
                effort=_NOTHING,
            )
        if command := self._command(robot, step):
            self._put(
                self._topic(robot, "cmd_vel"),
                "geometry_msgs/Twist",
                t,
                **vars(self._twist(command[0], 0.0, command[1])),
            )
        if robot.number in self._scans:
            scan = self._scans[robot.number]
            ranges, increment = scan.ranges[step], 2 * np.pi / scan.ranges.shape[1]
            self._put(
                self._topic(robot, "scan"),
                "sensor_msgs/LaserScan",
                t,
                best_effort=True,
                header=self._header(t, robot.frame.removesuffix("base_footprint") + "base_scan"),
                angle_min=scan.first_rad,
                angle_max=scan.first_rad + (len(ranges) - 1) * increment,
                angle_increment=increment,
                time_increment=0.0,
                scan_time=self._recording.episode.dt_ns * 1e-9,
                range_min=RANGE_M[0],
                range_max=scan.most_m,
                ranges=np.asarray(ranges, np.float32),
                intensities=np.zeros(0, np.float32),
            )

        if robot.number in self._clouds:
            self._write_cloud(robot, self._clouds[robot.number], step, t)

    def _write_cloud(self, robot: _Mover, scan: Scan, step: int, t: int) -> None:
        """Write the points of a scan in the order of its lasers [L, R]; NaN where a ray met nothing."""
        # to x forward, y left, z up, as `pose_to_ros`
        points = scan.around([step])[0][:, [0, 2, 1]] * (1, -1, 1)
        lasers, rays = scan.ranges.shape[1:]
        fields = [
            self._make("sensor_msgs/PointField", name=name, offset=4 * k, datatype=7, count=1)  # 7: float32
            for k, name in enumerate("xyz")
        ]
        self._put(
            self._topic(robot, "points"),
            "sensor_msgs/PointCloud2",
            t,
            best_effort=True,
            header=self._header(t, robot.frame.removesuffix("base_footprint") + CLOUD_FRAME),
            height=lasers,
            width=rays,
            fields=fields,
            is_bigendian=False,
            point_step=12,
            row_step=12 * rays,
            data=np.ascontiguousarray(points, "<f4").view(np.uint8).ravel(),
            is_dense=False,
        )

    def _write_people(self, step: int, t: int) -> None:
        if not self._people:
            return
        here = [person for person in self._people if person.known[step]]
        people = []
        for person in here:
            x, y, z = person.poses[step, :3].tolist()
            vx, vy = person.velocity[step].tolist()
            people.append(
                self._make(
                    "people_msgs/Person",
                    name=person.name,
                    position=self._make("geometry_msgs/Point", x=x, y=y, z=z),
                    velocity=self._make("geometry_msgs/Point", x=vx, y=vy, z=0.0),
                    reliability=1.0,
                    tagnames=[],
                    tags=[],
                )
            )
        self._put("/people", "people_msgs/People", t, header=self._header(t, MAP), people=people)
        ids = [person.name for person in here]
        self._put("/humans/persons/tracked", "hri_msgs/IdsList", t, header=self._header(t, ""), ids=ids)
        ids = [person.name for person in here if f"{JOINT_NAMES[0]}_{person.name}" in self._parts]
        self._put("/humans/bodies/tracked", "hri_msgs/IdsList", t, header=self._header(t, ""), ids=ids)

    def _write_pictures(self, step: int, t: int, images: Sequence[NDArray[np.uint8]]) -> None:
        import cv2

        for view, name, image in zip(self._cameras, self._camera_names, images, strict=True):
            lens, header = view.camera, self._header(t, f"{name}_optical_frame")
            _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            topic = f"/{name}/image_raw/compressed"
            self._put(
                topic,
                "sensor_msgs/CompressedImage",
                t,
                best_effort=True,
                header=header,
                format="jpeg",
                data=data.ravel(),
            )
            if lens.projection != "perspective":
                continue
            k = np.array([lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1.0])
            whole = self._make(
                "sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            )
            self._put(
                f"/{name}/camera_info",
                "sensor_msgs/CameraInfo",
                t,
                best_effort=True,
                header=header,
                height=lens.height,
                width=lens.width,
                distortion_model="plumb_bob",
                d=np.zeros(5),
                k=k,
                r=np.eye(3).ravel(),
                p=np.insert(k.reshape(3, 3), 3, 0, axis=1).ravel(),
                binning_x=0,
                binning_y=0,
                roi=whole,
            )

    # --- where its numbers come from ----------------------------------------------------------------------------------
    def _mover(self, number: int, name: str, prefix: str | None) -> _Mover:
        column = self._recording.agent_column(number, "base_pose")
        poses = pose_to_ros(column)
        known = np.isfinite(poses).all(axis=1)
        seconds = np.diff(self._recording.columns["time_ns"]) * 1e-9
        velocity, turning = np.zeros((len(poses), 2)), np.zeros(len(poses))
        with np.errstate(invalid="ignore"):
            velocity[1:] = np.diff(poses[:, :2], axis=0) / seconds[:, None]
            turning[1:] = wrap_angle(np.diff(heading_from_quat(column[:, 3:].astype(np.float64)).reshape(-1))) / seconds
        frame = f"{PERSON}{name}" if prefix is None else f"{prefix}base_footprint"
        return _Mover(
            number=number,
            name=name,
            frame=frame,
            poses=poses,
            velocity=np.nan_to_num(velocity, nan=0.0),
            turning=np.nan_to_num(turning, nan=0.0),
            known=np.asarray(known),
        )

    def _joints(self) -> dict[str, NDArray[np.float64]]:
        """Return poses in ``map`` [T, 7] of the joints of people with a built-in body, by frame, as in replays."""
        found = dict[str, NDArray[np.float64]]()
        people = [person for person in self._people if self._recording.agents[person.number].model]
        try:
            replay = PosedRecording(self._recording, detail=False) if people else None
        except H3DataError as fault:
            self.notes.append(f"No frames of the joints of people: {fault}")
            return found
        for person in people:
            assert replay is not None
            for start in range(0, len(self._times), BLOCK):
                rows = np.arange(start, min(start + BLOCK, len(self._times)))
                frames = replay.joint_matrices(person.number, rows)[:, :TRACKED_JOINTS].astype(np.float64)
                for k, name in enumerate(JOINT_NAMES[:TRACKED_JOINTS]):
                    poses = found.setdefault(f"{name}_{person.name}", np.full((len(self._times), 7), np.nan))
                    there = np.isfinite(frames[:, k]).all((1, 2))
                    poses[rows[there]] = pose_to_ros(pose_from_matrix(frames[there, k]))
        return found

    def _things(self) -> dict[str, NDArray[np.float64]]:
        """Return the poses in ``map`` [T, 7] of the things that move in the recording, by frame."""
        poses = self._recording.columns.get("object_pose", np.zeros((len(self._times), 0, 7)))
        bodies = [
            body for body in self._recording.moving_bodies if (poses[:, body.moving] != poses[:1, body.moving]).any()
        ]
        names = safe_names([body.name for body in bodies], "object")
        return {f"{THING}{name}": pose_to_ros(poses[:, body.moving]) for name, body in zip(names, bodies, strict=True)}

    def _describe(self, robot: _Mover) -> _Described | None:
        """Return the URDF and the frames of the links of a robot; None, with a note, if there is no such robot here."""
        agent = self._recording.agents[robot.number]
        name = agent.model.removeprefix("robot/")
        joints = self._recording.columns.get(f"agent_{robot.number}.joint_pos")
        try:
            model = load_robot(name) if name else None
            urdf = "" if model is None else model.file.read_text(encoding="utf-8")
        except (H3DataError, OSError, UnicodeDecodeError) as fault:
            self.notes.append(f"No robot_description of {robot.name}: {fault}")
            return None
        if model is None:
            return None
        if "<robot" not in urdf:
            self.notes.append(f"No robot_description of {robot.name}: its file is no URDF: {model.file}")
            return None
        if joints is None or tuple(agent.joint_names) != model.joint_names:
            self.notes.append(
                f"Joints of {robot.name} are at rest in /tf: the recording does not hold those of {name}."
            )
            joints = np.tile(model.rest, (len(self._times), 1))
        prefix = robot.frame.removesuffix("base_footprint")
        return _Described(urdf, robot_links(model, joints, prefix))

    def _command(self, robot: _Mover, step: int) -> tuple[float, float] | None:
        """Return the commanded speed [m/s] and turn [rad/s] that led to a row; None if they were not recorded."""
        agent, action = self._recording.agents[robot.number], f"agent_{robot.number}.action"
        spec = self._recording.episode.info.get("spec")
        body = spec.get("robot") if isinstance(spec, Mapping) else None
        if (
            agent.action_names != ("forward", "turn_left")
            or action not in self._recording.columns
            or not isinstance(body, Mapping)
        ):
            return None
        limits = (body.get("max_speed_mps"), body.get("max_turn_rad_s"))
        if not all(isinstance(limit, int | float) for limit in limits):
            return None
        forward, turn = self._recording.columns[action][step].tolist()
        return float(forward * limits[0]), float(turn * limits[1])  # type: ignore[operator]

    def _find_scans(self, rays: int) -> dict[int, _RobotScan]:
        recorded = {}
        for scan in scans_of(self._recording):  # the finest of a robot
            best = recorded.get(scan.agent)
            if best is None or scan.ranges.shape[1] >= best.ranges.shape[1]:
                recorded[scan.agent] = scan
        scans: dict[int, _RobotScan] = {}
        for robot in self._robots:
            if robot.number in recorded:
                scan = recorded[robot.number]
                behind = scan.ranges.shape[1] // 2  # rays that point to the right and back come first
                first = -behind * 2 * np.pi / scan.ranges.shape[1]
                scans[robot.number] = _RobotScan(np.roll(scan.met(), behind, axis=1), first, scan.max_m)
            elif rays and self._free is None:
                self.notes.append("No scan: the recording does not hold its scene.")
            elif rays:
                assert self._free is not None
                base = self._recording.agent_column(robot.number, "base_pose").astype(np.float64)
                others = [self._recording.agent_column(p.number, "base_pose")[:, [0, 2]] for p in self._people]
                around = np.stack(others, axis=1).astype(np.float64) if others else np.zeros((len(base), 0, 2))
                cast = cast_scans(
                    self._free,
                    base[:, [0, 2]],
                    np.asarray(heading_from_quat(base[:, 3:]), np.float64).reshape(-1),
                    around,
                    rays=rays,
                    radius_m=PERSON_RADIUS_M,
                )
                scans[robot.number] = _RobotScan(cast, -np.pi, RANGE_M[1])
        return scans

    def _floor(self, scene: Scene) -> FreeSpace | None:
        try:
            return FreeSpace.from_scene(scene)
        except H3DataError as fault:
            self.notes.append(f"No map: {fault}")
            return None

    # --- messages -----------------------------------------------------------------------------------------------------
    def _make(self, kind: str, **fields: Any) -> Any:
        return self._type[kind](**fields)

    def _stamp(self, t: int) -> Any:
        return self._make("builtin_interfaces/Time", sec=t // 1_000_000_000, nanosec=t % 1_000_000_000)

    def _header(self, t: int, frame: str) -> Any:
        return self._make("std_msgs/Header", stamp=self._stamp(t), frame_id=frame)

    def _pose(self, pose: NDArray[np.float64]) -> Any:
        x, y, z, qx, qy, qz, qw = pose.tolist()
        return self._make(
            "geometry_msgs/Pose",
            position=self._make("geometry_msgs/Point", x=x, y=y, z=z),
            orientation=self._make("geometry_msgs/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )

    def _twist(self, ahead: float, aside: float, turn: float) -> Any:
        return self._make(
            "geometry_msgs/Twist",
            linear=self._make("geometry_msgs/Vector3", x=ahead, y=aside, z=0.0),
            angular=self._make("geometry_msgs/Vector3", x=0.0, y=0.0, z=turn),
        )

    def _transform(self, t: int, parent: str, child: str, pose: NDArray[np.float64]) -> Any:
        x, y, z, qx, qy, qz, qw = pose.tolist()
        return self._make(
            "geometry_msgs/TransformStamped",
            header=self._header(t, parent),
            child_frame_id=child,
            transform=self._make(
                "geometry_msgs/Transform",
                translation=self._make("geometry_msgs/Vector3", x=x, y=y, z=z),
                rotation=self._make("geometry_msgs/Quaternion", x=qx, y=qy, z=qz, w=qw),
            ),
        )

    def _topic(self, robot: _Mover, name: str) -> str:
        return f"/{name}" if len(self._robots) == 1 else f"/{robot.name}/{name}"

    def _put(
        self, topic: str, kind: str, t: int, *, latched: bool = False, best_effort: bool = False, **fields: Any
    ) -> None:
        name = kind.replace("/", "/msg/")
        if topic not in self._connections:
            self._connections[topic] = self._bag.add_connection(
                topic,
                name,
                typestore=self._store,
                offered_qos_profiles=[delivery(latched=latched, best_effort=best_effort)],
            )
            self.counts[topic] = 0
        self._bag.write(self._connections[topic], t, self._store.serialize_cdr(self._make(kind, **fields), name))
        self.counts[topic] += 1


_IDENTITY = np.array([0, 0, 0, 0, 0, 0, 1.0])
_NO_COVARIANCE = np.zeros(36)
_NOTHING = np.zeros(0)
