"""Recordings and datasets in notebooks: a picture strip and tables, an inline Rerun viewer, an inline video."""

from __future__ import annotations

import base64
import importlib.util
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from h3data.errors import H3DataError, InputError, MissingExtraError
from h3data.progress import progress
from h3data.recording import Episodes, Recording
from h3data.replay import CameraTrack, Replay, camera_at, camera_track
from h3data.replay.third_person import third_person_at
from h3data_viewers.rerun.cameras import scaled
from h3data_viewers.templates import jpeg_data_uri, render

if TYPE_CHECKING:
    from h3data.metrics import EpisodeMetrics, MetricsTable

Viewer = Literal["rerun", "video"]
STRIP = 5
"""Number of pictures in the strip of a recording in a notebook."""
LISTED = 10
"""Largest number of episodes of a dataset that a notebook lists."""


@dataclass(frozen=True)
class InlineVideo:
    """An MP4 file that notebooks play in place."""

    data: bytes
    width: int
    title: str

    def _repr_html_(self) -> str:
        data = base64.b64encode(self.data).decode()
        return _html(video=data, width=self.width, video_title=self.title)

    def __repr__(self) -> str:
        return f"InlineVideo({self.title}: {len(self.data) / 1e6:.1f} MB; notebooks play it, save() writes it)"

    def save(self, path: str | Path) -> Path:
        """Write the MP4 file and return its path."""
        path = Path(path)
        path.write_bytes(self.data)
        return path


def show(
    recording: Recording,
    viewer: Viewer | None = None,
    *,
    camera: str = "third_person",
    width: int | None = None,
    assets: Sequence[str | Path] = (),
) -> Any:
    """Return an object that a notebook displays: a Rerun viewer of the recording, or a video from one camera.

    Args:
        recording: The recording.
        viewer: ``rerun`` (needs ``pip install "h3data[notebook]"``) or ``video``; None selects Rerun if it is
            installed.
        camera: Camera of the video: a name (`h3data.replay.camera_names`) or a file.
        width: Width [px] of the viewer or video.
        assets: Folders with the asset files of a foreign recording.

    Raises:
        InputError: there is no such viewer or camera.
        MissingExtraError: the Rerun viewer is not installed.
    """
    if viewer not in (None, "rerun", "video"):
        raise InputError(f"Expected 'rerun' or 'video' as viewer, got {viewer!r}.", code="H3-VIEW-013")
    installed = importlib.util.find_spec("rerun_notebook") is not None
    if viewer == "rerun" and not installed:
        raise MissingExtraError(
            'The Rerun viewer for notebooks is not installed. Hint: pip install "h3data[notebook]", or show("video")',
            code="H3-VIEW-014",
        )
    if viewer == "rerun" or (viewer is None and installed):
        return _rerun(recording, width=width, assets=assets)
    return _video(recording, camera, width=width or 480, assets=assets)


def _rerun(recording: Recording, *, width: int | None, assets: Sequence[str | Path]) -> Any:
    from rerun.notebook import Viewer as RerunViewer

    from h3data_viewers.rerun.rrd_file import ViewedRecording, recorded_stream

    shown = ViewedRecording(recording=recording, replay=Replay(recording, assets=assets, detail=False))
    # from memory: the notebook holds the recording, no file
    return RerunViewer(width=width or "auto", recording=recorded_stream([shown]))


def _video(recording: Recording, camera: str, *, width: int, assets: Sequence[str | Path]) -> InlineVideo:
    from h3data.render.video import VideoWriter

    replay = Replay(recording, assets=assets)
    track = camera_track(replay, camera)
    small = replace(track, camera=scaled(track.camera, width / track.camera.width))
    # a damaged file may have steps of no length
    rate = 1e9 / max(recording.episode.dt_ns, 1)
    # FFmpeg writes the index of an MP4 last and in front, which needs a file
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        with (
            VideoWriter(path, small.camera.width, small.camera.height, rate) as video,
            progress(total=len(replay), desc="render", unit="step") as bar,
        ):
            for _, views in replay.frames([small], range(len(replay)), threads=2):
                video.write(views[0]["rgb"])
                bar.update(1)
        return InlineVideo(path.read_bytes(), width, f"{recording.episode.episode_id} from {camera}")


