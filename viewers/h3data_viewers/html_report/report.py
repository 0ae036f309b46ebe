"""Report about many episodes as one HTML file: our tables and the paper's, charts, trajectories and key frames.

The file needs no network and no other file, and it can be read without scripts, which only sort tables. All texts from
recordings are escaped, and a content security policy allows only the page's own scripts.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

from h3data.bodies.people.rigid_parts import PeopleStyle
from h3data.errors import InputError
from h3data.files import part_file
from h3data.metrics.batch import Spread
from h3data.metrics.paper.profiles import REARRANGEMENT_PROFILE, SOCIAL_NAV_PROFILE
from h3data.metrics.report_layout import FailedEpisodes, StepsModel
from h3data.plugins import Registry, own_version
from h3data.progress import progress
from h3data.render.light.sources import LightMode
from h3data_viewers.html_report.charts import (
    StudyTables,
    distribution_charts,
    estimate_charts,
    learning_charts,
    time_charts,
)
from h3data_viewers.html_report.data import CURVES_FILE, RUN_CURVES_FILE, ReportData, Run, gather
from h3data_viewers.html_report.paper import (
    paired_tables,
    partner_tables,
    rearrangement_table,
    social_nav_table,
    tables_beside,
    task_table,
)
from h3data_viewers.html_report.pictures import (
    Plans,
    Posing,
    ReplayFiles,
    highlight_card,
    highlights,
    ranked_by,
    trajectory_charts,
)
from h3data_viewers.html_report.reading import Found
from h3data_viewers.html_report.tables import Table, to_latex, to_markdown
from h3data_viewers.html_report.text import TASKS, episode_tables, facts, findings, remarks, task_name
from h3data_viewers.templates import render

SECTIONS: Registry[Callable[..., Any]] = Registry("h3data.report_sections", {}, what="section of reports")
"""Registry of report sections from other packages. Section ``study`` is a function of the runs of a task and of the
model of its steps, which returns `StudyTables`; ``added_time`` is a function of a recording, which returns persons with
their ``seconds``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """Report with its runs, tables, page and related files."""

    title: str
    data: ReportData
    tables: tuple[Table, ...]
    """Tables next to the paper's numbers, and tables of paired differences."""
    tables_of_partners: tuple[Table, ...]
    """Heat maps of policies by partners."""
    missing: tuple[str, ...]
    """Parts that are not in the report, with the reason."""
    html: str
    replays: tuple[Path, ...] = ()
    """HTML replays to which the page links."""

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the page; the file appears only when it is complete."""
        with part_file(path) as part:
            part.write_text(self.html, encoding="utf-8")

    def to_markdown(self) -> str:
        """Return all tables as GitHub Markdown."""
        return "\n\n".join(map(to_markdown, self.tables)) + "\n"

    def to_latex(self) -> str:
        """Return all tables as LaTeX; needs the package booktabs."""
        return "% \\usepackage{booktabs}\n" + "\n\n".join(map(to_latex, self.tables)) + "\n"


def make_report(
    paths: Iterable[str | os.PathLike[str]],
    *,
    title: str = "",
    pictures: int = 6,
    assets: Sequence[str | os.PathLike[str]] = (),
    people: PeopleStyle = "skin",
    light: LightMode = "flat",
    stand_ins: bool = False,
    study_model: StepsModel = "auto",
    failed: FailedEpisodes = "leave-out",
    unseen_partners: Sequence[str] = (),
    seeds: Sequence[str] = (),
    more: Sequence[Table] = (),
    folder: Path | None = None,
    replays: Path | None = None,
    spread: Spread[Found] = map,
    command: str = "",
) -> Report:
    """Return the report on datasets, logs and folders of logs, with key frames of at most ``pictures`` episodes.

    ``assets`` are folders with the asset files of foreign recordings. ``people``, ``light`` and ``stand_ins`` set the
    look of the key frames, as in `h3data.replay.Replay`. ``study_model`` and ``failed`` choose the statistical model of
    a study, like the options of ``h3data report``. ``unseen_partners`` names the partners of the zero-shot population.
    ``seeds`` has patterns of policies that differ only by their training seed and share a row (`gather`). ``more`` are
    additional tables, each in a section of its own. Paths on the page are relative to ``folder``. ``replays`` is the
    folder, such as `replay_folder`, for HTML replays of the episodes with key frames. ``spread`` may distribute reading
    and measuring over processes or machines. ``command`` is the command in the last line of the page.

    Raises:
        InputError: there is no recording, or episodes that cannot share a table; see `gather`.
        FormatError: a file is damaged.
    """
    from h3data.replay import Replay

    data = gather(paths, unseen_partners=unseen_partners, seeds=seeds, spread=spread)
    if not title:
        several = f": {len(data.runs)} runs" if len(data.runs) > 1 else ""
        title = (" and ".join(map(task_name, data.tasks)).capitalize() or "Recordings") + several
    missing: list[str] = []
    studies = _studies(data, missing, study_model, failed)
    tables = _paper_tables(data, missing, studies)
    pairs = paired_tables(data)
    if len(data.runs) > 1 and not pairs:
        several = ", and runs of several training seeds are not paired" if any(run.seeds for run in data.runs) else ""
        missing.append(f"Paired differences: no two runs hold the same episodes (ids, scenes and seeds){several}.")
    sections, plans, heat = [], Plans(), []
    files = None if replays is None else ReplayFiles(replays)
    posed: Posing = partial(Replay, assets=[Path(each) for each in assets], people=people, stand_ins=stand_ins)
    for task in data.tasks:
        runs, tail = data.of_task(task), f" in {task_name(task)}" if len(data.tasks) > 1 else ""
        partners = partner_tables(runs, runs[0].profile.report.by_partner or ranked_by(runs[0].profile))
        # heat maps are for the page alone: Markdown and LaTeX have no colours
        heat += partners
        sections += _task_sections(task, runs, tables, partners, studies.get(task), plans, missing, tail)
        if chosen := highlights(runs, pictures):
            shown = progress(chosen, desc=f"picture episodes{tail}", unit="episode", leave=False)
            cards = [highlight_card(highlight, plans, posed, light, files, folder) for highlight in shown]
            content = {"cards": cards, "ranking": ranked_by(runs[0].profile)}
            sections.append(ReportSection(f"{task}-episodes", "Worst and best episodes" + tail, "cards", content))
    if any(not e.recorded for e in data.episodes):
        missing.append(
            "Pictures, paths and times of evaluated episodes: evaluate --save-recordings keeps their recordings."
        )
    more = [*(table for task in data.tasks for table in tables_beside(task_name(task), data.of_task(task))), *more]
    sections += [ReportSection(table.key, table.title, "table", {"table": table}) for table in more]
    if pairs:
        sections.append(ReportSection("paired", "Paired differences", "tables", {"tables": pairs}))
    if data.curves:
        curves = {"charts": learning_charts(data.curves), "names": list(data.curves)}
        sections.append(ReportSection("learning", "Learning curves", "charts", curves))
    else:
        missing.append(f"Learning curves: no folder holds {RUN_CURVES_FILE} (of h3data train) or {CURVES_FILE}.")
    sections.append(ReportSection("episodes", "All episodes", "episodes", {"tables": episode_tables(data)}))
    methods = {
        "profiles": list(dict.fromkeys(run.profile.name for run in data.runs)),
        "metrics": list(dict.fromkeys(m for run in data.runs for m in run.profile.metrics)),
        "remarks": remarks(data),
    }
    sections.append(ReportSection("methods", "What the numbers mean", "methods", methods))
    if missing:
        sections.append(ReportSection("absent", "Not in this report", "absent", {"lines": missing}))
    return Report(
        title=title,
        data=data,
        tables=(*tables, *more, *pairs),
        tables_of_partners=tuple(heat),
        missing=tuple(missing),
        html=render(
            "html_report/page/report.html",
            title=title,
            data=data,
            folder=folder,
            date=f"{date.today():%d %B %Y}",
            facts=facts(data),
            findings=findings(data),
            sections=sections,
            plans=list(plans.made.values()),
            command=command,
            version=own_version(),
        ),
        replays=tuple(files.written) if files is not None else (),
    )


def replay_folder(out: str | os.PathLike[str]) -> Path:
    """Return the folder for the replays of a report that is written to ``out``; it lies next to the report."""
    return Path(out).with_name(f"{Path(out).stem}_replays")


# --- sections ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class ReportSection:
    """Section of the report's page."""

    key: str
    """Anchor of the section in the page."""
    title: str
    layout: str
    """Macro of page/sections.html that renders the section."""
    content: Mapping[str, Any]
    """Arguments of the macro."""


