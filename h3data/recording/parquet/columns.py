"""Conversion of columns between NumPy arrays and the Arrow arrays that a dataset stores."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from h3data.recording.schema import Column


def padded(values: NDArray[Any] | None, column: Column, steps: int) -> NDArray[Any]:
    """Return rows flattened to [T, width] and padded to the declared width with NaN, -1, 0 (unsigned) or False."""
    if values is not None and values.shape[1:] == column.shape:
        return np.ascontiguousarray(values, column.dtype).reshape(steps, column.width)
    # values that mean "nothing there" in our columns: an absent pose, no body, no skill
    kind = np.dtype(column.dtype).kind
    wide = np.full((steps, *column.shape), {"f": np.nan, "i": -1}.get(kind, 0), column.dtype)
    if values is not None:
        wide[(slice(None), *(slice(0, n) for n in values.shape[1:]))] = values
    return wide.reshape(steps, column.width)


def numbers(array: pa.Array) -> NDArray[Any]:
    """Return the numbers or booleans of an Arrow array, read-only.

    `pa.Array.to_numpy` does the same, but imports pandas where it is installed: half a second or more.

    Raises:
        ValueError: there are nulls.
    """
    if array.null_count:
        raise ValueError("there are nulls")
    # booleans are stored as bits
    whole = array.cast(pa.uint8()) if pa.types.is_boolean(array.type) else array
    dtype = np.dtype(whole.type.to_pandas_dtype())
    values = np.ndarray(len(whole), dtype, whole.buffers()[1], whole.offset * dtype.itemsize)
    return values if whole is array else values.view(np.bool_)


def to_arrow(rows: NDArray[Any]) -> pa.Array:
    """Return rows [T, width] as an Arrow array, a fixed-size list if the width is not 1; only booleans are copied."""
    flat = rows.reshape(-1)
    # pa.array(ndarray) looks for pandas on every call: 1.5 ms per episode
    data = pa.py_buffer(np.packbits(flat, bitorder="little") if flat.dtype == bool else flat)
    flat = pa.Array.from_buffers(pa.from_numpy_dtype(flat.dtype), len(flat), [None, data])
    return flat if rows.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, rows.shape[1])


def to_numpy(stored: pa.ChunkedArray | None, column: Column, declared: Column, steps: int) -> NDArray[Any]:
    """Return a writable copy of a stored column in its own shape [steps, ...], without padding.

    ``declared`` is the column of the dataset; ``stored`` is None if the column has no width.

    Raises:
        ValueError: ``stored`` does not have the declared type or shape.
    """
    if not column.width or stored is None:
        return column.empty(steps)
    # a width of 1 is stored as scalars, which viewers and SQL read without unpacking
    if pa.types.is_fixed_size_list(stored.type) != (declared.width > 1):
        raise ValueError(f"column {column.name} is not {declared}")
    chunks = [c.flatten() if declared.width > 1 else c for c in stored.chunks]
    if any(c.null_count for c in chunks):
        raise ValueError(f"column {column.name} has nulls")
    values = np.concatenate([numbers(c) for c in chunks])
    # a uint64 is stored as an int64 of the same bits, so it is viewed and not converted
    if declared.dtype == "uint64" and values.dtype == np.int64:
        values = values.view(np.uint64)
    if values.dtype != declared.dtype:
        raise ValueError(f"expected {declared.dtype}, got {values.dtype}")
    wide = values.reshape(steps, *declared.shape)
    if declared.shape == column.shape:
        return wide
    # a copy, or the padding of all rows would stay in memory with it
    return wide[(slice(None), *(slice(0, n) for n in column.shape))].copy()


def conform(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return the table with its columns cast to the types of ``schema``.

    Columns that are missing in either are unchanged.

    Raises:
        ValueError: a column of the schema has nulls.
        pa.ArrowException: a value does not fit the declared type.
    """
    for index, name in enumerate(table.column_names):
        if name in schema.names:
            column = table[name].cast(schema.field(name).type)
            if column.null_count:
                raise ValueError(f"column {name} has nulls")
            table = table.set_column(index, name, column)
    return table
