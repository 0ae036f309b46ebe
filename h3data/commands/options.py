"""Options of a command, from the fields of its dataclass, and their values from text."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import tyro

from h3data.commands.command import Command, NameOf
from h3data.errors import InputError, suggest

T = TypeVar("T")
RENAMED = {
    "--hold": "--action-repeat",
    "--human-walk": "--rules",
    "--init": "--warm-start",
    "--light": "--person-detail",
    "--keep": "--save-recordings",
    "--lod": "--low-detail",
    "--play-as": "--as",
    "--rule": "--set",
    "--walk": "--rules",
    "--without": "--ablate",
    "--zsc": "--unseen-partners",
}
"""Options of earlier versions and their present names. The old names are refused with a message that states the new
one."""
Repeatable = tyro.conf.UseAppendAction
"""Option that takes one value each time it is given: ``--camera A --camera B``. With several values after one flag, it
would consume a following positional argument."""


@dataclass(frozen=True)
class OfTasks:
    """Marker of an option that only some tasks have; other tasks refuse it and do not list it in their help.

    A task that is given as ``module:Class`` may have it."""

    has: Callable[[str], bool]
    """Function that returns whether the option applies to the task with a name."""


@dataclass(frozen=True)
class TaskNotes:
    """Marker of an option whose meaning depends on the task: the help of each task adds a sentence about it."""

    note: Callable[[str], str]
    """Function that returns the sentence for the name of a task, or an empty text."""


@dataclass(frozen=True)
class Option:
    """Option of a command: one of its fields."""

    field: str
    flags: tuple[str, ...]
    """Names of the option: ``-o``, ``--out``; ``--camera``, ``--cameras`` if it takes several values; empty for a
    positional argument."""
    required: bool
    kind: Any
    """Type of one value, without None."""
    count: int | None
    """Number of values, None for any number."""
    metadata: tuple[Any, ...]
    """Annotations of the option for tyro."""

    @property
    def name(self) -> str:
        """Name of the option in messages: its flags, or the field in capitals for a positional argument."""
        return "/".join(self.flags) or self.field.upper()

    @property
    def word_type(self) -> Any:
        """Type for assigning words to the option without parsing them: flags are parsed, values stay text."""
        if self.kind is bool:
            return annotated(bool, self.metadata)
        if self.count is None and self.flags:
            return annotated(Repeatable[tuple[str, ...]], self.metadata)
        return annotated(str if self.count == 1 else tuple[str, ...], self.metadata)

    @property
    def is_list(self) -> bool:
        """Return whether the option takes any number of values, as ``--camera A --camera B`` or ``--cameras A,B``."""
        return self.count is None and bool(self.flags)

    @property
    def of_tasks(self) -> OfTasks | None:
        """Marker that restricts the option to some tasks; None if all have it."""
        return next((mark for mark in self.metadata if isinstance(mark, OfTasks)), None)

    def note(self, task: str) -> str:
        """Return the sentence that describes the option in a task; empty if its meaning is the same in all tasks."""
        return next((mark.note(task) for mark in self.metadata if isinstance(mark, TaskNotes)), "")


def annotated(kind: Any, metadata: tuple[Any, ...]) -> Any:
    """Return the type of the option annotated with its markers."""
    return Annotated[(kind, *metadata)] if metadata else kind


@functools.cache
def options_of(command: type[Command]) -> tuple[Option, ...]:
    """Return the options of a command, in the order of its fields."""
    hints = get_type_hints(command, include_extras=True)
    return tuple(
        _option(
            field.name,
            hints[field.name],
            required=field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING,
        )
        for field in dataclasses.fields(cast(Any, command))
    )


@dataclass_transform(kw_only_default=True, frozen_default=True)
def command_of(function: Callable[..., Any]) -> Callable[[type[T]], type[T]]:
    """Make the command-line command of a function of `h3data`, with the names and defaults of its parameters.

    The class adds types of single words, help, and options such as ``--json`` that exist only on the command line. Its
    fields have no defaults where the function has a parameter of that name.

    Raises:
        TypeError: a parameter has no field, or a field that the function does not have lacks a default.
    """

    def decorate(cls: type[T]) -> type[T]:
        hints = get_type_hints(cls, include_extras=True)
        for name, parameter in inspect.signature(function).parameters.items():
            if name not in hints or hasattr(cls, name):
                raise TypeError(f"Expected a field {name} without a default in {cls.__name__}.")
            if parameter.default is not parameter.empty:
                option = _option(name, hints[name], required=False)
                nothing = () if option.count is None else None
                given = parameter.default
                setattr(cls, name, nothing if given is None else python_value(option, given))
        # after the defaults are set: a dataclass reads them when it is made
        return dataclass(frozen=True, kw_only=True)(cls)

    return decorate


def _option(name: str, annotation: Any, *, required: bool) -> Option:
    metadata = getattr(annotation, "__metadata__", ())
    kind = get_args(annotation)[0] if metadata else annotation
    count: int | None = 1
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (k for k in get_args(kind) if k is not NoneType)
    if get_origin(kind) is tuple:
        count = None if get_args(kind)[-1] is ... else len(get_args(kind))
        kind = get_args(kind)[0]
    # a command with another type would fail only when somebody gives the option
    if kind is not bool and get_origin(kind) is not Literal and kind not in _PYTHON_TYPES:
        raise TypeError(f"Options must be bool, int, float, str, Path, Literal, or tuples of these; {name} is {kind}.")
    flags: tuple[str, ...] = ()
    if get_args(tyro.conf.Positional[str])[1] not in metadata:
        aliases = [alias for m in metadata for alias in getattr(m, "aliases", None) or ()]
        named = next((m.name for m in metadata if getattr(m, "name", None)), None)
        flag = named or name.replace("_", "-")
        # --camera as well as --cameras, --policy as well as --policies
        if count is None and named is None and flag.endswith("s"):
            one = f"--{flag[:-3]}y" if flag.endswith("ies") else f"--{flag[:-1]}"
            metadata = (*metadata, tyro.conf.arg(aliases=[*aliases, one]))
            aliases.append(one)
        flags = (*aliases, f"--{flag}")
    return Option(name, flags, required, kind, count, metadata)


def split_list(text: str) -> list[str]:
    """Split a text at commas into values; commas within brackets and quotes belong to a value."""
    parts, depth, quoted = [""], 0, False
    for character in text:
        # values may be JSON: --set near_m=[2.0,1.5]
        quoted ^= character == '"'
        depth += 0 if quoted else (character in "([{") - (character in ")]}")
        if character == "," and depth <= 0 and not quoted:
            parts.append("")
        else:
            parts[-1] += character
    return [part for part in map(str.strip, parts) if part]


def known_tasks(command: type[Command]) -> tuple[str, ...]:
    """Return the names that the argument ``task`` of a command accepts, except ``module:Class``.

    The result is empty if the command has no such argument.
    """
    marks = (mark for o in options_of(command) if o.field == "task" for mark in o.metadata if isinstance(mark, NameOf))
    return tuple(name for mark in marks for name in mark.names())


def check_task(command: type[Command], task: str, given: Iterable[str]) -> None:
    """Raise an error if an option is set that the task does not have.

    ``given`` are the fields that are set.

    Raises:
        InputError: a set option belongs to other tasks.
    """
    fields = set(given)
    marked = [(o, o.of_tasks) for o in options_of(command) if o.field in fields and o.of_tasks is not None]
    tasks = known_tasks(command) if marked else ()
    strangers = [(option, mark) for option, mark in marked if task in tasks and not mark.has(task)]
    if strangers:
        listed = ", ".join(f"{option.flags[-1]} (of {_few([*filter(mark.has, tasks)])})" for option, mark in strangers)
        raise InputError(f"These are no options of {task}: {listed}.", code="H3-OPTION-076")


def _few(tasks: list[str]) -> str:
    """Return names as text, of more than three only the first two and a number."""
    *first, last = tasks if len(tasks) < 4 else [*tasks[:2], f"{len(tasks) - 2} others"]
    return " and ".join(filter(None, (", ".join(first), last)))


def python_value(option: Option, value: Any) -> Any:
    """Return the value of an option from a Python value: one value or several, paths as text, and objects by their names.

    Raises:
        InputError: the value does not have the option's type.
    """
    if option.count == 1:
        return _one(option, value)
    # rules={"objects": 3} is --set objects=3
    if isinstance(value, Mapping):
        value = [f"{name}={json.dumps(each)}" for name, each in value.items()]
    if isinstance(value, str) or not isinstance(value, Iterable):
        value = [value]
    return tuple(_one(option, each) for each in value)


def _one(option: Option, value: Any) -> Any:
    """Return one value: a class or function by ``module:name``, a robot by its file, text instead of a path."""
    if get_origin(option.kind) is Literal:
        choices = get_args(option.kind)
        if value not in choices:
            raise InputError(
                f"{option.field}: unknown {value!r}.{suggest(str(value), map(str, choices))}", code="H3-OPTION-014"
            )
        return value
    if option.kind is str and not isinstance(value, str):
        value = _name_of(value)
    types, expected = _PYTHON_TYPES[option.kind]
    # a bool is an int in Python: workers=True is a mistake
    if not isinstance(value, types) or (isinstance(value, bool) and option.kind is not bool):
        raise InputError(f"{option.field}: expected {expected}, got {value!r:.100}.", code="H3-OPTION-013")
    return Path(str(value)) if option.kind is Path else value


def _name_of(thing: Any) -> Any:
    """Return the text by which a command knows an object; itself if there is none."""
    if isinstance(thing, os.PathLike):
        return os.fspath(thing)
    if isinstance(thing, type) or inspect.isfunction(thing):
        module = thing.__module__
        if module == "__main__" and (script := getattr(sys.modules["__main__"], "__file__", None)):
            module = Path(script).stem  # recordings name it, and other processes import it
            # a script's class is called __main__:Name, which another process would look up in its own script
            sys.modules.setdefault(module, sys.modules["__main__"])  # which must not run again in this one
        return f"{module}:{thing.__qualname__}"
    from h3data.bodies import Robot, robot_name

    return robot_name(thing) if isinstance(thing, Robot) else thing


_PYTHON_TYPES: dict[Any, tuple[tuple[type, ...], str]] = {
    bool: ((bool,), "True or False"),
    int: ((Integral,), "a whole number"),
    float: ((Real,), "a number"),
    str: ((str,), "a name or path"),
    Path: ((str, os.PathLike), "a path"),
}


# --- options in messages ----------------------------------------------------------------------------------------------


def in_python_words(message: str, command: type[Command]) -> str:
    """Return a message in which options are written as in Python: ``--resume`` becomes ``resume=True``.

    Whole commands, such as ``h3data motion import --fps 120``, are unchanged.
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
    # commands name options as the shell does (--resume), the packages below them as Python does (resume=True).
    # Both reach users of both, so they are translated where they leave: here, once, instead of two texts in
    # hundreds of messages.
    in_shell = re.compile(r"(h3data [a-z]+ [^.;)`]*)|(?<![\w-])(--?[a-z][a-z-]*)(?:[ =]([A-Z]+\b|\d[\d.]*\b(?!\.)))?")
    return in_shell.sub(as_parameter, message.replace("overwrite=True", "force=True"))


