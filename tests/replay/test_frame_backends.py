"""Frames of recordings by a GPU: 32 steps at once, each in a world of its own, and the pictures of the CPU.

On a GPU: ``python -m pytest -q -m gpu tests/replay/test_frame_backends.py -s`` (the last line says how fast it is).
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording import Dataset, Recording, write_mcap
from h3data.render import Output
from h3data.render.renderer import gpu_fault
from h3data.replay import CameraTrack, Replay, camera_track
from h3data.replay import stage as stage_module
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from sim_kinematic.motion.spec import HOME_WALKER, SocialNavSpec
from tests.simulated import simulate_social_nav, social_nav_episode

OUTPUTS: tuple[Output, ...] = ("rgb", "depth", "instance")


@pytest.fixture(scope="module")
def recording() -> Recording:
    spec = SocialNavSpec(max_steps=70, human=HOME_WALKER)
    return simulate_social_nav(social_nav_episode(build_home(HomeSpec(preset="small", seed=2)), seed=2, spec=spec))


def frames(
    replay: Replay, tracks: list[CameraTrack], steps: range, backend: Any, samples: Literal[1, 4] = 1
) -> list[tuple[int, Any]]:
    options: Any = {"outputs": OUTPUTS, "samples": samples, "threads": 2, "backend": backend}
    return list(replay.stage.frames(tracks, steps, **options))


def test_steps_in_worlds_are_steps_one_by_one(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    replay = Replay(recording, light="baked")
    tracks = [camera_track(replay, name).resized(72, 56) for name in ("third_person", "top_down_orthographic")]
    one_by_one = frames(replay, tracks, range(0, 70, 5), "cpu")
    monkeypatch.setattr(stage_module, "chosen_backend", lambda _: "gpu")
    monkeypatch.setattr(stage_module, "WORLDS", 4)
    renderers: list[dict[str, Any]] = []
    renderer = stage_module.Stage.renderer

    def on_the_cpu(stage: Any, backend: Any = "cpu", **options: Any) -> Any:
        renderers.append({"backend": backend, **options})
        return renderer(stage, "cpu", **options)

    monkeypatch.setattr(stage_module.Stage, "renderer", on_the_cpu)
    at_once = frames(replay, tracks, range(0, 70, 5), "gpu")
    assert renderers == [{"backend": "auto", "worlds": 4}]
    assert [step for step, _ in at_once] == [step for step, _ in one_by_one] == list(range(0, 70, 5))
    for (step, got), (_, want) in zip(at_once, one_by_one, strict=True):
        for one, other in zip(got, want, strict=True):
            for name in OUTPUTS:
                np.testing.assert_array_equal(one[name], other[name], err_msg=f"{name} of step {step}")


def test_a_devices_pictures_are_copied_into_the_same_memory(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Batches take turns in two sets of buffers; without ``then``, whoever gets the pictures may keep them."""
    torch = pytest.importorskip("torch")
    replay = Replay(recording, light="flat")
    tracks = [camera_track(replay, name).resized(40, 32) for name in ("third_person", "top_down")]
    steps, options = range(0, 70, 5), {"outputs": OUTPUTS, "threads": 2}
    want = frames(replay, tracks, steps, "cpu")
    monkeypatch.setattr(stage_module, "chosen_backend", lambda _: "gpu")
    monkeypatch.setattr(stage_module, "WORLDS", 4)
    renderer = stage_module.Stage.renderer

    def on_the_cpu(stage: Any, backend: Any = "cpu", **options: Any) -> Any:
        made = renderer(stage, "cpu", **options)
        draw = made.render_batch
        made.render_batch = lambda *a, **k: {name: torch.from_numpy(one) for name, one in draw(*a, **k).items()}
        return made

    monkeypatch.setattr(stage_module.Stage, "renderer", on_the_cpu)
    places: set[int] = set()

    def digested(step: int, images: Any) -> Any:
        places.update(image["depth"].ctypes.data for image in images)
        time.sleep(0.002)  # the next batch is drawn meanwhile
        return [{name: image[name].copy() for name in OUTPUTS} for image in images]

    kept = frames(replay, tracks, steps, "gpu")
    then = list(replay.stage.frames(tracks, steps, then=digested, **options))  # type: ignore[arg-type]
    assert len(places) == 2 * 4 * len(tracks)
    for got in (kept, then):
        assert [step for step, _ in got] == list(steps)
        for (step, images), (_, expected) in zip(got, want, strict=True):
            for one, other in zip(images, expected, strict=True):
                for name in OUTPUTS:
                    np.testing.assert_array_equal(one[name], other[name], err_msg=f"{name} of step {step}")