def recording_html(recording: Recording) -> str:
    """Return a picture strip, a description and the metrics of a recording as HTML."""
    episode = recording.episode
    agents = ", ".join(f"{a.name} ({a.model or a.kind})" for a in recording.agents) or "none"
    facts: dict[str, Any] = {
        "task": episode.task,
        "scene": episode.scene,
        "agents": agents,
        "length": f"{len(recording):,} steps, {recording.duration_s:.1f} s",
    }
    facts |= {name: episode.info[name] for name in ("policy", "partner", "ended") if episode.info.get(name)}
    tables: list[tuple[Sequence[str], Sequence[Sequence[object]]]] = [((), list(facts.items()))]
    pictures, fault = _strip(recording)
    notes = [f"No pictures: {fault}"] if fault else []
    try:
        from h3data.metrics import measure

        tables.append(_metrics(measure(recording)))
    except H3DataError as error:
        notes.append(f"No metrics: {error}")
    notes.append("print(rec) lists columns; rec.show() plays it")
    return _html(title=f"Recording {episode.episode_id}", pictures=pictures, tables=tables, notes=notes)


def episodes_html(episodes: Episodes, title: str) -> str:
    """Return a list of the first episodes as HTML, with the facts that are known without reading their steps."""
    facts = [stored.facts for stored in episodes.stored]
    counted = Counter(str(of["task"]) for of in facts)
    tasks = ", ".join(f"{count} {task}" for task, count in counted.most_common())
    optional = [name for name in ("policy", "partner", "ended") if any(of.get(name) for of in facts[:LISTED])]
    names = ["task", "scene", "seed", "length", *optional]
    rows = [[k, *(of.get(name, "") for name in names)] for k, of in enumerate(facts[:LISTED])]
    steps = sum(int(of["length"]) for of in facts)
    about = f": {len(facts):,} episode{'s' * (len(facts) != 1)} ({tasks or 'none'}), {steps:,} steps"
    more = [f"and {len(facts) - LISTED} more"] if len(facts) > LISTED else []
    return _html(title=title, about=about, tables=[(["", *names], rows)], cut=True, notes=more)


def metrics_table_html(table: MetricsTable) -> str:
    """Return the means and intervals of metrics as HTML."""
    head, *rows = table.to_rows()
    left_out = sum(map(len, table.left_out.values()))
    notes = [f"{left_out} episodes left out: print(table) says why"] if left_out else []
    return _html(tables=[(head, rows)], notes=notes)


def metrics_html(measured: EpisodeMetrics) -> str:
    """Return the values of the metrics of an episode, and notes on them, as HTML."""
    return _html(tables=[_metrics(measured)])


def _metrics(measured: EpisodeMetrics) -> tuple[list[str], list[list[str]]]:
    """Return the head and rows of the table of metrics."""
    head, *rows = measured.to_rows()
    if not measured.notes:
        return head, rows
    return [*head, "notes"], [[*row, measured.notes.get(row[0], "")] for row in rows]


def _html(**content: Any) -> str:
    """Return the output of a cell: the parts of notebook.html that have content."""
    nothing = {"title": "", "about": "", "video": "", "pictures": (), "tables": (), "cut": False, "notes": ()}
    return render("notebook.html", **nothing | content)


def _strip(recording: Recording) -> tuple[list[tuple[str, int, str, float]], str]:
    """Return pictures evenly spread over a recording, from behind the robot or, without agents, from above.

    Returns:
        JPEG as a data URI, width [px], camera and time [s] of each picture; and the reason why there are none, else empty.
    """
    if not len(recording):
        return [], "the recording has no steps."
    try:
        replay = Replay(recording, detail=False)
        if not replay.drawables:
            return [], "the recording names nothing that could be drawn."
        name = "third_person" if recording.agents else "top_down"
        rows = [int(row) for row in np.unique(np.linspace(0, len(recording) - 1, STRIP).round())]
        times = (recording.columns["time_ns"][rows] - recording.columns["time_ns"][0]) * 1e-9
        pictures = []
        for row, time_s in zip(rows, times, strict=True):
            # the search for a smooth path, as of a video, would take 95% of the time
            alone = bool(recording.agents)
            camera = third_person_at(replay, row, around_s=0.0) if alone else camera_at(replay, name, row)
            small = scaled(camera, 200 / camera.width)  # five of them fit into a cell
            track = CameraTrack(camera=small, poses=small.pose[None])
            picture = next(iter(replay.frames([track], [row])))[1][0]["rgb"]
            pictures.append((jpeg_data_uri(picture), picture.shape[1], name, float(time_s)))
    except H3DataError as error:
        return [], str(error)
    return pictures, ""
