"""Lookup of tasks by name: entry points of the group ``h3data.tasks``, and ``module:Class``."""

from __future__ import annotations

from functools import cache
from typing import Any

from h3data.errors import InputError
from h3data.plugins import Registry
from sim_kinematic.tasks.task import Task


@cache
def task_registry() -> Registry[Any]:
    """Return all tasks by name."""
    return Registry("h3data.tasks", {}, what="task")


def find_task(task: str | Task | type[Task]) -> Task:
    """Return the task with this name or ``module:Class``, of this class, or the task itself if it is one.

    Raises:
        InputError: There is no such task, or the name does not refer to a task.
    """
    if isinstance(task, Task):
        return task
    return _checked(task(), task.__qualname__) if isinstance(task, type) else _find(task)


@cache
def _find(name: str) -> Task:
    made = task_registry().get(name)
    if isinstance(made, type) and issubclass(made, Task):
        made = made()
    return _checked(made, name)


def _checked(made: Any, name: str) -> Task:
    if not isinstance(made, Task):
        raise InputError(
            f"Expected {name!r} to name a subclass of sim_kinematic.tasks.task.Task, got {made!r}.", code="H3-TASK-031"
        )
    if not made.name:
        raise InputError(f"The task {name!r} has no name. Hint: set the class attribute name.", code="H3-TASK-032")
    return made


def reference_of(task: Task) -> str:
    """Return ``module:Class`` for a task that cannot be found by its name; empty for other tasks."""
    kind = type(task)
    # whatever goes wrong with the name, an entry point that fails included, the reference still finds the task
    try:
        known = type(find_task(task.name)) is kind
    except Exception:
        known = False
    return "" if known else f"{kind.__module__}:{kind.__qualname__}"
