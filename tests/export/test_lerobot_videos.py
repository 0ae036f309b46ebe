"""Datasets with videos from the commands: rendered with the episodes, copied by exports, as `h3data rerender` shows them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.errors import InputError
from h3data.formats import ExportRequest
from h3data.recording import Dataset, Recording
from h3data.recording.parquet.lerobot import rebuild_meta
from h3data.replay import Replay, camera_track, camera_videos
from h3data.replay.camera_videos import render_videos
from h3data_exporters import lerobot as lerobot_export
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.task import Task
from tests.simulated import simulate_social_nav, social_nav_episode

CAMERAS = ("robot_arm", "human_head")
OPTIONS = ("--episodes", "2", "--seed", "5", "--max-steps", "24", "--spawn-distance", "2")


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Two short episodes with videos of two cameras."""
    root = tmp_path_factory.mktemp("filmed") / "ds"
    done = h3data.generate(
        "social_nav", root, episodes=2, seed=5, max_steps=24, spawn_distance=2.0, cameras=CAMERAS, force=True
    )
    assert done.dataset.cameras == CAMERAS
    return done.dataset


def psnr_db(one: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


@pytest.mark.slow
def test_generated_videos_show_what_the_cameras_see(dataset: Dataset) -> None:
    recording = dataset[1]
    assert recording.episode.info["light"] == "baked"
    replay = Replay(recording, light="baked")
    tracks = [camera_track(replay, name) for name in CAMERAS]
    frames = [list(dataset.video(1, name).frames()) for name in CAMERAS]
    assert [len(of) for of in frames] == [len(recording)] * 2
    assert frames[0][0].shape == (172, 224, 3), "an odd height is padded"
    for step, images in replay.frames(tracks, range(len(recording))):
        for image, of in zip(images, frames, strict=True):
            height, width = image["rgb"].shape[:2]
            assert psnr_db(of[step][:height, :width], image["rgb"]) > 28, step
    far = psnr_db(frames[1][0], frames[1][-1])
    assert far < 25, "another step is another picture, else this test would say nothing"
    assert {row["tasks"][0] for row in dataset.rows} == {"follow the person"}


@pytest.mark.slow
def test_workers_and_resuming_change_no_byte(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cameras = [word for name in CAMERAS for word in ("--camera", name)]
    out = tmp_path / "ds"
    job = ("generate", "social_nav", *OPTIONS, *cameras, "-o", out)
    run_json(capsys, *job, "--workers", "2")
    assert contents(out) == contents(Path(str(dataset.root)))
    told = run_json(capsys, "info", out)["found"][0]
    assert (told["cameras"], told["instructions"]) == ([*CAMERAS], {"follow the person": 2})
    assert run_json(capsys, *job, "--resume")["new"] == 0
    error = run_json(capsys, "generate", "social_nav", *OPTIONS, *cameras[:2], "-o", out, "--resume", code=2)["error"]
    assert "videos of robot_arm, human_head" in error


def test_going_on_in_another_light_is_refused(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "ds"
    shutil.copytree(str(dataset.root), out)
    options = [
        *OPTIONS,
        *(word for name in CAMERAS for word in ("--camera", name)),
        "--episodes",
        "3",
        "--light",
        "flat",
    ]
    error = run_json(capsys, "generate", "social_nav", *options, "-o", out, "--resume", code=2)["error"]
    assert "in baked light" in error


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.mark.parametrize(
    ("camera", "words"), [("robot_arms", "Did you mean 'robot_arm'"), ("robot_arm_depth", "--outputs depth")]
)
def test_a_camera_that_is_not_there_stops_the_job(
    camera: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "ds"
    error = run_json(capsys, "generate", "social_nav", *OPTIONS, "--camera", camera, "-o", out, code=2)["error"]
    assert "Episode 0: " in error
    assert words in error
    assert not list(out.rglob("*.parquet"))


@pytest.mark.slow
def test_an_export_copies_the_videos_that_there_are(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(camera_videos, "Replay", None)  # nothing is rendered
        done = run_json(capsys, "export", dataset.root, "--to", "lerobot", "-o", tmp_path / "all")
    assert done["videos"] == {"copied": 4, "rendered": 0}
    both = Dataset(tmp_path / "all")
    for k in range(2):
        for camera in CAMERAS:
            was, now = (list(ds.video(k, camera).frames()) for ds in (dataset, both))
            assert len(now) == len(both[k]) == len(was) - 1
            assert all(np.array_equal(a, b) for a, b in zip(was, now, strict=False))
    assert {row["tasks"][0] for row in both.rows} == {"follow the person"}

    names = ("--camera", "human_head", "--camera", "robot_left")
    done = run_json(capsys, "export", f"{dataset.root}#1", "--to", "lerobot", *names, "-o", tmp_path / "one")
    assert done["videos"] == {"copied": 1, "rendered": 1}
    one = Dataset(tmp_path / "one")
    assert one.cameras == ("human_head", "robot_left")
    assert np.array_equal(list(one.video(0, "human_head").frames()), list(both.video(1, "human_head").frames()))


@pytest.mark.slow
def test_a_rendered_export_is_a_copied_one(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rendering later gives the bytes that rendering with the episode gave."""
    again = render_videos(dataset[0], CAMERAS, tmp_path, threads=2)
    for camera, video in zip(CAMERAS, again, strict=True):
        stored = dataset.video(0, camera)
        assert np.array_equal(list(video.frames()), list(stored.frames()))
        np.testing.assert_allclose(video.moments.mean, stored.moments.mean)
        np.testing.assert_allclose(video.moments.std, stored.moments.std)


def test_an_interrupted_export_leaves_nothing(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "lerobot"

    class Stopped(list[Recording]):
        reads = 0

        def __iter__(self) -> Any:
            for k in range(2):
                self.reads += 1
                if self.reads > 3:  # in the middle of the second pass
                    raise KeyboardInterrupt
                yield dataset[k]

    with pytest.raises(KeyboardInterrupt):
        lerobot_export.export_lerobot(Stopped(), ExportRequest(out=out))
    assert not list(tmp_path.iterdir())
    (tmp_path / "lerobot.part").mkdir()
    (tmp_path / "lerobot.part" / "killed").touch()
    lerobot_export.export_lerobot(dataset, ExportRequest(out=out))
    assert [path.name for path in tmp_path.iterdir()] == ["lerobot"]
    with pytest.raises(InputError, match="H3-EXPORT-028"):
        lerobot_export.export_lerobot(dataset, ExportRequest(out=out))


def test_a_dataset_with_videos_is_converted_and_replaced(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "again"
    for _ in range(2):
        run_json(capsys, "convert", dataset.root, out, "--to", "dataset", "--check", "--force")
        again = Dataset(out)
        assert again.cameras == CAMERAS
        assert np.array_equal(list(again.video(1, "robot_arm").frames()), list(dataset.video(1, "robot_arm").frames()))


# --- the task in words -----------------------------------------------------------------------------------------------
def test_every_task_says_what_is_to_be_done() -> None:
    home = build_home(HomeSpec(seed=2))
    assert (
        find_task("social_nav").codec.instruction(find_task("social_nav").episode(home, seed=2)) == "follow the person"
    )
    rearrange = find_task("rearrange")
    episode: Any = rearrange.episode(home, seed=3)
    first, second = ([replaced(t.name), replaced(t.destination)] for t in episode.targets)
    words = f"bring the {first[0]} to the {first[1]} and bring the {second[0]} to the {second[1]}"
    assert rearrange.codec.instruction(episode) == words
    assert not any(c.isdigit() or c in "_|" for c in words)

    class FetchCoffee(Task):
        """A stranger's task."""

    task = FetchCoffee()
    episode = task.episode(home, seed=1, spec=replace(task.Spec(), max_steps=3))
    assert task.codec.instruction(episode) == "fetch coffee"


def replaced(name: str) -> str:
    return "".join(c for c in name.partition("|")[0].replace("_", " ") if not c.isdigit()).strip()


def _short(steps: int) -> Recording:
    home = build_home(HomeSpec(preset="small", seed=1))
    return simulate_social_nav(social_nav_episode(home, seed=1, spec=SocialNavSpec(max_steps=steps)))


def test_an_export_renders_in_the_light_of_the_dataset(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    recording = _short(4)
    lights: list[str] = []

    def rendered(*_: Any, light: str, **__: Any) -> list[Any]:
        lights.append(light)
        raise InputError("seen enough")

    monkeypatch.setattr(camera_videos, "render_videos", rendered)
    in_flat_light = replace(
        recording, episode=replace(recording.episode, info={**recording.episode.info, "light": "flat"})
    )
    for made, stored in ((recording, ()), (in_flat_light, ()), (recording, ("human_head",))):
        request = ExportRequest(out=tmp_path / "x", cameras=("robot_arm",), stored_cameras=stored)
        with pytest.raises(InputError, match="seen enough"):
            lerobot_export.export_lerobot([made], request)
    assert lights == ["baked", "flat", "flat"]  # datasets of before, which do not say it, were rendered in flat light


def test_exports_name_the_numbers_of_actions_and_states(tmp_path: Path) -> None:
    lerobot_export.write_lerobot([_short(4)], tmp_path / "ds")
    for again in (False, True):
        features = json.loads((tmp_path / "ds/meta/info.json").read_text())["features"]
        for name in ("action", "observation.state"):
            assert len(features[name]["names"]) == features[name]["shape"][0], again
        rebuild_meta(tmp_path / "ds")  # from the schema alone
