"""Built-in questionnaires, and checks of answers to forms.

NASA-TLX: S. G. Hart and L. E. Staveland, "Development of NASA-TLX", 1988, without the pairwise weighting (raw TLX: S.
G. Hart, "NASA-Task Load Index (NASA-TLX); 20 Years Later", 2006): six scales from 0 to 100 in steps of 5. Fluency: the
subjective scales "human-robot fluency" and "robot relative contribution" of G. Hoffman, "Evaluating Fluency in
Human-Robot Collaboration", 2019. Trust: J.-Y. Jian, A. M. Bisantz, C. G. Drury, "Foundations for an Empirically
Determined Scale of Trust in Automated Systems", 2000, about "the robot" instead of "the system".
"""

from __future__ import annotations

import math
from typing import Any

from h3data_studies.design import Design, Form, Item
from h3data_studies.texts import in_all_languages

LONGEST_TEXT = 4000
"""Greatest length of a free-text answer [characters]."""


def _agree(name: str, text: str, *, reversed: bool = False) -> Item:
    return Item(id=name, text=text, low="Strongly disagree", high="Strongly agree", reversed=reversed)


def _trust(name: str, text: str, *, reversed: bool = False) -> Item:
    return Item(id=name, text=text, low="Not at all", high="Extremely", reversed=reversed)


def _load(name: str, title: str, question: str, low: str = "Very low", high: str = "Very high") -> Item:
    return Item(id=name, text=f"{title}: {question}", low=low, high=high, min=0, max=100, step=5)


_ENGLISH: dict[str, Form] = {
    "nasa_tlx": Form(
        title="How was the task?",
        text="Please rate the episodes that you have just played.",
        items=[
            _load("mental", "Mental demand", "How mentally demanding was the task?"),
            _load("physical", "Physical demand", "How physically demanding was the task?"),
            _load("temporal", "Temporal demand", "How hurried or rushed was the pace of the task?"),
            _load(
                "performance",
                "Performance",
                "How successful were you in accomplishing what you were asked to do?",
                "Perfect",
                "Failure",
            ),
            _load("effort", "Effort", "How hard did you have to work to accomplish your level of performance?"),
            _load("frustration", "Frustration", "How insecure, discouraged, irritated, stressed and annoyed were you?"),
        ],
    ),
    "fluency": Form(
        title="How did you work together?",
        text="How far do you agree with these statements about the episodes that you have just played?",
        items=[
            _agree("fluent", "The human-robot team worked fluently together."),
            _agree("improved", "The human-robot team's fluency improved over time."),
            _agree("contributed", "The robot contributed to the fluency of the interaction."),
            _agree("weight", "I had to carry the weight to make the human-robot team better.", reversed=True),
            _agree("equally", "The robot contributed equally to the team performance."),
            _agree("me", "I was the most important team member on the team.", reversed=True),
            _agree("robot", "The robot was the most important team member on the team."),
        ],
    ),
    "trust": Form(
        title="How do you feel about the robot?",
        text="Please rate the robot of the episodes that you have just played.",
        items=[
            _trust("deceptive", "The robot is deceptive.", reversed=True),
            _trust("underhanded", "The robot behaves in an underhanded manner.", reversed=True),
            _trust("suspicious", "I am suspicious of the robot's intent, action or outputs.", reversed=True),
            _trust("wary", "I am wary of the robot.", reversed=True),
            _trust("harmful", "The robot's actions will have a harmful or injurious outcome.", reversed=True),
            _trust("confident", "I am confident in the robot."),
            _trust("security", "The robot provides security."),
            _trust("integrity", "The robot has integrity."),
            _trust("dependable", "The robot is dependable."),
            _trust("reliable", "The robot is reliable."),
            _trust("can_trust", "I can trust the robot."),
            _trust("familiar", "I am familiar with the robot."),
        ],
    ),
}
BUILTIN = {name: in_all_languages(name, form) for name, form in _ENGLISH.items()}
"""Questionnaires by name. The German and Spanish words are our translations and have not been validated."""
ABOUT_ROBOT = ("fluency", "trust")
"""Names of built-in forms about the robot, which are omitted after conditions without a robot."""


def resolved(form: Form) -> Form:
    """Return a form with all its items: those of its built-in questionnaire, followed by its own.

    Its own title and text replace those of the built-in questionnaire.
    """
    if not form.builtin:
        return form
    base = BUILTIN[form.builtin]
    return Form(
        id=form.id or form.builtin,
        builtin=form.builtin,
        after=form.after,
        conditions=form.conditions,
        title=form.title or base.title,
        text=form.text or base.text,
        items=[*base.items, *form.items],
        attempts=form.attempts,
        fail=form.fail,
        again=form.again,
    )


def forms_after(design: Design, what: str, condition: str = "") -> list[Form]:
    """Return the forms that follow a stage: consent, tutorial, an episode, a condition, or the end of all conditions."""
    found = []
    for form in map(resolved, design.forms):
        if form.after != what or (condition and form.conditions and condition not in form.conditions):
            continue
        if condition and form.builtin in ABOUT_ROBOT and not form.conditions and design.condition(condition).is_solo:
            continue
        found.append(form)
    return found


def checked_answers(form: Form, answers: dict[str, Any]) -> tuple[dict[str, float | str], str]:
    """Return the valid answers to a form, and a sentence about the first invalid one."""
    taken: dict[str, float | str] = {}
    if unknown := set(answers) - {item.id for item in form.items}:
        return {}, f"There is no question {sorted(unknown)[0][:40]!r} in this form."
    for item in form.items:
        value = answers.get(item.id)
        if value is None or value == "":
            if item.required:
                return {}, "Please answer every question."
            continue
        if item.kind == "text":
            if not isinstance(value, str) or len(value) > LONGEST_TEXT:
                return {}, f"An answer is too long: at most {LONGEST_TEXT} characters."
            taken[item.id] = value
            continue
        low, high, step = (0, len(item.options) - 1, 1) if item.kind == "choice" else (item.min, item.max, item.step)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            return {}, "Expected a number as an answer."
        stepped = item.kind == "number" or math.isclose((value - low) / step, round((value - low) / step), abs_tol=1e-6)
        if not low <= value <= high or not stepped:
            return {}, f"Expected an answer from {low:g} to {high:g}."
        taken[item.id] = float(value)
    return taken, ""


def wrong_items(form: Form, answers: dict[str, float | str]) -> list[str]:
    """Return the names of a form's checks that its answers do not pass."""
    return [item.id for item in form.items if not item.is_right(answers.get(item.id))]


def right_answers(design: Design) -> dict[tuple[str, str], float]:
    """Return a right answer to each check of a study, by form and item."""
    found: dict[tuple[str, str], float] = {}
    for form in map(resolved, design.forms):
        for item in form.items:
            if item.right_answers is not None:
                found[form.id, item.id] = item.right_answers[0]
    return found


def score(form: Form, answers: dict[str, float | str]) -> float | None:
    """Return the mean of the scale answers, without checks and with reversed scales inverted; None without scales."""
    values = [
        item.min + item.max - float(answers[item.id]) if item.reversed else float(answers[item.id])
        for item in form.items
        if item.kind == "scale" and item.right is None and item.id in answers
    ]
    return sum(values) / len(values) if values else None
