"""Tables with the paper's numbers next to ours, differences of paired runs, and metrics by policy and partner.

There is one table for social navigation and one for rearrangement with both populations. Differences are computed
between runs over the same episodes. `h3data.metrics.paper.published` has the paper's numbers with their sources.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from h3data.metrics import Metric, Profile, compare_tables, tabulate
from h3data.metrics.paper.profiles import REARRANGEMENT_PROFILE, SOCIAL_NAV_PROFILE
from h3data.metrics.paper.published import published_results
from h3data.metrics.report_layout import PublishedTable
from h3data_viewers.html_report.data import Mean, ReportData, Run, same_episodes
from h3data_viewers.html_report.episode import ReportEpisode
from h3data_viewers.html_report.reading import profiles_beside
from h3data_viewers.html_report.tables import (
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

_MOST_PAIRS = 6
ZSC = "ZSC mean"
"""Heading of the column with the mean over the zero-shot population in heat maps."""


# --- social navigation ------------------------------------------------------------------------------------------------
def social_nav_table(runs: Sequence[Run]) -> Table:
    """Return a table with means and intervals of each run, above the paper's rows."""
    paper = published_results().social_nav
    metrics = SOCIAL_NAV_PROFILE.metrics
    published = [
        Row(name=row.name, cells=tuple(spread_cell(row.values.get(m.name, ())) for m in metrics)) for row in paper.rows
    ]
    # FD is defined only where the person was found: its mean is over other episodes than those of its neighbours
    fewer = [
        f"{run.name}: {m.name} is over the {s[m.name].count} of {len(run.episodes)} episodes that define it."
        for run in runs
        for s in (run.means(),)
        for m in metrics
        if s[m.name].count < len(run.episodes)
    ]
    return Table(
        key=SOCIAL_NAV_PROFILE.tasks[0],
        title="Social navigation",
        caption="Social navigation. Mean over episodes with 95% interval (Wilson for S and CR, else bootstrap)."
        + _of_seeds(runs),
        name_head="Policy",
        columns=tuple(metric_column(m) for m in metrics),
        sections=(
            Section(title="These recordings", rows=_rows(runs, metrics, paper=paper)),
            Section(title="Habitat 3.0, as published", rows=tuple(published), published=True),
        ),
        notes=(f"Published numbers: {paper.source}.", *_deviations(runs), *fewer),
    )


def _rows(runs: Sequence[Run], metrics: Sequence[Metric], *, paper: PublishedTable | None = None) -> tuple[Row, ...]:
    """Return a row of means with intervals for each run, below them those that ``paper`` has of the same policy."""
    summaries, percent = [run.means() for run in runs], runs[0].profile.report.percent
    # the best mean of a column is bold, whatever its interval
    best = _best([{name: s.mean for name, s in summary.items()} for summary in summaries], metrics)
    rows = []
    for k, (run, summary) in enumerate(zip(runs, summaries, strict=True)):
        published = paper.row_of(run.policy) if paper is not None else None
        cells = []
        for metric in metrics:
            factor = 100.0 if metric.name in percent else 1.0
            beside = spread_cell(published.values.get(metric.name, ())).text if published else ""
            small = f"paper {beside}" if beside else ""
            cell = _measured(summary[metric.name], factor=factor, digits=_digits(metric), small=small)
            cells.append(replace(cell, strong=k in best[metric.name]))
        # the number of episodes stands beside each mean, since an interval alone does not tell it
        rows.append(Row(name=run.name, cells=tuple(cells), small=run.size))
    return tuple(rows)


def _deviations(runs: Sequence[Run]) -> list[str]:
    """Return the deviations from the paper's rules of each run that has some."""
    found = {
        run.name: Counter(e.metrics.protocol_deviations for e in run.episodes if e.metrics.protocol_deviations)
        for run in runs
    }
    return [
        f"{name}: rules differ from the paper's, {text} ({counted(times, 'episode')})."
        for name, texts in found.items()
        for text, times in texts.most_common()
    ]


