"""examples/point_goal.py: a task that the package does not know goes everywhere a built-in one goes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import h3data
from examples.point_goal import PointGoal
from h3data.errors import H3DataError
from h3data_pipelines.cli import main
from sim_kinematic.tasks.episode import StepOutcome

REFERENCE = "examples.point_goal:PointGoal"


def run(capsys: pytest.CaptureFixture[str], *words: Any) -> dict[str, Any]:
    capsys.readouterr()
    code = main([*map(str, words), "--json"])
    out, error = capsys.readouterr()
    assert code == 0, error
    return json.loads(out)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("point_goal") / "pg"
    assert main(["generate", REFERENCE, "--episodes", "3", "--set", "arrive_m=0.4", "-o", str(out), "--json"]) == 0
    return out


def test_it_is_measured_verified_resumed_and_reported(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = run(capsys, "metrics", dataset)["summary"]
    assert summary["success"]["mean"] == 1.0
    assert summary["reward"]["count"] == 3
    assert run(capsys, "replay", dataset, "--verify")["equal"] == 3
    run(capsys, "replay", f"{dataset}#1", "--resume-from", "25", "-o", tmp_path / "again.mcap")
    again, first = h3data.open(tmp_path / "again.mcap"), list(h3data.open(dataset))[1]
    for name, values in first.columns.items():
        np.testing.assert_array_equal(again.columns[name], values, err_msg=name)
    run(capsys, "report", dataset, "--pictures", "0", "-o", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "succeeds in 100" in page
    assert "not measured" not in page


def test_its_rules_and_goal_are_recorded(dataset: Path) -> None:
    for recording in h3data.open(dataset):
        goal = np.array(recording.episode.info["extra"]["goal"])
        end = recording.columns["agent_0.base_pose"][-1, [0, 2]]
        assert recording.episode.info["spec"]["arrive_m"] == 0.4
        assert np.hypot(*(goal - end)) < 0.4
        assert recording.columns["metrics.goal_distance"][-1] < 0.4
        assert [event.kind for event in recording.events if event.kind == "arrived"] == ["arrived"]


@pytest.mark.filterwarnings("ignore:.*Box.*precision", "ignore:.*not within the observation space")
def test_gymnasium_accepts_it() -> None:
    env = h3data.make(REFERENCE, scenes="small:1", observations=("goal_gps", "range_scan"))
    check_env(env.unwrapped, skip_render_check=True)
    batch = h3data.make(REFERENCE, scenes="small:1", observations=("goal_gps",), num_envs=3)
    observation, _ = batch.reset(seed=0)
    assert observation["goal_gps"].shape == (3, 2)
    for _ in range(20):
        _, reward, terminated, _, _ = batch.step(batch.action_space.sample())
        assert reward.shape == terminated.shape == (3,)


class NotANumber(PointGoal):
    """Judges NaN."""

    def judge(self, play: Any) -> StepOutcome:
        good = super().judge(play)
        return StepOutcome(
            reward=good.reward * np.nan, terminated=good.terminated, success=good.success, columns=good.columns
        )


class WrongShape(PointGoal):
    """Judges two worlds where there is one."""

    def judge(self, play: Any) -> StepOutcome:
        good = super().judge(play)
        return StepOutcome(
            reward=good.reward, terminated=np.zeros(2, np.bool_), success=good.success, columns=good.columns
        )


class UndeclaredColumn(PointGoal):
    """Records what it did not declare."""

    columns: ClassVar[Mapping[str, Any]] = {}


class NoOutcome(PointGoal):
    """Forgets to judge."""

    def judge(self, play: Any) -> Any:
        return None


@pytest.mark.parametrize(
    ("task", "says"),
    [
        (NotANumber(), r"(?s)NotANumber\.judge: reward.*nan.*H3-TASK-007"),
        (WrongShape(), r"(?s)WrongShape\.judge: terminated.*\[1\].*\[2\].*H3-TASK-006"),
        (
            UndeclaredColumn(),
            r"(?s)metrics\.disturbs, metrics\.goal_distance.*H3-TASK-003",
        ),
        (NoOutcome(), r"(?s)NoOutcome\.judge.*NoneType.*H3-TASK-068"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_faulty_task_is_named_with_the_field(task: PointGoal, says: str) -> None:
    with pytest.raises(H3DataError, match=says):
        h3data.simulate(task, scenes="small:1")


@pytest.mark.parametrize(
    ("member", "place"),
    [
        ("hindsight", r"EpisodeCodec\.final_info, of Task\.codec,"),
        ("instruction", r"EpisodeCodec\.instruction, of Task\.codec,"),
        ("skills", r"Control\.skills, of Task\.control,"),
        ("default_spec", r"TaskUsage\.dataset_rules, of Task\.usage,"),
        ("end_reason", r"StepOutcome\.ended"),
        ("info_of", r"TaskUsage\.env_info, of Task\.usage,"),
    ],
)
def test_members_of_earlier_tasks_are_refused_with_their_new_place(member: str, place: str) -> None:
    with pytest.raises(H3DataError, match="H3-TASK-070"):
        type("EarlierTask", (PointGoal,), {member: lambda *_: {}})


def test_sensors_that_are_a_method_are_refused() -> None:
    with pytest.raises(H3DataError, match="H3-TASK-093"):
        type("EarlierTask", (PointGoal,), {"sensors": lambda *_: {}})


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("examples.point_goal:PointGaol", "cannot be imported: AttributeError"),
        ("examples.no_such_file:Task", "cannot be imported: ModuleNotFoundError"),
        ("examples.point_goal:drive_to_goal", "to name a subclass of sim_kinematic.tasks.task.Task"),
        ("point_gaol", "Unknown task 'point_gaol'"),
    ],
)
def test_names_that_mean_no_task(name: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", name, "-o", str(tmp_path / "x")]) == 2
    assert says in capsys.readouterr().err
