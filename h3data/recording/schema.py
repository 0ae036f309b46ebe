"""Column layouts, records and episodes as plain values, shared by both stores (MCAP, Parquet).

`Column` is one time-indexed array without its rows. `STRUCTS` lists the fields of the records that are not indexed by
time; the protobuf messages of the log and the Parquet sidecars of the dataset are both generated from it.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.recording.records import (
    OLDEST_VERSION,
    SCHEMA_VERSION,
    Agent,
    AssetRef,
    Body,
    Episode,
    Event,
    InputEvent,
    Recording,
    RecordingHeader,
    SkillSpan,
)

Topic = Literal["state", "action", "metrics", "input"]

CONVENTIONS = {
    "up": "+Y",
    "handedness": "right",
    "length": "m",
    "angle": "rad",
    "time": "ns since the episode began; row k is the state after action k",
    "quaternion": "xyzw",
    "pose7": "x y z qx qy qz qw, local to world",
    "absent": "NaN pose = the body is not in the world at that step",
}

DTYPES = frozenset(
    "bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 float32 float64".split()  # noqa: SIM905
)


@dataclass(frozen=True)
class Column:
    """Description of one column, without its rows."""

    name: str
    dtype: str
    """Name of the dtype in numpy, such as ``float32``."""
    shape: tuple[int, ...]
    """Shape of one row; ``()`` is a scalar."""

    @property
    def width(self) -> int:
        """Number of values per row."""
        return math.prod(self.shape)

    def empty(self, rows: int = 0) -> NDArray[Any]:
        """Return zeros of the column's type, shape [rows, *shape]."""
        return np.zeros((rows, *self.shape), self.dtype)

    def __str__(self) -> str:
        return f"{self.name} {self.dtype} [T{''.join(f', {n}' for n in self.shape)}]"


Layout = tuple[Column, ...]


def topic_of(column: str) -> Topic:
    """Return the kind of a column: state, an action, a measurement, or input of people."""
    if re.match(r"agent_\d+\.action$", column):
        return "action"
    if column.startswith("input."):
        return "input"
    return "metrics" if column.startswith("metrics.") else "state"


def log_topic_of(column: str) -> Topic:
    """Return the per-step topic of the log that a column is written to.

    Metrics share the topic of the state, because a separate topic took 21 B/step, 16 of them in the index.
    """
    return "action" if topic_of(column) == "action" else "state"


def layout_of(columns: Mapping[str, NDArray[Any]]) -> Layout:
    """Return the layout of arrays [T, ...], in their order; an `InputError` names every column that cannot be stored."""
    layout, faults = [], []
    for name, array in columns.items():
        array = np.asarray(array)
        dtype = array.dtype.name  # composed anew at each look
        if dtype not in DTYPES:
            faults.append(f"{name!r} has dtype {array.dtype}")
        elif array.ndim < 1:
            faults.append(f"{name!r} has no time axis")
        else:
            layout.append(Column(name, dtype, array.shape[1:]))
    if faults:
        raise InputError(
            f"Columns must be bool, integer or float arrays with time as axis 0, but {'; '.join(faults)}.",
            code="H3-RECORDING-108",
        )
    return tuple(layout)


def default_layout(header: RecordingHeader | Recording) -> Layout:
    """Return the smallest layout for given bodies and agents, used for episodes that end before their first step."""
    moving = sum(b.moving >= 0 for b in header.bodies)
    layout = [Column("time_ns", "int64", ())]
    if moving:
        layout.append(Column("object_pose", "float32", (moving, 7)))
    layout += [Column(f"agent_{i}.base_pose", "float32", (7,)) for i in range(len(header.agents))]
    return tuple(layout)


def required_columns(agents: int) -> set[str]:
    """Return the columns that every `Recording` must have."""
    return {"time_ns", "object_pose", *(f"agent_{i}.base_pose" for i in range(agents))}


