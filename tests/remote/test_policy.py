"""Policies behind servers: the same recordings as in process, and one sentence for whatever a server does wrong."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies import load_robot
from h3data.errors import InputError, UntrustedNameError
from h3data.plugins import names_from_data
from h3data.recording import Recording
from h3data_remote import connections
from h3data_remote.adapter import read_adapter
from h3data_remote.connections import Address, WebSocketConnection
from h3data_remote.policy import RemotePolicy
from h3data_remote.wire import MOST_BYTES, OPENPI, PolicyServerError
from sim_kinematic.policies.assignment import resolve_policy
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.resume import resume, verify
from tests.remote.scripted_server import answering, follow, followed, groot_server, steer, websocket_server

STEPS = 60


def played(policy: Any, steps: int = STEPS) -> Recording:
    return h3data.simulate("social_nav", "small:3", agents={"robot": policy}, max_steps=steps)


def rearranged(policy: str) -> Recording:
    """A second of rearrangement."""
    with h3data.session("rearrange", "small:3", agents={"robot": policy}) as session:
        session.task.codec.load_precomputed(session.episode, {"solo_steps": 600})
        for _ in range(30):
            session.step()
    return session.close()


def differing(one: Recording, other: Recording) -> list[str]:
    assert one.columns.keys() == other.columns.keys()
    return [
        name for name, values in one.columns.items() if not np.array_equal(values, other.columns[name], equal_nan=True)
    ]


def adapter(folder: Path, text: str) -> str:
    """Ending of an address that names an adapter file with this text."""
    file = folder / "mine.toml"
    file.write_text(text)
    return f"?adapter={file}"


def quick(folder: Path, more: str = "") -> str:
    return adapter(
        folder,
        f"timeout_s = 0.3\nfirst_timeout_s = 0.3\n{more}\n[observation]\nhumanoid_gps = {{sensor = 'humanoid_gps'}}\n",
    )


# --- the same as in process -------------------------------------------------------------------------------------------
def test_a_policy_behind_a_websocket_plays_as_in_process_and_verifies_without_its_server() -> None:
    asked: list[dict[str, Any]] = []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request)
        return {**followed(request), "server_timing": {"infer_ms": 2.0}}

    with websocket_server(answering(answer, {"name": "my net", "n": np.float32(2)})) as address:
        recording = played(address)
        assert len(asked) == STEPS
    assert differing(played(follow), recording) == []
    info = recording.episode.info
    assert info["policy"].startswith("ws:my_net@")
    (remote,) = info["remote"]
    assert (remote["calls"], remote["protocol"], remote["infer_ms"]) == (STEPS, "openpi", {"median": 2.0, "p95": 2.0})
    assert remote["metadata"] == {"name": "my net", "n": 2.0}
    assert "127.0.0.1" not in repr(recording.episode)
    assert set(asked[0]) >= {"prompt", "humanoid_gps", "h3data/reset", "h3data/step"}
    assert [one["h3data/reset"] for one in asked[:3]] == [True, False, False]
    assert verify(recording).difference is None, "with no server there"


def test_groots_protocol_carries_the_same_policy() -> None:
    shown: list[dict[str, Any]] = []

    def act(observation: dict[str, Any]) -> list[Any]:
        shown.append(observation)
        return [{"base": np.tile(np.array(steer(observation["state"]["base"][0, 0, :2]), np.float32), (1, 8, 1))}, {}]

    asked: list[str] = []
    with groot_server(act, asked) as address:
        recording = played(address, steps=9)
    assert asked == ["ping", "get_modality_config", "reset", "get_action", "get_action"]
    first = shown[0]
    assert first["video"]["arm"].shape == (1, 1, 168, 224, 3)
    assert first["state"]["base"].shape == (1, 1, 5)
    assert first["language"]["task"] == [["follow the person"]]
    assert recording.episode.info["policy"].startswith("zmq:gr00t@")
    assert (recording.columns["agent_0.action"][:8] == recording.columns["agent_0.action"][0]).all()


def test_an_adapter_says_what_is_shown_and_how_long_chunks_are_carried_out(tmp_path: Path) -> None:
    text = """
