"""Writing a Parquet dataset: one row per step, one row group per episode, LeRobot v3.0 layout, safe against crashes.

Episodes are gathered in *shards* of about 100. A shard is a data file, its sidecars (``h3/bodies``, ``h3/skills``, ...)
and an episode table. All are written under temporary names and renamed when they are complete, the episode table last:
its presence is the commit. What is not listed there does not exist for any reader.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording.lerobot_meta import (
    FILE_MB,
    FILES_PER_CHUNK,
    STANDARD,
    DatasetSchema,
    Moments,
    Totals,
    merge_into,
    moments_of,
    shard_files,
    shard_number,
    shard_path,
    union_layout,
    write_atomic,
    write_meta,
)
from h3data.recording.records import SCHEMA_VERSION, Recording
from h3data.recording.schema import (
    STRUCTS,
    Column,
    Layout,
    episode_to_dict,
    layout_hash,
    layout_of,
    layout_to_json,
    struct_to_dict,
)

SIDECARS = {"bodies": "Body", "assets": "Asset", "agents": "Agent", "skills": "Skill", "events": "Event"}
EPISODES_PER_FILE = 100
_ARROW = {"string": pa.string(), "int64": pa.int64(), "double": pa.float64(), "float": pa.float32()}
_EPISODE_FIELDS: list[tuple[str, pa.DataType]] = [
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


class DatasetWriter:
    """Writes recordings into a dataset folder.

    The columns of a dataset are fixed by its first episode, or up front by ``like`` (recordings whose columns it must
    hold as well) and ``max_bodies`` (moving bodies of the fullest scene). Later episodes may be narrower or lack columns
    - they are padded, and read back exactly - but not wider. As a context manager it commits all episodes that were added
    completely, also on an exception or Ctrl-C. One writer per folder at a time.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        fps: int = 30,
        overwrite: bool = False,
        resume: bool = False,
        max_bodies: int | None = None,
        like: Iterable[Recording] = (),
        episodes_per_file: int = EPISODES_PER_FILE,
        file_bytes: int = FILE_MB << 20,
    ) -> None:
        """Open a new folder, replace the dataset in it (``overwrite``), or go on after its last commit (``resume``)."""
        self.root = Path(root)
        self.closed = False
        self._fps, self._max_bodies = fps, max_bodies
        self._episodes_per_file, self._file_bytes = episodes_per_file, file_bytes
        self._totals, self._shard_index = Totals(), 0
        self._schema: DatasetSchema | None = None
        self._shard: _Shard | None = None
        if overwrite and resume:
            raise InputError("Choose one: overwrite=True starts anew, resume=True goes on.")
        with self._writing():
            self._open_root(overwrite=overwrite, resume=resume)
            if self._schema is None:
                self._declare(like)

    def __len__(self) -> int:
        """Episodes so far, with those not yet committed: the index of the next one."""
        return self._totals.episodes + (self._shard.episodes if self._shard else 0)

    def add(self, recording: Recording) -> int:
        """Append one episode and return its index. It is durable from the next commit on."""
        if self.closed:
            raise InputError(f"This dataset writer is closed: {self.root}")
        with self._writing():
            if self._schema is None:
                self._declare([recording])
            assert self._schema is not None
            layout = _checked_layout(recording, self._schema)
            row = episode_row(recording, layout)
            attachments = {name: self._store_file(name, data) for name, data in recording.attachments.items()}
            row["attachments"] = json.dumps(attachments, ensure_ascii=False)
            sidecars = {kind: [struct_to_dict(r) for r in getattr(recording, kind)] for kind in SIDECARS}
            index, start = len(self), self._totals.frames + (self._shard.frames if self._shard else 0)
            task = self._totals.tasks.setdefault(row["task"], len(self._totals.tasks))
            if self._shard is None:
                self._shard = _Shard(self.root, self._shard_index, self._schema)
            try:
                self._shard.add(recording, row, sidecars, index=index, start=start, task=task)
            except BaseException:
                shard, self._shard = self._shard, None  # a half-written row group spoils its file: drop the shard
                shard.discard()
                raise
        if self._shard.episodes >= self._episodes_per_file or self._shard.bytes >= self._file_bytes:
            self.commit()
        return index

    def commit(self) -> None:
        """Finish the current files: all episodes added so far survive whatever comes."""
        if self._shard is None or self._schema is None:
            return
        shard, self._shard = self._shard, None
        with self._writing():
            try:
                shard.commit()
            except BaseException:
                shard.discard()
                raise
            self._shard_index += 1
            self._totals.episodes += shard.episodes
            self._totals.frames += shard.frames
            merge_into(self._totals.moments, shard.moments)
            write_meta(self.root, self._schema, self._totals)

    def close(self) -> None:
        """Commit and end. A second call does nothing."""
        if not self.closed:
            self.commit()
            self.closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"DatasetWriter({str(self.root)!r}, {len(self)} episodes, {self._totals.episodes} committed)"

    # --- inside ---
    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except FileExistsError as error:
            raise InputError(f"Somebody else is writing this dataset: {error.filename}") from None
        except OSError as error:
            raise InputError(
                f"Could not write the dataset: {error.strerror or error}. Episodes committed before are safe; go on with "
                f"resume=True: {self.root}"
            ) from error

    def _open_root(self, *, overwrite: bool, resume: bool) -> None:
        root = self.root
        if root.exists() and not root.is_dir():
            raise InputError(f"Expected a folder for the dataset, this is a file: {root}")
        if not root.exists() or not any(root.iterdir()):
            root.mkdir(parents=True, exist_ok=True)
            return
        if not is_dataset(root):
            raise InputError(f"The folder exists and is not a dataset of h3data; choose another one: {root}")
        if overwrite:
            for name in ("meta", "data", "h3"):
                shutil.rmtree(root / name, ignore_errors=True)
        elif resume:
            self._resume()
        else:
            raise InputError(
                f"The dataset exists; choose another folder, pass overwrite=True (--force) to replace it or resume=True "
                f"to go on: {root}"
            )

    def _resume(self) -> None:
        if not (self.root / "h3" / "schema.json").exists():
            raise InputError(f"A dataset, but not written by h3data; choose another folder: {self.root}")
        self._schema = DatasetSchema.load(self.root)
        for leftover in self.root.glob("**/*.part"):
            leftover.unlink()
        committed = shard_files(self.root, "meta/episodes")
        self._shard_index = shard_number(committed[-1]) + 1 if committed else 0
        for kind in ("data", *(f"h3/{k}" for k in SIDECARS)):
            for path in shard_files(self.root, kind):
                if shard_number(path) >= self._shard_index:
                    path.unlink()  # renamed before the crash, never committed
        self._totals = Totals.of(self.root)

    def _declare(self, examples: Iterable[Recording]) -> None:
        """Fix the columns of the dataset so that all of these fit, and write them down; without any, do nothing."""
        layouts, robots = [], []
        for recording in examples:  # may be a generator: one recording in memory at a time
            layouts.append(layout_of(recording.columns))
            robots += [a.model or a.name for a in recording.agents if a.kind == "robot"]
        if not layouts:
            return
        columns = union_layout(layouts, max_bodies=self._max_bodies)
        faults = [f"{c.name!r} contains '/'" for c in columns if "/" in c.name]
        faults += [f"{c.name!r} is reserved by LeRobot" for c in columns if c.name in STANDARD]
        if faults:
            raise InputError(f"Columns that a LeRobot dataset cannot have: {'; '.join(faults)}. Rename them.")
        schema = DatasetSchema(columns=columns, fps=self._fps, robot_type=robots[0] if robots else "none")
        write_atomic(self.root / "h3" / "schema.json", schema.to_json())
        self._schema = schema

    def _store_file(self, name: str, data: bytes) -> str:
        """Keep an attachment under the hash of its contents; returns the file name below ``h3/files``."""
        suffix = "".join(c for c in Path(name).suffix[1:9].lower() if c.isascii() and c.isalnum())
        stored = hashlib.sha256(data).hexdigest() + (f".{suffix}" if suffix else "")
        path = self.root / "h3" / "files" / stored
        if not path.exists():
            write_atomic(path, bytes(data))
        return stored