# --- rearrangement ----------------------------------------------------------------------------------------------------
def rearrangement_table(runs: Sequence[Run]) -> Table:
    """Return a table of SR, RE, CR and RC per policy, with training and unseen partners, above the paper's rows."""
    paper = published_results().rearrange
    metrics = {m.name: m for m in REARRANGEMENT_PROFILE.metrics}
    shown = ("SR", "RE", "CR", "RC")
    there = {episode.population for run in runs for episode in run.episodes}
    populations = ["train", "zsc"] + ([""] if "" in there else [])
    if there == {""}:  # imported sessions and the like: what was measured stands first, where a narrow window shows it
        populations = ["", "train", "zsc"]
    other = "Other partners" if len(there) > 1 else "All partners"
    heads = {"train": "Train-pop-eval", "zsc": "ZSC-pop-eval", "": other}  # as in the paper's table
    ours = []
    for run in runs:
        cells = []
        for population in populations:
            chosen = [e for e in run.episodes if e.population == population]
            summary = run.means(chosen)
            for name in shown:
                s, factor = summary.get(name), 100.0 if name == "SR" else 1.0
                digits = 1 if name in ("SR", "RE") else 2
                cells.append(_measured(s, factor=factor, digits=digits) if s else Cell(text=""))
        partners = len({e.partner for e in run.episodes})
        small = f"{run.size}, {counted(partners, 'partner')}"
        ours.append(Row(name=run.name, cells=tuple(cells), small=small))
    published = [
        Row(
            name=row.name,
            cells=tuple(
                spread_cell({"train": row.train, "zsc": row.zsc}.get(population, {}).get(name, ()), digits=2)
                for population in populations
                for name in shown
            ),
        )
        for row in paper.rows
    ]
    return Table(
        key=REARRANGEMENT_PROFILE.tasks[0],
        title="Social rearrangement",
        caption="Social rearrangement, with the training population and with unseen partners. SR and RE in %. "
        "Mean over episodes with 95% interval." + _of_seeds(runs),
        name_head="Method",
        columns=tuple(
            metric_column(metrics[name], group=heads[population]) for population in populations for name in shown
        ),
        sections=(
            Section(title="These recordings", rows=tuple(ours)),
            Section(title="Habitat 3.0, as published", rows=tuple(published), published=True),
        ),
        notes=(f"Published numbers: {paper.source}.", *_deviations(runs)),
    )


# --- any other task ---------------------------------------------------------------------------------------------------
def task_table(name: str, runs: Sequence[Run]) -> Table:
    """Return a table with means and intervals of each run, in the columns that the task's profile selects."""
    profile = runs[0].profile
    shown = profile.report.columns or tuple(m.name for m in profile.metrics)
    metrics = [m for m in profile.metrics if m.name in shown]
    title = profile.report.title or name.capitalize()
    return Table(
        key=runs[0].task,
        title=title,
        caption=f"{title}, by the metrics profile {profile.name}. Mean over episodes with 95% interval."
        + _of_seeds(runs),
        name_head="Policy",
        columns=tuple(metric_column(m) for m in metrics),
        sections=(Section(title="", rows=_rows(runs, metrics)),),
    )


def tables_beside(name: str, runs: Sequence[Run]) -> list[Table]:
    """Return a table for each further profile that measures some episodes of a task (`h3data.metrics.Profile.beside`)."""
    tables = []
    for profile in profiles_beside():
        measured = [
            replace(run, profile=profile, episodes=episodes, table=tabulate(unique, profile=profile.name))
            for run in runs
            if (episodes := tuple(_by(profile, run)))
            # training seeds play the same episodes, and a table refuses an episode that comes twice
            for unique in [[replace(e.metrics, uid=f"{e.metrics.uid} {e.policy}") for e in episodes]]
        ]
        if measured:
            table = task_table(name, measured)
            title = f"{profile.title} in {name}"
            caption = f"By the metrics profile {profile.name}. Mean over episodes with 95% interval."
            tables.append(replace(table, key=f"{table.key}-{profile.name}", title=title, caption=caption))
    return tables


def _by(profile: Profile, run: Run) -> Iterator[ReportEpisode]:
    """Yield the episodes of a run that a further profile measures, with its metrics."""
    for episode in run.episodes:
        for measured in episode.beside:
            if measured.profile == profile.name:
                # of partners who share a recording, each counts
                own = replace(measured, partner=episode.metrics.partner, metrics=profile.metrics)
                yield replace(episode, metrics=own)


