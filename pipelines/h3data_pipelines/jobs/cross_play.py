"""Tables of robots by partners (cross-play): means with intervals, the paper's zero-shot and training numbers beside."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from h3data.metrics.table import aligned, set_up_lines
from h3data.stats import bootstrap_interval, wilson_interval
from h3data_viewers.html_report.report_paper import paper_results

METRICS = {
    "SR": "success rate [%]",
    "RE": "relative efficiency [%]",
    "CR": "collision rate",
    "RC": "ratio of completion by the robot",
}
BINARY, PERCENT = ("SR", "S", "CR"), ("SR",)
ZSC_COLUMN = "ZSC planners"
NOTHING = "No episode could be played: there is no table."


@dataclass(frozen=True, kw_only=True)
class Row:
    """One robot with one partner in one episode."""

    index: int
    policy: str
    partner: str
    plan: str
    """What the partner does in this episode."""
    ended: str
    solo_steps: int
    values: dict[str, float | None]
    """The paper's metrics; None = undefined."""
    state_hash: str
    set_up: str = ""
    """In what its rules differ from the paper's."""


@dataclass(frozen=True, kw_only=True)
class CellValue:
    """Mean over episodes with a 95 % interval: Wilson for SR and CR, else bootstrap."""

    mean: float
    low: float
    high: float
    count: int


@dataclass(frozen=True, kw_only=True)
class CrossPlayTable:
    """Robots by partners, for each metric."""

    policies: tuple[str, ...]
    partners: tuple[str, ...]
    """Names, and last, if all four are there, the paper's zero-shot planners together."""
    cells: dict[tuple[str, str, str], CellValue]
    """By metric, policy, partner."""
    episodes: int
    solo_steps: float
    """Mean steps of the person alone."""
    set_ups: tuple[str, ...] = ()
    """Of each result: in what its rules differ from the paper's."""

    def to_text(self) -> str:
        """A table for each metric, the paper's rows below; without ours there is nothing to compare."""
        if not self.cells:
            return NOTHING
        blocks = [
            f"{self.episodes} episodes; the person alone takes {self.solo_steps:.0f} steps on average.\n"
            "Rows: robots. Columns: partners. Mean [95 % interval]."
        ]
        for metric, title in METRICS.items():
            lines = [[f"{metric}, {title}", *self.partners]]
            for policy in self.policies:
                cells = [self.cells.get((metric, policy, partner)) for partner in self.partners]
                lines.append([policy, *(_shown(metric, cell) for cell in cells)])
            blocks.append(aligned(lines))
        return "\n\n".join([*blocks, "\n".join([_paper_text(), *set_up_lines(self.set_ups)])])

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON types; NaN becomes None."""
        return {
            "policies": list(self.policies),
            "partners": list(self.partners),
            "solo_steps": or_none(self.solo_steps),
            "cells": [
                {
                    "metric": metric, "policy": policy, "partner": partner, "mean": or_none(c.mean),
                    "low": or_none(c.low), "high": or_none(c.high), "episodes": c.count,
                }
                for (metric, policy, partner), c in self.cells.items()
            ],
        }  # fmt: skip


def cross_play_table(rows: Iterable[Row]) -> CrossPlayTable:
    """The table of many results."""
    from sim_kinematic.policies.rearrange import ZSC

    rows = list(rows)
    policies = tuple(dict.fromkeys(row.policy for row in rows))
    partners = tuple(dict.fromkeys(row.partner for row in rows))
    groups: dict[str, tuple[str, ...]] = {partner: (partner,) for partner in partners}
    if set(ZSC) <= set(partners):
        groups[ZSC_COLUMN] = ZSC
    cells = {
        (metric, policy, name): cell_value(
            metric, [r.values.get(metric) for r in rows if r.policy == policy and r.partner in of]
        )
        for metric in METRICS
        for policy in policies
        for name, of in groups.items()
    }
    solo = {row.index: row.solo_steps for row in rows}
    return CrossPlayTable(
        policies=policies, partners=tuple(groups), cells=cells, episodes=len(solo),
        solo_steps=float(np.mean(list(solo.values()))) if solo else float("nan"), set_ups=tuple(row.set_up for row in rows),
    )  # fmt: skip


def cell_value(metric: str, found: Sequence[float | None]) -> CellValue:
    """The mean of what is defined, with its interval."""
    values = np.array([v for v in found if v is not None], np.float64)
    if metric in BINARY:
        low, high = wilson_interval(int(values.sum()), len(values))
    else:
        low, high = bootstrap_interval(values)
    mean = float(values.mean()) if len(values) else float("nan")
    return CellValue(mean=mean, low=low, high=high, count=len(values))


def _shown(metric: str, cell: CellValue | None) -> str:
    if cell is None or not cell.count:
        return "-"
    factor, digits = (100.0 if metric in PERCENT else 1.0), (0 if metric in ("SR", "RE") else 2)
    interval = f" [{factor * cell.low:.{digits}f}, {factor * cell.high:.{digits}f}]" if not np.isnan(cell.low) else ""
    return f"{factor * cell.mean:.{digits}f}{interval}"


def _paper_text() -> str:
    """The published rows: learned robots with their training partner or population, and with the zero-shot one."""
    paper = paper_results().rearrange
    lines = [["Habitat 3.0, as published", *(f"{p} {m}" for p in ("train", "ZSC") for m in METRICS)]]
    for row in paper.rows:
        of = [values.get(metric, ()) for values in (row.train, row.zsc) for metric in METRICS]
        lines.append([row.name, *(f"{v[0]:g} ± {v[1]:g}" if v else "-" for v in of)])
    return f"{aligned(lines)}\n{paper.source}."


def or_none(value: float) -> float | None:
    """The value as JSON has it."""
    return None if np.isnan(value) else value
