"""The study with people: estimated means of a mixed model and their pairwise contrasts, the paper's beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from h3data.errors import H3DataError
from h3data.metrics import metrics_of
from h3data.metrics.paper.published import published_results
from h3data.stats import (
    GlmmFit,
    MarginalMeans,
    bootstrap_interval,
    contrasts,
    fit_glmm,
    marginal_means,
    relative_efficiency,
)
from h3data_viewers.html_report.report_data import ReportData, ReportEpisode, Run
from h3data_viewers.html_report.report_paper import metric_column
from h3data_viewers.html_report.report_tables import (
    NAN,
    Cell,
    Column,
    Row,
    Section,
    Table,
    counted,
    mean_cell,
    number,
    p_text,
    spread_cell,
)

Estimates = dict[str, tuple[float, float, float]]
"""Mean with the ends of its interval, by condition."""


def study_runs(data: ReportData) -> tuple[Run, ...]:
    """Runs of rearrangement whose episodes all say which participant did them under which condition."""
    return tuple(r for r in data.of_task("rearrange") if all(e.participant and e.condition for e in r.episodes))


def study_tables(episodes: Sequence[ReportEpisode]) -> tuple[list[Table], str]:
    """The tables of estimated means and of pairwise contrasts, or none of them and why."""
    conditions = sorted({e.condition for e in episodes}, key=lambda c: (not _alone(c), c))
    if len(conditions) < 2 or len({e.participant for e in episodes}) < 2:
        return [], "the study needs two conditions and two participants or more"
    try:
        return _fitted(episodes, conditions), ""
    except H3DataError as fault:
        return [], f"the mixed model could not be fitted: {fault}"


def _fitted(episodes: Sequence[ReportEpisode], conditions: Sequence[str]) -> list[Table]:
    steps = _fit(episodes, "TS", "poisson")
    means = marginal_means(steps, "condition")
    notes = [f"Model of TS, all episodes: {steps.formula}, {steps.rows} rows.", *steps.notes]
    estimates = {"TS": _estimates(means), "RE": _efficiencies(means, notes), "CR": _rates(episodes, conditions, notes)}
    estimates["RC"] = {
        c: _bootstrapped([e.metrics.values["RC"] for e in episodes if e.condition == c]) for c in conditions
    }
    return [_study_table(episodes, conditions, estimates, notes), _contrast_table(means)]


def _fit(episodes: Sequence[ReportEpisode], metric: str, family: Literal["poisson", "binomial"]) -> GlmmFit:
    """A mixed model of the episodes that define the metric, with intercepts of participants and, if several, scenes."""
    kept = [e for e in episodes if not np.isnan(e.metrics.values[metric])]
    rows = {
        "condition": [e.condition for e in kept],
        "participant": [e.participant for e in kept],
        "scene": [e.metrics.scene for e in kept],
        metric: [int(e.metrics.values[metric]) for e in kept],
    }
    random = [name for name in ("participant", "scene") if len(set(rows[name])) > 1]
    return fit_glmm(rows, metric, family, fixed=["condition"], random=random)


def _alone(condition: str) -> bool:
    """Whether people work without a robot under a condition."""
    return condition.lower().startswith("solo")


def _estimates(means: MarginalMeans) -> Estimates:
    ends = means.intervals()
    return {c: (float(m), float(a), float(b)) for c, m, (a, b) in zip(means.levels, means.means, ends, strict=True)}


def _efficiencies(means: MarginalMeans, notes: list[str]) -> Estimates:
    """RE in percent of the condition in which people work alone, if there is one."""
    solo = next((c for c in means.levels if _alone(c)), None)
    if solo is None:
        notes.append("RE needs a condition whose name begins with solo.")
        return {}
    others = {r.level: (r.percent, r.low, r.high) for r in relative_efficiency(means, solo)}
    return {solo: (100.0, NAN, NAN), **others}


def _rates(episodes: Sequence[ReportEpisode], conditions: Sequence[str], notes: list[str]) -> Estimates:
    """Estimated shares of episodes with a collision; plain ones where they are 0 or 1, for these have no log-odds."""
    known = {
        c: [v for e in episodes if e.condition == c and not np.isnan(v := e.metrics.values["CR"])] for c in conditions
    }
    rates: Estimates = {c: (float(np.mean(v)), NAN, NAN) for c, v in known.items() if v}
    between = [c for c, (rate, _, _) in rates.items() if 0 < rate < 1]
    if plain := [c for c in rates if c not in between]:
        notes.append(f"CR of {', '.join(plain)} is a plain share: at 0 or 1 the model has no estimate.")
    if len(between) < 2:
        return rates
    fit = _fit([e for e in episodes if e.condition in between], "CR", "binomial")
    notes += [f"Model of CR: {fit.formula}, {fit.rows} rows.", *(f"CR: {note}" for note in fit.notes)]
    return rates | _estimates(marginal_means(fit, "condition"))


def _bootstrapped(values: Sequence[float]) -> tuple[float, float, float]:
    known = [v for v in values if not np.isnan(v)]
    return (float(np.mean(known)), *bootstrap_interval(known)) if known else (NAN, NAN, NAN)


def _study_table(
    episodes: Sequence[ReportEpisode], conditions: Sequence[str], estimates: Mapping[str, Estimates], notes: list[str]
) -> Table:
    paper, facts = published_results().hitl, {m.name: m for m in metrics_of("paper", "rearrange")}
    digits = {"CR": 2, "TS": 1, "RC": 2, "RE": 1}
    rows = [
        Row(
            name=condition,
            cells=tuple(
                mean_cell(*estimates[name].get(condition, (NAN, NAN, NAN)), digits=n) for name, n in digits.items()
            ),
            small=counted(sum(e.condition == condition for e in episodes), "episode"),
        )
        for condition in conditions
    ]
    published = [Row(name=r.name, cells=tuple(spread_cell(r.values.get(n, ())) for n in digits)) for r in paper.rows]
    people = len({e.participant for e in episodes})
    return Table(
        key="hitl",
        title="Human-in-the-loop study",
        caption=f"Human-in-the-loop study: estimated means over {people} participants with 95 % intervals.",
        name_head="Condition",
        columns=tuple(metric_column(facts[name]) for name in digits),
        sections=(
            Section(title="These recordings", rows=tuple(rows)),
            Section(title="Habitat 3.0, as published", rows=tuple(published), published=True),
        ),
        notes=(*notes, f"Published numbers: {paper.source}."),
    )


def _contrast_table(means: MarginalMeans) -> Table:
    paper = published_results().contrasts
    ours = []
    for c in contrasts(means, scale="response", adjust="tukey"):
        names, difference = (c.first, c.second), (c.difference, c.low, c.high)
        if c.difference < 0:  # as the paper prints them
            names, difference = (c.second, c.first), (-c.difference, -c.high, -c.low)
        cells = (mean_cell(*difference, digits=1), Cell(text=p_text(c.p), value=c.p))
        ours.append(Row(name=" − ".join(names), cells=cells))
    published = [
        Row(name=r.name, cells=(Cell(text=number(r.difference), value=r.difference), Cell(text=r.p)))
        for r in paper.rows
    ]
    return Table(
        key="contrasts",
        title="Pairwise contrasts of TS",
        caption="Post hoc pairwise differences of the estimated means of TS; p adjusted by Tukey's method.",
        name_head="Conditions",
        columns=(Column(head="Difference [steps]"), Column(head="p")),
        sections=(
            Section(title="These recordings", rows=tuple(ours)),
            Section(title="Habitat 3.0, as published", rows=tuple(published), published=True),
        ),
        notes=(f"Published numbers: {paper.source}.",),
    )
