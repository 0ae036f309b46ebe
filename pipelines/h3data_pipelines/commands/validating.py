"""Command ``h3data validate``, which finds faults of recordings and prints them as a table or as JSON."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from h3data.commands.command import JsonFlag, Outcome
from h3data.commands.executors import ExecutorOption, check_workers, opened
from h3data.errors import FormatError, H3DataError, InputError, with_code
from h3data.progress import progress
from h3data.recording import Recording
from h3data.recording.episodes import StoredEpisode
from h3data_pipelines.jobs.episode_parts import EpisodePart, episode_parts

_TOGETHER = 16
"""Number of episodes of a shard: some tenths of a second."""
_STEPS_TOGETHER = 10_000
"""Number of steps of a dataset that are read at once."""
_SHOWN = 4
"""Number of findings per kind and recording in the text; JSON has all."""


@dataclass(frozen=True)
class Validate:
    """Check recordings for errors; the exit code is 1 if there are any.

    The checks cover schema, time, values, unit quaternions, the hash chain, jumps, penetrations, sliding feet, missing
    assets and videos. An error means that the recording is wrong, a warning that something about it is unusual.

    Examples:
        h3data validate out/demo/episode.mcap
        h3data validate ds/ recordings/ --json
        h3data validate rec/session.mcap --assets ~/habitat --strict
        h3data validate out/demo/episode.mcap --parts
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """.mcap files, datasets, single episodes (ds#3), and folders of these."""
    assets: tuple[Path, ...] = ()
    """Folders to search for recorded asset files (default: H3DATA_ASSETS)."""
    parts: bool = False
    """Check every part of every agent and the things it holds against walls and furniture (FCL; about 1 ms per agent
    and step).
    """
    strict: bool = False
    """Count warnings as errors."""
    workers: int = 1
    """Number of processes that validate."""
    executor: ExecutorOption = "local"
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Check all episodes, with ``workers`` processes, and return the findings."""
        check_workers(self.executor, self.workers)
        if not self.paths:
            raise InputError("Expected at least one recording (.mcap) or dataset.", code="H3-METRIC-002")
        parts = episode_parts(self.paths, together=_TOGETHER)
        rows: list[dict[str, Any]] = []
        bar = progress(total=parts[0].count if parts else 0, desc="validate", unit="episode")
        with (
            opened(self.executor, self.workers) as executor,
            bar,
            closing(executor.run(partial(validate_part, self), parts, lost=_lost)) as results,
        ):
            for of_part in results:
                rows += of_part
                bar.update(len(of_part))
        failed = sum(row["verdict"] == "failed" for row in rows)
        counts = {
            s: Counter(f["check"] for row in rows for f in row["findings"] if f["severity"] == s) for s in _SEVERITIES
        }
        data: dict[str, Any] = {"recordings": len(rows), "failed": failed, **counts, "episodes": rows}
        return Outcome(text=_text(rows, failed), data=data, exit_code=1 if failed else 0)

    def row(self, source: StoredEpisode, read: Callable[[], Recording], library: Any, *, alone: bool) -> dict[str, Any]:
        """Return the findings in one recording, which the function ``read`` returns."""
        from h3data_pipelines.validation.recordings import Finding, validate_recording

        steps = 0
        try:
            recording = read()
            steps = len(recording)
            findings = validate_recording(recording, assets=library)
            if self.parts and not any(finding.severity == "error" for finding in findings):  # else it may not be posed
                from h3data_pipelines.validation.penetration import penetration_findings

                findings += penetration_findings(recording)
            for video in source.read_videos():
                try:
                    deque(video.frames(), maxlen=0)
                except FormatError as error:
                    findings.append(
                        Finding(check="video", severity="error", subject=video.feature.camera, text=with_code(error))
                    )
        except H3DataError as error:
            if alone and not isinstance(error, FormatError):
                raise
            findings = [Finding(check="unreadable", severity="error", subject=source.name, text=with_code(error))]
        bad = bool(findings) if self.strict else any(f.severity == "error" for f in findings)
        verdict = "failed" if bad else "warnings" if findings else "sound"
        rows = [asdict(f) for f in findings]
        return {"recording": source.name, "steps": steps, "verdict": verdict, "findings": rows}


def validate_part(command: Validate, part: EpisodePart) -> list[dict[str, Any]]:
    """Return the findings in the recordings of one part of the job."""
    from h3data.recording.assets.library import AssetLibrary

    library = AssetLibrary(command.assets)
    sources = part.sources()
    return [
        command.row(source, read, library, alone=part.count == 1)
        for source, read in zip(sources, read_ahead(sources, most_steps=_STEPS_TOGETHER), strict=True)
    ]


def _lost(part: EpisodePart, error: H3DataError) -> list[dict[str, Any]]:
    finding = {"check": "unreadable", "severity": "error", "subject": "", "text": with_code(error)}
    return [
        {"recording": source.name, "steps": 0, "verdict": "failed", "findings": [finding]} for source in part.sources()
    ]


_SEVERITIES = ("error", "warning")


def _text(rows: list[dict[str, Any]], failed: int) -> str:
    from h3data_pipelines.validation.recordings import Finding

    width = max(len(row["recording"]) for row in rows)
    lines = [f"{'recording':<{width}}  {'steps':>6}  verdict   errors  warnings"]
    for row in rows:
        errors, warnings = (sum(f["severity"] == s for f in row["findings"]) for s in _SEVERITIES)
        lines.append(f"{row['recording']:<{width}}  {row['steps']:>6}  {row['verdict']:<8}  {errors:>6}  {warnings:>8}")
        kinds: dict[tuple[str, str], list[Finding]] = {}
        for values in row["findings"]:
            kinds.setdefault((values["severity"], values["check"]), []).append(Finding(**values))
        for (severity, check), findings in kinds.items():
            lines += [f"  {finding}" for finding in findings[:_SHOWN]]
            if len(findings) > _SHOWN:
                lines.append(f"  {severity:<7} {check:<11} ... and {len(findings) - _SHOWN} more; --json lists all")
    if len(rows) > 1:
        lines.append(f"{len(rows)} recordings, {failed} failed")
    return "\n".join(lines)


def read_ahead(stored: Sequence[StoredEpisode], *, most_steps: int) -> Iterator[Callable[[], Recording]]:
    """Yield for each episode a function that returns its recording or raises an `H3DataError`.

    Consecutive episodes of a dataset are read together, up to ``most_steps`` steps at once.
    """
    for group in _consecutive(stored, most_steps):
        first = group[0]
        recordings: list[Recording] = []
        if first.read_together is not None and first.index is not None and len(group) > 1:
            try:
                recordings = list(first.read_together(range(first.index, first.index + len(group))))
            except H3DataError:  # one of them is damaged: each for itself
                recordings = []
        for k, of in enumerate(group):
            yield (lambda k=k, recordings=recordings: recordings[k]) if recordings else of.read


def _consecutive(stored: Sequence[StoredEpisode], most_steps: int) -> Iterator[list[StoredEpisode]]:
    group: list[StoredEpisode] = []
    steps = 0
    for of in stored:
        try:
            length = int(of.facts["length"]) if of.read_together is not None else most_steps
        except H3DataError:
            length = most_steps
        last = group[-1] if group else None
        follows = (
            last is not None
            and of.read_together is not None
            and (of.path, of.index) == (last.path, (last.index or 0) + 1)
        )
        if group and (not follows or steps + length > most_steps):
            yield group
            group, steps = [], 0
        group.append(of)
        steps += length
    if group:
        yield group
