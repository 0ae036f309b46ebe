"""Confidence intervals: Wilson for proportions, percentile bootstrap and Student's t for means."""

# scipy.stats has all three but takes about a second to import; these need scipy.special alone, and the bootstrap must
# give the same bits whatever the version of scipy. tests/stats/test_intervals.py compares each with scipy.stats.

from __future__ import annotations

import os
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError

_BLOCK, _WORTH_THREADS = 250_000, 64
"""Number of random indices that are sampled together (2 MB, which fit in a core's cache), and number of blocks of all
columns above which several cores are used (50 ms of work)."""


def wilson_interval(successes: int, trials: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """Return the Wilson score interval of a proportion, without continuity correction; NaN without trials.

    E. B. Wilson 1927, equation for p0: (p + z²/2n ± z sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n).
    """
    from scipy.special import ndtri

    check_confidence(confidence)
    if not 0 <= successes <= trials:
        raise InputError(f"Expected 0 <= successes <= trials, got {successes} of {trials}.", code="H3-STATS-023")
    if trials == 0:
        return float("nan"), float("nan")
    z = float(ndtri((1 + confidence) / 2))
    p, spread = successes / trials, z * z / trials
    middle = (p + spread / 2) / (1 + spread)
    half = z / (1 + spread) * np.sqrt(p * (1 - p) / trials + spread / (4 * trials))
    # At the ends the two terms cancel except for rounding, which would leave -1e-17 for 0.
    low = 0.0 if successes == 0 else float(middle - half)
    return low, (1.0 if successes == trials else float(middle + half))


def bootstrap_interval(
    values: ArrayLike, *, confidence: float = 0.95, resamples: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the mean of ``values`` [E].

    NaN values are left out; with fewer than two left, both ends are NaN. The same seed gives the same interval.
    """
    return bootstrap_intervals([values], confidence=confidence, resamples=resamples, seed=seed)[0]


def bootstrap_intervals(
    columns: Sequence[ArrayLike], *, confidence: float = 0.95, resamples: int = 10_000, seed: int = 0
) -> list[tuple[float, float]]:
    """Return the `bootstrap_interval` of each of several columns [E].

    Columns with the same number of values share their samples.
    """
    check_confidence(confidence)
    defined = [_defined(values) for values in columns]
    means: dict[int, NDArray[np.float64]] = {}
    for count in {len(v) for v in defined if len(v) > 1}:
        alike = [k for k, v in enumerate(defined) if len(v) == count]
        sampled = _resampled_means([defined[k] for k in alike], resamples, seed)
        means.update(zip(alike, sampled, strict=True))
    ends = [(1 - confidence) / 2, (1 + confidence) / 2]
    nothing = (float("nan"), float("nan"))
    return [tuple(np.quantile(means[k], ends).tolist()) if k in means else nothing for k in range(len(defined))]


def _resampled_means(columns: Sequence[NDArray[np.float64]], resamples: int, seed: int) -> NDArray[np.float64]:
    """Return the means of random samples with replacement of columns of one length, shape [columns, resamples].

    All columns use the same rows in each sample.
    """
    count = len(columns[0])
    random = np.random.default_rng(seed)
    means = np.empty((len(columns), resamples))

    def average(column: int, start: int, rows: NDArray[np.int64]) -> None:
        # np.take(mode="clip") is three times as fast as columns[column][rows], and lets other threads run.
        means[column, start : start + len(rows)] = np.take(columns[column], rows, mode="clip").mean(axis=1)

    per_block = max(1, _BLOCK // count)
    blocks = [(start, min(per_block, resamples - start)) for start in range(0, resamples, per_block)]
    if len(blocks) * len(columns) < _WORTH_THREADS:
        for start, size in blocks:
            rows = random.integers(0, count, (size, count))
            for column in range(len(columns)):
                average(column, start, rows)
        return means
    workers = os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[None]] = deque()
        for start, size in blocks:  # sampled in one order, whichever thread averages
            rows = random.integers(0, count, (size, count))
            waiting.extend(pool.submit(average, column, start, rows) for column in range(len(columns)))
            # indices are drawn faster than they are averaged: what waits in memory is bounded
            while len(waiting) > 2 * workers * len(columns):
                waiting.popleft().result()
        for future in waiting:
            future.result()
    return means


def t_interval(values: ArrayLike, *, confidence: float = 0.95) -> tuple[float, float]:
    """Return Student's t interval of the mean of ``values`` [E]; NaN below two defined values.

    It is for a few runs, such as training seeds, for which a bootstrap interval is too narrow.
    """
    from scipy.special import stdtrit

    check_confidence(confidence)
    v = _defined(values)
    if len(v) < 2:
        return float("nan"), float("nan")
    # the sample has n - 1 degrees of freedom
    half = float(stdtrit(len(v) - 1, (1 + confidence) / 2)) * v.std(ddof=1) / np.sqrt(len(v))
    return float(v.mean() - half), float(v.mean() + half)


@dataclass(frozen=True, kw_only=True)
class SeedSummary:
    """Mean and spread over training seeds."""

    mean: float
    std: float
    """Sample standard deviation (n - 1); NaN for one seed."""
    low: float
    """Lower end of Student's t interval of the mean; NaN for one seed."""
    high: float
    """Upper end of Student's t interval of the mean; NaN for one seed."""
    seeds: int
    """Number of seeds with a defined value."""

    def __str__(self) -> str:
        return f"{self.mean:.3g} ± {self.std:.2g}"


def over_seeds(values: ArrayLike, *, confidence: float = 0.95) -> SeedSummary:
    """Return mean ± standard deviation of one value per seed [S], as papers print it; NaN values are left out."""
    v = _defined(values)
    low, high = t_interval(v, confidence=confidence)
    return SeedSummary(
        mean=float(v.mean()) if len(v) else float("nan"),
        std=float(v.std(ddof=1)) if len(v) > 1 else float("nan"),
        low=low,
        high=high,
        seeds=len(v),
    )


def check_confidence(confidence: float) -> None:
    """Raise an `InputError` unless ``confidence`` is a share, such as 0.95 (not 95)."""
    if not 0 < confidence < 1:
        raise InputError(f"Expected a confidence between 0 and 1, e.g. 0.95, got {confidence}.", code="H3-STATS-024")


def _defined(values: ArrayLike) -> NDArray[np.float64]:
    v = np.asarray(values, np.float64)
    if v.ndim != 1:
        raise InputError(f"Expected one value per episode, shape [E], got shape {list(v.shape)}.", code="H3-STATS-025")
    return v[~np.isnan(v)]
