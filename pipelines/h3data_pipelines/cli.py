"""Command line ``h3data``, with exit codes 0 (done), 1 (failures), 2 (invalid input) and 130 (interrupted)."""

from __future__ import annotations

import errno
import gc
import io
import json
import logging
import math
import os
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

from h3data.terminal import printable

if TYPE_CHECKING:
    from h3data.commands.command import Command

ABOUT = """Simulate people and robots sharing a home, record everything, and render, measure and inspect it again."""


def jsonable(value: Any) -> Any:
    """Return a value as JSON types: NaN and infinities become null, and NumPy scalars become plain numbers."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(v) for v in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        return _run(list(sys.argv[1:] if arguments is None else arguments))
    except KeyboardInterrupt as stop:
        _complain("; ".join(filter(None, ("interrupted", str(stop)))))
        return 130
    except BrokenPipeError:
        _close_stdout()
        return 0


def _run(args: list[str]) -> int:
    from h3data.errors import H3DataError  # here, so that Ctrl-C during these slow imports is caught too
    from h3data.plugins import missing_part
    from h3data.recording.storage import masked
    from h3data_pipelines.commands.table import REGISTRY, TABLE, all_commands
    from h3data_pipelines.option_words import in_shell_words
    from h3data_pipelines.parsing import parse

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    command: Command | None = None
    try:
        commands = all_commands()
        if args and args[0] in TABLE and args[0] not in commands:
            REGISTRY.get(args[0])  # says which package is not there
        invocation = parse(args, commands, about=ABOUT)
        command = invocation.command
        with _silence() if invocation.quiet else nullcontext():
            outcome = command.run()
    except BrokenPipeError:
        raise
    except (H3DataError, OSError, MemoryError, ModuleNotFoundError) as error:
        if isinstance(error, ModuleNotFoundError) and not missing_part(error):
            raise
        message = masked(_message(error) if command is None else in_shell_words(_message(error), type(command)))
        code = error.code if isinstance(error, H3DataError) else ""
        _complain(f"error: {message} [{code}]" if code else f"error: {message}")
        if "--json" in args:
            _print(json.dumps({"error": message} | ({"code": code} if code else {})))
        return 2
    try:
        _print(json.dumps(jsonable(outcome.data), indent=2) if command.json else outcome.text.rstrip())
    except OSError as error:
        _complain(f"error: {_message(error)}")
        return 2
    return outcome.exit_code


@contextmanager
def _silence() -> Iterator[None]:
    """Turn off progress, notices and warnings, in worker processes too."""
    from h3data.progress import QUIET

    before = os.environ.get(QUIET)
    os.environ[QUIET] = "1"
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)
        if before is None:
            del os.environ[QUIET]
        else:
            os.environ[QUIET] = before


def _message(error: BaseException) -> str:
    """Return one line about an error, including those of the operating system that a user can fix (permissions, full disks)."""
    if isinstance(error, MemoryError):
        return f"Out of memory ({error})." if str(error) else "Out of memory."
    if isinstance(error, ModuleNotFoundError):
        from h3data.plugins import missing_part

        return (
            f"This needs the package {missing_part(error)}, which this installation does not have. "
            "Hint: install h3data as a whole."
        )
    if isinstance(error, OSError):
        path = f": {error.filename}" if error.filename is not None else ""
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            return f"The disk is full ({error.strerror}). Free some space, or write elsewhere with -o{path}"
        return f"The operating system refused ({error.strerror or error}){path}"
    return str(error)


def _complain(text: str) -> None:
    sys.stderr.write(printable(text) + "\n")


def _print(text: str) -> None:
    try:
        sys.stdout.write(printable(text) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        _close_stdout()


def _close_stdout() -> None:
    """Discard further output, also what Python flushes at exit: a reader has closed the pipe (``| head``), a disk is full."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def entry() -> None:
    """Run the command line and exit the process, as the console entry point."""
    for number in (signal.SIGTERM, signal.SIGHUP):  # ended from outside, or the terminal closed: as after Ctrl-C
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup asks to go on
            signal.signal(number, signal.default_int_handler)
    # with the default of 700 objects, the search for cycles takes 0.4 s of the demo; with more than 5,000 it does not take
    # less than 0.1 s, and rendering many recordings takes more memory
    gc.set_threshold(5_000)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may not fit the terminal's encoding
    code = main()
    try:
        sys.stdout.flush()
    except OSError:  # `main` has said it; Python would say it again and exit with 120
        _close_stdout()
    # the search for cycles at the end of a process takes up to half a second, for memory that is freed anyway
    gc.freeze()
    sys.exit(code)


if __name__ == "__main__":
    entry()
