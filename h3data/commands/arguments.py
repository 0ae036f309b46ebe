"""Arguments of jobs that are called from Python, such as `h3data.report`, and their conversion to a command.

The function of each job is in the same module as its command, which takes names and defaults of options from it
(`command_of`). Options for several values accept one value or a list.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from h3data.commands.command import Command

if TYPE_CHECKING:
    FilePath = str | os.PathLike[str]
    Paths = FilePath | Sequence[FilePath]
    Names = str | Sequence[str]


def result_of(command: type[Command], given: dict[str, Any]) -> Any:
    """Run a command with options given as Python values, and return its result."""
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
            # the caller's own traceback stays; only the words change
            error.args = (in_python_words(str(error), command), *error.args[1:])
        raise
