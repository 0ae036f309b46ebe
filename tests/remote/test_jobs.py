"""Commands and live play with a policy behind a server."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.recording import Dataset, read_mcap
from h3data_pipelines.cli import main
from h3data_play.live import EpisodeFactory, LiveGame
from h3data_play.plan import GameOrder, PlayPlan
from sim_kinematic.tasks.resume import verify
from tests.remote.scripted_server import answering, follow, followed, websocket_server
from tests.remote.test_policy import adapter

FOLLOW = "tests.remote.scripted_server:follow"


def test_a_dataset_and_an_evaluation_are_those_of_the_policy_in_process(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["social_nav", "--scenes", "small:3", "--episodes", "2", "--max-steps", "20", "--json"]
    with websocket_server(answering(followed, {"name": "net"})) as address:
        hashes = []
        for policy, name in ((address, "far"), (FOLLOW, "near")):
            assert main(["generate", *common, "--policy", policy, "-o", str(tmp_path / name)]) == 0
            hashes.append(json.loads(capsys.readouterr().out)["state_hashes"])
        assert hashes[0] == hashes[1]
        policies = f"{address},{FOLLOW}"
        out = str(tmp_path / "table")
        assert main(["evaluate", *common, "--policies", policies, "--save-recordings", "-o", out]) == 0
    rows = [json.loads(file.read_text())["rows"] for file in sorted(Path(out, "episodes").glob("*.json"))]
    assert all(far["values"] == near["values"] for far, near in rows)
    recordings = [Dataset(folder) for folder in sorted(Path(out, "recordings").iterdir())]
    assert [r.episode.info["policy"].partition("@")[0] for r in recordings[0]] == ["ws:net", FOLLOW]
    for recording in Dataset(tmp_path / "far"):
        assert recording.episode.info["policy"].startswith("ws:net@")
        assert verify(recording).difference is None


def test_an_evaluation_ends_with_what_it_has_when_its_server_goes_for_good(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, served, begun = tmp_path / "table", contextlib.ExitStack(), [0]

    def dying(request: dict[str, Any]) -> dict[str, Any]:
        begun[0] += bool(request["h3data/reset"])
        if begun[0] == 3:
            threading.Thread(target=served.close).start()
            raise ConnectionAbortedError
        return followed(request)

    address = served.enter_context(websocket_server(answering(dying)))
    common = ["--scenes", "small:3", "--episodes", "6", "--max-steps", "10", "--json"]
    assert main(["evaluate", "social_nav", *common, "--policies", address, "-o", str(out)]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["episodes"] == 6
    assert len(told["failed"]) == 4
    assert all(line.startswith(f"episode {k} ") and "olicy server" in line for k, line in enumerate(told["failed"], 2))
    files = [json.loads(file.read_text()) for file in sorted((out / "episodes").glob("*.json"))]
    assert [len(found["rows"]) for found in files] == [1, 1, 0, 0, 0, 0]


def test_a_server_that_is_not_there_is_refused_before_the_first_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with websocket_server(answering(followed)) as address:
        pass
    out = tmp_path / "ds"
    for words in (["generate", "social_nav", "--policy"], ["evaluate", "social_nav", "--policies"]):
        assert main([*words, address, "--scenes", "small:3", "--episodes", "1", "-o", str(out)]) == 2
        assert "No policy server answers" in capsys.readouterr().err
    assert not out.exists()


def test_partners_of_vector_environments_are_asked_together() -> None:
    batches: list[int] = []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        batches.append(len(request.get("batch", [request])))
        return {"batch": [followed(one) for one in request["batch"]]} if "batch" in request else followed(request)

    def positions(partner: Any) -> np.ndarray:
        env = h3data.make(
            "social_nav", "small:3", num_envs=3, agents="human", partner=partner, observations=["humanoid_gps"]
        )
        env.reset(seed=0)
        return np.stack([env.step(np.zeros((3, 2), np.float32))[0]["humanoid_gps"] for _ in range(4)])

    with websocket_server(answering(answer, {"h3data": {"batch": True}})) as address:
        far = positions(address)
    assert np.array_equal(far, positions(follow))
    assert batches == [3] * 4


# --- live play --------------------------------------------------------------------------------------------------------
def game_of(out: Path, partner: str) -> LiveGame:
    plan = PlayPlan(app="social_nav", scenes="small:3", partner=partner, out=str(out))
    return EpisodeFactory(plan).begin(GameOrder(name="game", index=0))


def test_a_slow_server_never_slows_a_player_and_its_commands_verify(tmp_path: Path) -> None:
    asked = threading.Event()

    def slow(request: dict[str, Any]) -> dict[str, Any]:
        asked.set()
        time.sleep(0.4)
        return {"actions": np.tile([[1.0, 0.1]], (5, 1))}

    text = "hold = 5\ndeadline_s = 0.1\n[observation]\ngps = {sensor = 'humanoid_gps'}\n"
    with websocket_server(answering(slow, {"name": "slow"})) as address:
        game = game_of(tmp_path, address + adapter(tmp_path, text))
        longest = 0.0
        game.step()
        assert asked.wait(5)
        for _ in range(45):
            begun = time.perf_counter()
            game.step()
            longest = max(longest, time.perf_counter() - begun)
            time.sleep(1 / 60)
        recording = game.close()
    assert longest < 0.3, "less than one answer"
    assert recording is not None
    actions = recording.columns["agent_0.action"]
    assert actions[0].tolist() == [0.0, 0.0], "no answer yet"
    assert (actions == np.array([1.0, 0.1], np.float32)).all(1).sum() >= 5
    assert actions.any(1).sum() < len(actions), "it stands while answers are later than the deadline"
    info = read_mcap(tmp_path / "game.mcap").episode.info
    assert info["policy"].startswith("ws:slow@")
    assert info["remote"][0]["late_steps"] > 10
    assert verify(recording).difference is None


def test_a_server_that_goes_does_not_end_the_game(tmp_path: Path) -> None:
    with websocket_server(answering(followed)) as address:
        game = game_of(tmp_path, address)
        for _ in range(20):
            game.step()
            time.sleep(0.005)
    for _ in range(5):
        game.step()
        time.sleep(0.02)
    recording = game.close()
    assert recording is not None
    assert len(recording) == 25
    assert recording.episode.info["remote"][0]["faults"] >= 1
    assert verify(recording).difference is None


def test_a_game_goes_on_after_a_crash_with_what_its_server_had_said(tmp_path: Path) -> None:
    with websocket_server(answering(followed)) as address:
        game = game_of(tmp_path, address)
        for _ in range(30):
            game.step()
            time.sleep(0.005)
        game.abort()
        again = game_of(tmp_path, address)
        assert len(again.session.recorder) == 30
        again.step()
        recording = again.close()
    assert recording is not None
    assert recording.columns["agent_0.action"][:30].any()
    assert verify(recording).difference is None
