"""Recordings as a Rerun file (``.rrd``): 3-D home with moving bodies, cameras, plots, action lanes and event log.

Entities: ``world/scene/<name>`` (static meshes, below their layer if they have one), ``world/objects/<name>`` (moving
ones), ``world/<agent>/...`` (parts of an agent, relative to its root frame: only joints that move cost bytes),
``world/trajectories``, ``world/goals``, ``world/free_space``, ``world/scans``, ``world/cameras/<name>``, ``metrics/*``,
``actions/*``, ``latency/*``, ``log/*``, ``input/*``. Two recordings in one file lie below ``/a`` and ``/b``. Timelines:
``step`` and ``sim_time``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError, MissingExtraError
from h3data.files import part_file
from h3data.geometry import transform_points
from h3data.recording.records import Recording
from h3data.replay import CameraTrack, Replay, camera_track
from h3data_viewers.rerun.cameras import CameraFeed, ImageStorage, camera_entity, log_camera
from h3data_viewers.rerun.entities import Drawable, PosedScene, entity_part, log_agents, log_rigid, log_skins
from h3data_viewers.rerun.floor_marks import log_free_space, log_goals, log_scans
from h3data_viewers.rerun.layout import LoggedRecording, layout
from h3data_viewers.rerun.sink import DeferredStream, Sink
from h3data_viewers.rerun.timeseries import log_events, log_inputs, log_lanes, log_latency, log_scalars

if TYPE_CHECKING:
    import rerun as rr

LABELS = ("a", "b")
"""Names of the root entities of two recordings in one file."""
SKIN_EVERY = 3
"""Number of steps between samples of skinned bodies."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewedRecording:
    """A recording together with its meshes, cameras and title."""

    recording: Recording
    replay: PosedScene | None = None
    """Meshes and poses of the recording; None shows agents as simple solids."""
    cameras: Sequence[CameraFeed] = ()
    videos: Mapping[str, Path] = field(default_factory=dict)
    """MP4 files of further cameras of the replay, by camera name (see `h3data.replay.camera_names`)."""
    name: str = ""
    """Title of the recording in a comparison; empty selects task and episode id."""


def write_rrd(
    recording: Recording,
    path: str | Path,
    *,
    replay: PosedScene | None = None,
    cameras: Sequence[CameraFeed | tuple[CameraTrack, Path]] = (),
    videos: Mapping[str, Path] | None = None,
    videos_ready: Callable[[Path], object] | None = None,
    images: ImageStorage = "stills",
    skin_every: int = SKIN_EVERY,
    overwrite: bool = False,
) -> Path:
    """Write a recording as a Rerun file with a ready-made layout and return its path.

    Args:
        recording: recording to show.
        path: path of the ``.rrd`` file; missing folders are created.
        replay: meshes and poses, as in `ViewedRecording`.
        cameras: cameras to show, as feeds or as tracks with their MP4 files.
        videos: MP4 files of cameras of the replay, as in `ViewedRecording`.
        videos_ready: Function that is called with the path of each video before it is read, and may wait until it is complete.
        images: storage of camera videos, see `h3data_viewers.rerun.cameras.log_camera`.
        skin_every: steps between samples of skinned bodies, which move rigidly with their agent in between. A larger
            interval is chosen where the file would otherwise become too large.
        overwrite: whether to replace an existing file.

    Raises:
        InputError: ``path`` exists and ``overwrite`` is false, or a camera's video cannot be read.
        MissingExtraError: rerun-sdk is not installed.
    """
    feeds = [
        each if isinstance(each, CameraFeed) else CameraFeed(camera=each[0].camera, poses=each[0].poses, video=each[1])
        for each in cameras
    ]
    shown = ViewedRecording(recording=recording, replay=replay, cameras=feeds, videos=videos or {})
    path, ready = Path(path), videos_ready
    return _write_file([shown], path, images=images, skin_every=skin_every, overwrite=overwrite, ready=ready)


def write_comparison_rrd(
    first: ViewedRecording,
    second: ViewedRecording,
    path: str | Path,
    *,
    images: ImageStorage = "stills",
    skin_every: int = SKIN_EVERY,
    overwrite: bool = False,
) -> Path:
    """Write a Rerun file that shows two recordings side by side on one timeline, and return its path.

    The first recording lies below ``/a``, the second below ``/b``. Each has its own 3-D view, and they share plots,
    lanes and log. They may differ in scene, agents, task and length: the shorter one stays in its last state, and its
    lanes and log state that it has ended. The timeline is ``step`` if the steps of both are at the same times, else
    ``sim_time``.

    Raises:
        InputError: as for `write_rrd`, or one of them has no steps.
        MissingExtraError: rerun-sdk is not installed.
    """
    for label, shown in zip(LABELS, (first, second), strict=True):
        if not len(shown.recording):
            raise InputError(
                f"Expected two recordings with steps to compare, but {label}, {_title(shown)!r}, has none. "
                "Hint: view the other one alone.",
                code="H3-VIEW-021",
            )
    return _write_file([first, second], Path(path), images=images, skin_every=skin_every, overwrite=overwrite)


