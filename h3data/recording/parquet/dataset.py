"""Reading a Parquet dataset: one row group per episode, only the columns that are asked for."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError, did_you_mean
from h3data.recording.parquet.arrow_columns import conform, to_numpy
from h3data.recording.parquet.dataset_records import DAMAGE, DatasetRecords
from h3data.recording.parquet.dataset_shard import EPISODE_SCHEMA, SIDECARS
from h3data.recording.parquet.dataset_writer import is_dataset
from h3data.recording.parquet.lerobot_meta import FILES_PER_CHUNK, DatasetSchema, shard_files, shard_path
from h3data.recording.records import Recording
from h3data.recording.schema import (
    Layout,
    check_version,
    episode_from_dict,
    layout_from_json,
    required_columns,
)
from h3data.recording.storage import RemotePath, place, readable

if TYPE_CHECKING:
    import pandas
    import polars
    import torch


class Dataset:
    """Committed episodes of a dataset folder. Reads lazily; safe to open while a writer is at work."""

    def __init__(self, root: str | os.PathLike[str] | RemotePath) -> None:
        """Open a folder that `DatasetWriter` made, by its path or URI (``s3://bucket/ds``)."""
        self.root = place(root)
        try:
            found, dataset = self.root.exists(), is_dataset(self.root)
        except OSError as error:
            raise InputError(f"The folder cannot be read ({error.strerror or error}): {self.root}") from error
        if not found:
            raise InputError(f"There is no such folder: {self.root}")
        if not dataset:
            raise FormatError(f"Expected a dataset folder (with meta/info.json): {self.root}")
        if not (self.root / "h3" / "schema.json").exists():
            raise FormatError(
                f"A LeRobot dataset, but not written by h3data: it lacks h3/schema.json and with it bodies and agents. "
                f"Hint: open it with lerobot or Rerun: {self.root}"
            )
        self._promised = self._check_info()
        self.schema = DatasetSchema.load(self.root)
        self._declared = {c.name: c for c in self.schema.columns}
        self._files: dict[int, pq.ParquetFile] = {}
        self._records = DatasetRecords(self.root, self.schema.version)

    @cached_property
    def episodes(self) -> pa.Table:
        """One row per episode: LeRobot's columns (place, length) and ours (uid, task, scene, seed, info as JSON, ...)."""
        paths = shard_files(self.root, "meta/episodes")
        try:
            tables = [
                pq.read_table(readable(p), page_checksum_verification=True).replace_schema_metadata(None) for p in paths
            ]
            table = pa.concat_tables(tables, promote_options="default") if tables else pa.table({"episode_index": []})
            table = conform(table, EPISODE_SCHEMA)
            if tables and (lacking := [name for name in EPISODE_SCHEMA.names if name not in table.column_names]):
                raise ValueError(f"it lacks {', '.join(lacking)}")
            faults = _chain_faults(table) if tables else []
        except DAMAGE as error:
            raise FormatError(f"An episode table is damaged ({error}): {self.root / 'meta' / 'episodes'}") from error
        if len(table) < self._promised:
            faults.append(f"info.json counts {self._promised} episodes, there are {len(table)}: files are missing")
        if faults:
            raise FormatError(f"The episode table is not consistent: {'; '.join(faults)}: {self.root}")
        return table

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """`episodes` as Python values."""
        return self.episodes.to_pylist()

    def __len__(self) -> int:
        return len(self.episodes)

    def __getitem__(self, index: int) -> Recording:
        """Episode ``index``; see `recording`."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"The dataset has {len(self)} episodes, there is no {index}.")  # also ends a for loop
        return self.recording(index % len(self))

    def recording(
        self, index: int, *, columns: Sequence[str] | None = None, records: Sequence[str] | None = None
    ) -> Recording:
        """Episode ``index``, exactly as it was added; with ``columns`` only these and the indispensable ones.

        With ``records`` (of ``bodies``, ``assets``, ``agents``, ``skills``, ``events``, ``inputs``) only these, and no
        attachments: metrics need no more than ``agents``. Reads one row group.
        """
        self._row(index)
        return next(self.recordings(range(index, index + 1), columns=columns, records=records))

    def recordings(
        self, indices: range, *, columns: Sequence[str] | None = None, records: Sequence[str] | None = None
    ) -> Iterator[Recording]:
        """Consecutive episodes, each as `recording` gives it, read together: faster for jobs over many.

        Holds all of them in memory; their columns are views of common arrays.
        """
        kinds = [kind for kind in SIDECARS if records is None or kind in records]
        self._require_columns(columns or ())
        for group in self._groups(indices):
            rows = [self._row(index) for index in group]
            shard = self.shard_of(rows[0])
            found = {kind: self._records.of_episodes(kind, shard, group) for kind in kinds}
            names = None
            if columns is not None or records is not None:
                agents = max(map(len, found.get("agents", [()])))
                names = {*(self._declared if columns is None else columns), *required_columns(agents)}
                if "bodies" not in kinds:
                    names.discard("object_pose")
            for k, (row, arrays) in enumerate(zip(rows, self._read(group, names), strict=True)):
                yield Recording(
                    episode=episode_from_dict(row, path=self.root),
                    columns=arrays,
                    attachments=self._records.attachments(row) if records is None else {},
                    **{kind: of[k] for kind, of in found.items()},
                )

    def with_columns(self, index: int, columns: Mapping[str, NDArray[Any]]) -> Recording:
        """Episode ``index`` with all its records and attachments, and these arrays in the place of its columns."""
        row, one = self._row(index), range(index, index + 1)
        return Recording(
            episode=episode_from_dict(row, path=self.root),
            columns=columns,
            attachments=self._records.attachments(row),
            **{kind: self._records.of_episodes(kind, self.shard_of(row), one)[0] for kind in SIDECARS},
        )

    def iter_columns(
        self, columns: Sequence[str], *, episodes: Iterable[int] | None = None
    ) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
        """Episode by episode ``(index, {column: array [T, ...]})``: constant memory, only these columns are read.

        A column that an episode does not have is not in its dict. This is the path for metrics.
        """
        self._require_columns(columns)
        for index in range(len(self)) if episodes is None else episodes:
            yield index, self._read(range(index, index + 1), columns)[0]

    def layout(self, index: int) -> Layout:
        """Columns of one episode with their true shapes."""
        return _layout(self._row(index)["columns"])

    def __repr__(self) -> str:
        frames = self.rows[-1]["dataset_to_index"] if self.rows else 0
        tasks = ", ".join(sorted({row["task"] for row in self.rows})) or "none"
        lines = [f"Dataset {str(self.root)!r}: {len(self)} episodes, {frames} steps, tasks: {tasks}"]
        lines += [f"  {c.name:<24} {c.dtype:<8} {['T', *c.shape]}".replace("'T'", "T") for c in self.schema.columns]
        return "\n".join(lines)

    def __getstate__(self) -> dict[str, Any]:
        """The same episodes in another process, which opens the files for itself."""
        return {**self.__dict__, "_files": {}, "_records": DatasetRecords(self.root, self.schema.version)}

    # --- as tables ------------------------------------------------------------------------------------------------
    def to_arrow(self, columns: Sequence[str] | None = None, *, episodes: Iterable[int] | None = None) -> pa.Table:
        """The steps of ``episodes`` (default: all) as one table, only ``columns`` (default: all, also LeRobot's).

        As stored: a vector is a fixed-size list of the declared width, narrower episodes are padded. Holds all of it in
        memory; for more than that use `iter_columns` or ``h3data sql``.

        Raises:
            InputError: no such column or episode.
            FormatError: damaged data.
        """
        from h3data.recording import tables

        return tables.to_arrow(self, columns=columns, episodes=episodes)

    def to_polars(
        self, columns: Sequence[str] | None = None, *, episodes: Iterable[int] | None = None
    ) -> polars.DataFrame:
        """`to_arrow` as a polars frame, in the same memory. Needs ``pip install "h3data[frames]"``."""
        from h3data.recording import tables

        return tables.to_polars(self.to_arrow(columns, episodes=episodes))

    def to_pandas(
        self, columns: Sequence[str] | None = None, *, episodes: Iterable[int] | None = None
    ) -> pandas.DataFrame:
        """`to_arrow` as a pandas frame; vectors stay Arrow lists. Needs ``pip install "h3data[frames]"``."""
        from h3data.recording import tables

        return tables.to_pandas(self.to_arrow(columns, episodes=episodes))

    def to_torch(
        self, columns: Sequence[str] | None = None, *, episodes: Iterable[int] | None = None
    ) -> dict[str, torch.Tensor]:
        """`to_arrow` as tensors [T, *declared shape] on the CPU; of one episode without a copy."""
        from h3data.recording import tables

        return tables.to_torch(self.to_arrow(columns, episodes=episodes), tables.shapes_of(self))

    # --- inside ---
    def read_group(self, group: Sequence[int], names: Sequence[str]) -> pa.Table:
        """Stored columns of some episodes of one shard, of which at least one has steps, as Arrow has them."""
        rows = [self._row(index) for index in group]
        try:
            row_groups = [row["row_group"] for row in rows if row["length"]]
            file = self._file(self.shard_of(rows[0]))
            table = file.read_row_groups(row_groups, columns=list(names), use_threads=False).select(names)
            if len(table) != (steps := sum(row["length"] for row in rows)):
                raise ValueError(f"expected {steps} rows, got {len(table)}")
        except DAMAGE as error:
            raise self._damage(group, error) from error
        return table.replace_schema_metadata(None)

    def sidecar(self, kind: str, shard: int) -> pa.Table:
        """The records of a kind in one shard; none where a dataset began before there were any of that kind."""
        return self._records.table(kind, shard)

    def _check_info(self) -> int:
        """Episodes that info.json counts; it is written after the episode tables, so there are at least as many."""
        path = self.root / "meta" / "info.json"
        if not path.exists():
            return 0  # before the first commit
        try:
            info = json.loads(path.read_bytes())
            version, episodes = info["h3data"]["schema_version"], int(info["total_episodes"])
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise FormatError(
                f"info.json is damaged ({error!r}). Hint: h3data.recording.rebuild_meta makes it again: {path}"
            ) from error
        check_version(version, path=path)
        return episodes

    def _row(self, index: int) -> dict[str, Any]:
        if not 0 <= index < len(self):
            raise InputError(f"Episode {index}: the dataset has episodes 0..{len(self) - 1}: {self.root}")
        return self.rows[index]

    def shard_of(self, row: Mapping[str, Any]) -> int:
        """Number of the files that hold an episode, by its row of `episodes`."""
        return row["data/chunk_index"] * FILES_PER_CHUNK + row["data/file_index"]

    def _require_columns(self, columns: Sequence[str]) -> None:
        unknown = sorted(set(columns) - set(self._declared))
        if unknown:
            near = did_you_mean(unknown[0], self._declared)
            raise InputError(
                f"No columns {unknown} in this dataset.{near} It has: {', '.join(self._declared)}: {self.root}"
            )

    def _groups(self, indices: range) -> Iterator[range]:
        """Runs of episodes of one shard with the same columns: what one read can give."""
        start = indices.start
        for index in indices[1:]:
            before, row = self._row(index - 1), self._row(index)
            if self.shard_of(before) != self.shard_of(row) or before["columns"] != row["columns"]:
                yield range(start, index)
                start = index
        if len(indices):
            yield range(start, indices.stop)

    def _read(self, group: range, names: Iterable[str] | None) -> list[dict[str, NDArray[Any]]]:
        """The columns of each episode of one group."""
        rows = [self._row(index) for index in group]
        wanted = None if names is None else set(names)
        layout = [c for c in self.layout(group[0]) if wanted is None or c.name in wanted]
        ends = np.cumsum([row["length"] for row in rows])
        steps, stored = int(ends[-1]), [c.name for c in layout if c.width]
        if not steps or not stored:
            return [{c.name: c.empty(row["length"]) for c in layout} for row in rows]
        try:
            table = self.read_group(group, stored)
            whole = {
                c.name: to_numpy(table[c.name] if c.width else None, c, self._declared[c.name], steps) for c in layout
            }
        except DAMAGE as error:
            raise self._damage(group, error) from error
        return [
            {name: array[end - row["length"] : end] for name, array in whole.items()}
            for row, end in zip(rows, ends, strict=True)
        ]

    def to_numpy(self, index: int, stored: Mapping[str, pa.ChunkedArray], rows: int) -> dict[str, NDArray[Any]]:
        """Stored columns of episode ``index`` (of `read_group`), ``rows`` of them, in their own shapes; columns without
        width are not stored, but are in the result."""
        try:
            return {
                c.name: to_numpy(stored.get(c.name), c, self._declared[c.name], rows)
                for c in self.layout(index)
                if c.name in stored or not c.width
            }
        except DAMAGE as error:
            raise self._damage([index], error) from error

    def _damage(self, group: Sequence[int], error: Exception) -> FormatError:
        path = shard_path(self.root, "data", self.shard_of(self._row(group[0])))
        which = f"Episode {group[0]}" if len(group) == 1 else f"One of the episodes {group[0]} to {group[-1]}"
        return FormatError(f"{which} cannot be read, its data are damaged ({error}): {path}")

    def _file(self, shard: int) -> pq.ParquetFile:
        if shard not in self._files:
            if len(self._files) >= 4:
                self._files.pop(next(iter(self._files))).close()
            path = shard_path(self.root, "data", shard)
            self._files[shard] = pq.ParquetFile(
                readable(path), memory_map=isinstance(path, Path), pre_buffer=not isinstance(path, Path),
                page_checksum_verification=True,
            )  # fmt: skip
        return self._files[shard]


@lru_cache(maxsize=64)
def _layout(text: str) -> Layout:
    return layout_from_json(text)


def _chain_faults(table: pa.Table) -> list[str]:
    """Gaps and overlaps in an episode table: boundaries are never lost silently."""
    index, length, start, end = (
        table[n].to_numpy() for n in ("episode_index", "length", "dataset_from_index", "dataset_to_index")
    )
    faults = []
    if not np.array_equal(index, np.arange(len(index))):
        faults.append(f"expected episodes 0..{len(index) - 1} in order, got {index[:5].tolist()}...")
    if not np.array_equal(end - start, length) or not np.array_equal(start[1:], end[:-1]):
        faults.append("episode boundaries do not follow each other")
    return faults
