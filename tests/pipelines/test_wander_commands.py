"""``h3data generate wander``: any cast, the same episodes again, failures that are told, bodies that are drawn."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import h3data
from h3data.bodies.people.humanoid_file import ADULTS
from h3data.recording import Dataset, recordings_equal
from h3data_pipelines.cli import main
from h3data_pipelines.commands.generate import Generate
from sim_kinematic.tasks import wander

WANDER = ("generate", "wander", "--homes", "2", "--seed", "3", "--max-steps", "20", "--json", "-o")


def run_json(capsys: pytest.CaptureFixture[str], *args: object, code: int = 0) -> dict[str, Any]:
    capsys.readouterr()
    assert main([str(a) for a in args]) == code
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_a_cast_of_three_is_resumed_logged_measured_and_simulated_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cast = ("--agents", "robot,human,male_1", "--human", "female_1")
    whole = run_json(capsys, *WANDER, tmp_path / "a", *cast, "--episodes", "3", "--mcap")
    run_json(capsys, *WANDER, tmp_path / "b", *cast, "--episodes", "1")
    rest = run_json(capsys, *WANDER, tmp_path / "b", *cast, "--episodes", "3", "--resume", "--workers", "2")
    assert (rest["new"], rest["steps"], rest["failed"]) == (2, 60, [])
    assert rest["state_hashes"] == whole["state_hashes"]
    assert len(set(whole["state_hashes"])) == 3
    for k in range(3):
        a, b = (h3data.open(tmp_path / name).recording(k) for name in "ab")
        assert recordings_equal(a, b) == []
        assert recordings_equal(a, h3data.open(tmp_path / "a" / "mcap" / f"{k:06d}.mcap")) == []
        assert [agent.model for agent in a.agents] == ["robot/quad_arm", "humanoid/female_1", "humanoid/male_1"]
        assert a.episode.info["ended"] == "max_steps"
    assert whole["metrics"]["profile"] == "task"
    assert run_json(capsys, "replay", tmp_path / "b", "--verify", "--json")["equal"] == 3
    other = run_json(capsys, *WANDER, tmp_path / "b", "--agents", "robot", "--episodes", "3", "--resume", code=2)
    assert "agents was ['robot', 'female_1', 'male_1'], is ['robot']" in other["error"]


def test_a_single_agent_is_measured_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = run_json(capsys, *WANDER, tmp_path / "ds", "--agents", "lift_arm", "--episodes", "1")
    values = made["metrics"]["episodes"][0]["values"]
    assert (made["episodes"], made["steps"], values["steps"], values["success"]) == (1, 20, 20, None)


def test_a_set_gives_its_scenes_and_its_seeds() -> None:
    jobs = Generate(task="wander", out=Path("ds"), scenes=("h3-homes/val",), episodes=7).jobs()
    again = Generate(task="rearrange", out=Path("ds"), scenes=("h3-homes/val",), episodes=7).jobs()
    assert [(j.index, j.seed, j.scene, j.origin) for j in jobs] == [(j.index, j.seed, j.scene, j.origin) for j in again]
    others = Generate(task="wander", out=Path("ds"), scenes=("h3-homes/val",), episodes=7, seed=1).jobs()
    assert {j.seed for j in others}.isdisjoint(j.seed for j in jobs)


def test_each_person_draws_a_body_that_does_not_depend_on_how_many_episodes_there_are() -> None:
    def bodies(episodes: int) -> list[Any]:
        options = {"agents": ("human", "robot", "human"), "human": "any", "homes": 1}
        return [
            job.to_json()["agents"]
            for job in Generate(task="wander", out=Path("ds"), episodes=episodes, **options).jobs()
        ]

    drawn = bodies(60)
    assert drawn[:5] == bodies(5)
    assert {names[1] for names in drawn} == {"robot"}
    assert {names[0] for names in drawn} == {names[2] for names in drawn} == set(ADULTS)
    assert any(names[0] != names[2] for names in drawn)


def test_an_episode_that_raises_is_listed_and_the_others_are_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fine = run_json(capsys, *WANDER, tmp_path / "fine", "--episodes", "3")
    seeds = [recording.episode.seed for recording in Dataset(tmp_path / "fine")]
    played = wander.Wander.sample

    def breaks(*args: Any) -> Any:
        if seeds.index(args[3]) + 1 in broken:
            raise RuntimeError("boom")
        return played(*args)

    monkeypatch.setattr(wander.Wander, "sample", breaks)
    for broken in ({1}, {1, 2}, {3}):
        out = tmp_path / str(len(list(tmp_path.iterdir())))
        made = run_json(capsys, *WANDER, out, "--episodes", "3", code=1)
        kept = [h if k + 1 not in broken else "" for k, h in enumerate(fine["state_hashes"])]
        assert made["state_hashes"] == kept
        assert len(made["failed"]) == len(broken)
        index = min(broken) - 1
        recording = h3data.open(out).recording(index)
        assert made["failed"][0].startswith(f"{index:06d} (seed {recording.episode.seed}): RuntimeError: boom (")
        assert (len(recording), recording.episode.info.get("policy")) == (0, None)
        assert [agent.name for agent in recording.agents] == ["robot", "human"]
    broken = {1, 2}
    error = run_json(capsys, *WANDER, tmp_path / "none", "--episodes", "2", code=2)["error"]
    assert "No episode could be played, 2 episodes failed. The first, 000000 in small:0 (seed" in error
    assert "boom" in error


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--policy", "random"), "Unknown policy 'random'"),
        (("--partner", "both"), "Unknown partner 'both'"),
        (("--agents", "robot,humen"), "Did you mean 'human'?"),
        (("--agents", ""), "expected at least one value"),
        (("--human", "femal_1"), "Did you mean 'female_1'?"),
        (("--scenes", "smal"), "Did you mean 'small'?"),
        (("--episodes", "0"), "at least 1"),
        (("--episodes-file", "x.json.gz"), "leave out --seed"),
        (("--spawn-distance", "-1"), "must not be negative"),
    ],
)
def test_bad_options_are_refused(
    options: tuple[str, ...], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told in run_json(capsys, *WANDER, tmp_path / "x", *options, code=2)["error"]
    assert not (tmp_path / "x").exists()


def test_homes_with_more_joints_and_things_may_come_later(tmp_path: Path) -> None:
    """Columns of a dataset cannot grow, so the widest home determines them before the first episode is played."""
    cast = ("--agents", "robot,human", "--partner", "orca+chores", "--spawn-distance", "1", "--max-steps", "2")
    scenes = ("--scenes", "medium-open:1,medium-open:3", "--episodes", "2")
    assert main(["generate", "wander", *scenes, *cast, "-o", str(tmp_path / "ds")]) == 0
    first, second = (recording.columns["scene.joint_pos"].shape[1] for recording in Dataset(tmp_path / "ds"))
    assert first < second