class _Shard:
    """The files of up to ``episodes_per_file`` episodes until they are committed."""

    def __init__(self, root: Path, number: int, schema: DatasetSchema) -> None:
        self.root, self.number, self.schema = root, number, schema
        self.episodes = self.frames = self.row_groups = 0
        self.rows: list[dict[str, Any]] = []
        self.sidecars: dict[str, list[dict[str, Any]]] = {kind: [] for kind in SIDECARS}
        self.moments: dict[str, Moments] = {}
        self.parts: list[tuple[Path, Path]] = []
        self._arrow = _data_schema(schema)
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
        if steps:
            table = pa.Table.from_arrays([_to_arrow(arrays[name]) for name in self._arrow.names], schema=self._arrow)
            self._writer.write_table(table, row_group_size=steps)
        chunk, file = divmod(self.number, FILES_PER_CHUNK)
        place = {"episode_index": index, "tasks": [row["task"]], "task_index": task, "length": steps}
        place |= {"data/chunk_index": chunk, "data/file_index": file}
        place |= {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
        place |= {"dataset_from_index": start, "dataset_to_index": start + steps}
        self.rows.append({**row, **place, "row_group": self.row_groups if steps else -1})
        for kind, records in sidecars.items():
            self.sidecars[kind] += [{"episode_index": index, **record} for record in records]
        if steps:
            merge_into(self.moments, {name: moments_of(a) for name, a in arrays.items()})
        self.row_groups += steps > 0
        self.episodes += 1
        self.frames += steps

    def commit(self) -> None:
        self._writer.close()
        _sync(self._stream)
        for kind, struct in SIDECARS.items():
            fields = [("episode_index", pa.int64())]
            fields += [(name, _arrow_type(spec)) for name, spec in STRUCTS[struct].items()]
            self._write(f"h3/{kind}", pa.Table.from_pylist(self.sidecars[kind], schema=pa.schema(fields)))
        moments = json.dumps({name: m.to_lists() for name, m in self.moments.items()})
        metadata = {"h3data.schema_version": SCHEMA_VERSION, "h3data.moments": moments}
        self._write(
            "meta/episodes", pa.Table.from_pylist(self.rows, schema=pa.schema(_EPISODE_FIELDS, metadata=metadata))
        )
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


def is_dataset(root: Path) -> bool:
    """Whether a folder holds a dataset: LeRobot's info.json or our schema."""
    return (root / "meta" / "info.json").is_file() or (root / "h3" / "schema.json").is_file()


def episode_row(recording: Recording, layout: Layout) -> dict[str, Any]:
    """What the episode table says about a recording beside its place."""
    row = {**episode_to_dict(recording.episode), "columns": layout_to_json(layout)}
    try:
        for value in row.values():
            pa.scalar(value)
    except (OverflowError, UnicodeEncodeError, pa.ArrowException) as error:
        raise InputError(f"Episode {recording.episode.episode_id!r}: a value cannot be stored ({error}).") from None
    return row


def _checked_layout(recording: Recording, schema: DatasetSchema) -> Layout:
    """Layout of a recording that fits the dataset; an `InputError` lists every reason why it does not."""
    layout = layout_of(recording.columns)
    declared = {c.name: c for c in schema.columns}
    faults = []
    for column in layout:
        home = declared.get(column.name)
        if home is None:
            faults.append(f"{column} is not a column of the dataset")
        elif home.dtype != column.dtype or len(home.shape) != len(column.shape):
            faults.append(f"{column}, the dataset has {home}")
        elif any(n > m for n, m in zip(column.shape, home.shape, strict=True)):
            faults.append(f"{column} is wider than {home}")
    if faults:
        raise InputError(
            f"Episode {recording.episode.episode_id!r} does not fit this dataset: {'; '.join(faults[:8])}. "
            "Hint: declare the widest episodes before the first one, DatasetWriter(..., max_bodies=N, like=[recordings]), "
            "or write them to another dataset."
        )
    if abs(recording.episode.dt_ns * schema.fps - 1_000_000_000) > 10_000_000:
        raise InputError(
            f"Episode {recording.episode.episode_id!r} has steps of {recording.episode.dt_ns} ns, the dataset "
            f"{schema.fps} per second. Hint: DatasetWriter(..., fps=N)."
        )
    return layout


def padded(values: NDArray[Any] | None, column: Column, steps: int) -> NDArray[Any]:
    """Rows in the declared width, flattened to [T, width]; what is not there is NaN, -1, 0 (unsigned) or False."""
    if values is not None and values.shape[1:] == column.shape:
        return np.ascontiguousarray(values, column.dtype).reshape(steps, column.width)
    kind = np.dtype(column.dtype).kind
    wide = np.full((steps, *column.shape), {"f": np.nan, "i": -1}.get(kind, 0), column.dtype)
    if values is not None:
        wide[(slice(None), *(slice(0, n) for n in values.shape[1:]))] = values
    return wide.reshape(steps, column.width)


def _to_arrow(rows: NDArray[Any]) -> pa.Array:
    flat = rows.reshape(-1)
    if flat.dtype == bool:
        flat = pa.array(flat)
    else:  # pa.array(ndarray) looks for pandas on every call: 1.5 ms per episode
        flat = pa.Array.from_buffers(pa.from_numpy_dtype(flat.dtype), len(flat), [None, pa.py_buffer(flat)])
    return flat if rows.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, rows.shape[1])


