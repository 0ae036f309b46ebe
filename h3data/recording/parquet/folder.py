"""Committed episodes of a dataset folder as Arrow tables: its episode table, row groups and records."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, overload

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from h3data.errors import FormatError, InputError
from h3data.recording.parquet.columns import conform, numbers
from h3data.recording.parquet.files import FILES_PER_CHUNK, is_dataset, shard_files, shard_path
from h3data.recording.parquet.records import DAMAGE, DatasetRecords, read_whole
from h3data.recording.parquet.schema import EPISODE_SCHEMA, DatasetSchema, episode_schema
from h3data.recording.schema import check_version
from h3data.recording.storage import RemotePath, place, readable

_BLOCK, _BLOCKS_KEPT = 64, 256


class EpisodeRows(Sequence[dict[str, Any]]):
    """Rows of an episode table as Python values, made on demand.

    The rows of a million episodes would take gigabytes, so only the 16,384 used last are cached.
    """

    def __init__(self, table: pa.Table) -> None:
        self._table, self._length = table, len(table)
        # a cache for each object: one of the class would keep the tables of closed datasets in memory
        self._block = lru_cache(maxsize=_BLOCKS_KEPT)(self._decoded)

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...
    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...
    def __getitem__(self, index: int | slice) -> dict[str, Any] | list[dict[str, Any]]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        if not -self._length <= index < self._length:
            raise IndexError(f"There are {self._length} episodes, no {index}.")
        block, at = divmod(index % self._length, _BLOCK)
        return self._block(block)[at]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (row for block in range(-(-len(self) // _BLOCK)) for row in self._block(block))

    def __reduce__(self) -> tuple[type[EpisodeRows], tuple[pa.Table]]:
        # the cache cannot be pickled
        return EpisodeRows, (self._table,)

    def _decoded(self, block: int) -> list[dict[str, Any]]:
        return self._table.slice(block * _BLOCK, _BLOCK).to_pylist()


class DatasetFolder:
    """Committed episodes of a dataset folder.

    Files are read lazily, and a folder can be opened while a writer is active.
    """

    def __init__(self, root: str | os.PathLike[str] | RemotePath) -> None:
        """Open a folder written by `DatasetWriter`, by path or URI (``s3://bucket/ds``).

        Raises:
            InputError: there is no such folder, or it cannot be read.
            FormatError: the folder is not a dataset of h3data, or its metadata are damaged.
        """
        self.root = place(root)
        try:
            exists, dataset = self.root.exists(), is_dataset(self.root)
        except OSError as error:
            raise InputError(
                f"The folder cannot be read ({error.strerror or error}): {self.root}", code="H3-RECORDING-066"
            ) from error
        if not exists:
            raise InputError(f"There is no such folder: {self.root}", code="H3-RECORDING-061")
        if not dataset:
            raise FormatError(f"Expected a dataset folder (with meta/info.json): {self.root}", code="H3-RECORDING-062")
        if not (self.root / "h3" / "schema.json").exists():
            raise FormatError(
                f"A LeRobot dataset, but not written by h3data: it lacks h3/schema.json and with it bodies and agents. "
                f"Hint: open it with lerobot or Rerun: {self.root}",
                code="H3-RECORDING-063",
            )
        # before the tables: a writer may commit in between, and then there is more than promised, never less
        self._promised = self._promised_episodes()
        self.schema = DatasetSchema.load(self.root)
        self._files: dict[int, pq.ParquetFile] = {}
        self._records = DatasetRecords(self.root)

    @cached_property
    def episodes(self) -> pa.Table:
        """Table of the committed episodes, one row each.

        It has LeRobot's columns (location, length), h3data's columns (uid, task, scene, seed, info as JSON, ...), and
        LeRobot's statistics of videos only.

        Raises:
            FormatError: a table is damaged or missing.
        """
        paths = shard_files(self.root, "meta/episodes")
        kept = tuple(f"stats/{video.key}/" for video in self.schema.videos)
        # statistics of features are hundreds of columns, after all others
        names = episode_schema(replace(self.schema, columns=())).names
        read = partial(read_whole, first=[n for n in names if not n.startswith("stats/") or n.startswith(kept)])
        try:
            # several at once in an object store, where each takes a round trip; on a disk threads cost more than they give
            with ThreadPoolExecutor(4) as pool:
                read_all = pool.map if isinstance(self.root, RemotePath) else map
                tables = [table.replace_schema_metadata(None) for table in read_all(read, paths)]
            table = pa.concat_tables(tables, promote_options="default") if tables else pa.table({"episode_index": []})
            table = conform(table, EPISODE_SCHEMA)
            if tables and (lacking := [name for name in EPISODE_SCHEMA.names if name not in table.column_names]):
                raise ValueError(f"it lacks {', '.join(lacking)}")
            faults = _chain_faults(table) if tables else []
        except DAMAGE as error:
            raise FormatError(
                f"An episode table is damaged ({error}): {self.root / 'meta' / 'episodes'}", code="H3-RECORDING-067"
            ) from error
        # fewer than promised are a loss; more are not, as info.json is written after the tables
        if len(table) < self._promised:
            faults.append(f"info.json counts {self._promised} episodes, there are {len(table)}: files are missing")
        if faults:
            raise FormatError(
                f"The episode table is not consistent: {'; '.join(faults)}: {self.root}", code="H3-RECORDING-064"
            )
        return table

    @cached_property
    def rows(self) -> Sequence[dict[str, Any]]:
        """Rows of `episodes` as Python values, with names in ``info`` updated to this version."""
        return EpisodeRows(self.episodes)

    def __len__(self) -> int:
        return len(self.episodes)

    def row(self, index: int) -> dict[str, Any]:
        """Return row ``index`` of `episodes`.

        Raises:
            InputError: there is no such episode.
        """
        rows = self.rows
        if not 0 <= index < len(rows):
            raise InputError(
                f"Episode {index}: the dataset has episodes 0..{len(rows) - 1}: {self.root}", code="H3-RECORDING-065"
            )
        return rows[index]

    def shard_of(self, row: Mapping[str, Any]) -> int:
        """Return the number of the files that hold an episode, from its row of `episodes`."""
        return row["data/chunk_index"] * FILES_PER_CHUNK + row["data/file_index"]

    def read_group(self, group: Sequence[int], names: Sequence[str]) -> pa.Table:
        """Read stored columns of some episodes of one shard, at least one of them with steps.

        Raises:
            FormatError: the data are damaged.
        """
        rows = [self.row(index) for index in group]
        try:
            row_groups = [row["row_group"] for row in rows if row["length"]]
            file = self._file(self.shard_of(rows[0]))
            # in one thread, because who reads many episodes has several of them already; Parquet gives
            # columns in its own order
            table = file.read_row_groups(row_groups, columns=list(names), use_threads=False).select(names)
            if len(table) != (steps := sum(row["length"] for row in rows)):
                raise ValueError(f"expected {steps} rows, got {len(table)}")
        except DAMAGE as error:
            raise self._damage(group, error) from error
        return table.replace_schema_metadata(None)

    def sidecar(self, kind: str, shard: int) -> pa.Table:
        """Return the table of all records of one kind in one shard."""
        return self._records.table(kind, shard)

    def __getstate__(self) -> dict[str, Any]:
        """Return the same episodes in another process, which opens the files for itself."""
        return {**self.__dict__, "_files": {}, "_records": DatasetRecords(self.root)}

    # --- private ---
    def _promised_episodes(self) -> int:
        """Return the number of episodes in info.json: a lower bound, because the file is written after the episode tables."""
        path = self.root / "meta" / "info.json"
        if not path.exists():
            return 0  # before the first commit
        try:
            info = json.loads(path.read_bytes())
            version, episodes = info["h3data"]["schema_version"], int(info["total_episodes"])
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise FormatError(
                f"info.json is damaged ({error!r}). Hint: h3data.recording.rebuild_meta makes it again: {path}",
                code="H3-RECORDING-068",
            ) from error
        check_version(version, path=path)
        return episodes

    def _damage(self, group: Sequence[int], error: Exception) -> FormatError:
        path = shard_path(self.root, "data", self.shard_of(self.row(group[0])))
        which = f"Episode {group[0]}" if len(group) == 1 else f"One of the episodes {group[0]} to {group[-1]}"
        return FormatError(f"{which} cannot be read, its data are damaged ({error}): {path}", code="H3-RECORDING-060")

    def _file(self, shard: int) -> pq.ParquetFile:
        if shard not in self._files:
            # files are read one after the other; each open one holds its footer, of some hundred columns
            if len(self._files) >= 4:
                self._files.pop(next(iter(self._files))).close()
            path = shard_path(self.root, "data", shard)
            # mapped where it lies on a disk; elsewhere many small ranges are joined into few requests
            local = isinstance(path, Path)
            self._files[shard] = pq.ParquetFile(
                readable(path), memory_map=local, pre_buffer=not local, page_checksum_verification=True
            )
        return self._files[shard]


def _chain_faults(table: pa.Table) -> list[str]:
    """Return the gaps and overlaps between the episodes of an episode table: no episode is ever lost silently."""
    index, length, start, end = (
        numbers(table[n].combine_chunks())
        for n in ("episode_index", "length", "dataset_from_index", "dataset_to_index")
    )
    faults = []
    if not np.array_equal(index, np.arange(len(index))):
        faults.append(f"expected episodes 0..{len(index) - 1} in order, got {index[:5].tolist()}...")
    # compared as a chain, so that one missing table in the middle is found without reading any steps
    if not np.array_equal(end - start, length) or not np.array_equal(start[1:], end[:-1]):
        faults.append("episode boundaries do not follow each other")
    return faults
