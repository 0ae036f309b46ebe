"""One shard of a dataset: a data file, its sidecars and its episode table, invisible until all are complete."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from h3data.errors import InputError
from h3data.recording.parquet.arrow_columns import padded, to_arrow
from h3data.recording.parquet.lerobot_meta import (
    FILES_PER_CHUNK,
    STANDARD,
    DatasetSchema,
    Moments,
    merge_into,
    moments_of,
    pack_moments,
    shard_path,
)
from h3data.recording.records import Recording
from h3data.recording.schema import STRUCTS, Column, layout_hash

ZSTD_LEVEL, PAGE_BYTES = 6, 8 << 20
SIDECARS = {
    "bodies": "Body",
    "assets": "Asset",
    "agents": "Agent",
    "skills": "Skill",
    "events": "Event",
    "inputs": "Input",
}
SIDECAR_SINCE = {"inputs": (1, 3)}
"""Schema version from which on every shard has this sidecar."""
_ARROW = {"string": pa.string(), "int64": pa.int64(), "double": pa.float64(), "float": pa.float32()}
EPISODE_SCHEMA = pa.schema(
    [
        ("episode_index", pa.int64()),
        ("tasks", pa.list_(pa.string())),
        ("length", pa.int64()),
        ("data/chunk_index", pa.int64()),
        ("data/file_index", pa.int64()),
        ("dataset_from_index", pa.int64()),
        ("dataset_to_index", pa.int64()),
        ("meta/episodes/chunk_index", pa.int64()),
        ("meta/episodes/file_index", pa.int64()),
        ("uid", pa.string()),
        ("episode_id", pa.string()),
        ("task", pa.string()),
        ("scene", pa.string()),
        ("seed", pa.int64()),
        ("dt_ns", pa.int64()),
        ("task_index", pa.int64()),
        ("created_by", pa.string()),
        ("schema_version", pa.string()),
        ("info", pa.string()),
        ("row_group", pa.int64()),
        ("columns", pa.string()),
        ("attachments", pa.string()),
    ]
)


class Shard:
    """The files of up to ``episodes_per_file`` episodes until they are committed."""

    def __init__(self, root: Path, number: int, schema: DatasetSchema) -> None:
        self.root, self.number, self.schema = root, number, schema
        self.episodes = self.frames = self.row_groups = 0
        self.rows: list[dict[str, Any]] = []
        self.sidecars: dict[str, list[pa.Table]] = {kind: [] for kind in SIDECARS}
        self.moments: dict[str, Moments] = {}
        self.parts: list[tuple[Path, Path]] = []
        self.spoiled = False
        """A row group was begun and not finished: nothing of this file can be used."""
        self._arrow = data_schema(schema)
        self._stream = self._open("data")
        self._writer = pq.ParquetWriter(self._stream, self._arrow, **_parquet_options(schema))

    @property
    def bytes(self) -> int:
        return self._stream.tell()

    def add(
        self,
        recording: Recording,
        row: dict[str, Any],
        sidecars: dict[str, list[dict[str, Any]]],
        *,
        index: int,
        start: int,
        task: int,
    ) -> None:
        steps = len(recording)
        arrays = {c.name: padded(recording.columns.get(c.name), c, steps) for c in self.schema.columns if c.width}
        frame = np.arange(steps, dtype=np.int64)
        standard = {
            "timestamp": (frame / self.schema.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(steps, index, np.int64),
            "index": frame + start,
            "task_index": np.full(steps, task, np.int64),
        }
        arrays |= {name: values[:, None] for name, values in standard.items()}
        for c in self.schema.columns:
            if c.width:  # the same bits
                arrays[c.name] = arrays[c.name].view(self.schema.stored_dtype(c))
        table = pa.Table.from_arrays([to_arrow(arrays[name]) for name in self._arrow.names], schema=self._arrow)
        records = {kind: _record_table(kind, of, index) for kind, of in sidecars.items() if of}
        moments = {name: moments_of(a) for name, a in arrays.items()}
        chunk, file = divmod(self.number, FILES_PER_CHUNK)
        place = {"episode_index": index, "tasks": [row["task"]], "task_index": task, "length": steps}
        place |= {"data/chunk_index": chunk, "data/file_index": file}
        place |= {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
        place |= {"dataset_from_index": start, "dataset_to_index": start + steps}
        self.spoiled = True  # from here to the end all or nothing
        if steps:
            self._writer.write_table(table, row_group_size=steps)
            merge_into(self.moments, moments)
        self.rows.append({**row, **place, "row_group": self.row_groups if steps else -1})
        for kind, of in records.items():
            self.sidecars[kind].append(of)
        self.row_groups += steps > 0
        self.episodes += 1
        self.frames += steps
        self.spoiled = False

    def commit(self) -> None:
        self._writer.close()
        _sync(self._stream)
        for kind, struct in SIDECARS.items():
            tables = [record_schema(struct).empty_table(), *self.sidecars[kind]]
            self._write(f"h3/{kind}", pa.concat_tables(tables).combine_chunks())
        metadata = {"h3data.schema_version": self.schema.version, "h3data.moments": pack_moments(self.moments)}
        self._write("meta/episodes", pa.Table.from_pylist(self.rows, schema=EPISODE_SCHEMA.with_metadata(metadata)))
        for part, final in self.parts:  # the episode table is the last: its name is the commit
            os.replace(part, final)

    def discard(self) -> None:
        with contextlib.suppress(Exception):  # its disk may be full; nothing of this file is wanted
            self._writer.close()
        with contextlib.suppress(OSError):
            self._stream.close()
        for part, _ in self.parts:
            part.unlink(missing_ok=True)

    def _open(self, kind: str) -> IO[bytes]:
        final = shard_path(self.root, kind, self.number)
        final.parent.mkdir(parents=True, exist_ok=True)
        part = final.with_name(f"_{final.name}.part")  # readers of whole folders skip names with an underscore
        stream = open_shard_file(part)
        self.parts.append((part, final))
        return stream

    def _write(self, kind: str, table: pa.Table) -> None:
        with self._open(kind) as stream:
            pq.write_table(table, stream, compression="zstd", write_page_checksum=True)
            _sync(stream)


def open_shard_file(part: Path) -> IO[bytes]:
    """A new file under its temporary name; tests replace this by disks that fill up."""
    return open(part, "xb")


def _sync(stream: IO[bytes]) -> None:
    stream.flush()
    os.fsync(stream.fileno())
    stream.close()


def _arrow_type(spec: str) -> pa.DataType:
    plain = _ARROW[spec.rstrip("*")]
    return pa.list_(plain) if spec.endswith("*") else plain


def record_schema(struct: str) -> pa.Schema:
    """Arrow schema of the records of a kind, one of `STRUCTS`."""
    fields = [("episode_index", pa.int64())]
    return pa.schema(fields + [(name, _arrow_type(spec)) for name, spec in STRUCTS[struct].items()])


def _record_table(kind: str, records: list[dict[str, Any]], index: int) -> pa.Table:
    """The records of episode ``index``; an `InputError` if a value cannot be stored."""
    rows = [{"episode_index": index, **record} for record in records]
    try:
        return pa.Table.from_pylist(rows, schema=record_schema(SIDECARS[kind]))
    except (OverflowError, UnicodeEncodeError, pa.ArrowException) as error:
        raise InputError(f"The {kind} of episode {index}: a value cannot be stored ({error}).") from None


def data_schema(schema: DatasetSchema) -> pa.Schema:
    """Arrow schema of the data files: LeRobot's columns, then ours that have a width."""
    fields = [pa.field(name, pa.from_numpy_dtype(np.dtype(dtype))) for name, dtype in STANDARD.items()]
    for c in schema.columns:
        item = pa.from_numpy_dtype(np.dtype(schema.stored_dtype(c)))
        if c.width:
            fields.append(pa.field(c.name, item if c.width == 1 else pa.list_(item, c.width)))
    return pa.schema(
        fields, metadata={"h3data.schema_version": schema.version, "h3data.layout_hash": layout_hash(schema.columns)}
    )


