"""Commands ``h3data study report`` and ``h3data study compare``: the results of a study."""

from __future__ import annotations

import csv
import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.command import (
    FailedOption,
    ForceFlag,
    JsonFlag,
    Outcome,
    StepsModelOption,
    claim_folder,
    write_text,
)
from h3data.commands.options import command_line
from h3data.errors import InputError
from h3data.files import part_file, spreadsheet_cell
from h3data.recording.records import STEP_NS
from h3data.terminal import counted
from h3data_studies.commands.managing import REPORT

if TYPE_CHECKING:
    from h3data.metrics import EpisodeMetrics
    from h3data_studies.design import Design
    from h3data_studies.exclusions import Exclusions
    from h3data_studies.overview import PlayedEpisode
    from h3data_studies.store import Participant
    from h3data_viewers.html_report.episode import ReportEpisode
    from h3data_viewers.html_report.tables import Table


@dataclass(frozen=True)
class StudyReport:
    """Write the report of a study: the paper's table, its contrasts, and questionnaires.

    CR, TS, RC and RE are analysed with mixed models and post-hoc comparisons, as in Habitat 3.0. Episodes during which
    the machine was too slow are excluded and counted, and so are participants and episodes that the study file's rules
    ([[exclude]]) exclude. The command writes report.html and study.json. It also writes participants.csv, answers.csv,
    checks.csv, focus.csv and trials.csv (a row for each episode), with the data of all participants. Without usable
    episodes, only report.html is missing.

    Examples:
        h3data study report study.toml
        h3data study report study.toml --everybody --failed limit -o out/
    """

    study: tyro.conf.Positional[Path]
    """Study file, or the study's folder."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder to write to (default: the folder report in the study's folder, from which h3data study forget also deletes
    participants)."""
    everybody: bool = False
    """Include participants who have not finished."""
    free_text: bool = False
    """Include free text of participants, which may identify them."""
    model: StepsModelOption = "auto"
    failed: FailedOption = "leave-out"
    pictures: int = 6
    """Number of episodes shown with key frames."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Measure the study's recordings and write the report."""
        from h3data.metrics import find_profile, measure_files
        from h3data_studies.analysis import StudyModel, analyse_study
        from h3data_studies.answers import answer_rows, check_rows, form_means
        from h3data_studies.exclusions import exclusions, focus_rows
        from h3data_studies.files import open_store, open_study
        from h3data_viewers.html_report.report import make_report

        folder, design = open_study(self.study)
        everyone = sorted(open_store(folder, design).participants.values(), key=lambda p: p.number)
        people = finished(everyone, everybody=self.everybody)
        rules = exclusions(design, people)
        used = [person for person in people if person.id not in rules.people]
        files, left_out = usable_recordings(folder, design, used, rules)
        out = folder / REPORT if self.out is None else self.out
        claim_folder(out, force=self.force or self.out is None)
        # before anything is measured: what people have answered does not hang on how their episodes went
        write_rows(out / "answers.csv", answer_rows(people, free_text=self.free_text))
        write_rows(out / "checks.csv", check_rows(everyone))
        write_rows(out / "focus.csv", focus_rows(everyone))
        write_rows(out / "participants.csv", participant_rows(design, everyone))
        write_rows(out / "trials.csv", trial_rows(folder, design, people, [], rules))
        notes = [f"{counted(count, 'episode')} left out: {why}." for why, count in left_out.items()]
        notes += _rule_notes(design, rules, people)
        notes += _bots(people)
        model, page = StudyModel(steps=self.model, failed=self.failed), out / "report.html"
        text, found = "", None
        try:
            table = measure_files(files) if files else None
        except InputError as fault:
            table = None
            notes.append(f"No table of the episodes: {fault}")
        if table is not None:
            write_rows(out / "trials.csv", trial_rows(folder, design, people, table.episodes, rules))
            try:
                analysis = analyse_study(table.episodes, find_profile(table.profile, table.episodes[0].task), model)
                text, found = analysis.to_text(), analysis.to_dict()
            except InputError as fault:  # one condition, or one participant: there is nothing to compare
                text = table.to_text()
                notes.append(f"No comparison of conditions: {str(fault).partition(' Hint:')[0]}")
            more = [t for t in (_forms_table(design, used), _rules_table(design, rules)) if t is not None]
            title = f"{design.name}, version {design.version}" + (" (scripted participants)" if _bots(people) else "")
            report = make_report(
                files,
                title=title,
                pictures=self.pictures,
                study_model=self.model,
                failed=self.failed,
                more=more,
                folder=folder,
                command=command_line("study report", self),
            )
            report.write(page)
        else:
            page.unlink(missing_ok=True)  # of an earlier report
            notes.append("No report.html: it needs an episode that can be used.")
        means, differences = form_means(design, used)
        data = {
            "study": design.name,
            "version": design.version,
            "participants": len(used),
            "excluded": rules.people,
            "excluded_by_rule": rules.counts,
            "analysis": found,
            "forms": [vars(m) for m in means],
            "form_differences": [vars(d) for d in differences],
            "notes": notes,
        }
        write_text(out / "study.json", json.dumps(_plain(data), indent=2) + "\n")
        names = ("participants.csv", "answers.csv", "checks.csv", "focus.csv", "trials.csv", "study.json")
        made = [out / name for name in names] + [page] * (table is not None)
        blocks = [text, _forms_text(means, differences), "\n".join(notes), "\n".join(map(str, made))]
        return Outcome(text="\n\n".join(filter(None, blocks)), data={**data, "out": str(out)}, result=out)


