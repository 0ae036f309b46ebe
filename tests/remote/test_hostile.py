"""Servers that do wrong in the middle of a job or a game, in both protocols: one sentence, and everything else goes on."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.recording import Dataset
from h3data_pipelines.cli import main
from h3data_remote.wire import MOST_BYTES
from sim_kinematic.tasks.resume import verify
from tests.remote.scripted_server import BREAK_OFF, answering, followed, groot_server, steer, websocket_server
from tests.remote.test_jobs import game_of
from tests.remote.test_policy import adapter

SCHEMES = ("ws", "zmq")
FAULTS = {
    "gone": "closed the connection",
    "slow": "did not answer",
    "nan": "not finite",
    "shape": r"[1, 7]",
    "text": "reports a fault: RuntimeError: CUDA is out of memory",
    "oversize": f"more than {MOST_BYTES:,} bytes",
}
"""Each fault with words of the sentence that says it."""


def answer_of(fault: str, scheme: str) -> Any:
    """What a server sends that has this fault."""
    traceback = "Traceback:\n  File ...\nRuntimeError: CUDA is out of memory"
    if fault == "gone":
        return BREAK_OFF
    if fault == "slow":
        time.sleep(1.4)
    if fault == "oversize":
        return bytes(MOST_BYTES + 1)
    if fault == "text":
        return traceback if scheme == "ws" else {"error": traceback}
    actions = {"nan": np.full((1, 2), np.nan), "shape": np.zeros((1, 7))}.get(fault, np.zeros((1, 2)))
    return {"actions": actions} if scheme == "ws" else [{"actions": actions[None]}, {}]


@contextmanager
def hostile_server(scheme: str, fault: str, conversations: range, folder: Path) -> Iterator[str]:
    """Address of a server that steers well, but in these conversations, counted from 0, has the fault at the third request."""
    lock, begun = threading.Lock(), [-1]
    text = "timeout_s = {}\nfirst_timeout_s = 20\n[observation]\n'{}' = {{sensor = 'humanoid_gps'}}\n"
    text = text.format(0.7 if fault == "slow" else 20, "humanoid_gps" if scheme == "ws" else "state.gps")

    def goes_wrong(requests: int, conversation: int) -> bool:
        return requests == 3 and conversation in conversations

    def handle(connection: Any) -> None:
        requests = 0
        with lock:
            begun[0] += 1
            conversation = begun[0]

        def answer(request: dict[str, Any]) -> Any:
            nonlocal requests
            requests += 1
            return answer_of(fault, scheme) if goes_wrong(requests, conversation) else followed(request)

        answering(answer)(connection)

    asked: list[str] = []

    def act(observation: dict[str, Any]) -> Any:
        after = len(asked) - 1 - asked[::-1].index("reset")
        if goes_wrong(len(asked) - after - 1, asked.count("reset") - 1):
            return answer_of(fault, scheme)
        return [{"actions": np.array([[steer(observation["state"]["gps"].ravel())]], np.float32)}, {}]

    with websocket_server(handle) if scheme == "ws" else groot_server(act, asked) as address:
        yield address + adapter(folder, text)


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("command", ["generate", "evaluate"])
def test_a_fault_costs_its_episode_and_is_one_sentence(
    command: str, scheme: str, fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, flag = tmp_path / "out", "--policy" if command == "generate" else "--policies"
    common = ["social_nav", "--scenes", "small:3", "--episodes", "3", "--max-steps", "6", "--json", "-o", str(out)]
    # the first conversations are looks before the job: one of `generate`, two of `evaluate`
    with hostile_server(scheme, fault, range(2, 3), tmp_path) as address:
        assert main([command, *common, flag, address]) == 1
    told = json.loads(capsys.readouterr().out)
    (line,) = told["failed"]
    assert FAULTS[fault] in line
    assert address.partition("?")[0] in line
    assert "\n" not in line.strip()
    assert told["episodes"] == 3
    if command == "generate":
        played = [recording for recording in Dataset(out) if not recording.episode.info.get("failed")]
        assert [verify(recording).difference for recording in played] == [None, None]
    else:
        files = [json.loads(file.read_text()) for file in sorted((out / "episodes").glob("*.json"))]
        assert sorted(len(found["rows"]) for found in files) == [0, 1, 1]


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_game_goes_on_and_its_recording_verifies(scheme: str, fault: str, tmp_path: Path) -> None:
    with hostile_server(scheme, fault, range(99), tmp_path) as address:
        game = game_of(tmp_path, address)
        (policy,) = game.waited_for.values()
        until = time.monotonic() + 30
        while not policy.faults and time.monotonic() < until:
            game.step()
            time.sleep(0.01)
        assert FAULTS[fault] in policy.fault
        for _ in range(3):
            game.step()
        recording = game.close()
    assert recording is not None
    assert recording.columns["agent_0.action"].any(), "two answers were good"
    assert recording.episode.info["remote"][0]["faults"] >= 1
    assert verify(recording).difference is None
