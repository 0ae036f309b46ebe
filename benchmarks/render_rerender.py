"""Drawing a recording again: frames of 640x480 per second of CPU, with RGB, depth and ids or RGB alone with smooth edges as
`h3data rerender` has it by default, and where the time goes.

A home with a robot that follows a person, seen by a camera that trails the robot; textures, occlusion, the body as
detailed as the camera needs. CPU seconds of the process, so per core; files are written to a temporary folder.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

from benchmarks.render import cpu_seconds
from h3data.render import Output, VideoWriter, pinhole
from h3data.replay import CameraTrack, Replay, camera_track
from h3data.replay.stage import Stage
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.outputs import Format, Target
from h3data_pipelines.pictures.rendering import render_files
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.social_nav import SocialNav

Emit = Callable[[str, float, str], None]

STEPS = 240
OUTPUTS: tuple[Output, ...] = ("rgb", "depth", "instance")


def scene_of() -> tuple[Replay, CameraTrack]:
    """Return the recording, and the camera that trails its robot, 640x480."""
    world = SocialNav().episode(build_home(HomeSpec(seed=2)), seed=2, spec=SocialNavSpec(max_steps=STEPS))
    replay = Replay(simulate(SocialNav(), world))
    trailing = camera_track(replay, "third_person")
    camera = pinhole(640, 480, hfov_deg=trailing.camera.hfov_deg, name="bench")
    return replay, CameraTrack(camera=camera, poses=trailing.poses)


def run(emit: Emit) -> None:
    """Emit all `render.rerender*` lines."""
    replay, track = scene_of()
    stage = replay.stage
    renderer = stage.renderer()

    def draw(*outputs: Output) -> None:
        for step in range(len(replay)):
            stage.render(renderer, step, [track.at(step)], outputs=outputs)

    def pose(stage: Stage) -> None:
        own = stage.renderer()
        for step in range(len(replay)):
            stage.render(own, step, [replace(track.at(step), width=1, height=1)], outputs=("depth",))

    full = Replay(replay.recording, detail=True).stage
    count = len(replay)
    depth, drawn = (_seconds(work) / count for work in (lambda: draw("depth"), lambda: draw(*OUTPUTS)))
    emit("render.rerender_update_ms", _seconds(lambda: pose(stage)) / count * 1e3, "ms")
    emit("render.rerender_update_full_body_ms", _seconds(lambda: pose(full)) / count * 1e3, "ms")
    emit("render.rerender_depth_640x480_fps_per_core", 1 / depth, "1/s")
    emit("render.rerender_640x480_fps_per_core", 1 / drawn, "1/s")
    _run_smooth(emit, replay, track)
    _run_still(emit, replay)
    with tempfile.TemporaryDirectory() as folder:
        for samples in (1, 4):
            files = (
                _seconds(lambda samples=samples: _files(replay, track, Path(folder), "data", samples=samples)) / count
            )
            emit(f"rerender.s{samples}_fps_per_core", 1 / files, "1/s")
        for form in ("mp4", "data", "png"):
            files = _seconds(lambda form=form: _files(replay, track, Path(folder), form)) / count
            emit(f"render.rerender_{form}_640x480_fps_per_core", 1 / files, "1/s")
            emit(f"render.rerender_{form}_640x480_encode_share", 1 - drawn / files, "1")


def _run_still(emit: Emit, replay: Replay) -> None:
    """Emit the lines of a camera that stands still, and of the same pictures if each is rendered from scratch."""
    stage, count = replay.stage, len(replay)
    camera = camera_track(replay, "top_down").at(0)
    renderer = stage.renderer()

    def again() -> None:
        for step in range(count):
            stage.render(renderer, step, [camera], outputs=("rgb",), samples=4)

    def anew() -> None:
        one = stage.renderer()
        for step in range(0, count, 8):  # a hair's breadth apart, so that none is the one before
            pose = camera.pose.copy()
            pose[0, 3] += 1e-6 * step
            moved = replace(camera, pose=pose)
            stage.render(one, step, [moved], outputs=("rgb",), samples=4)

    still, whole = _seconds(again) / count, _seconds(anew) / len(range(0, count, 8))
    emit("render.rerender_still_top_down_ms", still * 1e3, "ms")
    emit("render.rerender_still_speedup", whole / still, "1")


def _run_smooth(emit: Emit, replay: Replay, track: CameraTrack) -> None:
    """Emit the lines of a video of colours with four samples a pixel, and of its conversion and encoding alone."""
    stage, count = replay.stage, len(replay)
    renderer = stage.renderer()
    pictures = [stage.render(renderer, k, [track.at(k)], outputs=("rgb",), samples=4)[0]["rgb"] for k in range(count)]

    with tempfile.TemporaryDirectory() as folder:

        def encode() -> None:
            with VideoWriter(Path(folder) / "alone.mp4", 640, 480) as video:
                for picture in pictures:
                    video.write(picture)

        whole = _seconds(lambda: _files(replay, track, Path(folder), "mp4", outputs=("rgb",), samples=4))
        encoded = _seconds(encode)
    emit("render.rerender_smooth_640x480_fps_per_core", count / whole, "1/s")
    emit("render.rerender_smooth_640x480_encode_share", encoded / whole, "1")
    emit("render.h264_640x480_fps_per_core", count / encoded, "1/s")


def _files(
    replay: Replay,
    track: CameraTrack,
    folder: Path,
    form: Format,
    *,
    outputs: tuple[Output, ...] = OUTPUTS,
    samples: Literal[1, 4] = 1,
) -> None:
    targets = [Target.named(folder, "bench", "bench", output, form) for output in outputs]
    render_files(replay, [(track, targets)], steps=range(len(replay)), threads=1, samples=samples, description=form)


def _seconds(work: Callable[[], object]) -> float:
    """Return the CPU seconds of ``work``: the least of three, after one that does not count."""
    work()
    times = []
    for _ in range(3):
        start = cpu_seconds()
        work()
        times.append(cpu_seconds() - start)
    return min(times)
