"""Limits on the size of a foreign recording: a larger one would not fit into usual memory, and is not a recording."""

from __future__ import annotations

from pathlib import Path

from h3data.errors import FormatError

MAX_STEPS = 1_000_000
MAX_TRACK_VALUES = 1 << 27
"""Largest product of steps, bodies (agents, metrics) and values of each."""
MAX_BODIES = 100_000
MAX_AGENTS = 256


def check_size(steps: int, things: int, path: Path, *, values: int = 7) -> None:
    """Raise a `FormatError` if so many things with so many values each over so many steps would not fit into memory."""
    if steps > MAX_STEPS or steps * things * values > MAX_TRACK_VALUES:
        raise FormatError(
            f"A log of {steps} steps with {things} bodies is more than can be read: {path}", code="H3-FORMAT-018"
        )


def check_count(count: int, most: int, what: str, path: Path) -> None:
    """Raise a `FormatError` if there are more than ``most`` of them."""
    if count > most:
        raise FormatError(
            f"More than {most} {what} are more than can be read. Hint: cut the file into parts. {path}",
            code="H3-FORMAT-019",
        )
