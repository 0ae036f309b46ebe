"""Command ``h3data demo``, which simulates one episode in a home and makes metrics, a picture and videos."""

from __future__ import annotations

import json as jsonlib
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import tyro

from h3data.commands.command import ForceFlag, JsonFlag, LightOption, Outcome, claim_folder, open_episode, write_text
from h3data.errors import InputError
from h3data.files import size_text
from h3data.plugins import Registry
from h3data.progress import is_quiet, progress
from h3data.recording import Recording
from h3data.replay import CameraTrack, Replay, camera_track
from h3data.replay.cameras import parse_size
from h3data.terminal import counted
from h3data_pipelines.dataset_folders import remove_dataset
from h3data_pipelines.execution.processes import core_count
from h3data_pipelines.machine.warmup import compiled_aside
from h3data_pipelines.outputs import Target
from h3data_pipelines.pictures.rendering import render_files

VIEWERS: Registry[Callable[..., object]] = Registry("h3data.viewers", {}, what="viewer")
"""Functions that write a recording as the file of a viewer, such as `h3data_viewers.write_rrd`."""

if TYPE_CHECKING:
    from h3data.render import Output
    from h3data.scene import Scene
FILES = (
    "episode.mcap",
    "first_picture.png",
    "third_person.mp4",
    "arm_depth.mp4",
    "top_down.mp4",
    "episode.rrd",
    "metrics.json",
    "summary.json",
)
FRAME_EVERY = 2
"""Number of steps between consecutive frames of the videos, which gives 15 frames/s."""
VIDEO_SIZE = (480, 360)
"""Default size of third_person.mp4 [px]; at this size, the first picture has the camera's own size, 640x480."""


@dataclass(frozen=True)
class Demo:
    """Simulate a person and a robot in a home, and record, render and measure the episode.

    Examples:
        h3data demo
        h3data demo -o out/demo --seed 5 --force
        h3data demo -o out/demo --size 1280x720 --force
    """

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/demo")
    """Folder for the results."""
    seed: int = 3
    """Seed of the home and the episode."""
    steps: int = 600
    """Largest number of steps of the episode, at 30 steps per second."""
    human_speed: float = 1.2
    """Walking speed of the person [m/s]. (`h3data generate` uses 1.3, the paper 2.5.)"""
    size: str = ""
    """Size of third_person.mp4 [pixels], such as 1280x720 (default: 480x360, which takes two thirds of the time of
    640x480).
    """
    light: LightOption = "baked"
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Simulate the episode, then write its metrics, a picture and the videos."""
        from h3data.metrics import measure_many
        from h3data.scene.open import named_scenes, open_scene

        if self.steps < 1:
            raise InputError(f"--steps must be at least 1, got {self.steps}.", code="H3-OPTION-029")
        if not 0 < self.human_speed <= 4:
            raise InputError(
                f"--human-speed must be above 0 and at most 4 m/s, got {self.human_speed}.", code="H3-OPTION-030"
            )
        size = parse_size(self.size) if self.size else None
        if "rerun" not in VIEWERS.names():
            VIEWERS.get("rerun")  # says which package is missing, before anything is done
        (home,) = named_scenes(f"small2:{self.seed}")
        out = claim_folder(self.out, force=self.force)
        if self.force:
            remove_dataset(out / "dataset")
            for name in FILES:
                (out / name).unlink(missing_ok=True)
        clock = _Clock()
        # the kernels of people come last: this process needs them early, and compiles them meanwhile
        with compiled_aside(["pictures", *(["light"] if self.light == "baked" else []), "people"]):
            with clock.part("simulate"):
                recording = self._simulate(open_scene(home.source), out / "episode.mcap")
            with clock.part("metrics"):
                table = measure_many([recording])
                write_text(out / "metrics.json", table.to_json() + "\n")
            clock.say(f"{counted(len(recording), 'step')} recorded in {out / 'episode.mcap'}:\n{table.to_text()}\n")
            replay = Replay(recording, light=self.light)
            with ThreadPoolExecutor(2, thread_name_prefix="h3data-demo") as pool, _Videos(replay, out) as videos:
                with clock.part("first picture"):
                    videos.prepare()
                    # the view from above meanwhile: the search for a good third-person view takes one core
                    above = pool.submit(videos.write, "top_down", threads=max(core_count() - 1, 1))
                    view = videos.track("third_person")
                    _write_first_picture(replay, view.resized(*size) if size else view, out / "first_picture.png")
                clock.say(f"the first picture: {out / 'first_picture.png'}. Three videos follow.\n")
                with clock.part("videos, dataset, rerun"):
                    beside = pool.submit(_write_beside, recording, videos, out)
                    videos.show_progress()
                    videos.write("third_person", size or VIDEO_SIZE)
                    videos.write("arm_depth")
                    above.result()
                    beside.result()
        summary: dict[str, Any] = {
            "wall_s": round(clock.total, 2),
            "parts_s": {name: round(seconds, 2) for name, seconds in clock.parts.items()},
            "steps": len(recording),
            "seconds_of_life": round(recording.duration_s, 1),
            "ended": recording.episode.info["ended"],
            "files": {name: _size(out / name) for name in (*FILES[:-1], "dataset")},
        }
        write_text(out / "summary.json", jsonlib.dumps(summary, indent=2) + "\n")
        return Outcome(
            text=_text(out, summary, "" if clock.has_said else table.to_text()),
            data=summary | {"out": str(out), "metrics": table.to_dict()},
        )

    def _simulate(self, scene: Scene, path: Path) -> Recording:
        from h3data.recording import RecordingWriter
        from sim_kinematic.motion.spec import NATURAL_WALKER, SocialNavSpec
        from sim_kinematic.tasks.recorder import simulate
        from sim_kinematic.tasks.social_nav import SocialNav

        spec = SocialNavSpec(
            max_steps=self.steps, spawn_distance_m=4.0, human=replace(NATURAL_WALKER, speed_mps=self.human_speed)
        )
        task = SocialNav()
        episode = task.episode(scene, seed=self.seed, spec=spec)
        with progress(total=self.steps, desc="simulate", unit="step") as bar:
            simulate(
                task,
                episode,
                episode_id="demo",
                progress=bar.update,
                sink=lambda header: RecordingWriter(path, header, overwrite=self.force),
            )
        return open_episode(path)  # from the file: what follows uses nothing but the recording


VIDEOS: dict[str, tuple[str, Output]] = {
    "third_person": ("third_person", "rgb"),
    "top_down": ("top_down", "rgb"),
    "arm_depth": ("robot_arm", "depth"),
}
"""Camera and output of each video."""


class _Videos:
    """The videos of a replay, of which several threads may write one each. After an error in the block all of them stop."""

    def __init__(self, replay: Replay, out: Path) -> None:
        self.replay, self.out = replay, out
        self.written: dict[Path, Future[None]] = {out / f"{name}.mp4": Future() for name in VIDEOS}
        """Future of each file, which is done when the file is written."""
        self._steps = range(0, len(replay), FRAME_EVERY)
        # one bar for all of them, later (`show_progress`)
        self._bar = progress(total=len(VIDEOS) * len(self._steps), desc="render", unit="frame", delay=math.inf)
        self._lock = threading.Lock()
        self._tracks: dict[str, CameraTrack] = {}
        self._failed = False

    def prepare(self) -> None:
        """Build what threads share."""
        self.replay.stage  # noqa: B018

    def track(self, name: str) -> CameraTrack:
        """Return the camera of a video, with pictures of the camera's own size."""
        if name not in self._tracks:
            self._tracks[name] = camera_track(self.replay, VIDEOS[name][0])
        return self._tracks[name]

    def write(self, name: str, size: tuple[int, int] | None = None, *, threads: int | None = None) -> None:
        """Write one video; all cores work on it unless ``threads`` is given."""
        track, path = self.track(name).resized(*size) if size else self.track(name), self.out / f"{name}.mp4"
        render_files(
            self.replay,
            [(track, [Target(VIDEOS[name][1], "h264", path)])],
            steps=self._steps,
            threads=threads or core_count(),
            samples=4,
            frame_done=self._count,
        )
        self.written[path].set_result(None)

    def show_progress(self) -> None:
        """Show the bar from now on."""
        self._bar.delay = 0

    def _count(self) -> None:
        if self._failed:
            raise CancelledError
        with self._lock:
            self._bar.update()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._failed = error is not None
        for file in self.written.values():
            if error is not None and not file.done():
                file.set_exception(error)
        self._bar.close()


