"""Joint states and laser scans of a bag, resampled to the rows of the recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import quat_rotate
from h3data.recording.records import Recording
from h3data.recording.scans import scan_column
from h3data_ros.frames import message_time
from h3data_ros.transforms import TransformTree

LASER, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
JOINTS = "sensor_msgs/msg/JointState"
RAYS = 360
"""Number of rays of an imported scan, one per degree around the robot's frame."""
BAND_M = (0.1, 1.8)
"""Range of heights of a cloud's points that count as obstacles, in the robot's frame [m]."""
RANGE_MAX_M = 1000.0
"""Greatest accepted range of a scanner [m]."""
_FLOATS = {7: "f4", 8: "f8"}
"""Types of coordinates in clouds, by `PointField.datatype`."""


@dataclass
class JointLog:
    """Log of joint positions by name, as messages of the type `JOINTS` state them."""

    times: dict[str, list[int]] = field(default_factory=dict)
    positions: dict[str, list[float]] = field(default_factory=dict)

    def add(self, message: Any, t: int) -> None:
        """Add the positions of one message, except names without a finite position."""
        stamp = message_time(message.header, t)
        for name, position in zip(message.name, np.asarray(message.position).tolist(), strict=False):
            if np.isfinite(position):
                self.times.setdefault(name, []).append(stamp)
                self.positions.setdefault(name, []).append(position)

    def at(self, name: str, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the positions [T] of a joint at times [T] [ns], interpolated between and held outside its stamps."""
        times, first = np.unique(np.array(self.times[name], np.int64), return_index=True)
        positions = np.array(self.positions[name])[first]
        return np.interp(rows - rows[0], times - rows[0], positions).astype(np.float32)


def with_joints(recording: Recording, joints: JointLog, rows: NDArray[np.int64]) -> Recording:
    """Return the recording with its robot's joint positions from a bag, at the times ``rows`` [T] [ns]."""
    robot, column = recording.agents[0], "agent_0.joint_pos"
    named = [k for k, name in enumerate(robot.joint_names) if name in joints.times]
    if not named:
        return recording
    values = recording.columns[column].copy()
    for k in named:
        values[:, k] = joints.at(robot.joint_names[k], rows)
    info = recording.episode.info
    missing = [name for name in robot.joint_names if name not in joints.times]
    made_up = {
        **info["synthesised"],
        robot.name: [what for what in info["synthesised"][robot.name] if what != "posture"],
    }
    if missing:
        made_up[robot.name].append(f"joints {', '.join(missing[:6])}{', ...' if len(missing) > 6 else ''}")
    info = {**info, "synthesised": {name: what for name, what in made_up.items() if what}}
    episode = replace(recording.episode, info=info)
    return replace(recording, episode=episode, columns={**recording.columns, column: values})


def with_scans(
    recording: Recording,
    messages: Iterable[tuple[str, int, Any]],
    tree: TransformTree,
    frame: str,
    rows: NDArray[np.int64],
    gap_ns: int,
) -> tuple[Recording, int]:
    """Return the recording with its robot's scans as sensor ``lidar``, and the number of used messages.

    Each row has the message with the nearest stamp, no farther away than ``gap_ns``. Its points, in the robot's
    ``frame``, become `RAYS` distances from that frame, to the nearest point in each degree. Points of clouds are used
    if they are within `BAND_M`. Directions without a measurement are NaN. A ray of a `LASER` without a reflection has
    the scanner's range.

    Args:
        recording: Recording whose first agent is the robot.
        messages: Scans, each as topic, time of recording [ns] and message.
        tree: Frames of the bag.
        frame: Frame of the robot.
        rows: Times of the rows [T] [ns].
        gap_ns: Longest time between a row and its scan [ns].
    """
    ranges = np.full((len(rows), RAYS), np.nan, np.float32)
    nearest = np.full(len(rows), gap_ns + 1, np.int64)
    most = 0.0
    for _, t, message in messages:
        stamp, child = message_time(message.header, t), message.header.frame_id.lstrip("/")
        after = int(np.clip(np.searchsorted(rows, stamp), 1, max(len(rows) - 1, 1)))
        row = min((k for k in (after - 1, after) if k < len(rows)), key=lambda k: abs(int(rows[k]) - stamp))
        apart = abs(int(rows[row]) - stamp)
        if apart >= nearest[row] or (child != frame and (child not in tree or not tree.connected(child, frame))):
            continue
        points, far = _points_of(message)
        place = np.array([0, 0, 0, 0, 0, 0, 1.0])
        if child != frame:
            place = tree.poses(child, frame, np.array([stamp], np.int64), gap_ns)[0]
        scan = _around(points, far, place, flat=hasattr(message, "ranges"))
        if scan is not None:
            ranges[row], nearest[row], most = scan, apart, max(most, float(np.nanmax(scan, initial=0.0)), far.most)
    used = int((nearest <= gap_ns).sum())
    if not used:
        return recording, 0
    name = scan_column(0, "lidar")
    facts = {"sensor": "lidar", "agent": 0, "unit": "m", "frame": "base", "low": 0.0, "high": most}
    episode = replace(recording.episode, info={**recording.episode.info, "sensors": {name: facts}})
    return replace(recording, episode=episode, columns={**recording.columns, name: ranges}), used


@dataclass(frozen=True)
class _Empty:
    """Directions in which a scanner measured and met nothing."""

    rays: NDArray[np.float64]
    """Directions of the rays as unit vectors [N, 3]."""
    most: float
    """Range of the scanner [m]."""


def _points_of(message: Any) -> tuple[NDArray[np.float64], _Empty]:
    """Return points [N, 3] of a scan or a cloud in its own frame [m], and the rays that met nothing."""
    if hasattr(message, "ranges"):
        known = np.isfinite([message.angle_min, message.angle_increment]).all()
        ranges = np.asarray(message.ranges if known else (), np.float64)
        angles = message.angle_min + np.arange(len(ranges)) * message.angle_increment
        rays = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=-1)
        most = float(message.range_max) if 0 < message.range_max < RANGE_MAX_M else 0.0
        # REP 117: +inf met nothing, anything below range_min is no measurement; older drivers send range_max or more for +inf
        met = np.isfinite(ranges) & (ranges >= max(float(message.range_min), 1e-6)) & (ranges < (most or RANGE_MAX_M))
        empty = np.isposinf(ranges) | (ranges >= most) if most else np.zeros(len(ranges), np.bool_)
        return rays[met] * ranges[met, None], _Empty(rays[empty], most)
    return _coordinates(message), _Empty(np.zeros((0, 3)), 0.0)


