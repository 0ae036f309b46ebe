"""``h3data info``: what recordings and datasets hold."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from h3data.recording import DatasetWriter, write_mcap
from h3data_pipelines.cli import main
from tests.recording.strategies import simple_recording


def info(capsys: pytest.CaptureFixture[str], *paths: object, code: int = 0) -> Any:
    capsys.readouterr()
    assert main(["info", *map(str, paths), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def test_recordings_and_datasets_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = simple_recording()
    write_mcap(recording, tmp_path / "logs" / "a.mcap")
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(recording)
    (log,) = info(capsys, tmp_path / "logs")["found"]
    (episode,) = info(capsys, f"{tmp_path / 'ds'}#0")["found"]
    assert {**log, "path": ""} == {**episode, "path": ""}
    assert (log["kind"], log["steps"], log["task"]) == ("recording", len(recording), recording.episode.task)
    assert [agent["name"] for agent in log["agents"]] == [agent.name for agent in recording.agents]
    assert log["columns"]["time_ns"] == {"dtype": "int64", "shape": [len(recording)]}
    (dataset,) = info(capsys, tmp_path / "ds")["found"]
    assert (dataset["kind"], dataset["episodes"], dataset["steps"]) == ("dataset", 1, len(recording))
    assert dataset["scenes"] == {recording.episode.scene: 1}
    ended = replace(recording, episode=replace(recording.episode, info={"ended": "success"}))
    write_mcap(ended, tmp_path / "logs" / "b.mcap")
    outcomes = info(capsys, tmp_path / "logs" / "b.mcap")["found"][0]
    assert (log["ended"], outcomes["ended"]) == (None, "success")
    assert outcomes["skill_outcomes"] == {"done": len(recording.skills)}
    assert main(["info", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert f"{tmp_path / 'logs' / 'a.mcap'}\nRecording" in out
    assert "ds#0" in out
    assert f"  ended    success\n  skills   {len(recording.skills)} done" in out


def test_what_cannot_be_read_is_told_beside_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mcap(simple_recording(), tmp_path / "a.mcap")
    (tmp_path / "b.mcap").write_text("no log")
    found = info(capsys, tmp_path, code=1)["found"]
    assert found[0]["kind"] == "recording"
    assert "looks like" in found[1]["error"]
    assert "looks like" in info(capsys, tmp_path / "b.mcap", code=2)["error"]
    assert "at least one" in info(capsys, code=2)["error"]
    assert "no such file" in info(capsys, tmp_path / "c.mcap", code=2)["error"]