def _paper_tables(data: ReportData, missing: list[str], studies: Mapping[str, StudyTables]) -> list[Table]:
    """Return the tables of all tasks, with those of ``studies`` by task; absent tables are added to ``missing``."""
    # tables of the paper's tasks come first, in its order, and say so if there are no episodes of them
    others = [task_table(task_name(t), data.of_task(t)) for t in data.tasks if t not in TASKS]
    of_studies = [table for study in studies.values() for table in study.tables]
    if len(others) == len(data.tasks):
        return [*others, *of_studies]  # of a study of another task nobody expects the paper's tables
    tables = []
    if runs := data.of_task(SOCIAL_NAV_PROFILE.tasks[0]):
        tables.append(social_nav_table(runs))
    else:
        missing.append("Social navigation: there are no episodes of it.")
    if runs := [
        run for run in data.of_task(REARRANGEMENT_PROFILE.tasks[0]) if not all(e.studied for e in run.episodes)
    ]:
        tables.append(rearrangement_table(runs))
    else:
        missing.append("Social rearrangement (train-pop and ZSC-pop): there are no episodes of it.")
    if not any(e.studied for e in data.episodes):
        missing.append("Human-in-the-loop study and its contrasts: no episodes of participants under conditions.")
    return [*tables, *of_studies, *others]


