"""``h3data import``: turns recordings of other programs into MCAP recordings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tqdm import tqdm

from h3data.errors import FormatError, H3DataError, InputError
from h3data.formats import FORMATS, Format, SourceFile, detect, import_suffixes, load
from h3data.habitat.asset_library import AssetLibrary
from h3data.recording import Recording
from h3data.replay import Replay
from h3data_pipelines.assets.scene_reports import text_table
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_file


@dataclass(frozen=True)
class Import:
    """Turn recordings of other programs into MCAP recordings. Folders are searched, formats are detected by content.

    Reads gfx-replay files, the logs of Habitat's human-in-the-loop tools, and formats of plug-ins (docs/import.md).

    Examples:
        h3data import my_session.gfx_replay.json -o rec/
        h3data import hitl_sessions/ -o rec/ --assets ~/habitat
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """gfx-replay files (.json, .json.gz), HITL logs (.json.gz, .pkl.gz) or folders that hold some."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the recordings, one .mcap each; files of a folder keep their place below it."""
    assets: tuple[Path, ...] = ()
    """Folders below which the recorded asset files are searched (default: H3DATA_ASSETS), to report what is missing."""
    fps: float = 30.0
    """Steps per second of files without times: gfx-replays and the first generation of HITL logs."""
    strict: bool = False
    """Refuse recordings with warnings or missing assets."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        if not self.paths:
            raise InputError("Expected at least one file or folder to import.")
        if not 0.001 <= self.fps <= 1000:
            raise InputError(f"--fps must be at least 0.001 and at most 1000, got {self.fps}.")
        sources = _collect(self.paths, self.out)
        library = AssetLibrary(self.assets)
        if len(sources) == 1 and sources[0][0] in self.paths:
            path, target = sources[0]
            file = SourceFile(path)
            return _report([self._one(file, detect(file), target, library, {})])  # refused as a whole if unreadable
        rows: list[dict[str, Any]] = []
        written: dict[Path, Path] = {}
        for path, target in tqdm(sources, desc="import", unit="file", disable=None):
            file, form = SourceFile(path), None
            row: dict[str, Any] = {"source": str(path), "status": "failed", "kind": "unknown"}
            try:
                form = detect(file)
                row["kind"] = form.name
                twin = written.get(target)
                if form.name == "hitl_log" and twin is not None and twin.name == path.name.replace(".json", ".pkl"):
                    row |= {"status": "skipped", "reason": f"the same log as {twin.name}, which is not rounded"}
                else:
                    row = self._one(file, form, target, library, written)
            except H3DataError as error:
                row["reason"] = str(error)
                if form is not None and form.read is None and form.name != "unknown":
                    row["status"] = "skipped"
            rows.append(row)
        return _report(rows)

    def _one(
        self, file: SourceFile, form: Format, target: Path, library: AssetLibrary, written: dict[Path, Path]
    ) -> dict[str, Any]:
        from h3data.recording import write_mcap

        recording = self._read(file, form, library)
        if target in written:
            raise InputError(f"Another input of this run became {target}. Import this one with another -o: {file.path}")
        claim_file(target, force=self.force)
        summary = summarize(recording, library)
        faults = [*summary["warnings"], *(f"missing asset {name}" for name in summary["missing"])]
        if self.strict and faults:
            raise InputError(f"--strict: {len(faults)} faults, the first: {'; '.join(faults[:3])}: {file.path}")
        write_mcap(recording, target, overwrite=self.force)
        written[target] = file.path
        return {
            "source": str(file.path),
            "status": "imported",
            "kind": recording.episode.info.get("source", {}).get("format", form.name),  # a pickle is a HITL log
            "recording": str(target),
            **summary,
        }

    def _read(self, file: SourceFile, form: Format, library: AssetLibrary) -> Recording:
        if form.name in ("json", "unknown"):
            form = FORMATS.get("gfx_replay")  # whose reader says where it stops being one
        if form.read is None:
            hint = f" Hint: {form.hint}." if form.hint else ""
            raise FormatError(f"Expected a recording, this is {form.title}.{hint} {file.path}")
        options = {"fps": self.fps, "assets": library}
        return load(form, "read")(file, **{name: options[name] for name in form.read_options})


def recording_stem(path: Path) -> str:
    """``my_session`` of ``my_session.gfx_replay.json.gz``."""
    name = path.name
    for suffix in (".gz", ".json", ".pkl", ".gfx_replay", ".mcap"):
        name = name.removesuffix(suffix)
    return name or path.stem


def summarize(recording: Recording, library: AssetLibrary) -> dict[str, Any]:
    """Counts of a recording, and which of its asset files are missing below the library's roots."""
    missing = Replay(recording, assets=library).missing
    return {
        "steps": len(recording),
        "seconds": round(recording.duration_s, 3),
        "bodies": len(recording.bodies),
        "moving": len(recording.moving_bodies),
        "agents": [{"name": a.name, "kind": a.kind} for a in recording.agents],
        "assets": len(recording.assets),
        "missing_assets": len(missing),
        "missing": sorted(missing),
        "synthesised": dict(recording.episode.info.get("synthesised", {})),
        "warnings": list(recording.episode.info.get("warnings", ())),
    }


