"""Buffer of rows between `RecordingWriter.append` and the file, which are checked and then encoded together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.recording.schema import Layout

Rows = dict[str, NDArray[Any]]


def native_rows(rows: Mapping[str, ArrayLike]) -> Rows:
    """Return rows as arrays in this machine's byte order."""
    arrays = {name: np.asarray(values) for name, values in rows.items()}
    # numpy keeps the byte order of files that were read, but the wire has only one
    return {n: a if a.dtype.isnative else a.astype(a.dtype.newbyteorder("=")) for n, a in arrays.items()}


class PendingRows:
    """Buffered rows of one log, until `take` returns them."""

    def __init__(self, layout: Layout) -> None:
        self.steps = 0
        """Number of rows added so far."""
        self.taken = 0
        """Number of rows returned by `take` so far."""
        self._kinds = {c.name: (np.dtype(c.dtype), c.shape) for c in layout}
        self._pending: list[Rows] = []
        self._times: list[NDArray[np.int64]] = []
        self._last_time: int | None = None

    def add(self, arrays: Rows) -> None:
        """Add a copy of n rows to the buffer; ``rows`` has every column with shape [n, ...].

        Raises:
            InputError: columns are missing or have another dtype or shape, or time does not increase.
        """
        count = self._check(arrays)
        if not count:
            return
        self._pending.append({name: a.copy() for name, a in arrays.items()})  # callers reuse their buffers
        self._last_time = int(arrays["time_ns"][-1])
        self.steps += count

    def take(self) -> Rows:
        """Remove all rows from the buffer and return them joined; {} if there are none."""
        pending, self._pending = self._pending, []
        if not pending:
            return {}
        rows = pending[0] if len(pending) == 1 else {n: np.concatenate([p[n] for p in pending]) for n in pending[0]}
        self._times.append(rows["time_ns"])
        self.taken += len(rows["time_ns"])
        return rows

    def time_of(self, step: int) -> int:
        """Return ``time_ns`` of an added row; for any other step, that of the nearest row."""
        step = min(step, self.steps - 1)
        if step >= self.taken:
            return self._last_time or 0  # at most one flush interval off
        if not self._times:
            return 0
        if len(self._times) > 1:
            # joined when somebody asks, not at each flush, which would copy all times again and again
            self._times = [np.concatenate(self._times)]
        return int(self._times[0][max(step, 0)])

    def _check(self, arrays: Rows) -> int:
        """Return the number of rows; an `InputError` unless all columns have it, with the dtype and shape of the layout."""
        times = arrays.get("time_ns")
        count = len(times) if times is not None and times.ndim else 0
        faults = []
        for name, array in arrays.items():
            kind = self._kinds.get(name)
            if kind is None:
                faults.append(f"{name} is not one of the columns")
            elif array.dtype != kind[0] or array.shape != (count, *kind[1]):
                faults.append(f"{name} must be {kind[0]} {[count, *kind[1]]}, is {array.dtype} {list(array.shape)}")
        if len(arrays) - len(faults) < len(self._kinds):
            faults += [f"{name} is missing" for name in self._kinds if name not in arrays]
        if faults:
            raise InputError(f"Rows do not fit this recording: {'; '.join(faults[:8])}.", code="H3-RECORDING-033")
        first_is_late = self._last_time is None or count == 0 or int(arrays["time_ns"][0]) > self._last_time
        if not first_is_late or (count > 1 and np.any(np.diff(arrays["time_ns"]) <= 0)):
            raise InputError(
                "time_ns must increase strictly from row to row, also from one append to the next.",
                code="H3-RECORDING-034",
            )
        return count
