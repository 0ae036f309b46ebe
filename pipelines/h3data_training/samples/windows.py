"""Windows of consecutive steps from a dataset as training samples, which never cross the boundary of an episode."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording.parquet import tables
from h3data.recording.parquet.dataset import Dataset
from h3data_training.samples import cache

Border = Literal["drop", "pad"]
CACHE_BYTES = 256 << 20
_OWN_KEYS = ("valid", "episode", "step")


class WindowDataset:
    """Map-style dataset for `torch.utils.data.DataLoader`, in which window ``k`` is a dict of tensors.

    The window of step t holds the rows t - history + 1 ... t + horizon of one episode:

    * each column as [history + horizon, *declared shape], a copy in the column's dtype;
    * ``valid`` bool [history + horizon]: False for rows in which ``border="pad"`` repeats the first or last row;
    * ``episode`` and ``step``: number of the episode, and t.

    ``border="drop"`` leaves out windows that reach beyond their episode; ``"pad"`` gives a window for every
    ``stride``-th step. Windows always come in the same order, by episode and step; shuffling is the loader's task.

    The dataset reads ``columns`` from the row group of one episode at a time and caches the most recent ones, up to
    ``cache_bytes`` in each worker. For shuffled windows of a larger dataset, ``disk_cache`` keeps the columns in
    memory-mapped files (`h3data_training.samples.cache`) that all workers share. Workers may be forked or spawned;
    spawn them if the dataset is in an object store.
    """

    def __init__(
        self,
        dataset: Dataset,
        columns: Sequence[str],
        *,
        history: int = 1,
        horizon: int = 0,
        stride: int = 1,
        border: Border = "drop",
        episodes: Iterable[int] | None = None,
        cache_bytes: int = CACHE_BYTES,
        disk_cache: bool = False,
    ) -> None:
        """Create windows over ``episodes`` (default: all episodes that are committed now).

        Raises:
            InputError: there is no such column or episode, or a length or stride is out of range.
        """
        if history < 1 or horizon < 0 or stride < 1:
            raise InputError(
                f"Expected history >= 1, horizon >= 0 and stride >= 1, got {history}, {horizon} and {stride}.",
                code="H3-RECORDING-125",
            )
        if border not in ("drop", "pad"):
            raise InputError(f"Expected border 'drop' or 'pad', got {border!r}.", code="H3-RECORDING-126")
        clash = sorted(set(columns) & set(_OWN_KEYS))
        if clash:
            raise InputError(
                f"Columns {clash} cannot be in a window: its own keys are {', '.join(_OWN_KEYS)}.",
                code="H3-RECORDING-127",
            )
        self.dataset, self.columns = dataset, tuple(tables.table_schema(dataset, columns).names)
        self.history, self.horizon, self.stride, self.border = history, horizon, stride, border
        chosen = tables.chosen_episodes(dataset, episodes)
        lengths = np.array([dataset.rows[k]["length"] for k in chosen], np.int64)
        anchors = lengths if border == "pad" else np.maximum(lengths - (history + horizon - 1), 0)
        self._episodes = np.array(chosen, np.int64)
        self._ends = np.cumsum(-(-anchors // stride))
        self._cache_bytes, self._cached = cache_bytes, 0
        self._disk_cache = disk_cache
        self._mapped: dict[int, pa.ipc.RecordBatchFileReader | None] = {}
        self._cache: OrderedDict[int, tuple[dict[str, NDArray[Any]], int]] = OrderedDict()

    def __len__(self) -> int:
        """Return the number of windows."""
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return window ``index``; negative indices count from the end."""
        import torch

        if not -len(self) <= index < len(self):
            raise IndexError(f"There are {len(self)} windows, there is no {index}.")
        index %= len(self)
        position = int(np.searchsorted(self._ends, index, side="right"))
        step = (index - (int(self._ends[position - 1]) if position else 0)) * self.stride
        step += 0 if self.border == "pad" else self.history - 1
        episode = int(self._episodes[position])
        last = self.dataset.rows[episode]["length"] - 1
        rows = np.arange(step - self.history + 1, step + self.horizon + 1)
        inside = rows.clip(0, last)
        window = {name: torch.from_numpy(values[inside]) for name, values in self._rows_of(episode).items()}
        return {**window, "valid": torch.from_numpy(rows == inside), "episode": episode, "step": step}

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[index] for index in range(len(self)))

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without cached rows: spawned workers read for themselves."""
        return {**self.__dict__, "_cache": OrderedDict(), "_cached": 0, "_mapped": {}}

    def __repr__(self) -> str:
        shape = f"history={self.history}, horizon={self.horizon}, stride={self.stride}, border={self.border!r}"
        return f"WindowDataset({len(self)} windows of {len(self._episodes)} episodes, {list(self.columns)}, {shape})"

    def _rows_of(self, episode: int) -> dict[str, NDArray[Any]]:
        """Return all rows of an episode, from the cache if it has them."""
        if episode in self._cache:
            self._cache.move_to_end(episode)
            return self._cache[episode][0]
        table = self._table_of(episode)
        tensors = tables.to_torch(table, tables.shapes_of(self.dataset))
        rows = {name: tensor.numpy() for name, tensor in tensors.items()}
        size = sum(values.nbytes for values in rows.values())
        self._cache[episode] = rows, size
        self._cached += size
        while self._cached > self._cache_bytes and len(self._cache) > 1:
            self._cached -= self._cache.popitem(last=False)[1][1]
        return rows

    def _table_of(self, episode: int) -> pa.Table:
        row = self.dataset.rows[episode]
        shard = self.dataset.shard_of(row)
        if self._disk_cache and shard not in self._mapped:
            self._mapped[shard] = cache.open_cached(self.dataset, shard, self.columns)
        reader = self._mapped.get(shard)
        if reader is None:
            return tables.to_arrow(self.dataset, columns=self.columns, episodes=[episode])
        return pa.Table.from_batches([reader.get_batch(row["row_group"])])
