"""Confidence intervals: Wilson for proportions, percentile bootstrap and Student's t for means."""

# scipy.stats has all three but takes about a second to import; these need scipy.special alone, and the bootstrap must
# give the same bits whatever the version of scipy. tests/stats/test_intervals.py compares each with scipy.stats.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError

_BLOCK = 2_000_000
"""Random indices held in memory at once: 16 MB."""


def wilson_interval(successes: int, trials: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """Returns the Wilson score interval of a proportion, without continuity correction; NaN without trials.

    E. B. Wilson 1927, equation for p0: (p + z²/2n ± z sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n).
    """
    from scipy.special import ndtri

    check_confidence(confidence)
    if not 0 <= successes <= trials:
        raise InputError(f"Expected 0 <= successes <= trials, got {successes} of {trials}.")
    if trials == 0:
        return float("nan"), float("nan")
    z = float(ndtri((1 + confidence) / 2))
    p, spread = successes / trials, z * z / trials
    middle = (p + spread / 2) / (1 + spread)
    half = z / (1 + spread) * np.sqrt(p * (1 - p) / trials + spread / (4 * trials))
    # At the ends the two terms cancel except for rounding, which would leave -1e-17 for 0.
    low = 0.0 if successes == 0 else float(middle - half)
    high = 1.0 if successes == trials else float(middle + half)
    return low, high


def bootstrap_interval(
    values: ArrayLike, *, confidence: float = 0.95, resamples: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Returns the percentile bootstrap interval of the mean of ``values`` [E].

    NaN values are left out; with fewer than two left, both ends are NaN. The same seed gives the same interval.
    """
    check_confidence(confidence)
    v = _defined(values)
    if len(v) < 2:
        return float("nan"), float("nan")
    random = np.random.default_rng(seed)
    means = np.empty(resamples)
    per_block = max(1, _BLOCK // len(v))
    for start in range(0, resamples, per_block):
        stop = min(start + per_block, resamples)
        means[start:stop] = v[random.integers(0, len(v), (stop - start, len(v)))].mean(axis=1)
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def t_interval(values: ArrayLike, *, confidence: float = 0.95) -> tuple[float, float]:
    """Returns Student's t interval of the mean of ``values`` [E]; NaN below two defined values.

    For a few runs, such as training seeds, where a bootstrap is too narrow.
    """
    from scipy.special import stdtrit

    check_confidence(confidence)
    v = _defined(values)
    if len(v) < 2:
        return float("nan"), float("nan")
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
    """Upper end of the interval."""
    seeds: int
    """Seeds with a defined value."""

    def __str__(self) -> str:
        return f"{self.mean:.3g} ± {self.std:.2g}"


def over_seeds(values: ArrayLike, *, confidence: float = 0.95) -> SeedSummary:
    """Returns mean ± standard deviation of one value per seed [S], as papers print it; NaN values are left out."""
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
    """Raises an `InputError` unless ``confidence`` is a share, such as 0.95 (not 95)."""
    if not 0 < confidence < 1:
        raise InputError(f"Expected a confidence between 0 and 1, e.g. 0.95, got {confidence}.")


def _defined(values: ArrayLike) -> NDArray[np.float64]:
    v = np.asarray(values, np.float64)
    if v.ndim != 1:
        raise InputError(f"Expected one value per episode, shape [E], got shape {list(v.shape)}.")
    return v[~np.isnan(v)]
