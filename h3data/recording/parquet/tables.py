"""Conversion of Parquet datasets to tables of Arrow, polars, pandas and torch.

A table has one row per step, like the files: arrays are flattened in C order to fixed-size lists of the declared width,
narrower episodes are padded (h3data docs format). Vectors are not split into columns.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from h3data.errors import InputError, MissingExtraError, suggest
from h3data.recording.parquet.folder import DatasetFolder
from h3data.recording.parquet.schema import STANDARD, arrow_rows

if TYPE_CHECKING:
    import pandas
    import polars
    import torch


def to_arrow(
    dataset: DatasetFolder, *, columns: Sequence[str] | None = None, episodes: Iterable[int] | None = None
) -> pa.Table:
    """Return the steps of ``episodes`` in the given order as a table; see `Dataset.to_arrow`."""
    schema = table_schema(dataset, columns)
    tables = [_typed(dataset.read_group(group, schema.names), schema) for group in _groups(dataset, episodes)]
    # an empty batch, unlike `Schema.empty_table`, gives each column a chunk, which tensors are made of
    empty = pa.record_batch([pa.array([], field.type) for field in schema], schema=schema)
    return pa.concat_tables(tables or [pa.Table.from_batches([empty])])


def to_polars(table: pa.Table) -> polars.DataFrame:
    """Convert an Arrow table to a polars frame in the same memory; fixed-size lists become polars arrays."""
    try:
        import polars
    except ImportError:
        raise MissingExtraError(
            'A polars frame needs polars. Hint: pip install "h3data[frames]"', code="H3-RECORDING-077"
        ) from None
    frame = polars.from_arrow(table)
    assert isinstance(frame, polars.DataFrame)
    return frame


def to_pandas(table: pa.Table) -> pandas.DataFrame:
    """Convert an Arrow table to a pandas frame.

    Scalars become NumPy columns, and vectors stay in the same Arrow memory (``frame[name].list[0]``)."""
    try:
        import pandas
    except ImportError:
        raise MissingExtraError(
            'A pandas frame needs pandas. Hint: pip install "h3data[frames]"', code="H3-RECORDING-078"
        ) from None

    def kind(arrow: pa.DataType) -> Any:
        # NumPy has no column of vectors: pandas would make one Python list for each row
        return pandas.ArrowDtype(arrow) if pa.types.is_fixed_size_list(arrow) else None

    return table.to_pandas(types_mapper=kind, split_blocks=True)


def to_torch(table: pa.Table, shapes: dict[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Return columns of an Arrow table as torch tensors [T, *shape].

    A column of one chunk shares its memory, except bool, which Arrow packs into bits.
    """
    import torch

    tensors = {}
    for name in table.column_names:
        chunks = [c.flatten() if pa.types.is_fixed_size_list(c.type) else c for c in table.column(name).chunks]
        if len(chunks) == 1 and not pa.types.is_boolean(chunks[0].type):
            flat = torch.from_dlpack(chunks[0])
        else:
            # several chunks have no common memory to share, and booleans are bits there
            flat = torch.from_numpy(np.concatenate([c.to_numpy(zero_copy_only=False) for c in chunks]))
        tensors[name] = flat.reshape(len(table), *shapes.get(name, ()))
    return tensors


def table_schema(dataset: DatasetFolder, columns: Sequence[str] | None = None) -> pa.Schema:
    """Return the names and declared types of all columns of the data files, or of ``columns`` in their order.

    Raises:
        InputError: there is no such column, or its width is 0 in the whole dataset, so that it is not stored.
    """
    kinds = {name: (dtype, 1) for name, dtype in STANDARD.items()}
    kinds |= {c.name: (c.dtype, c.width) for c in dataset.schema.columns if c.width}
    unknown = sorted(set(columns or ()) - set(kinds))
    if unknown:
        raise InputError(
            f"No columns {unknown} in this dataset.{suggest(unknown[0], kinds, lead='It has')} Dataset: {dataset.root}",
            code="H3-RECORDING-076",
        )
    names = dict.fromkeys(kinds if columns is None else columns)
    return pa.schema([pa.field(name, arrow_rows(*kinds[name])) for name in names])


def chosen_episodes(dataset: DatasetFolder, episodes: Iterable[int] | None) -> Sequence[int]:
    """Return ``episodes``, or all of them; raise an `InputError` if one does not exist."""
    chosen = range(len(dataset)) if episodes is None else list(episodes)
    for index in chosen:
        if not 0 <= index < len(dataset):
            raise InputError(
                f"Episode {index}: the dataset has episodes 0..{len(dataset) - 1}: {dataset.root}",
                code="H3-RECORDING-079",
            )
    return chosen


def shapes_of(dataset: DatasetFolder) -> dict[str, tuple[int, ...]]:
    """Return the declared shape of one row of each stored column."""
    return {**dict.fromkeys(STANDARD, ()), **{c.name: c.shape for c in dataset.schema.columns if c.width}}


def _typed(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return the same bits under the declared types; uint64 is stored as int64."""
    for k, field in enumerate(schema):
        column = table.column(k)
        if column.type != field.type:
            # a view, not a cast: values above 2**63 would overflow
            table = table.set_column(k, field, pa.chunked_array([c.view(field.type) for c in column.chunks]))
    return table.cast(schema)


def _groups(dataset: DatasetFolder, episodes: Iterable[int] | None) -> Iterator[list[int]]:
    """Yield the episodes that have steps, in their order, in runs within one shard."""
    rows = dataset.rows
    with_steps = (index for index in chosen_episodes(dataset, episodes) if rows[index]["length"])
    # in runs, not sorted: the rows come in the order in which episodes were asked for
    for _, group in itertools.groupby(with_steps, key=lambda index: dataset.shard_of(rows[index])):
        yield list(group)