def _parquet_options(schema: DatasetSchema) -> dict[str, Any]:
    """zstd-6, no dictionaries, BYTE_STREAM_SPLIT on floats: 424 B/step instead of 733 with pyarrow's defaults.

    Poses and actions stay PLAIN: long runs of equal rows (13.4 instead of 14.9 B/step a base pose, 7.5 instead of 9.9 for
    20 objects; joint rotations 699 split, 790 plain). Pages are as large as an episode's column, so that the four byte
    streams of all its steps are compressed as one (a looping clip: 15 B/step instead of 30 with pages of 1 MiB).
    """
    encodings = {}
    standard = [Column(name, dtype, ()) for name, dtype in STANDARD.items()]
    for c in (*standard, *schema.columns):
        path = c.name if c.width == 1 else f"{c.name}.list.element"
        if c.name.endswith(("_pose", ".action")):
            encodings[path] = "PLAIN"
        elif c.dtype in ("float32", "float64"):
            encodings[path] = "BYTE_STREAM_SPLIT"
        elif schema.stored_dtype(c) in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32"):
            encodings[path] = "DELTA_BINARY_PACKED"
    return {
        "compression": "zstd",
        "compression_level": ZSTD_LEVEL,
        "data_page_size": PAGE_BYTES,
        "use_dictionary": False,
        "column_encoding": encodings,
        "write_statistics": ["episode_index", "index", "frame_index", "task_index", "time_ns"],
        "write_page_checksum": True,
    }
