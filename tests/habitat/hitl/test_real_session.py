"""A true Habitat 3.0 human-in-the-loop session goes through import, rerender, metrics and view (needs ../shared/real)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data_pipelines.cli import main


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def session(real: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("real")
    assert main(["import", str(real / "hitl" / "my_session.gfx_replay.json"), "-o", str(out)]) == 0
    return out / "my_session.mcap"


def test_import_reports_what_is_there(real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = run(capsys, "import", real / "hitl" / "my_session.gfx_replay.json", "-o", tmp_path)
    assert data["steps"] == 503
    assert data["bodies"] == 352
    assert data["moving"] == 22
    assert [a["kind"] for a in data["agents"]] == ["robot", "human"]
    assert data["files"][0]["missing_assets"] == data["files"][0]["assets"]
    assert any("hab_spot_arm" in name for name in data["files"][0]["missing"])


def test_distances_are_those_of_the_two_agents(real: Path, session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = run(capsys, "metrics", session)["episodes"][0]["values"]
    # from the file itself: nodes of the robot's base and of the humanoid, folded by hand
    robot, human, distances = np.zeros(3), np.zeros(3), []
    frames = json.loads((real / "hitl" / "my_session.gfx_replay.json").read_text())["keyframes"]
    keys = {c["instanceKey"]: c["creation"]["filepath"] for c in frames[0]["creations"]}
    for frame in frames:
        for update in frame.get("stateUpdates", []):
            name = keys[update["instanceKey"]]
            position = np.array(update["state"]["absTransform"]["translation"])
            if name.endswith("/base.glb"):
                robot = position - [0, 0.48, 0]
            elif name.endswith("human_f.glb"):
                human = position - [0, 0.9, 0]
        distances.append(np.linalg.norm(robot - human))
    assert values["TD"] == pytest.approx(np.mean(distances), abs=1e-3)
    assert 1.0 <= values["FD"] <= 2.0
    assert values["CR"] is None  # a gfx-replay knows no contacts: undefined, not 0


def test_the_video_from_above_shows_the_motion(session: Path) -> None:
    replay = h3data.Replay(h3data.open(session))
    agent = np.array([d.agent for d in replay.drawables])
    centers = []
    for step in (0, 250, 502):
        picture = h3data.render_frame(replay, camera="top_down", step=step, outputs=("instance",))["instance"]
        where = [np.argwhere((picture >= 0) & (agent[picture] == a)) for a in (0, 1)]
        assert all(len(w) > 3 for w in where)
        centers.append([w.mean(0) for w in where])
    moved = np.linalg.norm(np.diff(np.array(centers), axis=0), axis=-1)
    assert moved.sum(0).min() > 20  # pixels
    assert len(replay.missing) == 229
    assert all(d.placeholder for d in replay.drawables)


def test_view_writes_a_rerun_file(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = run(capsys, "view", session, "-o", tmp_path / "s.rrd")
    assert data["bytes"] > 100_000
    assert len(data["missing"]) == 229


def test_the_smallest_replay(real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = run(capsys, "import", real / "hitl" / "minimal.gfx_replay.json", "-o", tmp_path)
    assert data["steps"] == 1
    run(capsys, "rerender", tmp_path / "minimal.mcap", "-o", tmp_path)
    assert main(["metrics", str(tmp_path / "minimal.mcap")]) == 2  # nobody in it
    assert "robot" in capsys.readouterr().err


def test_a_replay_whose_assets_are_here(real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = real / "habitat-sim" / "reference" / "replays" / "room_rigid" / "replay.gfx_replay.json"
    data = run(capsys, "import", source, "-o", tmp_path, "--assets", real / "habitat-sim")
    assert data["files"][0]["missing_assets"] == 0
    data = run(
        capsys,
        "rerender",
        tmp_path / "replay.mcap",
        "--camera",
        "user.cam_rgba_256x256",
        "--steps",
        "0:3",
        "--outputs",
        "rgb,depth",
        "--assets",
        real / "habitat-sim",
        "-o",
        tmp_path / "v",
    )
    assert data["recordings"][0]["missing"] == {}


def test_a_folder_is_walked(real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = run(capsys, "import", real / "hitl", "-o", tmp_path)
    assert data["imported"] == 2


def test_episodes_in_a_real_habitat_scene(real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stage = real / "habitat-sim" / "data" / "test_assets" / "scenes" / "simple_room.stage_config.json"
    data = run(
        capsys,
        "generate",
        "social_nav",
        "--scenes",
        stage,
        "--spawn-distance",
        "2.5",
        "--episodes",
        "2",
        "--max-steps",
        "90",
        "-o",
        tmp_path / "ds",
    )
    assert data["episodes"] == 2
    recording = h3data.open(tmp_path / "ds").recording(0)
    picture = h3data.render_frame(recording, camera="top_down", step=-1, outputs=("instance",))["instance"]
    assert len(np.unique(picture)) > 5