def _write_first_picture(replay: Replay, track: CameraTrack, path: Path) -> None:
    """Write the frame in the middle of the episode."""
    from h3data.render import write_png

    stage, middle = replay.stage, len(replay) // 2
    (view,) = stage.render(stage.renderer(), middle, [track.at(middle)], outputs=("rgb",), samples=4)
    write_png(path, view["rgb"])


def _write_beside(recording: Recording, videos: _Videos, out: Path) -> None:
    """Write the dataset and the file for Rerun, which waits for each video."""
    from h3data.recording import DatasetWriter

    with DatasetWriter(out / "dataset") as writer:
        writer.add(recording)
    cameras = [(videos.track(name), out / f"{name}.mp4") for name in VIDEOS]
    plain = Replay(recording, detail=False)
    ready = lambda video: videos.written[video].result()  # noqa: E731
    VIEWERS.get("rerun")(recording, out / "episode.rrd", replay=plain, cameras=cameras, videos_ready=ready)


@dataclass
class _Clock:
    """Wall time of each part."""

    parts: dict[str, float] = field(default_factory=dict)
    begin: float = field(default_factory=time.perf_counter)
    has_said: bool = False

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.parts[name] = time.perf_counter() - start

    def say(self, text: str) -> None:
        """Say on stderr what there is after how long, unless the command is to be quiet."""
        if not is_quiet() and sys.stderr is not None:
            self.has_said = True
            sys.stderr.write(f"After {self.total:.1f} s: {text}")
            sys.stderr.flush()

    @property
    def total(self) -> float:
        return time.perf_counter() - self.begin


def _size(path: Path) -> int:
    """Return bytes of a file or of everything in a folder."""
    return sum(p.stat().st_size for p in path.rglob("*") if p.is_file()) if path.is_dir() else path.stat().st_size


def _text(out: Path, summary: dict[str, Any], table: str) -> str:
    lines = [
        f"{summary['steps']} steps ({summary['seconds_of_life']} s of life, ended by {summary['ended']}) "
        f"in {summary['wall_s']} s. In {out}:",
        *(
            f"  {name + '/' * (out / name).is_dir():<18} {size_text(size):>9}"
            for name, size in summary["files"].items()
        ),
        "",
        *([table, ""] if table else []),
        f"Look: open {out}/third_person.mp4 in a browser, or: rerun {out}/episode.rrd",
    ]
    return "\n".join(lines)
