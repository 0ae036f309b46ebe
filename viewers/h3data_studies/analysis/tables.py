"""Tables of a study with people: estimated means of a mixed model and their pairwise contrasts, next to the paper's."""

from __future__ import annotations

from collections.abc import Sequence

from h3data.errors import InputError
from h3data.metrics import Metric, Profile
from h3data.metrics.paper.profiles import REARRANGEMENT_PROFILE
from h3data.metrics.report_layout import FailedEpisodes, StepsModel, StudyLayout
from h3data_studies.analysis.estimates import (
    FittedMeans,
    StudyAnalysis,
    StudyModel,
    analyse_study,
    study_layout,
    without_hint,
)
from h3data_studies.analysis.ranks import rank_table
from h3data_viewers.html_report.charts import StudyTables, mean_charts
from h3data_viewers.html_report.data import Run
from h3data_viewers.html_report.paper import metric_column
from h3data_viewers.html_report.tables import (
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


def study_tables(
    runs: Sequence[Run], *, steps: StepsModel = "auto", failed: FailedEpisodes = "leave-out"
) -> StudyTables:
    """Return tables of estimated means, of pairwise contrasts and of ranks, with charts of the means.

    Args:
        runs: Runs of one task. Runs without participants are compared with the others only by their ranks.
        steps: Model of the steps, as in `StudyModel`.
        failed: Treatment of episodes without success, as in `StudyModel`.
    """
    studied = [run for run in runs if any(e.studied for e in run.episodes)]
    task, profile = studied[0].task, studied[0].profile
    layout, tables, charts, missing = study_layout(profile), [], {}, ""
    try:
        model = StudyModel(steps=steps, failed=failed)
        analysis = analyse_study([e.metrics for run in studied for e in run.episodes], profile, model)
    except InputError as fault:
        missing = str(fault).partition(" Hint:")[0].rstrip(".")
    else:
        tables.append(_means_table(task, analysis, profile, layout))
        if analysis.models:
            tables.append(_contrast_table(task, analysis, layout))
        means = {
            name: {condition: (e.mean, e.low, e.high) for condition, e in by_condition.items()}
            for name, by_condition in analysis.estimates.items()
        }
        names = [run.name for run in studied]
        charts[tables[0].key] = mean_charts(analysis.metrics, analysis.conditions, means, names)
    ranks = rank_table(runs)
    return StudyTables(tables=tuple(tables if ranks is None else [*tables, ranks]), charts=charts, missing=missing)


def _means_table(task: str, analysis: StudyAnalysis, profile: Profile, layout: StudyLayout) -> Table:
    rows = []
    for condition in analysis.conditions:
        cells = []
        for metric in analysis.metrics:
            estimate = analysis.estimates[metric.name].get(condition)
            cells.append(
                Cell(text="–")
                if estimate is None
                else mean_cell(estimate.mean, estimate.low, estimate.high, digits=_digits(metric))
            )
        rows.append(Row(name=condition, cells=tuple(cells), small=counted(analysis.episodes[condition], "episode")))
    sections, notes = [Section(title="These recordings", rows=tuple(rows))], list(analysis.notes)
    if layout.published is not None:
        paper = layout.published()
        published = [
            Row(name=r.name, cells=tuple(spread_cell(r.values.get(m.name, ())) for m in analysis.metrics))
            for r in paper.rows
        ]
        sections.append(Section(title=f"{paper.paper}, as published", rows=tuple(published), published=True))
        notes.append(f"Published numbers: {paper.source}.")
    return Table(
        key=_key_of("hitl", task),
        title="Human-in-the-loop study",
        caption=f"Human-in-the-loop study: estimated means over {analysis.participants} participants with 95% intervals, by "
        f"the metrics profile {profile.name}.",
        name_head="Condition",
        columns=tuple(metric_column(metric) for metric in analysis.metrics),
        sections=tuple(sections),
        notes=tuple(notes),
    )


def _contrast_table(task: str, analysis: StudyAnalysis, layout: StudyLayout) -> Table:
    names: dict[str, list[Cell]] = {}
    first = analysis.models[0].means
    order = sorted(first.levels, key=lambda level: -first.means[first.levels.index(level)])
    for model in analysis.models:
        for name, cells in _contrasts(model, order).items():
            names.setdefault(name, []).extend(cells)
    sections = [Section(title="These recordings", rows=tuple(Row(name=n, cells=tuple(c)) for n, c in names.items()))]
    notes = [f"{model.label}: {without_hint(note)}" for model in analysis.models for note in model.fit.notes]
    if layout.published_contrasts is not None:
        paper = layout.published_contrasts()
        blank = (Cell(text=""),) * (2 * len(analysis.models) - 2)
        published = [
            Row(name=r.name, cells=(Cell(text=number(r.difference), value=r.difference), Cell(text=r.p), *blank))
            for r in paper.rows
        ]
        sections.append(Section(title=f"{paper.paper}, as published", rows=tuple(published), published=True))
        notes.append(f"Published numbers: {paper.source}.")
    unit = next((m.unit for m in analysis.metrics if m.name == analysis.compared and m.unit != "1"), "")
    several = len(analysis.models) > 1
    return Table(
        key=_key_of("contrasts", task),
        title=f"Pairwise contrasts of {analysis.compared}",
        caption=f"Post hoc pairwise differences of the estimated means of {analysis.compared}; p adjusted by Tukey's method.",
        name_head="Conditions",
        columns=tuple(
            Column(head=head, group=model.label if several else "")
            for model in analysis.models
            for head in (f"Difference [{unit}]" if unit else "Difference", "p" if model.fit.sound else "p (too small)")
        ),
        sections=tuple(sections),
        notes=tuple(notes),
    )


def _contrasts(model: FittedMeans, order: Sequence[str]) -> dict[str, list[Cell]]:
    """Return the difference and p of each pair of conditions; the first has the larger mean, as in the paper."""
    cells = {}
    for c in model.differences:
        names, difference = (c.first, c.second), (c.difference, c.low, c.high)
        if order.index(c.first) > order.index(c.second):
            names, difference = (c.second, c.first), (-c.difference, -c.high, -c.low)
        cells[" − ".join(names)] = [
            mean_cell(*difference, digits=1 if abs(c.difference) >= 1 else 2),
            Cell(text=p_text(c.p), value=c.p),
        ]
    return cells


def _key_of(table: str, task: str) -> str:
    """Return the key of a table of a study: ``hitl`` for rearrangement, the paper's task, else ``hitl_<task>``."""
    return table if task == REARRANGEMENT_PROFILE.tasks[0] else f"{table}_{task}"


def _digits(metric: Metric) -> int:
    return {"%": 1, "steps": 1}.get(metric.unit, 2)
