"""A study of tasks in words: the file that docs/study.md shows, played by bots beside every kind of partner."""

from __future__ import annotations

import csv
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from h3data.recording import read_mcap
from h3data_pipelines.cli import main
from h3data_studies.files import read_design
from sim_kinematic.tasks.resume import verify
from tests.llm.scripted_endpoint import Served, call, chat_server
from tests.paths import ROOT
from tests.studies.tiny import as_toml

MODEL = "llm:http://127.0.0.1:8000/v1?model=NAME"


def documented() -> dict[str, Any]:
    """The study that the page shows."""
    code = re.search(r"```toml\n(name = \"words\"\n.*?)```", (ROOT / "docs" / "study.md").read_text(), re.DOTALL)
    assert code is not None
    return tomllib.loads(code[1])


def small(folder: Path, served: Served) -> Path:
    """It with one participant, one home and one short episode in each condition."""
    data = documented()
    conditions = [
        {**one, "partner": one["partner"].replace(MODEL, served.policy(plans=3))}
        for one in data["conditions"]
        if "play_as" not in one  # those of two people: test_pairs.py
    ]
    for one in conditions:
        one["rules"] = {"template": "wash_and_put", "max_steps": 5000}
    changes = {
        "participants": 1,
        "episodes": 1,
        "scenes": ["h3-homes/val#3"],
        "tutorial": {"skip": True},
        "conditions": conditions,
        "retention": "2030-01-31",
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "study.toml"
    path.write_text(as_toml({**data, **changes}))
    return path


def test_the_study_of_the_page_is_a_design(tmp_path: Path) -> None:
    with chat_server(lambda _: call("wait", seconds=60)) as served:
        path = small(tmp_path, served)
        assert [c.partner.partition(":")[0] for c in read_design(path).conditions if c.partner] == [
            "solo",
            "language_expert",
            "language_talk",
            "llm",
        ]


def test_a_study_beside_a_model_that_is_not_there_does_not_begin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with chat_server(lambda _: call("done")) as served:
        path = small(tmp_path, served)
    assert main(["study", "bots", str(path), "--participants", "1"]) == 2
    said = capsys.readouterr().err
    assert "The condition model cannot be played" in said
    assert "No language model answers" in said


@pytest.mark.slow
def test_bots_play_a_study_in_words_beside_everybody(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with chat_server(
        lambda body: call("say", text="Hello.") if "Said so far" not in str(body) else call("done")
    ) as served:
        path = small(tmp_path, served)
        assert main(["study", "bots", str(path), "--participants", "1", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["statuses"] == {"complete": 1}
        assert served.requests
    folder = tmp_path / "words-1-bots"
    recordings = [read_mcap(file) for file in sorted((folder / "recordings").glob("*.mcap"))]
    assert len(recordings) == 4
    policies = [str(r.episode.info["policy"]) for r in recordings]
    assert {"solo", "language_expert", "language_talk"} < set(policies)
    assert any(policy.startswith("llm:scripted@") for policy in policies)
    for recording in recordings:
        assert verify(recording).difference is None, "without the endpoint"
        assert [remark["answer"] for remark in recording.episode.info["hitl"]["remarks"]]
    assert any(e.kind == "say" and e.detail == "Hello." for r in recordings for e in r.events)
    assert "success" in {r.episode.info["ended"] for r in recordings}
    assert main(["study", "report", str(folder)]) == 0
    rows = list(csv.DictReader((folder / "report" / "trials.csv").read_text().splitlines()))
    assert {row["completed"] for row in rows} <= {"yes", "no", "unsure"}
    assert all(row["problems"] == "0" and row["PC"] for row in rows)
    assert (folder / "report" / "report.html").is_file()
