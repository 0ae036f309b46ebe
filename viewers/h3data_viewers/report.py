"""One HTML file about many episodes: the paper's tables beside ours, charts, trajectories, best and worst episodes.

The file needs nothing else: no network, no other file, no script to be read (scripts only sort tables). Everything that
comes from a recording is escaped, and a content security policy lets no script run but the page's own.
"""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from html import escape
from importlib.metadata import version
from importlib.resources import files
from string import Template

from h3data.files import part_file
from h3data.metrics import Metric, metrics_of
from h3data_viewers.report_charts import (
    distribution_charts,
    estimate_charts,
    learning_charts,
    legend,
    time_charts,
)
from h3data_viewers.report_data import CURVES_FILE, ReportData, Run, gather
from h3data_viewers.report_paper import (
    paired_tables,
    paper_results,
    partner_tables,
    rearrangement_table,
    social_nav_table,
)
from h3data_viewers.report_pictures import Plans, highlight_card, highlights, ranked_by, trajectory_figures
from h3data_viewers.report_study import study_runs, study_tables
from h3data_viewers.report_tables import Cell, Column, Row, Section, Table, number, to_html, to_latex, to_markdown

_TASKS = {"social_nav": "social navigation", "rearrange": "social rearrangement"}
_PERCENT = "\u00a0%"
_LISTED = 5_000
"""At most so many episodes are listed one by one."""
_BESIDE = 4
"""With more partners than this, heat maps stand below each other."""
_PARTNER_METRICS = {"social_nav": ("S", "F", "CR"), "rearrange": ("SR", "RE", "CR")}


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """A finished report."""

    title: str
    data: ReportData
    tables: tuple[Table, ...]
    """The paper's tables that there are episodes for, and the paired differences."""
    missing: tuple[str, ...]
    """What is not in the report, and why."""
    html: str

    def to_markdown(self) -> str:
        """All tables as GitHub Markdown."""
        return "\n\n".join(map(to_markdown, self.tables)) + "\n"

    def to_latex(self) -> str:
        """All tables as LaTeX; needs the package booktabs."""
        return "% \\usepackage{booktabs}\n" + "\n\n".join(map(to_latex, self.tables)) + "\n"


def make_report(paths: Iterable[str | os.PathLike[str]], *, title: str = "", pictures: int = 6) -> Report:
    """The report of datasets, logs and folders of logs; ``pictures`` episodes at most are shown with key frames.

    Raises:
        InputError: there is no recording, or episodes that cannot share a table; see `gather`.
        FormatError: a file is damaged.
    """
    data = gather(paths)
    title = title or _title(data)
    missing: list[str] = []
    tables = _paper_tables(data, missing)
    pairs = paired_tables(data)
    if len(data.runs) > 1 and not pairs:
        missing.append("Paired differences: no two runs hold the same episodes (ids, scenes and seeds).")
    body, plans = [], Plans()
    for task in _TASKS:
        runs = data.of_task(task)
        if runs:
            body += _task_sections(task, runs, tables, plans, pictures, missing)
    if pairs:
        text = "".join(f"<h3>{escape(t.title)}</h3>{to_html(t)}" for t in pairs)
        body.append(_section("paired", "Paired differences", text))
    if data.curves:
        panels = learning_charts(data.curves)
        body.append(_section("learning", "Learning curves", legend(list(data.curves)) + _panels(panels)))
    else:
        missing.append(f"Learning curves: no dataset holds a file {CURVES_FILE}.")
    body.append(_section("episodes", "All episodes", _episode_list(data)))
    body.append(_section("methods", "What the numbers mean", _methods(data)))
    head = _head(title, data, missing, body)
    return Report(
        title=title,
        data=data,
        tables=(*tables, *pairs),
        missing=tuple(missing),
        html=_page(title, plans.definitions() + head + "<main>" + "".join(s for _, _, s in body) + "</main>" + _foot()),
    )


def write_report(
    paths: Iterable[str | os.PathLike[str]], out: str | os.PathLike[str], *, title: str = "", pictures: int = 6
) -> Report:
    """`make_report`, written to ``out``."""
    report = make_report(paths, title=title, pictures=pictures)
    with part_file(out) as part:
        part.write_text(report.html, encoding="utf-8")
    return report


# --- sections ---------------------------------------------------------------------------------------------------------
Part = tuple[str, str, str]
"""Key, title and HTML of a section."""


