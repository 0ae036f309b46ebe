"""Lines that a training run says while it goes on."""

from __future__ import annotations

import sys

from h3data.progress import is_quiet
from h3data.terminal import printable


def say(line: str) -> None:
    if not is_quiet():
        sys.stderr.write(printable(line) + "\n")
        sys.stderr.flush()
