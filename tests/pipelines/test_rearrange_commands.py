"""``h3data generate rearrange`` and ``h3data evaluate``: the same episodes again, failures that are told, tables."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import h3data
from h3data.recording import recordings_equal
from h3data_pipelines.cli import main
from h3data_pipelines.jobs.cross_play import METRICS, ZSC_COLUMN, ZSC_TEN_COLUMN, Row, cross_play_table
from h3data_pipelines.jobs.episodes import Choices
from h3data_viewers.html_report.report import make_report
from sim_kinematic.policies import rearrange as planners

GENERATE = ("generate", "rearrange", "--scenes", "small", "--homes", "1", "--max-steps", "700", "--json", "-o")
EVALUATE = (
    "evaluate",
    "rearrange",
    "--scenes",
    "h3-homes/test#2",
    "--episodes",
    "1",
    "--policies",
    "complement,still",
    "--partners",
    "object_1,plan_pop_1",
    "--json",
    "-o",
)


def run_json(capsys: pytest.CaptureFixture[str], *args: object, code: int = 0) -> dict[str, Any]:
    capsys.readouterr()
    assert main([str(a) for a in args]) == code
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_generate_resumes_with_the_same_episodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = run_json(capsys, *GENERATE, tmp_path / "a", "--episodes", "2", "--partner", "plan_pop_2")
    assert set(whole["metrics"]["summary"]) == {"SR", "RE", "CR", "RC", "TS"}
    run_json(capsys, *GENERATE, tmp_path / "b", "--episodes", "1", "--partner", "plan_pop_2")
    rest = run_json(capsys, *GENERATE, tmp_path / "b", "--episodes", "2", "--partner", "plan_pop_2", "--resume")
    assert rest["new"] == 1
    assert rest["state_hashes"] == whole["state_hashes"]
    a, b = (h3data.open(tmp_path / name).recording(1) for name in "ab")
    assert recordings_equal(a, b) == []
    assert a.episode.info["partner_plan"] in ("object_1", "object_2")
    other = run_json(capsys, *GENERATE, tmp_path / "b", "--episodes", "2", "--partner", "both", "--resume", code=2)
    assert "partner was plan_pop_2, is both" in other["error"]


def test_an_episode_that_raises_is_marked_and_the_job_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    args = (*GENERATE[:-1], "--rules", "paper", "--policy", "still", "--partner", "still", "--episodes", "2", "-o")
    made = []

    def first_breaks(*_: object) -> planners.HighLevelPolicy:
        made.append(1)
        if len(made) == 1:
            raise RuntimeError("boom")
        return planners.Planner(())

    monkeypatch.setattr("sim_kinematic.tasks.rearrange.task.robot_policy", first_breaks)
    result = run_json(capsys, *args, tmp_path / "broken", code=1)
    assert len(result["failed"]) == 1
    assert "RuntimeError: boom" in result["failed"][0]
    assert "seed" in result["failed"][0]
    broken, fine = (h3data.open(tmp_path / "broken").recording(k) for k in range(2))
    assert len(fine) == 700
    assert len(broken) == 0
    assert "boom" in broken.episode.info["failed"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--policy", "magic"), "greedy_nearest"),
        (("--partner", "nobody"), "plan_pop_3"),
        (("--scenes", "nowhere"), "h3-homes/test"),
        (("--episodes", "0"), "at least 1"),
        (("--agents", "human,nobody"), "quad_arm"),
        (("--agents", "human,human", "--policy", "complement"), "is for a robot, but there is none"),
        (("--agents", "robot,robot", "--partner", "both"), "is for a human, but there is none"),
        (("--agents", "robot", "--policy", "solo"), "Expected a person in --agents"),
        (("--episodes-file", "x.json.gz"), "no such file"),
    ],
)
def test_bad_options_are_refused(
    options: tuple[str, ...], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = ["generate", "rearrange", "--json", "-o", tmp_path / "x", *options]
    assert told in run_json(capsys, *args, code=2)["error"]
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_two_people_are_resumed_only_as_two(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ("generate", "rearrange", "--scenes", "h3-homes/test#2", "--json", "-o", tmp_path / "ds")
    made = run_json(capsys, *args, "--episodes", "1", "--agents", "human,male_1")
    assert (made["episodes"], made["failed"]) == (1, [])
    recording = h3data.open(tmp_path / "ds").recording(0)
    assert [agent.model for agent in recording.agents] == ["humanoid/female_0", "humanoid/male_1"]
    assert (recording.episode.info["policy"], recording.episode.info["partner"]) == ("", "both,both")
    assert made["metrics"]["episodes"][0]["notes"]["RC"] == "there is no robot"
    other = run_json(capsys, *args, "--episodes", "1", "--agents", "human,human,human", "--resume", code=2)
    assert "agents was human,male_1, is human,human,human" in other["error"]


def test_social_nav_has_no_planners(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ("generate", "social_nav", "--partner", "both", "--json", "-o", tmp_path / "x")
    assert "waypoints" in run_json(capsys, *args, code=2)["error"]


def test_one_command_prints_every_robot_with_every_partner(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "pairs"
    first = run_json(capsys, *EVALUATE, out)
    assert first["new"] == 1
    cells = {(c["metric"], c["policy"], c["partner"]): c["mean"] for c in first["cells"]}
    assert len(cells) == len(METRICS) * 2 * 2
    assert cells["SR", "complement", "object_1"] == cells["SR", "complement", "plan_pop_1"] == 1
    assert cells["SR", "still", "object_1"] == 0
    assert cells["RE", "complement", "object_1"] > 100 > cells["RE", "still", "object_1"]
    text = (out / "table.txt").read_text()
    assert "Learn-Single" in text
    assert "159.2" in text
    again = run_json(capsys, *EVALUATE, out)
    assert again["new"] == 0
    assert again["cells"] == first["cells"]
    assert "other options" in run_json(capsys, *EVALUATE, out, "--max-steps", "600", code=2)["error"]
    (out / "episodes" / "000000.json").write_text("{}")
    assert "no result" in run_json(capsys, *EVALUATE, out, code=2)["error"]
    wrong = [*EVALUATE[:6], "--policies", "magic", *EVALUATE[8:], tmp_path / "y"]
    assert "same_object" in run_json(capsys, *wrong, code=2)["error"]


def test_the_zero_shot_column_is_over_the_four_planners() -> None:
    rows = [
        Row(
            index=0,
            policy="p",
            partner=partner,
            plan=partner,
            ended="",
            solo_steps=600,
            state_hash="",
            values={"SR": float(k < 3), "RE": None if k == 0 else 100.0, "CR": 0.0, "RC": 0.5},
        )
        for k, partner in enumerate(planners.ZSC)
    ]
    table = cross_play_table(rows)
    assert table.cells["SR", "p", ZSC_COLUMN].mean == 0.75
    assert table.cells["RE", "p", ZSC_COLUMN].count == 3
    assert "75 [30, 95]" in table.to_text()
    assert ZSC_TEN_COLUMN not in table.partners
    more = [replace(rows[0], partner=partner, plan=partner) for partner in planners.ZSC_TEN[4:]]
    other = [replace(row, policy="q", values={**row.values, "SR": 0.25}) for row in rows]
    seeds = cross_play_table([*rows, *other], seeds={"weights:*": ("p", "q")})
    assert "weights:* (2 seeds)" in seeds.to_text()
    assert "50 ± 35" in seeds.to_text()
    pooled = {(cell["metric"], cell["partner"]): cell["mean"] for cell in seeds.to_dict()["seeds"]}
    assert pooled["SR", ZSC_COLUMN] == 0.5
    ten = cross_play_table([*rows, *more])
    assert len(planners.ZSC_TEN) == 10
    assert ten.cells["SR", "p", ZSC_COLUMN].mean == 0.75
    assert ten.cells["SR", "p", ZSC_TEN_COLUMN].mean == 0.9


@pytest.mark.slow
def test_kept_recordings_and_bare_results_give_the_same_heat_maps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept, bare = tmp_path / "kept", tmp_path / "bare"
    zsc = ("--unseen-partners", "plan_pop_1")
    first = run_json(capsys, *EVALUATE[:-1], *zsc, "--save-recordings", "-o", kept)
    run_json(capsys, *EVALUATE[:-1], *zsc, "-o", bare)
    means = {(c["metric"], c["policy"], c["partner"]): c["mean"] for c in first["cells"]}
    assert means["RC", "complement", "ZSC mean"] == means["RC", "complement", "plan_pop_1"]
    tables = {}
    for folder in (kept, bare):
        report = make_report([folder], pictures=1 if folder is kept else 0, unseen_partners=["plan_pop_1"])
        heat = {t.key: t for t in report.tables_of_partners}
        tables[folder] = {
            k: [(r.name, [c.value for c in r.cells]) for r in t.sections[0].rows] for k, t in heat.items()
        }
        assert set(heat) == {f"partners_rearrange_{name}" for name in ("SR", "RE", "CR", "RC")}
        assert [c.head for c in heat["partners_rearrange_RC"].columns] == ["object_1", "plan_pop_1", "ZSC mean"]
        assert [run.name for run in report.data.runs] == ["complement", "still"]
        assert ("Other partners", 4) in report.tables[0].groups
        assert "complement against still" in [table.title for table in report.tables]  # the same episodes, in pairs
    assert tables[kept] == tables[bare]
    rows = dict(tables[kept]["partners_rearrange_SR"])
    assert rows["complement"] == [means["SR", "complement", p] for p in ("object_1", "plan_pop_1", "ZSC mean")]
    assert main(["report", str(kept), "-o", str(tmp_path / "r.html"), "--pictures", "1"]) == 0
    assert "<h2>Trajectories" in (tmp_path / "r.html").read_text()
    assert main(["report", str(bare), "-o", str(tmp_path / "b.html")]) == 0
    assert "evaluate --save-recordings keeps their recordings" in (tmp_path / "b.html").read_text()
    capsys.readouterr()
    shutil.rmtree(kept / "recordings" / "000000")  # killed before the episode was whole
    again = run_json(capsys, *EVALUATE[:-1], *zsc, "--save-recordings", "--resume", "-o", kept)
    assert (again["new"], again["cells"]) == (1, first["cells"])
    assert (kept / "recordings" / "000000").is_dir()
    assert (
        "no evaluation to go on with"
        in run_json(capsys, *EVALUATE[:-1], "--resume", "-o", tmp_path / "x", code=2)["error"]
    )
    assert (
        "expected partners"
        in run_json(capsys, *EVALUATE[:-1], "--unseen-partners", "both", "-o", tmp_path / "x", code=2)["error"]
    )
    assert main(["report", str(bare), "-o", str(tmp_path / "c.html"), "--unseen-partners", "objekt_1"]) == 2
    assert "Did you mean 'object_1'" in capsys.readouterr().err


@pytest.mark.slow
def test_datasets_of_one_policy_are_one_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ("generate", "rearrange", "--scenes", "h3-homes/test#2", "--episodes", "1", "--policy", "still", "--json")
    for partner in ("object_1", "object_2"):
        run_json(capsys, *common, "--partner", partner, "-o", tmp_path / partner)
    report = make_report([tmp_path / "object_1", tmp_path / "object_2"], pictures=0)
    assert [(run.name, len(run.episodes)) for run in report.data.runs] == [("still", 2)]
    run_json(capsys, *common, "--partner", "object_1", "-o", tmp_path / "again")
    twice = make_report([tmp_path / "object_1", tmp_path / "again"], pictures=0)
    assert [run.name for run in twice.data.runs] == ["still (object_1)", "still (again)"]


def test_oracle_skills_are_played_as_worlds_on_a_device_play_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = ("--scenes", "small:1", "--episodes", "1", "--skills", "oracle", "--max-steps", "700", "--json", "-o")
    run_json(capsys, "generate", "rearrange", *args, tmp_path / "ds")
    spec = h3data.open(tmp_path / "ds").recording(0).episode.info["spec"]
    assert spec["oracle"]
    assert (spec["people_give_way"], spec["human"]["speed_mps"], spec["max_steps"]) == (False, 2.5, 700)
    table = run_json(
        capsys, "evaluate", "rearrange", "--policies", "still", "--partners", "still", *args, tmp_path / "e"
    )
    assert table["failed"] == []
    for task, more, message in (
        ("rearrange", ("--rules", "natural"), "--skills oracle has the paper's people"),
        ("social_nav", (), "no options of social_nav: --skills"),
    ):
        other = run_json(capsys, "evaluate", task, *more, *args, tmp_path / "other", code=2)
        assert message in other["error"]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--set", "objectz=3"], "Unknown rule 'objectz'. Did you mean 'objects'?"),
        (["--set", "objects=2.5"], "Expected the rule objects to be a whole number, as objects=2; got 2.5."),
        (["--set", "at_goal_m=NaN"], "Expected the rule at_goal_m to be a number"),
        (["--set", "end_on_collision=no"], "to be true or false, as end_on_collision=true; got no."),
        (["--set", "near_m=[1]"], "a list of numbers of length 2, as near_m=[2.0, 1.5]; got [1]."),
        (["--set", "max_steps=9", "--max-steps", "8"], "Expected --max-steps or --set max_steps=..., got both."),
        (["--observe", "seen", "--set", "observe=full"], "Expected --observe or --set observe=..., got both."),
    ],
)
def test_rules_of_other_names_and_types_are_refused(
    options: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["generate", "rearrange", "--scenes", "small:1", *options, "-o", str(tmp_path / "ds")]) == 2
    assert expected in capsys.readouterr().err


@pytest.mark.slow
def test_observe_is_the_rule_of_the_same_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ("--scenes", "small:1", "--episodes", "1", "--max-steps", "700", "--observe", "seen", "-o", tmp_path / "ds")
    run_json(capsys, "generate", "rearrange", *args, "--json")
    assert h3data.open(tmp_path / "ds").recording(0).episode.info["spec"]["observe"] == "seen"


def test_rules_are_numbers_words_and_lists() -> None:
    choices = Choices(task="rearrange", overrides=(("max_steps", 90), ("at_goal_m", 1), ("near_m", [1, 2])))
    spec = choices.spec()
    assert (spec.max_steps, spec.at_goal_m, spec.near_m) == (90, 1.0, (1.0, 2.0))
    assert {type(spec.at_goal_m), *map(type, spec.near_m)} == {float}
