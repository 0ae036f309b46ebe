"""Leaderboards, which show the results of a benchmark in one table, as Markdown or as an HTML page."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from h3data.errors import FormatError, InputError
from h3data.metrics import Metric
from h3data.metrics.table import legend
from h3data_pipelines.benchmark.definition import BASELINES, Benchmark
from h3data_pipelines.benchmark.result import MANIFEST, BenchmarkResult, ResultRow, cell_text, read_result, row_label
from h3data_pipelines.benchmark.verification import ResultVerification
from h3data_pipelines.hub.checksums import file_sha256

VERDICT = "verification.json"
"""Name of the file that ``h3data benchmark verify`` writes next to ``benchmark.json``."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Row of a leaderboard."""

    row: ResultRow
    result: BenchmarkResult
    source: str
    """Name of the folder of the result, or ``baseline`` for results that ship with the benchmark."""
    checked: str
    """Result of `h3data benchmark verify` for the row."""


@dataclass(frozen=True, kw_only=True)
class Leaderboard:
    """Leaderboard with all results of one benchmark, best first."""

    benchmark: Benchmark
    entries: tuple[Entry, ...]

    @cached_property
    def _columns(self) -> list[Metric]:
        return self.benchmark.metrics()

    def to_markdown(self) -> str:
        """Return the leaderboard as Markdown with a heading, the table, and the meaning of its columns."""
        lines = [f"# {self.benchmark.label}", "", self.benchmark.file.about, ""]
        rows = [
            self._heads(),
            ["---"] * len(self._heads()),
            *(self._cells(place, one) for place, one in self._places()),
        ]
        lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
        return "\n".join([*lines, "", "Means with 95% intervals.", "", *self._legend(), ""])

    def to_html(self) -> str:
        """Return the leaderboard as a self-contained HTML page, with a card below the table for each result."""
        from jinja2 import Environment, PackageLoader, StrictUndefined

        pages = PackageLoader("h3data_pipelines", "benchmark")
        environment = Environment(loader=pages, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
        return environment.get_template("leaderboard.html").render(
            benchmark=self.benchmark,
            heads=self._heads(),
            rows=[self._cells(place, one) for place, one in self._places()],
            legend=self._legend(),
            results={entry.source: entry.result for entry in self.entries},
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the rows as JSON types, best first."""
        return {
            "benchmark": self.benchmark.label,
            "rows": [
                {**msgspec.to_builtins(one.row), "source": one.source, "date": one.result.date, "checked": one.checked}
                for one in self.entries
            ],
        }

    def _heads(self) -> list[str]:
        return ["", "Policy", *(metric.name for metric in self._columns), "Checked", "Version", "Date"]

    def _places(self) -> Iterable[tuple[int, Entry]]:
        return enumerate(self.entries, start=1)

    def _cells(self, place: int, one: Entry) -> list[str]:
        cells = [cell_text(one.row, metric.name) for metric in self._columns]
        return [str(place), row_label(one.row), *cells, one.checked, ", ".join(one.result.created_by), one.result.date]

    def _legend(self) -> list[str]:
        return legend(self._columns).splitlines()


def leaderboard(benchmark: Benchmark, folders: Sequence[Path]) -> Leaderboard:
    """Return the leaderboard of a benchmark: its baselines and the results in some folders.

    Complete results come first, then the best by the benchmark's ranking metric.

    Raises:
        InputError: a folder holds no result, or the result of another benchmark.
        FormatError: a file is damaged.
    """
    entries = _baselines(benchmark)
    for folder in folders:
        result = read_result(folder)
        if result.benchmark != benchmark.label:
            raise InputError(
                f"Expected results of {benchmark.label}, got one of {result.benchmark}: a leaderboard has one benchmark. "
                f"Result: {folder}",
                code="H3-OPTION-087",
            )
        checked = _checked(folder, result)
        entries += [Entry(row=row, result=result, source=folder.resolve().name, checked=checked) for row in result.rows]
    rank = next(metric for metric in benchmark.metrics() if metric.name == benchmark.file.rank)
    sign = 1.0 if rank.direction == "lower" else -1.0

    def order(one: Entry) -> tuple[bool, float]:
        mean = one.row.metrics.get(rank.name, {}).get("mean")
        return one.row.played < one.row.expected, float("inf") if mean is None else sign * mean

    return Leaderboard(benchmark=benchmark, entries=tuple(sorted(entries, key=order)))


def write_verdict(verdict: ResultVerification) -> dict[str, Any]:
    """Write ``verification.json`` with the outcome of a verification and the digest of the verified result."""
    return {**verdict.to_dict(), "result_sha256": file_sha256(verdict.folder / MANIFEST)}


def _checked(folder: Path, result: BenchmarkResult) -> str:
    """Return the leaderboard's entry on the check of a result: of how many episodes, if it is of this very result."""
    try:
        found = json.loads((folder / VERDICT).read_text(encoding="utf-8"))
        if found["result_sha256"] != file_sha256(folder / MANIFEST) or found["benchmark"] != result.benchmark:
            return "no"
        return f"{found['episodes']} of {found['of_episodes']}" if found["true"] else "not true"
    except (OSError, ValueError, KeyError, TypeError):
        return "no"


def _baselines(benchmark: Benchmark) -> list[Entry]:
    """Return rows that ship with the benchmark, which were checked when they were made."""
    path = benchmark.folder / BASELINES
    if not path.is_file():
        return []
    try:
        results = msgspec.json.decode(path.read_bytes(), type=list[BenchmarkResult])
    except (msgspec.DecodeError, OSError) as fault:
        raise FormatError(
            f"Expected the results of the baselines, got: {fault} File: {path}", code="H3-OPTION-088"
        ) from None
    return [
        Entry(row=row, result=result, source="baseline", checked="baseline")
        for result in results
        for row in result.rows
    ]
