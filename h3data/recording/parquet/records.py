"""Records of a Parquet dataset other than steps: bodies, assets, agents, skills, events, inputs, and attached files."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from h3data.errors import FormatError
from h3data.recording.file_store import FileStore
from h3data.recording.parquet.columns import conform, numbers
from h3data.recording.parquet.files import shard_path
from h3data.recording.parquet.schema import SIDECARS, record_schema
from h3data.recording.schema import RECORD_TYPES, STRUCTS
from h3data.recording.storage import AnyPath, readable

DAMAGE = (
    pa.ArrowException,
    OSError,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    OverflowError,
    MemoryError,
    RecursionError,
)
"""Exceptions that reading a damaged file can raise."""


class _Numbered(pq.ParquetFile):
    """File whose columns are read by their numbers: tables of the paths of all columns take longer than reading a few."""

    def _build_nested_paths(self) -> Any:
        return {}  # pyarrow has no public switch, and with its own method opening a file takes 1.5 times as long


def read_whole(path: AnyPath, first: Sequence[str] | None = None) -> pa.Table:
    """Read the table in a small Parquet file, or only the columns ``first``, with which it begins.

    It takes half the time of `pq.read_table`, which is designed for folders of files.
    """
    with _Numbered(readable(path), page_checksum_verification=True) as file:
        if first is not None:
            leading = range(min(len(first), file.metadata.num_columns))
            table = file.reader.read_all(column_indices=leading, use_threads=False)
            if table.column_names == first:
                return table
        whole = file.reader.read_all(use_threads=False)
    # another program may have written the columns in another order
    return whole if first is None else whole.select([name for name in first if name in whole.column_names])


class DatasetRecords:
    """Records of a dataset folder; tables of the most recently read shards are cached."""

    def __init__(self, root: AnyPath) -> None:
        """Prepare reading the records of the dataset in ``root``."""
        self._root = root
        self._tables: dict[tuple[str, int], tuple[pa.Table, NDArray[np.int64]]] = {}
        self._files = FileStore(root / "h3" / "files")

    def table(self, kind: str, shard: int) -> pa.Table:
        """Return the table of all records of one kind in one shard."""
        return read_whole(shard_path(self._root, f"h3/{kind}", shard))

    def of_episodes(self, kind: str, shard: int, episodes: range) -> list[tuple[Any, ...]]:
        """Return the records of one kind for each of several consecutive episodes of one shard.

        Raises:
            FormatError: the records are damaged.
        """
        key = (kind, shard)
        try:
            if key not in self._tables:
                # two shards: jobs over many episodes go from one to the next
                if len(self._tables) >= 2 * len(SIDECARS):
                    self._tables.pop(next(iter(self._tables)))
                table = conform(self.table(kind, shard), record_schema(SIDECARS[kind]))
                self._tables[key] = (table, numbers(table["episode_index"].combine_chunks()))
            table, owners = self._tables[key]
            # records are sorted by episode, since episodes are only ever appended
            bounds = np.searchsorted(owners, [*episodes, episodes.stop])
            # most episodes have no records of some kinds
            records = (
                _records(SIDECARS[kind], table.slice(bounds[0], bounds[-1] - bounds[0]))
                if bounds[-1] > bounds[0]
                else []
            )
            return [tuple(records[a - bounds[0] : b - bounds[0]]) for a, b in itertools.pairwise(bounds)]
        except DAMAGE as error:
            last = episodes[-1]
            which = f"episode {last}" if len(episodes) == 1 else f"episodes {episodes[0]} to {last}"
            path = shard_path(self._root, f"h3/{kind}", shard)
            raise FormatError(
                f"The {kind} of {which} cannot be read ({error}): {path}", code="H3-RECORDING-070"
            ) from error

    def attachments(self, row: Mapping[str, Any]) -> dict[str, bytes]:
        """Return the attached files of an episode, from its row of the episode table.

        Raises:
            FormatError: a file is missing or damaged.
        """
        episode = row["episode_index"]
        try:
            stored = {str(name): str(file) for name, file in json.loads(row["attachments"]).items()}
        except (ValueError, AttributeError, TypeError, RecursionError) as error:
            raise FormatError(
                f"The list of attachments of episode {episode} is damaged ({error}): {self._root}",
                code="H3-RECORDING-071",
            ) from error
        hint = (
            "copy the file of this name from a backup or from another dataset with the same scene; "
            "or convert the original logs again"
        )
        return {
            name: self._files.get(file, what=f"The attachment {name} of episode {episode}", hint=hint)
            for name, file in stored.items()
        }


def _records(struct: str, table: pa.Table) -> list[Any]:
    """Return the records in a table of `record_schema`, column by column, which is faster than `struct_from_dict` for each.

    Fields that the file lacks keep their defaults.
    """
    stored = dict(zip(table.column_names, table.columns, strict=True))
    columns = {name: _cells(stored[name], kind) for name, kind in STRUCTS[struct].items() if name in stored}
    if "color" in columns:
        # Arrow lists have no None: no colour is stored as an empty list
        columns["color"] = [color or None for color in columns["color"]]
    rows = zip(*columns.values(), strict=True) if columns else [()] * len(table)
    return [RECORD_TYPES[struct](**dict(zip(columns, row, strict=True))) for row in rows]


def _cells(column: pa.ChunkedArray, kind: str) -> Sequence[Any]:
    """Return the values of a column of this kind: numbers, texts, tuples, or float32 arrays."""
    values = column.to_pylist()
    if kind.endswith("*"):
        if any(None in value for value in values):
            raise ValueError(f"a list of {kind[:-1]} values has nulls")
        values = [np.array(value, np.float32) if kind == "float*" else tuple(value) for value in values]
    return values
