"""``h3data rerender``: videos or pictures of recordings from any camera."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from h3data.errors import InputError
from h3data.replay import CameraTrack, Replay, camera_track
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_file, open_episode
from h3data_pipelines.importing import recording_stem

if TYPE_CHECKING:
    from h3data.render import Output

ROBOT_COLOR, HUMAN_COLOR = (255, 176, 32), (64, 150, 255)
TRAJECTORY_STRIDE = 6
"""Trajectories are drawn through every sixth step: 0.2 s."""


@dataclass(frozen=True)
class Rerender:
    """Draw recordings again from any camera: H.264 videos that a browser plays, or PNG pictures.

    Examples:
        h3data rerender out/demo/episode.mcap --camera top_down --camera robot_arm --outputs rgb,depth -o videos/
        h3data rerender ds#3 --camera third_person -o videos/
        h3data rerender rec/session.mcap --camera my_camera.toml --steps 0:300:2 --format png -o frames/
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """.mcap files, or episodes of a dataset as ds#0."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the videos: <recording>.<camera>.<output>.mp4."""
    camera: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Camera name or .toml file; may be given several times (default: top_down). Unknown names list what there is."""
    outputs: str = "rgb"
    """Comma-separated: rgb, depth, instance."""
    assets: tuple[Path, ...] = ()
    """Folders below which recorded asset files are searched (default: H3DATA_ASSETS)."""
    steps: str = ""
    """Which steps, as start:stop:stride (default: all)."""
    format: Literal["mp4", "png"] = "mp4"
    """Videos, or one PNG per step (depth in 16-bit millimetres) in a folder <recording>.<camera>.<output>/."""
    workers: int = 2
    """Threads that draw."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        outputs = parse_outputs(self.outputs)
        if not self.recordings:
            raise InputError("Expected at least one recording (.mcap).")
        if self.workers < 1:
            raise InputError(f"--workers must be at least 1, got {self.workers}.")
        stems = [recording_stem(path) for path in self.recordings]
        twice = sorted({stem for stem in stems if stems.count(stem) > 1})
        if twice:
            raise InputError(
                f"Several recordings are called {twice[0]!r}, their videos would overwrite each other. "
                "Render them one at a time, each to another -o."
            )
        lines, data = [], []
        for path in self.recordings:
            replay = Replay(open_episode(path), assets=self.assets)
            tracks = [camera_track(replay, name) for name in self.camera or ("top_down",)]
            steps = parse_steps(self.steps, len(replay))
            files = render_videos(
                replay, tracks, outputs, self._targets(path, tracks, outputs), steps=steps,
                threads=self.workers, pictures=self.format == "png",
            )  # fmt: skip
            lines += [f"wrote {file}" for file in files]
            lines += missing_lines(replay)
            data.append(
                {
                    "recording": str(path),
                    "files": [str(f) for f in files],
                    "missing": dict(sorted(replay.missing.items())),
                }
            )
        return Outcome(text="\n".join(lines), data={"recordings": data})

    def _targets(
        self, path: Path, tracks: Sequence[CameraTrack], outputs: Sequence[Output]
    ) -> dict[tuple[int, str], Path]:
        stem, suffix = recording_stem(path), ".mp4" if self.format == "mp4" else ""
        targets = {
            (n, output): self.out / f"{stem}.{track.camera.name}.{output}{suffix}"
            for n, track in enumerate(tracks)
            for output in outputs
        }
        if len(set(targets.values())) < len(targets):
            raise InputError("Two cameras have the same name, so their files would overwrite each other.")
        for target in targets.values():
            if self.format == "mp4":
                claim_file(target, force=self.force)
            elif target.exists() and not self.force:
                raise InputError(f"The output folder exists. Use --force to overwrite, or another -o: {target}")
        return targets


