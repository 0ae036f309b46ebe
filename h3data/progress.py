"""Progress of long work on stderr: a bar on a terminal, otherwise a line every half minute (logs, CI, ``2> log``)."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Iterable
from threading import Event
from typing import TYPE_CHECKING, Any

from h3data.terminal import printable

if TYPE_CHECKING:
    from tqdm import tqdm

LINE_EVERY_S = 30.0
"""Time between two progress lines if stderr is not a terminal [s]; shorter work prints no line."""
QUIET = "H3DATA_QUIET"
"""Environment variable that silences progress and notices, set by ``h3data ... --quiet``. Worker processes inherit it."""
BEGUN = Event()
"""Event that is set once this process has printed progress, after which notices would interrupt progress lines."""


def is_quiet() -> bool:
    """Return whether progress and notices are off."""
    return os.environ.get(QUIET, "") not in ("", "0")


def say(line: str) -> None:
    """Write a line to stderr, unless `is_quiet`; terminal control characters are replaced."""
    if not is_quiet():
        sys.stderr.write(printable(line) + "\n")
        sys.stderr.flush()


def progress(
    items: Iterable[Any] | None = None,
    *,
    desc: str,
    unit: str,
    total: int | None = None,
    initial: int = 0,
    delay: float = 0.0,
    leave: bool = True,
    at_least: int = 0,
) -> tqdm[Any]:
    """Return a `tqdm` bar over ``items``, or one to be updated by hand, silent under `is_quiet`.

    Args:
        items: Items to iterate over, each counting as one unit; None if ``update`` is called instead.
        desc: Name of the work, in one word.
        unit: Name of a unit, in the singular.
        total: Number of units, by default the length of ``items``.
        initial: Number of units that are done already.
        delay: Seconds before a bar appears.
        leave: True if a finished bar stays on the terminal.
        at_least: Smallest number of units for which progress is displayed.
    """
    from tqdm import tqdm

    if total is None and hasattr(items, "__len__"):
        total = len(items)  # type: ignore[arg-type]
    terminal = sys.stderr is not None and sys.stderr.isatty()
    silent = is_quiet() or sys.stderr is None or (total is not None and total < at_least)
    shared: dict[str, Any] = {
        "desc": printable(desc),
        "unit": unit,
        "total": total,
        "initial": initial,
        "disable": silent,
        "file": sys.stderr,
    }
    if terminal and not silent:
        BEGUN.set()
    if silent or terminal:
        return tqdm(items, delay=delay, leave=leave, **shared)
    form = "{desc}: {n_fmt} {unit}s, {elapsed} so far{postfix}"
    if total is not None:
        form = "{desc}: {n_fmt} of {total_fmt} {unit}s, {elapsed} so far, about {remaining} left{postfix}"
    # miniters: else tqdm guesses how many units make a line, and a line comes late where they become slower
    every = {"mininterval": LINE_EVERY_S, "miniters": 1, "delay": LINE_EVERY_S}
    return _lines_bar()(items, **every, leave=False, bar_format=form, **shared)


@functools.cache
def _lines_bar() -> type[tqdm[Any]]:
    """Return a bar that writes lines instead of overwriting one: control characters would fill a log file."""
    from tqdm import tqdm

    class Lines(tqdm):
        monitor_interval = 0  # no thread that repeats the last line, with its stale estimate, every ten seconds

        @property
        def format_dict(self) -> dict[str, Any]:
            shown = dict(super().format_dict)
            # nothing is foretold from the first units, which wait for kernels that are compiled once
            if self.total and self.n - self.initial <= max(1, 0.03 * self.total):
                shown["bar_format"] = "{desc}: {n_fmt} of {total_fmt} {unit}s, {elapsed} so far{postfix}"
            return shown

        def display(self, msg: str | None = None, pos: int | None = None) -> None:
            text = str(self) if msg is None else msg
            if text:
                BEGUN.set()
                self.fp.write(text + "\n")
                self.fp.flush()

        def clear(self, nolock: bool = False) -> None:
            """Do nothing: a log has no bar that would have to be wiped off."""

        def close(self) -> None:
            self.disable = True  # without a last line: the result that the caller prints says that the work is done
            self._decr_instances(self)  # type: ignore[attr-defined]

    return Lines
