"""Cells of tables of policies, with the mean and interval of one policy, or the mean of the means of several.

Policies that differ only in their training seed and are named by a pattern of files (``weights:out/s*/policy.npz``)
share one row, which has the standard deviation over the seeds, as in published tables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from h3data.metrics import Metric, Summary
from h3data.metrics.table import summarize_all

NOTHING = "No episode could be played: there is no table."
SEEDS_HEAD = "; of seeds mean ± standard deviation"
"""Addition to the heading of a table that has rows of several policies."""


def cell_of(metric: Metric, values: Sequence[float | None]) -> Summary:
    """Return the mean of the defined values with its 95% interval; None stands for undefined."""
    defined = np.array([np.nan if v is None else v for v in values], np.float64)
    return summarize_all([metric], {metric.name: defined})[metric.name]


def cell_dict(cell: Summary) -> dict[str, float | None]:
    """Return mean, interval and number of episodes as JSON types."""
    ends = {name: or_none(value) for name, value in (("mean", cell.mean), ("low", cell.low), ("high", cell.high))}
    return {**ends, "episodes": cell.count}


def or_none(value: float) -> float | None:
    """Return the value, or None instead of NaN, for JSON."""
    return None if np.isnan(value) else value


@dataclass(frozen=True, kw_only=True)
class SeedsSummary:
    """Summary of one metric over several policies."""

    each: Mapping[str, Summary]
    """Summaries of the metric over the episodes of each policy, by policy."""

    @property
    def means(self) -> np.ndarray:
        """Means of the policies that have one, shape [S]."""
        return np.array([cell.mean for cell in self.each.values() if cell.count], np.float64)

    @property
    def mean(self) -> float:
        """Mean of the policies' means; NaN if no policy has one."""
        return float(self.means.mean()) if len(self.means) else float("nan")

    @property
    def deviation(self) -> float:
        """Standard deviation of the policies' means (n - 1 in the denominator); NaN for fewer than two means."""
        return float(self.means.std(ddof=1)) if len(self.means) > 1 else float("nan")

    def to_text(self, *, factor: float = 1.0, digits: int = 2) -> str:
        """Return text such as ``0.95 ± 0.01``; ``-`` if no policy has a mean."""
        if not len(self.means):
            return "-"
        spread = f" ± {factor * self.deviation:.{digits}f}" if self.deviation == self.deviation else ""
        return f"{factor * self.mean:.{digits}f}{spread}"

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as JSON types; NaN becomes None."""
        return {
            "mean": or_none(self.mean),
            "deviation": or_none(self.deviation),
            "seeds": [{"policy": policy, **cell_dict(cell)} for policy, cell in self.each.items()],
        }


def row_name(pattern: str, policies: Sequence[str]) -> str:
    """Return the name of the row that combines several policies."""
    return f"{pattern} ({len(policies)} seeds)"


def rows_of(policies: Sequence[str], seeds: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Return the policies of each row of a table, by row name.

    A row of several policies has the position of its first policy.
    """
    rows: dict[str, tuple[str, ...]] = {}
    of = {policy: pattern for pattern, members in seeds.items() for policy in members}
    for policy in policies:
        pattern = of.get(policy)
        if pattern is None:
            rows[policy] = (policy,)
        else:
            members = tuple(member for member in seeds[pattern] if member in policies)
            rows[row_name(pattern, members)] = members
    return rows
