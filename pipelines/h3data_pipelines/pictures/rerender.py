"""``h3data rerender``: videos or pictures of recordings from any camera."""

from __future__ import annotations

import errno
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.errors import H3DataError, InputError
from h3data.recording.storage import local
from h3data.replay import CameraTrack, Replay, camera_track
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, open_episode
from h3data_pipelines.commands.importing import recording_stem
from h3data_pipelines.jobs.camera_log import CameraLog
from h3data_pipelines.outputs import OUTPUTS, Format, Target
from h3data_pipelines.pictures.drawing import core_count, draw_files, frames_per_second

if TYPE_CHECKING:
    from h3data.render import Output


@dataclass(frozen=True)
class Rerender:
    """Draw recordings again from any camera, any number of each: videos that a browser plays, or lossless data.

    The same command again goes on where it was interrupted: what is complete is kept. Beside the videos,
    <recording>.cameras.json holds each camera's K and its pose at every frame.

    Examples:
        h3data rerender out/demo/episode.mcap --camera top_down --camera robot_arm --outputs rgb,depth -o videos/
        h3data rerender rec/*.mcap --camera third_person --outputs rgb,depth,instance --format data -o training/
        h3data rerender rec/session.mcap --camera my_camera.toml --steps 0:300:2 --format png -o frames/
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """.mcap files, or episodes of a dataset as ds#0."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the results: <recording>.<camera>.<output>, with a suffix or as a folder of pictures."""
    camera: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Camera name or .toml file; may be given several times (default: top_down). Unknown names list what there is."""
    outputs: str = "rgb"
    """Comma-separated: rgb, depth, instance, semantic."""
    assets: tuple[Path, ...] = ()
    """Folders below which recorded asset files are searched (default: H3DATA_ASSETS)."""
    steps: str = ""
    """Which steps, as start:stop:stride (default: all)."""
    format: Format = "mp4"
    """mp4 (H.264) or av1: videos to look at. png: pictures, depth as 16-bit millimetres, ids as 16-bit id + 1.
    data: H.264 for rgb, lossless 16-bit FFV1 for depth, PNG for ids."""
    workers: int | None = None
    """Threads that draw (default: one per core)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        outputs = parse_outputs(self.outputs)
        local(self.out)
        if not self.recordings:
            raise InputError("Expected at least one recording (.mcap).")
        if self.workers is not None and self.workers < 1:
            raise InputError(f"--workers must be at least 1, got {self.workers}.")
        stems = [recording_stem(path) for path in self.recordings]
        twice = sorted({stem for stem in stems if stems.count(stem) > 1})
        if twice:
            raise InputError(
                f"Several recordings are called {twice[0]!r}, their videos would overwrite each other. "
                "Render them one at a time, each to another -o."
            )
        lines, rows = [], []
        for number, (path, stem) in enumerate(zip(self.recordings, stems, strict=True)):
            place = f"[{number + 1}/{len(stems)}] " if len(stems) > 1 else ""
            try:
                told, row = self._one(path, stem, outputs, place)
            except H3DataError as error:
                if len(stems) == 1 or isinstance(error, DiskFullError):
                    raise
                told, row = [f"failed {path}: {error}"], {"recording": str(path), "error": str(error)}
            lines += told
            rows.append(row)
        failed = sum("error" in row for row in rows)
        if failed:
            lines.append(f"{failed} of {len(rows)} recordings could not be drawn")
        return Outcome(text="\n".join(lines), data={"recordings": rows}, exit_code=1 if failed else 0)

    def _one(self, path: Path, stem: str, outputs: Sequence[Output], place: str) -> tuple[list[str], dict[str, Any]]:
        """Draw one recording; what to tell, as text and as data."""
        replay = Replay(open_episode(path), assets=self.assets)
        tracks = [camera_track(replay, name) for name in self.camera or ("top_down",)]
        names = [track.camera.name for track in tracks]
        if len(set(names)) < len(names):
            raise InputError("Two cameras have the same name, so their files would overwrite each other.")
        steps = parse_steps(self.steps, len(replay))
        log = CameraLog(self.out, stem, replay, steps)
        views = [
            (track, [Target.named(self.out, stem, track.camera.name, output, self.format) for output in outputs])
            for track in tracks
        ]
        todo = [(track, [t for t in targets if self.force or not log.has(track, t)]) for track, targets in views]
        for track, targets in todo:
            if not self.force and not self._mark(stem, track).exists():
                _refuse_existing(targets)
        for track, targets in todo:
            if targets:
                with _errors_of_the_disk(self.out), self._marked(stem, track, targets):
                    log.forget(track, targets)
                    draw_files(
                        replay, [(track, targets)], steps=steps, threads=self.workers or core_count(),
                        description=f"{place}{stem} {track.camera.name}",
                    )  # fmt: skip
                    log.add(track, targets, fps=frames_per_second(replay, steps))
        drawn = {t.path for _, targets in todo for t in targets}
        files = [t.path for _, targets in views for t in targets]
        lines = [f"{'wrote' if file in drawn else 'kept '} {file}" for file in files] + missing_lines(replay)
        row = {
            "recording": str(path),
            "files": [str(file) for file in files],
            "kept": [str(file) for file in files if file not in drawn],
            "cameras": str(log.path),
            "missing": dict(sorted(replay.missing.items())),
        }
        return lines, row

    def _mark(self, stem: str, track: CameraTrack) -> Path:
        return self.out / f"{stem}.{track.camera.name}.part"

    @contextmanager
    def _marked(self, stem: str, track: CameraTrack, targets: Sequence[Target]) -> Iterator[None]:
        """A file that is there as long as this camera is under way, so that a later run may replace what is half done."""
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


class DiskFullError(InputError):
    """There is no room for the results."""


@contextmanager
def _errors_of_the_disk(folder: Path) -> Iterator[None]:
    """A disk without room and a folder that cannot be written, in words."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            free = shutil.disk_usage(folder).free / 1e6 if folder.is_dir() else 0
            raise DiskFullError(
                f"The disk is full ({free:.0f} MB free). What is complete is kept; make room and run the same command "
                f"again to go on. {folder}"
            ) from None
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.ENAMETOOLONG):
            raise InputError(f"Cannot write here ({error.strerror}): {folder}") from None
        raise


def _refuse_existing(targets: Sequence[Target]) -> None:
    for target in targets:
        if target.path.exists():
            kind = "folder" if target.path.is_dir() else "file"
            raise InputError(
                f"The output {kind} exists and was made of something else. Use --force to overwrite, or another -o: "
                f"{target.path}"
            )


def parse_outputs(text: str) -> tuple[Output, ...]:
    """``"rgb,depth"`` as a tuple; an `InputError` names what exists."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in OUTPUTS]
    if unknown or not names:
        raise InputError(f"Unknown outputs {unknown or text!r}. Expected some of: {', '.join(OUTPUTS)}.")
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