# --- paired differences -----------------------------------------------------------------------------------------------
def paired_tables(data: ReportData) -> list[Table]:
    """Return one table for each pair of runs over the same episodes, up to 6; with more runs, each against the first."""
    pairs = [(a, b) for a, b in itertools.combinations(data.runs, 2) if same_episodes(a, b)]
    if len(pairs) > _MOST_PAIRS:
        # of many runs, each is compared with the first, which is the baseline by its place on the command line
        pairs = [(a, b) for a, b in pairs if a is pairs[0][0]][:_MOST_PAIRS]
    return [_paired_table(k, a, b) for k, (a, b) in enumerate(pairs)]


def _paired_table(place: int, first: Run, second: Run) -> Table:
    found = compare_tables(first.table, second.table, names=(first.name, second.name))
    rows = []
    for metric in first.table.metrics:
        test = found.tests[metric.name]
        digits = _digits(metric)
        effect = (
            Cell(text=number(test.effect), value=test.effect, small=test.effect_name) if test.pairs else Cell(text="–")
        )
        difference = mean_cell(test.difference, test.low, test.high, digits=digits)
        rows.append(
            Row(
                name=metric.name,
                small=metric.title,
                cells=(
                    mean_cell(test.first_mean, digits=digits),
                    mean_cell(test.second_mean, digits=digits),
                    replace(difference, strong=bool(test.p_adjusted < 0.05)),
                    Cell(text=p_text(test.p_adjusted), value=test.p_adjusted, small=test.method),
                    effect,
                    Cell(text=f"{len(found.changed(metric.name))} of {len(found.episode_ids)}"),
                ),
            )
        )
    return Table(
        key=f"paired_{place + 1}",
        title=f"{first.name} against {second.name}",
        caption=f"{first.name} minus {second.name} on the same {len(found.episode_ids)} episodes; 95% bootstrap interval "
        "of the mean difference, p adjusted for all metrics (Holm); bold: below 0.05.",
        name_head="Metric",
        columns=(
            Column(head=first.name),
            Column(head=second.name),
            Column(head="Difference"),
            Column(head="p"),
            Column(head="Effect"),
            Column(head="Episodes that differ"),
        ),
        sections=(Section(title="", rows=tuple(rows)),),
        notes=tuple(found.notes),
    )


# --- partners ---------------------------------------------------------------------------------------------------------
def partner_tables(runs: Sequence[Run], names: Sequence[str]) -> list[Table]:
    """Return one heat map of runs by partners per metric in ``names``; the list is empty if there is only one partner.

    A last column has the mean over all episodes with partners of the zero-shot population, if there is one.
    """
    kinds = {e.partner: e.population for run in runs for e in run.episodes if e.partner}
    partners = sorted(kinds, key=lambda name: (("train", "", "zsc").index(kinds[name]), name))
    if len(partners) < 2:
        return []
    unseen = [name for name in partners if kinds[name] == "zsc"]
    columns = [*partners, ZSC] if unseen else partners
    metrics = {m.name: m for m in runs[0].table.metrics}
    tables = []
    for name in names:
        cells = {
            (run.name, column): run.means(
                [e for e in run.episodes if (e.population == "zsc" if column == ZSC else e.partner == column)]
            ).get(name)
            for run in runs
            for column in columns
        }
        means = [cell.mean for cell in cells.values() if cell is not None and cell.count]
        if not means:
            continue
        metric = metrics[name]
        # shares have a common scale, so that tables of two runs can be compared; other units span what there is
        low, high = (0.0, max(1.0, *means)) if metric.unit == "1" else (min(means), max(means))
        in_percent = metric.unit == "%" or name == "SR" or name in runs[0].profile.report.percent
        # the paper prints SR in percent
        factor = 100.0 if in_percent and metric.unit != "%" else 1.0
        shade = _Shade(low=low, high=high, factor=factor, digits=1 if in_percent else _digits(metric))
        rows = [
            Row(name=run.name, cells=tuple(shade.cell(cells[run.name, p]) for p in columns), small=run.size)
            for run in runs
        ]
        unit = "%" if in_percent else metric.unit
        title = metric.title.lower() + (f" [{unit}]" if unit != "1" else "")
        tables.append(
            Table(
                key=f"partners_{runs[0].task}_{name}",
                title=f"{name} by partner",
                caption=f"{name}, {title}: mean by policy and partner"
                + (f"; {ZSC}: over the episodes with all {len(unseen)} zero-shot partners." if unseen else ".")
                + _of_seeds(runs),
                name_head="Policy",
                columns=tuple(
                    Column(head=column, group="" if column == ZSC else _partner_group(kinds, column))
                    for column in columns
                ),
                sections=(Section(title="", rows=tuple(rows)),),
                scale=shade.ends(metric),
            )
        )
    return tables


