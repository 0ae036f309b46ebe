"""Tables of robots by partners (cross-play): means with intervals, followed by the paper's zero-shot and training results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from h3data.metrics import Metric, Summary
from h3data.metrics.episode import deviation_lines
from h3data.metrics.paper.profiles import REARRANGEMENT_PROFILE
from h3data.metrics.paper.published import published_results
from h3data.metrics.table import summarize
from h3data.terminal import aligned, counted

METRICS = tuple(m for m in REARRANGEMENT_PROFILE.metrics if m.name in REARRANGEMENT_PROFILE.report.columns)
"""Metrics of the paper's table."""
ZSC_COLUMN, ZSC_TEN_COLUMN, ZSC_NAMED = "ZSC planners", "ZSC ten", "ZSC mean"
"""Heads of the columns of the paper's four planners, of these and six learned partners, and of a population that the user
names."""
NOTHING = "No episode could be played: there is no table."


@dataclass(frozen=True, kw_only=True)
class Row:
    """One robot with one partner in one episode."""

    index: int
    policy: str
    partner: str
    plan: str
    """The partner's plan in this episode."""
    ended: str
    solo_steps: int
    values: dict[str, float | None]
    """The paper's metrics; None = undefined."""
    state_hash: str
    set_up: str = ""
    """Rules that differ from the paper's."""


@dataclass(frozen=True, kw_only=True)
class CrossPlayTable:
    """Robots by partners, for each metric."""

    policies: tuple[str, ...]
    partners: tuple[str, ...]
    """Names; last the zero-shot population together, if there is one."""
    cells: dict[tuple[str, str, str], Summary]
    """By metric, policy, partner."""
    episodes: int
    solo_steps: float
    """Mean steps of the person alone."""
    deviations: tuple[str, ...] = ()
    """Rules of each result that differ from the paper's."""

    def to_text(self) -> str:
        """A table for each metric, followed by the paper's rows; a sentence if there are no results."""
        if not self.cells:
            return NOTHING
        blocks = [
            f"{counted(self.episodes, 'episode')}; the person alone takes {self.solo_steps:.0f} steps on average.\n"
            "Rows: policies of the robot. Columns: partners, the policies of the person; ZSC (zero-shot coordination): the "
            "mean over a population that no robot was trained with. Mean [95% interval]."
        ]
        for metric in METRICS:
            lines = [[f"{metric.name}, {metric.title.lower()}{' [%]' if _in_percent(metric) else ''}", *self.partners]]
            for policy in self.policies:
                cells = [self.cells.get((metric.name, policy, partner)) for partner in self.partners]
                lines.append([policy, *(_shown(metric, cell) for cell in cells)])
            blocks.append(aligned(lines))
        return "\n\n".join([*blocks, "\n".join([_paper_text(), *deviation_lines(self.deviations)])])

    def to_dict(self) -> dict[str, Any]:
        """The table as JSON types; NaN becomes None."""
        return {
            "policies": list(self.policies),
            "partners": list(self.partners),
            "solo_steps": or_none(self.solo_steps),
            "cells": [
                {"metric": metric, "policy": policy, "partner": partner, **cell_dict(cell)}
                for (metric, policy, partner), cell in self.cells.items()
            ],
        }


def cross_play_table(rows: Iterable[Row], zsc: Sequence[str] = ()) -> CrossPlayTable:
    """Returns the table of many results.

    Args:
        rows: One for each robot, partner and episode.
        zsc: Partners of the zero-shot population (default: the paper's four planners, and these with six learned partners, if
            all are there).
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
        partners=tuple(groups),
        cells=cells,
        episodes=len(solo),
        solo_steps=float(np.mean(list(solo.values()))) if solo else float("nan"),
        deviations=tuple(row.set_up for row in rows),
    )


def cell_of(metric: Metric, values: Sequence[float | None]) -> Summary:
    """Returns the mean of the defined values with its 95% interval; None stands for undefined."""
    return summarize(metric, np.array([np.nan if v is None else v for v in values], np.float64))


def cell_dict(cell: Summary) -> dict[str, float | None]:
    """Returns mean, interval and number of episodes as JSON types."""
    ends = {name: or_none(value) for name, value in (("mean", cell.mean), ("low", cell.low), ("high", cell.high))}
    return {**ends, "episodes": cell.count}


def _in_percent(metric: Metric) -> bool:
    return metric.unit == "%" or metric.name in REARRANGEMENT_PROFILE.report.percent


def _shown(metric: Metric, cell: Summary | None) -> str:
    if cell is None or not cell.count:
        return "-"
    factor = 100.0 if metric.name in REARRANGEMENT_PROFILE.report.percent else 1.0
    digits = 0 if _in_percent(metric) else 2
    interval = f" [{factor * cell.low:.{digits}f}, {factor * cell.high:.{digits}f}]" if not np.isnan(cell.low) else ""
    return f"{factor * cell.mean:.{digits}f}{interval}"


def _paper_text() -> str:
    """Published rows: learned robots with their training partner or population, and with the zero-shot one."""
    paper = published_results().rearrange
    lines = [["Habitat 3.0, as published", *(f"{p} {m.name}" for p in ("train", "ZSC") for m in METRICS)]]
    for row in paper.rows:
        of = [values.get(metric.name, ()) for values in (row.train, row.zsc) for metric in METRICS]
        lines.append([row.name, *(f"{v[0]:g} ± {v[1]:g}" if v else "-" for v in of)])
    return f"{aligned(lines)}\n{paper.source}."


def or_none(value: float) -> float | None:
    """Returns the value as JSON has it: None for NaN."""
    return None if np.isnan(value) else value
