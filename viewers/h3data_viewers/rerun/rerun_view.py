"""A recording as a Rerun file (``.rrd``): 3-D home with everything that moves, cameras, plots, action lanes, event log.

Entities: ``world/scene/<name>`` what stands still (below its layer, if it has one), ``world/objects/<name>`` what moves,
``world/<agent>/...`` agents: their parts hang in the agent's root frame, so that only joints that move cost bytes.
``world/trajectories``, ``world/goals``, ``world/free_space``, ``world/cameras/<name>``, ``metrics/*``,
``actions/*``, ``log/*``, ``input/*``; of two recordings in one file below ``/a`` and ``/b``. Timelines: ``step``, ``sim_time``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError, MissingExtraError
from h3data.files import part_file
from h3data.geometry import transform_points
from h3data.recording.records import Recording
from h3data.replay import Replay, camera_track
from h3data_viewers.rerun.rerun_bodies import Drawable, Posed, entity_part, log_agents, log_rigid, log_skins
from h3data_viewers.rerun.rerun_cameras import CameraFeed, Pictures, log_camera
from h3data_viewers.rerun.rerun_layout import Side, layout
from h3data_viewers.rerun.rerun_marks import log_free_space, log_goals
from h3data_viewers.rerun.rerun_sink import Sink
from h3data_viewers.rerun.rerun_tracks import log_events, log_inputs, log_lanes, log_scalars

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "h3data"
LABELS = ("a", "b")
"""Roots of two recordings in one file."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shown:
    """A recording with what is needed to show it."""

    recording: Recording
    replay: Posed | None = None
    """Meshes and poses; without it agents are drawn as plain solids."""
    cameras: Sequence[CameraFeed] = ()
    videos: Mapping[str, Path] = field(default_factory=dict)
    """More cameras, those of the replay by name (`h3data.replay.camera_names`), with an MP4 of what each saw."""
    name: str = ""
    """Title beside another one; by default the name of the episode."""


def write_rrd(
    recording: Recording,
    path: str | Path,
    *,
    replay: Posed | None = None,
    cameras: Sequence[CameraFeed] = (),
    videos: Mapping[str, Path] | None = None,
    pictures: Pictures = "stills",
    skin_every: int = 3,
    overwrite: bool = False,
) -> Path:
    """Write a Rerun file with a ready layout and return its path.

    ``replay``, ``cameras`` and ``videos`` are as in `Shown`. Skinned bodies are sampled every ``skin_every`` steps (less
    often if that would make the file too large) and ride on the agent's root in between.
    ``pictures`` says how camera videos are stored, see `h3data_viewers.rerun.rerun_cameras.log_camera`.

    Raises:
        InputError: ``path`` exists and ``overwrite`` is not given, or a camera's video cannot be read.
        MissingExtraError: rerun-sdk is not installed.
    """
    shown = Shown(recording=recording, replay=replay, cameras=cameras, videos=videos or {})
    return _write_file([shown], Path(path), pictures=pictures, skin_every=skin_every, overwrite=overwrite)


def write_comparison_rrd(
    first: Shown,
    second: Shown,
    path: str | Path,
    *,
    pictures: Pictures = "stills",
    skin_every: int = 3,
    overwrite: bool = False,
) -> Path:
    """Write a Rerun file that shows two recordings side by side on one timeline and return its path.

    Everything of the first lies below ``/a``, of the second below ``/b``; each has its own home, they share plots, lanes
    and log. They may differ in scene, agents, task and length: the shorter one stays in its last state, and its lanes and
    log say that it has ended. The timeline is ``step`` if the steps that both have are at the same times, else
    ``sim_time``.

    Raises:
        InputError: as `write_rrd`; or one of them has no steps.
        MissingExtraError: rerun-sdk is not installed.
    """
    for label, shown in zip(LABELS, (first, second), strict=True):
        if not len(shown.recording):
            raise InputError(
                f"Expected two recordings with steps to compare; {label}, {_title(shown)!r}, has none. "
                "Hint: view the other one alone."
            )
    return _write_file([first, second], Path(path), pictures=pictures, skin_every=skin_every, overwrite=overwrite)


def _write_file(sides: Sequence[Shown], path: Path, *, pictures: Pictures, skin_every: int, overwrite: bool) -> Path:
    if path.exists() and not overwrite:
        raise InputError(
            f"There is a file already; nothing was written. Hint: choose another name or overwrite: {path}"
        )
    try:
        import rerun as rr
    except ImportError as error:
        raise MissingExtraError('Rerun is not installed. Hint: pip install "rerun-sdk>=0.41,<0.42"') from error
    feeds = [[*side.cameras, *_named_cameras(side)] for side in sides]
    videos = [(feed.camera.name, feed.video) for group in feeds for feed in group if feed.video is not None]
    faults = [f"{name}: {video}" for name, video in videos if not video.is_file()]
    if faults:
        raise InputError(f"Camera videos that do not exist: {'; '.join(faults)}.")

    path.parent.mkdir(parents=True, exist_ok=True)
    identity = " ".join(side.recording.episode.uid for side in sides)
    stream = rr.RecordingStream(APPLICATION, recording_id=identity, send_properties=False)
    labels = LABELS if len(sides) > 1 else ("",)
    longest = max(sides, key=lambda side: len(side.recording))
    with part_file(path) as part:
        try:
            stream.save(part)
            _log_properties(stream, sides)
            written = []
            for side, label, group in zip(sides, labels, feeds, strict=True):
                sink = Sink(stream, side.recording.columns["time_ns"], label)
                written.append(_write_side(side, sink, group, pictures, skin_every, bounds=side is longest))
            stream.send_blueprint(layout(written, timeline=_timeline(sides)))
        finally:
            stream.disconnect()
        if not part.is_file() or part.stat().st_size == 0:
            raise H3DataError("Rerun wrote nothing. Hint: is it switched off by the environment variable RERUN?")
    return path