def _collect(paths: tuple[Path, ...], out: Path) -> list[tuple[Path, Path]]:
    """Every file with the recording that it becomes; files of a folder keep their place below it."""
    sources: list[tuple[Path, Path]] = []
    for path in paths:
        if path.is_dir():
            suffixes = import_suffixes()
            files = sorted(p for p in path.rglob("*") if p.is_file() and p.name.endswith(suffixes))
            files.sort(key=lambda p: not p.name.endswith(".pkl.gz"))  # stable: logs that are not rounded come first
            if not files:
                raise InputError(f"No {', '.join(suffixes[:-1])} or {suffixes[-1]} file in this folder: {path}")
            sources += [(p, out / p.relative_to(path).parent) for p in files]
        elif path.is_file():
            sources.append((path, out))
        elif path.exists():
            raise InputError(f"Expected a file or folder, this is a pipe or device, which cannot be read twice: {path}")
        else:
            raise InputError(f"There is no such file or folder. Expected a gfx-replay or a HITL log: {path}")
    return [(path, folder / f"{recording_stem(path)}.mcap") for path, folder in sources]


def _table(rows: list[dict[str, Any]]) -> str:
    """One line for each file: what became of it, what it is, and why it was not imported."""
    cells = [(row["status"], row["kind"], row["source"], str(row.get("steps", "")), _why(row)) for row in rows]
    return text_table(("", "kind", "file", "steps", "why"), cells)


def _why(row: dict[str, Any]) -> str:
    """Why a file was not imported, short enough for a table."""
    reason = row.get("reason", "").partition(" Hint:")[0]
    return reason.replace(row["source"], "").strip(" :")[:100]


@dataclass
class _Counts:
    imported: int = 0
    skipped: int = 0
    failed: int = 0
    lines: list[str] = field(default_factory=list)


def _report(rows: list[dict[str, Any]]) -> Outcome:
    counts = _Counts()
    for row in rows:
        setattr(counts, row["status"], getattr(counts, row["status"]) + 1)
        if row["status"] == "imported":
            agents = ", ".join(f"{a['name']} ({a['kind']})" for a in row["agents"]) or "none recognised"
            counts.lines += [
                f"imported {row['source']} -> {row['recording']}",
                f"         {row['steps']} steps, {row['bodies']} bodies ({row['moving']} moving), agents: {agents}",
            ]
            if row["missing_assets"]:
                counts.lines.append(
                    f"         {row['missing_assets']} of {row['assets']} assets not found; they are drawn as marked "
                    "placeholders. Hint: --assets DIR or H3DATA_ASSETS"
                )
            if row["synthesised"]:
                made_up = "; ".join(f"{name}: {', '.join(what)}" for name, what in row["synthesised"].items())
                counts.lines.append(f"         not in the file, made up: {made_up}")
            counts.lines += [f"         warning: {w}" for w in row["warnings"]]
        else:
            counts.lines.append(f"{row['status']} {row['source']}: {row['reason']}")
    if len(rows) > 1:
        counts.lines += ["", _table(rows), ""]
        counts.lines.append(f"{counts.imported} imported, {counts.skipped} skipped, {counts.failed} failed")
    data: dict[str, Any] = {
        "imported": counts.imported,
        "skipped": counts.skipped,
        "failed": counts.failed,
        "files": rows,
    }
    if len(rows) == 1:
        data |= {k: v for k, v in rows[0].items() if k in ("steps", "recording", "bodies", "moving", "agents")}
    return Outcome(text="\n".join(counts.lines), data=data, exit_code=1 if counts.failed or not counts.imported else 0)
