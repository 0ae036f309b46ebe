"""Tables of policies by metrics, with 95% intervals, and the paper's rows below where it has any."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from h3data.metrics.table import aligned, set_up_lines
from h3data_pipelines.jobs.cross_play import NOTHING, CellValue, cell_value, or_none
from h3data_viewers.html_report.report_paper import paper_results


@dataclass(frozen=True, kw_only=True)
class PolicyTable:
    """Policies by metrics."""

    task: str
    metrics: tuple[str, ...]
    cells: dict[tuple[str, str], CellValue]
    """By policy and metric."""
    set_ups: tuple[str, ...] = ()
    """Of each result: in what its rules differ from the paper's."""

    def to_text(self) -> str:
        """Our rows with intervals, the paper's below; without ours there is nothing to compare."""
        if not self.cells:
            return NOTHING
        policies = tuple(dict.fromkeys(policy for policy, _ in self.cells))
        lines = [["Mean [95 % interval]", *self.metrics]]
        lines += [[policy, *(self._shown(policy, metric) for metric in self.metrics)] for policy in policies]
        if self.task != "social_nav":
            return "\n".join([aligned(lines), *set_up_lines(self.set_ups)])
        paper = paper_results().social_nav
        lines.append(["Habitat 3.0, as published", *self.metrics])
        lines += [[row.name, *(_published(row.values.get(m, ())) for m in self.metrics)] for row in paper.rows]
        return "\n".join([aligned(lines), f"{paper.source}.", *set_up_lines(self.set_ups)])

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON types; NaN becomes None."""
        return {
            "cells": [
                {
                    "policy": policy, "metric": metric, "mean": or_none(c.mean), "low": or_none(c.low),
                    "high": or_none(c.high), "episodes": c.count,
                }
                for (policy, metric), c in self.cells.items()
            ]
        }  # fmt: skip

    def _shown(self, policy: str, metric: str) -> str:
        cell = self.cells[policy, metric]
        if not cell.count:
            return "-"
        interval = f" [{cell.low:.2f}, {cell.high:.2f}]" if cell.low == cell.low else ""
        return f"{cell.mean:.2f}{interval}"


def policy_table(task: str, rows: Iterable[dict[str, Any]], metrics: Sequence[str]) -> PolicyTable:
    """The table of the rows that `h3data_pipelines.jobs.evaluations.play_evaluation` makes."""
    rows = list(rows)
    return PolicyTable(
        task=task,
        metrics=tuple(metrics),
        cells={
            (policy, metric): cell_value(metric, [r["values"].get(metric) for r in rows if r["policy"] == policy])
            for policy in dict.fromkeys(r["policy"] for r in rows)
            for metric in metrics
        },
        set_ups=tuple(r.get("set_up", "") for r in rows),
    )


def _published(value: tuple[float, ...]) -> str:
    return " ± ".join(f"{v:.2f}" for v in value) or "-"
