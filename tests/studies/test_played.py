"""What is made of a study that has been played: status, report, ranks, and the removal of somebody who asks for it."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
import shutil
import sqlite3
import zipfile
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pytest

from h3data.errors import InputError
from h3data_pipelines.cli import main
from h3data_studies.commands.handing_out import StudyData, StudyPay
from h3data_studies.commands.managing import StudyForget, StudyStatus, payments_folder
from h3data_studies.commands.reporting import StudyCompare, StudyReport, _by_policy, _shipped
from h3data_studies.commands.running import keep_design, running
from h3data_studies.files import bots_folder, open_store, open_study, read_design
from h3data_viewers.html_report.episode import ReportEpisode
from sim_kinematic.policies.learned import network_of
from tests.studies.played import NOTHING, pid, play_study
from tests.studies.tiny import tiny, write_tiny

FORMS = [
    {"builtin": "nasa_tlx"},
    {
        "id": "you",
        "after": "end",
        "items": [
            {"id": "age", "text": "Age", "kind": "number", "min": 18, "max": 120},
            {"id": "words", "text": "Anything else?", "kind": "text"},
        ],
    },
]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    conditions = [{"name": name, "partner": name, "rules": {"objects": 1}} for name in ("solo", "still")]
    return play_study(tmp_path_factory.mktemp("study"), 2, unfinished=1, forms=FORMS, conditions=conditions)


def copied(study: Path, folder: Path) -> Path:
    shutil.copytree(study.parent, folder, dirs_exist_ok=True)
    return folder / study.name


@pytest.mark.slow
def test_status_says_who_is_where(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = StudyStatus(study).run().data
    assert data["statuses"]["complete"] == 2
    assert data["statuses"]["active"] == 1
    assert data["bots"] == 3
    assert [(c["episodes"], c["planned"], c["success"]) for c in data["conditions"]] == [(3, 4, 3), (2, 4, 2)]
    active = next(p for p in data["participants"] if p["status"] == "active")
    assert active["stage"] == "form/1/nasa_tlx"
    assert main(["study", "status", str(study.parent / "tiny-1")]) == 0
    text = capsys.readouterr().out
    assert "3 participants scripted (bots)" in text
    assert "solo       3 of 4" in text


def test_the_report_has_the_papers_table_and_the_questionnaires(study: Path, tmp_path: Path) -> None:
    outcome = StudyReport(study, out=tmp_path / "out", pictures=0).run()
    assert outcome.data["participants"] == 2, "who has not finished does not count"
    assert outcome.data["analysis"]["episodes"] == {"solo": 2, "still": 2}
    assert outcome.data["analysis"]["estimates"]["RE"]["solo"]["mean"] == 100
    assert [(m["form"], m["condition"], m["people"]) for m in outcome.data["forms"]] == [
        ("nasa_tlx", "solo", 2),
        ("nasa_tlx", "still", 2),
    ]
    assert "are scripts (bots)" in outcome.text
    html = (tmp_path / "out" / "report.html").read_text()
    assert "Questionnaires" in html
    assert "Human-in-the-loop study" in html
    assert "scripted participants" in html
    rows = list(csv.reader((tmp_path / "out" / "answers.csv").read_text().splitlines()))
    assert NOTHING["text"] not in [row[-1] for row in rows], "free text is left out"
    assert [row[-1] for row in rows if row[3] == "age"] == ["30", "30"]
    assert json.loads((tmp_path / "out" / "study.json").read_text())["participants"] == 2
    everybody = StudyReport(study, out=tmp_path / "all", pictures=0, everybody=True, free_text=True).run()
    assert everybody.data["analysis"]["episodes"] == {"solo": 3, "still": 2}
    assert NOTHING["text"] in (tmp_path / "all" / "answers.csv").read_text().replace('""', '"')


def changed(study: Path, folder: Path, statement: str, *values: object) -> Path:
    """A copy of the study of which the database has been changed."""
    path = copied(study, folder)
    db = sqlite3.connect(folder / "tiny-1" / "study.sqlite")
    db.execute(statement, values)
    db.commit()
    db.close()
    return path


def test_answers_are_exported_where_every_episode_came_late(study: Path, tmp_path: Path) -> None:
    late = "update rows set data = json_set(data, '$.slipped', 9999) where stage like 'episode/%'"
    path = changed(study, tmp_path / "late", late)
    outcome = StudyReport(path, pictures=0).run()
    out = tmp_path / "late" / "tiny-1" / "report"
    tables = ["answers.csv", "checks.csv", "focus.csv", "participants.csv", "study.json", "trials.csv"]
    assert sorted(file.name for file in out.iterdir()) == tables
    assert "4 episodes left out: more than 1% of the steps came late." in outcome.data["notes"]
    assert [m["form"] for m in outcome.data["forms"]] == ["nasa_tlx", "nasa_tlx"]
    assert len(list(csv.reader((out / "answers.csv").read_text().splitlines()))) == 1 + 2 * (2 * 6 + 1)
    trials = list(csv.DictReader((out / "trials.csv").read_text().splitlines()))
    assert {row["left_out"] for row in trials} == {"more than 1% of the steps came late"}
    assert {row["late_steps"] for row in trials} == {"9999"}
    with pytest.raises(InputError, match="H3-STUDY-010"):
        StudyCompare(path, tmp_path).run()


def test_each_trial_is_a_row_with_its_place_time_and_metrics(study: Path, tmp_path: Path) -> None:
    StudyReport(study, out=tmp_path / "out", pictures=0).run()
    rows = list(csv.DictReader((tmp_path / "out" / "trials.csv").read_text().splitlines()))
    folder, design = open_study(study)
    people = [p for p in open_store(folder, design).participants.values() if p.progress.status == "complete"]
    assert [row["participant"] for row in rows] == [p.id for p in people for _ in range(2)]
    assert [(row["order"], row["block"], row["trial"]) for row in rows] == [("1", "1", "1"), ("2", "2", "1")] * 2
    for row, block in zip(rows, [b for p in people for b in p.progress.place.blocks], strict=True):
        assert (row["condition"], row["scene"], row["episode"]) == (
            block.condition,
            block.scene,
            str(block.episodes[0]),
        )
        assert datetime.fromisoformat(row["ended_at"]).tzinfo is not None
        assert float(row["seconds"]) == pytest.approx(int(row["steps"]) / 30, abs=1e-3)
        assert row["SR"] == "1.0"
        assert (folder / row["recording"]).is_file()


@pytest.mark.slow
def test_the_page_groups_recordings_by_condition_and_names_no_folder_of_the_machine(
    study: Path, tmp_path: Path
) -> None:
    StudyReport(study.resolve(), out=tmp_path / "out", pictures=1, everybody=True).run()
    html = (tmp_path / "out" / "report.html").read_text()
    assert sorted(re.findall(r"<li>(\w+) \(\d episodes?\)", html)) == ["solo", "still"]
    assert "CR: collision rate" in html.replace("Collision", "collision")
    assert "estimated means with 95% intervals" in html
    assert "Paired differences</h2>" not in html, "people's single recordings are no pairs"
    assert "h3data view recordings/" in html
    for file in (tmp_path / "out").iterdir():
        assert str(study.parent) not in file.read_text()


def test_free_text_is_no_formula(study: Path, tmp_path: Path) -> None:
    words = '=HYPERLINK("http://evil.example","a")'
    path = changed(
        study,
        tmp_path / "evil",
        "update rows set data = json_set(data, '$.answers.words', ?) where stage = 'form/you'",
        words,
    )
    StudyReport(path, pictures=0, free_text=True, out=tmp_path / "out").run()
    answers = [row[-1] for row in csv.reader((tmp_path / "out" / "answers.csv").read_text().splitlines())]
    assert "'" + words in answers
    assert not any(cell.startswith("=") for cell in answers)


def test_weights_are_matched_by_digest_and_shipped_ones_by_name(tmp_path: Path) -> None:
    shipped = network_of("learn_single").digest[:12]
    people = [studied(f"weights:nets/a.npz@{'0' * 12}"), studied(f"weights:copy.npz@{shipped}"), studied("")]
    names = _shipped()
    assert names[shipped] == "learn_single"
    automatic = [
        replace(e, condition="") for e in (studied(f"weights:/elsewhere/b.npz@{'0' * 12}"), studied("learn_single"))
    ]
    first, second = (_by_policy(episodes, names) for episodes in (people, automatic))
    assert [e.condition for e in first] == [second[0].policy, "learn_single", "c"]
    assert [e.condition for e in second] == ["", ""]
    assert second[1].policy == "learn_single"


def studied(policy: str) -> ReportEpisode:
    """An episode of a participant, as far as matching reads it."""
    fields = dict.fromkeys((f.name for f in dataclasses.fields(ReportEpisode)), "")
    return ReportEpisode(**{**fields, "policy": policy, "condition": "c", "participant": "P"})  # type: ignore[arg-type]


def test_what_bots_have_played_is_found_from_the_study_file(study: Path, tmp_path: Path) -> None:
    path = copied(study, tmp_path / "bots")
    own = path.parent / "tiny-1"
    own.rename(bots_folder(own))
    assert open_study(path)[0] == bots_folder(own)
    assert StudyStatus(path).run().data["statuses"]["complete"] == 2
    own.mkdir()
    shutil.copy(bots_folder(own) / "design.json", own)
    with pytest.raises(InputError, match=r"(?s)bots have.*tiny-1-bots.*H3-STUDY-029"):
        StudyStatus(path).run()


@pytest.mark.slow
def test_episodes_that_came_late_are_left_out_and_counted(study: Path, tmp_path: Path) -> None:
    path = copied(study, tmp_path / "late")
    db = sqlite3.connect(tmp_path / "late" / "tiny-1" / "study.sqlite")
    data = json.loads(db.execute("select data from rows where stage = 'episode/1/1' and participant = 1").fetchone()[0])
    db.execute(
        "update rows set data = ? where stage = 'episode/1/1' and participant = 1",
        (json.dumps({**data, "slipped": 99}),),
    )
    db.commit()
    db.close()
    outcome = StudyReport(path, pictures=0, everybody=True).run()
    assert "1 episode left out: more than 1% of the steps came late." in outcome.data["notes"]
    assert sum(c["left_out"] for c in StudyStatus(path).run().data["conditions"]) == 1


@pytest.mark.slow
@pytest.mark.parametrize("by", ["number", pytest.param("recruiting id", marks=pytest.mark.slow)])
def test_forgetting_leaves_no_trace(study: Path, tmp_path: Path, by: str) -> None:
    root = tmp_path / "forget"
    path = copied(study, root)
    folder, design = open_study(path)
    person = open_store(folder, design).participants[1]
    StudyReport(path, pictures=0).run()
    (folder / "recordings" / f".{person.id}_9-01.mcap.saved.mcap").write_bytes(b"x")
    traces = [person.id, *person.ids.values()]
    asked = person.id if by == "number" else pid(0)
    assert found(root, traces)
    before = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}
    dry = StudyForget(path, asked, dry_run=True).run()
    assert {file: file.read_bytes() for file in root.rglob("*") if file.is_file() and file.name != ".running"} == before
    outcome = StudyForget(path, asked).run()
    assert outcome.data["files"] == dry.data["files"]
    assert len(outcome.data["files"]) == 4, "two recordings, what a crash has left, the report"
    assert outcome.data["database"] == {"participants": 1, "rows": 6, "seats": 1, "games": 2}
    assert outcome.data["forms"] == 3
    assert found(root, traces) == []
    assert len(open_store(folder, design).participants) == 2
    StudyReport(path, pictures=0, everybody=True).run()
    with pytest.raises(InputError, match="H3-STUDY-008"):
        StudyForget(path, asked).run()
    again = open_store(folder, design)
    assert again.free_place() == 0, "the place is free again"
    new = again.join("P-NEW", 0, language="en", consent={}, ids={})
    assert new.number == 4, "numbers of people who were forgotten are not given again"


def found(root: Path, traces: list[str]) -> list[Path]:
    """Files below a folder that name somebody, in their content or their name."""
    return [
        file
        for file in root.rglob("*")
        if any(trace in file.name or (file.is_file() and trace.encode() in file.read_bytes()) for trace in traces)
    ]


def test_a_study_that_runs_is_left_alone(study: Path, tmp_path: Path) -> None:
    path = copied(study, tmp_path / "busy")
    folder, design = open_study(path)
    with running(folder):
        with pytest.raises(InputError, match="H3-STUDY-014"):
            StudyForget(path, "P-X").run()
        StudyStatus(path).run()
    with pytest.raises(InputError, match=r"(?s)3 participants.*H3-STUDY-013"):
        keep_design(folder, tiny(episodes=2))
    keep_design(folder, design)


def test_what_is_no_study_is_said_to_be_none(tmp_path: Path, study: Path) -> None:
    with pytest.raises(InputError, match="H3-STUDY-043"):
        StudyStatus(write_tiny(tmp_path)).run()
    with pytest.raises(InputError, match="H3-STUDY-043"):
        StudyStatus(tmp_path).run()
    folder = tmp_path / "tiny-1"
    folder.mkdir()
    keep_design(folder, read_design(study))
    with pytest.raises(InputError, match="H3-STUDY-029"):
        StudyStatus(tmp_path / "study.toml").run()


@pytest.mark.slow
def test_ranks_by_people_stand_beside_ranks_by_automatic_evaluation(tmp_path: Path) -> None:
    conditions = [{"name": "idle", "partner": "still"}, {"name": "helper", "partner": "same_object"}]
    path = play_study(tmp_path, 2, conditions=conditions, scenes=["small:1"])
    zsc = tmp_path / "zsc"
    evaluate = ["evaluate", "rearrange", "--policies", "still,same_object", "--partners", "both", "--episodes", "1"]
    assert main([*evaluate, "--scenes", "small:1", "-o", str(zsc)]) == 0
    outcome = StudyCompare(path, zsc).run()
    (table,) = outcome.data["tables"]
    assert set(table["rows"]) >= {"CR", "RC"}
    assert "same_object" in table["rows"]["RC"]["Order, with people"]
    assert "Kendall" in outcome.text
    other = play_study(tmp_path / "other", 2, conditions=conditions[:1], scenes=["small:1"])
    with pytest.raises(InputError, match="H3-STUDY-011"):
        StudyCompare(other, zsc).run()


RULES = [
    {"name": "inattentive", "what": "failed_checks", "above": 0},
    {"name": "long", "of": "trial", "what": "away_s", "above": 60},
]


def test_the_report_applies_rules_written_beforehand_and_keeps_what_they_leave_out(study: Path, tmp_path: Path) -> None:
    path = copied(study, tmp_path / "ruled")
    folder = path.parent / "tiny-1"
    for file in (folder / "design.json",):
        design = json.loads(file.read_text())
        file.write_text(json.dumps({**design, "exclude": RULES}))
    away = json.dumps({"away": False, "why": "blur", "seconds": 99.0, "stage": "episode/1/1"})
    wrong = "update rows set data = json_set(data, '$.wrong', json('[\"age\"]')) where stage = 'form/you' and participant = 2"
    with sqlite3.connect(folder / "study.sqlite") as db:
        db.execute(wrong)
        db.execute("insert into rows values (1, 'focus/1', 0, ?)", (away,))
    outcome = StudyReport(folder, pictures=0).run()
    out = folder / "report"
    assert "Rule inattentive: 1 participant left out." in outcome.text
    assert "Rule long: 1 episode left out." in outcome.text
    assert "1 of 2 participants left out by rules written beforehand." in outcome.text
    data = json.loads((out / "study.json").read_text())
    assert (data["participants"], data["excluded_by_rule"]) == (1, {"inattentive": 1, "long": 1})
    trials = list(csv.DictReader((out / "trials.csv").read_text().splitlines()))
    assert len(trials) == 4
    assert sorted(row["left_out"].partition(" (")[0] for row in trials) == ["", *["rule inattentive"] * 2, "rule long"]
    people = list(csv.DictReader((out / "participants.csv").read_text().splitlines()))
    assert [row["status"] for row in people] == ["complete", "complete", "active"], "everybody, whatever became of them"
    assert [bool(row["excluded"]) for row in people] == [False, True, False]
    assert len(list(csv.DictReader((out / "focus.csv").read_text().splitlines()))) == 1
    assert {row["participant"] for row in csv.DictReader((out / "answers.csv").read_text().splitlines())} == {
        row["participant"] for row in people[:2]
    }
    if (out / "report.html").is_file():
        assert "Left out by rules" in (out / "report.html").read_text()


def test_codes_are_unique_and_bonuses_go_to_those_who_finished(study: Path, tmp_path: Path) -> None:
    path = copied(study, tmp_path / "paid")
    folder = path.parent / "tiny-1"
    design = json.loads((folder / "design.json").read_text())
    with pytest.raises(InputError, match="H3-STUDY-006"):
        StudyPay(folder, ids=write(tmp_path / "a.csv", pid(0))).run()
    design |= {"bonus": {"base": 0.5, "per_success": 0.25, "most": 0.9}}
    design["recruiting"]["unique_codes"] = True
    (folder / "design.json").write_text(json.dumps(design))
    out = Path(StudyPay(folder).run().data["out"])
    assert out == payments_folder(folder)
    assert not (out / "bonus.csv").exists()
    codes = {row["participant"]: row for row in csv.DictReader((out / "codes.csv").read_text().splitlines())}
    given = [row["code"] for row in codes.values() if row["status"] == "complete"]
    assert len(set(given)) == len(given) == 2
    assert all(re.fullmatch("[A-Z2-7]{10}", code) for code in given)
    assert [row["code"] for row in codes.values() if row["status"] != "complete"] == [""]
    first = next(row for row in codes.values())
    exported = f"Participant id,Completion code\n{pid(0)},{first['code']}\n{pid(1)},WRONG\n{pid(2)},\n{pid(77)},\n"
    outcome = StudyPay(folder, ids=write(tmp_path / "export.csv", exported)).run()
    assert (out / "bonus.csv").read_text() == f"{pid(0)},{first['bonus']}\n"
    assert first["bonus"] == "0.90"
    assert f"{pid(1)} has finished, but gave the code WRONG" in outcome.text
    assert f"{pid(2)} has not finished" in outcome.text
    with pytest.raises(InputError, match="H3-STUDY-004"):
        StudyPay(folder, ids=write(tmp_path / "b.csv", "name,age\nA,3\n")).run()
    forgotten = StudyForget(folder, pid(0)).run()
    assert not out.exists(), "it has the id of who is forgotten"
    assert str(out) in forgotten.text


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_participant_gets_all_of_their_own_data_and_nothing_of_others(study: Path, tmp_path: Path) -> None:
    outcome = StudyData(study, pid(0), out=tmp_path / "own.zip").run()
    folder, design = open_study(study)
    me, other = (person.id for person in list(open_store(folder, design).participants.values())[:2])
    with zipfile.ZipFile(tmp_path / "own.zip") as file:
        names = set(file.namelist())
        data = json.loads(file.read("participant.json"))
        everything = b"".join(map(file.read, names))
    assert {"README.txt", "participant.json", "consent.txt"} < names
    assert {name for name in names if name.startswith("recordings/")} == {
        f"recordings/{path.name}" for path in (folder / "recordings").glob(f"{me}_*.mcap")
    }
    assert outcome.data["recordings"] == 2
    assert data["participant"] == me
    assert {entry["what"] for entry in data["entries"]} >= {"device", "episode/1/1", "form/you"}
    words = next(entry for entry in data["entries"] if entry["what"] == "form/you")
    assert words["data"]["answers"]["words"] == NOTHING["text"]
    assert other.encode() not in everything
    assert pid(0).encode() not in everything, "the study does not know it"
    with pytest.raises(InputError, match="H3-STUDY-008"):
        StudyData(study, "P-NOBODY", out=tmp_path / "no.zip").run()
