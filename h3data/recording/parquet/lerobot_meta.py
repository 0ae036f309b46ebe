"""The metadata that make a folder of Parquet files a LeRobot v3.0 dataset: info.json, tasks.parquet, stats.json.

They are summaries only: everything in them can be made again from ``h3/schema.json`` and ``meta/episodes`` (`rebuild_meta`).
"""

from __future__ import annotations

import base64
import json
import os
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, overload

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.files import part_file
from h3data.recording.parquet.arrow_columns import conform
from h3data.recording.records import SCHEMA_VERSION
from h3data.recording.schema import (
    CONVENTIONS,
    Column,
    Layout,
    check_version,
    layout_from_json,
    layout_hash,
    version_numbers,
)
from h3data.recording.storage import AnyPath, RemotePath, place, readable

FILES_PER_CHUNK = 1000
FILE_MB = 128
STANDARD = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns that LeRobot asks of every data file."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_POSE7 = ["x", "y", "z", "qx", "qy", "qz", "qw"]


@overload
def shard_path(root: Path, kind: str, shard: int) -> Path: ...
@overload
def shard_path(root: AnyPath, kind: str, shard: int) -> AnyPath: ...
def shard_path(root: AnyPath, kind: str, shard: int) -> AnyPath:
    """File number ``shard`` of a kind (``data``, ``meta/episodes``, ``h3/bodies``, ...)."""
    return root / kind / f"chunk-{shard // FILES_PER_CHUNK:03d}" / f"file-{shard % FILES_PER_CHUNK:03d}.parquet"


def shard_files(root: AnyPath, kind: str) -> list[AnyPath]:
    """All complete files of a kind, in order."""
    return sorted((root / kind).glob("chunk-*/file-*.parquet"), key=shard_number)


def shard_number(path: AnyPath) -> int:
    """The inverse of `shard_path`."""
    return int(path.parent.name.split("-")[1]) * FILES_PER_CHUNK + int(path.stem.split("-")[1])


def write_atomic(path: AnyPath, data: bytes) -> None:
    """Write a small file under its final name in one step."""
    if isinstance(path, RemotePath):
        path.put(data)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with part_file(path) as part, part.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


# --- the declared schema -----------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class DatasetSchema:
    """What every data file of a dataset holds, decided before the first one is written."""

    columns: Layout
    """Widest shape of every column."""
    fps: int
    robot_type: str
    version: str = SCHEMA_VERSION
    """Schema version of the whole dataset, also of the files that are added to it later."""

    def stored_dtype(self, column: Column) -> str:
        """The dtype of a column in the data files: since version 1.2 a uint64 is an int64 of the same bits.

        Torch tensors hold no uint64, so LeRobot's loader would refuse the whole dataset.
        """
        return "int64" if column.dtype == "uint64" and version_numbers(self.version) >= (1, 2) else column.dtype

    def to_json(self) -> bytes:
        """Contents of ``h3/schema.json``."""
        columns = [{"name": c.name, "dtype": c.dtype, "shape": list(c.shape)} for c in self.columns]
        values = {"schema_version": self.version, "layout_hash": layout_hash(self.columns)}
        values |= {"fps": self.fps, "robot_type": self.robot_type, "conventions": CONVENTIONS, "columns": columns}
        return json.dumps(values, indent=1, ensure_ascii=False).encode()

    @classmethod
    def load(cls, root: AnyPath) -> Self:
        """The schema of an existing dataset."""
        path = root / "h3" / "schema.json"
        try:
            values = json.loads(path.read_bytes())
            check_version(values["schema_version"], path=path)
            text = json.dumps([[c["name"], c["dtype"], c["shape"]] for c in values["columns"]], ensure_ascii=False)
            fps, robot, version = int(values["fps"]), str(values["robot_type"]), values["schema_version"]
            version_numbers(version)
            return cls(columns=layout_from_json(text), fps=fps, robot_type=robot, version=version)
        except FileNotFoundError:
            raise FormatError(f"Expected a dataset of h3data, there is no {path.name}: {path}") from None
        except (OSError, KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
            raise FormatError(f"The schema of the dataset is damaged ({error!r}): {path}") from error


def union_layout(layouts: Iterable[Layout], *, max_bodies: int | None = None) -> Layout:
    """The narrowest layout in which all of these fit; ``max_bodies`` widens ``object_pose``."""
    union: dict[str, Column] = {}
    faults = []
    for layout in layouts:
        for column in layout:
            known = union.setdefault(column.name, column)
            if known.dtype != column.dtype or len(known.shape) != len(column.shape):
                faults.append(f"{known} and {column}")
            else:
                shape = tuple(max(a, b) for a, b in zip(known.shape, column.shape, strict=True))
                union[column.name] = Column(column.name, column.dtype, shape)
    if faults:
        raise InputError(f"These columns cannot share a dataset: {'; '.join(faults[:8])}.")
    if max_bodies is not None:
        poses = union.get("object_pose", Column("object_pose", "float32", (0, 7)))
        union["object_pose"] = Column("object_pose", poses.dtype, (max(max_bodies, poses.shape[0]), *poses.shape[1:]))
    return tuple(union.values())


def features(schema: DatasetSchema) -> dict[str, dict[str, Any]]:
    """``features`` of info.json: every column of the data files, as LeRobot demands."""
    out: dict[str, dict[str, Any]] = {
        c.name: {"dtype": schema.stored_dtype(c), "shape": [c.width], "names": _POSE7 if c.shape == (7,) else None}
        for c in schema.columns
        if c.width
    }
    return out | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in STANDARD.items()}


