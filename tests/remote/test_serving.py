"""``h3data serve``: policies of ours behind openpi's protocol play as in process, and refuse what they cannot read."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import h3data
from h3data.errors import InputError
from h3data_remote.adapter import Adapter, Entry
from h3data_remote.connections import Address, WebSocketConnection
from h3data_remote.serving import ServedPolicy, policy_service
from h3data_remote.wire import OPENPI, PolicyServerError
from sim_kinematic.tasks.resume import verify
from tests.paths import ROOT
from tests.remote.test_policy import differing, played


@contextmanager
def served(name: str, **options: Any) -> Iterator[str]:
    """Address of a server of this policy."""
    with policy_service(ServedPolicy(name, **options), port=0) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
        thread.join()


GPS = Adapter(observation={"humanoid_gps": Entry("humanoid_gps")}, session=True)
FOLLOW = "tests.remote.scripted_server:follow"


@pytest.mark.parametrize(("name", "options"), [(FOLLOW, {"adapter": GPS}), ("rollout_expert", {}), ("random", {})])
def test_a_served_policy_plays_as_in_process_in_every_column(name: str, options: dict[str, Any]) -> None:
    with served(name, **options) as address:
        recording = played(address, steps=40)
    assert differing(played(name, steps=40), recording) == []
    assert verify(recording).difference is None


def test_a_trained_policy_sees_what_its_metadata_ask_for() -> None:
    with served("end_to_end") as address:
        recording = played(address, steps=30)
        with closing(WebSocketConnection(Address.of(address))) as connection:
            metadata = connection.metadata["h3data"]
    assert metadata["adapter"]["hold"] == recording.episode.info["remote"][0]["adapter"]["hold"] > 1
    local = played("end_to_end", steps=30)
    for name in ("agent_0.action", "agent_0.base_pose"):  # observations are 32 bits wide on the wire
        assert np.allclose(local.columns[name], recording.columns[name], atol=1e-4)


def test_several_episodes_and_batches_are_kept_apart() -> None:
    with served(FOLLOW, adapter=GPS) as address:
        connection = WebSocketConnection(Address.of(address))
        ask = {"humanoid_gps": np.array([3.0, 0.1], np.float32), "h3data/step": 0, "h3data/reset": True}
        alone = connection.ask({**ask, "h3data/session": "a"}, 5.0)
        both = connection.ask({"batch": [{**ask, "h3data/session": "a"}, {**ask, "h3data/session": "b"}]}, 5.0)
        connection.close()
    assert [one["actions"].tolist() for one in both["batch"]] == [alone["actions"].tolist()] * 2
    assert {"infer_ms", "prev_total_ms"} == set(both["server_timing"])


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({}, "(?s)lacks: humanoid_gps.*H3-REMOTE-021"),
        ([1, 2], "(?s)Expected a map.*H3-REMOTE-021"),
        ({"humanoid_gps": np.zeros(2), "h3data/step": "x"}, "(?s)whole numbers.*H3-REMOTE-021"),
        ({"humanoid_gps": "far"}, "(?s)arrays of numbers.*humanoid_gps.*H3-REMOTE-021"),
    ],
)
def test_what_cannot_be_answered_is_said_and_ends_the_connection(request_: Any, words: str) -> None:
    with served(FOLLOW, adapter=GPS) as address:
        connection = WebSocketConnection(Address.of(address))
        with pytest.raises(PolicyServerError, match=words):
            connection.ask(request_, 5.0)
        assert played(address, steps=3).episode.info["ended"] == "max_steps", "others are served as before"


def test_garbage_is_refused_without_harm() -> None:
    with served(FOLLOW, adapter=GPS) as address:
        for garbage in (b"\xc1", b"\x80\x04cos\nsystem\n.", "text", b""):
            with connect(address) as client:
                client.recv()
                client.send(garbage)
                assert isinstance(client.recv(), str)
        with served("rollout_expert") as privileged, connect(privileged) as client:
            client.recv()
            client.send(OPENPI.pack({"h3data/reset": True, "h3data/episode": b"no recording", "h3data/step": 0}))
            assert isinstance(client.recv(), str)


def test_browsers_are_refused_and_health_is_told() -> None:
    with served(FOLLOW, adapter=GPS) as address:
        with pytest.raises(InvalidStatus):
            connect(address, origin="https://example.org")  # type: ignore[arg-type]
        with urlopen(address.replace("ws", "http", 1) + "/healthz") as answer:
            assert answer.read() == b"OK\n"


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("nobody", {}, "(?s)nobody.*H3-POLICY-002"),
        ("ws://127.0.0.1:1", {}, "H3-REMOTE-045"),
        ("complement", {"task": "rearrange"}, "H3-REMOTE-046"),
    ],
)
def test_what_cannot_be_served_is_refused(name: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        ServedPolicy(name, **options)


def test_planners_are_not_for_named_observations_and_wanderers_for_nobody() -> None:
    with (
        served("rollout_expert", adapter=GPS) as address,
        pytest.raises(PolicyServerError, match=r"(?s)know the map.*H3-REMOTE-021"),
    ):
        played(address)
    with (
        served("wander", task="wander") as address,
        pytest.raises(PolicyServerError, match=r"(?s)gives way to everybody.*H3-REMOTE-021"),
    ):
        h3data.simulate("wander", "small:3", agents={"robot": address}, max_steps=3)


@pytest.mark.slow
def test_the_command_serves_until_it_is_interrupted() -> None:
    code = "import sys; from h3data_pipelines.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "serve", "--policy", "stand_still", "--port", "0"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        address = process.stderr.readline().split(" is at ")[1].split(". ")[0]
        with closing(WebSocketConnection(Address.of(address))) as connection:
            assert connection.metadata["policy"] == "stand_still"
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "has ended" in out