def _coordinates(cloud: Any) -> NDArray[np.float64]:
    """Return points [N, 3] of a cloud; none of one whose layout is not known or does not fit its data."""
    fields: Mapping[str, Any] = {one.name: one for one in cloud.fields}
    step, width, height, row = (int(n) for n in (cloud.point_step, cloud.width, cloud.height, cloud.row_step))
    data = np.asarray(cloud.data, np.uint8)
    order = ">" if cloud.is_bigendian else "<"
    told = [fields[axis] for axis in "xyz" if axis in fields and fields[axis].datatype in _FLOATS]
    places = [(int(one.offset), np.dtype(order + _FLOATS[one.datatype])) for one in told]
    fits = len(places) == 3 and all(start + kind.itemsize <= step for start, kind in places)
    if not fits or min(width, height) < 1 or row < step * width or len(data) < row * height:
        return np.zeros((0, 3))
    points = data[: row * height].reshape(height, row)[:, : step * width].reshape(-1, step)
    numbers = [np.ascontiguousarray(points[:, at : at + kind.itemsize]).view(kind)[:, 0] for at, kind in places]
    return np.stack(numbers, axis=-1).astype(np.float64)


def _around(
    points: NDArray[np.float64], empty: _Empty, place: NDArray[np.float64], *, flat: bool
) -> NDArray[np.float32] | None:
    """Return distances [RAYS] around the robot's frame, in which the scanner has the pose ``place``; None without a pose."""
    if not np.isfinite(place).all():
        return None
    found = np.full(RAYS, np.nan, np.float32)
    # first, so that points that another ray met in the same degree take their place
    found[_degrees(np.asarray(quat_rotate(place[3:], empty.rays), np.float64))] = empty.most
    points = points[np.isfinite(points).all(axis=1) & (np.abs(points) < RANGE_MAX_M).all(axis=1)]
    points = np.asarray(quat_rotate(place[3:], points) + place[:3], np.float64)
    if not flat:
        points = points[(points[:, 2] > BAND_M[0]) & (points[:, 2] < BAND_M[1])]
    np.fmin.at(found, _degrees(points), np.hypot(points[:, 0], points[:, 1]).astype(np.float32))
    return found


def _degrees(vectors: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the ray [N] of each vector [N, 3]: whole degrees to the left of straight ahead."""
    return np.round(np.degrees(np.arctan2(vectors[:, 1], vectors[:, 0]))).astype(np.intp) % RAYS
