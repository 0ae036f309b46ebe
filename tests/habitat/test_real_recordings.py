"""Every recording in ../shared/real imports, validates and is drawn, and is where the simulator says it was."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.geometry import pose_from_matrix, pose_inverse, pose_multiply, pose_to_matrix
from h3data.recording.assets.library import AssetLibrary
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_pipelines.cli import main
from h3data_pipelines.validation.recordings import validate_recording

FLOAT32 = 2e-6
"""gfx-replays hold 7 decimals of single precision; matrices of quaternions that were rounded so."""
CHAIR_ORIGIN = np.array([0.0740, 0.2070, -0.0059, 0, 0, 0, 1])  # of its mesh in the frame that truth has, the COM's

HITL = "habitat-lab/reference/hitl"
IMPORTED = {
    f"{HITL}/session_2users/gen1/session.0.pkl.gz": 200,
    f"{HITL}/session_2users/gen1/session.1.pkl.gz": 200,
    f"{HITL}/session_2users/gen1/session.gfx_replay.json.gz": 400,
    f"{HITL}/session_2users/gen2/10.json.gz": 200,
    f"{HITL}/session_2users/gen2/11.json.gz": 200,
    f"{HITL}/session_1user_policy/gen2/10.json.gz": 200,
    f"{HITL}/session_1user_policy/gen2/11.json.gz": 200,
    f"{HITL}/session_1user_policy/gfx/episode_0.gfx_replay.json.gz": 200,
    f"{HITL}/session_1user_policy/gfx/episode_1.gfx_replay.json.gz": 200,
    "habitat-sim/reference/replays/room_articulated/replay.gfx_replay.json": 60,
    "habitat-sim/reference/replays/room_rigid/replay.gfx_replay.json": 90,
    "habitat-sim/reference/replays/room_rigid_flat/replay.gfx_replay.json": 90,
    "habitat-sim/reference/replays/room_skinned/replay.gfx_replay.json": 60,
    "hitl/minimal.gfx_replay.json": 1,
    "hitl/my_session.gfx_replay.json": 503,
}
"""Steps by file."""
ROOMS = ("room_articulated", "room_rigid", "room_rigid_flat", "room_skinned")


@pytest.fixture(scope="module")
def assets(real: Path) -> list[Path]:
    return [real / "habitat-sim", real / "habitat-lab" / "reference" / "navmesh"]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rec")


@pytest.fixture(scope="module")
def report(real: Path, out: Path, assets: list[Path]) -> dict[str, dict[str, Any]]:
    """What ``h3data import DIR`` says of each file."""
    from h3data_pipelines.commands.importing import Import

    outcome = Import(paths=(real,), out=out, assets=tuple(assets)).run()
    assert outcome.exit_code == 0
    return {str(Path(row["source"]).relative_to(real)): row for row in outcome.data["files"]}


@pytest.mark.slow
def test_the_whole_folder_is_told_apart(report: dict[str, dict[str, Any]]) -> None:
    imported = {name: row["steps"] for name, row in report.items() if row["status"] == "imported"}
    assert imported == IMPORTED
    assert {row["status"] for row in report.values()} == {"imported", "skipped"}
    for name in ("habitat-sim/reference/replays/room_rigid/meta.json", "habitat-lab/geodesic-golden.json"):
        assert report[name]["kind"] == "json"  # the first has keyframes, but none of a gfx-replay; both hold Infinity
    assert "its keyframes hold nothing of one" in report["habitat-sim/reference/replays/room_rigid/meta.json"]["reason"]


@pytest.mark.parametrize("name", IMPORTED)
def test_each_is_valid_and_drawn(report: dict[str, dict[str, Any]], assets: list[Path], name: str) -> None:
    recording = h3data.open(report[name]["recording"])
    library = AssetLibrary(assets)
    assert [f for f in validate_recording(recording, assets=library) if f.severity == "error"] == []
    replay = h3data.Replay(recording, assets=library)
    for camera in ("top_down", "third_person") if recording.agents else ("top_down",):
        picture = h3data.render_frame(replay, camera=camera, step=len(recording) // 2, outputs=("rgb", "instance"))
        assert (picture["instance"] >= 0).mean() > 0.005
        if name != "hitl/minimal.gfx_replay.json":  # one floor, seen from above
            assert picture["rgb"].std() > 3
        seen = {replay.drawables[i].agent for i in np.unique(picture["instance"]) if i >= 0}
        assert seen >= (set(range(len(recording.agents))) if camera == "top_down" else {0})


@pytest.mark.slow
def test_all_are_drawn_by_the_command(
    report: dict[str, dict[str, Any]], assets: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, row in enumerate(row for row in report.values() if row["status"] == "imported"):
        cameras = ["top_down", "third_person"] if row["agents"] else ["top_down"]
        stride, folder = max(row["steps"] // 2, 1), tmp_path / str(number)
        options = [word for camera in cameras for word in ("--camera", camera)] + ["--format", "png", "-o", str(folder)]
        options += [
            "--steps",
            f"0:{row['steps']}:{stride}",
            *(word for folder in assets for word in ("--assets", str(folder))),
        ]
        assert main(["rerender", row["recording"], *options]) == 0
        assert len(list(folder.rglob("*.png"))) == len(cameras) * len(range(0, row["steps"], stride))
    capsys.readouterr()


# --- poses ------------------------------------------------------------------------------------------------------------
def matrices(poses: np.ndarray) -> np.ndarray:
    return pose_to_matrix(poses.astype(np.float64))


@pytest.mark.parametrize("name", ROOMS)
def test_cameras_and_agent_are_where_the_simulator_had_them(real: Path, name: str) -> None:
    folder = real / "habitat-sim" / "reference" / "replays" / name
    recording = read_gfx_replay(folder / "replay.gfx_replay.json")
    keyframes = json.loads((folder / "meta.json").read_text())["keyframes"]
    cameras = [n for n in recording.columns if n.startswith("user.cam_")]
    assert len(cameras) == 5
    for column in cameras:
        true = np.array([k["camera_to_world"] for k in keyframes])
        np.testing.assert_allclose(matrices(recording.columns[column]), true, rtol=0, atol=FLOAT32)
    true = np.array([k["agent_to_world"] for k in keyframes])
    np.testing.assert_allclose(matrices(recording.columns["user.agent"]), true, rtol=0, atol=FLOAT32)


def test_bones_stay_where_they_are_in_their_links(real: Path) -> None:
    folder = real / "habitat-sim" / "reference" / "replays" / "room_skinned"
    recording = read_gfx_replay(folder / "replay.gfx_replay.json")
    keyframes = json.loads((folder / "meta.json").read_text())["keyframes"]
    for rig in recording.episode.info["rigs"]:
        for k, bone in enumerate(rig["bones"]):
            link = np.array([f["articulated"][rig["id"]]["links"][bone]["world"] for f in keyframes])
            column = recording.columns[f"rig.{rig['id']}"][:, k].astype(np.float64)
            inside = pose_to_matrix(pose_multiply(pose_inverse(pose_from_matrix(link)), column))
            assert np.ptp(link, axis=0).max() > 0.05 or bone == rig["bones"][0]
            assert np.ptp(inside, axis=0).max() < 2e-5


@pytest.mark.parametrize("episode", [0, 1])
def test_a_session_replay_equals_the_truth(real: Path, episode: int) -> None:
    """Rigid bodies, agents' roots and cameras in the gfx-replay that a HITL session writes beside its log."""
    session = real / HITL / "session_1user_policy"
    recording = read_gfx_replay(session / "gfx" / f"episode_{episode}.gfx_replay.json.gz")
    with gzip.open(session / "truth.json.gz") as stream:
        frames = json.load(stream)["episodes"][episode]["frames"]
    columns = recording.columns
    for agent in (0, 1):
        root = np.array([f["agents"][agent]["sim_obj_T"] for f in frames])
        np.testing.assert_allclose(matrices(columns[f"user.agent_{agent}"]), root, rtol=0, atol=FLOAT32)
        seen = np.array([f[f"camera_agent_{agent}_T"] for f in frames])
        np.testing.assert_allclose(matrices(columns[f"user.sensor_camera_agent_{agent}"]), seen, rtol=0, atol=FLOAT32)
    for k, thing in enumerate(frames[0]["objects"]):
        kind = thing["handle"].split("_:")[0]
        body = next(b for b in recording.bodies if b.asset == kind)
        true = np.array([(*f["objects"][k]["translation"], *f["objects"][k]["rotation_xyzw"]) for f in frames])
        tolerance = FLOAT32
        if kind == "chair":  # the README gives its origin to 4 decimals
            true, tolerance = pose_multiply(true, CHAIR_ORIGIN), 1.5e-4
        ours = columns["object_pose"][:, body.moving] if body.moving >= 0 else np.tile(body.pose, (len(frames), 1))
        np.testing.assert_allclose(matrices(ours), pose_to_matrix(true), rtol=0, atol=tolerance)
