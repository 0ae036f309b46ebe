"""The ``h3data`` command line. Exit codes: 0 done, 1 done with failures listed, 2 refused (bad input), 130 interrupted."""

from __future__ import annotations

import inspect
import json
import logging
import math
import sys
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from h3data.errors import H3DataError
from h3data_pipelines.command import Command
from h3data_pipelines.demo import Demo
from h3data_pipelines.doctor import Doctor
from h3data_pipelines.generate import Generate
from h3data_pipelines.importing import Import
from h3data_pipelines.measuring import Metrics
from h3data_pipelines.rerender import Rerender
from h3data_pipelines.scenes import Scenes
from h3data_pipelines.viewing import View

COMMANDS: dict[str, type[Command]] = {
    "demo": Demo,
    "generate": Generate,
    "import": Import,
    "rerender": Rerender,
    "metrics": Metrics,
    "view": View,
    "scenes": Scenes,
    "doctor": Doctor,
}

_DESCRIPTION = """Simulate people and robots sharing a home, record everything, and render, measure and inspect it again.

Start with: h3data demo -o out/demo"""


def jsonable(value: Any) -> Any:
    """The value with NaN and infinities as null, which JSON has no other word for."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(v) for v in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _parse(args: list[str]) -> Command:
    """The command that ``args`` ask for; the help of each shows its docstring with the examples, unabridged."""
    parts = [Annotated[c, tyro.conf.subcommand(n, description=inspect.getdoc(c))] for n, c in COMMANDS.items()]
    union: Any = Union[tuple(parts)]  # noqa: UP007 - made at run time
    config = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
    return tyro.cli(union, args=args, prog="h3data", description=_DESCRIPTION, config=config)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    args = list(sys.argv[1:] if arguments is None else arguments)
    command = _parse(args or ["--help"])
    try:
        outcome = command.run()
    except H3DataError as error:
        if command.json:
            sys.stdout.write(json.dumps({"error": str(error)}) + "\n")
        sys.stderr.write(f"error: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; finished files are kept\n")
        return 130
    except BrokenPipeError:
        return 0
    if command.json:
        sys.stdout.write(json.dumps(jsonable(outcome.data), indent=2) + "\n")
    else:
        sys.stdout.write(outcome.text.rstrip() + "\n")
    return outcome.exit_code


def entry() -> None:
    """Console entry point."""
    sys.exit(main())


if __name__ == "__main__":
    entry()
