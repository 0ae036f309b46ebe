"""Imported HITL sessions as studies: measured as social rearrangement, with participants and conditions."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.metrics import measure
from h3data.pseudonyms import KEY_VARIABLE, anonymous_id, participant_key
from h3data.recording import open_recording
from h3data_habitat.hitl.paper_logs import read_hitl_log
from h3data_habitat.hitl.sessions import read_hitl_episode
from h3data_pipelines.cli import main
from tests.habitat.hitl.test_hostile_files import TILTED, frame, log, session, stored

GOALS = [[1.0, 0.5, 0.0], [5.0, 0.5, 0.0]]


def tidied(*, contact: int | None = None, done: bool = True) -> dict[str, Any]:
    """A log of 6 steps: the robot brings object 7, the person object 9; success in step 5."""
    content = log(6, target_obj_ids=[7, 9], goal_positions=GOALS)
    for k, step in enumerate(content["steps"]):
        robot, person = step["agent_states"]
        robot["grasp_mgr_snap_idx"] = 7 if k < 2 else None
        person["grasp_mgr_snap_idx"] = 9 if k < 4 else None
        placed = done and k >= 4
        step["target_object_positions"] = [[1.0 if k >= 2 else 3.0, 0.5, 0.1], [5.0 if placed else 7.0, 0.5, 0.1]]
        step["metrics"] = {"did_collide": k == contact, "pddl_success": placed and k == 5, "num_steps": k + 1}
    return content


def user(name: str, index: int = 0, **more: str) -> dict[str, Any]:
    return {"user_index": index, "connection_record": {"user_id": name, "experiment": "kitchen", **more}}


def test_a_log_of_the_paper_is_measured_as_rearrangement(tmp_path: Path) -> None:
    recording = read_hitl_log(stored(tmp_path, tidied()))
    measured = measure(recording)
    assert (measured.profile, measured.task) == ("paper", "rearrange")
    assert {k: v for k, v in measured.values.items() if k != "RE"} == {"SR": 1, "CR": 0, "RC": 0.5, "TS": 6}
    np.testing.assert_array_equal(recording.columns["metrics.at_goal"][:, 0], np.arange(6) >= 2)
    assert math.isnan(measured.values["RE"])
    assert "info:solo_steps" in measured.notes["RE"]
    hit = measure(read_hitl_log(stored(tmp_path, tidied(contact=3, done=False))))
    assert (hit.values["SR"], hit.values["CR"], hit.moments["collision"]) == (0, 1, 3)
    assert math.isnan(hit.values["TS"])


def test_contacts_follow_from_their_count_and_bad_goals_are_said(tmp_path: Path) -> None:
    content = tidied()
    content["goal_positions"] = [[0, 0], "x"]
    for k, step in enumerate(content["steps"]):
        step["metrics"] = {"num_agents_collide": int(k > 1) + int(k > 3)}
    recording = read_hitl_log(stored(tmp_path, content))
    np.testing.assert_array_equal(np.flatnonzero(recording.columns["metrics.collision"]), [2, 4])
    assert "metrics.at_goal" not in recording.columns
    assert any("goal_positions" in warning for warning in recording.episode.info["warnings"])


def test_a_session_has_its_success_and_pseudonyms_of_its_users(tmp_path: Path) -> None:
    frames = [frame(k, task_percent_complete=0.5 if k < 3 else 1.0) for k in range(5)]
    users = [user("Ann@Example.org", condition="plan_pop3"), user("robot operator", 1)]
    content = session(frames, users=users, session={"connection_records": {"0": users[0]["connection_record"]}})
    content["episode"]["user_index_to_agent_index_map"] = {"0": 1, "1": 0}
    recording = read_hitl_episode(stored(tmp_path, content))
    ann = anonymous_id("ann@example.org", key=participant_key())
    info = recording.episode.info
    assert (info["participant"], info["condition"], info["experiment"]) == (ann, "plan_pop3", "kitchen")
    assert set(info["participants"]) == {"0", "1"}
    assert "example" not in json.dumps(info).lower()
    values = measure(recording).values
    assert (values["SR"], values["TS"]) == (1, 4)
    assert math.isnan(values["CR"])


def test_the_key_is_made_once_and_only_for_its_owner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(KEY_VARIABLE)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    first = participant_key()
    assert participant_key() == first
    (file,) = (tmp_path / "h3data").iterdir()
    assert file.stat().st_mode & 0o077 == 0
    assert len(first) == 32


def test_a_manifest_says_who_did_what(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = tmp_path / "logs"
    for person in ("p1", "p2"):
        (logs / person).mkdir(parents=True)
        for k in (0, 1):
            stored(logs / person, tidied(contact=k) | {"start_time": person}, f"s.{k}.json")
    stored(logs, session([frame(k, task_percent_complete=0) for k in range(4)], users=[user("ann")]), "ann.json")
    manifest = tmp_path / "sessions.csv"
    manifest.write_text(
        "\ufefffile, user_id, participant, condition, solo_steps, age\n"
        "p1/*,,P01,solo,,30\np2/*,,P02,solo,,31\n*/s.1.json,,,plan_pop3,12,\n,ANN,,learn_single,,\nnone*,,,x,,\n"
    )
    out = tmp_path / "rec"
    assert main(["import", str(logs), "-o", str(out), "--manifest", str(manifest)]) == 0
    text = capsys.readouterr().out
    assert "participant P01, condition plan_pop3" in text
    assert "no recording fits line 6" in text
    assert "not used: age" in text
    info = open_recording(out / "p2" / "s.1.mcap").episode.info
    assert (info["participant"], info["condition"], info["solo_steps"]) == ("P02", "plan_pop3", 12)
    assert open_recording(out / "ann.mcap").episode.info["condition"] == "learn_single"
    assert main(["metrics", str(out), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["episodes"]
    assert [row["values"]["RE"] for row in rows] == [None, None, 200.0, None, 200.0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("file,conditon\na,b\n", "Did you mean 'condition'"),
        ("who,condition\na,b\n", "chooses recordings"),
        ("file,condition\n,b\n", "Line 2 chooses no recording"),
        ("file,solo_steps\na,many\n", "Expected a number of steps in solo_steps of line 2"),
        ("file,condition\n", "no rows"),
    ],
)
def test_manifests_that_say_nothing_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    manifest = tmp_path / "m.csv"
    manifest.write_text(text)
    source = stored(tmp_path, tidied())
    assert main(["import", str(source), "-o", str(tmp_path / "rec"), "--manifest", str(manifest)]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "rec").exists()


def test_a_person_alone_never_collides(tmp_path: Path) -> None:
    content = tidied()
    for step in content["steps"]:
        step["agent_states"] = [{"position": [1, 0.92, 0], "rotation_xyzw": TILTED, "grasp_mgr_snap_idx": None}]
        step["action"], step["metrics"] = None, {"pddl_success": False}
    values = measure(read_hitl_log(stored(tmp_path, content))).values
    assert values["CR"] == 0


def test_real_sessions_are_measured(real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = real / "habitat-lab" / "reference" / "hitl" / "session_2users"
    out = tmp_path / "rec"
    assets = str(real / "habitat-lab" / "reference")
    assert main(["import", str(folder), "-o", str(out), "--assets", assets]) == 0
    assert open_recording(out / "gen1" / "session.0.mcap").episode.scene == "flat"  # found by its name alone
    capsys.readouterr()
    assert main(["metrics", str(out), "--json"]) == 1  # one is left out
    measured = json.loads(capsys.readouterr().out)
    by_id = {(row["episode_id"], row["steps"]): row["values"] for row in measured["episodes"]}
    assert len(measured["episodes"]) == 4
    assert by_id["17", 200]["SR"] == 0
    assert measured["left_out"] == {"needs a robot and a human": [str(out / "gen1" / "session.mcap")]}
    gen1 = measure(open_recording(out / "gen1" / "session.0.mcap"))
    assert (gen1.values["CR"], gen1.moments["collision"]) == (1, 188)
    distances = open_recording(out / "gen1" / "session.0.mcap").columns
    for k in (0, 1):  # Habitat's own distances tell the same
        near = distances[f"metrics.object_to_goal_distance.{k}"] < 0.3
        np.testing.assert_array_equal(distances["metrics.at_goal"][:, k], near)