def _studies(data: ReportData, missing: list[str], model: StepsModel, failed: FailedEpisodes) -> dict[str, StudyTables]:
    """Return the tables of the episodes that participants did under conditions, by task."""
    studies = {}
    for task in data.tasks:
        if any(e.studied for run in data.of_task(task) for e in run.episodes):
            try:
                studies[task] = SECTIONS.get("study")(data.of_task(task), steps=model, failed=failed)
                why = studies[task].missing
            # a report without statistics is better than none
            except InputError as fault:  # the package of studies is not there
                why = str(fault).partition(" Hint:")[0].rstrip(".")
            if why:
                missing.append(f"Human-in-the-loop study in {task_name(task)}: {why}.")
    return studies


def _task_sections(
    task: str,
    runs: Sequence[Run],
    tables: Sequence[Table],
    partners: Sequence[Table],
    study: StudyTables | None,
    plans: Plans,
    missing: list[str],
    tail: str,
) -> list[ReportSection]:
    """Return all sections about the runs of one task, except key frames; titles end in ``tail``."""
    names = [run.name for run in runs]
    sections = []
    if table := next((t for t in tables if t.key == task), None):
        content: dict[str, Any] = {"table": table}
        if task == SOCIAL_NAV_PROFILE.tasks[0]:
            content |= {"charts": estimate_charts(runs), "names": names, "heading": "Compared with the paper"}
        sections.append(ReportSection(task, table.title, "table", content))
    if study is not None:
        for table in study.tables:
            content = {"table": table, "charts": study.charts.get(table.key, ())}
            sections.append(ReportSection(table.key, table.title + tail, "table", content))
    if partners:
        title = "Policies and partners" + tail
        sections.append(ReportSection(f"{task}-partners", title, "heat_maps", {"tables": partners}))
    else:
        # what a reader may look for in vain is listed at the end, with the reason
        missing.append(f"Policies by partner in {task_name(task)}: all episodes have the same partner.")
    plotted, which = trajectory_charts(runs, plans)
    paths = (
        f"{which}Paths of the robots are in the colour of their run, with a dot where each ended; paths of the people are "
        "grey."
    )
    for key, title, charts, lead in (
        (
            "spread",
            "Distributions",
            distribution_charts(runs),
            "Each bar counts episodes; the upright line is the mean.",
        ),
        ("time", "Over time", time_charts(runs), ""),
        ("plans", "Trajectories", plotted, paths),
    ):
        if charts or key == "spread":
            content = {"charts": charts, "names": names, "lead": lead}
            sections.append(ReportSection(f"{task}-{key}", title + tail, "charts", content))
    return sections