@dataclass(frozen=True)
class StudyCompare:
    """Compare the ranking of partners by people with that by automatic evaluation.

    This tests the final claim of the paper, that both put the robots in the same order. Conditions are matched with the
    robots of h3data evaluate by the name of their policy, and weights files by their digest.

    Examples:
        h3data evaluate rearrange --policies complement,same_object --save-recordings -o out/zsc
        h3data study compare study.toml out/zsc
    """

    study: tyro.conf.Positional[Path]
    """Study file, or the study's folder."""
    automatic: tyro.conf.Positional[Path]
    """Folder of h3data evaluate, or recordings of the same policies with other partners."""
    everybody: bool = False
    """Include participants who have not finished."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return a table of both rankings and their agreement."""
        from h3data_studies.analysis.ranks import rank_table
        from h3data_studies.exclusions import exclusions
        from h3data_studies.files import open_store, open_study
        from h3data_viewers.html_report.data import gather
        from h3data_viewers.html_report.tables import to_markdown

        folder, design = open_study(self.study)
        people = finished(list(open_store(folder, design).participants.values()), everybody=self.everybody)
        rules = exclusions(design, people)
        people = [person for person in people if person.id not in rules.people]
        files, left_out = usable_recordings(folder, design, people, rules)
        if not files:
            raise InputError(
                f"No episode of people can be used: {dict(left_out) or 'none has been played'}.", code="H3-STUDY-010"
            )
        policies = [c.partner for c in design.conditions if c.partner and not c.is_solo]
        data = gather([*files, self.automatic])
        stamped = any(e.policy.startswith("weights:") for e in data.episodes)
        names = _shipped() if stamped else {}
        runs = [replace(run, episodes=_by_policy(run.episodes, names)) for run in data.runs]
        tables = [t for task in data.tasks if (t := rank_table([run for run in runs if run.task == task])) is not None]
        if not tables:
            automatic = sorted({e.policy or run.name for run in runs for e in run.episodes if not e.studied})
            raise InputError(
                f"Expected two or more policies that are both in the study ({', '.join(policies) or 'none'}) and in "
                f"the automatic evaluation ({', '.join(automatic) or 'none'}). Hint: h3data evaluate rearrange --policies "
                f"{','.join(policies)} -o {self.automatic}",
                code="H3-STUDY-011",
            )
        text = "\n\n".join([*map(to_markdown, tables), *_bots(people)])
        return Outcome(text=text, data={"tables": [_table_data(table) for table in tables]}, result=tables)


def finished(people: Sequence[Participant], *, everybody: bool) -> list[Participant]:
    """Return the participants whose data count: all with ``everybody``, else those who have finished.

    Raises:
        InputError: no participant has finished.
    """
    from h3data_studies.flow import COMPLETE

    kept = sorted((p for p in people if everybody or p.progress.status == COMPLETE), key=lambda p: p.number)
    if not kept:
        raise InputError(
            f"Nobody has finished this study yet; {counted(len(people), 'participant')} began. Hint: --everybody counts "
            "those too.",
            code="H3-STUDY-009",
        )
    return kept


