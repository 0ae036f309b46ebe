"""The replay played from disk by Chromium without a window: keys, cameras, charts, events, sizes; no network."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from h3data.recording import Recording
from h3data_viewers.html_replay.html_file import write_html
from tests.play.test_browser import CHROMIUM, PLAYER_S, WEB, missing_browser
from tests.viewers.replays.test_html_replay import hostile, tidied, walk

__all__ = ["hostile", "tidied", "walk"]

_MISSING = missing_browser()
pytestmark = [pytest.mark.browser, pytest.mark.skipif(bool(_MISSING), reason=_MISSING or "nothing is missing")]


def play(recording: Recording, folder: Path) -> dict[str, Any]:
    """What `web/test/browser/replay.mjs` says of the replay of a recording; pictures lie in ``folder``."""
    file = write_html(recording, folder / "e.html").path
    command = ["node", str(WEB / "test" / "browser" / "replay.mjs"), str(file), str(folder / "seen")]
    environment = {**os.environ, "CHROMIUM": str(CHROMIUM)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=PLAYER_S, env=environment)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["faults"] == []
    assert said["network"] == []
    return said


def test_a_walk_plays_from_disk_and_is_used_by_keys_alone(walk: Recording, tmp_path: Path) -> None:
    said = play(walk, tmp_path)
    assert said["rows"] == len(walk)
    assert said["bones"] > 15
    assert said["playsOnLoad"]
    assert said["paused"]
    assert (said["home"], said["right"], said["left"], said["end"]) == (0, 1, 0, len(walk) - 1)
    assert said["speed"] == 2
    assert said["help"]
    assert len(said["cameras"]) == 6
    assert all(said["fits"].values()), said["fits"]
    assert said["covered"] == []
    assert {path.name for path in tmp_path.glob("*.png")} >= {"seen_wide.png", "seen_zoomed.png", "seen_phone.png"}


def test_charts_and_events_of_rearrangement_go_with_the_scrub_bar(tidied: Recording, tmp_path: Path) -> None:
    said = play(tidied, tmp_path)
    assert said["charts"] >= 6
    assert said["cursorsMoved"]
    assert said["events"] > 1
    assert said["eventRow"] == said["eventStep"]
    assert said["nextEvent"] > 0


def test_recorded_strings_never_become_script(hostile: Recording, tmp_path: Path) -> None:
    said = play(hostile, tmp_path)
    assert said["hostile"] is None
    assert "<script>" in said["title"]


def test_a_recording_without_agents_events_and_columns_plays(walk: Recording, tmp_path: Path) -> None:
    bare = {
        name: column for name, column in walk.columns.items() if not name.startswith(("agent_", "metrics.", "sim."))
    }
    said = play(replace(walk, agents=(), events=(), skills=(), columns=bare), tmp_path)
    assert said["cameras"] == ["Overview", "From above"]
    assert said["charts"] == 0
