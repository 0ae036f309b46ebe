"""``h3data study report`` and ``h3data study compare``: what a study has found."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.errors import InputError
from h3data.files import part_file
from h3data.terminal import counted
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_folder, write_text
from h3data_pipelines.studies.fitting import FailedOption, StepsModelOption
from h3data_pipelines.studies.managing import REPORT

if TYPE_CHECKING:
    from h3data_viewers.hitl.study.design import Design
    from h3data_viewers.hitl.study.store import Participant
    from h3data_viewers.html_report.report_tables import Table


@dataclass(frozen=True)
class StudyReport:
    """Write the report of a study: the paper's table, its contrasts, questionnaires.

    CR, TS, RC and RE with mixed models and post-hoc comparisons, as in Habitat 3.0; episodes during which the machine was too
    slow are left out, and counted. Writes report.html, study.json and answers.csv.

    Examples:
        h3data study report study.toml
        h3data study report study.toml --everybody --failed limit -o out/
    """

    study: tyro.conf.Positional[Path]
    """The study file, or the study's folder."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder to write to (default: report in the study's folder, which h3data study forget keeps free of who is forgotten)."""
    everybody: bool = False
    """Also those who have not finished."""
    free_text: bool = False
    """Also what participants wrote themselves; it may say who they are."""
    model: StepsModelOption = "auto"
    failed: FailedOption = "leave-out"
    pictures: int = 6
    """Number of episodes shown with key frames."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data.metrics import StudyModel, analyse_study, find_profile, measure_files
        from h3data_viewers.hitl.study.answers import answer_rows, form_means
        from h3data_viewers.hitl.study.files import open_store, open_study
        from h3data_viewers.html_report.report import write_report

        folder, design = open_study(self.study)
        people = finished(list(open_store(folder, design).participants.values()), everybody=self.everybody)
        files, left_out = usable_recordings(folder, design, people)
        model = StudyModel(steps=self.model, failed=self.failed)
        table = measure_files(files)
        notes = [f"{counted(count, 'episode')} left out: {why}." for why, count in left_out.items()]
        notes += _bots(people)
        try:
            analysis = analyse_study(table.episodes, find_profile(table.profile, table.episodes[0].task), model)
            text, found = analysis.to_text(), analysis.to_dict()
        except InputError as fault:  # one condition, or one participant: there is nothing to compare
            text, found = table.to_text(), None
            notes.append(f"No comparison of conditions: {str(fault).partition(' Hint:')[0]}")
        out = folder / REPORT if self.out is None else self.out
        claim_folder(out, force=self.force or self.out is None)
        forms = _forms_table(design, people)
        title = f"{design.name}, version {design.version}" + (" (scripted participants)" if _bots(people) else "")
        write_report(
            files, out / "report.html", title=title, pictures=self.pictures, study=model, more=[forms] if forms else []
        )
        means, differences = form_means(design, people)
        data = {
            "study": design.name,
            "version": design.version,
            "participants": len(people),
            "analysis": found,
            "forms": [vars(m) for m in means],
            "form_differences": [vars(d) for d in differences],
            "notes": notes,
        }
        write_text(out / "study.json", json.dumps(_plain(data), indent=2) + "\n")
        with part_file(out / "answers.csv") as part, part.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(answer_rows(design, people, free_text=self.free_text))
        blocks = [text, _forms_text(means, differences), "\n".join(notes), f"{out / 'report.html'}"]
        return Outcome(text="\n\n".join(filter(None, blocks)), data={**data, "out": str(out)}, result=out)