def layout_hash(layout: Layout) -> str:
    """Return 16 hex digits that identify a layout."""
    return hashlib.sha256(layout_to_json(layout).encode()).hexdigest()[:16]


def layout_to_json(layout: Layout) -> str:
    """Return a JSON list of ``[name, dtype, shape]``."""
    return json.dumps([[c.name, c.dtype, list(c.shape)] for c in layout], ensure_ascii=False)


def layout_from_json(text: str) -> Layout:
    """Decode a layout that `layout_to_json` encoded; raise a `FormatError` if the text is not a layout."""
    try:
        layout = tuple(Column(str(n), str(d), tuple(int(s) for s in shape)) for n, d, shape in json.loads(text))
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise FormatError(
            f"Expected a JSON list of [name, dtype, shape], got {text[:80]!r}.", code="H3-RECORDING-111"
        ) from error
    unknown = sorted({c.dtype for c in layout} - DTYPES)
    if unknown:
        raise FormatError(
            f"Unknown dtypes {unknown} in a column layout. Hint: a newer h3data may read this file.",
            code="H3-RECORDING-109",
        )
    return layout


def check_version(version: str, *, path: object) -> None:
    """Raise a `FormatError` if the schema version of a file is unreadable, of a newer major version, or too old."""
    ours = int(SCHEMA_VERSION.partition(".")[0])
    try:
        # a third number is allowed, and says nothing about what can be read
        major, minor = (int(number) for number in version.split(".")[:2])
    except (ValueError, AttributeError):
        raise FormatError(
            f"Expected a schema version such as {SCHEMA_VERSION!r}, got {version!r}: {path}", code="H3-RECORDING-112"
        ) from None
    if major > ours:
        raise FormatError(
            f"Written with schema version {version}; this h3data reads up to {ours}.x. "
            f"Hint: install a newer h3data (pip install --upgrade h3data): {path}",
            code="H3-RECORDING-110",
        )
    if (major, minor) < OLDEST_VERSION:
        raise FormatError(
            f"Written with schema version {version} before h3data 0.2; this h3data reads {'.'.join(map(str, OLDEST_VERSION))} "
            f"and later. Hint: h3data 0.2.0 is the last that reads it; export it to another format with that: {path}",
            code="H3-RECORDING-129",
        )


# --- records that are not indexed by time -----------------------------------------------------------------------------
STRUCTS: dict[str, dict[str, str]] = {
    "Asset": {
        "name": "string",
        "uri": "string",
        "up": "double*",
        "front": "double*",
        "units_m": "double",
        "color": "int64*",
    },
    "Body": {
        "name": "string",
        "asset": "string",
        "pose": "float*",
        "scale": "float*",
        "semantic_id": "int64",
        "moving": "int64",
        "layer": "string",
        "agent": "int64",
    },
    "Agent": {
        "name": "string",
        "kind": "string",
        "model": "string",
        "semantic_id": "int64",
        "joint_names": "string*",
        "motion_names": "string*",
        "action_names": "string*",
        "skill_names": "string*",
    },
    "Event": {"step": "int64", "agent": "int64", "kind": "string", "target": "string", "detail": "string"},
    "Skill": {
        "agent": "int64",
        "name": "string",
        "target": "string",
        "start_step": "int64",
        "end_step": "int64",
        "outcome": "string",
        "reason": "string",
    },
    "Input": {"time_ns": "int64", "kind": "string", "user": "int64", "payload": "string"},
}
"""Fields of stored records in protobuf order (number = position + 1: append only, never reorder); ``*`` marks a
list."""

RECORD_TYPES: dict[str, type] = {
    "Asset": AssetRef,
    "Body": Body,
    "Agent": Agent,
    "Event": Event,
    "Skill": SkillSpan,
    "Input": InputEvent,
}
_STRUCT_NAMES = {cls: name for name, cls in RECORD_TYPES.items()}

