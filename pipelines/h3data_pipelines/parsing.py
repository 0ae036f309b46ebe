"""Parsing of the words after ``h3data`` into a command and its options, with errors as one line."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import io
import itertools
import re
import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin, get_type_hints

import docstring_parser
import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from h3data.commands.command import Command, Group, NameOf
from h3data.commands.options import RENAMED, Option, Repeatable, annotated, check_task, known_tasks, options_of
from h3data.errors import InputError, did_you_mean, suggest
from h3data.plugins import own_version, trust
from h3data_pipelines.job_files import read_job_file
from h3data_pipelines.option_words import KINDS, read_value

_CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)
_SILENT = ("None", "False", "", "''")
"""Defaults that help leaves out, because they only mean that the option is not given."""
_COMMON_HELP = (
    "Every command also takes --config JOB.toml (options by name, those given here win), --quiet (no progress), and "
    "--trust MODULE (files may name what is in this Python module; repeatable)."
)
_ABSENT = "\0"
"""Default of options while words are assigned to them; no word on a command line can hold it."""

_registry = ConstructorRegistry()


@dataclass(frozen=True)
class Invocation:
    """Command with its options, and the options that all commands share."""

    command: Command
    quiet: bool = False
    """True if progress, notices and warnings are not printed; results and errors still are."""


def parse(args: Sequence[str], commands: Mapping[str, type[Command] | Group], *, about: str) -> Invocation:
    """Return the command that ``args`` name, with its options; after help or the version, raise `SystemExit`.

    Raises:
        InputError: a command or option does not exist or is missing, or a value has the wrong type.
    """
    if list(args) == ["--version"]:
        _leave(f"h3data {own_version()}")
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


def _parse_options(command: type[Command], prog: str, words: list[str]) -> Invocation:
    """Return the command with its options, from its words and a ``--config`` file.

    tyro assigns the words to the fields and prints help. Its errors are boxes of text for a terminal, and the hook that
    would give them as objects (``tyro._errors``) is private and unstable. So it never sees an error: fields are optional
    texts while words are assigned, then values are read and missing ones reported here, in one line.
    """
    if {"-h", "--help"} & set(words):
        _help(command, prog, words[0] if words and not words[0].startswith("-") else "")
    options, see = options_of(command), f"See: {prog} --help"
    words, quiet, config = _common(words, see)
    configured = {} if config is None else read_job_file(config, options)
    try:
        texts, unknown = tyro.cli(
            _unread(command), prog=prog, config=_CONFIG, args=words, return_unknown_args=True, console_outputs=False
        )
    except SystemExit:  # all fields are optional: only the value of an option can be missing
        raise InputError(f"{_valueless(options, words)} {see}", code="H3-OPTION-072") from None
    rest = next((o for o in options if o.count is None and not o.flags), None)
    apart = unknown if rest is not None and not any(word.startswith("-") for word in unknown) else []
    if unknown and not apart:
        _refuse_option(unknown, options, see)
    given = configured | {
        o.field: text for o in options if (text := getattr(texts, o.field)) not in (_ABSENT, (), False)
    }
    if rest is not None and apart:  # metrics A --paired B: words of one list on both sides of an option
        given[rest.field] = (*given.get(rest.field, ()), *apart)
    if missing := [o.name for o in options if o.required and o.field not in given and o.count is not None]:
        raise InputError(f"Missing from {prog}: {' and '.join(missing)}. {see}", code="H3-OPTION-069")
    try:
        check_task(command, given.get("task", ""), given)
    except InputError as error:
        raise InputError(f"{error} {see}", code="H3-OPTION-079") from None
    values = {o.field: () for o in options if o.required}  # any number of values may be none
    for option in options:
        if option.field in given:
            try:
                values[option.field] = read_value(option, given[option.field])
            except ValueError as error:
                raise InputError(f"{option.name}: {error}. {see}", code="H3-OPTION-073") from None
    return Invocation(command(**values), quiet)


def _common(words: list[str], see: str) -> tuple[list[str], bool, Path | None]:
    """Return the words without the options that all commands share, and these: ``--quiet`` and the path after ``--config``.

    A module after ``--trust`` is trusted at once, in the processes of the command too.
    """
    rest, config, quiet = [], None, False
    waiting = iter(words)
    for word in waiting:
        name, sign, value = word.partition("=")
        if word == "--":
            rest += [word, *waiting]
        elif word == "--quiet":
            quiet = True
        elif name == "--config":
            path = value if sign else next(waiting, "")
            if not path or path.startswith("-"):
                raise InputError(f"Missing value for --config. {see}", code="H3-OPTION-074")
            config = Path(path)
        elif name == "--trust":
            trust(value if sign else next(waiting, ""))
        else:
            rest.append(word)
    return rest, quiet, config


def _help(command: type[Command], prog: str, task: str) -> NoReturn:
    """Print the help of a command: summary, options, and the examples last, where a terminal still shows them.

    Of a command whose options differ between tasks, ``task`` chooses what is shown; empty: what all of them have.
    """
    about, _, examples = (inspect.getdoc(command) or "").partition("Examples:\n")
    tasks = known_tasks(command)
    page = _Page()
    try:
        with contextlib.redirect_stdout(page):
            tyro.cli(
                _documented(command, task),
                prog=f"{prog} {task}" if task in tasks else prog,
                config=_CONFIG,
                args=["--help"],
                description=_ABSENT,
                registry=_registry,
            )
    except SystemExit:
        # tyro leaves its paragraphs to the terminal, which breaks lines within words
        sys.stdout.write(page.getvalue().replace(_ABSENT, _wrapped(about)))
        more = _wrapped(_COMMON_HELP)
        if tasks and task not in tasks:
            more = _wrapped(
                f"Each task has more options: {', '.join(tasks)}. See: {prog} {tasks[0]} --help\n\n{_COMMON_HELP}"
            )
        lines = examples.rstrip().splitlines()
        if task in tasks:
            lines = [line for line in lines if f"{prog} {task} " in f"{line} "]
        _leave(f"{more}\n\nExamples:\n" + "\n".join(lines))
    raise AssertionError("tyro printed no help")


@functools.cache
def _unread(command: type[Command]) -> Any:
    """Return a class with the fields of the command as optional texts."""
    defaults = {bool: False}
    fields = [
        (o.field, o.word_type, dataclasses.field(default=defaults.get(o.kind, _ABSENT if o.count == 1 else ())))
        for o in options_of(command)
    ]
    return dataclasses.make_dataclass(command.__name__, fields)


def _documented(command: type[Command], task: str) -> Any:
    """Return a subclass of the command whose help shows only defaults that mean something, and only options of ``task``.

    An empty task leaves out all that only some tasks have; one of another package may have any option.
    """
    annotations: dict[str, Any] = {}
    by_field = {option.field: option for option in options_of(command)}
    tasks = known_tasks(command)
    # tyro keeps the line breaks of the source, which are not those of the terminal
    texts = {
        p.arg_name: " ".join((p.description or "").split()) for p in docstring_parser.parse_from_object(command).params
    }
    for name, kind in get_type_hints(command, include_extras=True).items():
        if name not in by_field:  # a class variable
            continue
        option = by_field[name]
        names = next((extra for extra in getattr(kind, "__metadata__", ()) if isinstance(extra, NameOf)), None)
        if names is not None:
            kind = Annotated[kind, _shown(f"{{{','.join(names.names())}}}")]
        elif get_origin(option.kind) is Literal and NoneType in get_args(_bare(kind)):
            kind = Annotated[kind, _shown(f"{{{','.join(map(str, get_args(option.kind)))}}}")]
        if option.is_list:
            kind = Repeatable[annotated(kind, option.metadata)]
        if (mark := option.of_tasks) is not None and (not task or (task in tasks and not mark.has(task))):
            kind = Annotated[kind, tyro.conf.Suppress]
        note = option.note(task) if task in tasks else ""
        hint = functools.partial(_hint, f"{task}: {note}" if note else "")
        annotations[name] = Annotated[kind, tyro.conf.arg(help=texts.get(name), help_behavior_hint=hint)]
    members = {"__doc__": command.__doc__, "__module__": command.__module__, "__annotations__": annotations}
    return type(command.__name__, (command,), members)


def _hint(note: str, label: str) -> str:
    """Return the end of an option's help: its meaning in the task, and its default if that is informative."""
    return " ".join(filter(None, (note, "" if label in _SILENT else f"(default: {label})")))


