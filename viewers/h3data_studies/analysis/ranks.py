"""Comparison of automatic evaluation with a study with people, by their rankings of the robots' policies."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from h3data.errors import InputError
from h3data_studies.analysis.estimates import study_layout
from h3data_studies.statistics import RankAgreement, rank_agreement
from h3data_viewers.html_report.data import Run
from h3data_viewers.html_report.episode import ReportEpisode
from h3data_viewers.html_report.tables import NAN, Cell, Column, Row, Section, Table, mean_cell, number


def rank_table(runs: Sequence[Run]) -> Table | None:
    """Return rank correlations over the policies that are also conditions of the study; None for fewer than two.

    Names are compared without case and punctuation: ``plan_pop_3`` equals ``Plan-Pop3``.
    """
    human: dict[str, list[ReportEpisode]] = {}
    automatic: dict[str, list[ReportEpisode]] = {}
    shown: dict[str, str] = {}
    for run in runs:
        for episode in run.episodes:
            policy = run.policy if run.seeds else episode.policy
            name = episode.condition if episode.studied else policy or run.name
            (human if episode.studied else automatic).setdefault(_key(name), []).append(episode)
            shown.setdefault(_key(name), name)
    shared = [key for key in automatic if key in human]
    if len(shared) < 2:
        return None
    layout = study_layout(runs[0].profile)
    rows = []
    for name in layout.columns:
        measured, sign = (layout.steps, -1.0) if name == layout.efficiency else (name, 1.0)
        try:
            agreement = rank_agreement(
                {shown[k]: [e.metrics.values[name] for e in automatic[k]] for k in shared},
                {shown[k]: [sign * e.metrics.values[measured] for e in human[k]] for k in shared},
            )
        except InputError:  # a policy without a defined value
            continue
        base = _alone(human, measured) if measured != name else NAN
        rows.append(_row(name, agreement, measured if measured != name else "", base))
    if not rows:
        return None
    return Table(
        key=f"ranks_{runs[0].task}",
        title="Automatic and human evaluation",
        caption=f"Agreement of the order of {', '.join(shown[k] for k in shared)} by their means in automatic episodes and in "
        "those of participants: 1 same order, −1 reversed; 95% bootstrap interval over episodes.",
        name_head="Metric",
        columns=tuple(
            Column(head=head) for head in ("Kendall's τ", "Spearman's ρ", "Order, automatic", "Order, with people")
        ),
        sections=(Section(title="", rows=tuple(rows)),),
        notes=("With few policies the coefficients take few values: of two, only 1 and −1.",),
    )


def _alone(human: Mapping[str, Sequence[ReportEpisode]], steps: str) -> float:
    """Return the mean steps of people without a robot; NaN if no person was alone."""
    alone = [e.metrics.values[steps] for key, episodes in human.items() if key.startswith("solo") for e in episodes]
    known = [value for value in alone if value == value]
    return float(np.mean(known)) if known else NAN


def _row(name: str, found: RankAgreement, steps: str, alone: float) -> Row:
    """Return a row; efficiency is ranked by the mean of ``steps``, ``alone`` is their mean without a robot."""
    if not steps:
        people, small = _order(found.names, found.second_means), ""
    elif alone == alone:
        people = _order(found.names, [100 * alone / -mean for mean in found.second_means])
        small = f"people's: 100 · mean {steps} alone / mean {steps} with the robot"
    else:
        people, small = _order(found.names, found.second_means, sign=-1.0), f"by people's {steps}, reversed"
    return Row(
        name=name,
        small=small,
        cells=(
            mean_cell(found.kendall, found.kendall_low, found.kendall_high, digits=2),
            mean_cell(found.spearman, found.spearman_low, found.spearman_high, digits=2),
            Cell(text=_order(found.names, found.first_means)),
            Cell(text=people),
        ),
    )


def _order(names: Sequence[str], means: Sequence[float], *, sign: float = 1.0) -> str:
    """Return a ranking such as ``a 0.44, b 0.36``, largest first; with a ``sign`` of -1 the means are negated."""
    return ", ".join(f"{names[k]} {number(sign * means[k])}" for k in np.argsort(-np.asarray(means), kind="stable"))


def _key(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