_SCALARS: dict[str, Callable[[Any], Any]] = {"string": str, "int64": int, "double": float}
# Looked up for each record that is read, so it is made once. A whole number is a valid double.
_FIELDS = {
    struct: tuple(
        (name, kind, kind.endswith("*"), {"string": str, "int64": int}.get(kind.rstrip("*"), (float, int)))
        for name, kind in fields.items()
    )
    for struct, fields in STRUCTS.items()
}
"""Fields of each record, with their name, kind, whether they are lists, and the types of their values."""


def struct_to_dict(record: Any) -> dict[str, Any]:
    """Return the fields of a stored record as plain values, with poses and scales rounded to float32."""
    values: dict[str, Any] = {}
    for name, kind in STRUCTS[_STRUCT_NAMES[type(record)]].items():
        value = getattr(record, name)
        if kind == "float*":
            values[name] = np.asarray(value, np.float32).ravel().tolist()
        elif kind.endswith("*"):
            values[name] = [] if value is None else [_SCALARS[kind[:-1]](v) for v in value]
        else:
            values[name] = _SCALARS[kind](value)
    return values


def struct_from_dict(struct: str, values: Mapping[str, Any]) -> Any:
    """Decode a record that `struct_to_dict` encoded; fields that the file lacks get their defaults.

    Raises:
        FormatError: a field has another type.
    """
    arguments: dict[str, Any] = {}
    for name, kind, many, types in _FIELDS[struct]:
        value = values.get(name)
        if value is None:
            continue
        if kind == "float*":
            arguments[name] = np.array(value, np.float32)
            continue
        if not many:
            sound = isinstance(value, types)
        else:
            sound = isinstance(value, list | tuple) and all(isinstance(v, types) for v in value)
        if not sound:
            raise FormatError(
                f"Expected {kind.replace('*', ' values')} in {struct}.{name}, got {value!r:.60}.",
                code="H3-RECORDING-113",
            )
        arguments[name] = tuple(value) if many else value
    # protobuf and Arrow have no None for a list: no colour is stored as an empty one
    if arguments.get("color") == ():
        arguments["color"] = None
    return RECORD_TYPES[struct](**arguments)


# --- the episode itself -----------------------------------------------------------------------------------------------
def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} is not JSON")


def info_to_json(info: Mapping[str, Any]) -> str:
    """Encode `Episode.info` as JSON; NumPy numbers and arrays become plain numbers and lists."""
    try:
        return json.dumps(dict(info), ensure_ascii=False, default=_plain)
    except (TypeError, ValueError) as error:
        raise InputError(f"Episode.info must hold only what JSON can hold: {error}.", code="H3-RECORDING-114") from None


def episode_to_dict(episode: Episode) -> dict[str, Any]:
    """Return the fields of an episode as plain values, with ``info`` as JSON text."""
    return {
        "uid": str(episode.uid),
        "episode_id": str(episode.episode_id),
        "task": str(episode.task),
        "scene": str(episode.scene),
        "seed": int(episode.seed),
        "dt_ns": int(episode.dt_ns),
        "created_by": str(episode.created_by),
        "schema_version": str(episode.schema_version),
        "info": info_to_json(episode.info),
    }


def episode_from_dict(values: Mapping[str, Any], *, path: object) -> Episode:
    """Decode an episode that `episode_to_dict` encoded; numbers may be given as text."""
    try:
        texts = {k: str(values[k]) for k in ("uid", "episode_id", "task", "scene", "created_by", "schema_version")}
        # before the rest, which a newer version may write otherwise
        check_version(texts["schema_version"], path=path)
        episode = Episode(
            **texts, seed=int(values["seed"]), dt_ns=int(values["dt_ns"]), info=json.loads(values["info"])
        )
    except (KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise FormatError(
            f"The episode record is incomplete or malformed ({error}): {path}", code="H3-RECORDING-115"
        ) from error
    return episode


def ordered(columns: Mapping[str, NDArray[Any]], names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Return columns in the order of ``names``."""
    return {name: columns[name] for name in names if name in columns}
