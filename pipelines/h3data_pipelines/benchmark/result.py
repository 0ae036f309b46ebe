"""Results of a benchmark in a folder, with the output of ``h3data evaluate``, all recordings, and ``benchmark.json``.

``benchmark.json`` names the benchmark, the machine and the versions, and has the table and the digest of every file, so that
`h3data_pipelines.benchmark.verification` can check whether the table follows from the recordings.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from h3data.commands.command import write_text
from h3data.errors import FormatError, InputError
from h3data.metrics import Metric
from h3data.plugins import own_version
from h3data.terminal import aligned
from h3data_pipelines.benchmark.definition import Benchmark
from h3data_pipelines.hub.checksums import checksums_of
from h3data_pipelines.jobs.evaluation_runs import RECORDINGS, evaluate_task
from h3data_pipelines.jobs.evaluations import check_identity
from h3data_pipelines.jobs.result_files import RESULTS
from h3data_pipelines.jobs.table_cells import cell_dict, cell_of

FORMAT = 1
MANIFEST = "benchmark.json"


class ResultRow(msgspec.Struct, frozen=True, kw_only=True):
    """Row of one policy in the table of a result."""

    policy: str
    played: int
    """Number of episodes that were completed with each partner."""
    expected: int
    metrics: dict[str, dict[str, float | None]]
    """Values by metric: ``mean``, ``low`` and ``high`` of the 95% interval, and the number of ``episodes`` in which the
    metric is defined.
    """


class BenchmarkResult(msgspec.Struct, frozen=True, kw_only=True):
    """Contents of ``benchmark.json``."""

    format: int
    benchmark: str
    definition_sha256: str
    date: str
    """Day on which the result was finished, UTC."""
    created_by: list[str]
    """Versions of the package that played the episodes."""
    machine: dict[str, str]
    rows: list[ResultRow]
    files: dict[str, str] = {}
    """SHA-256 of every file of the result, by its path in the folder."""

    @property
    def is_complete(self) -> bool:
        """Return whether every episode was played with every policy."""
        return all(row.played == row.expected for row in self.rows)


@dataclass(frozen=True, kw_only=True)
class BenchmarkRun:
    """Result of `run_benchmark`."""

    folder: Path
    benchmark: Benchmark
    result: BenchmarkResult
    failed: tuple[str, ...]

    def to_text(self) -> str:
        """Return the table, the failures, and how to check the result."""
        table = result_table(self.benchmark.metrics(), self.result.rows)
        failed = "".join(f"\nfailed {line}" for line in self.failed)
        return f"{self.benchmark.label}\n{table}{failed}\nCheck it: h3data benchmark verify {self.folder}"


def run_benchmark(
    benchmark: Benchmark,
    policies: Sequence[str],
    out: Path,
    *,
    resume: bool = False,
    force: bool = False,
    workers: int = 1,
    executor: str = "local",
    progress: Callable[..., Any] | None = None,
) -> BenchmarkRun:
    """Play policies in all episodes of a benchmark, and write the recordings, the table and ``benchmark.json`` to ``out``.

    Episodes that already have results in ``out`` are not played again.

    Args:
        benchmark: The benchmark.
        policies: Policies of the robot, as for ``h3data evaluate``.
        out: A new folder, or the folder of an interrupted run with the same policies.
        resume, force, workers, executor, progress: Options of `h3data_pipelines.jobs.evaluation_runs.evaluate_task`.

    Raises:
        InputError: there is no such policy, the folder holds other files, or this version generates different episodes.
    """
    columns = benchmark.metrics()
    if (out / MANIFEST).is_file() and not force and (found := read_result(out)).benchmark != benchmark.label:
        raise InputError(
            f"The folder holds a result of {found.benchmark}. Choose another -o, or --force: {out}",
            code="H3-OPTION-089",
        )
    uids, first = tuple(benchmark.episode_uids()), benchmark.jobs()[0].base
    check_identity(first.found_task, first.episode(), uids[0])  # the others as each begins: to make all takes minutes
    played = evaluate_task(
        replace(benchmark.request(tuple(policies)), uids=uids),
        out,
        save_recordings=True,
        resume=resume,
        force=force,
        workers=workers,
        executor=executor,
        progress=progress,
    )
    expected = played.episodes * max(len(played.job.get("partners", ())), 1)
    rows = summarized(columns, played.rows, expected)
    result = BenchmarkResult(
        format=FORMAT,
        benchmark=benchmark.label,
        definition_sha256=benchmark.sha256,
        date=datetime.now(UTC).date().isoformat(),
        created_by=list(played.created_by),
        machine=this_machine(),
        rows=rows,
        files=checksums_of(out, result_files(out)),
    )
    write_text(out / MANIFEST, json.dumps(msgspec.to_builtins(result), indent=1) + "\n")
    return BenchmarkRun(folder=out, benchmark=benchmark, result=result, failed=played.failed)


def summarized(metrics: Iterable[Metric], rows: Sequence[Mapping[str, Any]], expected: int) -> list[ResultRow]:
    """Return the table of a result, with means of each policy over all episodes and partners.

    Args:
        metrics: Metrics in the columns of the table.
        rows: Results of each policy, partner and episode, as ``h3data evaluate`` stores them.
        expected: Number of rows of each policy if nothing failed.
    """
    columns = list(metrics)
    found = []
    for policy in dict.fromkeys(row["policy"] for row in rows):
        of = [row["values"] for row in rows if row["policy"] == policy]
        cells = {
            metric.name: cell_dict(cell_of(metric, [values.get(metric.name) for values in of])) for metric in columns
        }
        found.append(ResultRow(policy=policy, played=len(of), expected=expected, metrics=cells))
    return found


def result_table(metrics: Iterable[Metric], rows: Iterable[ResultRow]) -> str:
    """Return the table as text, with one line for each policy."""
    columns = list(metrics)
    lines = [["Mean [95% interval]", *(metric.name for metric in columns)]]
    lines += [[row_label(row), *(cell_text(row, metric.name) for metric in columns)] for row in rows]
    return aligned(lines)


def row_label(row: ResultRow) -> str:
    """Return the name of the policy, with the number of completed episodes if some are missing."""
    return row.policy if row.played == row.expected else f"{row.policy} ({row.played} of {row.expected} episodes)"


def cell_text(row: ResultRow, metric: str) -> str:
    """Return text such as ``0.97 [0.92, 0.99]``, or ``-`` if the metric is undefined in all episodes."""
    cell = row.metrics.get(metric, {})
    mean, low, high = (cell.get(name) for name in ("mean", "low", "high"))
    if mean is None:
        return "-"
    return f"{mean:.2f}" + (f" [{low:.2f}, {high:.2f}]" if low is not None and high is not None else "")


def read_result(folder: Path) -> BenchmarkResult:
    """Return the result in a folder.

    Raises:
        InputError: the folder contains no result.
        FormatError: the file is damaged, or of a newer version.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise InputError(
            f"Expected the folder of a result, with {MANIFEST} (h3data benchmark run writes it when all episodes are played), "
            f"got: {folder}",
            code="H3-OPTION-091",
        )
    try:
        result = msgspec.json.decode(path.read_bytes(), type=BenchmarkResult)
    except (msgspec.DecodeError, OSError, RecursionError) as fault:
        raise FormatError(
            f"Expected the result of a benchmark, got: {fault} File: {path}", code="H3-OPTION-093"
        ) from None
    if result.format != FORMAT:
        raise FormatError(
            f"Expected format {FORMAT} of results, got {result.format}. File: {path}", code="H3-OPTION-092"
        )
    return result


def result_files(folder: Path) -> list[str]:
    """Return paths in a folder of everything that a result consists of: results of episodes, and recordings."""
    return sorted(
        path.relative_to(folder).as_posix()
        for part in (RESULTS, RECORDINGS)
        for path in (folder / part).rglob("*")
        if path.is_file()
    )


def this_machine() -> dict[str, str]:
    """Return the processor, operating system and package versions that a result records."""
    from h3data_pipelines.machine.bench import hardware_name

    return {
        "processor": hardware_name(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "h3data": own_version(),
    }