def _arrow_type(spec: str) -> pa.DataType:
    plain = _ARROW[spec.rstrip("*")]
    return pa.list_(plain) if spec.endswith("*") else plain


def _data_schema(schema: DatasetSchema) -> pa.Schema:
    fields = [pa.field(name, pa.from_numpy_dtype(np.dtype(dtype))) for name, dtype in STANDARD.items()]
    for c in schema.columns:
        item = pa.from_numpy_dtype(np.dtype(c.dtype))
        if c.width:
            fields.append(pa.field(c.name, item if c.width == 1 else pa.list_(item, c.width)))
    return pa.schema(
        fields, metadata={"h3data.schema_version": SCHEMA_VERSION, "h3data.layout_hash": layout_hash(schema.columns)}
    )


def _parquet_options(schema: DatasetSchema) -> dict[str, Any]:
    """zstd-3, no dictionaries, BYTE_STREAM_SPLIT on floats: 424 B/step instead of 733 with pyarrow's defaults.

    Poses stay PLAIN: long runs of equal rows (13.5 instead of 15.2 B/step a base pose, 7.3 instead of 9.8 for 20 objects;
    joint rotations 703 split, 790 plain).
    """
    encodings = {}
    standard = [Column(name, dtype, ()) for name, dtype in STANDARD.items()]
    for c in (*standard, *schema.columns):
        path = c.name if c.width == 1 else f"{c.name}.list.element"
        if c.name.endswith("_pose"):
            encodings[path] = "PLAIN"
        elif c.dtype in ("float32", "float64"):
            encodings[path] = "BYTE_STREAM_SPLIT"
        elif c.dtype in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32"):
            encodings[path] = "DELTA_BINARY_PACKED"
    return {
        "compression": "zstd",
        "compression_level": 3,
        "use_dictionary": False,
        "column_encoding": encodings,
        "write_statistics": ["episode_index", "index", "frame_index", "task_index", "time_ns"],
        "write_page_checksum": True,
    }