def _bare(kind: Any) -> Any:
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _refuse_option(unknown: list[str], options: tuple[Option, ...], see: str) -> NoReturn:
    word = next((w for w in unknown if w.startswith("-")), unknown[0])
    if not word.startswith("-"):
        raise InputError(f"Unknown argument {word!r}. {see}", code="H3-OPTION-070")
    flags = [flag for option in options for flag in option.flags]
    if (now := RENAMED.get(word.partition("=")[0])) in flags:
        raise InputError(f"{word} is {now} now. {see}", code="H3-OPTION-078")
    raise InputError(
        f"Unknown option {word!r}.{did_you_mean(word.partition('=')[0], flags)} {see}", code="H3-OPTION-067"
    )


def _valueless(options: tuple[Option, ...], words: list[str]) -> str:
    """Return the option after which a value is missing."""
    by_flag = {flag: option for option in options if option.kind is not bool for flag in option.flags}
    for word, following in zip(words, [*words[1:], "--"], strict=True):
        option = by_flag.get(word.replace("_", "-"))
        if option is not None and following.startswith("-"):
            return f"Missing value for {option.name}."
    return f"These options cannot be understood: {' '.join(words)}."


def _refuse(prog: str, word: str, commands: Mapping[str, Any]) -> NoReturn:
    if word.startswith("-"):
        raise InputError(
            f"Expected a command before {word}: {prog} COMMAND {word}. See: {prog} --help", code="H3-OPTION-071"
        )
    raise InputError(f"Unknown command {word!r}.{suggest(word, commands)} See: {prog} --help", code="H3-OPTION-068")


