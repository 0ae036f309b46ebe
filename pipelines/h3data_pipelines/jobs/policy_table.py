"""Tables of policies by metrics with 95% intervals, followed by published results if the metrics' profile has any."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from h3data.metrics import Metric, Profile, Summary
from h3data.metrics.episode import deviation_lines
from h3data.metrics.table import legend
from h3data.terminal import aligned
from h3data_pipelines.jobs.table_cells import NOTHING, SEEDS_HEAD, SeedsSummary, cell_dict, cell_of, rows_of

MOST_COLUMNS = 30
"""Largest number of metrics for which a table shows all metrics of a profile; otherwise it shows those of the
profile's report.
"""


@dataclass(frozen=True, kw_only=True)
class PolicyTable:
    """Table of policies by metrics."""

    profile: Profile
    cells: dict[tuple[str, str], Summary]
    """Summaries by policy and metric."""
    seeds: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Policies that share one row, by the pattern that names them."""
    deviations: tuple[str, ...] = ()
    """Rules of each result that differ from the paper's."""

    def to_text(self) -> str:
        """Return measured rows with intervals and published rows, or a sentence if there are no results."""
        if not self.cells:
            return NOTHING
        shown = self._columns()
        names, left_out = [metric.name for metric in shown], len(self.profile.metrics) - len(shown)
        policies = tuple(dict.fromkeys(policy for policy, _ in self.cells))
        head = "Mean [95% interval]" + (SEEDS_HEAD if self.seeds else "")
        lines = [[head, *names]]
        for row, members in rows_of(policies, self.seeds).items():
            lines.append([row, *(self._cell(members, name) for name in names)])
        published = self.profile.report.published() if self.profile.report.published else None
        if published:
            lines.append([f"{published.paper}, as published", *names])
            lines += [[row.name, *(_published(row.values.get(name, ())) for name in names)] for row in published.rows]
        source = [f"{published.source}."] if published else []
        more = [f"{left_out} more metrics: h3data metrics, or --json."] if left_out else []
        return "\n".join([aligned(lines), legend(shown), *more, *source, *deviation_lines(self.deviations)])

    def _columns(self) -> list[Metric]:
        """Return the metrics that fit a terminal: of profiles with many, those of the report's main table."""
        metrics, main = list(self.profile.metrics), self.profile.report.columns
        return [m for m in metrics if m.name in main] if len(metrics) > MOST_COLUMNS and main else metrics

    def to_dict(self) -> dict[str, Any]:
        """Return the table as JSON types; NaN becomes None, and ``seeds`` has the rows of several policies."""
        cells = [
            {"policy": policy, "metric": metric, **cell_dict(cell)} for (policy, metric), cell in self.cells.items()
        ]
        pooled = [
            {"policies": pattern, "metric": metric.name, **self._of_seeds(members, metric.name).to_dict()}
            for pattern, members in self.seeds.items()
            for metric in self.profile.metrics
            if self.cells
        ]
        return {"cells": cells, **({"seeds": pooled} if pooled else {})}

    def _cell(self, members: Sequence[str], metric: str) -> str:
        if len(members) == 1:
            return _shown(self.cells[members[0], metric])
        return self._of_seeds(members, metric).to_text()

    def _of_seeds(self, members: Sequence[str], metric: str) -> SeedsSummary:
        return SeedsSummary(each={name: self.cells[name, metric] for name in members if (name, metric) in self.cells})


def policy_table(
    profile: Profile, rows: Iterable[dict[str, Any]], seeds: Mapping[str, Sequence[str]] | None = None
) -> PolicyTable:
    """Return a table of the results of `h3data_pipelines.jobs.evaluations.play_evaluation`.

    ``seeds`` names the policies, such as training runs with different seeds, that are combined into one row.
    """
    rows = list(rows)
    return PolicyTable(
        profile=profile,
        seeds=seeds or {},
        cells={
            (policy, metric.name): cell_of(
                metric, [r["values"].get(metric.name) for r in rows if r["policy"] == policy]
            )
            for policy in dict.fromkeys(r["policy"] for r in rows)
            for metric in profile.metrics
        },
        deviations=tuple(r.get("set_up", "") for r in rows),
    )


def _shown(cell: Summary) -> str:
    if not cell.count:
        return "-"
    interval = f" [{cell.low:.2f}, {cell.high:.2f}]" if cell.low == cell.low else ""
    return f"{cell.mean:.2f}{interval}"


def _published(value: tuple[float, ...]) -> str:
    return " ± ".join(f"{v:.2f}" for v in value) or "-"
