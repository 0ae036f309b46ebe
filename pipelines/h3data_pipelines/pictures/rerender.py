"""Command ``h3data rerender``, which makes videos and images of recordings from any camera."""

from __future__ import annotations

import errno
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import (
    BackendOption,
    DryRunFlag,
    ForceFlag,
    JsonFlag,
    LightOption,
    Outcome,
    PeopleOption,
    StandInsFlag,
    keeping,
    missing_lines,
    open_episode,
    recording_stem,
)
from h3data.commands.executors import ExecutorOption, check_workers, opened
from h3data.commands.options import command_of
from h3data.errors import H3DataError, InputError, suggest_keywords
from h3data.progress import progress
from h3data.recording.finding import find_episodes
from h3data.recording.parquet.files import is_dataset
from h3data.recording.storage import local, place
from h3data.replay import CameraTrack, Replay, camera_track
from h3data.replay.cameras import parse_size
from h3data.terminal import counted
from h3data_pipelines.execution.processes import core_count
from h3data_pipelines.jobs.camera_log import CameraLog
from h3data_pipelines.outputs import Format, OutputName, Target, check_backend
from h3data_pipelines.pictures.rendering import frames_per_second, render_files

if TYPE_CHECKING:
    from h3data.bodies.people.rigid_parts import PeopleStyle
    from h3data.commands.arguments import FilePath, Paths
    from h3data.render import Output
    from h3data.render.light.sources import LightMode


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """Result of rendering recordings, with paths of files and failures."""

    files: tuple[Path, ...]
    """Paths of videos, and of folders of images."""
    failed: dict[str, str]
    """Reason why a recording could not be rendered, by its path."""


@suggest_keywords
def rerender(
    recordings: Paths,
    out: FilePath,
    *,
    cameras: Paths = (),
    people: PeopleStyle = "skin",
    light: LightMode = "baked",
    backend: Literal["auto", "cpu", "gpu"] = "cpu",
    outputs: OutputName | Sequence[OutputName] = "rgb",
    assets: Paths = (),
    stand_ins: bool = False,
    steps: str | slice | range = "",
    format: Literal["mp4", "av1", "png", "data"] = "mp4",
    size: tuple[int, int] | str = "",
    samples: Literal[1, 4] | None = None,
    workers: int | None = None,
    executor: str = "local",
    force: bool = False,
) -> Rendered:
    """Render recordings from any number of cameras into the folder ``out``, with the options of ``h3data rerender``.

    Returns:
        The video files and folders of images, and the recordings that failed.

    Raises:
        InputError: an option is invalid, a file exists, or no recording can be rendered.
    """
    if not isinstance(size, str):
        size = "x".join(map(str, size))
    if not isinstance(steps, str):
        steps = ":".join("" if part is None else str(part) for part in (steps.start, steps.stop, steps.step))
    return result_of(Rerender, locals())


