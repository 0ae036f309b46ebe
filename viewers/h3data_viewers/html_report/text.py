"""Texts of a report: its beginning, the list of episodes, what the numbers mean."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from html import escape
from pathlib import Path

from h3data.metrics import Metric
from h3data.metrics.episode import assumed_task
from h3data_viewers.html_report.data import ReportData
from h3data_viewers.html_report.tables import Cell, Column, Row, Section, Table, counted, number, to_html

TASKS = {"social_nav": "social navigation", "rearrange": "social rearrangement"}
"""Names of the paper's tasks."""
_LISTED, _MOST_PATHS = 5_000, 8
"""Largest numbers of episodes, and of folders, that are listed one by one."""


def task_name(task: str) -> str:
    """Returns the name of a task in reports."""
    return TASKS.get(task, task.replace("_", " "))


def beginning(
    title: str,
    data: ReportData,
    sections: Sequence[tuple[str, str]],
    folder: Path | None = None,
) -> str:
    """Title, numbers, findings, failed episodes, and links to ``sections`` (key and title).

    With ``folder``, the number of recordings in it replaces the list of their paths.
    """
    episodes = list(data.episodes)
    steps = sum(e.metrics.rows for e in episodes)
    hours = sum(e.metrics.rows * e.metrics.dt_ns for e in episodes) * 1e-9 / 3600
    facts = [
        *(
            (number_of, noun)
            for count, name in (
                (len(episodes), "episode"),
                (len(data.runs), "run"),
                (len({e.metrics.scene for e in episodes}), "scene"),
                (steps, "step"),
            )
            for number_of, _, noun in [counted(count, name).partition(" ")]
        ),
        (f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min", "of behaviour"),
    ]
    facts = facts if steps else facts[:3]  # results without recordings have no steps
    tiles = "".join(f"<li><b>{value}</b><span>{name}</span></li>" for value, name in facts)
    links = "".join(f'<li><a href="#{escape(key)}">{escape(name)}</a></li>' for key, name in sections)
    said = "".join(f"<li>{escape(line)}</li>" for line in _findings(data))
    failed = "".join(
        f"<li>{len(names)} not measured ({escape(reason)}): {escape(', '.join(names[:5]))}"
        f"{', …' if len(names) > 5 else ''}</li>"
        for reason, names in data.unmeasured.items()
    )
    where = ", ".join(f"<code>{escape(str(path))}</code>" for path in data.paths[:_MOST_PATHS])
    where += f" and {len(data.paths) - _MOST_PATHS} more" if len(data.paths) > _MOST_PATHS else ""
    if folder is not None:
        where = f"{counted(len(data.paths), 'recording')} of <code>{escape(folder.name)}</code>"
    return (
        f"<header><h1>{escape(title)}</h1><p class=quiet>{where} · {date.today():%d %B %Y}</p>"
        f'<ul class="facts">{tiles}</ul><ul class="findings">{said}</ul>'
        + (f'<div class="missing"><p>Episodes without numbers:</p><ul>{failed}</ul></div>' if failed else "")
        + f'<nav aria-label="Sections"><ul>{links}</ul></nav></header>'
    )


def absences(missing: Sequence[str]) -> str:
    """Return a list of what the report does not show, and why."""
    return f'<div class="missing"><ul>{"".join(f"<li>{escape(line)}</li>" for line in missing)}</ul></div>'


def _findings(data: ReportData) -> list[str]:
    """The main numbers in words, the paper's beside them; what is not known is left out."""
    lines = []
    for run in data.runs:
        summary, metrics = run.means(), {m.name: m for m in run.table.metrics}
        layout = run.profile.report
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
    lines += [f"Imported {log.metrics.episode_id}: {log.imported}." for log in logs[:_MOST_PATHS]]
    if len(logs) > _MOST_PATHS:
        lines.append(f"{len(logs) - _MOST_PATHS} more were imported.")
    return lines


def _in_words(metric: Metric, mean: float) -> str:
    if metric.binary:
        return f"{100 * mean:.0f}%"
    return number(mean, 1) + "%" if metric.unit == "%" else number(mean)


def episode_list(data: ReportData) -> str:
    """A table per task, folded; it can be sorted."""
    parts = []
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
                    *(Cell(text=number(v), value=v) for v in e.metrics.values.values()),
                ),
            )
            for run in runs
            for e in run.episodes
        ]
        if not rows:
            continue
        shown = rows[:_LISTED]
        table = Table(
            key=f"episodes_{task}",
            title=f"Episodes of {name}",
            caption="Click a head to sort."
            + (f" The first {_LISTED} of {len(rows)}." if len(shown) < len(rows) else ""),
            name_head="Episode",
            columns=(
                *(Column(head=head) for head in ("Run", "Partner", "Scene", "Steps")),
                *(Column(head=m.name, hint=m.title) for m in runs[0].profile.metrics),
            ),
            sections=(Section(title="", rows=tuple(shown)),),
        )
        parts.append(f"<details><summary>{counted(len(rows), 'episode')} of {name}</summary>{to_html(table)}</details>")
    return "".join(parts)


def meanings(data: ReportData) -> str:
    """Definitions of the metrics that are shown, and what had to be assumed."""
    terms = list(dict.fromkeys(m for run in data.runs for m in run.profile.metrics))
    profiles = dict.fromkeys(run.profile.name for run in data.runs)
    named = " and ".join(f"<code>{escape(name)}</code>" for name in profiles)
    notes = [f"{run.name}: {line}" for run in data.runs if (line := assumed_task(run.table.episodes))]
    notes += [
        f"{run.name}, {name}: {text} ({times} of {len(run.episodes)} episodes)"
        for run in data.runs
        for name, texts in run.table.notes().items()
        for text, times in texts.items()
    ]
    said = "".join(f"<li>{escape(line)}</li>" for line in notes)
    return (
        f"<p>Computed from the recordings alone by the metrics profile{'s' * (len(profiles) > 1)} {named}. Intervals hold "
        "95 %: Wilson's for shares, percentile bootstrap over episodes (10,000 resamples, seeded) for means. "
        "An episode that does not define a metric is left out of its mean.</p>"
        f'<dl class="definitions-list">{"".join(map(_definition, terms))}</dl>'
        + (f'<h3>Notes of the measurement</h3><ul class="notes">{said}</ul>' if said else "")
    )


def _definition(metric: Metric) -> str:
    better = {"higher": "higher is better", "lower": "lower is better", "neither": ""}[metric.direction]
    facts = ", ".join(filter(None, (f"unit {metric.unit}" if metric.unit != "1" else "", better, metric.source)))
    return (
        f"<dt>{escape(metric.name)}: {escape(metric.title)}</dt><dd>{escape(metric.formula)}</dd>"
        f'<dd class="quiet">{escape(facts)}. <code>{escape(metric.id)}</code></dd>'
    )
