"""Reduction over the rows of several consecutive episodes: sums per episode, events, and samples at a fixed rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Rows of E non-empty episodes, described by the first row of each."""

    starts: NDArray[np.int64]
    """First row of each episode, shape [E]."""
    total: int
    """Total number of rows R of all episodes."""

    @classmethod
    def of(cls, counts: Sequence[int] | NDArray[np.int64]) -> Rows:
        """Return the rows of episodes with these numbers of rows, at least one each."""
        ends = np.cumsum(counts, dtype=np.int64)
        return cls(starts=ends - np.asarray(counts, np.int64), total=int(ends[-1]))

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of rows of each episode, shape [E]."""
        return np.diff(self.starts, append=self.total)

    @property
    def ends(self) -> NDArray[np.int64]:
        """Index after the last row of each episode, shape [E]."""
        return self.starts + self.counts

    def sum(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return sums over each episode's rows and, if there are any, people: [R] or [R, P] -> [E]. NaN counts as 0."""
        known = values.astype(np.int64) if values.dtype == np.bool_ else np.where(np.isnan(values), 0.0, values)
        summed = np.add.reduceat(known, self.starts)
        return summed if summed.ndim == 1 else summed.sum(axis=1)

    def mean(self, values: Array) -> Array:
        """Return means over the known values of each episode: [R] or [R, P] -> [E]; NaN if none is known."""
        with np.errstate(invalid="ignore"):
            return self.sum(values) / self.sum(~np.isnan(values))

    def least(self, values: Array) -> Array:
        """Return the smallest known value of each episode, [R] -> [E]; NaN if none is known."""
        return np.fmin.reduceat(values, self.starts)

    def greatest(self, values: Array) -> Array:
        """Return the greatest known value of each episode, [R] -> [E]; NaN if none is known."""
        return np.fmax.reduceat(values, self.starts)

    def changes(self, values: NDArray[Any]) -> Array:
        """Return the changes since the previous row of the episode, shape [R, ...]; NaN in its first row."""
        changes = np.full(values.shape, np.nan)
        changes[1:] = np.diff(values, axis=0)
        changes[self.starts] = np.nan
        return changes

    def begins(self, flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask of the rows in which a flag [R, ...] becomes true within an episode."""
        before = np.zeros_like(flags)
        before[1:] = flags[:-1]
        before[self.starts] = False
        return flags & ~before

    def earlier(self, time_ns: NDArray[np.int64], ago_ns: int) -> NDArray[np.int64]:
        """Return the last row of the episode at least ``ago_ns`` before each row, shape [R]; -1 if there is none."""
        since, shift = self._since(time_ns)
        episode = np.repeat(np.arange(len(self.starts)), self.counts)
        found = np.searchsorted(since + shift[episode], since + shift[episode] - ago_ns, side="right") - 1
        return np.where(since >= ago_ns, found, -1)

    def sampled(
        self, time_ns: NDArray[np.int64], period_ns: NDArray[np.int64], *values: Array
    ) -> tuple[Rows, list[Array]]:
        """Return values at a fixed rate from each episode's first row on, by linear interpolation between rows.

        Args:
            time_ns: Time of each row [ns], shape [R].
            period_ns: Sampling period of each episode [ns], shape [E].
            values: Arrays [R, ...].

        Returns:
            The `Rows` of the samples, and the samples of each array.
        """
        since, shift = self._since(time_ns)
        counts = since[self.ends - 1] // period_ns + 1
        samples = Rows.of(counts)
        episode = np.repeat(np.arange(len(self.starts)), counts)
        wanted = (np.arange(samples.total) - samples.starts[episode]) * period_ns[episode]
        everywhere = since + shift[np.repeat(np.arange(len(self.starts)), self.counts)]
        row = np.searchsorted(everywhere, wanted + shift[episode], side="right") - 1
        after = np.minimum(row + 1, self.ends[episode] - 1)
        share = (wanted - since[row]) / np.maximum(since[after] - since[row], 1)
        taken = []
        for array in values:
            part = share.reshape(-1, *[1] * (array.ndim - 1))
            taken.append(np.where(part == 0, array[row], array[row] + part * (array[after] - array[row])))
        return samples, taken

    def _since(self, time_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the time of each row since its episode's first [R], and what puts the episodes one after another [E]."""
        since = time_ns - np.repeat(time_ns[self.starts], self.counts)
        lasting = since[self.ends - 1] + 1
        return since, np.cumsum(lasting) - lasting
