"""Parser of tables with tracks of people: CSV, ETH/UCY, TrajNet++, THÖR-MAGNI and ATC."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data_ros.track_recording import Array

NAMES = {
    "t": ("t", "time", "timestamp", "time_s", "timestamp_s", "sec", "seconds"),
    "frame": ("frame", "frame_id", "frame_number", "framenumber", "f"),
    "id": ("id", "agent_id", "ped_id", "person_id", "track_id", "pedestrian_id", "ag_id", "agent", "person", "p"),
    "x": ("x", "pos_x", "x_m", "px"),
    "y": ("y", "pos_y", "y_m", "py"),
    "heading": ("heading", "theta", "yaw", "facing"),
}
"""Accepted names of columns in lower case, by meaning; the first that a file has is used."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
EPOCH_S = 1e8
"""Time above which values are seconds since 1970, which distinguishes ATC's tables from others of eight numbers."""
MAGNI_HZ = 100.0
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*|\s*[+-]?nan\s*", re.IGNORECASE)
_HEADER_LINES = 200
"""Largest number of lines about the file before the header of a THÖR-MAGNI table."""
_MARKER = re.compile(r"(?P<body>\S+) (?:Centroid_|- \d+ )(?P<axis>[XY])$")


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackTable:
    """Observations in a file of tracks, one per row."""

    layout: str
    """Name of the kind of file."""
    ids: Sequence[str]
    """Identity of the person in each row, shape [N]."""
    t: Array
    """Times [s], or frame numbers, shape [N]."""
    frames: bool
    """True if ``t`` counts frames."""
    xy: Array
    """Positions in the unit of the file, shape [N, 2]."""
    heading: Array | None = None
    """Headings about +z [rad], shape [N]; None if the file has none."""
    unit: str = "m"
    """Unit of length in this kind of file."""
    left_out: Sequence[str] = ()
    """Number of bodies in the file that are not people."""


def parse_table(text: str, columns: Sequence[str], robot: str, *, path: object) -> TrackTable:
    """Return the observations of a file of tracks.

    Args:
        text: Content of the file.
        columns: Names of the columns in order (``_`` for an ignored one), or ``meaning=name``. If empty, they are those
            of the first line, or the usual ones of files of numbers.
        robot: Id of the robot, which is included even if it is not a person.
        path: Name of the file for messages.

    Raises:
        InputError: a necessary column is missing.
        FormatError: the file is damaged, or empty.
    """
    lines = text.splitlines()
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith(("#", "%"))), "")
    if not first:
        raise FormatError(f"The file of tracks is empty: {path}", code="H3-ROS-039")
    if first.lstrip().startswith("{"):
        return _trajnet(lines, path)
    for number, line in enumerate(lines[:_HEADER_LINES]):
        if line.lower().startswith(("frame,", "frame\t", "time,", "time\t")) and (
            "Centroid_X" in line or " - 1 X" in line
        ):
            return _magni("\n".join(lines[number:]), robot, path)
    delimiter = next((d for d in (",", ";", "\t") if d in first), None)
    fields = [f.strip().strip("\"'") for f in first.split(delimiter)]
    numeric = sum(_NUMBER.fullmatch(field) is not None for field in fields) >= 2  # ids may be words
    start = lines.index(first)
    body = lines[start if numeric else start + 1 :]
    names = [str(k) for k in range(len(fields))] if numeric else [field.lower() for field in fields]
    chosen, layout, unit = _chosen(names, columns, fields, numeric, delimiter, path)
    values = {meaning: [*_column(body, delimiter, index, len(fields), path)] for meaning, index in chosen.items()}
    if not values["id"]:
        raise FormatError(f"The file of tracks has no rows: {path}", code="H3-ROS-040")
    numbers = {
        meaning: _numbers(texts, names[chosen[meaning]], path) for meaning, texts in values.items() if meaning != "id"
    }
    return TrackTable(
        layout=layout,
        ids=[_id(text) for text in values["id"]],
        t=numbers["t" if "t" in numbers else "frame"],
        frames="t" not in numbers,
        xy=np.stack([numbers["x"], numbers["y"]], axis=1),
        heading=numbers.get("heading"),
        unit=unit,
    )


