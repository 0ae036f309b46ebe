"""Markers of options that depend on the task, which state the tasks that have an option, and its meaning in each."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from h3data.commands.options import OfTasks, TaskNotes
from h3data.errors import H3DataError
from h3data.plugins import Registry

if TYPE_CHECKING:
    from sim_kinematic.tasks.task import Task

SKILL = "skill"
"""Name that commands accept instead of a task: a single skill of a robot."""
REMARKS: Mapping[str, str] = {
    "future_oracle": "knows their walk",
    "end_to_end": "sees by cameras",
    "end_to_end_paper": "sees by cameras",
    "plan_pop_3_pixels": "sees by a camera",
}
"""Remarks that follow the names of policies in parentheses."""
_NUMBERED = re.compile(r"(.*_)(\d+)")


def task_names() -> tuple[str, ...]:
    """Return the names of all tasks that are installed."""
    # not `task_registry`: the simulator is not imported for names
    return Registry("h3data.tasks", {}, what="task").names()


def of_tasks(test: Callable[[Task], object], *others: str) -> OfTasks:
    """Mark an option of the tasks that satisfy a test; ``others`` are names other than tasks that have it too."""

    def has(name: str) -> bool:
        task = _found(name)
        return name in others if name == SKILL else task is None or bool(test(task))

    return OfTasks(has)


def task_notes(note: Callable[[Task], str], **others: str) -> TaskNotes:
    """Mark an option with its meaning in each task; ``others`` are sentences for names other than tasks."""

    def said(name: str) -> str:
        task = _found(name)
        return others.get(name, "") if task is None else note(task)

    return TaskNotes(said)


def policies_of(kind: str, *, default: bool = True) -> TaskNotes:
    """Mark an option with the policies that agents of a kind have in each task, the default one first."""

    def listed(task: Task) -> str:
        from sim_kinematic.policies.assignment import policy_names

        first = task.defaults.get(kind, "")
        others = in_ranges([name for name in policy_names(task, kind) if name != first])
        names = [f"{name} ({REMARKS[name]})" if name in REMARKS else name for name in others]
        if default and kind == "robot" and task.usage.can_be_solo:
            names.append("solo (there is no robot)")
        return ", ".join([f"{first} (default)" if default else first, *names]) + "."

    return task_notes(listed)


def in_ranges(names: Sequence[str]) -> list[str]:
    """Return the names as text, in which three or more consecutive numbers are written as ``a_1 to a_3``."""
    runs: list[list[str]] = []
    for name in names:
        before, this = _NUMBERED.fullmatch(runs[-1][-1]) if runs else None, _NUMBERED.fullmatch(name)
        if before and this and before[1] == this[1] and int(this[2]) == int(before[2]) + 1:
            runs[-1].append(name)
        else:
            runs.append([name])
    return [text for run in runs for text in ([f"{run[0]} to {run[-1]}"] if len(run) > 2 else run)]


WITH_SKILLS = of_tasks(lambda task: task.control.has_skills)
"""Marker for options of tasks whose agents choose skills."""
PLAYED = of_tasks(lambda task: True)
"""Marker for options of all tasks, but not of single skills."""


def _found(name: str) -> Task | None:
    """Return the task of a name; None: it is none, or its package is not there, of which others tell."""
    from sim_kinematic.tasks.registry import find_task

    with suppress(H3DataError):
        return None if name == SKILL else find_task(name)
    return None
