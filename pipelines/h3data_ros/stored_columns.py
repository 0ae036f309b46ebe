"""Storage of records as JSON, and of columns as rows of numbers, for data without a standard ROS message."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, H3DataError
from h3data.recording.records import Recording
from h3data.recording.schema import (
    Column,
    episode_from_dict,
    episode_to_dict,
    layout_of,
    struct_from_dict,
    struct_to_dict,
)

EPISODE_TOPIC, COLUMNS_TOPIC = "/h3data/episode", "/h3data/columns"
VERSION = 1
RECORDS = {
    "assets": "Asset",
    "bodies": "Body",
    "agents": "Agent",
    "skills": "Skill",
    "events": "Event",
    "inputs": "Input",
}
"""Fields of a `Recording` that are lists of records, with the names of their types."""


def carried(columns: Mapping[str, NDArray[Any]], told: Sequence[str]) -> list[Column]:
    """Return the columns for `COLUMNS_TOPIC`: all that no other message contains, without the time."""
    return [column for column in layout_of(columns) if column.name not in told and column.name != "time_ns"]


def labels_of(layout: Sequence[Column]) -> list[str]:
    """Return the names of the numbers in a row, such as ``metrics.dist_agents`` or ``agent_0.action.1``."""
    names = []
    for column in layout:
        width = _numbers(column)
        names += [column.name] if width == 1 else [f"{column.name}.{k}" for k in range(width)]
    return names


def rows_of(columns: Mapping[str, NDArray[Any]], layout: Sequence[Column], rows: int) -> NDArray[np.float64]:
    """Return columns as rows of numbers [T, W]; a 64-bit integer becomes two 32-bit ones, which float64 can hold."""
    parts = [np.zeros((rows, 0))]
    for column in layout:
        values = np.ascontiguousarray(columns[column.name]).reshape(rows, column.width)
        if values.dtype.kind in "iu" and values.dtype.itemsize == 8:
            values = values.view(np.uint32)
        parts.append(values.astype(np.float64))
    return np.concatenate(parts, axis=1)


def columns_from(rows: NDArray[np.float64], layout: Sequence[Column]) -> dict[str, NDArray[Any]]:
    """Return the columns from rows of numbers, as the inverse of `rows_of`.

    Raises:
        FormatError: the rows do not have the width of the layout.
    """
    widths = [_numbers(column) for column in layout]
    if rows.shape[1] != sum(widths):
        raise FormatError(
            f"Expected {sum(widths)} numbers in messages on {COLUMNS_TOPIC}, got {rows.shape[1]}. Hint: leave this topic "
            "out of the bag, and the rest is imported as that of any robot.",
            code="H3-ROS-002",
        )
    found, start = {}, 0
    for column, width in zip(layout, widths, strict=True):
        values = rows[:, start : start + width]
        start += width
        dtype = np.dtype(column.dtype)
        if dtype.kind in "iu" and dtype.itemsize == 8:
            values = np.ascontiguousarray(values.astype(np.uint32)).view(dtype)
        with np.errstate(invalid="ignore"):
            found[column.name] = values.astype(dtype).reshape(len(rows), *column.shape)
    return found


def episode_text(
    recording: Recording,
    layout: Sequence[Column],
    *,
    start_ns: int,
    robots: Mapping[int, str],
    people: Mapping[int, str],
) -> str:
    """Return the records of a recording as JSON, for `EPISODE_TOPIC`.

    Args:
        recording: Recording whose records are written.
        layout: Columns of `COLUMNS_TOPIC`.
        start_ns: Stamp of time 0 of the recording [ns].
        robots: Names of the frames of robots by number of the agent.
        people: Ids of people by number of the agent.
    """
    document = {
        "version": VERSION,
        "episode": episode_to_dict(recording.episode),
        "columns": [[c.name, c.dtype, list(c.shape)] for c in layout],
        "start_ns": start_ns,
        "robots": {str(k): frame for k, frame in robots.items()},
        "people": {str(k): name for k, name in people.items()},
    }
    document |= {field: [struct_to_dict(one) for one in getattr(recording, field)] for field in RECORDS}
    return json.dumps(document, ensure_ascii=False)


def read_episode(text: str, *, path: object) -> dict[str, Any]:
    """Return the contents of `episode_text`: the episode, the records, and the layout ``columns``.

    Raises:
        FormatError: the text is damaged, or has a newer version.
    """
    try:
        document = json.loads(text)
        if document["version"] > VERSION:
            raise FormatError(
                f"The bag is of a newer h3data ({EPISODE_TOPIC} has version {document['version']}, this reads {VERSION}). "
                f"Hint: pip install --upgrade h3data. {path}",
                code="H3-ROS-003",
            )
        values: dict[str, Any] = {
            "episode": episode_from_dict(document["episode"], path=path),
            "columns": [Column(str(n), str(d), tuple(map(int, shape))) for n, d, shape in document["columns"]],
            "start_ns": int(document["start_ns"]),
        }
        for agents in ("robots", "people"):
            values[agents] = {int(k): str(name) for k, name in document[agents].items()}
        for field, struct in RECORDS.items():
            values[field] = tuple(struct_from_dict(struct, one) for one in document[field])
    except H3DataError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as fault:
        raise FormatError(
            f"The message on {EPISODE_TOPIC} is damaged ({type(fault).__name__}: {fault}). Hint: leave this topic out of the "
            f"bag, and the rest is imported as that of any robot. {path}",
            code="H3-ROS-004",
        ) from None
    return values


def _numbers(column: Column) -> int:
    dtype = np.dtype(column.dtype)
    return column.width * (2 if dtype.kind in "iu" and dtype.itemsize == 8 else 1)
