"""Command ``h3data completion``, which prints scripts for the completion of commands and options in a shell."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args, get_origin

import shtab
import tyro

from h3data.commands.command import Command, Group, JsonFlag, Outcome
from h3data.commands.options import options_of


@dataclass(frozen=True)
class Completion:
    """Print the script that completes commands and options with Tab.

    Examples:
        h3data completion bash > ~/.local/share/bash-completion/completions/h3data
        h3data completion zsh > ~/.zfunc/_h3data
        h3data completion tcsh > ~/.h3data.completion.csh
    """

    commands: ClassVar[Mapping[str, type[Command] | Group]] = {}
    """All commands, including this one, as set by `h3data_pipelines.commands.table.all_commands`."""

    shell: tyro.conf.Positional[Literal["bash", "zsh", "tcsh"]]
    """Shell that reads the script."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return the completion script for a shell."""
        script = shtab.complete(_parser("h3data", self.commands), shell=self.shell)
        return Outcome(text=script, data={"shell": self.shell, "script": script})


def _parser(prog: str, commands: Mapping[str, type[Command] | Group]) -> argparse.ArgumentParser:
    """Return all commands as an `argparse.ArgumentParser`, which never parses: shtab reads names and choices off it."""
    root = argparse.ArgumentParser(prog=prog)
    branches = root.add_subparsers()
    for name, command in commands.items():
        if isinstance(command, Group):
            subgroup = branches.add_parser(name, help=command.about).add_subparsers()
            for sub_name, sub_command in command.commands.items():
                _add_options(subgroup.add_parser(sub_name, help=sub_name), sub_command)
        else:
            _add_options(branches.add_parser(name, help=name), command)
    return root


def _add_options(parser: argparse.ArgumentParser, command: type[Command]) -> None:
    for option in options_of(command):
        settings: dict[str, Any] = {}
        if option.kind is bool:
            settings["action"] = "store_true"
        elif get_origin(option.kind) is Literal:
            settings["choices"] = get_args(option.kind)
        if option.flags:
            argument = parser.add_argument(*option.flags, **settings)
        else:
            argument = parser.add_argument(option.field, nargs=option.count or "*", **settings)
        if option.kind is Path:
            argument.complete = shtab.FILE  # type: ignore[attr-defined]
    parser.add_argument("--config").complete = shtab.FILE  # type: ignore[attr-defined]
    parser.add_argument("--quiet", action="store_true")