def _chosen(
    names: Sequence[str],
    columns: Sequence[str],
    fields: Sequence[str],
    numeric: bool,
    delimiter: str | None,
    path: object,
) -> tuple[dict[str, int], str, str]:
    """Return the index of the column of each meaning, the kind of the file and its unit."""
    if columns and all("=" in column for column in columns):
        wanted = dict(column.split("=", 1) for column in columns)
        unknown = [name for name in wanted if name not in NAMES]
        missing = [name for name in wanted.values() if name.lower() not in names]
        if unknown or missing:
            raise InputError(
                f"--columns {(unknown or missing)[0]!r} is {'no meaning' if unknown else 'no column'}. Expected "
                f"{', '.join(NAMES) if unknown else ', '.join(fields)}: {path}",
                code="H3-ROS-041",
            )
        chosen = {meaning: names.index(name.lower()) for meaning, name in wanted.items()}
        return _complete(chosen, fields, path), "table", "m"
    if columns:
        if len(columns) != len(fields):
            raise InputError(
                f"--columns names {len(columns)} columns, the file has {len(fields)} ({', '.join(fields[:12])}): {path}",
                code="H3-ROS-042",
            )
        return _complete(_by_name([column.lower() for column in columns]), fields, path), "table", "m"
    if not numeric:
        return _complete(_by_name(names), fields, path), "table", "m"
    if len(fields) == 8 and delimiter == "," and _NUMBER.fullmatch(fields[0]) and float(fields[0]) > EPOCH_S:
        return {"t": 0, "id": 1, "x": 2, "y": 3, "heading": 7}, "ATC", "mm"
    if len(fields) == 8 and delimiter is None:
        return {"frame": 0, "id": 1, "x": 2, "y": 4}, "ETH/UCY obsmat", "m"
    if len(fields) == 4 and delimiter in (None, "\t"):
        return {"frame": 0, "id": 1, "x": 2, "y": 3}, "frame id x y", "m"
    raise InputError(
        f"The file has {len(fields)} columns without names. Hint: name them in their order, as in --columns t,id,x,y,_: {path}",
        code="H3-ROS-043",
    )


def _by_name(names: Sequence[str]) -> dict[str, int]:
    found = {}
    for meaning, known in NAMES.items():
        index = next((names.index(name) for name in known if name in names), None)
        if index is not None:
            found[meaning] = index
    return found


def _complete(chosen: dict[str, int], fields: Sequence[str], path: object) -> dict[str, int]:
    missing = [meaning for meaning in ("id", "x", "y") if meaning not in chosen]
    missing += [] if "t" in chosen or "frame" in chosen else ["t"]
    if missing:
        raise InputError(
            f"No column of the file is known as {', '.join(missing)}; it has {', '.join(fields[:20])}. Hint: --columns "
            f"t=NAME,id=NAME,x=NAME,y=NAME: {path}",
            code="H3-ROS-044",
        )
    return chosen


def _column(lines: Sequence[str], delimiter: str | None, index: int, width: int, path: object) -> Any:
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith(("#", "%")):
            continue
        fields = line.split(delimiter)
        if len(fields) != width:
            raise FormatError(
                f"Row {number} has {len(fields)} columns, the first has {width}. Hint: the file may be cut off: {path}",
                code="H3-ROS-045",
            )
        yield fields[index]


def _numbers(texts: Sequence[str], name: str, path: object) -> Array:
    try:
        return np.array([text.strip() or "nan" for text in texts], np.float64)
    except ValueError:
        wrong = next(text for text in texts if text.strip() and not _NUMBER.fullmatch(text))
        raise FormatError(f"Expected numbers in column {name}, got {wrong!r:.40}: {path}", code="H3-ROS-046") from None


def _id(text: str) -> str:
    """Return the text of an id; 7.0000e+00 is 7."""
    text = text.strip().strip("\"'")
    if _NUMBER.fullmatch(text) and float(text).is_integer():
        return str(int(float(text)))
    return text


