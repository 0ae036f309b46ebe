"""Record of the commands that made a dataset, stored in ``h3/commands.json``."""

from __future__ import annotations

import json
from collections.abc import Sequence

from h3data.recording.parquet.files import write_atomic
from h3data.recording.storage import AnyPath

FILE = "commands.json"


def write_commands(root: AnyPath, commands: Sequence[str]) -> None:
    """Store the commands that made a dataset, in order."""
    write_atomic(root / "h3" / FILE, json.dumps({"commands": list(commands)}, indent=1, ensure_ascii=False).encode())


def read_commands(root: AnyPath) -> list[str]:
    """Return the commands that made a dataset; empty if none are recorded."""
    try:
        found = json.loads((root / "h3" / FILE).read_bytes())["commands"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [command for command in found if isinstance(command, str)]