def usable_recordings(
    folder: Path, design: Design, people: Sequence[Participant], rules: Exclusions
) -> tuple[list[Path], Counter[str]]:
    """Return the recordings of usable episodes of participants, and the number of unusable ones by reason."""
    from h3data_studies.overview import played

    reasons: dict[
        Path, str
    ] = {}  # an episode that two have played together is one, and left out if it is for one of them
    for person in people:
        for episode in played(person):
            path, why = _recorded(folder, design, episode, rules)
            reasons[path] = reasons.get(path) or why
    left_out = Counter(why.partition(" (")[0] for why in reasons.values() if why)
    return [path for path, why in reasons.items() if not why], left_out


def _recorded(folder: Path, design: Design, episode: PlayedEpisode, rules: Exclusions) -> tuple[Path, str]:
    """Return where an episode is recorded, and why it cannot be used; empty if it can."""
    from h3data_studies.orders import recording_path
    from h3data_studies.overview import usable

    path = recording_path(folder, "_".join(episode.pair or (episode.participant,)), episode.row)
    why = next((rules.people[who] for who in (episode.participant, *episode.pair) if who in rules.people), "")
    why = why or rules.trials.get((episode.participant, episode.row))
    return path, why or usable(design, episode) or ("" if path.is_file() else "the recording is missing")


def participant_rows(design: Design, people: Sequence[Participant]) -> list[list[str | float]]:
    """Return a header and a row for each participant of any status, with all facts that exclusion rules can use."""
    from h3data_studies.exclusions import PARTICIPANT_MEASURES, exclusions, participant_measures
    from h3data_studies.overview import is_bot, played

    rules = exclusions(design, people)
    head: list[str | float] = ["participant", "bot", "status", "reason", "language", "episodes", *PARTICIPANT_MEASURES]
    rows: list[list[str | float]] = [[*head, "excluded"]]
    for person in people:
        progress, measured = person.progress, participant_measures(person)
        rows.append(
            [
                person.id,
                int(is_bot(person)),
                progress.status,
                progress.reason,
                person.language,
                len(played(person)),
                *(round(measured[name], 6) for name in PARTICIPANT_MEASURES),
                rules.people.get(person.id, ""),
            ]
        )
    return rows


def _rule_notes(design: Design, rules: Exclusions, people: Sequence[Participant]) -> list[str]:
    from h3data_studies.exclusions import rule_text

    if not design.exclude:
        return []
    kinds = {"participant": "participant", "trial": "episode"}
    return [
        f"{len(rules.people)} of {counted(len(people), 'participant')} left out by rules written beforehand.",
        *(
            f"Rule {r.name}: {counted(rules.counts[r.name], kinds[r.of])} left out. {rule_text(r)}."
            for r in design.exclude
        ),
    ]


def trial_rows(
    folder: Path, design: Design, people: Sequence[Participant], measured: Sequence[EpisodeMetrics], rules: Exclusions
) -> list[list[str | float]]:
    """Return a header and a row for each episode that was played, whether the report uses it or not.

    ``order`` counts a participant's episodes, ``block`` their conditions and ``trial`` the episodes of a block, all
    from 1; ``ended_at`` is in UTC, and ``late_steps`` is the number of steps that the machine could not play in time.
    ``completed`` is the answer to the question at the end of an episode, ``problems`` the number of reported problems.
    The metrics of ``measured``, empty where they are undefined, and the answers to questions after each episode
    (``form.item``, no free text) come last.
    """
    from h3data_studies.answers import filled_stages
    from h3data_studies.exclusions import trial_measures
    from h3data_studies.overview import is_bot, played

    found = {(m.participant, m.condition, m.episode_id): m.values for m in measured}  # nobody plays an episode twice
    metrics = list(dict.fromkeys(name for values in found.values() for name in values))
    answered = {
        (person.id, stage.block, stage.trial, f"{form.id}.{item}"): value
        for person in people
        for stage, form, _, answers in filled_stages(person)
        if stage.after == "trial"
        for item, value in answers.items()
        if not isinstance(value, str)
    }
    questions = list(dict.fromkeys(name for *_, name in answered))
    head = ["participant", "bot", "order", "block", "trial", "condition", "partner", "scene", "episode", "ended_at"]
    rows: list[list[str | float]] = [
        [
            *head,
            "seconds",
            "ended",
            "steps",
            "late_steps",
            "away_s",
            "completed",
            "problems",
            "left_out",
            "recording",
            *metrics,
            *questions,
        ]
    ]
    for person in people:
        for number, e in enumerate(played(person), 1):
            block = person.progress.place.blocks[e.block - 1]
            path, why = _recorded(folder, design, e, rules)
            when = datetime.fromtimestamp(person.times[e.row], UTC).isoformat(timespec="seconds")
            who = "+".join(e.pair) or person.id
            values = found.get((who, e.condition, str(block.episodes[e.trial - 1])), {})
            rows.append(
                [
                    person.id,
                    int(is_bot(person)),
                    number,
                    e.block,
                    e.trial,
                    e.condition,
                    design.condition(e.condition).partner or "",
                    block.scene,
                    block.episodes[e.trial - 1],
                    when,
                    round(e.steps * STEP_NS * 1e-9, 3),
                    e.ended,
                    e.steps,
                    e.slipped,
                    trial_measures(person, e)["away_s"],
                    next((str(remark["answer"]) for remark in e.remarks if "answer" in remark), ""),
                    sum("answer" not in remark for remark in e.remarks),
                    why,
                    str(path.relative_to(folder)) if path.is_file() else "",
                    *("" if (v := values.get(name, math.nan)) != v else float(v) for name in metrics),
                    *(answered.get((person.id, e.block, e.trial, name), "") for name in questions),
                ]
            )
    return rows


