"""The commands that made a dataset, kept in ``h3/commands.json``."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Sequence
from dataclasses import is_dataclass

from h3data.recording.parquet.files import write_atomic
from h3data.recording.storage import AnyPath
from h3data_pipelines.command import Command
from h3data_pipelines.options import options_of

FILE = "commands.json"
_NOT_KEPT = ("out", "workers", "executor", "resume", "force", "json", "dry_run", "mcap", "share_scenes")
"""Options that do not decide what is in the dataset."""
_FOLDERS = re.compile(r"(?<![\w.~-])[/~](?:[^/,\s:]*/)+")


def command_line(name: str, command: Command) -> str:
    """The command as it is typed, without options that change nothing in its result; folders outside are cut off paths,
    as datasets are given to others."""
    assert is_dataclass(command)
    words = ["h3data", *name.split()]
    for option in options_of(type(command)):
        value, default = getattr(command, option.field), type(command).__dataclass_fields__[option.field].default
        if option.field in _NOT_KEPT or (option.flags and value == default):
            continue
        values = [value] if option.count == 1 else list(value)
        for each in values:
            text = [] if option.kind is bool else [_FOLDERS.sub("", str(each))]
            words += [*option.flags[-1:], *text]
    return shlex.join(words)


def write_commands(root: AnyPath, commands: Sequence[str]) -> None:
    """Keeps the commands, the first one first."""
    write_atomic(root / "h3" / FILE, json.dumps({"commands": list(commands)}, indent=1, ensure_ascii=False).encode())


def read_commands(root: AnyPath) -> list[str]:
    """The commands that made a dataset; none if nothing is known."""
    try:
        found = json.loads((root / "h3" / FILE).read_bytes())["commands"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [command for command in found if isinstance(command, str)]
