"""Running moments and quantiles of the features of a dataset, for LeRobot's statistics."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
"""Quantiles by the names that LeRobot gives them."""
STATISTICS = ("min", "max", "mean", "std", *QUANTILES)
"""Statistics of a feature besides its count."""


@dataclass
class Moments:
    """Count, mean, sum of squared deviations and extremes of the finite values of one feature, each of shape [width]."""

    count: NDArray[np.float64]
    mean: NDArray[np.float64]
    m2: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    quantiles: NDArray[np.float64] | None = None
    """Values of the `QUANTILES`, shape [5, width]. For several episodes, they are means weighted by counts, as LeRobot
    aggregates them. None if the dataset was written without them."""

    @property
    def std(self) -> NDArray[np.float64]:
        """Standard deviation of each component [width]; 0 where there is no finite value."""
        return np.sqrt(self.m2 / np.maximum(self.count, 1))

    def to_lists(self) -> list[list[float]]:
        """Return all fields as lists for JSON, which `from_lists` reads."""
        return [
            v.tolist()
            for v in (
                self.count,
                self.mean,
                self.m2,
                self.low,
                self.high,
                *([] if self.quantiles is None else self.quantiles),
            )
        ]

    @classmethod
    def from_lists(cls, lists: Iterable[Iterable[float]]) -> Self:
        """Return moments from the lists that `to_lists` returned."""
        count, mean, m2, low, high, *quantiles = (np.array(list(v), np.float64) for v in lists)
        return cls(count, mean, m2, low, high, np.array(quantiles) if quantiles else None)


def moments_of(values: NDArray[Any]) -> Moments:
    """Return moments of rows [T, width]; NaN and infinities do not count."""
    x = values if values.dtype.kind == "f" and values.dtype != np.float16 else values.astype(np.float64)
    rows, width = x.shape
    with np.errstate(all="ignore"):
        mean = x.sum(0, dtype=np.float64) / max(rows, 1)
        # what is not finite passes into the sum, so that a pass over all values is saved
        if rows and np.isfinite(mean).all():
            # two passes: sums of squares would lose what a position far from the origin varies by
            deviation = x - mean
            m2 = np.einsum("ij,ij->j", deviation, deviation)
            count = np.full(width, float(rows))
            # most components of a recording never change, and of float32 the mean of equal values is exact
            varied = np.flatnonzero(m2 if x.dtype == np.float32 else deviation.any(0))
            return Moments(count, mean, m2, *_ordered(x, count, varied))
        finite = np.isfinite(x)
        count = finite.sum(0).astype(np.float64)
        mean = np.where(finite, x, 0).sum(0, dtype=np.float64) / np.maximum(count, 1)
        m2 = (np.where(finite, x - mean, 0) ** 2).sum(0, dtype=np.float64)
        ordered = _ordered(np.where(finite, x, np.nan), count, np.arange(width))
        filled = [np.where(count > 0, v, none) for v, none in zip(ordered, (np.inf, -np.inf, 0.0), strict=True)]
        return Moments(count, mean, m2, *filled)


def _ordered(
    x: NDArray[np.floating], count: NDArray[np.float64], varied: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return minimum and maximum [width] and the quantiles [5, width] of rows [T, width], NaN left out.

    Each quantile is the smallest value that its share of the values does not exceed. LeRobot computes them from
    histograms, from which these differ by at most one bin. Columns outside ``varied`` have one value.
    """
    # values that occur, and no interpolation: a quantile of a flag is 0 or 1
    found = np.full((len(QUANTILES) + 2, x.shape[1]), x[0] if len(x) else 0.0, np.float64)
    if len(x) and len(varied):
        # sorting takes more time than all other statistics together
        shares = np.array([0.0, *QUANTILES.values(), 1.0])
        rank = np.maximum(np.ceil(shares * count[varied, None]) - 1, 0).astype(np.intp)
        ordered = x.T[varied]
        ordered.sort(axis=1)  # NaN come last
        found[:, varied] = ordered[np.arange(len(varied))[:, None], rank].T
    return found[0], found[-1], found[1:-1]


def merged(a: Moments, b: Moments) -> Moments:
    """Return the moments of the union of two samples (Chan et al. 1979)."""
    with np.errstate(all="ignore"):
        count = a.count + b.count
        share = b.count / np.maximum(count, 1)
        gap = b.mean - a.mean
        quantiles = None
        if a.quantiles is not None and b.quantiles is not None:
            # not those of both samples, which would need all values; LeRobot weights them in the same way
            quantiles = a.quantiles + (b.quantiles - a.quantiles) * share
        return Moments(
            count,
            a.mean + gap * share,
            a.m2 + b.m2 + gap * gap * a.count * share,
            np.minimum(a.low, b.low),
            np.maximum(a.high, b.high),
            quantiles,
        )


def merge_into(total: dict[str, Moments], more: Mapping[str, Moments]) -> None:
    """Add the moments of further rows to ``total``, for each feature."""
    for name, moments in more.items():
        total[name] = merged(total[name], moments) if name in total else moments


def finite_stats(moments: Sequence[Moments]) -> dict[str, NDArray[np.float64]]:
    """Return the `STATISTICS` of a feature in each of some episodes as arrays [E, width], 0 where no value is finite.

    The quantiles are left out if they are unknown.
    """
    values = np.array([[m.low, m.high, m.mean, m.std, *(() if m.quantiles is None else m.quantiles)] for m in moments])
    finite = np.nan_to_num(np.where(np.array([m.count for m in moments])[:, None] > 0, values, 0.0))
    return dict(zip(STATISTICS, finite.swapaxes(0, 1), strict=False))


def lerobot_stats(m: Moments, frames: int, shape: tuple[int, ...]) -> dict[str, list[Any]]:
    """Return min, max, mean, std, count and quantiles of one sample as LeRobot stores them, each in the given shape."""
    found = finite_stats([m])
    return {**{name: rows.reshape(shape).tolist() for name, rows in found.items()}, "count": [frames]}


def pack_moments(moments: Mapping[str, Moments]) -> str:
    """Return moments as text for Parquet metadata: base64 of deflated JSON, at a third of the size."""
    # JSON and no pickle: metadata of a foreign file are data, and never run
    text = json.dumps({name: m.to_lists() for name, m in moments.items()})
    return base64.b64encode(zlib.compress(text.encode())).decode()


def unpack_moments(packed: bytes) -> dict[str, Moments]:
    """Return the moments that `pack_moments` packed; empty bytes give no moments."""
    lists = json.loads(zlib.decompress(base64.b64decode(packed))) if packed else {}
    return {name: Moments.from_lists(v) for name, v in lists.items()}