def write_rows(path: Path, rows: Sequence[Sequence[str | float]]) -> None:
    """Write rows to a CSV file, with cells escaped so that spreadsheets do not run them as formulas."""
    with part_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([spreadsheet_cell(cell) for cell in row] for row in rows)


_STAMPED = re.compile(r"weights:(?:.*/)?(?P<file>[^/]+)@(?P<digest>[0-9a-f]{12})(?P<light>@baked|@flat|)")


def _by_policy(episodes: Sequence[ReportEpisode], names: dict[str, str]) -> tuple[ReportEpisode, ...]:
    """Rename the conditions of episodes to the robots' policies.

    The same weights have the same name, wherever their file lies; ``names`` has the name of each digest that was met
    before.
    """
    found = []
    for e in episodes:
        policy = e.policy
        if stamp := _STAMPED.fullmatch(policy):
            plays = stamp["digest"] + stamp["light"]
            policy = names.setdefault(plays, f"weights:{stamp['file']}@{plays}")
        found.append(replace(e, policy=policy, condition=policy or e.condition if e.condition else ""))
    return tuple(found)


def _shipped() -> dict[str, str]:
    """Return the names of the policies of the package by the digest of their weights."""
    from sim_kinematic.policies.learned import SHIPPED, network_of

    return {network_of(name).digest[:12]: name for name in SHIPPED}


def _bots(people: Sequence[Participant]) -> list[str]:
    from h3data_studies.overview import is_bot

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
    from h3data_studies.answers import form_means
    from h3data_viewers.html_report.tables import Cell, Column, Row, Section, Table, mean_cell

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
        key="forms",
        title="Questionnaires",
        name_head="Condition",
        columns=tuple(Column(head=form) for form in forms),
        caption="Mean score of each questionnaire over participants with 95% intervals; reversed items are turned round.",
        sections=(Section(title="", rows=rows),),
        notes=tuple(notes),
    )


def _rules_table(design: Design, rules: Exclusions) -> Table | None:
    from h3data_studies.exclusions import rule_text
    from h3data_viewers.html_report.tables import Cell, Column, Row, Section, Table

    if not design.exclude:
        return None
    rows = tuple(
        Row(name=rule.name, cells=(Cell(text=rule_text(rule)), Cell(text=str(rules.counts[rule.name]))))
        for rule in design.exclude
    )
    notes = [f"{who}: {why}." for who, why in rules.people.items()]
    return Table(
        key="exclusions",
        title="Left out by rules",
        name_head="Rule",
        columns=(Column(head="leaves out"), Column(head="count")),
        caption="Rules that were part of the study file before anybody took part. The tables beside the report have everybody, "
        "with the reason.",
        sections=(Section(title="", rows=rows),),
        notes=tuple(notes),
    )


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
    """Return JSON types without NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and value != value else value
