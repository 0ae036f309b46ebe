"""The words after ``h3data``: which command they name, what its options are, and in one line what is wrong with them."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.metadata
import inspect
import io
import math
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, NoReturn, cast, get_args, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from h3data.errors import InputError, did_you_mean
from h3data_pipelines.command import Command, Group, NameOf

_CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)
_SILENT = ("None", "False", "", "''")
"""Defaults that say nothing: an option that is not given is not given."""

_registry = ConstructorRegistry()


def parse(args: Sequence[str], commands: Mapping[str, type[Command] | Group], *, about: str) -> Command:
    """The command that ``args`` ask for, with its options. Help and the version are printed and leave by `SystemExit`.

    Raises:
        InputError: there is no such command or option, one is missing, or a value is of another kind.
    """
    if list(args) == ["--version"]:
        _leave(f"h3data {importlib.metadata.version('h3data')}")
    prog, words = "h3data", list(args)
    while True:
        if not words or words[0] in ("-h", "--help"):
            _leave(_overview(prog, about, commands))
        chosen = commands.get(words[0])
        if chosen is None:
            _refuse(prog, words[0], commands)
        prog, words = f"{prog} {words[0]}", words[1:]
        if not isinstance(chosen, Group):
            return _options(chosen, prog, words)
        about, commands = chosen.about, chosen.commands


def _options(command: type[Command], prog: str, words: list[str]) -> Command:
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            found, unknown = tyro.cli(
                _quiet(command), args=words, prog=prog, description=inspect.getdoc(command), config=_CONFIG,
                return_unknown_args=True, registry=_registry,
            )  # fmt: skip
    except SystemExit as end:
        if end.code in (0, None):
            raise
        raise InputError(f"{_unboxed(box.getvalue())} See: {prog} --help") from None
    if unknown:
        flags = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(cast(Any, command))]
        word = next((w for w in unknown if w.startswith("-")), unknown[0])
        what = "option" if word.startswith("-") else "argument"
        near = did_you_mean(word.partition("=")[0], flags) if what == "option" else ""
        raise InputError(f"Unknown {what} {word!r}.{near} See: {prog} --help")
    return found


@functools.cache
def _quiet(command: type[Command]) -> Any:
    """The command, whose help keeps defaults that say something and leaves out the others."""
    for name, kind in get_type_hints(command, include_extras=True).items():
        names = next((extra for extra in getattr(kind, "__metadata__", ()) if isinstance(extra, NameOf)), None)
        if names is not None:
            kind = Annotated[kind, _text_of(names.names())]
        hint = tyro.conf.arg(help_behavior_hint=lambda label: "" if label in _SILENT else f"(default: {label})")
        command.__annotations__[name] = Annotated[kind, hint]
    return command


def _unboxed(text: str) -> str:
    """What a box of tyro says is wrong, on one line: from below its title to the first rule, without the help of options."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    lines = [
        re.sub("[─╭╮╰╯│]", lambda edge: "-" if edge[0] == "─" else " ", line)[2:].rstrip()
        for line in plain.splitlines()
    ]
    rules = [k for k, line in enumerate(lines) if re.fullmatch("-{3,}", line.strip())]
    body = lines[2 if rules[:1] == [1] else 1 : next((k for k in rules if k > 1), None)]
    told, named = [], []
    for line in body:
        indent = len(line) - len(line.lstrip())
        (named if indent == 4 else told).append(line if indent < 8 else "")
    found = " ".join(" ".join([*told, " and ".join(map(str.strip, filter(None, named)))]).split())
    found = found.removeprefix("Error parsing ").removesuffix(".").removesuffix(". Expected 1 values")
    return f"{found[:1].upper()}{found[1:]}."


def _refuse(prog: str, word: str, commands: Mapping[str, Any]) -> NoReturn:
    if word.startswith("-"):
        raise InputError(f"Expected a command before {word}: {prog} COMMAND {word}. See: {prog} --help")
    raise InputError(f"Unknown command {word!r}.{did_you_mean(word, commands)} Expected one of: {', '.join(commands)}.")


# --- help -------------------------------------------------------------------------------------------------------------
def _leave(text: str) -> NoReturn:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
    raise SystemExit(0)


def _overview(prog: str, about: str, commands: Mapping[str, type[Command] | Group]) -> str:
    """All commands with a line or two on each."""
    width = min(shutil.get_terminal_size().columns, 120)
    wide = max(map(len, commands))
    rows = [
        textwrap.fill(
            _first_sentence(command), width, initial_indent=f"  {name:<{wide}}  ", subsequent_indent=" " * (wide + 4)
        )
        for name, command in commands.items()
    ]  # fmt: skip
    examples = [f"    {_first_example(c)}" for c in commands.values() if not isinstance(c, Group)][:4]
    return "\n".join(
        [
            f"usage: {prog} COMMAND ...", "", about, "", "commands:", *rows, "", "Examples:", *examples, "",
            f"Options and more examples: {prog} COMMAND --help. Every command prints one JSON object with --json.",
        ]
    )  # fmt: skip


def _first_sentence(command: type[Command] | Group) -> str:
    text = command.about if isinstance(command, Group) else inspect.getdoc(command) or ""
    return re.split(r"(?<=\.)\s", " ".join(text.split("\n\n")[0].split()))[0]


def _first_example(command: type[Command]) -> str:
    return (inspect.getdoc(command) or "").partition("Examples:\n")[2].strip().partition("\n")[0]


# --- values -----------------------------------------------------------------------------------------------------------
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


_KINDS: dict[Any, tuple[str, Any]] = {
    int: ("INT", _whole),
    float: ("NUMBER", _number),
    str: ("TEXT", str),
    Path: ("PATH", _path),
}


def _text_of(names: Iterable[str]) -> PrimitiveConstructorSpec[str]:
    """A text whose help shows ``names``; what else it may be is for the command to judge."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(names)}}}",
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
    )


@_registry.primitive_rule
def _value(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Numbers, texts and paths, some of one kind, or None where the option is not given: ``None`` is no word for it."""
    kinds = [kind for kind in get_args(info.type) or (info.type,) if kind is not NoneType]
    if len(set(kinds)) != 1 or kinds[0] not in _KINDS:
        return None
    kind, (metavar, read) = kinds[0], _KINDS[kinds[0]]
    if info.type_origin is tuple:
        return PrimitiveConstructorSpec(
            nargs=len(kinds), metavar=" ".join([metavar] * len(kinds)), instance_from_str=lambda words: tuple(map(read, words)),
            is_instance=lambda value: isinstance(value, tuple), str_from_instance=lambda value: list(map(str, value)),
        )  # fmt: skip
    return PrimitiveConstructorSpec(
        nargs=1, metavar=metavar, instance_from_str=lambda words: read(words[0]),
        is_instance=lambda value: value is None or isinstance(value, kind), str_from_instance=lambda value: [str(value)],
    )  # fmt: skip
