"""Schedules on many cores, and the command that reckons with them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data_pipelines.cli import main
from h3data_pipelines.machine.schedule import Workload, simulate_schedule

LOAD = Workload(shards=4000, shard_s=1.0, scenes=10, scene_s=0.0, start_s=0.0, driver_s=0.0)
COSTS = {
    "task": "social_nav",
    "start_s": 0.7,
    "scene_s": 0.5,
    "episode_s": 0.02,
    "step_s": 0.0005,
    "steps": 600.0,
    "frame_s": {"robot_arm": 0.003, "human_head": 0.018, "top_down": 0.026},
    "metrics_s": 0.002,
    "driver_s": 0.01,
    "episode_bytes": 40_000.0,
}


def changed(**values: float) -> Workload:
    return Workload(**{**LOAD.__dict__, **values})


def test_free_work_is_divided() -> None:
    for workers in (1, 2, 40, 1000):
        went = simulate_schedule(LOAD, workers)
        assert went.seconds == pytest.approx(4000 / workers)
        assert went.held_up_by == "work"
    assert simulate_schedule(LOAD, 10_000).seconds == pytest.approx(1.0), "no more workers than shards"


def test_one_writer_is_the_end_of_scaling() -> None:
    went = simulate_schedule(changed(driver_s=0.01), 1000)
    assert went.seconds == pytest.approx(40 + 1, rel=0.05)
    assert went.held_up_by == "writer"
    assert simulate_schedule(changed(driver_s=0.01), 1000, datasets=20).seconds < 7


def test_every_worker_sees_every_home_once() -> None:
    went = simulate_schedule(changed(scene_s=5.0), 2)
    assert went.seconds == pytest.approx(4000 / 2 + 5 * 5.0, rel=0.02), (
        "shards go round the homes, so each worker sees half"
    )


def test_long_jobs_go_on_at_the_pace_of_their_second_half() -> None:
    assert simulate_schedule(changed(shards=1_000_000), 100).seconds == pytest.approx(10_000, rel=0.01)


@given(
    st.integers(1, 300),
    st.floats(0.01, 10),
    st.integers(1, 5),
    st.floats(0, 3),
    st.floats(0, 3),
    st.floats(0, 1),
    st.integers(1, 50),
)
def test_bounds(
    shards: int, shard_s: float, scenes: int, scene_s: float, start_s: float, driver_s: float, workers: int
):
    load = Workload(shards=shards, shard_s=shard_s, scenes=scenes, scene_s=scene_s, start_s=start_s, driver_s=driver_s)
    went = simulate_schedule(load, workers)
    assert went.seconds >= start_s + max(shards * shard_s / workers, shards * driver_s, shard_s) - 1e-6
    alone = start_s + shards * (shard_s + scene_s) + shards * driver_s
    assert went.seconds <= alone + 1e-6


def test_the_command_reckons_from_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    costs = tmp_path / "costs.json"
    costs.write_text(json.dumps({"costs": COSTS}))
    words = ["plan", "social_nav", "--costs", str(costs), "--episodes", "20000", "--cores", "1000"]
    assert main([*words, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    rows = data["rows"]
    assert [row["cores"] for row in rows] == [1, 2, 10, 100, 1000]
    assert rows[1]["speedup"] == pytest.approx(2, rel=0.05)
    assert rows[-1]["held_up_by"] == "writer"
    assert main(words) == 0
    assert "--datasets" in capsys.readouterr().out
    assert main([*words, "--camera", "robot_arm", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["seconds"] > 3 * rows[0]["seconds"]
    for wrong in (["--camera", "nose"], ["--cores", "0"], ["--datasets", "0"]):
        assert main([*words, *wrong]) == 2
    costs.write_text("{}")
    assert main(words) == 2
    assert main(["plan", "rearrange", "--costs", str(tmp_path / "none.json")]) == 2


@pytest.mark.slow
def test_costs_are_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "social_nav", "--measure", "--json"]) == 0
    costs = json.loads(capsys.readouterr().out)["costs"]
    assert all(
        value > 0 for value in [*costs["frame_s"].values(), costs["step_s"], costs["driver_s"], costs["metrics_s"]]
    )
    assert costs["frame_s"]["robot_arm"] < costs["frame_s"]["human_head"]
