"""Cross-play tables of robots by partners, with means and intervals, and the paper's zero-shot and training results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from h3data.metrics import Metric, Summary
from h3data.metrics.episode import deviation_lines
from h3data.metrics.paper.profiles import REARRANGEMENT_PROFILE
from h3data.metrics.paper.published import published_results
from h3data.terminal import aligned, counted
from h3data_pipelines.jobs.table_cells import NOTHING, SEEDS_HEAD, SeedsSummary, cell_dict, cell_of, or_none, rows_of

METRICS = tuple(m for m in REARRANGEMENT_PROFILE.metrics if m.name in REARRANGEMENT_PROFILE.report.columns)
"""Metrics of the paper's table."""
ZSC_COLUMN, ZSC_TEN_COLUMN, ZSC_NAMED = "ZSC planners", "ZSC ten", "ZSC mean"
"""Headings of the zero-shot columns: the paper's four planners, these and six learned partners, or a population that
the user names.
"""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Result of one robot with one partner in one episode."""

    index: int
    policy: str
    partner: str
    plan: str
    """Name of the partner's plan in this episode."""
    ended: str
    solo_steps: int
    values: dict[str, float | None]
    """Values of the paper's metrics; None if undefined."""
    state_hash: str
    set_up: str = ""
    """Rules of the episode that differ from the paper's."""


@dataclass(frozen=True, kw_only=True)
class CrossPlayTable:
    """Table of robots by partners, for each metric."""

    policies: tuple[str, ...]
    partners: tuple[str, ...]
    """Names of the partners; the last one is the whole zero-shot population, if there is one."""
    cells: dict[tuple[str, str, str], Summary]
    """Summaries by metric, policy and partner."""
    episodes: int
    solo_steps: float
    """Mean steps of the person alone."""
    seeds: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Policies of robots that share one row, by the pattern that names them."""
    deviations: tuple[str, ...] = ()
    """Rules of each result that differ from the paper's."""

    def to_text(self) -> str:
        """Return a table for each metric, followed by the paper's rows, or a sentence if there are no results."""
        if not self.cells:
            return NOTHING
        blocks = [
            f"{counted(self.episodes, 'episode')}; the person alone takes {self.solo_steps:.0f} steps on average.\n"
            "Rows: policies of the robot. Columns: partners, the policies of the person; ZSC (zero-shot coordination): the "
            f"mean over a population that no robot was trained with. Mean [95% interval]{SEEDS_HEAD if self.seeds else ''}."
        ]
        for metric in METRICS:
            lines = [[f"{metric.name}, {metric.title.lower()}{' [%]' if _in_percent(metric) else ''}", *self.partners]]
            for row, members in rows_of(self.policies, self.seeds).items():
                lines.append([row, *(self._cell(metric, members, partner) for partner in self.partners)])
            blocks.append(aligned(lines))
        return "\n\n".join([*blocks, "\n".join([_paper_text(), *deviation_lines(self.deviations)])])

    def _cell(self, metric: Metric, members: Sequence[str], partner: str) -> str:
        if len(members) == 1:
            return _shown(metric, self.cells.get((metric.name, members[0], partner)))
        return self._of_seeds(metric, members, partner).to_text(factor=_factor(metric), digits=_digits(metric))

    def _of_seeds(self, metric: Metric, members: Sequence[str], partner: str) -> SeedsSummary:
        found = {name: self.cells.get((metric.name, name, partner)) for name in members}
        return SeedsSummary(each={name: cell for name, cell in found.items() if cell is not None})

    def to_dict(self) -> dict[str, Any]:
        """Return the table as JSON types; NaN becomes None, and ``seeds`` has the rows of several policies."""
        pooled = [
            {
                "metric": metric.name,
                "policies": pattern,
                "partner": partner,
                **self._of_seeds(metric, members, partner).to_dict(),
            }
            for metric in METRICS
            for pattern, members in self.seeds.items()
            for partner in self.partners
            if self.cells
        ]
        return {
            **({"seeds": pooled} if pooled else {}),
            "policies": list(self.policies),
            "partners": list(self.partners),
            "solo_steps": or_none(self.solo_steps),
            "cells": [
                {"metric": metric, "policy": policy, "partner": partner, **cell_dict(cell)}
                for (metric, policy, partner), cell in self.cells.items()
            ],
        }


def cross_play_table(
    rows: Iterable[Row], zsc: Sequence[str] = (), seeds: Mapping[str, Sequence[str]] | None = None
) -> CrossPlayTable:
    """Return the table of many results.

    Args:
        rows: Results, one for each robot, partner and episode.
        zsc: Partners of the zero-shot population (default: the paper's four planners, and these with six learned
            partners, if all of them are present).
        seeds: Policies of robots that share one row, by the pattern that names them.
    """
    from sim_kinematic.policies.rearrange import zsc_populations

    rows = list(rows)
    policies = tuple(dict.fromkeys(row.policy for row in rows))
    partners = tuple(dict.fromkeys(row.partner for row in rows))
    groups: dict[str, tuple[str, ...]] = {partner: (partner,) for partner in partners}
    if zsc:
        groups[ZSC_NAMED] = tuple(zsc)
    else:
        groups |= dict(zip((ZSC_COLUMN, ZSC_TEN_COLUMN), zsc_populations(partners), strict=False))
    cells = {
        (metric.name, policy, name): cell_of(
            metric, [r.values.get(metric.name) for r in rows if r.policy == policy and r.partner in of]
        )
        for metric in METRICS
        for policy in policies
        for name, of in groups.items()
    }
    solo = {row.index: row.solo_steps for row in rows}
    return CrossPlayTable(
        policies=policies,
        seeds=seeds or {},
        partners=tuple(groups),
        cells=cells,
        episodes=len(solo),
        solo_steps=float(np.mean(list(solo.values()))) if solo else float("nan"),
        deviations=tuple(row.set_up for row in rows),
    )


def _in_percent(metric: Metric) -> bool:
    return metric.unit == "%" or metric.name in REARRANGEMENT_PROFILE.report.percent


def _factor(metric: Metric) -> float:
    return 100.0 if metric.name in REARRANGEMENT_PROFILE.report.percent else 1.0


def _digits(metric: Metric) -> int:
    return 0 if _in_percent(metric) else 2


def _shown(metric: Metric, cell: Summary | None) -> str:
    if cell is None or not cell.count:
        return "-"
    factor, digits = _factor(metric), _digits(metric)
    interval = f" [{factor * cell.low:.{digits}f}, {factor * cell.high:.{digits}f}]" if not np.isnan(cell.low) else ""
    return f"{factor * cell.mean:.{digits}f}{interval}"


def _paper_text() -> str:
    """Return published rows: learned robots with their training partner or population, and with the zero-shot one."""
    paper = published_results().rearrange
    lines = [["Habitat 3.0, as published", *(f"{p} {m.name}" for p in ("train", "ZSC") for m in METRICS)]]
    for row in paper.rows:
        of = [values.get(metric.name, ()) for values in (row.train, row.zsc) for metric in METRICS]
        lines.append([row.name, *(f"{v[0]:g} ± {v[1]:g}" if v else "-" for v in of)])
    return f"{aligned(lines)}\n{paper.source}."
