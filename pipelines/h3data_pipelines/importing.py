"""``h3data import``: recordings that others made become recordings of ours."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tqdm import tqdm

from h3data.errors import FormatError, H3DataError, InputError
from h3data.interop import AssetLibrary, read_gfx_replay, sniff
from h3data.recording import Recording
from h3data.replay import Replay
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_file

_SUFFIXES = (".json", ".json.gz")


@dataclass(frozen=True)
class Import:
    """Turn Habitat recordings into MCAP recordings. Folders are walked, kinds are detected by content.

    Examples:
        h3data import my_session.gfx_replay.json -o rec/
        h3data import hitl_sessions/ -o rec/ --assets ~/habitat
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """gfx-replay files (.json, .json.gz) or folders that hold some."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the recordings, one .mcap each; files of a folder keep their place below it."""
    assets: tuple[Path, ...] = ()
    """Folders below which the recorded asset files are searched (default: H3DATA_ASSETS), to report what is missing."""
    fps: float = 30.0
    """Keyframes per second: a gfx-replay stores no times."""
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
            return _report([self._one(*sources[0], library, set())])  # refused as a whole if it cannot be read
        rows: list[dict[str, Any]] = []
        written: set[Path] = set()
        for path, target in tqdm(sources, desc="import", unit="file", disable=None):
            try:
                rows.append(self._one(path, target, library, written))
            except H3DataError as error:
                kind = sniff(path) if isinstance(error, FormatError) else "unknown"
                status = (
                    {"status": "failed"} if kind in ("gfx_replay", "unknown") else {"status": "skipped", "kind": kind}
                )
                rows.append({"source": str(path), **status, "reason": str(error)})
        return _report(rows)

    def _one(self, path: Path, target: Path, library: AssetLibrary, written: set[Path]) -> dict[str, Any]:
        from h3data.recording import write_mcap

        recording = read_gfx_replay(path, fps=self.fps)
        if target in written:
            raise InputError(f"Another input of this run became {target}. Import this one with another -o: {path}")
        claim_file(target, force=self.force)
        summary = summarize(recording, library)
        faults = [*summary["warnings"], *(f"missing asset {name}" for name in summary["missing"])]
        if self.strict and faults:
            raise InputError(f"--strict: {len(faults)} faults, the first: {'; '.join(faults[:3])}: {path}")
        write_mcap(recording, target, overwrite=self.force)
        written.add(target)
        return {
            "source": str(path),
            "status": "imported",
            "kind": "gfx_replay",
            "recording": str(target),
            **summary,
        }


def recording_stem(path: Path) -> str:
    """``my_session`` of ``my_session.gfx_replay.json.gz``."""
    name = path.name
    for suffix in (".gz", ".json", ".gfx_replay", ".mcap"):
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
        "warnings": list(recording.episode.info.get("warnings", ())),
    }


def _collect(paths: tuple[Path, ...], out: Path) -> list[tuple[Path, Path]]:
    """Every file with the recording that it becomes; files of a folder keep their place below it."""
    sources: list[tuple[Path, Path]] = []
    for path in paths:
        if path.is_dir():
            found = sorted(p for p in path.rglob("*") if p.is_file() and p.name.endswith(_SUFFIXES))
            if not found:
                raise InputError(f"No .json or .json.gz file in this folder: {path}")
            sources += [(p, out / p.relative_to(path).parent) for p in found]
        elif path.exists():
            sources.append((path, out))
        else:
            raise InputError(f"There is no such file or folder. Expected a gfx-replay (.json or .json.gz): {path}")
    return [(path, folder / f"{recording_stem(path)}.mcap") for path, folder in sources]


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
            counts.lines += [f"         warning: {w}" for w in row["warnings"]]
        else:
            counts.lines.append(f"{row['status']} {row['source']}: {row['reason']}")
    if len(rows) > 1:
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