def _section(key: str, title: str, html: str) -> Part:
    return key, title, f'<section id="{escape(key)}"><h2>{escape(title)}</h2>{html}</section>'


def _paper_tables(data: ReportData, missing: list[str]) -> list[Table]:
    tables = []
    if runs := data.of_task("social_nav"):
        tables.append(social_nav_table(runs))
    else:
        missing.append("Social navigation: there are no episodes of it.")
    people = study_runs(data)
    if runs := [run for run in data.of_task("rearrange") if run not in people]:
        tables.append(rearrangement_table(runs))
    else:
        missing.append("Social rearrangement (train-pop and ZSC-pop): there are no episodes of it.")
    if people:
        study, why = study_tables([e for run in people for e in run.episodes])
        tables += study
        if why:
            missing.append(f"Human-in-the-loop study: {why}.")
    else:
        missing.append("Human-in-the-loop study and its contrasts: no episodes of participants under conditions.")
    return tables


def _task_sections(
    task: str, runs: Sequence[Run], tables: Sequence[Table], plans: Plans, pictures: int, missing: list[str]
) -> list[Part]:
    """Everything about the runs of one task."""
    names = legend([run.name for run in runs])
    parts = []
    if table := next((t for t in tables if t.key == task), None):
        beside = f"<h3>Beside the paper</h3>{names}{_panels(estimate_charts(runs))}" if task == "social_nav" else ""
        parts.append(_section(task, table.title, to_html(table) + beside))
    if task == "rearrange":
        parts += [_section(t.key, t.title, to_html(t)) for t in tables if t.key in ("hitl", "contrasts")]
    partners = partner_tables(runs, _PARTNER_METRICS[task])
    if partners:
        heats = "".join(f"<div>{to_html(t, sortable=False)}</div>" for t in partners)
        css = "heats" if len(partners[0].columns) <= _BESIDE else "heats rows"
        parts.append(_section(f"{task}-partners", "Policies and partners", f'<div class="{css}">{heats}</div>'))
    else:
        missing.append(f"Policies by partner in {_TASKS[task]}: all episodes have the same partner.")
    lead = "<p class=quiet>Each bar counts episodes; the upright line is the mean.</p>"
    parts.append(_section(f"{task}-spread", "Distributions", lead + names + _panels(distribution_charts(runs))))
    if charts := time_charts(runs):
        parts.append(_section(f"{task}-time", "Over time", names + _panels(charts)))
    if figures := trajectory_figures(runs, plans):
        lead = (
            "<p class=quiet>Ways of the robots in the colour of their run, with a dot where each ended; ways of the people in "
            "grey.</p>"
        )
        parts.append(_section(f"{task}-plans", "Trajectories", lead + names + _panels(figures)))
    if pictures > 0:
        cards = "".join(highlight_card(h, plans) for h in highlights(runs, pictures))
        first, *others = ranked_by(task)
        lead = (
            f"<p class=quiet>Ranked by {first}, then {', '.join(others)}. Plans: robot orange, person blue; a ring is the "
            "start, a dot the end.</p>"
        )
        parts.append(_section(f"{task}-episodes", "Worst and best episodes", lead + cards))
    return parts


def _panels(figures: Sequence[str]) -> str:
    return f'<div class="panels">{"".join(figures)}</div>'