def _write_file(
    sides: Sequence[ViewedRecording],
    path: Path,
    *,
    images: ImageStorage,
    skin_every: int,
    overwrite: bool,
    ready: Callable[[Path], object] | None = None,
) -> Path:
    if path.exists() and not overwrite:
        raise InputError(
            f"The file already exists; choose another name or pass overwrite=True: {path}", code="H3-VIEW-001"
        )
    stream = _stream(sides)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Rerun's own file sink reports a full disk in its log only, and the file would be cut
    encoded = stream.binary_stream()
    try:
        _log(stream, sides, images=images, skin_every=skin_every, ready=ready)
    finally:
        content = encoded.read()  # unread data would be reported as dropped
        stream.disconnect()
    if not content:
        raise H3DataError(
            "Rerun wrote nothing. Hint: check that the environment variable RERUN does not disable it.",
            code="H3-VIEW-018",
        )
    with part_file(path) as part:
        part.write_bytes(content)
    return path


def recorded_stream(sides: Sequence[ViewedRecording]) -> rr.RecordingStream:
    """Return one or two recordings as a Rerun stream in memory, with its layout.

    Raises:
        InputError: a camera's video cannot be read.
        MissingExtraError: rerun-sdk is not installed.
    """
    stream = _stream(sides)
    _log(stream, sides, images="stills", skin_every=SKIN_EVERY)
    return stream


def _stream(sides: Sequence[ViewedRecording]) -> rr.RecordingStream:
    try:
        import rerun as rr
    except ImportError as error:
        raise MissingExtraError(
            'Rerun is not installed. Hint: pip install "rerun-sdk>=0.41,<0.42"', code="H3-VIEW-022"
        ) from error
    identity = " ".join(side.recording.episode.uid for side in sides)
    return rr.RecordingStream("h3data", recording_id=identity, send_properties=False)


def _log(
    stream: rr.RecordingStream,
    sides: Sequence[ViewedRecording],
    *,
    images: ImageStorage,
    skin_every: int,
    ready: Callable[[Path], object] | None = None,
) -> None:
    feeds = [[*side.cameras, *_named_cameras(side)] for side in sides]
    # a missing video is found before all else is written; videos that are still being written are checked later
    if ready is None:
        _check_videos(feeds)
    labels = LABELS if len(sides) > 1 else ("",)
    # the bounds of following are drawn once, as long as the longer recording
    longest = max(sides, key=lambda side: len(side.recording))
    _log_properties(stream, sides)
    held, logged = DeferredStream(), []
    for side, label, group in zip(sides, labels, feeds, strict=True):
        sink = Sink(held, side.recording.columns["time_ns"], label)
        logged.append(_log_curves(side, sink, group, bounds=side is longest))
    # The layout comes first: viewers play, in a layout of their own, whatever they have before it.
    stream.send_blueprint(layout(logged, timeline=_timeline(sides)))
    held.release(stream)
    for side, label, group in zip(sides, labels, feeds, strict=True):
        sink = Sink(stream, side.recording.columns["time_ns"], label)
        _log_world(side, sink, group, images, skin_every, ready=ready)


def _log_curves(shown: ViewedRecording, sink: Sink, cameras: Sequence[CameraFeed], *, bounds: bool) -> LoggedRecording:
    """Log plots, lanes and texts; return what the layout shows of this recording, with the home and the cameras."""
    recording, replay, compared = shown.recording, shown.replay, bool(sink.label)
    drawables = list(replay.drawables) if replay is not None else []
    ceilings = {f"world/scene/{entity_part(d.layer)}" for d in drawables if d.layer == "ceiling" and not d.moving}
    return LoggedRecording(
        label=sink.label,
        name=f"{sink.label}: {_title(shown)}" if compared else "Home",
        world=sink.path("world"),
        focus=_focus(recording, drawables),
        hidden=sorted(sink.path(entity) for entity in ceilings),
        cameras=[sink.path(camera_entity(feed.camera)) for feed in cameras if feed.has_images],
        plotted=log_scalars(sink, recording, shade=LABELS.index(sink.label) if compared else None, bounds=bounds),
        lanes=log_lanes(sink, recording, ends=compared),
        latency=log_latency(sink, recording),
        log=sink.path("log") if log_events(sink, recording, ends=compared) else "",
        inputs=sink.path("input") if log_inputs(sink, recording) else "",
    )


