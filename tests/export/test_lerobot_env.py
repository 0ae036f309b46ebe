"""The environment that lerobot-eval plays, without lerobot: `make check-lerobot` trains and evaluates with it."""

from __future__ import annotations

import json
import runpy
import sys
import tomllib
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import h3data
from h3data.errors import InputError
from h3data.recording import Dataset
from h3data_pipelines.cli import main
from lerobot_env_h3data import ENV_ID
from lerobot_env_h3data.env import LeRobotEnv, make_vector
from tests.paths import ROOT


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("demos")
    h3data.generate("social_nav", root / "ds", scenes=["small:3"], episodes=2, seed=5, max_steps=8, spawn_distance=2.0)
    h3data.export(root / "ds", root / "demos", to="lerobot", cameras=["robot_arm_rgb@32x24"])
    return root / "demos"


def test_lerobot_finds_the_package_by_its_name() -> None:
    project = tomllib.loads((ROOT / "pipelines" / "lerobot_env_h3data" / "pyproject.toml").read_text())["project"]
    assert project["name"].startswith("lerobot_env_"), "lerobot compares the name as it is written"
    assert project["name"] == project["name"].lower() == "lerobot_env_h3data", "and imports a module of that name"
    assert project["version"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert "lerobot" not in sys.modules


def test_it_keeps_lerobots_contract(demos: Path) -> None:
    env = gymnasium.make(ENV_ID, dataset=str(demos), episodes="recorded")
    assert isinstance(env, LeRobotEnv), "no wrapper hides the attributes that lerobot reads"
    assert env.task_description == "follow the person"
    assert env.metadata["render_fps"] == 30
    columns = Dataset(demos)[1].columns
    shown, info = env.reset(seed=1, options={"lerobot_new_rollout": True})
    assert info["is_success"] is False
    assert shown["pixels"]["robot_arm_rgb"].shape == (24, 32, 3)
    steps = 0
    for state, action in zip(columns["observation.state"], columns["action"], strict=True):
        assert env.observation_space.contains(shown)
        assert np.array_equal(shown["agent_pos"], state)
        shown, _, terminated, truncated, info = env.step(action)
        steps += 1
    assert steps == env._max_episode_steps
    assert (terminated, truncated) == (False, True)


def test_worlds_tell_success_in_their_last_step(demos: Path) -> None:
    worlds = make_vector(demos, 2, episodes="recorded", cameras=[])
    worlds.reset(seed=[0, 1])
    assert worlds.call("_max_episode_steps") == (7, 7)
    for _ in range(7):
        shown, _, _, truncated, info = worlds.step(np.zeros((2, 2), np.float32))
    assert truncated.all()
    assert info["final_info"]["is_success"].tolist() == [False, False]
    assert set(shown) == {"agent_pos"}


def test_evaluated_episodes_are_recorded_and_no_others(demos: Path, tmp_path: Path) -> None:
    worlds = make_vector(demos, 2, episodes="recorded", cameras=[], record=str(tmp_path / "played"))
    worlds.reset(seed=[0, 1])
    for _ in range(20):  # more than two episodes each
        worlds.step(np.zeros((2, 2), np.float32))
    assert sorted(file.name for file in (tmp_path / "played").iterdir()) == ["0-0.mcap", "1-0.mcap"]


@pytest.mark.parametrize(
    "action", [np.full((2, 2), np.nan), np.full((2, 2), np.inf), np.zeros((2, 3)), np.zeros((2, 1))]
)
def test_malformed_actions_of_policies_are_refused(demos: Path, action: np.ndarray) -> None:
    worlds = make_vector(demos, 2, cameras=[])
    worlds.reset(seed=1)
    with pytest.raises(InputError, match="H3-ENV-0"):
        worlds.step(action.astype(np.float32))


def test_what_is_no_export_is_refused(tmp_path: Path, demos: Path) -> None:
    with pytest.raises(h3data.errors.H3DataError):
        LeRobotEnv(tmp_path)
    with pytest.raises(InputError, match=r"(?s)robot_leg.*H3-ENV-047"):
        LeRobotEnv(demos, cameras=["robot_leg"])


def test_push_writes_the_environment_of_a_dataset(
    demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "env"
    words = ["push", str(demos), "user/name", "--env", str(out), "--dry-run"]
    assert main([*words, "--json"]) == 0
    assert {Path(path).name for path in json.loads(capsys.readouterr().out)["plan"]["env"]} == {
        "env.py",
        "requirements.txt",
        "README.md",
    }
    monkeypatch.setenv("H3DATA_ENV_DATASET", str(demos))
    module = runpy.run_path(str(out / "env.py"))
    assert module["REPO"] == "user/name"
    worlds = module["make_env"](n_envs=2)
    shown, _ = worlds.reset(seed=1)
    assert shown["pixels"]["robot_arm_rgb"].shape == (2, 24, 32, 3)
    assert main(words) == 0, "the same again"
    (out / "env.py").write_text("mine")
    assert main(words) == 2
    assert (out / "env.py").read_text() == "mine"
    assert main(["push", str(demos.with_name("ds")), "user/name", "--env", str(tmp_path / "no"), "--dry-run"]) == 2
    assert not (tmp_path / "no").exists()
