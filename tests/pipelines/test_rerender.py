"""``h3data rerender``: exact data, the same bytes every time, resumed after any interruption."""

from __future__ import annotations

import json
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

import h3data
from h3data.recording import DatasetWriter
from h3data.recording.mcap.writer import write_mcap
from h3data.replay import camera_track
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from sim_kinematic.motion.spec import HOME_WALKER, SocialNavSpec
from tests.simulated import simulate_social_nav, social_nav_episode

CAMERA = 'eye = [-1.0, 1.6, 0.3]\ntarget = [1.0, 1.0, 0.0]\nfollow = "human"\nwidth = 97\nheight = 64\n'


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rerender")
    world = social_nav_episode(
        build_home(HomeSpec(seed=2)), seed=2, spec=SocialNavSpec(max_steps=24, human=HOME_WALKER)
    )
    write_mcap(simulate_social_nav(world), folder / "walk.mcap")
    (folder / "near.toml").write_text(CAMERA)
    return folder / "walk.mcap"


def rerender(capsys: pytest.CaptureFixture[str], *arguments: Any, code: int = 0) -> Any:
    capsys.readouterr()
    assert main(["rerender", *map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def files_below(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_data_is_exact_and_comes_with_its_cameras(
    episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    near = episode.with_name("near.toml")
    rerender(
        capsys,
        episode,
        "--camera",
        near,
        "--camera",
        "third_person",
        "--outputs",
        "rgb,depth,instance,semantic",
        "--format",
        "data",
        "--steps",
        "2:20:4",
        "-o",
        tmp_path,
    )
    log = json.loads((tmp_path / "walk.cameras.json").read_text())
    assert set(log["cameras"]) == {"near", "third_person"}
    entry, replay = log["cameras"]["near"], h3data.Replay(h3data.open(episode))
    track = camera_track(replay, str(near))
    np.testing.assert_allclose(entry["K"], track.camera.intrinsics)
    assert entry["steps"] == [2, 6, 10, 14, 18]
    np.testing.assert_allclose(entry["time_s"], replay.recording.columns["time_ns"][2:20:4] * 1e-9)
    np.testing.assert_allclose(entry["camera_to_world"], track.poses[2:20:4], atol=1e-6)
    wanted = dict(replay.frames([track], entry["steps"], outputs=("depth", "instance", "semantic")))
    with av.open(str(tmp_path / entry["outputs"]["depth"]["file"])) as container:
        assert container.streams.video[0].codec_context.name == "ffv1"
        depths = [frame.to_ndarray(format="gray16le") for frame in container.decode(video=0)]
    for depth, step in zip(depths, entry["steps"], strict=True):
        np.testing.assert_allclose(depth, wanted[step][0]["depth"] * 1e3, atol=0.51)
        for output in ("instance", "semantic"):
            folder = tmp_path / entry["outputs"][output]["file"]
            ids = cv2.imread(str(folder / f"{step:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert ids is not None
            np.testing.assert_array_equal(ids.astype(int) - 1, wanted[step][0][output])
    with av.open(str(tmp_path / entry["outputs"]["rgb"]["file"])) as container:
        assert container.streams.video[0].average_rate == pytest.approx(entry["frames_per_second"], rel=1e-3)
        assert sum(1 for _ in container.decode(video=0)) == 5


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["data", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("mp4", "av1", "png"))]
)
def test_the_same_bytes_with_any_number_of_workers(
    kind: str, episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = (
        episode,
        "--camera",
        episode.with_name("near.toml"),
        "--outputs",
        "rgb,depth,instance",
        "--format",
        kind,
        "--steps",
        "0:12",
    )
    for name, workers in (("one", 1), ("again", 1), ("many", 3)):
        rerender(capsys, *options, "--workers", workers, "-o", tmp_path / name)
    one = files_below(tmp_path / "one")
    assert len(one) == {"mp4": 4, "av1": 4, "data": 3 + 12, "png": 1 + 36}[kind]
    assert files_below(tmp_path / "again") == one
    assert files_below(tmp_path / "many") == one


def test_what_is_complete_is_kept(episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = (episode, "--steps", "0:6", "-o", tmp_path)
    near = ("--camera", episode.with_name("near.toml"))
    first = rerender(capsys, *options, *near)["recordings"][0]
    assert (len(first["files"]), first["kept"]) == (1, [])
    stamp = Path(first["files"][0]).stat().st_mtime_ns
    again = rerender(capsys, *options, *near)["recordings"][0]
    assert again["kept"] == first["files"]
    more = rerender(capsys, *options, *near, "--camera", "robot_arm", "--outputs", "rgb,depth")["recordings"][0]
    assert len(more["files"]) == 4
    assert more["kept"] == first["files"]
    assert Path(first["files"][0]).stat().st_mtime_ns == stamp
    log = json.loads(Path(first["cameras"]).read_text())
    assert {name: set(c["outputs"]) for name, c in log["cameras"].items()} == {
        "near": {"rgb", "depth"},
        "robot_arm": {"rgb", "depth"},
    }
    other = rerender(capsys, episode, "--steps", "0:7", "-o", tmp_path, *near, code=2)
    assert "made from another recording" in other["error"]
    changed = rerender(capsys, episode, "--steps", "0:7", "-o", tmp_path, *near, "--force")["recordings"][0]
    assert changed["kept"] == []
    assert len(json.loads(Path(first["cameras"]).read_text())["cameras"]["near"]["steps"]) == 7


@pytest.mark.slow
def test_a_folder_stands_for_all_recordings_in_it(
    episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `h3data import -o` leaves it: files of different sessions may have the same name."""
    for name in ("a/walk.mcap", "b/walk.mcap", "walk.mcap"):
        (tmp_path / "rec" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(episode, tmp_path / "rec" / name)
    with DatasetWriter(tmp_path / "rec" / "ds") as writer:
        for number in range(2):
            recording = h3data.open(episode)
            writer.add(replace(recording, episode=replace(recording.episode, uid=f"{number}")))
    options = ("--camera", episode.with_name("near.toml"), "--steps", "0:2", "-o", tmp_path / "out")
    found = rerender(capsys, tmp_path / "rec", *options)["recordings"]
    names = {str(Path(file).relative_to(tmp_path / "out")) for row in found for file in row["files"]}
    assert names == {f"{name}.near.rgb.mp4" for name in ("a/walk", "b/walk", "walk", "ds#0", "ds#1")}
    assert all((tmp_path / "out" / name).is_file() for name in names)
    again = rerender(capsys, tmp_path / "rec", *options)["recordings"]
    assert [row["kept"] for row in again] == [row["files"] for row in found]
    of_dataset = rerender(capsys, tmp_path / "rec" / "ds", *options)["recordings"]
    assert [row["kept"] for row in of_dataset] == [row["files"] for row in found[-2:]]
    (tmp_path / "none").mkdir()
    assert "No recording" in rerender(capsys, tmp_path / "none", *options, code=2)["error"]


@pytest.mark.slow
def test_pictures_of_another_size_with_smooth_edges(
    episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Videos to look at have four samples a pixel, data one; either can be had of both."""
    options = (episode, "--camera", "robot_arm", "--size", "112x64", "--steps", "3")
    colours = {}
    for name, more in (
        ("video", ()),
        ("rough", ("--samples", 1)),
        ("png", ("--format", "png")),
        ("smooth", ("--format", "png", "--samples", 4)),
    ):
        log = rerender(capsys, *options, *more, "-o", tmp_path / name)["recordings"][0]
        assert json.loads(Path(log["cameras"]).read_text())["cameras"]["robot_arm"]["width"] == 112
        (file,) = map(Path, log["files"])
        with av.open(str(file if file.is_file() else next(file.iterdir()))) as container:
            (frame,) = container.decode(video=0)
            colours[name] = frame.to_ndarray(format="rgb24").astype(int)
        assert colours[name].shape == (64, 112, 3)
    apart = {name: np.abs(colours[name] - colours["smooth"]).mean() for name in ("video", "rough")}
    assert apart["video"] < apart["rough"]
    assert np.abs(colours["png"] - colours["smooth"]).max() > 20
    for bad in ("112", "0x64", "112x99999", "-1x2"):
        assert "size such as 1280x720" in rerender(capsys, *options[:-3], bad, "-o", tmp_path / "no", code=2)["error"]


@pytest.mark.slow
def test_killed_at_any_time_it_goes_on(episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Only .part files and complete ones are there after a kill; the next run ends with what an undisturbed one makes."""
    near = str(episode.with_name("near.toml"))
    options = [str(episode), "--camera", near, "--camera", "robot_arm", "--outputs", "rgb,instance", "--format", "data"]
    rerender(capsys, *options, "-o", tmp_path / "whole")
    whole = files_below(tmp_path / "whole")
    out = tmp_path / "killed"
    command = [sys.executable, "-c", SLOW, "rerender", *options, "-o", str(out)]
    for patience in ("walk.near.part", "walk.robot_arm.part"):
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        while not ((out / patience).exists() and any(out.glob("*.part/000003.png"))) and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        left = files_below(out)
        finished = {name: data for name, data in left.items() if ".part" not in name and "cameras.json" not in name}
        assert len(finished) < len(whole)
        assert all(whole[name] == data for name, data in finished.items())
    assert any(name.startswith("walk.near.") for name in finished)  # the second run kept what the first camera has
    data = rerender(capsys, *options, "-o", out)["recordings"][0]
    assert {Path(f).name.split(".")[1] for f in data["kept"]} == {"near"}
    assert files_below(out) == whole


SLOW = """
import sys, time
from h3data.replay.stage import Stage
quick = Stage.render
def slow(*arguments, **options):
    time.sleep(0.05)
    return quick(*arguments, **options)
Stage.render = slow
from h3data_pipelines.cli import main
main(sys.argv[1:])
"""


@pytest.mark.slow  # quick: what is complete is kept
@pytest.mark.parametrize(
    ("kind", "unfinished"),
    [
        pytest.param("mp4", "rgb.mp4.part", marks=pytest.mark.slow),
        ("data", "depth.mkv.part"),
        pytest.param("png", "depth.part/", marks=pytest.mark.slow),
    ],
)
def test_a_full_disk_is_said_and_the_next_run_goes_on(
    kind: str, unfinished: str, episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The disk is one where no file grows as large as the largest must: the kernel refuses, as when nothing is left."""
    options = (
        episode,
        "--camera",
        episode.with_name("near.toml"),
        "--camera",
        "robot_arm",
        "--outputs",
        "rgb,depth",
        "--steps",
        "0:6",
        "--format",
        kind,
    )
    rerender(capsys, *options, "-o", tmp_path / "whole")
    whole, out = files_below(tmp_path / "whole"), tmp_path / "full"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (max(map(len, whole.values())) - 1, limits[1]))
    try:
        error = rerender(capsys, *options, "-o", out, code=2)["error"]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "to continue" in error
    left = files_below(out)
    assert any(name.startswith(f"walk.robot_arm.{unfinished}") for name in left)
    complete = {name: data for name, data in left.items() if ".part" not in name and "cameras.json" not in name}
    assert all(whole[name] == data for name, data in complete.items())
    assert {name for name in complete if "near" in name} == {name for name in whole if "near" in name}
    assert len(rerender(capsys, *options, "-o", out)["recordings"][0]["kept"]) == 2
    assert files_below(out) == whole


def test_one_bad_recording_does_not_stop_the_others(
    episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no recording")
    options = ("--camera", episode.with_name("near.toml"), "--steps", "0:3", "-o", tmp_path / "v")
    rows = rerender(capsys, tmp_path / "bad.mcap", episode, *options, code=1)["recordings"]
    assert "bad.mcap" in rows[0]["error"]
    assert Path(rows[1]["files"][0]).exists()


@pytest.mark.slow
def test_cameras_choose_how_detailed_people_are(episode: Path) -> None:
    """Near ones show the full mesh, far ones the reduced one, in the same call; ids do not tell which."""
    recording = h3data.open(episode)
    auto, full, light = (h3data.Replay(recording, detail=detail) for detail in (None, True, False))
    person = next(i for i, d in enumerate(auto.drawables) if d.deformable)
    tracks = {}
    for name, eye in (("near", [1.2, 1.4, 0.5]), ("far", [-1.0, 7.0, 0.0])):
        file = episode.with_name(f"{name}_person.toml")
        file.write_text(f'eye = {eye}\ntarget = [0.0, 1.0, 0.0]\nfollow = "human"\nhidden_layers = ["ceiling"]\n')
        tracks[name] = camera_track(auto, str(file))
    pictures = [
        dict(r.frames(list(tracks.values()), [5, 15], outputs=("depth", "instance"))) for r in (auto, full, light)
    ]
    for step in (5, 15):
        seen = [p[step] for p in pictures]
        for camera, chosen, other in ((0, 1, 2), (1, 2, 1)):
            np.testing.assert_array_equal(seen[0][camera]["depth"], seen[chosen][camera]["depth"])
            np.testing.assert_array_equal(seen[0][camera]["instance"], seen[chosen][camera]["instance"])
            body = seen[0][camera]["instance"] == person
            assert body.sum() > 30
            assert (seen[0][camera]["depth"] != seen[other][camera]["depth"])[body].any()
