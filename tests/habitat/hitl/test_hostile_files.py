"""HITL logs that are odd, damaged or hostile: tolerated or refused with a reason, never a crash."""

from __future__ import annotations

import collections
import datetime
import gzip
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.bodies import load_humanoid
from h3data.bodies.people.skeleton import JOINT_NAMES
from h3data.errors import FormatError, H3DataError
from h3data.geometry import quat_from_axis_angle, quat_from_heading
from h3data.recording import read_mcap, write_mcap
from h3data_habitat.hitl.agents import infer_joint_order
from h3data_habitat.hitl.paper_logs import read_hitl_log
from h3data_habitat.hitl.sessions import read_hitl_episode
from h3data_habitat.motion.habitat_humanoid import HABITAT_JOINTS
from h3data_motion.walk_synthesis import walk_columns
from h3data_pipelines.cli import main

LEVEL = [0.0, 0.0, 0.0, 1.0]
TILTED = [0.02, 0.0, 0.0, 0.9998]


def frame(k: int, *, wxyz: bool = False, **more: Any) -> dict[str, Any]:
    def order(q: list[float]) -> list[float]:
        return [q[3], *q[:3]] if wxyz else q

    return {
        "t": round(0.1 + k / 30, 5),
        "users": [
            {
                "events": [],
                "held_object": None,
                "camera_transform": {
                    "right": [1, 0, 0],
                    "up": [0, 1, 0],
                    "backward": [0, 0, 1],
                    "translation": [k, 1.5, 0],
                },
            }
        ],
        "object_states": [
            {
                "position": [0, 1, k],
                "rotation": order([0, 0.6, 0, 0.8]),
                "object_handle": "can_:0000",
                "object_id": 5,
                "states": {"is_clean": k > 1},
            }
        ],
        "agent_states": [
            {"position": [0.03 * k, 0.48, 0], "rotation": order([0, 0.6, 0, 0.8]), "grasp_mgr_snap_idx": 5},
            {"position": [2, 0.92, 0.04 * k], "rotation": order(TILTED), "grasp_mgr_snap_idx": None},
        ],
    } | more


def session(frames: Any, **more: Any) -> dict[str, Any]:
    return {
        "session": {},
        "users": [],
        "frames": frames,
        "episode": {
            "episode_id": "3",
            "scene_id": "a/b.scene_instance.json",
            "user_index_to_agent_index_map": {"0": 1},
        },
    } | more


