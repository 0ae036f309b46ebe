"""The command line as its users meet it: results, JSON for machines, refusals in one line, nothing half-written."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.errors import InputError
from h3data.replay import CameraTrack
from h3data_pipelines.cli import jsonable, main
from h3data_pipelines.commands.table import all_commands
from h3data_pipelines.pictures.rerender import parse_steps

DEMO_FILES = (
    "episode.mcap",
    "first_picture.png",
    "metrics.json",
    "third_person.mp4",
    "arm_depth.mp4",
    "top_down.mp4",
    "episode.rrd",
    "summary.json",
)

COMMANDS = all_commands()


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> Any:
    """The JSON object that a command prints; fails unless it exits with 0."""
    capsys.readouterr()
    code = main([*map(str, arguments), "--json"])
    out = capsys.readouterr().out
    assert code == 0, out
    return json.loads(out)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short demo, run once."""
    out = tmp_path_factory.mktemp("demo") / "out"
    assert main(["demo", "-o", str(out), "--steps", "24", "--size", "362x203"]) == 0
    return out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    assert "Examples:" in out
    assert f"h3data {command}" in out
    assert "--json" in out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_breaks_no_word_on_a_terminal(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main([command, "--help"])
    paragraphs, _, _ = capsys.readouterr().out.partition("Examples:")
    # indented: tables, which may be wider
    wide = [line for line in paragraphs.splitlines() if len(line) > 80 and not line.startswith((" ", "usage"))]
    assert not wide


def test_demo_says_first_what_it_has_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import av
    import cv2

    out = tmp_path / "demo"
    assert main(["demo", "-o", str(out), "--steps", "8", "--size", "160x120", "--light", "flat"]) == 0
    said, told = capsys.readouterr()
    places = [told.index(word) for word in ("recorded in", "Finding success", "first_picture.png", "videos follow")]
    assert places == sorted(places)
    assert "Finding success" not in said  # once is enough
    assert main(["demo", "-o", str(out), "--steps", "8", "--light", "flat", "--force", "--quiet"]) == 0
    said, told = capsys.readouterr()
    assert told == ""
    assert "Finding success" in said
    with av.open(str(out / "third_person.mp4")) as container:  # small, since videos take most of the time
        assert (container.streams.video[0].width, container.streams.video[0].height) == (480, 360)
    picture = cv2.imread(str(out / "first_picture.png"))
    assert picture is not None
    assert picture.shape == (480, 640, 3)


def test_demo_draws_the_map_while_it_searches_a_view_and_stops_when_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from h3data_pipelines.commands import demo as module

    begun, searches, find, render = Event(), [], module.camera_track, module.render_files

    def search(replay: h3data.Replay, name: str) -> CameraTrack:
        if name != "third_person":
            return find(replay, name)
        searches.append(begun.wait(10))
        raise KeyboardInterrupt

    def begin(*arguments: Any, frame_done: Callable[[], object], **options: Any) -> None:
        def drawn() -> None:
            begun.set()
            time.sleep(0.1)  # so that there are frames left to stop
            frame_done()

        render(*arguments, frame_done=drawn, **options)

    monkeypatch.setattr(module, "camera_track", search)
    monkeypatch.setattr(module, "render_files", begin)
    assert main(["demo", "-o", str(tmp_path / "out"), "--steps", "90", "--light", "flat"]) == 130
    assert searches == [True]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["episode.mcap", "metrics.json"]


def test_demo_searches_a_view_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from h3data.replay import cameras

    searches, find = [], cameras.third_person
    monkeypatch.setattr(cameras, "third_person", lambda *given: searches.append(1) or find(*given))
    assert main(["demo", "-o", str(tmp_path / "out"), "--steps", "4", "--size", "64x48", "--light", "flat"]) == 0
    assert len(searches) == 1  # for the picture, the video and the file for Rerun


def test_demo_makes_everything(demo: Path) -> None:
    for name in DEMO_FILES:
        assert (demo / name).stat().st_size > 0, name
    assert not list(demo.rglob("*.part"))
    summary = json.loads((demo / "summary.json").read_text())
    assert summary["steps"] == 24
    assert set(summary["files"]) == {*DEMO_FILES[:-1], "dataset"}
    recording = h3data.open(demo / "episode.mcap")
    dataset = h3data.open(demo / "dataset")
    assert len(dataset) == 1
    from h3data.recording import recordings_equal

    assert recordings_equal(recording, dataset.recording(0)) == []


def test_demo_videos_play(demo: Path) -> None:
    import av

    for name, size in (("third_person", (362, 203)), ("arm_depth", (224, 171))):
        with av.open(str(demo / f"{name}.mp4")) as container:
            stream = container.streams.video[0]
            assert stream.codec_context.name == "h264"
            assert (stream.width + stream.width % 2, stream.height // 2 * 2) == (size[0], (size[1] + 1) // 2 * 2)
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert len(frames) == 12  # 15 a second
        assert np.std(frames[0]) > 10  # a picture, not a plain colour


def test_python_api_on_the_demo(demo: Path) -> None:
    recording = h3data.open(demo / "episode.mcap")
    assert "24 steps" in repr(recording)
    state = h3data.Replay(recording).at(step=-1)
    assert state.step == 23
    assert {"robot", "human"} == set(state.agents)
    image = h3data.render_frame(recording, camera="third_person", step=20, outputs=("rgb", "depth"))
    assert image["rgb"].shape == (480, 640, 3)
    assert (image["depth"] > 0).mean() > 0.5
    flat = h3data.render_frame(recording, camera="third_person", step=20, light="flat")["rgb"]
    assert np.abs(image["rgb"].astype(int) - flat).mean() > 3
    assert h3data.measure(recording).values["TD"] > 0


def test_existing_output_is_kept_without_force(demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {p: p.stat().st_mtime_ns for p in demo.rglob("*")}
    assert main(["demo", "-o", str(demo), "--steps", "5"]) == 2
    assert "--force" in capsys.readouterr().err
    assert {p: p.stat().st_mtime_ns for p in demo.rglob("*")} == before


def test_rerender_view_and_metrics(demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episode = demo / "episode.mcap"
    data = run_json(
        capsys,
        "rerender",
        episode,
        "--camera",
        "top_down",
        "--camera",
        "robot_arm",
        "--outputs",
        "rgb,depth,instance",
        "--steps",
        "0:10:2",
        "-o",
        tmp_path / "v",
    )
    files = [Path(f) for f in data["recordings"][0]["files"]]
    assert len(files) == 6
    assert all(f.stat().st_size > 0 for f in files)
    data = run_json(
        capsys,
        "rerender",
        episode,
        "--camera",
        "robot_arm",
        "--outputs",
        "depth",
        "--steps",
        "3",
        "--format",
        "png",
        "-o",
        tmp_path / "p",
    )
    import cv2

    png = cv2.imread(str(Path(data["recordings"][0]["files"][0]) / "000003.png"), cv2.IMREAD_UNCHANGED)
    recording = h3data.open(episode)
    depth = h3data.render_frame(recording, camera="robot_arm", step=3, outputs=("depth",))["depth"]
    np.testing.assert_allclose(png / 1000.0, np.minimum(depth, 65.535), atol=6e-4)  # type: ignore[operator]
    data = run_json(capsys, "metrics", episode)
    assert data["episodes"][0]["values"]["TD"] > 0
    data = run_json(capsys, "view", episode, "-o", tmp_path / "e.rrd")
    assert data["bytes"] > 10_000


@pytest.mark.slow
def test_an_episode_of_a_dataset_can_be_drawn_and_viewed(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = f"{demo / 'dataset'}#0"
    data = run_json(capsys, "rerender", episode, "--steps", "0:4", "--outputs", "rgb,depth", "-o", tmp_path / "v")
    assert [Path(f).name for f in data["recordings"][0]["files"]] == [
        "dataset#0.top_down.rgb.mp4",
        "dataset#0.top_down.depth.mp4",
    ]
    import av

    with av.open(data["recordings"][0]["files"][1]) as container:
        picture = next(container.decode(video=0)).to_ndarray(format="rgb24")  # type: ignore[attr-defined]
    assert np.std(picture.reshape(-1, 3), axis=0).max() > 20  # not one flat colour
    run_json(capsys, "view", episode, "-o", tmp_path / "e.rrd")
    assert main(["view", str(demo / "dataset"), "-o", str(tmp_path / "f.rrd")]) == 2
    assert "#0" in capsys.readouterr().err
    assert main(["view", f"{demo / 'dataset'}#7", "-o", str(tmp_path / "f.rrd")]) == 2
    assert "no episode 7" in capsys.readouterr().err
    assert len([*h3data.open(demo / "dataset")]) == 1
    assert len(h3data.open(demo / "dataset")[-1]) == 24


@pytest.mark.slow  # quick: test_rerender, the same bytes
def test_depth_videos_are_the_same_every_time(demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episode, files = demo / "episode.mcap", []
    for name in ("a", "b", "c"):
        options = ("--camera", "robot_arm", "--outputs", "depth", "-o", tmp_path / name)
        files.append(run_json(capsys, "rerender", episode, *options)["recordings"][0]["files"][0])
    assert len({Path(f).read_bytes() for f in files}) == 1


def test_a_camera_from_a_file(demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = tmp_path / "shoulder.toml"
    camera.write_text('eye = [-1.0, 1.6, 0.0]\ntarget = [1.0, 1.0, 0.0]\nfollow = "human"\nwidth = 160\nheight = 120\n')
    data = run_json(
        capsys, "rerender", demo / "episode.mcap", "--camera", camera, "--steps", "0:4", "-o", tmp_path / "v"
    )
    assert data["recordings"][0]["files"][0].endswith("episode.shoulder.rgb.mp4")
    camera.write_text("eye = [1, 2]\n")
    assert main(["rerender", str(demo / "episode.mcap"), "--camera", str(camera), "-o", str(tmp_path / "w")]) == 2


def test_same_seed_same_episodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = (
        run_json(
            capsys,
            "generate",
            "social_nav",
            "--episodes",
            "3",
            "--homes",
            "2",
            "--seed",
            "7",
            "--max-steps",
            "20",
            "-o",
            tmp_path / name,
        )
        for name in ("a", "b")
    )
    assert first["state_hashes"] == second["state_hashes"]
    assert len(set(first["state_hashes"])) == 3
    assert set(first["metrics"]["summary"]) >= {"S", "SPS", "F", "CR", "BYR", "TD", "FD"}
    from h3data.recording import recordings_equal

    for i in range(3):
        a, b = (h3data.open(tmp_path / name).recording(i) for name in ("a", "b"))
        assert recordings_equal(a, b) == []
    other = run_json(
        capsys,
        "generate",
        "social_nav",
        "--episodes",
        "3",
        "--homes",
        "2",
        "--seed",
        "8",
        "--max-steps",
        "20",
        "-o",
        tmp_path / "c",
    )
    assert not set(other["state_hashes"]) & set(first["state_hashes"])


def test_an_interrupted_dataset_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["generate", "social_nav", "--homes", "1", "--seed", "7", "--max-steps", "30", "-o"]
    whole = run_json(capsys, *options, tmp_path / "whole", "--episodes", "3")
    run_json(capsys, *options, tmp_path / "parts", "--episodes", "1")
    assert main([*options, str(tmp_path / "parts"), "--episodes", "3"]) == 2
    said = capsys.readouterr().err
    assert "a dataset of 1 finished episode. --resume goes on" in said
    assert said.index("--resume") < said.index("--force")
    rest = run_json(capsys, *options, tmp_path / "parts", "--episodes", "3", "--resume")
    assert rest["new"] == 2
    assert rest["state_hashes"] == whole["state_hashes"]


BAD = {
    "missing file": (["metrics", "nowhere.mcap"], "no such file"),
    "missing replay": (["import", "nowhere.json", "-o", "rec"], "no such file"),
    "not json": (["import", "text.json", "-o", "rec"], "JSON"),
    "json of another kind": (["import", "other.json", "-o", "rec"], "an episode dataset"),
    "truncated replay": (["import", "cut.gfx_replay.json", "-o", "rec"], "JSON"),
    "empty folder": (["import", "empty", "-o", "rec"], "No .json"),
    "unknown task": (["generate", "dishes", "-o", "ds"], "social_nav"),
    "unknown policy": (["generate", "social_nav", "--policy", "magic", "-o", "ds"], "rollout_expert"),
    "unknown scenes": (["generate", "social_nav", "--scenes", "castle", "-o", "ds"], "small"),
    "no episodes": (["generate", "social_nav", "--episodes", "0", "-o", "ds"], "--episodes"),
    "unknown body": (["generate", "social_nav", "--human", "yeti", "-o", "ds"], "female_0"),
    "unknown camera": (["rerender", "EPISODE", "--camera", "sky", "-o", "v"], "top_down"),
    "unknown output": (["rerender", "EPISODE", "--outputs", "smell", "-o", "v"], "rgb, depth, instance"),
    "no such steps": (["rerender", "EPISODE", "--steps", "900:", "-o", "v"], "24 steps"),
    "unreadable steps": (["rerender", "EPISODE", "--steps", "a:b", "-o", "v"], "start:stop:stride"),
    "a text file as recording": (["rerender", "text.json", "-o", "v"], "text.json"),
    "missing asset root": (["rerender", "EPISODE", "--assets", "nowhere", "-o", "v"], "nowhere"),
    "out is a file": (["demo", "-o", "text.json"], "text.json"),
    "misspelt camera": (["rerender", "EPISODE", "--camera", "third_persn", "-o", "v"], "Did you mean 'third_person'?"),
    "misspelt metric": (["metrics", "explain", "Spz"], "Did you mean 'SPS'?"),
    "misspelt task": (["generate", "socal_nav", "-o", "ds"], "Did you mean 'social_nav'?"),
    "misspelt set": (["scenes", "list", "h3-homes/tset"], "Did you mean 'h3-homes/test'?"),
    "misspelt body": (["bodies", "show", "femal_0"], "Did you mean 'female_0'?"),
    "misspelt robot": (["robots", "show", "quadarm"], "Did you mean 'quad_arm'?"),
    "view of another kind": (["view", "EPISODE", "-o", "x.mp4"], "ends in .rrd, .html, .png or .jpg, got: x.mp4"),
    "recovered as another kind": (["recover", "EPISODE", "-o", "x.txt"], "ends in .mcap, got: x.txt"),
    "explain nothing": (["metrics", "explain"], "explain NAME [RECORDING]"),
    "folder without recordings": (["metrics", "empty"], "No recording (.mcap) and no dataset in this folder"),
    "report of nothing": (["report", "empty"], "No recording (.mcap) and no dataset in this folder"),
    "replay without a wish": (["replay", "EPISODE"], "Choose what to do: --verify"),
}


@pytest.mark.parametrize("case", BAD)
def test_refusals(
    case: str, demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One clear line, exit code 2, nothing written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.json").write_text("hello")
    (tmp_path / "other.json").write_text('{"episodes": []}')
    (tmp_path / "cut.gfx_replay.json").write_text('{"keyframes": [{"loads": [')
    before = sorted(p for p in tmp_path.rglob("*"))
    arguments, hint = BAD[case]
    code = main([str(demo / "episode.mcap") if a == "EPISODE" else a for a in arguments])
    error = capsys.readouterr().err
    assert code == 2, error
    lines = [line for line in error.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert hint in lines[0]
    assert "Traceback" not in error
    files = [p for p in tmp_path.rglob("*") if p not in before and p.is_file()]
    assert files == []


def test_errors_are_json_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["metrics", str(tmp_path / "none.mcap"), "--json"]) == 2
    said, line = map(str, capsys.readouterr())
    assert "no such file" in json.loads(said)["error"]
    assert line.endswith(f" [{json.loads(said)['code']}]\n")


def test_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, "doctor")
    assert data["checks"]["CPU renderer (numba)"]["ok"]
    assert data["versions"]["h3data"]


def test_json_has_no_nan() -> None:
    assert (
        json.dumps(jsonable({"a": np.float32("nan"), "b": [np.int64(3), float("inf")]}))
        == '{"a": null, "b": [3, null]}'
    )


def test_step_ranges() -> None:
    assert parse_steps("", 5) == range(5)
    assert parse_steps("1:4:2", 5) == range(1, 4, 2)
    assert parse_steps("-2:", 5) == range(3, 5)
    assert parse_steps("3", 5) == range(3, 4)
    assert parse_steps("-1", 5) == range(4, 5)
    for bad in ("x", "1:2:0", "9:", "1:2:3:4"):
        with pytest.raises(InputError):
            parse_steps(bad, 5)
