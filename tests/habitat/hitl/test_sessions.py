"""HITL logs of both generations against what was true in habitat-sim while they were written (needs ../shared/real)."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.geometry import pose_from_matrix, pose_to_matrix
from h3data.recording import Dataset, DatasetWriter, Recording, read_mcap, recordings_equal, write_mcap
from h3data.recording.assets.library import AssetLibrary
from h3data_habitat.hitl.paper_logs import read_hitl_log
from h3data_habitat.hitl.sessions import read_hitl_episode
from h3data_pipelines.cli import main

ROUNDED = 5.1e-6
"""Logs as JSON are rounded to 5 decimals."""
FLOAT32 = 1e-6


@pytest.fixture(scope="module")
def hitl(real: Path) -> Path:
    return real / "habitat-lab" / "reference" / "hitl"


def read_json(path: Path) -> Any:
    with gzip.open(path) as stream:
        return json.load(stream)


@pytest.fixture(scope="module")
def truth(hitl: Path) -> dict[str, list[list[dict[str, Any]]]]:
    """Frames of the episodes of each session."""
    names = ("session_2users", "session_1user_policy")
    return {name: [e["frames"] for e in read_json(hitl / name / "truth.json.gz")["episodes"]] for name in names}


def assert_poses(found: np.ndarray, true: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(found[..., :3], true[..., :3], rtol=0, atol=tolerance)
    assert_rotations(found[..., 3:], true[..., 3:], tolerance)


def assert_rotations(found: np.ndarray, true: np.ndarray, tolerance: float) -> None:
    """Quaternions of either sign, as near as ones that were rounded so and made unit again can be."""
    sign = np.where((found * true).sum(-1, keepdims=True) < 0, -1, 1)
    np.testing.assert_allclose(found, sign * true, rtol=0, atol=2 * tolerance)


def roots(frames: list[dict[str, Any]], agent: int) -> np.ndarray:
    return pose_from_matrix(np.array([f["agents"][agent]["sim_obj_T"] for f in frames]))


def objects(frames: list[dict[str, Any]]) -> np.ndarray:
    return np.array([[(*o["translation"], *o["rotation_xyzw"]) for o in f["objects"]] for f in frames])


# --- first generation -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("episode", [0, 1])
@pytest.mark.parametrize(("ending", "tolerance"), [("json", ROUNDED), ("pkl", FLOAT32)])
def test_a_paper_era_log_equals_the_truth(hitl: Path, truth: Any, episode: int, ending: str, tolerance: float) -> None:
    recording = read_hitl_log(hitl / "session_2users" / "gen1" / f"session.{episode}.{ending}.gz")
    frames = truth["session_2users"][episode]
    columns = recording.columns
    assert [a.kind for a in recording.agents] == ["robot", "human"]
    np.testing.assert_allclose(
        columns["agent_0.base_pose"][:, :3], [f["agents"][0]["base_pos"] for f in frames], rtol=0, atol=tolerance
    )
    assert_rotations(columns["agent_0.base_pose"][:, 3:], roots(frames, 0)[:, 3:], tolerance)
    assert_poses(columns["agent_1.root_pose"], roots(frames, 1), tolerance)
    np.testing.assert_allclose(
        columns["agent_1.base_pose"][:, :3], [f["agents"][1]["base_pos"] for f in frames], rtol=0, atol=tolerance
    )
    joints = np.array([f["agents"][1]["joint_positions"] for f in frames]).reshape(-1, 54, 4)
    assert_rotations(columns["agent_1.joint_quat"], joints, tolerance)
    np.testing.assert_allclose(columns["agent_0.action"], [f["action_robot"] for f in frames], atol=tolerance)
    held = [f["agents"][1]["snap_idx"] for f in frames]
    np.testing.assert_array_equal(columns["agent_1.grasp_id"], [-1 if i is None else i for i in held])


def test_what_else_a_paper_era_log_holds(hitl: Path, truth: Any) -> None:
    recording = read_hitl_log(hitl / "session_2users" / "gen1" / "session.0.json.gz")
    frames, info, columns = truth["session_2users"][0], recording.episode.info, recording.columns
    assert recording.episode.episode_id == "17"
    assert info["synthesised"] == {"robot": ["joint_pos"], "human": ["body"]}
    assert info["target_obj_ids"] == [63, 64]
    ids = [o["object_id"] for o in frames[0]["objects"]]
    at = [ids.index(i) for i in info["target_obj_ids"]]
    np.testing.assert_allclose(columns["object_pose"][:, :, :3], objects(frames)[:, at, :3], rtol=0, atol=ROUNDED)
    np.testing.assert_array_equal(columns["metrics.did_collide"], [f["metrics"]["did_collide"] for f in frames])
    distance = [f["metrics"]["object_to_goal_distance"]["1"] for f in frames]
    np.testing.assert_allclose(columns["metrics.object_to_goal_distance.1"], distance, atol=1e-5)
    by_keys = np.array([f["gui_walk"] != "hint" for f in frames])
    np.testing.assert_array_equal(np.isfinite(columns["input.user_0.cam_yaw"]), by_keys)
    np.testing.assert_array_equal(np.isnan(columns["input.user_0.hint_walk_dir"]).all(1), by_keys)
    assert [(e.step, e.agent, e.kind, e.target) for e in recording.events] == [
        (80, 1, "pick", "object_63"),
        (148, 1, "place", ""),
    ]


# --- second generation ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("episode", [0, 1])
@pytest.mark.parametrize("session", ["session_2users", "session_1user_policy"])
def test_a_session_episode_equals_the_truth(hitl: Path, truth: Any, session: str, episode: int) -> None:
    recording = read_hitl_episode(hitl / session / "gen2" / f"{10 + episode}.json.gz")
    frames, columns = truth[session][episode], recording.columns
    known = np.array([not f["empty_in_gen2"] for f in frames])
    np.testing.assert_array_equal(columns["recorded"], known)
    there = [f for f in frames if not f["empty_in_gen2"]]
    base = np.array([f["agents"][0]["base_pos"] for f in there])
    np.testing.assert_allclose(columns["agent_0.base_pose"][known, :3], base, rtol=0, atol=ROUNDED)
    assert_rotations(columns["agent_0.base_pose"][known, 3:], roots(there, 0)[:, 3:], ROUNDED)
    assert_poses(columns["agent_1.root_pose"][known], roots(there, 1), ROUNDED)
    assert [b.name for b in recording.moving_bodies] == [o["handle"] for o in frames[0]["objects"]]
    assert_poses(columns["object_pose"][known], objects(there), ROUNDED)
    for user in range(len(frames[0]["users"])):
        seen = pose_to_matrix(columns[f"user.user_{user}_camera"].astype(np.float64))
        assert np.isnan(seen[~known, 0]).all()
        true = np.array([f["users"][user]["camera_T"] for f in there])
        np.testing.assert_allclose(seen[known], true, rtol=0, atol=2e-5)
        holds = [f["users"][user]["held_object"] for f in there]
        np.testing.assert_array_equal(
            columns[f"input.user_{user}.held_object"][known], [-1 if i is None else i for i in holds]
        )
    t = np.array([f["t"] for f in frames])
    np.testing.assert_allclose(columns["time_ns"][known] * 1e-9, (t - t[0])[known], rtol=0, atol=1.1e-5)
    clean = [[o["states"].get("is_clean", -1) for o in f["objects"]] for f in there]
    np.testing.assert_array_equal(columns["object_state.is_clean"][known], clean)
    true_events = [(k, e["type"]) for k, f in enumerate(frames) for u in f["users"] for e in u["events"]]
    assert [(e.step, e.kind) for e in recording.events] == true_events


def test_events_name_who_did_what(hitl: Path) -> None:
    recording = read_hitl_episode(hitl / "session_2users" / "gen2" / "11.json.gz")
    events = {e.kind: e for e in recording.events}
    assert events["error_reported"].agent == 0
    assert json.loads(events["error_reported"].detail)["error_report"] == "object fell through the floor"
    assert json.loads(events["state_change"].detail) == {"user": 1, "state_name": "is_clean", "new_value": True}
    held = recording.columns["agent_0.grasp_body"]
    assert recording.bodies[held[100]].name == "sphere_:0000"
    policy = read_hitl_episode(hitl / "session_1user_policy" / "gen2" / "10.json.gz")
    assert {e.agent for e in policy.events} == {1}  # the only user is the person, not the robot


def test_frames_without_anybody_active_keep_the_state(hitl: Path) -> None:
    columns = read_hitl_episode(hitl / "session_2users" / "gen2" / "10.json.gz").columns
    gap = np.flatnonzero(~columns["recorded"])
    assert len(gap) == 35
    np.testing.assert_array_equal(
        columns["agent_1.root_pose"][35:47], np.tile(columns["agent_1.root_pose"][34], (12, 1))
    )
    assert (np.diff(columns["time_ns"]) > 2e7).all()


def test_people_without_a_logged_posture_walk_on_the_floor(hitl: Path) -> None:
    recording = read_hitl_episode(hitl / "session_1user_policy" / "gen2" / "10.json.gz")
    assert "joints" in recording.episode.info["synthesised"]["human"]
    replay = h3data.Replay(recording, detail=False)
    person = next(k for k, d in enumerate(replay.drawables) if d.name == "human")
    points = replay.vertices(person, np.arange(0, 200, 4))
    floor = recording.columns["agent_1.base_pose"][::4, 1]
    np.testing.assert_allclose(points[..., 1].min(1), floor, atol=0.02)
    assert (np.ptp(points[..., 1], axis=1) > 1.5).all()
    moving = recording.columns["agent_1.motion_blend"] > 0.99
    assert 0.3 < moving.mean() < 1
    walked = np.linalg.norm(np.diff(recording.columns["agent_1.base_pose"][:, [0, 2]], axis=0), axis=1)
    phase = np.diff(recording.columns["agent_1.motion_phase"]) % 1
    steady = moving[1:] & moving[:-1] & (np.diff(recording.columns["agent_1.motion_id"]) == 0) & (walked > 0.02)
    strides = walked[steady] / phase[steady]
    assert np.ptp(strides[(strides > 0.5) & (strides < 3)]) < 1.2  # the clip advances with the way, not with time


# --- as recordings ----------------------------------------------------------------------------------------------------
def test_they_are_stored_without_loss(hitl: Path, tmp_path: Path) -> None:
    sources: list[Recording] = [
        read_hitl_log(hitl / "session_2users" / "gen1" / "session.0.pkl.gz"),
        read_hitl_episode(hitl / "session_2users" / "gen2" / "10.json.gz"),
    ]
    for k, recording in enumerate(sources):
        write_mcap(recording, tmp_path / f"{k}.mcap")
        assert recordings_equal(recording, read_mcap(tmp_path / f"{k}.mcap")) == []
    with DatasetWriter(tmp_path / "ds", like=sources) as out:
        for recording in sources:
            out.add(recording)
    for k, recording in enumerate(sources):
        assert recordings_equal(recording, Dataset(tmp_path / "ds").recording(k)) == []


def test_the_scene_is_taken_if_it_is_there(real: Path, hitl: Path) -> None:
    library = AssetLibrary([real / "habitat-lab" / "reference" / "navmesh"])
    log = hitl / "session_2users" / "gen2" / "10.json.gz"
    recording = read_hitl_episode(log, assets=library)
    assert "scene.glb" in recording.attachments
    picture = h3data.render_frame(recording, camera="top_down", step=0, outputs=("instance",))["instance"]
    assert len(np.unique(picture)) > 5
    without = read_hitl_episode(log)
    assert "stages/flat.not_found" in h3data.Replay(without).missing
    assert without.bodies[-1].pose[1] == pytest.approx(0.11)  # right under the feet


def test_a_folder_is_imported_with_a_table(hitl: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", str(hitl / "session_2users"), "-o", str(tmp_path), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    kinds = {Path(f["source"]).name: (f["status"], f["kind"]) for f in data["files"]}
    assert kinds["session.0.pkl.gz"] == ("imported", "hitl_log")
    assert kinds["session.0.json.gz"] == ("skipped", "hitl_log")
    assert kinds["10.json.gz"] == ("imported", "hitl_episode")
    assert kinds["session.json.gz"] == ("skipped", "hitl_session")
    assert kinds["session.gfx_replay.json.gz"] == ("imported", "gfx_replay")
    assert len(h3data.open(tmp_path / "gen2" / "10.mcap")) == 200
    assert main(["import", str(hitl / "session_2users" / "gen2"), "-o", str(tmp_path / "again")]) == 0
    table = capsys.readouterr().out
    assert "skipped   hitl_session" in table
    assert "2 imported, 1 skipped, 0 failed" in table
