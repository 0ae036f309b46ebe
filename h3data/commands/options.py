"""Options of a command, read off the fields of its dataclass, and their values from text."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import re
import shlex
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import tyro

from h3data.commands.command import Command
from h3data.errors import H3DataError, InputError, suggest

_NOT_KEPT = ("out", "workers", "executor", "resume", "force", "json", "dry_run", "mcap", "share_scenes")
"""Options that do not decide what is in the dataset."""
_FOLDERS = re.compile(r"(?<![\w.~-])[/~](?:[^/,\s:]*/)+")
_POSITIONAL = get_args(tyro.conf.Positional[str])[1]
Repeatable = tyro.conf.UseAppendAction
"""An option of any number of values takes one each time it is given: ``--camera A --camera B``. With all of them after one
flag, it would swallow the positional argument behind it."""


@dataclass(frozen=True)
class Option:
    """One field of a command."""

    field: str
    flags: tuple[str, ...]
    """``-o``, ``--out``; empty for a positional argument."""
    required: bool
    kind: Any
    """Type of one value, without None."""
    count: int | None
    """Number of values, None for any number."""
    metadata: tuple[Any, ...]
    """Markers of tyro."""

    @property
    def name(self) -> str:
        return "/".join(self.flags) or self.field.upper()

    @property
    def word_type(self) -> Any:
        """Type for assigning words to the option without reading them: flags are read, values stay text."""
        if self.kind is bool:
            return _annotated(bool, self.metadata)
        if self.count is None and self.flags:
            return _annotated(Repeatable[tuple[str, ...]], self.metadata)
        return _annotated(str if self.count == 1 else tuple[str, ...], self.metadata)


def _annotated(kind: Any, metadata: tuple[Any, ...]) -> Any:
    return Annotated[(kind, *metadata)] if metadata else kind


@functools.cache
def options_of(command: type[Command]) -> tuple[Option, ...]:
    hints = get_type_hints(command, include_extras=True)
    return tuple(_option(field, hints[field.name]) for field in dataclasses.fields(cast(Any, command)))


def _option(field: dataclasses.Field[Any], annotation: Any) -> Option:
    metadata = getattr(annotation, "__metadata__", ())
    kind = get_args(annotation)[0] if metadata else annotation
    count: int | None = 1
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (k for k in get_args(kind) if k is not NoneType)
    if get_origin(kind) is tuple:
        count = None if get_args(kind)[-1] is ... else len(get_args(kind))
        kind = get_args(kind)[0]
    if kind is not bool and get_origin(kind) is not Literal and kind not in KINDS:
        raise TypeError(
            f"Options must be bool, int, float, str, Path, Literal, or tuples of these; {field.name} is {kind}."
        )
    flags: tuple[str, ...] = ()
    if _POSITIONAL not in metadata:
        aliases = [alias for m in metadata for alias in getattr(m, "aliases", None) or ()]
        flags = (*aliases, f"--{field.name.replace('_', '-')}")
    required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    return Option(field.name, flags, required, kind, count, metadata)


def read_value(option: Option, given: Any) -> Any:
    """The value of an option from its words.

    Raises:
        ValueError: they are not of its type; the message says what was expected and what came.
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
    return tuple(map(read, given))


def check_value(option: Option, value: Any) -> None:
    """Check one value that Python gives, as `read_value` does of words.

    Raises:
        InputError: it is not of the option's type.
    """
    if get_origin(option.kind) is Literal:
        choices = get_args(option.kind)
        if value not in choices:
            raise InputError(f"{option.field}: unknown {value!r}.{suggest(str(value), map(str, choices))}")
        return
    types, expected = _PYTHON_TYPES[option.kind]
    if not isinstance(value, types) or (isinstance(value, bool) and option.kind is not bool):
        raise InputError(f"{option.field}: expected {expected}, got {value!r}.")


_PYTHON_TYPES: dict[Any, tuple[tuple[type, ...], str]] = {
    bool: ((bool,), "True or False"),
    int: ((Integral,), "a whole number"),
    float: ((Real,), "a number"),
    str: ((str,), "text"),
    Path: ((str, os.PathLike), "a path"),
}


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


# --- options in messages ----------------------------------------------------------------------------------------------
# Commands name options as the shell does (--resume), the packages below them as Python does (resume=True). Both reach users
# of both, so they are translated where they leave: here, once, instead of two texts in hundreds of messages.
_AS_FORCE = {"overwrite": "force"}
"""Parameters of functions that a command offers under another name."""
_IN_PYTHON = re.compile(r"(?<![\w.-])([a-z]\w*)=(?:True\b|\[([A-Z]+)\]|([A-Z]+)\b|(?=[\s,;:)]|\.(?:\s|$)|$))")
_IN_SHELL = re.compile(r"(h3data [a-z]+ [^.;)`]*)|(?<![\w-])(--?[a-z][a-z-]*)(?:[ =]([A-Z]+\b|\d[\d.]*\b(?!\.)))?")
_OTHER_OUT = re.compile(r"\banother -o\b")


def in_shell_words(message: str, command: type[Command]) -> str:
    """Return a message with the options of the command as the shell names them: ``resume=True`` becomes ``--resume``."""
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


def in_python_words(message: str, command: type[Command]) -> str:
    """Return a message with the options of the command as Python names them: ``--resume`` becomes ``resume=True``.

    Whole commands, such as ``h3data motion import --fps 120``, stay.
    """
    by_flag = {flag: option for option in options_of(command) for flag in option.flags}

    def as_parameter(found: re.Match[str]) -> str:
        option = by_flag.get(found[2])
        if found[1] or option is None:
            return found[0]
        if option.kind is bool:
            return f"{option.field}=True" + (f" {found[3]}" if found[3] else "")
        return f"{option.field}={found[3]}" if found[3] else option.field

    message = message.replace("the same command", "the same call")
    return _IN_SHELL.sub(as_parameter, message.replace("overwrite=True", "force=True"))


def command_line(name: str, command: Command) -> str:
    """The command as it is typed, without options that change nothing in its result; folders outside are cut off paths,
    as datasets are given to others."""
    assert dataclasses.is_dataclass(command)
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


def run_from_python(command: type[Command], options: dict[str, Any], *, several: tuple[str, ...] = ()) -> Any:
    """Runs a command with options as Python has them: paths as text, lists instead of tuples, one path for several."""
    values: dict[str, Any] = {}
    for option in options_of(command):
        if option.field not in options:
            continue
        value = options[option.field]
        one = isinstance(value, str) or hasattr(value, "__fspath__")
        if option.field in several and one:
            value, one = [value], False
        if value is None:
            continue
        if option.count != 1 and (one or not isinstance(value, Iterable)):
            raise InputError(f"{option.field}: expected a list, as [{value!r}], got {value!r}.")
        value = value if option.count == 1 else tuple(value)
        for each in (value,) if option.count == 1 else value:
            check_value(option, each)
        if option.count == 1:
            values[option.field] = Path(str(value)) if option.kind is Path else value
        else:
            values[option.field] = tuple(map(Path, map(str, value)) if option.kind is Path else value)
    try:
        return command(**values).run().result
    except (H3DataError, KeyboardInterrupt) as error:
        if error.args:
            error.args = (in_python_words(str(error), command), *error.args[1:])
        raise