# --- help -------------------------------------------------------------------------------------------------------------
class _Page(io.StringIO):
    """Text in memory that has colours if the standard output has them."""

    def isatty(self) -> bool:
        return sys.__stdout__ is not None and sys.__stdout__.isatty()


def _width() -> int:
    return min(shutil.get_terminal_size().columns, 120)


def _wrapped(text: str) -> str:
    """Return paragraphs with lines no wider than the terminal; indented lines, as of tables, stay as they are."""
    lines: list[str] = []
    for kept, group in itertools.groupby(text.strip().splitlines(), lambda line: not line or line[0].isspace()):
        together = list(group)
        lines += together if kept else textwrap.wrap(" ".join(together), _width(), break_on_hyphens=False)
    return "\n".join(lines)


def _leave(text: str) -> NoReturn:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
    raise SystemExit(0)


def _overview(prog: str, about: str, commands: Mapping[str, type[Command] | Group]) -> str:
    """Return the first page of help: all commands with a line or two on each."""
    width = _width()
    longest = max(map(len, commands))
    indent = " " * (longest + 4)
    rows = [
        textwrap.fill(_first_sentence(c), width, initial_indent=f"  {name:<{longest}}  ", subsequent_indent=indent)
        for name, c in commands.items()
    ]
    examples = [f"    {_first_example(c)}" for c in commands.values() if not isinstance(c, Group)][:4]
    more = f"Options, examples: {prog} COMMAND --help. With --json: one JSON object."
    return "\n".join(
        [
            f"usage: {prog} COMMAND ...\n\n{_wrapped(about)}\n\ncommands:",
            *rows,
            "\nExamples:",
            *examples,
            "",
            _wrapped(more),
        ]
    )


def _first_sentence(command: type[Command] | Group) -> str:
    text = command.about if isinstance(command, Group) else inspect.getdoc(command) or ""
    return re.split(r"(?<=\.)\s", " ".join(text.split("\n\n")[0].split()))[0]


def _first_example(command: type[Command]) -> str:
    return (inspect.getdoc(command) or "").partition("Examples:\n")[2].strip().partition("\n")[0]


@_registry.primitive_rule
def _typed(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Return the numbers, texts and paths in help, without None, which only means that the option is not given."""
    kinds = [kind for kind in get_args(info.type) or (info.type,) if kind is not NoneType]
    if len(set(kinds)) != 1 or kinds[0] not in KINDS:
        return None
    metavar, _ = KINDS[kinds[0]]
    return _shown(" ".join([metavar] * len(kinds)), count=len(kinds) if info.type_origin is tuple else 1)


def _shown(metavar: str, *, count: int = 1) -> PrimitiveConstructorSpec[Any]:
    """Return a value as help shows it, where `read_value` reads it instead of tyro."""
    return PrimitiveConstructorSpec(
        nargs=count,
        metavar=metavar,
        instance_from_str=lambda words: words,
        is_instance=lambda value: True,
        str_from_instance=lambda value: [str(value)],
    )