def parse_outputs(text: str) -> tuple[Output, ...]:
    """``"rgb,depth"`` as a tuple; an `InputError` names what exists."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in ("rgb", "depth", "instance")]
    if unknown or not names:
        raise InputError(f"Unknown outputs {unknown or text!r}. Expected some of: rgb, depth, instance.")
    return tuple(dict.fromkeys(names))  # type: ignore[arg-type]


def parse_steps(text: str, count: int) -> range:
    """``"start:stop:stride"`` (each may be missing) as a range within ``count`` steps."""
    if not text:
        return range(count)
    if not re.fullmatch(r"-?\d*(:-?\d*){0,2}", text) or text.endswith("::-"):
        raise InputError(f"Cannot read the steps {text!r}. Expected start:stop:stride, e.g. 0:300:2.")
    parts = [int(p) if p not in ("", "-") else None for p in text.split(":")]
    if len(parts) == 1:
        parts = [parts[0], None if parts[0] == -1 else (parts[0] or 0) + 1]
    if len(parts) == 3 and parts[2] is not None and parts[2] <= 0:
        raise InputError(f"The stride in the steps {text!r} must be positive.")
    steps = range(count)[slice(*parts)]
    if not len(steps):
        raise InputError(f"The steps {text!r} select nothing: the recording has {count} steps, 0 to {count - 1}.")
    return steps


def missing_lines(replay: Replay, *, most: int = 8) -> list[str]:
    """What to tell about assets that were not found."""
    if not replay.missing:
        return []
    names = sorted(replay.missing)
    lines = [f"{len(names)} assets not found, drawn as marked placeholders (Hint: --assets DIR or H3DATA_ASSETS):"]
    lines += [f"  {name}" + (f"  x{replay.missing[name]}" if replay.missing[name] > 1 else "") for name in names[:most]]
    return lines + ([f"  ... and {len(names) - most} more (--json lists all)"] if len(names) > most else [])


def render_videos(
    replay: Replay,
    tracks: Sequence[CameraTrack],
    outputs: Sequence[Output],
    targets: dict[tuple[int, str], Path],
    *,
    steps: range,
    threads: int = 2,
    pictures: bool = False,
    annotate: bool = True,
    description: str = "render",
) -> list[Path]:
    """Draw ``steps`` from every camera to ``targets[camera index, output]``; returns the files in that order.

    Files appear under their names only when they are complete.
    """
    from h3data.render import VideoWriter, depth_to_rgb

    fps = 30.0
    times = replay.recording.columns["time_ns"]
    if len(times) > 1:
        fps = max(1e9 / float(np.median(np.diff(times))) / steps.step, 1.0)  # players want at least one frame a second
    with ExitStack() as stack:
        sinks: dict[tuple[int, str], Callable[[NDArray[Any], int], None]] = {}
        for (n, output), target in targets.items():
            if pictures:
                sinks[n, output] = _picture_sink(stack.enter_context(_picture_folder(target)), output)
            else:
                camera = tracks[n].camera
                writer = stack.enter_context(VideoWriter(target, camera.width, camera.height, fps=fps))
                sinks[n, output] = lambda image, step, writer=writer: writer.write(image)
        frames = replay.frames(tracks, steps, outputs=outputs, threads=threads)
        ranges: list[tuple[float, float]] = []
        for step, views in tqdm(frames, total=len(steps), desc=description, unit="frame", disable=None):
            ranges = ranges or [depth_range(view["depth"]) if "depth" in view else DEPTH_RANGE_M for view in views]
            for (n, output), sink in sinks.items():
                if output == "depth" and not pictures:
                    image = depth_to_rgb(views[n]["depth"], near=ranges[n][0], far=ranges[n][1])
                else:
                    image = _picture(replay, tracks[n], views[n], output, step, annotate=annotate)
                sink(image, step)
    return list(targets.values())


DEPTH_RANGE_M = (0.0, 10.0)


def depth_range(depth: NDArray[np.float32]) -> tuple[float, float]:
    """Nearest and farthest depth [m] that the colours of a depth video span: 0 to 10 m as a rule, what there is for
    cameras far away from everything, such as those from above."""
    hits = depth[depth > 0]
    if not len(hits) or np.median(hits) <= DEPTH_RANGE_M[1]:
        return DEPTH_RANGE_M
    near, far = np.percentile(hits, (0.5, 99.5))
    return float(near), float(max(far, near + 0.5))


def _picture(
    replay: Replay, track: CameraTrack, view: dict[str, NDArray[Any]], output: str, step: int, *, annotate: bool
) -> NDArray[Any]:
    from h3data.render import instance_to_rgb

    if output == "depth":
        return view["depth"]
    if output == "instance":
        return instance_to_rgb(view["instance"])
    image = view["rgb"]
    if annotate and track.camera.name == "top_down":
        draw_trajectories(image, replay, track, step)
    return image


def draw_trajectories(image: NDArray[np.uint8], replay: Replay, track: CameraTrack, step: int) -> None:
    """Draw on ``image`` where each agent has been up to ``step``, and its name."""
    from h3data.render.overlay import draw_label, draw_polyline

    camera = track.at(step)
    for index, agent in enumerate(replay.recording.agents):
        base = replay.recording.agent_column(index, "base_pose")[: step + 1, :3].astype(np.float64)
        base = base[np.isfinite(base).all(-1)]
        if not len(base):
            continue
        color = ROBOT_COLOR if agent.kind == "robot" else HUMAN_COLOR
        line = base[::TRAJECTORY_STRIDE] + np.array([0.0, 0.03, 0.0])
        draw_polyline(image, camera, np.concatenate([line, base[-1:]]), color=color, thickness=2)
        above = base[-1] - camera.pose[:3, 1] * 0.55  # upwards in the picture
        draw_label(image, camera, above, agent.name, color=color, scale=0.6)


@contextmanager
def _picture_folder(target: Path) -> Iterator[Path]:
    """A folder for pictures that gets the name ``target`` when they are complete, in the place of older pictures."""
    part = target.with_name(target.name + ".part")
    for folder in (part, target):
        strangers = [p for p in folder.glob("*") if not re.fullmatch(r"\d{6,}\.png(\.part)?", p.name)]
        if strangers:
            raise InputError(f"Other things than pictures lie in the output folder. Remove them: {strangers[0]}")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        yield part
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    if target.exists():
        shutil.rmtree(target)
    part.rename(target)


def _picture_sink(folder: Path, output: str) -> Callable[[NDArray[Any], int], None]:
    from h3data.render import write_depth_png, write_png

    def sink(image: NDArray[Any], step: int) -> None:
        (write_depth_png if output == "depth" else write_png)(folder / f"{step:06d}.png", image)

    return sink