# --- running totals ----------------------------------------------------------------------------------------------------
@dataclass
class Moments:
    """Count, mean, sum of squared deviations, extremes of the finite values of one feature, each of shape [width]."""

    count: NDArray[np.float64]
    mean: NDArray[np.float64]
    m2: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def to_lists(self) -> list[list[float]]:
        return [v.tolist() for v in (self.count, self.mean, self.m2, self.low, self.high)]

    @classmethod
    def from_lists(cls, lists: Iterable[Iterable[float]]) -> Self:
        return cls(*(np.array(list(v), np.float64) for v in lists))


def moments_of(values: NDArray[Any]) -> Moments:
    """Moments of rows [T, width]; NaN and infinities do not count."""
    x = values if values.dtype.kind == "f" and values.dtype != np.float16 else values.astype(np.float64)
    with np.errstate(all="ignore"):
        finite = np.isfinite(x)
        if len(x) and finite.all():
            mean = x.mean(0, dtype=np.float64)
            deviation = x - mean
            m2 = np.einsum("ij,ij->j", deviation, deviation)
            return Moments(np.full(x.shape[1], float(len(x))), mean, m2, x.min(0) * 1.0, x.max(0) * 1.0)
        count = finite.sum(0).astype(np.float64)
        mean = np.where(finite, x, 0).sum(0, dtype=np.float64) / np.maximum(count, 1)
        m2 = (np.where(finite, x - mean, 0) ** 2).sum(0, dtype=np.float64)
        low, high = (
            f(np.where(finite, x, fill), axis=0, initial=fill) for f, fill in ((np.min, np.inf), (np.max, -np.inf))
        )
        return Moments(count, mean, m2, np.asarray(low, np.float64), np.asarray(high, np.float64))


def merged(a: Moments, b: Moments) -> Moments:
    """Moments of both samples together (Chan et al. 1979)."""
    with np.errstate(all="ignore"):
        count = a.count + b.count
        share = b.count / np.maximum(count, 1)
        gap = b.mean - a.mean
        return Moments(
            count,
            a.mean + gap * share,
            a.m2 + b.m2 + gap * gap * a.count * share,
            np.minimum(a.low, b.low),
            np.maximum(a.high, b.high),
        )


def merge_into(total: dict[str, Moments], more: Mapping[str, Moments]) -> None:
    """Add the moments of more rows to ``total``."""
    for name, moments in more.items():
        total[name] = merged(total[name], moments) if name in total else moments


def pack_moments(moments: Mapping[str, Moments]) -> str:
    """Moments as text for Parquet metadata: base64 of deflated JSON, a third of its size."""
    text = json.dumps({name: m.to_lists() for name, m in moments.items()})
    return base64.b64encode(zlib.compress(text.encode())).decode()


