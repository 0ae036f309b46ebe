"""JSON files of other programs; errors state where and why a file is not valid JSON."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec

from h3data.errors import FormatError
from h3data.formats import format_by_beginning
from h3data.formats.source_file import BYTE_ORDER_MARK, SourceFile, decode_json


def read_json(path: Path) -> Any:
    """Return the content of a JSON file (gzip allowed).

    Raises:
        InputError: there is no such file.
        FormatError: the file is not JSON; the message states the position of the fault.
    """
    data = SourceFile(path).data
    try:
        return decode_json(data)
    except msgspec.DecodeError as fault:
        raise not_json(path, data, fault) from None


def not_json(path: Path, data: bytes, fault: Exception, *, start: int = 0) -> FormatError:
    """Return the error for bytes, from byte ``start`` of a file on, that are not a JSON document."""
    text = str(fault)
    if not data.strip():
        return FormatError(f"Expected JSON, the file is empty: {path}", code="H3-FORMAT-010")
    # msgspec has no class of its own for it
    if "truncated" in text:
        return truncated(path, start + len(data))
    actual = format_by_beginning(data)
    if not start and actual.begins is not None and actual.members is None:
        return FormatError(f"Expected JSON, this is {actual.title}: {path}", code="H3-FORMAT-011")
    number = _not_finite(data.removeprefix(BYTE_ORDER_MARK), text, start)
    if number is not None:
        return FormatError(
            f"{number}, which JSON does not allow. Hint: fix it where the file was made. {path}", code="H3-FORMAT-012"
        )
    text = text.removeprefix("JSON is malformed: ")
    text = re.sub(r"\(byte (\d+)\)", lambda at: f"(byte {int(at[1]) + start})", text)
    return FormatError(f"Expected JSON, this is not: {text}: {path}", code="H3-FORMAT-008")


def truncated(path: Path, size: int) -> FormatError:
    """Return the error for a JSON document that is cut off after ``size`` bytes."""
    return FormatError(
        f"The JSON is truncated: it ends at byte {size}. Hint: copy the file again. {path}", code="H3-FORMAT-009"
    )


def _not_finite(data: bytes, fault: str, start: int) -> str | None:
    """Return the NaN or infinity (as Python and NumPy write them) at which decoding failed; None for any other fault."""
    at = re.search(r"\(byte (\d+)\)", fault)
    number = re.compile(rb"-?(?:NaN|Infinity)").match(data, int(at[1])) if at else None
    if number is None:
        return None
    # the last key before the number is the one that it stands under
    keys = re.findall(rb'"((?:[^"\\]|\\.)*)"\s*:', data[: number.start()])
    under = f"under {keys[-1].decode(errors='replace')!r} " if keys else ""
    return f"{number[0].decode()} {under}(byte {start + number.start()})"
