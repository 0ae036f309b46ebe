"""Writer of a recording as one HTML file that plays from disk (`write_html`).

The file holds the page (built from ``h3data_play/web/src/replay``), the home as GLB and the states, all compressed in
one block of Base64. Names and texts of the recording are inside that block: the page shows them as text, and its
Content-Security-Policy allows no other script and no request.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from h3data.errors import H3DataError, InputError
from h3data.files import part_file
from h3data.plugins import own_version
from h3data.recording import Recording
from h3data.replay import Replay
from h3data_exporters.posing import posed_parts
from h3data_viewers.html_replay.home import add_home
from h3data_viewers.html_replay.packing import Payload
from h3data_viewers.html_replay.story import add_story
from h3data_viewers.html_replay.tracks import add_tracks
from h3data_viewers.templates import render

MOST_STATES = 6000
"""Largest number of states in an HTML replay (200 s at 30 Hz). Of longer recordings only every second or third state
(or fewer) is stored, and the page interpolates between them."""


@dataclass(frozen=True)
class HtmlReplay:
    """Properties of a replay that was written as an HTML file."""

    path: Path
    bytes: int
    states: int
    """Number of states in the file, at most `MOST_STATES`."""
    steps: int
    """Number of steps of the recording."""


def write_html(
    recording: Recording, path: str | Path, *, replay: Replay | None = None, title: str = "", overwrite: bool = False
) -> HtmlReplay:
    """Write a recording as an HTML file that needs no server, no network and no other file.

    Args:
        recording: Recording to show.
        path: Path of the ``.html`` file; missing folders are created.
        replay: Its meshes and poses (default: without assets of foreign recordings, people by their reduced meshes).
        title: Title of the page (default: task and episode id).
        overwrite: True if an existing file may be replaced.

    Raises:
        InputError: ``path`` exists and ``overwrite`` is false, or the recording has no steps.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise InputError(
            f"The file already exists; choose another name or pass overwrite=True: {path}", code="H3-VIEW-001"
        )
    if not len(recording):
        raise InputError(
            f"Expected a recording with steps, but episode {recording.episode.episode_id!r} has none.",
            code="H3-VIEW-002",
        )
    replay = replay or Replay(recording, detail=False)
    # the first and the last state are always among them
    rows = np.unique(np.linspace(0, len(recording) - 1, min(len(recording), MOST_STATES)).round().astype(np.int64))
    task, episode_id = (
        recording.episode.task.replace("_", " ").capitalize() or "Recording",
        recording.episode.episode_id,
    )
    named = f"{task}, episode {episode_id}" if episode_id else task
    page = _page(title or named, _block(recording, replay, rows))
    path.parent.mkdir(parents=True, exist_ok=True)
    with part_file(path) as part:
        part.write_text(page, encoding="utf-8", newline="\n")
    return HtmlReplay(path=path, bytes=path.stat().st_size, states=len(rows), steps=len(recording))


def _block(recording: Recording, replay: Replay, rows: np.ndarray) -> bytes:
    payload = Payload()
    parts = posed_parts(replay, rows)
    add_home(payload, recording, parts)
    times = recording.columns["time_ns"].astype(np.float64) * 1e-9
    payload.add_array("time", times[rows] - times[0], 1e-4)  # a tenth of a millisecond
    # the page names steps of the recording, whichever of them it holds
    payload.add_array("step", rows, 1)
    scene = replay.scene
    if scene is not None and scene.rooms:
        floor_y = scene.rooms[0].floor_y
    else:  # recordings of other tools have no rooms: agents stand on the lowest height that one has
        heights_y = [recording.agent_column(k, "base_pose")[:, 1] for k in range(len(recording.agents))]
        floor_y = min((float(y[np.isfinite(y)].min()) for y in heights_y if np.isfinite(y).any()), default=0.0)
    heights = replay.heights.round(6).tolist()
    stage = {**add_tracks(payload, replay, parts, rows), "floor_y": float(floor_y), "heights": heights}
    return payload.packed({"stage": stage, "facts": _facts(recording, replay), **add_story(payload, recording, rows)})


def _facts(recording: Recording, replay: Replay) -> dict[str, Any]:
    """Return the page's facts about the recording, by title, as text."""
    episode, info = recording.episode, recording.episode.info
    shapes = "plain bodies and named boxes" if replay.stand_ins else "striped shapes"
    facts = {
        "Task": episode.task.replace("_", " "),
        "Episode": episode.episode_id,
        "Scene": episode.scene,
        "Seed": "" if episode.seed is None else episode.seed,
        "Instruction": info.get("instruction", ""),
        "Robot policy": info.get("policy", ""),
        "Partner": info.get("partner", ""),
        "Ended by": str(info.get("ended", "")).replace("_", " "),
        "Steps": f"{len(recording):,}",
        "Recorded by": episode.created_by,
        "Not found": f"{len(replay.missing)} asset files: {shapes} stand in for them" if replay.missing else "",
    }
    return {name: str(value) for name, value in facts.items() if str(value)}


def _page(title: str, block: bytes) -> str:
    script = files("h3data_viewers.html_replay") / "page" / "replay.js"
    if not script.is_file():
        raise H3DataError(
            f"The page of HTML replays is not built. Hint: run make web (needs Node.js). Missing: {script.name}",
            code="H3-VIEW-003",
        )
    return render(
        "html_replay/page/replay.html",
        title=title,
        generator=f"h3data {own_version()}",
        data=base64.b64encode(block).decode(),
    )
