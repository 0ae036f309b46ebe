"""Texts of a report: key numbers, findings in words, lists of episodes, and remarks on the measurement."""

from __future__ import annotations

from h3data.metrics import Metric
from h3data.metrics.episode import assumed_task
from h3data.metrics.paper.profiles import PROFILES
from h3data_viewers.html_report.data import ReportData
from h3data_viewers.html_report.tables import Cell, Column, Row, Section, Table, counted, number

TASKS = {profile.tasks[0]: profile.report.title.lower() for profile in PROFILES}
"""Titles of the paper's tasks in lower case, in the paper's order, by task name."""
_LISTED, _MOST_LOGS = 5_000, 8
"""Largest numbers of episodes, and of imported logs, that are listed one by one."""


def task_name(task: str) -> str:
    """Return the name of a task in reports."""
    return TASKS.get(task, task.replace("_", " "))


def facts(data: ReportData) -> list[tuple[str, str]]:
    """Return the key numbers at the top of a report, each with its noun."""
    episodes = list(data.episodes)
    steps = sum(e.metrics.rows for e in episodes)
    hours = sum(e.metrics.rows * e.metrics.dt_ns for e in episodes) * 1e-9 / 3600
    counts = {"episode": len(episodes), "run": len(data.runs), "scene": len({e.metrics.scene for e in episodes})}
    counts |= {"step": steps} if steps else {}  # results without recordings have no steps
    behaviour = (f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min", "of behaviour")
    shown = [(number, noun) for name, n in counts.items() for number, _, noun in [counted(n, name).partition(" ")]]
    return [*shown, behaviour] if steps else shown


def findings(data: ReportData) -> list[str]:
    """Return the known main results of a report as sentences, with the paper's numbers in brackets."""
    lines = []
    for run in data.runs:
        summary, metrics = run.means(), {m.name: m for m in run.table.metrics}
        layout = run.profile.report
        # the paper's number only where its policy is the same
        row = layout.published().row_of(run.policy) if layout.published else None
        published = row.values if row else {}
        said = []
        for name, phrase in (
            layout.findings or {m.name: f"{m.title.lower()}:" for m in run.profile.metrics[:3]}
        ).items():
            if summary[name].count:
                beside = f" (paper: {_in_words(metrics[name], published[name][0])})" if name in published else ""
                share = " of episodes" if metrics[name].binary else ""
                said.append(f"{phrase} {_in_words(metrics[name], summary[name].mean)}{share}{beside}")
        if said:
            lines.append(f"{run.name} ({run.size}) {', '.join(said)}.")
    logs = [episode for episode in data.episodes if episode.imported]
    lines += [f"Imported {log.metrics.episode_id}: {log.imported}." for log in logs[:_MOST_LOGS]]
    if len(logs) > _MOST_LOGS:
        lines.append(f"{len(logs) - _MOST_LOGS} more were imported.")
    return lines


def _in_words(metric: Metric, mean: float) -> str:
    if metric.binary:
        return f"{100 * mean:.0f}%"
    return number(mean, 1) + "%" if metric.unit == "%" else number(mean)


def episode_tables(data: ReportData) -> list[tuple[str, Table]]:
    """Return a table of the episodes of each task, with the number of episodes in words."""
    tables = []
    for task in data.tasks:
        name, runs = task_name(task), data.of_task(task)
        rows = [
            Row(
                name=e.metrics.episode_id,
                cells=(
                    Cell(text=e.policy if run.seeds else run.name),
                    Cell(text=e.partner),
                    Cell(text=e.metrics.scene),
                    Cell(text=str(e.metrics.rows), value=e.metrics.rows),
                    # the value beside the text: a column is sorted by numbers, not by rounded words
                    *(Cell(text=number(v), value=v) for v in e.metrics.values.values()),
                ),
            )
            for run in runs
            for e in run.episodes
        ]
        if not rows:
            continue
        # a browser takes seconds for a table of more rows
        first = f" The first {_LISTED} of {len(rows)}." if len(rows) > _LISTED else ""
        table = Table(
            key=f"episodes_{task}",
            title=f"Episodes of {name}",
            caption=f"Click a head to sort.{first}",
            name_head="Episode",
            columns=(
                *(Column(head=head) for head in ("Run", "Partner", "Scene", "Steps")),
                *(Column(head=m.name, hint=m.title) for m in runs[0].profile.metrics),
            ),
            sections=(Section(title="", rows=tuple(rows[:_LISTED])),),
        )
        tables.append((f"{counted(len(rows), 'episode')} of {name}", table))
    return tables


def remarks(data: ReportData) -> list[str]:
    """Return assumptions that the measurement of each run had to make, and reasons why metrics are undefined."""
    lines = [f"{run.name}: {line}" for run in data.runs if (line := assumed_task(run.table.episodes))]
    return lines + [
        f"{run.name}, {name}: {text} ({times} of {len(run.episodes)} episodes)"
        for run in data.runs
        for name, texts in run.table.notes().items()
        for text, times in texts.items()
    ]