hold = 3
actions = "policy/out"
columns = [2, 0]
prompt = "words"
[observation]
"observation/image" = {sensor = "arm_rgb", size = [64, 64], pad = true}
"depth" = {sensor = "arm_depth", size = [32, 16]}
"observation/state" = {sensor = ["humanoid_gps", "egomotion"]}
"""
    shown: list[dict[str, Any]] = []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        shown.append(request)
        rows = np.array([[0.9, 9.0, 0.1 * len(shown)], [-5.0, 9.0, 0.5], [0.2, 9.0, 0.3], [7.0, 7.0, 7.0]])
        return {"policy/out": rows}

    with websocket_server(answering(answer)) as address:
        recording = played(address + adapter(tmp_path, text), steps=7)
    assert len(shown) == 3
    assert set(shown[0]) == {"observation/image", "depth", "observation/state", "words"}
    image = shown[0]["observation/image"]
    assert (image.shape, image.dtype) == ((64, 64, 3), np.uint8)
    assert not image[:8].any()
    assert not image[-8:].any()
    assert image[8:-8].any(), "480 rows of 640 pixels become 48 of 64"
    assert shown[0]["depth"].shape == (16, 32, 1)
    assert shown[0]["observation/state"].shape == (5,)
    actions = recording.columns["agent_0.action"]
    expected = np.array([[0.1, 0.9], [0.5, -1.0], [0.3, 0.2], [0.2, 0.9]], np.float32)
    assert np.array_equal(actions[:4], expected)


def test_observations_are_those_of_environments() -> None:
    names = ("humanoid_gps", "egomotion", "localization", "collision", "arm_joints", "range_scan", "way", "arm_depth")
    env = h3data.make("social_nav", scenes="small:3", observations=names, depth_size=(32, 24))
    shown, _ = env.reset(seed=0)
    view = env.unwrapped.stepper.play.view(0)
    for _ in range(3):
        for name, values in view.observe(names, (32, 24)).items():
            assert np.array_equal(values, shown[name]), name
            assert values.dtype == shown[name].dtype
        shown = env.step(np.array([1.0, 0.3], np.float32))[0]


def test_an_arm_is_moved_by_a_server_and_verified_without_it(tmp_path: Path) -> None:
    text = "action = 'control'\nhold = 4\n[observation]\nobj_sensor = {sensor = 'obj_sensor'}\n"
    rng = np.random.default_rng(0)
    width = 2 + len(load_robot("quad_arm").require_arm()) + 1
    with websocket_server(answering(lambda request: {"actions": rng.uniform(-1, 1, (4, width))})) as address:
        recording = rearranged(address + adapter(tmp_path, text))
    joints = recording.columns["agent_0.joint_pos"]
    assert np.abs(joints[-1] - joints[0]).max() > 0.05
    assert verify(recording).difference is None


@pytest.mark.slow
def test_a_base_is_moved_by_a_server_beside_objects(tmp_path: Path) -> None:
    with websocket_server(answering(lambda request: {"actions": np.array([[1.0, 0.2]])})) as address:
        recording = rearranged(address + quick(tmp_path))
    base = recording.columns["agent_0.base_pose"]
    assert np.hypot(*(base[-1] - base[0])[[0, 2]]) > 0.3
    assert verify(recording).difference is None


# --- recordings -------------------------------------------------------------------------------------------------------
def test_a_recording_is_continued_by_its_server_which_is_asked_only_for_what_is_new() -> None:
    asked: list[int] = []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request["h3data/step"])
        return followed(request)

    with websocket_server(answering(answer)) as address:
        recording = played(address)
        asked.clear()
        again = resume(recording, 40, policy=address)
    assert asked == list(range(40, STEPS))
    assert differing(recording, again) == []


def test_a_recording_names_the_server_that_is_missing_and_no_address() -> None:
    with websocket_server(answering(followed, {"name": "net"})) as address:
        recording = played(address, steps=5)
    with pytest.raises(InputError, match=r"(?s)'net'.*H3-TASK-040"):
        resume(recording, 3)


def test_an_address_that_a_file_names_is_not_called() -> None:
    with names_from_data(), pytest.raises(UntrustedNameError, match="H3-POLICY-065"):
        resolve_policy(find_task("social_nav"), "robot", "ws://127.0.0.1:1")


# --- servers that do wrong --------------------------------------------------------------------------------------------
def close_at(count: int) -> Any:
    def answer(request: dict[str, Any]) -> dict[str, Any]:
        if request["h3data/step"] >= count:
            raise ConnectionResetError
        return followed(request)

    return answer


def said(recording: Any) -> str:
    with pytest.raises(PolicyServerError) as caught:
        recording()
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 500
    return text


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("Traceback:\n  File ...\nRuntimeError: CUDA is out of memory", "reports a fault: RuntimeError: CUDA"),
        ({"actions": np.array([[np.nan, 0.0]])}, "not finite"),
        ({"actions": np.array([[np.inf, 0.0]])}, "not finite"),
        ({"actions": np.zeros((1, 7))}, r"actions of 2 numbers.*\[1, 7\]"),
        ({"actions": np.zeros((2, 1, 2))}, r"\[H, D\].*\[2, 1, 2\]"),
        ({"actions": np.zeros((0, 2))}, r"\[0, 2\]"),
        ({"actions": "left"}, r"\[H, D\]"),
        ({"actions": {"left": 1}}, r"\[H, D\]"),
        ({"action": np.zeros((1, 2))}, "Expected 'actions'.*got: action"),
        (b"\x93\x01\x02\x03", "Expected a map"),
        (b"\xc1", "MessagePack"),
        (b"", "MessagePack"),
    ],
    ids=range(12),
)
def test_a_bad_answer_is_one_sentence_with_the_address(answer: Any, words: str, tmp_path: Path) -> None:
    with websocket_server(answering(lambda request: answer)) as address:
        text = said(partial(played, address))
    assert re.search(words, text)
    assert address in text


def test_a_huge_answer_is_not_read(tmp_path: Path) -> None:
    with websocket_server(answering(lambda request: bytes(MOST_BYTES + 1))) as address:
        assert f"more than {MOST_BYTES:,} bytes" in said(partial(played, address))


def test_a_chunk_that_is_too_short_is_refused(tmp_path: Path) -> None:
    with (
        websocket_server(answering(followed)) as address,
        pytest.raises(PolicyServerError, match=r"(?s) 5 .*H3-REMOTE-002"),
    ):
        played(address + quick(tmp_path, "hold = 5"))


def test_a_server_that_sleeps_or_trickles_is_late_and_never_used_again(tmp_path: Path) -> None:
    def sleeps(request: dict[str, Any]) -> dict[str, Any]:
        time.sleep(0.6)
        return followed(request)

    with websocket_server(answering(sleeps)) as address:
        begun = time.monotonic()
        assert "did not answer within 0.3 s" in said(partial(played, address + quick(tmp_path)))
        assert time.monotonic() - begun < 3
        connection = WebSocketConnection(Address.of(address))
        with pytest.raises(PolicyServerError, match=r"(?s)within 0\.1 s.*H3-REMOTE-016"):
            connection.ask({"humanoid_gps": np.ones(2)}, 0.1)
        with pytest.raises(PolicyServerError, match="H3-REMOTE-030"):
            connection.ask({"humanoid_gps": np.ones(2)}, 5.0)

    with socket.create_server(("127.0.0.1", 0)) as listener:

        def trickles() -> None:
            client = listener.accept()[0]
            with client:
                for byte in b"HTTP/1.1 101 Switching Protocols\r\n" * 3:
                    time.sleep(0.02)
                    try:
                        client.send(bytes([byte]))
                    except OSError:
                        return

        thread = threading.Thread(target=trickles)
        thread.start()
        address = f"ws://127.0.0.1:{listener.getsockname()[1]}"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(connections, "CONNECT_S", 0.3)
            assert "within 0.3 s" in said(partial(WebSocketConnection, Address.of(address)))
        thread.join()


def test_a_server_that_sends_more_than_it_was_asked_is_refused() -> None:
    """Otherwise every later action would be that of an earlier step."""

    def pushes(connection: Any) -> None:
        connection.send(OPENPI.pack({}))
        while True:
            answer = OPENPI.pack(followed(OPENPI.unpack(bytes(connection.recv()))))
            connection.send(answer)
            connection.send(answer)

    with websocket_server(pushes) as address, pytest.raises(PolicyServerError, match="H3-REMOTE-062"):
        played(address)


def test_a_server_that_goes_is_said(tmp_path: Path) -> None:
    def goes(connection: Any) -> None:
        connection.send(OPENPI.pack({}))
        connection.recv()
        connection.close(1001, "restarting")

    with websocket_server(goes) as address:
        assert "closed the connection (code 1001 restarting)" in said(partial(played, address))
    assert "No policy server answers" in said(partial(played, address))


def test_what_is_no_policy_server_is_said(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def other() -> None:
            client = listener.accept()[0]
            with client:
                client.recv(4096)
                client.send(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")

        thread = threading.Thread(target=other)
        thread.start()
        text = said(partial(played, f"ws://127.0.0.1:{listener.getsockname()[1]}"))
        thread.join()
    assert "not as a policy server" in text
    assert "404" in text


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (
            {"error": "Traceback\nValueError: no such modality"},
            "(?s)reports a fault: ValueError: no such.*H3-REMOTE-026",
        ),
        ([{"base": np.full((1, 8, 2), np.nan)}, {}], "H3-REMOTE-003"),
        ([{"base": np.zeros((1, 8, 3))}, {}], r"(?s)\[8, 3\].*H3-REMOTE-002"),
        ([{"base": np.zeros((1, 2, 2))}, {}], "(?s)at least 8.*H3-REMOTE-002"),
        ({"base": 1}, "H3-REMOTE-018"),
        (b"\x80\x04nonsense", "(?s)MessagePack.*H3-REMOTE-025"),
    ],
    ids=range(6),
)
def test_a_bad_answer_in_groots_protocol_is_one_sentence(answer: Any, words: str, tmp_path: Path) -> None:
    text = "actions = 'base'\nhold = 8\n[observation]\n'state.base' = {sensor = 'humanoid_gps'}\n"
    with groot_server(lambda observation: answer) as address, pytest.raises(PolicyServerError, match=words):
        played(address + adapter(tmp_path, text))


def test_a_groot_server_that_is_gone_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "CONNECT_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    assert "did not answer 'ping' within 0.2 s" in said(partial(played, f"zmq://127.0.0.1:{port}"))


# --- addresses and adapters -------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "text", ["ws://me:secret@host:1", "ws://secret@host", "zmq://secret:@host:1", "wss://a:secret@[::1]:4"]
)
def test_an_address_with_a_user_is_refused_and_not_repeated(text: str) -> None:
    with pytest.raises(InputError, match="H3-REMOTE-019") as caught:
        played(text)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["ws://", "ws://h:x", "ws://h:99999", "ws://h?key=1", "zmq://h#a", "ws://h?adapter=none", "ws://a..b:1"]
)
def test_an_address_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        played(text)


def test_an_address_of_all_machines_is_no_server() -> None:
    with pytest.raises(PolicyServerError, match="H3-REMOTE-063"):
        played("zmq://*:5555")


def test_another_scheme_is_unknown() -> None:
    with pytest.raises(InputError, match="H3-FILE-011"):
        played("grpc://host:1")


def test_a_key_goes_to_the_server_and_to_nobody_else(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(connections.KEY_VARIABLE, "hush-1")
    seen: list[str] = []

    def handle(connection: Any) -> None:
        seen.append(connection.request.headers.get("Authorization", ""))
        answering(followed)(connection)

    with websocket_server(handle) as address:
        recording = played(address, steps=3)
    assert seen == ["Api-Key hush-1"]
    assert "hush-1" not in repr(recording.episode)
    with pytest.raises(InputError, match=r"(?s)H3DATA_POLICY_KEY.*H3-REMOTE-015"):
        played("ws://gpu.example.org:8000")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hold = 0", "(?s)hold.*H3-REMOTE-008"),
        ("nonsense = 1", "(?s)nonsense.*H3-REMOTE-008"),
        ("action = 'fly'", "(?s)action.*H3-REMOTE-008"),
        ("hold = [", "H3-REMOTE-007"),
        ("[observation]\na = {sensor = 'arm_rgb', size = [1000000, 4]}", "(?s)size.*H3-REMOTE-008"),
        ("[observation]\na = {sensor = ['arm_rgb', 'way']}", "H3-REMOTE-010"),
        ("[observation]\na={sensor='arm_rgb',size=[8,8]}\nb={sensor='arm_rgb',size=[9,9]}", "H3-REMOTE-011"),
        ("[observation]\na = {sensor = 'humanoid_gsp'}", "H3-TASK-071"),
        ("action = 'control'", "H3-REMOTE-034"),
    ],
)
def test_a_bad_adapter_is_refused_with_its_field(text: str, words: str, tmp_path: Path) -> None:
    with websocket_server(answering(followed)) as address, pytest.raises(InputError, match=words):
        played(address + adapter(tmp_path, text))


def test_a_server_may_bring_an_adapter_but_no_more() -> None:
    own = {"observation": {"gps": {"sensor": "humanoid_gps"}}, "hold": 2}
    shown: list[dict[str, Any]] = []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        shown.append(request)
        return {"actions": np.zeros((2, 2))}

    with websocket_server(answering(answer, {"h3data": {"adapter": own, "name": "x,y:z"}})) as address:
        recording = played(address, steps=4)
    assert [set(one) for one in shown] == [{"gps"}, {"gps"}]
    assert recording.episode.info["policy"].startswith("ws:x_y_z@")
    huge = {"observation": {"a": {"sensor": "arm_rgb", "size": [10**6, 10**6]}}}
    with (
        websocket_server(answering(followed, {"h3data": {"adapter": huge}})) as address,
        pytest.raises(InputError, match=r"(?s)adapter of the policy server at.*H3-REMOTE-008"),
    ):
        played(address)


def test_built_in_adapters_can_be_read() -> None:
    assert {name: read_adapter(name).hold for name in ("h3data", "openpi", "gr00t")} == {
        "h3data": 1,
        "openpi": 5,
        "gr00t": 8,
    }


def test_people_are_not_moved_by_servers() -> None:
    with pytest.raises(InputError, match="H3-REMOTE-033"):
        h3data.simulate("wander", "small:3", agents={"human": "ws://127.0.0.1:1"}, max_steps=3)


@pytest.mark.slow
@pytest.mark.parametrize("missing", ["websockets", "zmq"])
def test_a_missing_package_names_the_extra(missing: str) -> None:
    code = f"import sys; sys.modules['{missing}'] = None; from h3data_pipelines.cli import main; sys.exit(main(sys.argv[1:]))"
    for words in (["serve", "--policy", "stand_still"], ["evaluate", "social_nav", "--policies", "ws://h", "-o", "x"]):
        done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert done.stderr.count("pip install 'h3data[remote]'") == done.stderr.count("\n") == 1


# --- several worlds ---------------------------------------------------------------------------------------------------
def test_worlds_that_ran_out_of_actions_ask_together_where_the_server_can(tmp_path: Path) -> None:
    sizes: list[int] = []

    def act(observation: dict[str, Any]) -> list[Any]:
        gps = observation["state"]["base"]
        sizes.append(len(gps))
        return [{"base": np.array([[steer(one[0])] * 2 for one in gps], np.float32)}, {}]

    text = "actions = 'base'\nhold = 2\n[observation]\n'state.base' = {sensor = 'humanoid_gps'}\n"
    task = find_task("social_nav")
    with groot_server(act) as address:
        make = resolve_policy(task, "robot", address + adapter(tmp_path, text))
        sessions = [h3data.session("social_nav", f"small:{k}") for k in (3, 4)]
        views = [session.observe("robot") for session in sessions]
        policies = [make(session.episode, 0).policy for session in sessions]
        together = RemotePolicy.act_together(policies, views)
        again = RemotePolicy.act_together(policies, [view._replace(step=1) for view in views])
        alone = [make(session.episode, 0).policy.act(view) for session, view in zip(sessions, views, strict=True)]
    assert sizes == [2, 1, 1]
    assert together == alone == again


# --- nothing left behind ----------------------------------------------------------------------------------------------
@pytest.mark.skipif(sys.platform != "linux", reason="counts descriptors in /proc")
def test_no_connection_is_left_open() -> None:
    with (
        websocket_server(answering(followed)) as address,
        groot_server(lambda o: [{"base": np.zeros((1, 8, 2))}, {}]) as other,
    ):
        played(address, steps=2), played(other, steps=2)
        before = len(os.listdir("/proc/self/fd"))
        for _ in range(3):
            played(address, steps=2), played(other, steps=2)
        time.sleep(0.2)
        assert len(os.listdir("/proc/self/fd")) <= before + 2
