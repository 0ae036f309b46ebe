"""Metadata of a LeRobot v3.0 dataset: info.json, tasks.parquet, stats.json.

These files only summarise the dataset; `rebuild_meta` writes them again from ``h3/schema.json`` and ``meta/episodes``.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import pyarrow as pa
import pyarrow.parquet as pq

from h3data.errors import FormatError
from h3data.recording.parquet.columns import conform
from h3data.recording.parquet.files import FILES_PER_CHUNK, shard_files, write_atomic
from h3data.recording.parquet.moments import Moments, lerobot_stats, merge_into, unpack_moments
from h3data.recording.parquet.schema import STANDARD, DatasetSchema, stored_dtype
from h3data.recording.parquet.videos import MAX_FILE_BYTES
from h3data.recording.schema import layout_hash
from h3data.recording.storage import AnyPath, RemotePath, place, readable

FILE_MB = 128


@dataclass
class Totals:
    """Contents of info.json, tasks.parquet and stats.json."""

    episodes: int = 0
    frames: int = 0
    tasks: dict[str, int] = field(default_factory=dict)
    """Index of each instruction in tasks.parquet."""
    moments: dict[str, Moments] = field(default_factory=dict)

    @classmethod
    def of(cls, root: AnyPath) -> Self:
        """Count all committed episodes of a dataset.

        Raises:
            FormatError: an episode table is damaged.
        """
        totals = cls()
        counted = pa.schema([("length", pa.int64()), ("tasks", pa.list_(pa.string())), ("task_index", pa.int64())])
        for path in shard_files(root, "meta/episodes"):
            try:
                # three columns of some hundred: statistics of each episode are most of the table
                table = conform(pq.read_table(readable(path), columns=counted.names), counted)
                moments = unpack_moments((table.schema.metadata or {}).get(b"h3data.moments", b""))
                totals.episodes += len(table)
                totals.frames += sum(table["length"].to_pylist())
                tasks = [told for (told,) in table["tasks"].to_pylist()]
                totals.tasks |= dict(zip(tasks, table["task_index"].to_pylist(), strict=True))
                merge_into(totals.moments, moments)
            except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, zlib.error) as error:
                raise FormatError(f"The episode table is damaged ({error}): {path}", code="H3-RECORDING-069") from error
        return totals


def write_meta(root: AnyPath, schema: DatasetSchema, totals: Totals) -> None:
    """Write ``meta/tasks.parquet`` and ``meta/stats.json``, and last ``meta/info.json``, which makes the dataset complete."""
    write_atomic(root / "meta" / "tasks.parquet", _tasks_parquet(totals.tasks))
    pictures = {video.key for video in schema.videos}
    stats = {
        # LeRobot has the statistics of pictures with the channels first, to be broadcast over [3, H, W]
        name: lerobot_stats(m, totals.frames, (3, 1, 1) if name in pictures else (-1,))
        for name, m in totals.moments.items()
    }
    write_atomic(root / "meta" / "stats.json", json.dumps(stats).encode())
    info = {
        "codebase_version": "v3.0",
        "robot_type": schema.robot_type,
        "total_episodes": totals.episodes,
        "total_frames": totals.frames,
        "total_tasks": len(totals.tasks),
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": MAX_FILE_BYTES >> 20,
        "fps": schema.fps,
        "splits": {"train": f"0:{totals.episodes}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": _features(schema),
        "h3data": {"schema_version": schema.version, "layout_hash": layout_hash(schema.columns)},
    }
    # last, because readers begin with it
    write_atomic(root / "meta" / "info.json", json.dumps(info, indent=1, ensure_ascii=False).encode())


def rebuild_meta(root: str | os.PathLike[str] | RemotePath) -> int:
    """Write info.json, tasks.parquet and stats.json again from the committed episodes; return their number."""
    at = place(root)
    schema, totals = DatasetSchema.load(at), Totals.of(at)
    write_meta(at, schema, totals)
    return totals.episodes


def _features(schema: DatasetSchema) -> dict[str, dict[str, Any]]:
    """Return ``features`` of info.json: every column of the data files, as LeRobot requires, and the videos."""
    pose7 = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    # without names LeRobot takes a feature for numbers 0, 1, ...; of most columns only the recording knows more
    names = {c.name: pose7 if c.shape == (7,) else None for c in schema.columns}
    names |= {name: list(each) for name, each in schema.names.items()}
    ours: dict[str, dict[str, Any]] = {
        c.name: {"dtype": stored_dtype(c), "shape": [c.width], "names": names[c.name]}
        for c in schema.columns
        if c.width
    }
    standard = {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in STANDARD.items()}
    return ours | standard | {video.key: video.lerobot(schema.fps) for video in schema.videos}


def _tasks_parquet(tasks: Mapping[str, int]) -> bytes:
    """Return a pandas table whose *index* is the task string, as LeRobot reads it; written without pandas."""
    # the name that pandas gives to an index without one
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
