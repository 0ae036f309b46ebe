"""Parsing of option values from the words of a command line, and messages in terms of the shell."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from h3data.commands.command import Command
from h3data.commands.options import Option, options_of, split_list


def _listed(option: Option, words: Iterable[str]) -> list[str]:
    """Return all values of a list option; each word may contain several.

    A path with a comma in its name is one value if it exists.
    """
    listed: list[str] = []
    for word in words:
        parts = [word] if option.kind is Path and os.path.exists(word) else split_list(word)
        if not parts:
            raise ValueError("expected at least one value, got an empty text")
        listed += parts
    return listed


def read_value(option: Option, given: Any) -> Any:
    """Return the value of an option, parsed from its words on the command line.

    Raises:
        ValueError: the words do not match the option's type; the message states the expected and the given value.
    """
    if option.kind is bool:
        return given
    if get_origin(option.kind) is Literal:
        read: Callable[[str], Any] = functools.partial(_choice, get_args(option.kind))
    else:
        read = KINDS[option.kind][1]
    if option.count == 1:
        return read(given)
    if option.count is not None and len(given) != option.count:
        raise ValueError(f"expected {option.count} values, got {len(given)}")
    return tuple(map(read, _listed(option, given) if option.is_list else given))


def _choice(choices: tuple[Any, ...], text: str) -> Any:
    for choice in choices:
        if text == str(choice):
            return choice
    raise ValueError(f"expected one of {', '.join(map(str, choices))}, got {text!r}")


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"expected a whole number, got {text!r}") from None


def _number(text: str) -> float:
    with contextlib.suppress(ValueError):
        if math.isfinite(value := float(text)):
            return value
    raise ValueError(f"expected a number, got {text!r}")


def _path(text: str) -> Path:
    if not text:
        raise ValueError("expected a path, got an empty text")
    return Path(text)


KINDS: dict[Any, tuple[str, Callable[[str], Any]]] = {
    int: ("INT", _whole),
    float: ("NUMBER", _number),
    str: ("TEXT", str),
    Path: ("PATH", _path),
}


_AS_FORCE = {"overwrite": "force"}
"""Parameters of functions that a command offers under another name."""


_IN_PYTHON = re.compile(r"(?<![\w.-])([a-z]\w*)=(?:True\b|\[([A-Z]+)\]|([A-Z]+)\b|(?=[\s,;:)]|\.(?:\s|$)|$))")


_OTHER_OUT = re.compile(r"\banother -o\b")


def in_shell_words(message: str, command: type[Command]) -> str:
    """Return a message in which options are named as in a shell, e.g. ``--resume`` instead of ``resume=True``."""
    by_field = {option.field: option for option in options_of(command)}

    def as_flag(found: re.Match[str]) -> str:
        name = _AS_FORCE.get(found[1], found[1])
        option = by_field.get(name)
        if option is None or not option.flags:
            return found[0]
        return " ".join(filter(None, (option.flags[-1], found[2] or found[3])))

    out = by_field.get("out")
    if out is not None and not out.flags:
        message = _OTHER_OUT.sub("another OUT", message)
    return _IN_PYTHON.sub(as_flag, message)
