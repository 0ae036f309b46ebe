"""Export of recordings as MCAP files for Foxglove and Lichtblick (needs ``h3data[foxglove]``).

The exported file shows the home and all agents. The log of a recording also opens in these viewers, but shows only
numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, MissingExtraError
from h3data.files import part_file, size_text
from h3data.formats import Exported, ExportRequest
from h3data.geometry import Array, pose_from_matrix
from h3data.recording.log_lines import log_lines
from h3data.recording.mcap.header import episode_metadata, log_time, start_time
from h3data.recording.opening import FOXGLOVE_SUFFIX
from h3data.recording.records import Recording
from h3data.recording.scans import HEIGHT_M, clouds_of, scans_of
from h3data.recording.schema import Column
from h3data.render.camera import Camera
from h3data.replay import Replay, camera_track
from h3data_exporters.posed_parts import PosedPart
from h3data_exporters.posing import drawn_note, posed_parts

if TYPE_CHECKING:
    from mcap_protobuf.writer import Writer

BLOCK_STEPS = 512
"""Number of steps that are posed at once, so that memory does not grow with the recording."""
Posed = Callable[[NDArray[np.integer]], Sequence[PosedPart]]
"""Function that returns all parts, posed at some steps, such as ``lambda steps: posed_parts(replay, steps)``."""
Pictures = Iterable[tuple[int, Sequence[NDArray[np.uint8]]]]
"""Steps in order, each with the sRGB picture [H, W, 3] of every camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoxgloveCamera:
    """Camera with its poses, whose images and calibration are written to a file."""

    camera: Camera
    """Intrinsics and name of the camera."""
    poses: Array
    """Matrices from the camera (OpenCV axes) to the world, [T, 4, 4], or [1, 4, 4] for a static camera."""


@dataclass(frozen=True)
class FoxgloveFile:
    """Result of writing a Foxglove file."""

    path: Path
    topics: tuple[str, ...]
    messages: int
    frames: int


def write_foxglove(
    recording: Recording,
    posed: Posed,
    path: str | Path,
    *,
    cameras: Sequence[FoxgloveCamera] = (),
    pictures: Pictures = (),
) -> FoxgloveFile:
    """Write a ``.foxglove.mcap`` file whose messages are protobuf with their descriptors, at the times of the recorded log.

    - ``/tf``: FrameTransforms. The root ``map`` has +Z up; ``world`` in it is the recording's, +Y up; in that every
      moving body, the root of every agent, and in these the links of robots and the joints of people. A message holds
      what has moved by more than 1e-6, once a second everything.
    - ``/scene_update``: SceneUpdate with GLB models. Layers (``ceiling``) have topics below it, so that they can be
      switched off, and so has everything that is away at times. People are cut into rigid pieces, one for each joint.
    - ``/agents/<name>/pose``: PoseInFrame; ``/agents/<name>/joints``: JointStates of robots.
    - ``/agents/<name>/<sensor>``: LaserScan of a recorded laser scanner; rays that met nothing are infinite. PointCloud
      of one of several lasers.
    - ``/metrics``: the per-step scalars, a message of our own to plot. ``/log``: Log, events, skills and raw input.
    - ``/cam/<name>/calibration``: CameraCalibration of perspective cameras; ``/cam/<name>/video``: CompressedVideo
      (H.264).

    Raises:
        InputError: the name ends in something else, there is no step, or two cameras have one name.
        MissingExtraError: the extra ``foxglove`` is not installed.
    """
    path = Path(path)
    if not path.name.endswith(FOXGLOVE_SUFFIX):
        raise InputError(
            f"Expected a file name that ends in {FOXGLOVE_SUFFIX}, as no recording's does, got: {path}",
            code="H3-EXPORT-003",
        )
    names = [view.camera.name for view in cameras]
    if len(set(names)) < len(names):
        raise InputError(f"Each camera is shown once, got: {', '.join(names)}.", code="H3-EXPORT-004")
    if not len(recording):
        raise InputError("A recording without steps has nothing to show.", code="H3-EXPORT-005")
    try:
        import foxglove_schemas_protobuf  # noqa: F401
        from mcap_protobuf.writer import Writer
    except ImportError:
        raise MissingExtraError(
            'Files for Foxglove need its schemas. Hint: pip install "h3data[foxglove]"', code="H3-EXPORT-007"
        ) from None
    with part_file(path) as part, part.open("wb") as stream, Writer(stream) as mcap:
        mcap.add_metadata("h3.episode", episode_metadata(recording.episode))
        return _Export(recording, posed, mcap, cameras).write(path, pictures)


