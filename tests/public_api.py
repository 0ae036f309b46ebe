"""What h3data promises, as text: names and signatures of the public modules, commands and their options.

    python -m tests.public_api --renew        writes tests/data/public_api.txt (make api)
    python -m tests.public_api --since REF    shows what has changed since a commit (make api-diff BASE=REF)

The latter fails where something went away or has another signature, and docs/changes/ has no new fragment that says so.

A module is public if it lies directly in `h3data` and has an ``__all__``. Each keyword parameter and each option of a command
has a line of its own, so that a difference shows what is different.
"""

from __future__ import annotations

import argparse
import dataclasses
import enum
import functools
import importlib
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any, get_origin

from tests.paths import DATA, ROOT

FILE = DATA / "public_api.txt"
OURS = re.compile(r"(h3data|sim_kinematic)(_\w+)?(\.|$)")


def public_modules() -> list[str]:
    """Names of the modules of which every name in ``__all__`` is promised."""
    package, studies = ROOT / "h3data", ROOT / "viewers" / "h3data_studies"
    files = [
        package / "__init__.py",
        *package.glob("*.py"),
        *package.glob("*/__init__.py"),
        *studies.glob("*/__init__.py"),
    ]
    public = {file for file in files if re.search(r"^__all__\b", file.read_text(encoding="utf-8"), re.MULTILINE)}
    names = (".".join(file.relative_to(ROOT).with_suffix("").parts).removeprefix("viewers.") for file in public)
    return sorted(name.removesuffix(".__init__") for name in names)


def lines() -> Iterator[str]:
    """The public interface, a line for each name, parameter by keyword and option."""
    modules = {name: importlib.import_module(name) for name in public_modules()}
    for name, module in modules.items():
        for member in sorted(module.__all__):
            home = _home(modules, name, member)
            if home == name:
                yield from _described(f"{name}.{member}", getattr(module, member))
            else:
                yield f"{name}.{member} is {home}.{member}"
    yield from _commands()


def _home(modules: dict[str, ModuleType], name: str, member: str) -> str:
    """The last module that offers the same object by the same name: `h3data` itself only repeats what others have."""
    found = getattr(modules[name], member)
    return [
        other for other, module in modules.items() if member in module.__all__ and getattr(module, member) is found
    ][-1]


def _described(name: str, found: Any) -> Iterator[str]:
    if inspect.isclass(found):
        bases = [base.__name__ for base in found.__mro__[1:] if OURS.match(base.__module__)]
        of = f" of {', '.join(bases)}" if bases else ""
        if issubclass(found, enum.Enum):
            yield f"class {name}{of}"
            yield from (f"{name}.{member.name} = {member.value!r}" for member in found)
            return
        yield from _signature(f"class {name}", found, of)
        members: dict[str, Any] = {}
        for owner in reversed(found.__mro__):
            if OURS.match(owner.__module__):
                members |= vars(owner)
        fields = {field.name for field in dataclasses.fields(found)} if dataclasses.is_dataclass(found) else set()
        for member, value in sorted(members.items()):
            if not member.startswith("_") and member not in fields:
                yield from _member(f"{name}.{member}", value)
    elif callable(found) and get_origin(found) is None:
        yield from _signature(name, found)
    else:
        yield f"{name}: {type(found).__name__}"


def _member(name: str, value: Any) -> Iterator[str]:
    if isinstance(value, property | functools.cached_property):
        getter = value.fget if isinstance(value, property) else value.func
        yield f"{name}: {_type(inspect.signature(getter).return_annotation)}" if getter else name
    elif isinstance(value, classmethod | staticmethod):
        yield from _signature(f"{type(value).__name__} {name}", value.__func__)
    elif inspect.isfunction(value) or isinstance(value, functools.partialmethod):
        yield from _signature(name, value)
    elif not inspect.ismemberdescriptor(value):
        yield f"{name}: {type(value).__name__}"


def _signature(name: str, found: Any, of: str = "") -> Iterator[str]:
    if inspect.isclass(found) and issubclass(found, Exception) and not inspect.isfunction(found.__init__):
        yield f"{name}{of}"
        return
    signature = inspect.signature(found)
    parameters = signature.parameters.values()
    plain = [_parameter(p) for p in parameters if p.kind is not p.KEYWORD_ONLY]
    returned = signature.return_annotation
    arrow = "" if returned is signature.empty or inspect.isclass(found) else f" -> {_type(returned)}"
    yield f"{name}({', '.join(plain)}){of}{arrow}"
    yield from (f"{name}(... {_parameter(p)})" for p in parameters if p.kind is p.KEYWORD_ONLY)


def _parameter(parameter: inspect.Parameter) -> str:
    stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
    text = f"{stars}{parameter.name}"
    if parameter.annotation is not parameter.empty:
        text += f": {_type(parameter.annotation)}"
    return text if parameter.default is parameter.empty else f"{text} = {_value(parameter.default)}"


def _type(annotation: Any) -> str:
    if annotation is inspect.Signature.empty:
        return "Any"
    if inspect.isclass(annotation) and not hasattr(annotation, "__args__"):
        return annotation.__name__  # the module of Path is not the same in all versions of Python
    return annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)


def _value(value: Any) -> str:
    """A default as text that is the same in every process."""
    if isinstance(value, ModuleType):
        return value.__name__
    named = getattr(value, "__qualname__", None)
    return named or re.sub(r" at 0x[0-9a-f]+", "", " ".join(repr(value).split()))


def _commands() -> Iterator[str]:
    from h3data.commands.command import Group
    from h3data.commands.options import options_of
    from h3data_pipelines.commands.table import all_commands

    for name, command in sorted(all_commands().items()):
        parts = command.commands if isinstance(command, Group) else {"": command}
        for part, one in sorted(parts.items()):
            words = f"h3data {name} {part}".rstrip()
            defaults = inspect.signature(one).parameters
            yield words
            for option in options_of(one):
                default = defaults[option.field].default
                end = "" if default is inspect.Parameter.empty else f" = {_value(default)}"
                several = "" if option.count == 1 else " ..."
                yield f"{words} {option.name} {_type(option.kind)}{several}{end}"


def changed_since(commit: str) -> tuple[list[str], list[str], list[str]]:
    """What went away, what came, and the new fragments of the changelog that tell of changes.

    Raises:
        subprocess.CalledProcessError: git does not know the commit.
    """

    def git(*words: str) -> list[str]:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()

    compared = git("diff", "--unified=0", f"{commit}...HEAD", "--", str(FILE.relative_to(ROOT)))
    gone, come = ([line[1:] for line in compared if re.match(rf"\{sign}[^{sign}]", line)] for sign in "-+")
    fragments = git("diff", "--name-only", "--diff-filter=AM", f"{commit}...HEAD", "--", "docs/changes")
    return gone, come, [name for name in fragments if re.search(r"\.(changed|answers)(\.\d+)?\.md$", name)]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    choice = parser.add_mutually_exclusive_group(required=True)
    choice.add_argument("--renew", action="store_true", help="write what there is now")
    choice.add_argument("--since", metavar="REF", help="compare what two commits have stored")
    options = parser.parse_args(arguments)
    if options.renew:
        FILE.write_text("\n".join(lines()) + "\n", encoding="utf-8")
        return 0
    gone, come, fragments = changed_since(options.since)
    print(
        "\n".join([*(f"- {line}" for line in gone), *(f"+ {line}" for line in come)])
        or "The public interface is the same."
    )
    if gone and not fragments:
        print(
            "Some of it went away or has another signature. Tell users in a fragment TOPIC.changed.md in docs/changes/."
        )
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
