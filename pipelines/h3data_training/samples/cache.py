"""Cache of a dataset's columns as memory-mapped Arrow files, for training that reads in random order.

A Parquet row group is decoded as a whole; a mapped file returns any row at once, and all workers share its pages. One file
holds some columns of one shard, an uncompressed record batch for each row group. The cache is in
``$H3DATA_CACHE/arrow`` or ``~/.cache/h3data/arrow`` (`h3data.files.cache_folder`). It keeps the most recently used
files up to ``H3DATA_CACHE_GB`` gigabytes (default 20) and may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import pyarrow as pa

from h3data.errors import InputError
from h3data.files import cache_folder, evict, part_file
from h3data.recording.parquet import tables
from h3data.recording.parquet.files import shard_path
from h3data.recording.parquet.folder import DatasetFolder
from h3data.recording.storage import AnyPath, RemotePath

log = logging.getLogger(__name__)

FORMAT = 1


def open_cached(dataset: DatasetFolder, shard: int, columns: Sequence[str]) -> pa.ipc.RecordBatchFileReader | None:
    """Return the mapped columns of a shard, with batch k for row group k, and write them if the cache lacks them.

    Returns None if there is no cache (``H3DATA_CACHE=off``) or it cannot be written.
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
                # one batch an episode, so that one of them can be mapped without touching the others
                for episode in episodes:
                    writer.write(tables.to_arrow(dataset, columns=columns, episodes=[episode]).combine_chunks())
            reader = _opened(path, schema, len(episodes))
            with suppress(FileNotFoundError):  # other workers evict too
                _evict(folder, keep=path)
        return reader
    except OSError as error:
        log.info("The columns are not cached: %s", error)
        return None


def _opened(path: Path, schema: pa.Schema, batches: int) -> pa.ipc.RecordBatchFileReader | None:
    """Return a file of the cache, marked as used; None if it does not exist or does not hold these columns."""
    if not path.is_file():
        return None
    try:
        reader = pa.ipc.open_file(pa.memory_map(str(path)))
        if reader.schema.equals(schema) and reader.num_record_batches == batches:
            # eviction goes by the time of last use, which reading a mapped file does not change
            os.utime(path)
            return reader
    except pa.ArrowException as error:
        log.warning("A cached file is broken and is made again (%s): %s", error, path)
    return None


def _key(dataset: DatasetFolder, shard: int, episodes: Sequence[int], schema: pa.Schema) -> str:
    """Return the name of the cached file for these columns of the shard as it is now: size and time of its data file count."""
    path = shard_path(dataset.root, "data", shard)
    # the episode table is part of the name: the same data file may serve more episodes after the next commit
    uids = [dataset.rows[k]["uid"] for k in episodes]
    identity = [FORMAT, *_identity(path), [[f.name, str(f.type)] for f in schema], uids]
    return hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:32]


def _identity(path: AnyPath) -> tuple[str, int, int]:
    """Return the location, size and time of the last change [ns] of a file."""
    if isinstance(path, RemotePath):
        info = path.filesystem.get_file_info(path.key)
        return str(path), info.size or 0, info.mtime_ns or 0
    status = path.stat()
    return str(path.resolve()), status.st_size, status.st_mtime_ns


def _evict(folder: Path, *, keep: Path) -> None:
    """Delete the least recently used files until the rest fits; processes that have one open keep their pages."""
    text = os.environ.get("H3DATA_CACHE_GB", "20")
    try:
        room = float(text) * 1e9
    except ValueError:
        raise InputError(
            f"H3DATA_CACHE_GB must be a number of gigabytes, got {text!r}.", code="H3-RECORDING-056"
        ) from None
    evict(folder, room, keep=keep)
