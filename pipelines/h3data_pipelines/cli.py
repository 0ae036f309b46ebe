"""The ``h3data`` command line. Exit codes: 0 done, 1 done but failures are listed, 2 refused (bad input), 130 interrupted."""

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

ABOUT = """Simulate people and robots sharing a home, record everything, and render, measure and inspect it again."""


def jsonable(value: Any) -> Any:
    """The value as JSON can hold it: NaN and infinities become null, NumPy scalars plain numbers."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(v) for v in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # so that module:name finds the user's files, after everything that is installed
    try:
        return _run(list(sys.argv[1:] if arguments is None else arguments))
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; finished files are kept\n")
        return 130
    except BrokenPipeError:
        _close_stdout()
        return 0


def _run(args: list[str]) -> int:
    from h3data.errors import H3DataError  # here, so that Ctrl-C during these slow imports is caught too
    from h3data.recording.storage import masked
    from h3data_pipelines.commands.table import COMMANDS
    from h3data_pipelines.parsing import parse

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    logging.getLogger("h3data.kernels").setLevel(logging.INFO)  # says that the first command compiles
    try:
        command = parse(args, COMMANDS, about=ABOUT)
        outcome = command.run()
    except BrokenPipeError:
        raise
    except (H3DataError, OSError, MemoryError) as error:
        message = masked(_message(error))
        sys.stderr.write(f"error: {message}\n")
        if "--json" in args:
            _print(json.dumps({"error": message}))
        return 2
    try:
        _print(json.dumps(jsonable(outcome.data), indent=2) if command.json else outcome.text.rstrip())
    except OSError as error:
        sys.stderr.write(f"error: {_message(error)}\n")
        return 2
    return outcome.exit_code


def _message(error: BaseException) -> str:
    """One line about an error, including those of the operating system that a user can fix (permissions, full disks)."""
    if isinstance(error, MemoryError):
        return f"Out of memory ({error})." if str(error) else "Out of memory."
    if isinstance(error, OSError):
        path = f": {error.filename}" if error.filename is not None else ""
        return f"The operating system refused ({error.strerror or error}){path}"
    return str(error)


def _print(text: str) -> None:
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        _close_stdout()


def _close_stdout() -> None:
    """Discards further output when the reader has closed the pipe (``| head``), also what Python flushes at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def entry() -> None:
    """Console entry point."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C: finished files are kept
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may not fit the terminal's encoding
    sys.exit(main())


if __name__ == "__main__":
    entry()