def _partner_group(kinds: Mapping[str, str], partner: str) -> str:
    """Return the heading above partners of one population; with one population, all are partners."""
    if len(set(kinds.values())) == 1 and not kinds[partner]:
        return "Partner"
    # populations are those of the paper's appendix: trained with, and unseen
    return {"train": "Training partners", "zsc": "Zero-shot partners", "": "Other partners"}[kinds[partner]]


@dataclass(frozen=True, kw_only=True)
class _Shade:
    """Colour scale of a heat map of means: from ``low`` (pale) to ``high`` (dark), shown times ``factor``."""

    low: float
    high: float
    factor: float
    digits: int

    def cell(self, found: Mean | None) -> Cell:
        if found is None or not found.count:
            return Cell(text="–")
        spread = f"± {number(self.factor * found.deviation, self.digits)}, " if found.seeds > 1 else ""
        return Cell(
            text=number(self.factor * found.mean, self.digits),
            value=found.mean,
            small=f"{spread}n = {found.count}",
            heat=(found.mean - self.low) / ((self.high - self.low) or 1.0),
        )

    def ends(self, metric: Metric) -> tuple[str, str]:
        """Return the labels at the pale and the dark end of the colour bar."""
        better = {"higher": ("", ", better"), "lower": (", better", ""), "neither": ("", "")}[metric.direction]
        low, high = (
            number(self.factor * value, self.digits) + word
            for value, word in zip((self.low, self.high), better, strict=True)
        )
        return low, high


# --- small things -----------------------------------------------------------------------------------------------------
def metric_column(metric: Metric, *, group: str = "") -> Column:
    """Return the column of a metric, whose heading has its name, its unit, and an arrow for the better direction."""
    unit = f" [{metric.unit}]" if metric.unit in ("m", "steps") else ""
    arrow = {"higher": "↑", "lower": "↓", "neither": ""}[metric.direction]
    return Column(head=f"{metric.name}{arrow}{unit}", hint=metric.title, group=group)


def _digits(metric: Metric) -> int:
    return {"%": 1, "steps": 1}.get(metric.unit, 2)


def _best(means: Sequence[Mapping[str, float]], metrics: Sequence[Metric]) -> dict[str, set[int]]:
    """Return which rows have the best mean of each metric that has a direction; none if there is a single row."""
    best: dict[str, set[int]] = {}
    for metric in metrics:
        values = np.array([mean[metric.name] for mean in means])
        sign = {"higher": 1.0, "lower": -1.0, "neither": NAN}[metric.direction]
        ranked = np.round(sign * values, _digits(metric))
        several = len(values) > 1 and not np.isnan(ranked).all()
        best[metric.name] = set(np.flatnonzero(ranked == np.nanmax(ranked)).tolist()) if several else set()
    return best


def _measured(found: Mean, *, factor: float = 1.0, digits: int = 2, small: str = "") -> Cell:
    """Return a mean with its interval, of seeds with their standard deviation."""
    if not found.seeds:
        return mean_cell(factor * found.mean, factor * found.low, factor * found.high, digits=digits, small=small)
    values = (factor * found.mean, factor * found.deviation)
    return replace(spread_cell(values[: 1 + (found.seeds > 1)], digits=digits), small=small)


def _of_seeds(runs: Sequence[Run]) -> str:
    return " Of several training seeds: mean of their means ± standard deviation." if any(r.seeds for r in runs) else ""
