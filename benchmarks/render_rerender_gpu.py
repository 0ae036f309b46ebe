"""Drawing a recording again on a GPU: frames of 640x480 a second with files, where the time goes, and the same pictures.

The scene and the camera of `render_rerender`, RGB, depth and ids, written as data by all cores. Times are wall-clock times,
the least of three after one that does not count. The lines ``alike`` give the largest share of pixels of any picture that
differs from the CPU's by more than `docs/gpu.md` promises, and fail where it is larger.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.render_rerender import OUTPUTS, Emit, scene_of
from h3data.render import VideoWriter
from h3data.render.image_files import depth_to_mm, stored_ids
from h3data.replay import CameraTrack, Replay
from h3data.replay.stage import WORLDS
from h3data_gpu import gpu_problem
from h3data_pipelines.outputs import Target
from h3data_pipelines.pictures.id_png import id_png_bytes
from h3data_pipelines.pictures.rendering import render_files

LIMITS = {"depth": 1e-4, "instance": 1e-4, "rgb": 0.008}
"""Shares of pixels that may differ, the first two of those off silhouettes."""
COMPARED = 8
"""Every how many steps the pictures are compared."""


def run(emit: Emit) -> None:
    """Emit all `rerender.gpu.*` lines; none where there is no GPU."""
    problem = gpu_problem()
    if problem:
        print(f"# rerender.gpu: {problem}")
        return
    replay, track = scene_of()
    cores = os.cpu_count() or 1
    emit("rerender.gpu.cores", cores, "1")
    for samples in (1, 4):
        _run_files(emit, replay, track, samples, cores)
        _run_parts(emit, replay, track, samples)
    _run_encoders(emit, replay, track)
    for samples in (1, 4):
        _run_alike(emit, replay, track, samples)


def _run_files(emit: Emit, replay: Replay, track: CameraTrack, samples: Literal[1, 4], cores: int) -> None:
    count = len(replay)
    with tempfile.TemporaryDirectory() as folder:
        targets = [Target.named(Path(folder), "bench", "bench", output, "data") for output in OUTPUTS]
        for name, threads in ((f"threads{cores}", cores), ("threads2", 2)):
            start = time.process_time()
            seconds = _wall(
                lambda threads=threads: render_files(
                    replay,
                    [(track, targets)],
                    steps=range(count),
                    threads=threads,
                    samples=samples,
                    description="gpu",
                    frame_done=lambda: None,
                    backend="gpu",
                )
            )
            emit(f"rerender.gpu.s{samples}_{name}_fps", count / seconds, "1/s")
            emit(f"rerender.gpu.s{samples}_{name}_cpu_ms", (time.process_time() - start) / 4 / count * 1e3, "ms")


def _run_parts(emit: Emit, replay: Replay, track: CameraTrack, samples: Literal[1, 4]) -> None:
    """Emit milliseconds of a frame before files, and of this the poses and the launch with the copy to the host."""
    import torch

    stage, count = replay.stage, len(replay)
    emit(f"rerender.gpu.s{samples}_drawing_ms", _wall(lambda: _draw(replay, track, samples)) / count * 1e3, "ms")
    steps = range(min(WORLDS, count))
    renderer = stage.renderer("gpu", worlds=len(steps))
    cameras = [track.at(step) for step in steps]

    def pose() -> None:
        for world, step in enumerate(steps):
            for person, joints in stage._pose(renderer, step, OUTPUTS, world=world):
                stage_show(renderer, person, joints, cameras[world], set(), world=world)

    def launch() -> dict[str, Any]:
        drawn = renderer.render_batch(cameras, worlds=steps, outputs=OUTPUTS, samples=samples)
        torch.cuda.synchronize()
        return drawn

    from h3data.replay.stage import _HostCopies
    from h3data.replay.stage import _show as stage_show

    pose()
    emit(f"rerender.gpu.s{samples}_pose_ms", _wall(pose) / len(steps) * 1e3, "ms")

    def posed_and_launched() -> None:
        pose()
        launch()

    emit(f"rerender.gpu.s{samples}_pose_upload_launch_ms", _wall(posed_and_launched) / len(steps) * 1e3, "ms")
    emit(f"rerender.gpu.s{samples}_launch_ms", _wall(launch) / len(steps) * 1e3, "ms")
    drawn = launch()
    copies = _HostCopies()
    copied = _wall(lambda: copies.copied(0, drawn))
    emit(f"rerender.gpu.s{samples}_copy_to_host_ms", copied / len(steps) * 1e3, "ms")


def _draw(replay: Replay, track: CameraTrack, samples: Literal[1, 4]) -> None:
    for _ in replay.stage.frames(
        [track], range(len(replay)), outputs=OUTPUTS, samples=samples, threads=1, backend="gpu"
    ):
        pass


def _run_encoders(emit: Emit, replay: Replay, track: CameraTrack) -> None:
    """Emit milliseconds of a frame in each encoder alone; the largest wall-clock time bounds the rate."""
    stage, count = replay.stage, min(64, len(replay))
    renderer = stage.renderer()
    drawn = [stage.render(renderer, step, [track.at(step)], outputs=OUTPUTS)[0] for step in range(count)]

    def encode(name: str, suffix: str, codec: Any, frames: Sequence[NDArray[Any]]) -> None:
        with tempfile.TemporaryDirectory() as folder:

            def write() -> None:
                with VideoWriter(Path(folder) / f"alone{suffix}", 640, 480, codec=codec) as video:
                    for frame in frames:
                        (video.write if codec == "ffv1" else video.write_planes)(frame)

            _emit_both(emit, f"rerender.gpu.{name}", write, count)

    with VideoWriter(Path(tempfile.gettempdir()) / "rerender_gpu.mp4", 640, 480) as video:
        colors = [video.planes(one["rgb"]) for one in drawn]
        video.write_planes(colors[0])
    video.path.unlink()
    encode("h264", ".mp4", "h264", colors)
    encode("ffv1", ".mkv", "ffv1", [depth_to_mm(one["depth"]) for one in drawn])
    ids = [stored_ids(one["instance"]) for one in drawn]
    _emit_both(emit, "rerender.gpu.png_of_ids", lambda: [id_png_bytes(one) for one in ids], count)


def _emit_both(emit: Emit, name: str, work: Callable[[], object], count: int) -> None:
    start = time.process_time()
    seconds = _wall(work)
    emit(f"{name}_ms", seconds / count * 1e3, "ms")
    emit(f"{name}_cpu_ms", (time.process_time() - start) / 4 / count * 1e3, "ms")


def _run_alike(emit: Emit, replay: Replay, track: CameraTrack, samples: Literal[1, 4]) -> None:
    """Compare every `COMPARED`-th picture with the CPU's."""
    steps = range(0, len(replay), COMPARED)
    got, want = (
        [
            images[0]
            for _, images in replay.stage.frames([track], steps, outputs=OUTPUTS, samples=samples, backend=backend)
        ]
        for backend in ("gpu", "cpu")
    )
    differ = dict.fromkeys(LIMITS, 0.0)
    count = 0
    for one, other in zip(got, want, strict=True):
        calm = off_silhouettes(other["instance"], other["depth"])
        count += int(calm.sum())
        differ["depth"] += int((np.abs(one["depth"] - other["depth"]) > 1e-4)[calm].sum())
        differ["instance"] += int((one["instance"] != other["instance"])[calm].sum())
        colors = (np.abs(one["rgb"].astype(int) - other["rgb"]).max(-1) > 3).mean()
        differ["rgb"] = max(differ["rgb"], float(colors))
    differ["depth"] /= count
    differ["instance"] /= count
    for name, share in differ.items():
        emit(f"rerender.gpu.s{samples}_alike_{name}", share, "1")
        if share > LIMITS[name]:
            raise AssertionError(f"{name}: {share:.2g} of the pixels differ from the CPU's, at most {LIMITS[name]} may")


def off_silhouettes(instance: NDArray[np.integer], depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return pixels [H, W] around which one instance is seen without a jump in depth."""

    def around(image: NDArray[Any]) -> NDArray[Any]:
        return np.lib.stride_tricks.sliding_window_view(np.pad(image, 1, mode="edge"), (3, 3))

    ids, z = around(instance), around(depth)
    return (ids == instance[..., None, None]).all((2, 3)) & (z.max((2, 3)) < 1.2 * z.min((2, 3)) + 1e-3)


def _wall(work: Callable[[], object]) -> float:
    """Return the wall-clock seconds of ``work``: the least of three, after one that does not count."""
    work()
    times = []
    for _ in range(3):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True))
