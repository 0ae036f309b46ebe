"""A recording as a Rerun file (``.rrd``): 3-D home with everything that moves, cameras, plots, action lanes, event log.

Entities: ``world/scene/<name>`` what stands still (below its layer, if it has one), ``world/objects/<name>`` what moves,
``world/<agent>/...`` agents: their parts hang in the agent's root frame, so that only joints that move cost bytes.
``world/trajectories``, ``world/cameras/<name>``, ``metrics/*``, ``actions/*``, ``log/*``. Timelines: ``step``, ``sim_time``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError, MissingExtraError
from h3data.files import part_file
from h3data.geometry import transform_points
from h3data.recording.records import Recording
from h3data_viewers.rerun_bodies import Drawable, Posed, entity_part, log_agents, log_rigid, log_skins
from h3data_viewers.rerun_cameras import CameraFeed, Pictures, log_camera
from h3data_viewers.rerun_layout import layout
from h3data_viewers.rerun_tracks import Timeline, log_events, log_lanes, log_scalars

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "h3data"


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

    ``replay`` gives meshes and poses; without it agents are drawn as plain solids. Skinned bodies are sampled every
    ``skin_every`` steps (less often if that would make the file too large) and ride on the agent's root in between.
    ``videos`` adds cameras of the replay by name (`h3data.replay.camera_names`) with an MP4 of what each saw.
    ``pictures`` says how camera videos are stored, see `h3data_viewers.rerun_cameras.log_camera`.

    Raises:
        InputError: ``path`` exists and ``overwrite`` is not given, or a camera's video cannot be read.
        MissingExtraError: rerun-sdk is not installed.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise InputError(
            f"There is a file already; nothing was written. Hint: choose another name or overwrite: {path}"
        )
    try:
        import rerun as rr
    except ImportError as error:
        raise MissingExtraError('Rerun is not installed. Hint: pip install "rerun-sdk>=0.41,<0.42"') from error
    cameras = [*cameras, *_named_cameras(replay, videos or {})]
    faults = [f"{c.camera.name}: {c.video}" for c in cameras if c.video is not None and not c.video.is_file()]
    if faults:
        raise InputError(f"Camera videos that do not exist: {'; '.join(faults)}.")

    path.parent.mkdir(parents=True, exist_ok=True)
    stream = rr.RecordingStream(APPLICATION, recording_id=recording.episode.uid, send_properties=False)
    with part_file(path) as part:
        try:
            stream.save(part)
            _write(stream, recording, replay, cameras, pictures, skin_every)
        finally:
            stream.disconnect()
        if not part.is_file() or part.stat().st_size == 0:
            raise H3DataError("Rerun wrote nothing. Hint: is it switched off by the environment variable RERUN?")
    return path


def _write(
    stream: rr.RecordingStream,
    recording: Recording,
    replay: Posed | None,
    cameras: Sequence[CameraFeed],
    pictures: Pictures,
    skin_every: int,
) -> None:
    import rerun as rr

    timeline = Timeline(recording.columns["time_ns"])
    _log_properties(stream, recording)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True, strict=True)
    drawables = list(replay.drawables) if replay is not None else []
    log_agents(stream, recording, timeline, {d.agent for d in drawables})
    if replay is not None:
        log_rigid(stream, recording, timeline, replay)
        log_skins(stream, recording, timeline, replay, skin_every)
    logged = [(feed, log_camera(stream, timeline, feed, pictures=pictures)) for feed in cameras]
    seen = [entity for feed, entity in logged if feed.video is not None]
    plotted = log_scalars(stream, recording, timeline)
    lanes = log_lanes(stream, recording, timeline)
    has_log = log_events(stream, recording, timeline)
    focus = _focus(recording, drawables)
    hidden = sorted(
        {f"/world/scene/{entity_part(d.layer)}" for d in drawables if d.layer == "ceiling" and not d.moving}
    )
    stream.send_blueprint(
        layout(focus=focus, hidden=hidden, cameras=seen, plotted=plotted, lanes=lanes, has_log=has_log)
    )


def _named_cameras(replay: Posed | None, videos: Mapping[str, Path]) -> list[CameraFeed]:
    """Feeds of the replay's own cameras; only a `Replay` knows them by name."""
    if not videos:
        return []
    from h3data.replay import Replay, camera_track

    if not isinstance(replay, Replay):
        raise InputError("Videos by camera name need an h3data.replay.Replay. Hint: give cameras=[CameraFeed(...)].")
    tracks = {name: camera_track(replay, name) for name in videos}
    return [CameraFeed(camera=t.camera, poses=t.poses, video=Path(videos[name])) for name, t in tracks.items()]


def _log_properties(stream: rr.RecordingStream, recording: Recording) -> None:
    import rerun as rr

    e = recording.episode
    stream.send_recording_name(f"{e.task} {e.episode_id}")
    stream.send_property(
        "episode",
        rr.AnyValues(
            uid=e.uid, episode_id=e.episode_id, task=e.task, scene=e.scene, seed=e.seed, created_by=e.created_by,
            steps=len(recording),
        ),
    )  # fmt: skip


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
