"""Formatting of text for terminals.

Names in recordings may come from unknown sources and contain terminal control sequences.
"""

from __future__ import annotations

import re
from collections.abc import Sequence


def printable(text: str) -> str:
    """Return the text with control characters written out, such as ``\\x1b``, so that it moves no cursor and hides no text."""
    # C0 and C1 control characters except tab and newline, and the overrides of writing direction
    # (CVE-2021-42574)
    control = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
    return control.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), text)


def counted(count: int, noun: str) -> str:
    """Return a number with its noun in the singular or the plural: ``1 episode``, ``2 episodes``."""
    return f"{count} {noun}{'s' * (count != 1)}"


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """Return rows of cells as text with columns of equal width."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in lines)
