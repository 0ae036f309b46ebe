"""Import of recordings of other programs, file by file, with a result for each file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from h3data.commands.command import claim_file, keeping, recording_stem
from h3data.errors import FormatError, H3DataError, InputError
from h3data.formats import FORMATS, Format, ImportRequest, SourceFile, detect, load
from h3data.progress import progress
from h3data.recording import Recording
from h3data.recording.assets.library import AssetLibrary
from h3data.replay import Replay
from h3data.terminal import counted
from h3data_pipelines.format_names import import_suffixes
from h3data_pipelines.session_manifest import SessionManifest, read_manifest


@dataclass(frozen=True)
class ImportJob:
    """File to import and the recording to write."""

    source: Path
    target: Path
    below: PurePosixPath
    """Path of the file relative to the named folder, or the name of a file that was named itself."""


@dataclass(frozen=True, kw_only=True)
class ImportedFile:
    """Result of importing one file."""

    source: Path
    status: Literal["imported", "kept", "skipped", "failed"]
    """Status of the import; "kept" means that an earlier import has written the same recording."""
    kind: str = "unknown"
    """Name of the file's format."""
    recording: Path | None = None
    reason: str = ""
    """Reason why the file was not imported."""
    code: str = ""
    """Code of the error, if there was one."""
    summary: dict[str, Any] = field(default_factory=dict)
    """Counts, agents, missing assets, participant and condition, warnings; see `summarize`."""

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON types."""
        facts = {"source": str(self.source), "status": self.status, "kind": self.kind}
        facts |= {"recording": str(self.recording)} if self.recording else {}
        facts |= {"reason": self.reason} if self.reason else {}
        return facts | ({"code": self.code} if self.code else {}) | self.summary


@dataclass(frozen=True, kw_only=True)
class ImportResult:
    """Results of importing all files."""

    files: tuple[ImportedFile, ...]
    manifest_notes: tuple[str, ...] = ()
    """Rows of the manifest that match no file, recordings without a row, and columns with unknown names."""

    def count(self, status: str) -> int:
        """Return the number of files with a given status."""
        return sum(file.status == status for file in self.files)


def import_files(
    paths: Sequence[Path],
    out: Path,
    *,
    assets: Sequence[Path] = (),
    manifest: Path | None = None,
    fps: float = 30.0,
    tracks: ImportRequest | None = None,
    strict: bool = False,
    force: bool = False,
) -> ImportResult:
    """Import files and folders of files as MCAP recordings in the folder ``out``.

    If a single file cannot be imported, an error is raised. Among several files, such a file is listed and the others
    are imported.

    Args:
        paths: Files, and folders that are searched recursively.
        out: Folder of the recordings; files of a folder keep their relative paths.
        assets: Folders below which recorded asset files are searched (default: H3DATA_ASSETS).
        manifest: CSV table of participants and conditions (`h3data_pipelines.session_manifest`).
        fps: Steps per second of files without times.
        tracks: Options for bags and files of tracks.
        strict: True refuses recordings with warnings or missing assets.
        force: True if existing recordings may be replaced.

    Raises:
        InputError: there is nothing to import.
        FormatError: the manifest, or the only file, has the wrong format or is damaged.
    """
    if not 0.001 <= fps <= 1000:
        raise InputError(f"--fps must be at least 0.001 and at most 1000, got {fps}.", code="H3-JOB-036")
    importer = _Importer(
        AssetLibrary(assets),
        None if manifest is None else read_manifest(manifest),
        fps=fps,
        tracks=tracks or ImportRequest(),
        strict=strict,
        force=force,
    )
    jobs = _jobs(paths, out)
    alone = len(jobs) == 1 and (jobs[0].source in paths or _is_bag(jobs[0].source))
    files: list[ImportedFile] = []
    with keeping(lambda: _kept(files, out)):
        for job in progress(jobs, desc="import", unit="file", at_least=2):
            files.append(importer.run(job) if alone else importer.attempt(job))  # noqa: PERF401 - kept on Ctrl-C
    return ImportResult(files=tuple(files), manifest_notes=tuple(importer.manifest_notes()))


def _kept(files: Sequence[ImportedFile], out: Path) -> str:
    imported = sum(file.status == "imported" for file in files)
    return f"{counted(imported, 'recording')} in {out}: the same command goes on" if imported else ""


def _is_imported(recording: Recording, target: Path) -> bool:
    """Return whether a file holds this very recording, of an import that was interrupted."""
    from h3data.recording import read_mcap, recordings_equal

    try:
        return target.is_file() and not recordings_equal(recording, read_mcap(target))
    except H3DataError:
        return False


def summarize(recording: Recording, library: AssetLibrary) -> dict[str, Any]:
    """Summarise a recording's contents, and list its asset files that are missing in the library's folders."""
    missing = Replay(recording, assets=library).missing
    info = recording.episode.info
    return {
        "steps": len(recording),
        "seconds": round(recording.duration_s, 3),
        "bodies": len(recording.bodies),
        "moving": len(recording.moving_bodies),
        "agents": [{"name": a.name, "kind": a.kind} for a in recording.agents],
        "assets": len(recording.assets),
        "missing_assets": len(missing),
        "missing": sorted(missing),
        "participant": str(info.get("participant", "")),
        "condition": str(info.get("condition", "")),
        "imported": dict(info.get("imported", {})),
        "synthesised": dict(info.get("synthesised", {})),
        "warnings": list(info.get("warnings", ())),
    }


class _Importer:
    """Importer of one file after the other."""

    def __init__(
        self,
        library: AssetLibrary,
        manifest: SessionManifest | None,
        *,
        fps: float,
        tracks: ImportRequest,
        strict: bool,
        force: bool,
    ) -> None:
        self._library, self._manifest = library, manifest
        self._fps, self._tracks, self._strict, self._force = fps, tracks, strict, force
        self._written: dict[Path, Path] = {}
        self._strangers: list[str] = []

    def attempt(self, job: ImportJob) -> ImportedFile:
        """Import as `run` does, but report files that cannot be imported in the result."""
        kind, status = "unknown", "failed"
        try:
            file = SourceFile(job.source)
            form = detect(file)
            kind = form.name
            twin = self._written.get(job.target)
            if kind == "hitl_log" and twin is not None and twin.name == job.source.name.replace(".json", ".pkl"):
                reason = f"the same log as {twin.name}, which is not rounded"
                return ImportedFile(source=job.source, status="skipped", kind=kind, reason=reason)
            if form.read is None and kind != "unknown":
                status = "skipped"
            return self._import(file, form, job)
        except H3DataError as error:
            return ImportedFile(source=job.source, status=status, kind=kind, reason=str(error), code=error.code)

    def run(self, job: ImportJob) -> ImportedFile:
        """Import one file.

        Raises:
            H3DataError: it cannot be imported.
        """
        file = SourceFile(job.source)
        return self._import(file, detect(file), job)

    def manifest_notes(self) -> list[str]:
        """Return notes on manifest rows and recordings that have no counterpart."""
        if self._manifest is None:
            return []
        notes, name = [], self._manifest.path.name
        if lines := self._manifest.unused:
            shown = ", ".join(map(str, lines[:8])) + (", ..." if len(lines) > 8 else "")
            notes.append(f"{name}: no recording fits line {shown}")
        if self._strangers:
            shown = ", ".join(self._strangers[:4]) + (", ..." if len(self._strangers) > 4 else "")
            notes.append(f"{name}: no line fits {len(self._strangers)} of the recordings: {shown}")
        if self._manifest.ignored:
            notes.append(f"{name}: columns without a meaning here are not used: {', '.join(self._manifest.ignored)}")
        return notes

    def _import(self, file: SourceFile, form: Format, job: ImportJob) -> ImportedFile:
        from h3data.recording import write_mcap

        recording = self._read(file, form)
        if job.target in self._written:
            raise InputError(
                f"Another input of this run became {job.target}. Import this one with another -o: {file.path}",
                code="H3-JOB-037",
            )
        if self._manifest is not None:
            recording, fitted = self._manifest.applied(recording, job.below)
            if not fitted:
                self._strangers.append(str(job.below))
        kind = recording.episode.info.get("source", {}).get("format", form.name)  # a pickle is a HITL log
        if not self._force and _is_imported(recording, job.target):
            self._written[job.target] = file.path
            return ImportedFile(source=job.source, status="kept", kind=kind, recording=job.target)
        claim_file(job.target, force=self._force)
        summary = summarize(recording, self._library)
        faults = [*summary["warnings"], *(f"missing asset {name}" for name in summary["missing"])]
        if self._strict and faults:
            raise InputError(
                f"--strict: {len(faults)} faults, the first: {'; '.join(faults[:3])}: {file.path}", code="H3-JOB-038"
            )
        write_mcap(recording, job.target, overwrite=self._force)
        self._written[job.target] = file.path
        return ImportedFile(source=job.source, status="imported", kind=kind, recording=job.target, summary=summary)

    def _read(self, file: SourceFile, form: Format) -> Recording:
        if form.name in ("json", "unknown"):
            form = FORMATS.get("gfx_replay")  # whose reader says where it stops being one
        if form.read is None:
            hint = f" Hint: {form.hint}." if form.hint else ""
            raise FormatError(f"Expected a recording, this is {form.title}.{hint} {file.path}", code="H3-JOB-039")
        if self._tracks != ImportRequest() and "tracks" not in form.read_options:
            raise InputError(
                f"--people, --robot, --map, --goal, --columns, --unit, --rate and --hz are for bags and tracks; this is "
                f"{form.title}. Leave them out: {file.path}",
                code="H3-JOB-051",
            )
        options = {"fps": self._fps, "assets": self._library, "tracks": self._tracks}
        return load(form, "read")(file, **{name: options[name] for name in form.read_options})


def _is_bag(file: Path) -> bool:
    """Return whether a file stands for its folder, a bag of ROS 2, whose name the recording gets."""
    return file.name == "metadata.yaml"


def _jobs(paths: Sequence[Path], out: Path) -> list[ImportJob]:
    """Return every file with the recording that it becomes; files of a folder keep their place below it."""
    if not paths:
        raise InputError("Expected at least one file or folder to import.", code="H3-BODY-129")
    jobs: list[ImportJob] = []

    def add(file: Path, below: Path) -> None:
        named, place = (file.parent.resolve(), below.parent.parent) if _is_bag(file) else (file, below.parent)
        target = out / place / f"{recording_stem(named)}.mcap"
        jobs.append(ImportJob(file, target, PurePosixPath(below.as_posix())))

    for path in paths:
        if path.is_dir():
            suffixes = import_suffixes()
            files = sorted(p for p in path.rglob("*") if p.is_file() and p.name.endswith(suffixes))
            files.sort(key=lambda p: not p.name.endswith(".pkl.gz"))  # stable: logs that are not rounded come first
            if not files:
                FORMATS.get("gfx_replay")  # where its package is missing, it fails and says which one has it
                raise InputError(
                    f"No {', '.join(suffixes[:-1])} or {suffixes[-1]} file in this folder: {path}", code="H3-JOB-040"
                )
            for file in files:
                add(file, file.relative_to(path))
        elif path.is_file():
            add(path, Path(path.name))
        elif path.exists():
            raise InputError(
                f"Expected a file or folder, this is a pipe or device, which cannot be read twice: {path}",
                code="H3-JOB-041",
            )
        else:
            raise InputError(
                f"There is no such file or folder. Expected one of those in `h3data docs import`: {path}",
                code="H3-JOB-042",
            )
    return jobs
