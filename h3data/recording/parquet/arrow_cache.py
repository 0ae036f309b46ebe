"""Columns of a dataset as memory-mapped Arrow files: for training, which reads the same episodes over and over in any order.

A Parquet row group is decoded as a whole, a mapped file gives any row at once, and all workers share its pages. One file
holds some columns of one shard, an uncompressed record batch for each row group. The cache lies in ``$H3DATA_CACHE/arrow``
or ``~/.cache/h3data/arrow`` (`h3data.files.cache_folder`), keeps what was used last up to ``H3DATA_CACHE_GB`` gigabytes (20),
and may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from h3data.errors import InputError
from h3data.files import cache_folder, part_file
from h3data.recording import tables
from h3data.recording.parquet.lerobot_meta import shard_path
from h3data.recording.storage import AnyPath, RemotePath

if TYPE_CHECKING:
    from h3data.recording.parquet.dataset import Dataset

log = logging.getLogger(__name__)

FORMAT = 1


def open_cached(dataset: Dataset, shard: int, columns: Sequence[str]) -> pa.ipc.RecordBatchFileReader | None:
    """The mapped columns of a shard, batch k for row group k; made now if they are not there.

    None if there is no cache (``H3DATA_CACHE=off``) or it cannot be written.
    """
    folder = cache_folder("arrow")
    if folder is None:
        return None
    episodes = [k for k, row in enumerate(dataset.rows) if row["length"] and dataset.shard_of(row) == shard]
    schema = tables.table_schema(dataset, columns)
    path = folder / f"{_key(dataset, shard, episodes, schema)}.arrow"
    try:
        if (reader := _opened(path, schema, len(episodes))) is None:
            folder.mkdir(parents=True, exist_ok=True)
            with part_file(path, shared=True) as part, pa.ipc.new_file(str(part), schema) as writer:
                for episode in episodes:
                    writer.write(tables.to_arrow(dataset, columns=columns, episodes=[episode]).combine_chunks())
            reader = _opened(path, schema, len(episodes))
            with suppress(FileNotFoundError):  # other workers evict too
                _evict(folder, keep=path)
        return reader
    except OSError as fault:
        log.info("The columns are not cached: %s", fault)
        return None


def _opened(path: Path, schema: pa.Schema, batches: int) -> pa.ipc.RecordBatchFileReader | None:
    """A file of the cache, marked as used; None if it is not there or not what it should be."""
    if not path.is_file():
        return None
    try:
        reader = pa.ipc.open_file(pa.memory_map(str(path)))
        if reader.schema.equals(schema) and reader.num_record_batches == batches:
            os.utime(path)
            return reader
    except pa.ArrowException as fault:
        log.warning("A cached file is broken and is made again (%s): %s", fault, path)
    return None


def _key(dataset: Dataset, shard: int, episodes: Sequence[int], schema: pa.Schema) -> str:
    """Name of the file for these columns of this very data file."""
    path = shard_path(dataset.root, "data", shard)
    uids = [dataset.rows[k]["uid"] for k in episodes]
    told = [FORMAT, *_identity(path), [[f.name, str(f.type)] for f in schema], uids]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()[:32]


def _identity(path: AnyPath) -> tuple[str, int, int]:
    """Where a file is, its size and when it was changed [ns]."""
    if isinstance(path, RemotePath):
        info = path.filesystem.get_file_info(path.key)
        return str(path), info.size or 0, info.mtime_ns or 0
    status = path.stat()
    return str(path.resolve()), status.st_size, status.st_mtime_ns


def _evict(folder: Path, *, keep: Path) -> None:
    """Delete the files that were not used for longest until the rest fits; who has one open keeps it."""
    text = os.environ.get("H3DATA_CACHE_GB", "20")
    try:
        room = float(text) * 1e9
    except ValueError:
        raise InputError(f"H3DATA_CACHE_GB must be a number of gigabytes, got {text!r}.") from None
    found = [(path.stat(), path) for path in folder.glob("*.arrow") if path != keep]
    room -= keep.stat().st_size
    for status, path in sorted(found, key=lambda file: file[0].st_mtime_ns, reverse=True):
        room -= status.st_size
        if room < 0:
            path.unlink(missing_ok=True)
