"""Errors that say where and why a file is not a gfx-replay."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import msgspec

from h3data.errors import FormatError
from h3data.formats import json_format
from h3data.formats.source_file import decode_json
from h3data_habitat.json_files import not_json, truncated
from h3data_habitat.json_stream import ArrayFault


def undecoded(
    path: Path, data: bytes, fault: msgspec.DecodeError, *, keyframe: int = -1, start: int = 0
) -> FormatError:
    """Return the error for text that cannot be decoded.

    Args:
        path: File.
        data: Text of a keyframe, or of the whole file.
        fault: Reason that msgspec gives.
        keyframe: Number of the keyframe; -1 stands for the whole file.
        start: Number of the first byte of ``data`` in the file.
    """
    if not isinstance(fault, msgspec.ValidationError):
        return not_json(path, data, fault, start=start)
    if keyframe < 0:
        return not_a_replay(path, data, str(fault))
    reason, _, where = str(fault).partition(" - at `")
    where = where.rstrip("`").removeprefix("$").removeprefix(".")
    # an instance is named by its key instead of its index in the list
    place = f"keyframe {keyframe}"
    if match := re.match(r"(\w+)(?:\[(\d+)\])?", where):
        group, index = match.groups()
        item = None if index is None else _item(data, group, int(index))
        key = item.get("instanceKey", item.get("id", item.get("name"))) if isinstance(item, dict) else None
        place += f", {group}"
        place += f", instance {key}" if key is not None else f"[{index}]" if index is not None else ""
        place += f" ({where})"
    return _invalid(path, reason, place)


def not_a_replay(path: Path, data: bytes, fault: str = "") -> FormatError:
    """Return the error for a file without keyframes, which says what else it looks like.

    A file that has keyframes gets the error ``fault``, msgspec's text.
    """
    try:
        content = decode_json(data)
    except msgspec.DecodeError as damage:
        return not_json(path, data, damage)
    if not isinstance(content, dict):
        shape = f"It holds a JSON {type(content).__name__}."
    elif fault and not content.keys().isdisjoint(("keyframes", "keyframe")):
        reason, _, where = fault.partition(" - at `")
        return _invalid(path, reason, where.rstrip("`").removeprefix("$.") or "its top level")
    else:
        keys = ", ".join(list(content)[:8]) or "none"
        shape = f"Its top-level keys are: {keys}; it looks like {json_format(content, name=path.name).title}."
    return FormatError(f"Expected a gfx-replay (JSON with the key 'keyframes'). {shape} {path}", code="H3-HABITAT-058")


def broken_list(path: Path, fault: ArrayFault) -> FormatError:
    """Return the error for a list of keyframes that ends early or is damaged."""
    if str(fault) == "truncated":
        return truncated(path, fault.at)
    return FormatError(
        f"Not a valid gfx-replay: {fault} in its list of keyframes (byte {fault.at}): {path}", code="H3-HABITAT-063"
    )


def _item(text: bytes, group: str, index: int) -> Any:
    try:
        # msgspec refuses numbers that are too large, which may be the fault to explain
        return json.loads(text)[group][index]
    # a member may occur twice
    except (ValueError, RecursionError, LookupError, TypeError):
        return None


def _invalid(path: Path, reason: str, place: str) -> FormatError:
    return FormatError(
        f"Not a valid gfx-replay: {reason[:1].lower() + reason[1:]} at {place}: {path}", code="H3-HABITAT-059"
    )