def unpack_moments(packed: bytes) -> dict[str, Moments]:
    """The inverse of `pack_moments`; empty bytes give none."""
    lists = json.loads(zlib.decompress(base64.b64decode(packed))) if packed else {}
    return {name: Moments.from_lists(v) for name, v in lists.items()}


_COUNTED = pa.schema([("length", pa.int64()), ("task", pa.string()), ("task_index", pa.int64())])


@dataclass
class Totals:
    """What info.json, tasks.parquet and stats.json say."""

    episodes: int = 0
    frames: int = 0
    tasks: dict[str, int] = field(default_factory=dict)
    moments: dict[str, Moments] = field(default_factory=dict)

    @classmethod
    def of(cls, root: AnyPath) -> Self:
        """Totals of all committed episodes of a dataset."""
        totals = cls()
        for path in shard_files(root, "meta/episodes"):
            try:
                table = conform(pq.read_table(readable(path), columns=_COUNTED.names), _COUNTED)
                moments = unpack_moments((table.schema.metadata or {}).get(b"h3data.moments", b""))
                totals.episodes += len(table)
                totals.frames += sum(table["length"].to_pylist())
                totals.tasks |= dict(zip(table["task"].to_pylist(), table["task_index"].to_pylist(), strict=True))
                merge_into(totals.moments, moments)
            except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, zlib.error) as error:
                raise FormatError(f"The episode table is damaged ({error}): {path}") from error
        return totals


def write_meta(root: AnyPath, schema: DatasetSchema, totals: Totals) -> None:
    """Write ``meta/tasks.parquet``, ``meta/stats.json`` and, last, ``meta/info.json``."""
    write_atomic(root / "meta" / "tasks.parquet", _tasks_parquet(totals.tasks))
    stats = {name: _lerobot_stats(m, totals.frames) for name, m in totals.moments.items()}
    write_atomic(root / "meta" / "stats.json", json.dumps(stats).encode())
    info = {
        "codebase_version": "v3.0",
        "robot_type": schema.robot_type,
        "total_episodes": totals.episodes,
        "total_frames": totals.frames,
        "total_tasks": len(totals.tasks),
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": schema.fps,
        "splits": {"train": f"0:{totals.episodes}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": features(schema),
        "h3data": {"schema_version": schema.version, "layout_hash": layout_hash(schema.columns)},
    }
    write_atomic(root / "meta" / "info.json", json.dumps(info, indent=1, ensure_ascii=False).encode())


def rebuild_meta(root: str | os.PathLike[str] | RemotePath) -> int:
    """Make info.json, tasks.parquet and stats.json again from the episodes that are there; returns how many."""
    at = place(root)
    schema, totals = DatasetSchema.load(at), Totals.of(at)
    write_meta(at, schema, totals)
    return totals.episodes


def _lerobot_stats(m: Moments, frames: int) -> dict[str, list[float]]:
    """min, max, mean, std, count as LeRobot has them; a value that was never finite has zeros (JSON knows no NaN)."""
    seen = m.count > 0
    std = np.sqrt(m.m2 / np.maximum(m.count, 1))
    named = {"min": m.low, "max": m.high, "mean": m.mean, "std": std}
    out = {k: np.nan_to_num(np.where(seen, v, 0.0)).tolist() for k, v in named.items()}
    return {**out, "count": [frames]}


def _tasks_parquet(tasks: Mapping[str, int]) -> bytes:
    """A pandas table whose *index* is the task string, as LeRobot reads it; made without pandas."""
    index = "__index_level_0__"
    table = pa.table(
        {"task_index": pa.array(list(tasks.values()), pa.int64()), index: pa.array(list(tasks), pa.string())}
    )
    encoding = {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object"}
    number = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    text = {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    pandas = {
        "index_columns": [index],
        "column_indexes": [{**encoding, "metadata": {"encoding": "UTF-8"}}],
        "columns": [{**number, "metadata": None}, text],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    sink = pa.BufferOutputStream()
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), sink, compression="zstd")
    return sink.getvalue().to_pybytes()