@command_of(rerender)
class Rerender:
    """Render recordings from any number of cameras, as videos for the browser or as lossless data.

    Complete files are not rendered again; run the same command again to continue after an interruption. Next to the
    videos, <recording>.cameras.json holds each camera's intrinsics K and its pose at every frame.

    Examples:
        h3data rerender out/demo/episode.mcap --cameras top_down,robot_arm --outputs rgb,depth -o videos/
        h3data rerender rec/*.mcap --camera third_person --outputs rgb,depth,instance --format data -o training/
        h3data rerender rec/ --camera third_person -o videos/
        h3data rerender rec/session.mcap --camera my_camera.toml --steps 0:300:2 --format png -o frames/
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """.mcap files, episodes of a dataset such as ds#0, whole datasets, or folders of these, which are searched
    recursively.
    """
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the results: <recording>.<camera>.<output>, a video file or a folder of images. Recordings of a folder
    keep their relative paths.
    """
    cameras: tuple[str, ...]
    """Camera names or .toml files (default: top_down). An unknown name prints the list of cameras."""
    outputs: tuple[OutputName, ...]
    """Outputs to render."""
    assets: tuple[Path, ...]
    """Folders to search for recorded asset files (default: H3DATA_ASSETS)."""
    stand_ins: StandInsFlag
    steps: str
    """Range of steps as start:stop:stride (default: all)."""
    format: Format
    """mp4 (H.264) or av1: videos for viewing. png: images, depth as 16-bit millimetres, ids as 16-bit id + 1.
    data: H.264 for rgb, lossless 16-bit FFV1 for depth, PNG for ids."""
    size: str
    """Size of the pictures [pixels], such as 1280x720 (default: the camera's own). The horizontal field of view does
    not change, but top_down, top_down_orthographic and orbit keep the whole picture in view.
    """
    samples: Literal[1, 4] | None
    """Samples of colour per pixel: 4 smooths edges (default: 4 for mp4 and av1, 1 for png and data)."""
    people: PeopleOption
    light: LightOption
    backend: BackendOption
    workers: int | None
    """Number of render threads (default: one per core), or of Ray's workers, each for a recording."""
    executor: ExecutorOption
    dry_run: DryRunFlag = False
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Render all recordings, and return the files."""
        if self.size:
            parse_size(self.size)
        local(self.out)
        if not self.recordings:
            raise InputError("Expected at least one recording (.mcap).", code="H3-RENDER-089")
        if self.executor == "local" and not self.dry_run:  # elsewhere, each worker looks for itself
            check_backend(self.backend)
        check_workers(self.executor, self.workers)
        shards = _shards(self.recordings)
        twice = [name for name, times in Counter(str(s.below / s.stem) for s in shards).items() if times > 1]
        if twice:
            raise InputError(
                f"Several recordings are called {min(twice)!r}: their videos would overwrite each other. "
                "Render them one at a time, each with a different -o.",
                code="H3-RENDER-090",
            )
        lines, rows = [], []
        with keeping(lambda: self._kept(rows)), ExitStack() as stack:
            for text, row in self._rendered(shards, stack):
                lines += text
                rows.append(row)
        failed = sum("error" in row for row in rows)
        if failed:
            lines.append(f"{failed} of {len(rows)} recordings could not be rendered")
        result = Rendered(
            files=tuple(Path(file) for row in rows for file in row.get("files", ())),
            failed={row["recording"]: row["error"] for row in rows if "error" in row},
        )
        return Outcome(text="\n".join(lines), data={"recordings": rows}, result=result, exit_code=1 if failed else 0)

    @property
    def _samples(self) -> Literal[1, 4]:
        return self.samples or (4 if self.format in ("mp4", "av1") else 1)

    def _rendered(self, shards: Sequence[Shard], stack: ExitStack) -> Iterator[RenderedShard]:
        """Return all recordings in order: one after the other by threads of this process, or side by side by Ray."""
        work = partial(render_shard, self, alone=len(shards) == 1)
        if self.executor == "local":
            return map(work, shards)
        executor = stack.enter_context(opened(self.executor, self.workers or core_count()))
        work = partial(render_shard, replace(self, executor="local", workers=executor.threads), alone=len(shards) == 1)
        bar = stack.enter_context(progress(total=len(shards), desc="render", unit="recording"))
        results = stack.enter_context(closing(executor.run(work, shards, lost=_lost, writes=True)))
        return _counting(results, bar)

    def render(
        self, path: Path, stem: str, outputs: Sequence[Output], counter: str
    ) -> tuple[list[str], dict[str, Any]]:
        """Render one recording; return a summary as lines of text and as JSON data."""
        light = self.light if "rgb" in outputs else "flat"  # nothing else shows it
        replay = Replay(
            open_episode(path), assets=self.assets, people=self.people, light=light, stand_ins=self.stand_ins
        )
        tracks = [camera_track(replay, name) for name in self.cameras or ("top_down",)]
        if size := self.size and parse_size(self.size):
            tracks = [track.resized(*size) for track in tracks]
        names = [track.camera.name for track in tracks]
        if len(set(names)) < len(names):
            raise InputError(
                "Two cameras have the same name, so their files would overwrite each other.", code="H3-RENDER-091"
            )
        steps = parse_steps(self.steps, len(replay))
        if self.dry_run:
            files = [
                Target.named(self.out, stem, name, output, self.format).path for name in names for output in outputs
            ]
            row = {"recording": str(path), "frames": len(steps), "files": [str(file) for file in files]}
            return [f"would write {file}, {counted(len(steps), 'frame')}" for file in files] + missing_lines(
                replay
            ), row
        from h3data.replay.stage import chosen_backend

        drawn_by = chosen_backend(self.backend)
        log = CameraLog(self.out, stem, replay, steps, samples=self._samples, backend=drawn_by)
        views = [
            (track, [Target.named(self.out, stem, track.camera.name, output, self.format) for output in outputs])
            for track in tracks
        ]
        pending = [(track, [t for t in targets if self.force or not log.has(track, t)]) for track, targets in views]
        for track, targets in pending:
            if not self.force and not self._mark(stem, track).exists():
                _refuse_existing(targets)
        for track, targets in pending:
            if targets:
                with _disk_errors(self.out), self._marked(stem, track, targets):
                    log.forget(track, targets)
                    render_files(
                        replay,
                        [(track, targets)],
                        steps=steps,
                        threads=self.workers or core_count(),
                        samples=self._samples,
                        description=f"{counter}{stem} {track.camera.name}",
                        backend=drawn_by,
                    )
                    log.add(track, targets, fps=frames_per_second(replay, steps))
        rendered = {t.path for _, targets in pending for t in targets}
        files = [t.path for _, targets in views for t in targets]
        lines = [f"{'wrote' if file in rendered else 'kept '} {file}" for file in files] + missing_lines(replay)
        row = {
            "recording": str(path),
            "files": [str(file) for file in files],
            "kept": [str(file) for file in files if file not in rendered],
            "cameras": str(log.path),
            "missing": dict(sorted(replay.missing.items())),
        }
        return lines, row

    def _kept(self, rows: Sequence[dict[str, Any]]) -> str:
        """Say how many files of an interrupted run are complete; return an empty text if there are none."""
        files = sum(len(row.get("files", ())) for row in rows)
        return f"{counted(files, 'file')} in {self.out} are complete: the same command goes on" if files else ""

    def _mark(self, stem: str, track: CameraTrack) -> Path:
        return self.out / f"{stem}.{track.camera.name}.part"

    @contextmanager
    def _marked(self, stem: str, track: CameraTrack, targets: Sequence[Target]) -> Iterator[None]:
        """Keep a marker file while this camera is being rendered; a later run may replace incomplete files of it."""
        mark = self._mark(stem, track)
        self.out.mkdir(parents=True, exist_ok=True)
        mark.touch()
        try:
            yield
        except BaseException:
            if not any(target.path.exists() for target in targets):
                mark.unlink()
            raise
        mark.unlink()


@dataclass(frozen=True)
class Shard:
    """Shard of a job, which is one recording to render."""

    path: Path
    stem: str
    counter: str
    """Counter for progress lines, such as ``[2/7] ``."""
    below: PurePath
    """Folder of the results, relative to the output folder of the command."""


RenderedShard = tuple[list[str], dict[str, Any]]
"""Summary of a rendered recording, as lines of text and as JSON data."""


def render_shard(command: Rerender, shard: Shard, *, alone: bool) -> RenderedShard:
    """Render one recording. Errors are listed, unless it is the only recording or the disk is full."""
    command = replace(command, out=command.out / shard.below)
    try:
        return command.render(shard.path, shard.stem, tuple(dict.fromkeys(command.outputs)), shard.counter)
    except H3DataError as error:
        if alone or isinstance(error, DiskFullError):
            raise
        return _lost(shard, error)


def _shards(paths: Sequence[Path]) -> list[Shard]:
    """Return the recordings at the paths, including all recordings in folders and datasets."""
    found: list[tuple[Path, PurePath]] = []
    for path in paths:
        if not place(path).is_dir():
            found.append((path, PurePath()))
            continue
        root = path.parent if is_dataset(place(path)) else path
        found += [(of := Path(source.name), of.relative_to(root).parent) for source in find_episodes([path])]
    counters = [f"[{k + 1}/{len(found)}] " if len(found) > 1 else "" for k in range(len(found))]
    return [
        Shard(path, recording_stem(path), counter, below)
        for (path, below), counter in zip(found, counters, strict=True)
    ]


def _counting(results: Iterator[RenderedShard], bar: Any) -> Iterator[RenderedShard]:
    for result in results:
        bar.update()
        yield result


def _lost(shard: Shard, error: H3DataError) -> RenderedShard:
    return [f"failed {shard.path}: {error}"], {"recording": str(shard.path), "error": str(error), "code": error.code}


class DiskFullError(InputError):
    """Error of a job whose output disk is full."""


@contextmanager
def _disk_errors(folder: Path) -> Iterator[None]:
    """Turn errors of a full disk and of a folder without write access into `InputError`."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            free = shutil.disk_usage(folder).free / 1e6 if folder.is_dir() else 0
            raise DiskFullError(
                f"The disk is full ({free:.0f} MB free). Complete files are kept; free some space and run the same "
                f"command again to continue: {folder}",
                code="H3-RENDER-093",
            ) from None
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.ENAMETOOLONG):
            raise InputError(f"Cannot write here ({error.strerror}): {folder}", code="H3-RENDER-094") from None
        raise


