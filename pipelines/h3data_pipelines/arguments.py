"""What `h3data.generate` and the other jobs of Python take, and how they become commands.

The function of each job stands beside its command, which has its names and defaults from there (`command_of`). Where there may
be several things, one or a list is accepted; where a thing has a name or a path, so is the thing: a `Robot`, the class of a
policy or a task, a path.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from h3data.commands.command import Command

if TYPE_CHECKING:
    from h3data.bodies import Robot
    from sim_kinematic.policies.policy import Policy
    from sim_kinematic.tasks.task import Task

    FilePath = str | os.PathLike[str]
    Paths = FilePath | Sequence[FilePath]
    Names = str | Sequence[str]
    Body = FilePath | Robot
    Agents = str | Sequence[str | Robot]
    Scenes = FilePath | Sequence[FilePath]
    PolicyChoice = str | type[Policy] | Callable[[], Policy]
    """Name of a policy, ``weights:FILE``, ``module:name``, or a class or function that makes one for each episode."""
    Policies = PolicyChoice | Sequence[PolicyChoice]
    TaskChoice = str | type[Task]
    Rules = Mapping[str, Any] | Sequence[str]
    """Rules of a task by name, such as ``{"objects": 3}``."""


def result_of(command: type[Command], given: dict[str, Any]) -> Any:
    """Runs a command with options as Python has them."""
    from h3data.commands.options import check_task, in_python_words, options_of, python_value
    from h3data.errors import H3DataError

    options = [option for option in options_of(command) if given.get(option.field) is not None]
    values = {option.field: python_value(option, given[option.field]) for option in options}
    try:
        defaults = vars(command)
        check_task(command, values.get("task", ""), [n for n, v in values.items() if v != defaults.get(n)])
        return command(**values).run().result
    except (H3DataError, KeyboardInterrupt) as error:
        if error.args:
            error.args = (in_python_words(str(error), command), *error.args[1:])
        raise
