"""Single steps of one episode of a dataset."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
from numpy.typing import NDArray

from h3data.recording.parquet.dataset import Dataset
from h3data.recording.records import Recording
from h3data.recording.steps import Steps


class DatasetSteps(Steps):
    """Steps of one episode of a dataset; columns that were read are cached as Arrow data."""

    def __init__(self, dataset: Dataset, index: int) -> None:
        self.dataset, self.index = dataset, index
        self.layout = dataset.layout(index)  # an InputError if there is no such episode
        self._length: int = dataset.rows[index]["length"]
        self._kept: dict[str, pa.ChunkedArray] = {}

    def __len__(self) -> int:
        return self._length

    def close(self) -> None:
        """Drop the columns read so far from memory."""
        self._kept.clear()

    def _rows(self, start: int, stop: int, names: list[str]) -> dict[str, NDArray[Any]]:
        if start == stop:
            return {c.name: c.empty() for c in self.layout if c.name in names}
        # whole columns, because Parquet reads no less than a row group; steps are then slices without a copy
        unread = [c.name for c in self.layout if c.width and c.name in names and c.name not in self._kept]
        if unread:
            table = self.dataset.read_group([self.index], unread)
            self._kept |= {name: table[name] for name in unread}
        stored = {name: array.slice(start, stop - start) for name, array in self._kept.items() if name in names}
        columns = self.dataset.to_numpy(self.index, stored, stop - start)
        return {name: columns[name] for name in names}

    def _recording(self, start: int, stop: int) -> Recording:
        return self.dataset.with_columns(self.index, self._rows(start, stop, [c.name for c in self.layout]))