def _refuse_existing(targets: Sequence[Target]) -> None:
    for target in targets:
        if target.path.exists():
            kind = "folder" if target.path.is_dir() else "file"
            raise InputError(
                f"The output {kind} exists but was made from another recording, camera or range of steps. Use --force to "
                f"overwrite it, or another -o: {target.path}",
                code="H3-RENDER-092",
            )


def parse_steps(text: str, count: int) -> range:
    """Parse ``"start:stop:stride"``, each part optional and as in a Python slice, as a range within ``count`` steps."""
    if not text:
        return range(count)
    if not re.fullmatch(r"-?\d*(:-?\d*){0,2}", text) or text.endswith("::-"):
        raise InputError(f"Expected steps as start:stop:stride, e.g. 0:300:2, got {text!r}.", code="H3-RENDER-086")
    parts = [int(p) if p not in ("", "-") else None for p in text.split(":")]
    if len(parts) == 1:
        parts = [parts[0], None if parts[0] == -1 else (parts[0] or 0) + 1]
    if len(parts) == 3 and parts[2] is not None and parts[2] <= 0:
        raise InputError(f"Expected a positive stride in the steps, got {text!r}.", code="H3-RENDER-087")
    steps = range(count)[slice(*parts)]
    if not len(steps):
        raise InputError(
            f"The steps {text!r} select nothing: the recording has {count} steps, 0 to {count - 1}.",
            code="H3-RENDER-088",
        )
    return steps