def _trajnet(lines: Sequence[str], path: object) -> TrackTable:
    """Read TrajNet++: an object a line, ``{"track": {"f": frame, "p": person, "x": x, "y": y}}``, after the scenes."""
    tracks: list[tuple[float, str, float, float]] = []
    rates: set[float] = set()
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            document = json.loads(line)
            if "track" in document:
                one = document["track"]
                if one.get("prediction_number") is None:
                    tracks.append((float(one["f"]), str(one["p"]), float(one["x"]), float(one["y"])))
            elif "fps" in document.get("scene", {}):
                rates.add(float(document["scene"]["fps"]))
        except (ValueError, KeyError, TypeError, AttributeError) as fault:
            raise FormatError(
                f"Line {number} is no track of TrajNet++ ({type(fault).__name__}: {fault}): {path}", code="H3-ROS-047"
            ) from None
    if not tracks:
        raise FormatError(f"The file of tracks has no rows: {path}", code="H3-ROS-040")
    frames = np.array([t for t, *_ in tracks])
    step = np.diff(np.unique(frames))
    rate = rates.pop() * float(step.min()) if len(rates) == 1 and len(step) else None
    xy = np.array([place for *_, x, y in tracks for place in (x, y)]).reshape(-1, 2)
    ids = [name for _, name, *_ in tracks]
    return TrackTable(layout="TrajNet++", ids=ids, t=frames / rate if rate else frames, frames=rate is None, xy=xy)


def _magni(text: str, robot: str, path: object) -> TrackTable:
    """Read THÖR-MAGNI: a row a frame at 100 Hz, columns ``Helmet_1 Centroid_X`` or markers ``Helmet_1 - 1 X`` [mm]."""
    from pyarrow import ArrowInvalid, csv

    delimiter = "\t" if "\t" in text.partition("\n")[0] else ","
    try:
        table = csv.read_csv(io.BytesIO(text.encode()), parse_options=csv.ParseOptions(delimiter=delimiter))
    except ArrowInvalid as fault:
        raise FormatError(
            f"The table of THÖR-MAGNI is damaged ({str(fault)[:120]}): {path}", code="H3-ROS-048"
        ) from None

    def numbers(name: str) -> Array:
        try:
            return table[name].cast("float64").to_numpy().astype(np.float64)
        except ArrowInvalid:
            raise FormatError(f"Expected numbers in column {name}: {path}", code="H3-ROS-059") from None

    lower = {name.lower(): name for name in table.column_names}
    t = numbers(lower["time"]) if "time" in lower else numbers(lower["frame"]) / MAGNI_HZ
    bodies: dict[str, dict[str, list[str]]] = {}
    for name in table.column_names:
        if match := _MARKER.fullmatch(name):
            bodies.setdefault(match["body"], {}).setdefault(match["axis"], []).append(name)
    people = [body for body in bodies if body.startswith("Helmet") or body == robot]
    ids: list[str] = []
    xy: list[Array] = []
    for body in people:
        axes = []
        for axis in ("X", "Y"):
            its = bodies[body].get(axis, [])
            its = [name for name in its if "Centroid" in name] or its
            values = np.stack([numbers(name) for name in its], axis=1) if its else np.full((len(t), 1), np.nan)
            known = np.isfinite(values)
            with np.errstate(invalid="ignore"):
                axes.append(np.where(known, values, 0).sum(axis=1) / known.sum(axis=1))
        xy.append(np.stack(axes, axis=1))
        ids += [body] * len(t)
    if not people:
        raise FormatError(f"The table has no columns of helmets: {path}", code="H3-ROS-049")
    left = [body for body in bodies if body not in people]
    places = np.concatenate(xy)
    seen = np.isfinite(places).all(axis=1)  # empty fields are people who are away, not faults
    names = [ids[k] for k in np.flatnonzero(seen)]
    times = np.tile(t, len(people))[seen]
    return TrackTable(layout="THÖR-MAGNI", ids=names, t=times, frames=False, xy=places[seen], unit="mm", left_out=left)


def by_id(ids: Sequence[str]) -> dict[str, NDArray[np.intp]]:
    """Return the rows of each id, in order of first appearance."""
    names, first, code = np.unique(np.array(ids, dtype=str), return_index=True, return_inverse=True)
    order = np.argsort(code, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(code))[:-1])
    return {str(names[k]): parts[k] for k in np.argsort(first).tolist()}
