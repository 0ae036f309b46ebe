"""The ``h3data`` command line. Exit codes: 0 done, 1 done with failures listed, 2 refused (bad input), 130 interrupted."""

from __future__ import annotations

import io
import json
import logging
import math
import os
import signal
import sys
from collections.abc import Sequence
from typing import Any

from h3data.errors import H3DataError
from h3data.recording.storage import masked
from h3data_pipelines.bench import Bench
from h3data_pipelines.bodies import BODIES
from h3data_pipelines.command import Command, Group
from h3data_pipelines.converting import Convert
from h3data_pipelines.demo import Demo
from h3data_pipelines.doctor import Doctor
from h3data_pipelines.evaluating import Evaluate
from h3data_pipelines.exporting import Export
from h3data_pipelines.generate import Generate
from h3data_pipelines.importing import Import
from h3data_pipelines.informing import Info
from h3data_pipelines.measuring import Metrics
from h3data_pipelines.motion import MOTION
from h3data_pipelines.parsing import parse
from h3data_pipelines.recovering import Recover
from h3data_pipelines.replaying import ReplayCommand
from h3data_pipelines.report import ReportCommand
from h3data_pipelines.rerender import Rerender
from h3data_pipelines.robots import ROBOTS
from h3data_pipelines.scenes import SCENES
from h3data_pipelines.sql import Sql
from h3data_pipelines.validating import Validate
from h3data_pipelines.viewing import View

COMMANDS: dict[str, type[Command] | Group] = {
    "demo": Demo,
    "generate": Generate,
    "evaluate": Evaluate,
    "import": Import,
    "export": Export,
    "rerender": Rerender,
    "info": Info,
    "metrics": Metrics,
    "sql": Sql,
    "view": View,
    "report": ReportCommand,
    "scenes": SCENES,
    "bodies": BODIES,
    "motion": MOTION,
    "robots": ROBOTS,
    "replay": ReplayCommand,
    "convert": Convert,
    "validate": Validate,
    "recover": Recover,
    "doctor": Doctor,
    "bench": Bench,
}

ABOUT = """Simulate people and robots sharing a home, record everything, and render, measure and inspect it again."""


def jsonable(value: Any) -> Any:
    """The value with NaN and infinities as null, which JSON has no other word for."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(v) for v in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    logging.getLogger("h3data.kernels").setLevel(logging.INFO)  # why the very first command takes longer
    args = list(sys.argv[1:] if arguments is None else arguments)
    try:
        command = parse(args, COMMANDS, about=ABOUT)
        outcome = command.run()
        _print(json.dumps(jsonable(outcome.data), indent=2) if command.json else outcome.text.rstrip())
        return outcome.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; finished files are kept\n")
        return 130
    except BrokenPipeError:
        _close_stdout()
        return 0
    except (H3DataError, OSError, MemoryError) as error:
        message = masked(_message(error))
        sys.stderr.write(f"error: {message}\n")
        if "--json" in args:
            _print(json.dumps({"error": message}))
        return 2


def _message(error: BaseException) -> str:
    """One line. What the operating system refuses (rights, full disks, names too long) is the user's to mend as well."""
    if isinstance(error, MemoryError):
        return f"Out of memory ({error})." if str(error) else "Out of memory."
    if isinstance(error, OSError):
        where = f": {error.filename}" if error.filename is not None else ""
        return f"The operating system refused ({error.strerror or error}){where}"
    return str(error)


def _print(text: str) -> None:
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        _close_stdout()


def _close_stdout() -> None:
    """After the reader has seen enough (| head): what Python flushes at its end goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def entry() -> None:
    """Console entry point."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: what is finished is kept
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names need not be text in the terminal's encoding
    sys.exit(main())


if __name__ == "__main__":
    entry()