def _log_world(
    shown: ViewedRecording,
    sink: Sink,
    cameras: Sequence[CameraFeed],
    images: ImageStorage,
    skin_every: int,
    *,
    ready: Callable[[Path], object] | None,
) -> None:
    import rerun as rr

    recording, replay = shown.recording, shown.replay
    # two recordings in a file share its byte budgets
    share = 0.5 if sink.label else 1.0
    sink.static("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP)
    log_agents(sink, recording, {d.agent for d in replay.drawables} if replay is not None else set())
    if replay is not None:
        log_rigid(sink, recording, replay, share=share)
        log_skins(sink, recording, replay, skin_every, share=share)
    log_free_space(sink, recording, replay.scene if isinstance(replay, Replay) else None)
    log_goals(sink, recording)
    log_scans(sink, recording)
    for feed in cameras:
        if ready is not None and feed.video is not None:
            ready(feed.video)
            _check_videos([[feed]])
        log_camera(sink, feed, images=images)


def _check_videos(feeds: Sequence[Sequence[CameraFeed]]) -> None:
    videos = [(feed.camera.name, feed.video) for group in feeds for feed in group if feed.video is not None]
    missing = [f"{name}: {video}" for name, video in videos if not video.is_file()]
    if missing:
        raise InputError(f"These camera videos do not exist: {'; '.join(missing)}.", code="H3-VIEW-019")


def _title(shown: ViewedRecording) -> str:
    return shown.name or f"{shown.recording.episode.task} {shown.recording.episode.episode_id}"


def _timeline(sides: Sequence[ViewedRecording]) -> str:
    """Return the timeline on which all recordings run at the same pace."""
    times = [side.recording.columns["time_ns"] for side in sides]
    common = min(len(t) for t in times)
    return "step" if all(np.array_equal(t[:common], times[0][:common]) for t in times) else "sim_time"


def _named_cameras(shown: ViewedRecording) -> list[CameraFeed]:
    """Return feeds of the replay's own cameras that have videos."""
    if not shown.videos:
        return []
    if not isinstance(shown.replay, Replay):
        raise InputError(
            "Videos by camera name need an h3data.replay.Replay. Hint: pass cameras=[CameraFeed(...)].",
            code="H3-VIEW-020",
        )
    # the video has no pose: it is that of the camera with its name
    tracks = {name: camera_track(shown.replay, name) for name in shown.videos}
    return [CameraFeed(camera=t.camera, poses=t.poses, video=Path(shown.videos[name])) for name, t in tracks.items()]


def _log_properties(stream: rr.RecordingStream, sides: Sequence[ViewedRecording]) -> None:
    import rerun as rr

    episodes = [side.recording.episode for side in sides]
    stream.send_recording_name(" | ".join(f"{e.task} {e.episode_id}" for e in episodes))
    for side, e, label in zip(sides, episodes, LABELS, strict=False):
        values = rr.AnyValues(
            uid=e.uid,
            episode_id=e.episode_id,
            task=e.task,
            scene=e.scene,
            seed=e.seed,
            created_by=e.created_by,
            steps=len(side.recording),
        )
        stream.send_property(f"episode_{label}" if len(sides) > 1 else "episode", values)


# --- initial view -----------------------------------------------------------------------------------------------------
def _focus(recording: Recording, drawables: Sequence[Drawable]) -> NDArray[np.floating]:
    """Return the box [2, 3] that the initial view shows [m]: the part of the home within 5 m of the agents' tracks."""
    corners = []
    for d in drawables:
        # ceilings are hidden in the initial view
        if d.layer != "ceiling" and not d.moving and not d.deformable and len(d.mesh.vertices):
            lo, hi = d.mesh.bounds
            box = np.array([[x, y, z] for x in (lo[0], hi[0]) for y in (lo[1], hi[1]) for z in (lo[2], hi[2])])
            corners.append(transform_points(d.matrix, box))
    home = None
    if corners:
        points = np.concatenate(corners)
        home = np.stack([points.min(0), points.max(0)])
    tracks = [recording.agent_column(i, "base_pose")[:, :3] for i in range(len(recording.agents))]
    points = np.concatenate([t[np.isfinite(t).all(1)] for t in tracks]) if tracks else np.zeros((0, 3))
    if not len(points):
        return np.array([[-3.0, 0, -3], [3, 2, 3]]) if home is None else home
    # in a large building, the part where nobody goes would make the agents specks
    near = np.stack([points.min(0) - np.array([5, 0.5, 5]), points.max(0) + np.array([5, 2.5, 5])]).astype(np.float64)
    return near if home is None else np.stack([np.maximum(home[0], near[0]), np.minimum(home[1], near[1])])