def person(joints: np.ndarray, place: tuple[float, float, float]) -> list[float]:
    """A person's part of an action vector: facing +x."""
    base = np.eye(4)
    base[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    base[:3, 3] = place
    return [*joints.ravel(), *np.eye(4).T.ravel(), *base.T.ravel()]


def hanging(names: tuple[str, ...]) -> np.ndarray:
    """Arms down, the rest in T-pose, in the given order of joints."""
    joints = np.tile(LEVEL, (54, 1))
    for side, turn in (("left_shoulder", -1.2), ("right_shoulder", 1.2)):
        joints[names.index(side)] = quat_from_axis_angle(np.array([0.0, 0, 1]), np.array(turn))
    joints[names.index("left_knee")] = quat_from_axis_angle(np.array([1.0, 0, 0]), np.array(0.5))
    return joints


def log(steps: int = 4, *, names: tuple[str, ...] = HABITAT_JOINTS, **more: Any) -> dict[str, Any]:
    return {
        "start_time": "x",
        "episode_id": "1",
        "scene_id": "",
        "target_obj_ids": [7],
        "goal_positions": [[0, 0, 0]],
        "steps": [
            {
                "action": [0.5, 0.25, *person(hanging(names), (1, 0.9, 0))],
                "gui_humanoid": {"cam_yaw": 0.1, "base_user_input": [0, 1]},
                "agent_states": [
                    {"position": [0, 0.48, 0], "rotation_xyzw": LEVEL, "grasp_mgr_snap_idx": None},
                    {"position": [1, 0.92, 0], "rotation_xyzw": TILTED, "grasp_mgr_snap_idx": 7},
                ],
                "target_object_positions": [[k, 0.5, 0]],
                "metrics": {"n": k, "ok": True, "deep": {"a": 1.5}},
            }
            for k in range(steps)
        ],
    } | more


def stored(folder: Path, content: Any, name: str = "x.json") -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


# --- what varies ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("wxyz", [False, True])
def test_both_orders_of_quaternions_are_told_apart(tmp_path: Path, wxyz: bool) -> None:
    recording = read_hitl_episode(stored(tmp_path, session([frame(k, wxyz=wxyz) for k in range(5)])))
    assert recording.episode.info["quaternion_order"] == ("wxyz" if wxyz else "xyzw")
    assert [a.kind for a in recording.agents] == ["robot", "human"]
    np.testing.assert_allclose(recording.columns["object_pose"][0, 0, 3:], [0, 0.6, 0, 0.8], atol=1e-6)
    np.testing.assert_allclose(recording.columns["agent_0.base_pose"][0, 3:], [0, 0.6, 0, 0.8], atol=1e-6)


@pytest.mark.parametrize("names", [HABITAT_JOINTS, JOINT_NAMES[1:]])
def test_the_order_of_joints_is_told_by_the_posture(tmp_path: Path, names: tuple[str, ...]) -> None:
    recording = read_hitl_log(stored(tmp_path, log(names=names)))
    assert infer_joint_order(hanging(names)[None]) == ("habitat" if names == HABITAT_JOINTS else "smplx")
    np.testing.assert_allclose(recording.columns["agent_1.joint_quat"][0], hanging(JOINT_NAMES[1:]), atol=1e-6)
    np.testing.assert_allclose(recording.columns["agent_0.action"][0], [0.5, 0.25])
    np.testing.assert_allclose(recording.columns["agent_1.base_pose"][0], [1, 0, 0, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_array_equal(recording.columns["agent_1.grasp_body"], [0] * 4)


def test_people_may_come_first_or_alone(tmp_path: Path) -> None:
    first = log()
    for step in first["steps"]:
        step["action"] = step["action"][2:] + step["action"][:2]
        step["agent_states"].reverse()
    recording = read_hitl_log(stored(tmp_path, first))
    assert [a.kind for a in recording.agents] == ["human", "robot"]
    np.testing.assert_allclose(recording.columns["agent_1.action"][0], [0.5, 0.25])
    alone = log()
    for step in alone["steps"]:
        step["action"] = step["action"][2:]
        step["agent_states"] = step["agent_states"][1:]
    recording = read_hitl_log(stored(tmp_path, alone))
    assert [a.kind for a in recording.agents] == ["human"]
    assert "agent_0.joint_quat" in recording.columns


def test_actions_without_a_posture_give_people_a_walk(tmp_path: Path) -> None:
    content = log()
    for step in content["steps"]:
        step["action"] = {"action": ["agent_1_humanoidjoint_action"], "action_args": {"human_joints_trans": None}}
    recording = read_hitl_log(stored(tmp_path, content))
    assert [a.kind for a in recording.agents] == ["robot", "human"]
    assert "joints" in recording.episode.info["synthesised"]["human"]
    for step in content["steps"]:
        step["action"]["action_args"]["human_joints_trans"] = person(hanging(HABITAT_JOINTS), (1, 0.9, 0))
    assert "agent_1.joint_quat" in read_hitl_log(stored(tmp_path, content)).columns


def test_empty_frames_and_missing_things(tmp_path: Path) -> None:
    frames = [{}, {}, frame(2), {}, frame(4, object_states=[]), {}, {}]
    recording = read_hitl_episode(stored(tmp_path, session(frames)))
    columns = recording.columns
    np.testing.assert_array_equal(columns["recorded"], [0, 0, 1, 0, 1, 0, 0])
    assert np.diff(columns["time_ns"]) == pytest.approx(1 / 30 * 1e9, rel=1e-3)
    assert np.isfinite(columns["object_pose"][:4]).all()
    assert np.isnan(columns["object_pose"][4:]).all()  # it was taken out of the world
    nothing = read_hitl_episode(stored(tmp_path, session([{}, {}, {}])))
    assert len(nothing) == 3
    assert nothing.agents == ()


def test_stamps_that_go_back_are_mended(tmp_path: Path) -> None:
    recording = read_hitl_episode(stored(tmp_path, session([frame(0), frame(5), frame(2), frame(6)])))
    assert "1 time stamps do not increase" in recording.episode.info["warnings"][0]
    write_mcap(recording, tmp_path / "x.mcap")
    assert len(read_mcap(tmp_path / "x.mcap")) == 4


@pytest.mark.parametrize(
    ("start", "unix_ns"),
    [("1700000042", 1_700_000_042_100_000_000), ("x", None), (3, None), ("9" * 400, None), ("1e9", None), (None, None)],
)
def test_when_it_was_is_kept_if_the_file_says_it(tmp_path: Path, start: Any, unix_ns: int | None) -> None:
    content = session([frame(0), frame(1)])
    content["episode"]["start_timestamp"] = start
    recording = read_hitl_episode(stored(tmp_path, content))
    found = recording.episode.info.get("t0_unix_ns")
    assert found is None if unix_ns is None else found == pytest.approx(unix_ns, abs=1000)
    write_mcap(recording, tmp_path / "x.mcap")
    assert recording.episode.info["object_ids"] == {"can_:0000": 5}


def test_unknown_keys_and_odd_values_are_skipped(tmp_path: Path) -> None:
    odd = frame(0, new_key={"a": [1]}, task_percent_complete=None)
    odd["users"][0]["events"] = [{"type": "pick", "obj_id": 5, "what": None}, {}]
    recording = read_hitl_episode(stored(tmp_path, session([odd], surprise=1, metrics={"a": [1, None]})))
    assert [e.kind for e in recording.events] == ["pick", ""]
    content = log(metrics=3)
    content["steps"][1] = {"metrics": {"n": None, "text": "x", "nan": 1e300}}
    recording = read_hitl_log(stored(tmp_path, content))
    assert np.isnan(recording.columns["metrics.n"][1])
    assert np.isnan(recording.columns["agent_0.base_pose"][1]).all()
    assert any("action vector" in w for w in recording.episode.info["warnings"])


def test_partnr_results_are_found_beside_the_trajectory(tmp_path: Path) -> None:
    folder = tmp_path / "raw" / "s1"
    folder.mkdir(parents=True)
    (tmp_path / "processed_metrics.json").write_text(
        json.dumps(
            {
                "eid_to_filename": {"3": "data/raw/s1/7.json.gz", "4": "data/raw/s2/7.json.gz"},
                "eid_to_pc": {"3": 0.5},
                "eid_to_success": {"3": False},
                "eid_to_explanation": {},
                "eid_to_round_needed": [1],
                "ratio_agent_0": {"3": 0.25},
            }
        )
    )
    path = folder / "7.json.gz"
    path.write_bytes(gzip.compress(json.dumps(session([frame(0)])).encode()))
    result = read_hitl_episode(path).episode.info["partnr"]
    assert result == {"episode_id": "3", "percent_complete": 0.5, "success": False, "ratio_agent_0": 0.25}
    (tmp_path / "processed_metrics.json").write_text("[")
    assert "partnr" not in read_hitl_episode(path).episode.info


def test_a_walk_follows_the_way() -> None:
    body, steps = load_humanoid("neutral_0"), 120
    time_ns = np.arange(steps) * 33_333_333
    base = np.zeros((steps, 7))
    base[:, 0] = np.concatenate([np.zeros(30), np.arange(1, 61) * 0.04, np.full(30, 2.4)])
    base[:, 3:] = quat_from_heading(np.zeros(steps))
    columns = walk_columns(body, base, time_ns)
    names = [body.motion_names[i] for i in columns["motion_id"]]
    assert names[0] == names[-1] == "stand"
    assert names[60] == "walk_1.3"
    assert columns["motion_blend"][60] == 1
    assert columns["motion_blend"][[0, -1]].max() == 0
    stride = body.clips[body.motion_names.index("walk_1.3")].stride_m
    assert (columns["motion_phase"][60] - columns["motion_phase"][50]) % 1 == pytest.approx(0.4 / stride, abs=1e-5)
    base[:, 3:] = quat_from_heading(np.linspace(0, 6, steps))
    base[:, 0] = 0
    assert body.motion_names[walk_columns(body, base, time_ns)["motion_id"][60]] == "turn_left"
    base[60:, 0] = 50  # a jump is no walk
    base[:, 3:] = quat_from_heading(np.zeros(steps))
    assert not walk_columns(body, base, time_ns)["motion_id"].any()


# --- what is refused --------------------------------------------------------------------------------------------------
class Evil:
    def __reduce__(self) -> Any:
        return print, ("this must not run",)


def test_a_pickle_with_code_is_refused_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "session.0.pkl.gz"
    path.write_bytes(gzip.compress(pickle.dumps({**log(), "dataset": Evil()}, protocol=4)))
    with pytest.raises(
        FormatError, match=r"(?s)asks for builtins\.print; only NumPy arrays and known records.*H3-FORMAT-026"
    ):
        read_hitl_log(path)
    assert main(["import", str(tmp_path), "-o", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr().out
    assert "this must not run" not in shown.splitlines()
    assert "builtins.print" in shown
    assert not list((tmp_path / "out").rglob("*.mcap*"))


def test_a_pickle_equals_the_json_that_says_the_same(tmp_path: Path) -> None:
    content = log()
    told = read_hitl_log(stored(tmp_path, content))
    for step in content["steps"]:
        step["action"] = np.array(step["action"], np.float32)
        step["metrics"] = collections.defaultdict(dict, {**step["metrics"], "n": np.float64(step["metrics"]["n"])})
    content["start_time"] = datetime.datetime(2023, 9, 5, 10, 11, 12, 131415)
    for protocol in (2, 4, 5):
        (tmp_path / "x.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
        if protocol == 2:
            continue  # its dates are written in another way, and no tool of Habitat's used it
        recording = read_hitl_log(tmp_path / "x.pkl")
        assert recording.episode.info["start_time"] == "2023-09-05 10:11:12.131415"
        for name, column in told.columns.items():
            np.testing.assert_allclose(recording.columns[name], column, atol=1e-6)


BROKEN: dict[str, Any] = {
    "no frames": session([]),
    "frames no list": session(3),
    "frame no object": session([frame(0), 3]),
    "short position": session([frame(0, agent_states=[{"position": [0, 0], "rotation": LEVEL}])]),
    "no rotation": session([frame(0, agent_states=[{"position": [0, 0, 0], "rotation": [0, 0, 0, 0]}])]),
    "huge": session([frame(0, agent_states=[{"position": [1e30, 0, 0], "rotation": LEVEL}])]),
    "text": session([frame(0, t="x")]),
    "no steps": log(0),
    "log without objects": log(0) | {"steps": [1, 2]},
    "many bodies": session(
        [
            frame(
                0,
                object_states=[
                    {"object_handle": f"a{k}", "position": [0, 0, 0], "rotation": LEVEL} for k in range(3000)
                ],
            )
        ]
        + [{}] * 20_000
    ),
    "nested": '{"session":{"config":' + "[" * 100_000 + "]" * 100_000 + '},"episode":{},"frames":[{}]}',
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_logs_are_refused_with_a_reason(tmp_path: Path, case: str) -> None:
    path = stored(tmp_path, BROKEN[case])
    read = read_hitl_log if "steps" in case or "log" in case else read_hitl_episode
    with pytest.raises(FormatError, match=r"(?s)x\.json.*H3-(FORMAT-0(08|18)|HABITAT-0(68|69|71|74))"):
        read(path)


@pytest.mark.parametrize("depth", [50, 400, 900])
def test_deep_configurations_are_stored_or_refused(tmp_path: Path, depth: int) -> None:
    text = '{"session":{"config":' + "[" * depth + "]" * depth + '},"episode":{},"frames":[{}]}'
    try:
        recording = read_hitl_episode(stored(tmp_path, text))
        write_mcap(recording, tmp_path / "x.mcap")
    except H3DataError:
        return
    assert len(read_mcap(tmp_path / "x.mcap")) == 1


@pytest.mark.parametrize("opcode", [b"r\xff\xff\xff\x7f", b"p2147483647\n"])
def test_pickles_cannot_claim_memory_that_they_do_not_fill(tmp_path: Path, opcode: bytes) -> None:
    path = tmp_path / "x.pkl"
    path.write_bytes(b"\x80\x04N" + opcode + b".")
    with pytest.raises(FormatError, match=r"(?s)under.*number 2147483647.*H3-FORMAT-026"):
        read_hitl_log(path)


def test_gzip_bombs_are_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.pkl.gz"
    path.write_bytes(gzip.compress(b"\x80\x04" + bytes(200 << 20), compresslevel=1))
    with pytest.raises(FormatError, match="H3-FORMAT-016"):
        read_hitl_log(path)


SMALL = {
    "episode": json.dumps(session([frame(0), {}, frame(2)])).encode(),
    "log": json.dumps(log(1)).encode(),
    "pickle": pickle.dumps(log(1), protocol=4),
}
READERS = {"episode": read_hitl_episode, "log": read_hitl_log, "pickle": read_hitl_log}


@pytest.mark.parametrize("kind", SMALL)
def test_truncated_files_are_refused(tmp_path: Path, kind: str) -> None:
    data, path = SMALL[kind], tmp_path / "x"
    for end in range(0, len(data), max(1, len(data) // 300)):
        path.write_bytes(data[:end])
        with pytest.raises(FormatError):
            READERS[kind](path)
    packed = gzip.compress(data)
    for end in range(2, len(packed) - 1, max(1, len(packed) // 60)):
        path.write_bytes(packed[:end])
        with pytest.raises(FormatError):
            READERS[kind](path)


@pytest.mark.parametrize("kind", SMALL)
@given(data=st.data())
def test_mutated_files_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject
) -> None:
    content = bytearray(SMALL[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("mutated") / "x"
    path.write_bytes(bytes(content))
    try:
        recording = READERS[kind](path)
    except H3DataError:
        return
    write_mcap(recording, path.with_suffix(".mcap"))
    assert len(read_mcap(path.with_suffix(".mcap"))) == len(recording)


leaf = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4)
anything = st.recursive(leaf, lambda s: st.lists(s, max_size=4) | st.dictionaries(st.text(max_size=6), s, max_size=4))
KEYS = (
    "t",
    "users",
    "object_states",
    "agent_states",
    "task_percent_complete",
    "action",
    "gui_humanoid",
    "metrics",
    "target_object_positions",
)


@given(key=st.sampled_from(KEYS), value=anything)
def test_any_value_under_any_key_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, key: str, value: Any
) -> None:
    folder = tmp_path_factory.mktemp("value")
    steps = log(2)
    steps["steps"][1][key] = value
    for read, content in ((read_hitl_episode, session([frame(0), frame(1, **{key: value})])), (read_hitl_log, steps)):
        path = folder / "x.pkl"
        try:
            if read is read_hitl_log:
                path.write_bytes(pickle.dumps(content, protocol=5))
            else:
                path.write_text(json.dumps(content))
            recording = read(path)
        except H3DataError:
            continue
        write_mcap(recording, folder / "x.mcap", overwrite=True)
