"""Job files for ``--config``, which hold the options of a command as TOML, so that it can be run again."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from h3data.commands.options import RENAMED, Option
from h3data.errors import InputError, suggest


def read_job_file(path: Path, options: Sequence[Option]) -> dict[str, Any]:
    """Return the command-line words of each option that a job file sets, by field.

    Keys are the names of options and positional arguments, with dashes or underscores: ``episodes = 20``,
    ``cameras = ["robot_arm", "third_person"]``, ``task = "social_nav"``.

    Raises:
        InputError: the file cannot be read, or one of its keys is not an option of the command.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            f"There is no such file. Expected a TOML file of options after --config: {path}", code="H3-OPTION-062"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            f"Expected a TOML file of options after --config ({error}): {path}", code="H3-OPTION-063"
        ) from None
    by_name = {
        name: option for option in options for name in map(_key, option.flags or (option.field,)) if len(name) > 1
    }
    words: dict[str, Any] = {}
    for key, value in table.items():
        option = by_name.get(_key(key))
        if option is None:
            if _key(now := RENAMED.get(f"--{_key(key)}", "")) in by_name:
                raise InputError(f"{key} is {_key(now)} now. File: {path}", code="H3-OPTION-077")
            known = list(by_name)
            raise InputError(
                f"Unknown option {key!r} in {path}.{suggest(key, known, lead='Expected some of')}", code="H3-OPTION-064"
            )
        words[option.field] = _words(option, value, key, path)
    return words


def _key(name: str) -> str:
    """Return an option as a key: ``human-walk`` of ``--human-walk`` and of ``human_walk``."""
    return name.lstrip("-").replace("_", "-")


def _words(option: Option, value: Any, key: str, path: Path) -> Any:
    if option.kind is bool:
        if not isinstance(value, bool):
            raise InputError(f"Expected true or false for {key!r}, got {value!r}: {path}", code="H3-OPTION-065")
        return value
    values = value if isinstance(value, list) else [value]
    if not all(isinstance(each, str | int | float) and not isinstance(each, bool) for each in values):
        raise InputError(f"Expected text or numbers for {key!r}, got {value!r}: {path}", code="H3-OPTION-060")
    if option.count != 1:
        return tuple(map(str, values))
    if len(values) != 1:
        raise InputError(f"Expected one value for {key!r}, got {len(values)}: {path}", code="H3-OPTION-061")
    return str(values[0])