def command_line(name: str, command: Command) -> str:
    """Return the command line that repeats a command, without options that do not affect its result.

    Paths are shortened to their last part where they lead outside the working folder, because the line is stored in
    datasets that may be published.
    """
    assert dataclasses.is_dataclass(command)
    words = ["h3data", *name.split()]
    # options that do not decide what is in the dataset
    elsewhere = ("out", "workers", "executor", "resume", "force", "json", "dry_run", "mcap", "share_scenes")
    folders = re.compile(r"(?<![\w.~-])[/~](?:[^/,\s:]*/)+")
    for option in options_of(type(command)):
        value, default = getattr(command, option.field), type(command).__dataclass_fields__[option.field].default
        if option.field in elsewhere or (option.flags and value == default):
            continue
        values = [value] if option.count == 1 else list(value)
        texts = [folders.sub("", str(each)) for each in values]
        # joined by commas where that is read back as the same values
        if option.is_list and split_list(joined := ",".join(texts)) == texts:
            texts = [joined]
        # a single value is written with the flag in the singular
        flag = (
            option.flags[-2:-1] if len(values) == 1 and len(option.flags) > 1 and option.is_list else option.flags[-1:]
        )
        for text in texts:
            words += [*flag, *([] if option.kind is bool else [text])]
    return shlex.join(words)