@pytest.mark.skipif(not gpu_fault(), reason="there is a GPU")
def test_without_a_gpu_it_is_refused_in_one_sentence(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match="H3-REPLAY-030"):
        stage_module.chosen_backend("gpu")
    with pytest.raises(InputError, match="H3-RENDER-054"):
        stage_module.chosen_backend("rays")  # type: ignore[arg-type]
    assert stage_module.chosen_backend("auto") == "cpu"
    file = tmp_path / "walk.mcap"
    write_mcap(recording, file)
    for words in (
        ["rerender", file, "-o", tmp_path / "out"],
        ["export", file, "--to", "lerobot", "--camera", "top_down", "-o", tmp_path / "lerobot"],
        ["generate", "wander", "--episodes", "1", "--camera", "top_down", "-o", tmp_path / "ds"],
    ):
        assert main([*map(str, words), "--backend", "gpu", "--json"]) == 2
        assert "There is no GPU to draw with" in json.loads(capsys.readouterr().out)["error"]
    assert [path.name for path in tmp_path.iterdir()] == ["walk.mcap"]


@pytest.mark.parametrize(("first", "other"), [pytest.param("cpu", "gpu", marks=pytest.mark.slow), ("gpu", "cpu")])
def test_a_resumed_dataset_keeps_its_back_end(
    first: str, other: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    renderer = stage_module.Stage.renderer
    monkeypatch.setattr(stage_module, "gpu_fault", lambda: "")
    monkeypatch.setattr(stage_module.Stage, "renderer", lambda self, _="cpu", **options: renderer(self, **options))

    def generate(*words: str) -> tuple[int, Any]:
        options = ["--homes", "1", "--max-steps", "6", "--camera", "robot_arm", "--light", "flat", "--json"]
        code = main(["generate", "social_nav", *options, *words, "-o", str(tmp_path / "ds")])
        return code, json.loads(capsys.readouterr().out)

    assert generate("--episodes", "1", "--backend", first)[0] == 0
    code, said = generate("--episodes", "2", "--resume", "--backend", other)
    assert code == 2
    assert f"Hint: --backend {first}" in said["error"]
    code, said = generate("--episodes", "2", "--resume", "--backend", "auto")
    assert (code, said["new"]) == (0, 1)
    made_by = {json.loads(row["info"]).get("backend", "cpu") for row in Dataset(tmp_path / "ds").episodes.to_pylist()}
    assert made_by == {first}


def apart(got: NDArray[Any], want: NDArray[Any]) -> NDArray[np.float64]:
    return np.abs(got.astype(np.float64) - want.astype(np.float64))


@pytest.mark.gpu
@pytest.mark.skipif(bool(gpu_fault()), reason="there is no GPU")
@pytest.mark.parametrize("samples", [1, 4])
def test_a_gpu_draws_the_frames_of_the_cpu(recording: Recording, samples: Literal[1, 4], tmp_path: Path) -> None:
    """docs/gpu.md: depth within 1e-4 m and equal ids on 99.99 % of the pixels off silhouettes, 0.8 % of RGB apart."""
    replay = Replay(recording, light="baked")
    tracks = [camera_track(replay, name).resized(320, 240) for name in ("third_person", "top_down", "human_head")]
    by_cpu = frames(replay, tracks, range(0, 70, 2), "cpu", samples)
    by_gpu = frames(replay, tracks, range(0, 70, 2), "gpu", samples)
    again = frames(replay, tracks, range(0, 70, 2), "gpu", samples)
    inside = odd = 0
    for (step, got), (same, want), (_, repeated) in zip(by_gpu, by_cpu, again, strict=True):
        assert step == same
        for one, other, third in zip(got, want, repeated, strict=True):
            for name in OUTPUTS:
                assert one[name].dtype == other[name].dtype
                assert one[name].shape == other[name].shape
                np.testing.assert_array_equal(one[name], third[name], err_msg=f"{name} differs between two runs")
            ids, depth = other["instance"], other["depth"]
            around = np.lib.stride_tricks.sliding_window_view(np.pad(ids, 1, mode="edge"), (3, 3))
            near = np.lib.stride_tricks.sliding_window_view(np.pad(depth, 1, mode="edge"), (3, 3))
            off = (around == ids[..., None, None]).all((2, 3)) & (near.max((2, 3)) < 1.2 * near.min((2, 3)) + 1e-3)
            inside += int(off.sum())
            odd += int((off & ((one["instance"] != ids) | (apart(one["depth"], depth) > 1e-4))).sum())
            assert (apart(one["rgb"], other["rgb"]).max(-1) > 3)[off].mean() < 0.008, step
    assert odd < 1e-4 * inside
    file = tmp_path / "walk.mcap"
    write_mcap(recording, file)
    data = ("--outputs", "rgb,depth,instance", "--format", "data", "--samples", str(samples), "--size", "640x480")
    assert (
        main(["rerender", str(file), "--camera", "third_person", "--backend", "gpu", *data, "-o", str(tmp_path)]) == 0
    )
    start = time.perf_counter()
    steps = range(len(replay))
    for _ in replay.stage.frames(
        [camera_track(replay, "third_person").resized(640, 480)], steps, outputs=OUTPUTS, samples=samples, backend="gpu"
    ):
        pass
    print(f"\n{len(steps) / (time.perf_counter() - start):.0f} frames/s of 640x480 by the GPU, {samples} samples")
