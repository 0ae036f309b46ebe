"""A whole study in Chromium, by mouse and keys."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import msgspec

from h3data.recording import read_mcap
from h3data_studies.files import make_plan
from sim_kinematic.tasks.resume import verify
from tests.play.test_browser import CHROMIUM, PLAYER_S, WEB, pytestmark
from tests.studies.tiny import tiny

__all__ = ["pytestmark"]


def test_a_study_is_played_from_consent_to_the_completion_code(tmp_path: Path) -> None:
    from tests.play.server import Server

    folder = tmp_path / "tiny-1"
    plan = make_plan(tiny(recruiting={"completion_code": "C1A2B3C4"}), folder, speed=2.0)
    with Server(folder, {"study": msgspec.to_builtins(plan), "stays": True}) as server:
        command = ["node", str(WEB / "test" / "browser" / "study.mjs"), server.links[0], str(tmp_path / "shot")]
        environment = {**os.environ, "CHROMIUM": str(CHROMIUM)}
        done = subprocess.run(command, capture_output=True, text=True, timeout=PLAYER_S, env=environment)
        assert done.returncode == 0, done.stderr
        server.stop()
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["faults"] == []
    assert said["stages"][:2] == ["consent", "tutorial"]
    assert said["stages"].count("episode") == 2
    assert said["stages"].count("form") == 4
    assert "C1A2B3C4" in said["text"]
    assert said["warned"], "questions left open are pointed out"
    assert said["slider"] > 150, "px, on a phone of 320"
    assert said["paused"] == "Paused"
    assert said["resumed"]
    assert "PROLIFIC" not in said["address"], "ids leave the address bar"
    recordings = [read_mcap(path) for path in (folder / "recordings").glob("*.mcap")]
    assert {r.episode.info["condition"] for r in recordings} == {"solo", "still"}
    assert {r.episode.info["hitl"]["client"]["browser"] for r in recordings} == {"Chromium"}
    for recording in recordings:
        assert recording.episode.info["ended"] == "success"
        assert verify(recording).difference is None