def _write_side(
    shown: Shown, sink: Sink, cameras: Sequence[CameraFeed], pictures: Pictures, skin_every: int, *, bounds: bool
) -> Side:
    import rerun as rr

    recording, replay, together = shown.recording, shown.replay, bool(sink.label)
    share = 0.5 if together else 1.0
    sink.static("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP)
    drawables = list(replay.drawables) if replay is not None else []
    log_agents(sink, recording, {d.agent for d in drawables})
    if replay is not None:
        log_rigid(sink, recording, replay, share=share)
        log_skins(sink, recording, replay, skin_every, share=share)
    log_free_space(sink, recording, replay.scene if isinstance(replay, Replay) else None)
    log_goals(sink, recording)
    logged = [(feed, log_camera(sink, feed, pictures=pictures)) for feed in cameras]
    ceilings = {f"world/scene/{entity_part(d.layer)}" for d in drawables if d.layer == "ceiling" and not d.moving}
    return Side(
        label=sink.label,
        name=f"{sink.label}: {_title(shown)}" if together else "Home",
        world=sink.path("world"),
        focus=_focus(recording, drawables),
        hidden=sorted(sink.path(entity) for entity in ceilings),
        cameras=[entity for feed, entity in logged if feed.seen],
        plotted=log_scalars(sink, recording, shade=LABELS.index(sink.label) if together else None, bounds=bounds),
        lanes=log_lanes(sink, recording, ends=together),
        log=sink.path("log") if log_events(sink, recording, ends=together) else "",
        inputs=sink.path("input") if log_inputs(sink, recording) else "",
    )


def _title(shown: Shown) -> str:
    return shown.name or f"{shown.recording.episode.task} {shown.recording.episode.episode_id}"


def _timeline(sides: Sequence[Shown]) -> str:
    """The timeline on which all sides run at the same pace."""
    times = [side.recording.columns["time_ns"] for side in sides]
    both = min(len(t) for t in times)
    return "step" if all(np.array_equal(t[:both], times[0][:both]) for t in times) else "sim_time"


def _named_cameras(shown: Shown) -> list[CameraFeed]:
    """Feeds of the replay's own cameras; only a `Replay` knows them by name."""
    if not shown.videos:
        return []
    if not isinstance(shown.replay, Replay):
        raise InputError("Videos by camera name need an h3data.replay.Replay. Hint: give cameras=[CameraFeed(...)].")
    tracks = {name: camera_track(shown.replay, name) for name in shown.videos}
    return [CameraFeed(camera=t.camera, poses=t.poses, video=Path(shown.videos[name])) for name, t in tracks.items()]


def _log_properties(stream: rr.RecordingStream, sides: Sequence[Shown]) -> None:
    import rerun as rr

    episodes = [side.recording.episode for side in sides]
    stream.send_recording_name(" | ".join(f"{e.task} {e.episode_id}" for e in episodes))
    for side, e, label in zip(sides, episodes, LABELS, strict=False):
        values = rr.AnyValues(
            uid=e.uid, episode_id=e.episode_id, task=e.task, scene=e.scene, seed=e.seed, created_by=e.created_by,
            steps=len(side.recording),
        )  # fmt: skip
        stream.send_property(f"episode_{label}" if len(sides) > 1 else "episode", values)


# --- where to look ----------------------------------------------------------------------------------------------------
def _focus(recording: Recording, drawables: Sequence[Drawable]) -> NDArray[np.floating]:
    """Box [2, 3] that the first view should show: around all tracks, at most 5 m beyond, inside the home [m]."""
    corners = []
    for d in drawables:
        if d.layer != "ceiling" and not d.moving and not d.deformable and len(d.mesh.vertices):
            lo, hi = d.mesh.bounds
            box = np.array([[x, y, z] for x in (lo[0], hi[0]) for y in (lo[1], hi[1]) for z in (lo[2], hi[2])])
            corners.append(transform_points(d.matrix, box))
    home = None
    if corners:
        every = np.concatenate(corners)
        home = np.stack([every.min(0), every.max(0)])
    tracks = [recording.agent_column(i, "base_pose")[:, :3] for i in range(len(recording.agents))]
    points = np.concatenate([t[np.isfinite(t).all(1)] for t in tracks]) if tracks else np.zeros((0, 3))
    if not len(points):
        return np.array([[-3.0, 0, -3], [3, 2, 3]]) if home is None else home
    near = np.stack([points.min(0) - np.array([5, 0.5, 5]), points.max(0) + np.array([5, 2.5, 5])]).astype(np.float64)
    return near if home is None else np.stack([np.maximum(home[0], near[0]), np.minimum(home[1], near[1])])