def _head(title: str, data: ReportData, missing: Sequence[str], body: Sequence[Part]) -> str:
    episodes = list(data.episodes)
    steps = sum(e.metrics.rows for e in episodes)
    hours = sum(e.metrics.rows * e.metrics.dt_ns for e in episodes) * 1e-9 / 3600
    facts = [
        (f"{len(episodes):,}", "episodes"),
        (f"{len(data.runs)}", "runs"),
        (f"{len({e.metrics.scene for e in episodes})}", "scenes"),
        (f"{steps:,}", "steps"),
        (f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min", "of behaviour"),
    ]
    tiles = "".join(f"<li><b>{value}</b><span>{name}</span></li>" for value, name in facts)
    links = "".join(f'<li><a href="#{escape(key)}">{escape(name)}</a></li>' for key, name, _ in body)
    said = "".join(f"<li>{escape(line)}</li>" for line in _findings(data))
    absent = "".join(f"<li>{escape(line)}</li>" for line in missing)
    failed = "".join(
        f"<li>{len(names)} not measured ({escape(reason)}): {escape(', '.join(names[:5]))}"
        f"{', …' if len(names) > 5 else ''}</li>"
        for reason, names in data.unmeasured.items()
    )
    where = ", ".join(f"<code>{escape(str(path))}</code>" for path in data.paths)
    return (
        f"<header><h1>{escape(title)}</h1><p class=quiet>{where} · {date.today():%d %B %Y}</p>"
        f'<ul class="facts">{tiles}</ul><ul class="findings">{said}</ul>'
        + (
            f'<div class="missing"><p>Not in this report:</p><ul>{failed}{absent}</ul></div>'
            if failed or absent
            else ""
        )
        + f'<nav aria-label="Sections"><ul>{links}</ul></nav></header>'
    )


def _findings(data: ReportData) -> list[str]:
    """The main numbers in words."""
    lines = []
    for run in data.of_task("social_nav"):
        s = run.table.summary()
        row = paper_results().social_nav.row_of(run.policy)

        def paper(name: str, factor: float, unit: str, row=row) -> str:
            return f" (paper: {factor * row.values[name][0]:.{0 if unit else 2}f}{unit})" if row else ""

        lines.append(
            f"{run.name} finds the person in {_percent(s['S'].mean)} of {len(run.episodes)} episodes"
            f"{paper('S', 100, _PERCENT)}, follows at a rate F of {number(s['F'].mean)}{paper('F', 1, '')}, and touches "
            f"the person in {_percent(s['CR'].mean)}{paper('CR', 100, _PERCENT)}."
        )
    for run in data.of_task("rearrange"):
        s = run.table.summary()
        lines.append(
            f"{run.name} completes {_percent(s['SR'].mean)} of {len(run.episodes)} rearrangements"
            + ("" if s["RE"].count == 0 else f" at a relative efficiency of {number(s['RE'].mean, 1)} %")
            + "."
        )
    return lines


def _percent(share: float) -> str:
    return "an unknown share" if share != share else f"{100 * share:.0f}{_PERCENT}"


def _episode_list(data: ReportData) -> str:
    """A table per task, folded; it can be sorted."""
    parts = []
    for task, name in _TASKS.items():
        runs = data.of_task(task)
        rows = [
            Row(
                name=e.metrics.episode_id,
                cells=(
                    Cell(text=run.name),
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
                *(Column(head=m.name, hint=m.title) for m in metrics_of("paper", task)),
            ),
            sections=(Section(title="", rows=tuple(shown)),),
        )
        parts.append(f"<details><summary>{len(rows)} episodes of {name}</summary>{to_html(table)}</details>")
    return "".join(parts)


def _methods(data: ReportData) -> str:
    """Definitions of the metrics that are shown, and what had to be assumed."""
    terms = [m for task in _TASKS if data.of_task(task) for m in metrics_of("paper", task)]
    notes = [
        f"{run.name}, {', '.join([name])}: {text} ({times} of {len(run.episodes)} episodes)"
        for run in data.runs
        for name, texts in run.table.notes().items()
        for text, times in texts.items()
    ]
    said = "".join(f"<li>{escape(line)}</li>" for line in notes)
    return (
        "<p>Computed from the recordings alone by the profile <code>paper</code> of h3data. Intervals hold 95 %: Wilson's "
        "for shares, percentile bootstrap over episodes (10,000 resamples, seeded) for means. An episode that does not "
        "define a metric is left out of its mean.</p>"
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


def _foot() -> str:
    return (
        f"<footer>Made by h3data {escape(version('h3data'))}. Published numbers: Puig et al. 2023, Habitat 3.0: A Co-Habitat "
        "for Humans, Avatars and Robots, arXiv:2310.13724.</footer>"
    )


def _title(data: ReportData) -> str:
    tasks = [name for task, name in _TASKS.items() if data.of_task(task)]
    return (" and ".join(tasks).capitalize() or "Recordings") + (
        f": {len(data.runs)} runs" if len(data.runs) > 1 else ""
    )


def _page(title: str, body: str) -> str:
    folder = files("h3data_viewers") / "report_page"
    style, script, page = (
        (folder / name).read_text(encoding="utf-8").strip() for name in ("page.css", "page.js", "page.html")
    )
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return Template(page).substitute(title=escape(title), style=style, script=script, script_hash=digest, body=body)
