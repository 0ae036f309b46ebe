"""Parses the words after ``h3data``: the command, its options, and one line about what is wrong with them."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.metadata
import inspect
import math
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NoReturn, Union, cast, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from h3data.errors import InputError, did_you_mean
from h3data_pipelines.command import Command, Group, NameOf

_CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)
_POSITIONAL = get_args(tyro.conf.Positional[str])[1]
_SILENT = ("None", "False", "", "''")
"""Defaults that help leaves out: they only mean that the option is not given."""
_ABSENT = "\0"
"""Default of options while words are assigned to them; no word on a command line can hold it."""

_registry = ConstructorRegistry()


def parse(args: Sequence[str], commands: Mapping[str, type[Command] | Group], *, about: str) -> Command:
    """The command that ``args`` name, with its options. Help and the version are printed and end in `SystemExit`.

    Raises:
        InputError: there is no such command or option, one is missing, or a value has the wrong type.
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
            return _parse_options(chosen, prog, words)
        about, commands = chosen.about, chosen.commands


# --- options ----------------------------------------------------------------------------------------------------------
@dataclasses.dataclass(frozen=True)
class _Option:
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
        plain = bool if self.kind is bool else str if self.count == 1 else tuple[str, ...]
        return Annotated[(plain, *self.metadata)] if self.metadata else plain


def _parse_options(command: type[Command], prog: str, words: list[str]) -> Command:
    """The command with its options.

    tyro assigns the words to the fields and prints help. Its errors are boxes of text for a terminal, and the hook that
    would give them as objects (``tyro._errors``) is private and unstable. So it never sees an error: fields are optional
    texts while words are assigned, then values are read and missing ones reported here, in one line.
    """
    cli = functools.partial(tyro.cli, prog=prog, config=_CONFIG)
    if {"-h", "--help"} & set(words):
        cli(_documented(command), args=["--help"], description=inspect.getdoc(command), registry=_registry)
    options, see = _options(command), f"See: {prog} --help"
    try:
        texts, unknown = cli(_unread(command), args=words, return_unknown_args=True, console_outputs=False)
    except SystemExit:  # all fields are optional: only the value of an option can be missing
        raise InputError(f"{_valueless(options, words)} {see}") from None
    if unknown:
        _refuse_option(unknown, options, see)
    given = {o.field: text for o in options if (text := getattr(texts, o.field)) not in (_ABSENT, ())}
    if missing := [o.name for o in options if o.required and o.field not in given and o.count is not None]:
        raise InputError(f"Missing from {prog}: {' and '.join(missing)}. {see}")
    values = {o.field: () for o in options if o.required}  # any number of values may be none
    for option in options:
        if option.field in given:
            try:
                values[option.field] = _read(option, given[option.field])
            except ValueError as error:
                raise InputError(f"{option.name}: {error}. {see}") from None
    return command(**values)


@functools.cache
def _options(command: type[Command]) -> tuple[_Option, ...]:
    hints = get_type_hints(command, include_extras=True)
    return tuple(_option(field, hints[field.name]) for field in dataclasses.fields(cast(Any, command)))


def _option(field: dataclasses.Field[Any], annotation: Any) -> _Option:
    metadata = getattr(annotation, "__metadata__", ())
    kind = get_args(annotation)[0] if metadata else annotation
    count: int | None = 1
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (k for k in get_args(kind) if k is not NoneType)
    if get_origin(kind) is tuple:
        count = None if get_args(kind)[-1] is ... else len(get_args(kind))
        kind = get_args(kind)[0]
    if kind is not bool and get_origin(kind) is not Literal and kind not in _KINDS:
        raise TypeError(
            f"Options must be bool, int, float, str, Path, Literal, or tuples of these; {field.name} is {kind}."
        )
    flags: tuple[str, ...] = ()
    if _POSITIONAL not in metadata:
        aliases = [alias for m in metadata for alias in getattr(m, "aliases", None) or ()]
        flags = (*aliases, f"--{field.name.replace('_', '-')}")
    required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    return _Option(field.name, flags, required, kind, count, metadata)


@functools.cache
def _unread(command: type[Command]) -> Any:
    """A class with the fields of the command as optional texts."""
    defaults = {bool: False}
    fields = [
        (o.field, o.word_type, dataclasses.field(default=defaults.get(o.kind, _ABSENT if o.count == 1 else ())))
        for o in _options(command)
    ]
    return dataclasses.make_dataclass(command.__name__, fields)


