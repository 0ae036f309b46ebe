"""``h3data evaluate social_nav``: every policy in the same episodes, resumed, beside the paper's numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.metrics import measure, measure_files, measure_many
from h3data.metrics.paper.profiles import SOCIAL_NAV_PROFILE
from h3data.metrics.paper.protocol import REARRANGEMENT_PROTOCOL, SOCIAL_NAV_PROTOCOL, protocol_deviations
from h3data.recording import Agent, Episode, Recording
from h3data_pipelines.cli import main
from h3data_pipelines.jobs.cross_play import cross_play_table
from h3data_pipelines.jobs.evaluations import chosen_names, files_of
from h3data_pipelines.jobs.policy_table import policy_table
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.policies.network import Network, save_network
from sim_kinematic.tasks.episode import rules_dict, with_options
from sim_kinematic.tasks.registry import find_task

METRICS = ("S", "SPS", "F", "CR", "BYR", "TD", "FD")
RULES = ("--scenes", "h3-homes/val#1", "--max-steps", "150", "--json")


def run_json(capsys: pytest.CaptureFixture[str], *args: object, code: int = 0) -> dict[str, Any]:
    capsys.readouterr()
    assert main([str(a) for a in args]) == code
    return json.loads(capsys.readouterr().out)


def test_it_says_what_generate_and_metrics_say_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, ds = tmp_path / "table", tmp_path / "ds"
    evaluate = ("evaluate", "social_nav", *RULES, "--policies", "rollout_expert,stand_still", "-o", out)
    assert run_json(capsys, *evaluate, "--episodes", "1")["new"] == 1
    result = run_json(capsys, *evaluate, "--episodes", "2")
    assert (result["episodes"], result["new"], result["failed"]) == (2, 1, [])
    run_json(capsys, "generate", "social_nav", *RULES, "--policy", "rollout_expert", "--episodes", "2", "-o", ds)
    for name, summary in measure_files([ds]).summary().items():
        cell = next(c for c in result["cells"] if (c["policy"], c["metric"]) == ("rollout_expert", name))
        assert cell["mean"] == pytest.approx(summary.mean, nan_ok=True)
        assert cell["low"] == pytest.approx(summary.low, nan_ok=True)
        assert cell["episodes"] == summary.count
    stored = json.loads((out / "episodes" / "000001.json").read_text())
    assert stored["created_by"] == f"h3data {version('h3data')}"
    assert (stored["origin"]["split"], len(stored["origin"]["sha256"])) == ("val", 64)
    assert result["created_by"] == [stored["created_by"]]
    assert result["job"]["set"]["sha256"] == stored["origin"]["sha256"]
    assert (result["job"]["task"], result["job"]["scenes"]) == ("social_nav", "h3-homes/val#1")
    assert result["job"]["spec"]["max_steps"] == 150
    text = (out / "table.txt").read_text()
    assert "max_steps 150 (paper 1500)" in text
    assert "human.speed_mps 1.3 (paper 2.5)" in text
    assert "Heuristic Expert" in text
    assert "0.97" in text
    assert run_json(capsys, *evaluate, "--episodes", "2")["new"] == 0
    assert "other options" in run_json(capsys, *evaluate, "--human", "male_0", "--episodes", "2", code=2)["error"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("social_nav", "--policies", "magic"), "sampling_expert"),
        (("social_nav", "--policies", ","), "--policies: expected at least one value, got an empty text"),
        (("social_nav", "--partners", "both"), "Unknown partner 'both'. Expected one of: waypoints"),
        (("social_nav", "--scenes", "nowhere"), "h3-homes/test"),
        (("social_nav", "--max-steps", "0"), "--max-steps must be at least 1, got 0"),
        (("social_nav", "--seed", "-1"), "--seed must be at least 0, got -1"),
        (("social_nav", "--human-speed", "0"), "--human-speed must be above 0"),
        (("skill", "--max-steps", "0"), "--max-steps must be at least 1, got 0"),
        (("dance",), "Expected one of: social_nav, rearrange, wander"),
    ],
)
def test_bad_options_are_refused(
    options: tuple[str, ...], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told in run_json(capsys, "evaluate", *options, "--json", "-o", tmp_path / "x", code=2)["error"]
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("who", ["policies", "partners"])
def test_every_policy_and_partner_plays(who: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = () if who == "policies" else ("--policies", "still", "--partners", "all")
    rules = ("--scenes", "h3-homes/val#1", "--max-steps", "2", "--episodes", "1", "--json", *one)
    result = run_json(capsys, "evaluate", "social_nav", *rules, "-o", tmp_path / "table")
    assert result["failed"] == []
    assert ("wander" in {cell["policy"] for cell in result["cells"]}) == (who == "policies")


def test_all_may_stand_beside_other_names() -> None:
    there = ("complement", "still")
    assert chosen_names(["all"], there) == there
    assert chosen_names(["still", "all"], there) == ("still", "complement")
    assert chosen_names(["all", "my_package:MyPolicy"], there) == (*there, "my_package:MyPolicy")
    with pytest.raises(InputError, match="H3-JOB-050"):
        chosen_names([], there)


def test_results_of_other_weights_in_the_same_file_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, rules = tmp_path / "net.npz", ("--scenes", "h3-homes/val#1", "--max-steps", "2", "--episodes", "1", "--json")
    evaluate = ("evaluate", "social_nav", *rules, "--policies", f"weights:{file}", "-o", tmp_path / "table")
    for turn, code in ((0.5, 0), (0.5, 0), (-0.5, 2)):
        network = Network(
            task="social_nav",
            observations=("humanoid_gps",),
            weights=(np.zeros((2, 2), np.float32),),
            biases=(np.array([1.0, turn], np.float32),),
        )
        save_network(network, file)
        result = run_json(capsys, *evaluate, code=code)
    assert "other options" in result["error"]


def test_a_folder_of_others_is_not_written_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "table.txt").write_text("mine")
    error = run_json(capsys, "evaluate", "social_nav", *RULES, "--episodes", "1", "-o", tmp_path, code=2)["error"]
    assert "not empty" in error
    assert [file.name for file in tmp_path.iterdir()] == ["table.txt"]


def test_failed_episodes_are_tried_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules = ("--policies", "stand_still", "--episodes", "2", "--homes", "2", "--max-steps", "2", "--json")
    evaluate = ("evaluate", "social_nav", "--scenes", "small", *rules, "-o", tmp_path)
    first = run_json(capsys, *evaluate)
    file = tmp_path / "episodes" / "000001.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "failed": ["boom"], "rows": []}))
    again = run_json(capsys, *evaluate)
    assert (again["new"], again["failed"], again["cells"]) == (1, [], first["cells"])


def test_without_results_there_is_no_table_and_no_paper() -> None:
    for table in (policy_table(SOCIAL_NAV_PROFILE, []), cross_play_table([])):
        assert table.to_text() == "No episode could be played: there is no table."


def test_policies_of_several_training_seeds_are_one_row() -> None:
    def row(policy: str, s: float, fd: float | None) -> dict[str, Any]:
        return {"policy": policy, "values": dict.fromkeys((m.name for m in SOCIAL_NAV_PROFILE.metrics), s) | {"FD": fd}}

    rows = [row("expert", 1.0, 1.0), row("a", 1.0, None), row("a", 1.0, None), row("b", 1.0, 2.0), row("b", 0.0, 4.0)]
    table = policy_table(SOCIAL_NAV_PROFILE, rows, {"weights:*": ("a", "b")})
    lines = table.to_text().splitlines()
    assert [line.split("  ")[0] for line in lines[1:3]] == ["expert", "weights:* (2 seeds)"]
    assert "standard deviation" in lines[0]
    assert "0.75 ± 0.35" in lines[2]  # of 1 and 0.5, not of four episodes
    assert lines[2].split()[-1] == "3.00"  # a alone has no following distance: one mean has no deviation
    pooled = {cell["metric"]: cell for cell in table.to_dict()["seeds"]}
    assert pooled["S"]["mean"] == 0.75
    assert [seed["mean"] for seed in pooled["S"]["seeds"]] == [1.0, 0.5]
    assert pooled["FD"]["deviation"] is None
    assert len(table.to_dict()["cells"]) == 3 * len(SOCIAL_NAV_PROFILE.metrics)


def test_a_pattern_names_files_of_weights(tmp_path: Path) -> None:
    for seed in (2, 0, 1):
        (tmp_path / f"s{seed}").mkdir()
        (tmp_path / f"s{seed}" / "policy.npz").write_text("")
    (tmp_path / "s9").mkdir()
    (tmp_path / "s[1]").write_text("")
    pattern = f"weights:{tmp_path}/s*/policy.npz"
    assert files_of(pattern) == tuple(f"weights:{tmp_path}/s{seed}/policy.npz" for seed in (0, 1, 2))
    for name in ("rollout_expert", "my_package:NET", f"weights:{tmp_path}/none.npz", f"weights:{tmp_path}/s[1]"):
        assert files_of(name) == (name,)
    with pytest.raises(InputError, match="H3-JOB-031"):
        files_of(f"weights:{tmp_path}/x*/policy.npz")


def test_only_deviations_from_the_protocol_are_mentioned() -> None:
    spec = {"max_steps": 1500, "spawn_distance_m": 5.0, "human": {"speed_mps": 2.5}, "unknown": 3}
    agents = (Agent(name="robot", kind="robot"), Agent(name="human", kind="human"))
    episode = Episode(uid="u", episode_id="e", task="social_nav", scene="s", info={"spec": spec})
    pose = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (2, 1))
    columns = {"time_ns": np.arange(2), "agent_0.base_pose": pose, "agent_1.base_pose": pose}
    recording = Recording(episode=episode, agents=agents, columns=columns)
    assert protocol_deviations(recording, SOCIAL_NAV_PROTOCOL) == ""
    other = {**spec, "spawn_distance_m": 3.0, "human": {"speed_mps": 1.0}}
    changed = replace(recording, episode=replace(episode, info={"spec": other}), agents=agents[1:])
    assert protocol_deviations(changed, SOCIAL_NAV_PROTOCOL) == (
        "spawn_distance_m 3.0 (paper 5.0), human.speed_mps 1.0 (paper 2.5), agents human (paper robot, human)"
    )
    assert measure(recording).protocol_deviations == ""
    assert measure(replace(changed, agents=agents), "field").protocol_deviations == ""
    assert "human.speed_mps 1.0 (paper 2.5): 1 episode" in measure_many([replace(changed, agents=agents)]).to_text()


@pytest.mark.parametrize(
    ("task", "protocol"), [("social_nav", SOCIAL_NAV_PROTOCOL), ("rearrange", REARRANGEMENT_PROTOCOL)]
)
def test_the_papers_rules_do_not_differ_from_the_paper(task: str, protocol: Mapping[str, Any]) -> None:
    def deviations(rules: str) -> str:
        spec = rules_dict(with_options(find_task(task).Spec(), rules=rules))
        episode = Episode(uid="u", episode_id="e", task=task, scene="s", info={"spec": spec})
        agents = (Agent(name="robot", kind="robot"), Agent(name="human", kind="human"))
        pose = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (2, 1))
        columns = {"time_ns": np.arange(2), "agent_0.base_pose": pose, "agent_1.base_pose": pose}
        return protocol_deviations(Recording(episode=episode, agents=agents, columns=columns), protocol)

    assert deviations("paper") == ""
    assert deviations("natural") != ""


def test_the_papers_people_are_touched_at_their_bones() -> None:
    natural, paper = (with_options(SocialNavSpec(), rules=name) for name in ("natural", "paper"))
    assert (natural.person_contact, paper.person_contact) == ("body", "bones")
    assert with_options(paper, rules="natural") == natural
    whole = with_options(paper, person_contact="body")
    assert "person_contact" not in repr(whole)  # episodes from before keep their identity
    assert repr(paper) == repr(whole)[:-1] + ", person_contact='bones')"
    assert "person_contact" not in rules_dict(whole)
    assert rules_dict(paper)["person_contact"] == "bones"
    with pytest.raises(InputError, match="H3-SIM-057"):
        with_options(paper, person_contact="skin")


def test_rearrangement_with_learned_skills_or_with_agents_that_heed_each_other_is_not_the_papers() -> None:
    def deviations(*, kinds: tuple[Literal["robot", "human"], ...] = ("robot", "human"), **spec: Any) -> str:
        episode = Episode(uid="u", episode_id="e", task="rearrange", scene="s", info={"spec": spec})
        agents = tuple(Agent(name=kind, kind=kind) for kind in kinds)
        pose = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (2, 1))
        poses = {f"agent_{k}.base_pose": pose for k in range(len(agents))}
        return protocol_deviations(
            Recording(episode=episode, agents=agents, columns={"time_ns": np.arange(2), **poses}),
            REARRANGEMENT_PROTOCOL,
        )

    assert deviations(people_give_way=False) == deviations() == ""
    assert deviations(people_give_way=True) == "agents give way to each other (paper: they do not)"
    assert deviations(skills="learned@647e4d47bdec") == "learned skills (paper: oracle skills)"
    alone = deviations(kinds=("human",), people_give_way=True, skills="learned@647e4d47bdec")
    assert alone == "agents human (paper robot, human)"


def test_what_is_undefined_does_not_count() -> None:
    rows: list[dict[str, Any]] = [
        {"policy": "p", "values": dict.fromkeys((m.name for m in SOCIAL_NAV_PROFILE.metrics), value) | {"FD": fd}}
        for value, fd in ((1.0, None), (0.0, 1.5))
    ]
    cells = policy_table(SOCIAL_NAV_PROFILE, rows).cells
    assert cells["p", "FD"].count == 1
    assert cells["p", "FD"].mean == 1.5
    assert cells["p", "CR"].mean == 0.5
    assert not math.isnan(cells["p", "S"].low)
