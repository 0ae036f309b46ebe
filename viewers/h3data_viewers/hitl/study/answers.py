"""Answers to questionnaires: means of each form by condition, and all answers as a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from h3data.stats import adjust_p_values, compare_paired, t_interval
from h3data_viewers.hitl.study.design import Design, Form
from h3data_viewers.hitl.study.forms import forms_after, score
from h3data_viewers.hitl.study.store import Participant

Answers = dict[str, float | str]


@dataclass(frozen=True)
class FormMean:
    """Mean of a form over the participants who filled it in after a condition."""

    form: str
    condition: str
    mean: float
    low: float
    """Lower end of the 95% interval (Student's t); NaN with one participant."""
    high: float
    people: int


@dataclass(frozen=True)
class FormDifference:
    """Paired difference of a form between two conditions."""

    form: str
    first: str
    second: str
    difference: float
    low: float
    high: float
    p: float
    """Of a paired permutation test, adjusted by Holm's method for the pairs of its form."""
    people: int


def filled(design: Design, person: Participant) -> Iterator[tuple[Form, str, Answers]]:
    """A participant's forms with their condition (empty: of none) and answers."""
    for row, data in person.progress.rows.items():
        kind, *rest = row.split("/")
        if kind != "form":
            continue
        at_end = rest[0] == "end" and len(rest) == 2
        condition = person.progress.place.blocks[int(rest[0]) - 1].condition if len(rest) == 2 and not at_end else ""
        after = ("condition",) if condition else ("end",) if at_end else ("consent", "end")
        form = next(f for what in after for f in forms_after(design, what, condition) if f.id == data["form"])
        yield form, condition, data["answers"]


def form_means(design: Design, people: Sequence[Participant]) -> tuple[list[FormMean], list[FormDifference]]:
    """Means of all forms with scales by condition, and the paired differences of conditions."""
    scores: dict[str, dict[str, dict[str, float]]] = {}
    for person in people:
        for form, condition, answers in filled(design, person):
            value = score(form, answers)
            if condition and value is not None:
                scores.setdefault(form.id, {}).setdefault(condition, {})[person.id] = value
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
                {who: by_condition[first][who] for who in both}, {who: by_condition[second][who] for who in both},
                method="permutation",
            )  # fmt: skip
            pairs.append(
                FormDifference(form_id, first, second, found.difference, found.low, found.high, found.p, len(both))
            )
        adjusted = adjust_p_values([pair.p for pair in pairs]) if pairs else ()
        differences += [replace(pair, p=float(p)) for pair, p in zip(pairs, adjusted, strict=True)]
    return means, differences


def answer_rows(design: Design, people: Sequence[Participant], *, free_text: bool) -> list[list[str]]:
    """All answers, a row each, with a header; what people wrote themselves only with ``free_text``: it may say who they are."""
    rows = [["participant", "condition", "form", "item", "kind", "after", "answer"]]
    for person in people:
        for form, condition, answers in filled(design, person):
            kinds = {item.id: item.kind for item in form.items}
            rows += [
                [person.id, condition, form.id, item, kinds[item], form.after,
                 value if isinstance(value, str) else f"{value:g}"]
                for item, value in answers.items()
                if free_text or kinds[item] != "text"
            ]  # fmt: skip
    return rows
