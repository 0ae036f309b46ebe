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
from h3data_habitat.gfx.keyframes import Undecodable
from h3data_habitat.json_files import not_json, truncated
from h3data_habitat.json_stream import ArrayFault


def explain(path: Path, fault: Undecodable | ArrayFault) -> FormatError:
    """Return the error that says where and why a file is not a gfx-replay, and what else it looks like."""
    if isinstance(fault, ArrayFault):
        if str(fault) == "truncated":
            return truncated(path, fault.at)
        return FormatError(
            f"Not a valid gfx-replay: {fault} in its list of keyframes (byte {fault.at}): {path}", code="H3-HABITAT-063"
        )
    text, reason = fault.text, fault.fault
    content, damage = None, None if isinstance(reason, msgspec.ValidationError) else reason
    # text of another shape than expected may also stop being JSON further on
    if damage is None and fault.keyframe < 0:
        try:
            content = decode_json(text)
        except msgspec.DecodeError as found:
            damage = found
    if damage is not None:
        return not_json(path, text, damage, start=fault.start)
    is_replay = isinstance(content, dict) and not content.keys().isdisjoint(("keyframes", "keyframe"))
    if fault.keyframe >= 0 or (reason is not None and is_replay):
        what, _, where = str(reason).partition(" - at `")
        place = _place(fault, where.rstrip("`").removeprefix("$").removeprefix("."))
        return FormatError(
            f"Not a valid gfx-replay: {what[:1].lower() + what[1:]} at {place}: {path}", code="H3-HABITAT-059"
        )
    if isinstance(content, dict):
        keys = ", ".join(list(content)[:8]) or "none"
        shape = f"Its top-level keys are: {keys}; it looks like {json_format(content, name=path.name).title}."
    else:
        shape = f"It holds a JSON {type(content).__name__}."
    return FormatError(f"Expected a gfx-replay (JSON with the key 'keyframes'). {shape} {path}", code="H3-HABITAT-058")


def _place(fault: Undecodable, where: str) -> str:
    """Name the place ``where`` (a path of members and indices) of a fault; an instance is named by its key."""
    if fault.keyframe < 0:
        return where or "its top level"
    place = f"keyframe {fault.keyframe}"
    match = re.match(r"(\w+)(?:\[(\d+)\])?", where)
    if match is None:
        return place
    group, index = match.groups()
    item = None if index is None else _item(fault.text, group, int(index))
    key = item.get("instanceKey", item.get("id", item.get("name"))) if isinstance(item, dict) else None
    number = f", instance {key}" if key is not None else f"[{index}]" if index is not None else ""
    return f"{place}, {group}{number} ({where})"


def _item(text: bytes, group: str, index: int) -> Any:
    try:
        # msgspec refuses numbers that are too large, which may be the fault to explain
        return json.loads(text)[group][index]
    # a member may occur twice
    except (ValueError, RecursionError, LookupError, TypeError):
        return None
