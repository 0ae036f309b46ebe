"""Answers to questionnaires: means of each form by condition, and tables of all answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from h3data.stats import adjust_p_values, compare_paired, t_interval
from h3data_studies.design import Design, Form, Item
from h3data_studies.flow import CHECK, Stage
from h3data_studies.forms import score
from h3data_studies.store import Participant

Answers = dict[str, float | str]


@dataclass(frozen=True)
class FormMean:
    """Mean of a questionnaire over the participants who filled it in after a condition."""

    form: str
    condition: str
    mean: float
    low: float
    """Lower end of the 95% interval (Student's t); NaN with one participant."""
    high: float
    people: int


@dataclass(frozen=True)
class FormDifference:
    """Paired difference of a questionnaire's means between two conditions."""

    form: str
    first: str
    second: str
    difference: float
    low: float
    high: float
    p: float
    """The p-value of a paired permutation test, adjusted by Holm's method for the pairs of its form."""
    people: int


def filled(person: Participant) -> Iterator[tuple[Form, str, Answers]]:
    """Yield a participant's forms with their condition (empty for forms about no condition) and answers."""
    for _, form, condition, answers in filled_stages(person):
        yield form, condition, answers


def filled_stages(person: Participant) -> Iterator[tuple[Stage, Form, str, Answers]]:
    """Yield forms that a participant has filled in, with the stage of each."""
    progress = person.progress
    for stage in progress.stages:
        if stage.kind == "form" and stage.key in progress.rows:
            form, condition = progress.form_of(stage)
            yield stage, form, condition, progress.rows[stage.key]["answers"]


def form_means(design: Design, people: Sequence[Participant]) -> tuple[list[FormMean], list[FormDifference]]:
    """Return the means by condition of all forms with scales, and the paired differences between conditions."""
    given: dict[str, dict[str, dict[str, list[float]]]] = {}
    for person in people:
        for form, condition, answers in filled(person):
            value = score(form, answers)
            if condition and value is not None:  # questions after each episode are asked several times in a condition
                given.setdefault(form.id, {}).setdefault(condition, {}).setdefault(person.id, []).append(value)
    scores = {
        form: {name: {who: float(np.mean(values)) for who, values in by.items()} for name, by in conditions.items()}
        for form, conditions in given.items()
    }
    means, differences = [], []
    for form_id, by_condition in scores.items():
        names = [c.name for c in design.conditions if c.name in by_condition]
        for name in names:
            values = list(by_condition[name].values())
            low, high = t_interval(values) if len(values) > 1 else (float("nan"), float("nan"))
            means.append(FormMean(form_id, name, float(np.mean(values)), low, high, len(values)))
        pairs = []
        for first, second in combinations(names, 2):
            both = [who for who in by_condition[first] if who in by_condition[second]]
            found = compare_paired(
                {who: by_condition[first][who] for who in both},
                {who: by_condition[second][who] for who in both},
                method="permutation",
            )
            pairs.append(
                FormDifference(form_id, first, second, found.difference, found.low, found.high, found.p, len(both))
            )
        adjusted = adjust_p_values([pair.p for pair in pairs]) if pairs else ()
        differences += [replace(pair, p=float(p)) for pair, p in zip(pairs, adjusted, strict=True)]
    return means, differences


def answer_rows(people: Sequence[Participant], *, free_text: bool) -> list[list[str]]:
    """Return a header and one row per answer.

    Free text, which may identify people, is included only with ``free_text``.
    """
    rows = [["participant", "condition", "form", "item", "kind", "block", "trial", "right", "after", "answer"]]
    for person in people:
        for stage, form, condition, answers in filled_stages(person):
            items = {item.id: item for item in form.items}
            rows += [
                [
                    person.id,
                    condition,
                    form.id,
                    item,
                    items[item].kind,
                    str(stage.block) if condition else "",
                    str(stage.trial or ""),
                    _right(items[item], value),
                    form.after,
                    value if isinstance(value, str) else f"{value:g}",
                ]
                for item, value in answers.items()
                if free_text or items[item].kind != "text"
            ]
    return rows


def check_rows(people: Sequence[Participant]) -> list[list[str]]:
    """Return a header and one row per answer to a check, including answers before a retry."""
    rows = [["participant", "stage", "form", "attempt", "item", "answer", "right"]]
    for person in people:
        progress = person.progress
        for stage in progress.stages:
            form = progress.form_of(stage)[0] if stage.kind == "form" else None
            if form is None or not form.has_checks:
                continue
            keys = [*(key for key in progress.rows if key.startswith(f"{CHECK}/{stage.key}/")), stage.key]
            for data in (progress.rows[key] for key in keys if key in progress.rows):
                rows += [
                    [
                        person.id,
                        stage.key,
                        form.id,
                        str(data["attempt"]),
                        item.id,
                        f"{data['answers'].get(item.id, '')}",
                        _right(item, data["answers"].get(item.id)),
                    ]
                    for item in form.items
                    if item.right is not None
                ]
    return rows


def _right(item: Item, answer: float | str | None) -> str:
    return "" if item.right is None else str(int(item.is_right(answer)))