@dataclass(frozen=True)
class StudyCompare:
    """Put the order of partners by people beside that by automatic evaluation.

    For the claim that ends the paper: do both put the robots in the same order? Conditions are matched with the robots of
    h3data evaluate by the name of their policy.

    Examples:
        h3data evaluate rearrange --policies complement,same_object --keep -o out/zsc
        h3data study compare study.toml out/zsc
    """

    study: tyro.conf.Positional[Path]
    """The study file, or the study's folder."""
    automatic: tyro.conf.Positional[Path]
    """Folder of h3data evaluate, or recordings of the same policies with other partners."""
    everybody: bool = False
    """Also participants who have not finished."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data_viewers.hitl.study.files import open_store, open_study
        from h3data_viewers.html_report.report_data import gather
        from h3data_viewers.html_report.report_ranks import rank_table
        from h3data_viewers.html_report.report_study import studied
        from h3data_viewers.html_report.report_tables import to_markdown

        folder, design = open_study(self.study)
        people = finished(list(open_store(folder, design).participants.values()), everybody=self.everybody)
        files, _ = usable_recordings(folder, design, people)
        policies = [c.partner for c in design.conditions if c.partner and not c.is_solo]
        data = gather([*files, self.automatic])
        runs = [
            replace(run, episodes=tuple(_by_policy(e) for e in run.episodes))
            for run in data.runs
        ]  # fmt: skip
        tables = [t for task in data.tasks if (t := rank_table([run for run in runs if run.task == task])) is not None]
        if not tables:
            automatic = sorted({e.policy or run.name for run in runs for e in run.episodes if not studied(e)})
            raise InputError(
                f"Expected two or more policies that are both in the study ({', '.join(policies) or 'none'}) and in "
                f"the automatic evaluation ({', '.join(automatic) or 'none'}). Hint: h3data evaluate rearrange --policies "
                f"{','.join(policies)} -o {self.automatic}"
            )
        text = "\n\n".join([*map(to_markdown, tables), *_bots(people)])
        return Outcome(text=text, data={"tables": [_table_data(table) for table in tables]}, result=tables)


def finished(people: Sequence[Participant], *, everybody: bool) -> list[Participant]:
    """Participants whose data count.

    Raises:
        InputError: there are none.
    """
    from h3data_viewers.hitl.study.flow import COMPLETE

    kept = sorted((p for p in people if everybody or p.progress.status == COMPLETE), key=lambda p: p.number)
    if not kept:
        raise InputError(
            f"Nobody has finished this study yet; {counted(len(people), 'participant')} began. Hint: --everybody counts "
            "those too."
        )
    return kept


def usable_recordings(folder: Path, design: Design, people: Sequence[Participant]) -> tuple[list[Path], Counter[str]]:
    """Recordings of participants whose episodes can be used, and why how many others are left out.

    Raises:
        InputError: there are none.
    """
    from h3data_viewers.hitl.study.orders import recording_path
    from h3data_viewers.hitl.study.overview import played, usable

    files: list[Path] = []
    left_out: Counter[str] = Counter()
    for person in people:
        for episode in played(person):
            path = recording_path(folder, person.id, episode.row)
            why = usable(design, episode) or ("" if path.is_file() else "the recording is missing")
            if why:
                left_out[why] += 1
            else:
                files.append(path)
    if not files:
        raise InputError(f"There is no episode to report on: {dict(left_out) or 'none has been played'}.")
    return files, left_out


def _by_policy(episode: Any) -> Any:
    """The episode, its condition called by the robot's policy; files of weights by their name and digest, wherever they lie."""
    policy = re.sub(r"^weights:.*/", "weights:", episode.policy)
    return replace(episode, policy=policy, condition=policy or episode.condition if episode.condition else "")


def _bots(people: Sequence[Participant]) -> list[str]:
    from h3data_viewers.hitl.study.overview import is_bot

    bots = sum(map(is_bot, people))
    return [f"{bots} of {counted(len(people), 'participant')} are scripts (bots), no people."] if bots else []


def _forms_text(means: Sequence[Any], differences: Sequence[Any]) -> str:
    from h3data.metrics.table import aligned

    if not means:
        return ""
    lines = [["form", "condition", "mean", "95% interval", "participants"]]
    lines += [[m.form, m.condition, f"{m.mean:.2f}", f"[{m.low:.2f}, {m.high:.2f}]", str(m.people)] for m in means]
    blocks = [aligned(lines)]
    if differences:
        lines = [["form", "paired difference", "", "95% interval", "p (Holm)"]]
        lines += [
            [d.form, f"{d.first} - {d.second}", f"{d.difference:.2f}", f"[{d.low:.2f}, {d.high:.2f}]", f"{d.p:.4f}"]
            for d in differences
        ]
        blocks.append(aligned(lines))
    return "\n\n".join(blocks)


def _forms_table(design: Design, people: Sequence[Participant]) -> Table | None:
    from h3data_viewers.hitl.study.answers import form_means
    from h3data_viewers.html_report.report_tables import Cell, Column, Row, Section, Table, mean_cell

    means, differences = form_means(design, people)
    if not means:
        return None
    forms = list(dict.fromkeys(m.form for m in means))
    cells = {(m.condition, m.form): mean_cell(m.mean, m.low, m.high, digits=2) for m in means}
    names = [c.name for c in design.conditions if any(m.condition == c.name for m in means)]
    rows = tuple(
        Row(name=name, cells=tuple(cells.get((name, form), Cell(text="–")) for form in forms)) for name in names
    )
    notes = [
        f"{d.form}, {d.first} − {d.second}: {d.difference:.2f} [{d.low:.2f}, {d.high:.2f}], p {d.p:.4f} "
        f"(paired permutation test, Holm, {counted(d.people, 'participant')})."
        for d in differences
    ]
    return Table(
        key="forms", title="Questionnaires", name_head="Condition", columns=tuple(Column(head=form) for form in forms),
        caption="Mean score of each questionnaire over participants with 95 % intervals; reversed items are turned round.",
        sections=(Section(title="", rows=rows),), notes=tuple(notes),
    )  # fmt: skip


def _table_data(table: Table) -> dict[str, Any]:
    heads = [column.head for column in table.columns]
    return {
        "key": table.key,
        "rows": {
            row.name: dict(zip(heads, (cell.text for cell in row.cells), strict=True))
            for section in table.sections
            for row in section.rows
        },
        "notes": list(table.notes),
    }


def _plain(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and value != value else value