def _documented(command: type[Command]) -> Any:
    """A subclass of the command whose help shows only defaults that mean something."""
    annotations = {}
    for name, kind in get_type_hints(command, include_extras=True).items():
        names = next((extra for extra in getattr(kind, "__metadata__", ()) if isinstance(extra, NameOf)), None)
        if names is not None:
            kind = Annotated[kind, _shown(f"{{{','.join(names.names())}}}")]
        hint = tyro.conf.arg(help_behavior_hint=lambda label: "" if label in _SILENT else f"(default: {label})")
        annotations[name] = Annotated[kind, hint]
    members = {"__doc__": command.__doc__, "__module__": command.__module__, "__annotations__": annotations}
    return type(command.__name__, (command,), members)


def _refuse_option(unknown: list[str], options: tuple[_Option, ...], see: str) -> NoReturn:
    word = next((w for w in unknown if w.startswith("-")), unknown[0])
    if not word.startswith("-"):
        raise InputError(f"Unknown argument {word!r}. {see}")
    flags = [flag for option in options for flag in option.flags]
    raise InputError(f"Unknown option {word!r}.{did_you_mean(word.partition('=')[0], flags)} {see}")


def _valueless(options: tuple[_Option, ...], words: list[str]) -> str:
    """The option after which a value is missing."""
    by_flag = {flag: option for option in options if option.kind is not bool for flag in option.flags}
    for word, following in zip(words, [*words[1:], "--"], strict=True):
        option = by_flag.get(word.replace("_", "-"))
        if option is not None and following.startswith("-"):
            return f"Missing value for {option.name}."
    return f"These options cannot be understood: {' '.join(words)}."


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
    """The first page of help: all commands with a line or two on each."""
    width = min(shutil.get_terminal_size().columns, 120)
    longest = max(map(len, commands))
    indent = " " * (longest + 4)
    rows = [
        textwrap.fill(_first_sentence(c), width, initial_indent=f"  {name:<{longest}}  ", subsequent_indent=indent)
        for name, c in commands.items()
    ]
    examples = [f"    {_first_example(c)}" for c in commands.values() if not isinstance(c, Group)][:4]
    more = f"Options and more examples: {prog} COMMAND --help. Every command prints one JSON object with --json."
    return "\n".join(
        [f"usage: {prog} COMMAND ...", "", about, "", "commands:", *rows, "", "Examples:", *examples, "", more]
    )


def _first_sentence(command: type[Command] | Group) -> str:
    text = command.about if isinstance(command, Group) else inspect.getdoc(command) or ""
    return re.split(r"(?<=\.)\s", " ".join(text.split("\n\n")[0].split()))[0]


def _first_example(command: type[Command]) -> str:
    return (inspect.getdoc(command) or "").partition("Examples:\n")[2].strip().partition("\n")[0]


# --- values -----------------------------------------------------------------------------------------------------------
def _read(option: _Option, given: Any) -> Any:
    """The value of an option from its words."""
    if option.kind is bool:
        return given
    if get_origin(option.kind) is Literal:
        read: Callable[[str], Any] = functools.partial(_choice, get_args(option.kind))
    else:
        read = _KINDS[option.kind][1]
    if option.count == 1:
        return read(given)
    if option.count is not None and len(given) != option.count:
        raise ValueError(f"expected {option.count} values, got {len(given)}")
    return tuple(map(read, given))


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


_KINDS: dict[Any, tuple[str, Callable[[str], Any]]] = {
    int: ("INT", _whole),
    float: ("NUMBER", _number),
    str: ("TEXT", str),
    Path: ("PATH", _path),
}


@_registry.primitive_rule
def _typed(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Numbers, texts and paths in help; None is not among them, as it only means that the option is not given."""
    kinds = [kind for kind in get_args(info.type) or (info.type,) if kind is not NoneType]
    if len(set(kinds)) != 1 or kinds[0] not in _KINDS:
        return None
    metavar, _ = _KINDS[kinds[0]]
    return _shown(" ".join([metavar] * len(kinds)), count=len(kinds) if info.type_origin is tuple else 1)


def _shown(metavar: str, *, count: int = 1) -> PrimitiveConstructorSpec[Any]:
    """How help shows a value, where tyro reads none: `_read` does."""
    return PrimitiveConstructorSpec(
        nargs=count,
        metavar=metavar,
        instance_from_str=lambda words: words,
        is_instance=lambda value: True,
        str_from_instance=lambda value: [str(value)],
    )