def export_foxglove(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Export one recording for ``h3data export --to foxglove``, with a video of each requested camera."""
    (recording,) = recordings
    replay = Replay(recording, assets=request.assets, people=request.people, detail=False, stand_ins=request.stand_ins)
    recording = replay.recording
    tracks = [camera_track(replay, name) for name in request.cameras]
    frames = replay.frames(
        tracks, range(len(recording) if tracks else 0), threads=request.threads, backend=request.backend
    )
    shown = request.progress(frames, len(recording), "frame") if tracks else frames
    file = write_foxglove(
        recording,
        lambda steps: posed_parts(replay, steps),
        request.out,
        cameras=[FoxgloveCamera(camera=track.camera, poses=track.poses) for track in tracks],
        pictures=((step, [image["rgb"] for image in images]) for step, images in shown),
    )
    size, missing = file.path.stat().st_size, sorted(replay.missing)
    text = (
        f"{file.path}: {file.messages} messages on {len(file.topics)} topics, {file.frames} frames, {size_text(size)}"
    )
    data = {
        "messages": file.messages,
        "topics": list(file.topics),
        "frames": file.frames,
        "bytes": size,
        "missing": missing,
    }
    return Exported(text=text + drawn_note(missing, stand_ins=request.stand_ins), data=data)


class _Export:
    """One file while it is written; messages come in the order of their times."""

    def __init__(self, recording: Recording, posed: Posed, mcap: Writer, cameras: Sequence[FoxgloveCamera]) -> None:
        from h3data_exporters.foxglove import messages as foxglove_messages
        from h3data_exporters.foxglove.frames import WORLD
        from h3data_exporters.foxglove.scene import FoxgloveScene
        from h3data_exporters.foxglove.video import PictureStream

        self._messages, self._world = foxglove_messages, WORLD
        self._recording, self._posed, self._mcap, self._cameras = recording, posed, mcap, cameras
        self._t0 = start_time(recording, None)
        self._times = [self._log_time(t) for t in recording.columns["time_ns"].tolist()]
        self._scene = FoxgloveScene(recording, posed(np.zeros(1, np.intp)))
        frames = self._scene.frames
        self._camera_frames = [frames.names[frames.add(f"cam_{view.camera.name}")] for view in cameras]
        self._streams = [PictureStream(view.camera.width, view.camera.height) for view in cameras]
        self._metrics = _Metrics(recording)
        self._scans = [(scan, scan.met()) for scan in scans_of(recording)]
        self._clouds = clouds_of(recording)
        self._lines = self._log_lines()
        self._topics: set[str] = set()
        self._count = 0

    def write(self, path: Path, pictures: Pictures) -> FoxgloveFile:
        seen = iter(pictures)
        picture = next(seen, None)
        for start in range(0, len(self._times), BLOCK_STEPS):
            steps = np.arange(start, min(start + BLOCK_STEPS, len(self._times)))
            local = self._scene.frames.local(self._world_poses(steps))
            for step, poses in zip(steps.tolist(), local, strict=True):
                # messages of a log come in the order of their times
                self._tell_until(self._times[step])
                self._write_step(step, poses)
                if picture is not None and picture[0] == step:
                    self._write_pictures(step, picture[1])
                    picture = next(seen, None)
        self._tell_until(None)
        if picture is not None:
            raise InputError(
                f"Pictures must come in the order of their steps; that of step {picture[0]} fits nowhere.",
                code="H3-EXPORT-006",
            )
        return FoxgloveFile(path, tuple(sorted(self._topics)), self._count, len(self._scene.frames.names))

    def _world_poses(self, steps: NDArray[np.intp]) -> Array:
        """Return pose7 of all frames at ``steps``, cameras last."""
        things = self._scene.world_poses(steps, self._posed(steps))
        seen_from = [
            np.broadcast_to(pose_from_matrix(v.poses[steps if len(v.poses) > 1 else [0]]), (len(steps), 7))[:, None]
            for v in self._cameras
        ]
        return np.concatenate([things, *seen_from], axis=1)

    def _write_step(self, step: int, poses: Array) -> None:
        make, t = self._messages, self._times[step]
        moved, whole = self._scene.frames.news(t, poses)
        if moved:
            self._put("/tf", make.transforms(t, moved), t)
        for group in self._scene.groups.values():
            if group.changes(step):
                self._put(group.topic, group.update(step, t), t)
        for i, agent in enumerate(self._recording.agents):
            pose, name = self._recording.agent_column(i, "base_pose")[step], self._scene.agent_frame(i)
            if np.isfinite(pose).all():
                self._put(f"/agents/{name}/pose", make.pose_in_frame(t, self._world, pose), t)
            joints = self._recording.columns.get(f"agent_{i}.joint_pos")
            if joints is not None and joints.shape[1:] == (len(agent.joint_names),):
                states = make.joint_states(t, agent.joint_names, joints[step].tolist())
                self._put(f"/agents/{name}/joints", states, t)
        for scan, met in self._scans:
            name = self._scene.agent_frame(scan.agent)
            self._put(f"/agents/{name}/{scan.sensor}", make.laser_scan(t, name, HEIGHT_M, met[step]), t)
        for scan in self._clouds:
            name = self._scene.agent_frame(scan.agent)
            cloud = make.point_cloud(t, name, scan.height_m, scan.around([step])[0])
            self._put(f"/agents/{name}/{scan.sensor}", cloud, t)
        if self._metrics.names:
            self._put("/metrics", self._metrics.at(step), t)
        for view, frame in zip(self._cameras, self._camera_frames, strict=True):
            # repeated with the full set of frames, for whoever jumps in time
            if whole and view.camera.projection == "perspective":
                self._put(f"/cam/{view.camera.name}/calibration", make.calibration(t, frame, view.camera), t)

    def _write_pictures(self, step: int, images: Sequence[NDArray[np.uint8]]) -> None:
        t = self._times[step]
        for view, frame, stream, image in zip(self._cameras, self._camera_frames, self._streams, images, strict=True):
            message = self._messages.video_frame(t, frame, stream.packet(image))
            self._put(f"/cam/{view.camera.name}/video", message, t)

    # --- the log ------------------------------------------------------------------------------------------------------
    def _log_lines(self) -> list[tuple[int, Any]]:
        """Return ``(time, message)`` of all lines, the last one first."""
        found = []
        for line in log_lines(self._recording):
            # files of others may have events at steps that are not there
            t = self._times[min(max(line.step, 0), len(self._times) - 1)]
            found.append((t, line.source, line.text, line.warning))
        for given in self._recording.inputs:
            text = f"{given.kind} {given.payload}".rstrip()
            found.append((self._log_time(given.time_ns), f"input/user_{given.user}", text, False))
        # stable: events and inputs of one time keep their order
        found.sort(key=lambda line: line[0])
        return [(t, self._messages.log(t, source, text, warning=bad)) for t, source, text, bad in reversed(found)]

    def _tell_until(self, time_ns: int | None) -> None:
        while self._lines and (time_ns is None or self._lines[-1][0] < time_ns):
            t, message = self._lines.pop()
            self._put("/log", message, t)

    def _log_time(self, time_ns: int) -> int:
        return log_time(self._t0, time_ns)

    def _put(self, topic: str, message: Any, time_ns: int) -> None:
        self._mcap.write_message(topic, message, log_time=time_ns, publish_time=time_ns)
        self._topics.add(topic)
        self._count += 1


class _Metrics:
    """The scalars of each step as one message."""

    def __init__(self, recording: Recording) -> None:
        from h3data.recording.mcap.wire import message_class, step_descriptor, wire_layouts

        columns = {n.removeprefix("metrics."): a for n, a in recording.columns.items() if n.startswith("metrics.")}
        self._columns = {n: a for n, a in columns.items() if a.ndim == 1}
        layout = [Column(n, str(a.dtype), ()) for n, a in self._columns.items()]
        fields = wire_layouts(tuple(layout))["state"]  # the first is the number of the step
        self.names = [field.name for field in fields[1:]]
        self._class = message_class(step_descriptor("Metrics", fields), "h3.Metrics")

    def at(self, step: int) -> Any:
        values = zip(self.names, (a[step].item() for a in self._columns.values()), strict=True)
        return self._class(step=step, **dict(values))
