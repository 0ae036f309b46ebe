"""Limits on the size of an imported recording, above which a file does not fit into memory or is not a recording."""

from __future__ import annotations

from pathlib import Path

from h3data.errors import FormatError

MAX_STEPS = 1_000_000
MAX_TRACK_VALUES = 1 << 27
"""Largest product of the numbers of steps, of bodies (agents, metrics), and of values of each."""
MAX_BODIES = 100_000
MAX_AGENTS = 256


def check_size(steps: int, things: int, path: Path, *, values: int = 7) -> None:
    """Raise a `FormatError` if the values of a number of things over a number of steps would not fit into memory."""
    if steps > MAX_STEPS or steps * things * values > MAX_TRACK_VALUES:
        raise FormatError(
            f"A log of {steps} steps with {things} bodies is more than can be read: {path}", code="H3-FORMAT-018"
        )


def check_count(count: int, most: int, what: str, path: Path) -> None:
    """Raise a `FormatError` if a count exceeds ``most``."""
    if count > most:
        raise FormatError(
            f"More than {most} {what} are more than can be read. Hint: cut the file into parts. {path}",
            code="H3-FORMAT-019",
        )
