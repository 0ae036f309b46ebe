"""Confidence intervals of means: Wilson for proportions, percentile bootstrap in general, Student's t."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError

_BLOCK = 2_000_000
"""Random indices drawn at once: 16 MB."""


def wilson_interval(successes: int, trials: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a proportion, without continuity correction; NaN without trials.

    E. B. Wilson 1927, eq. for p0: (p + z²/2n ± z sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n).
    """
    from scipy.special import ndtri

    _check_confidence(confidence)
    if not 0 <= successes <= trials:
        raise InputError(f"Expected 0 <= successes <= trials, got {successes} of {trials}.")
    if trials == 0:
        return float("nan"), float("nan")
    z = float(ndtri((1 + confidence) / 2))
    p, spread = successes / trials, z * z / trials
    middle = (p + spread / 2) / (1 + spread)
    half = z / (1 + spread) * np.sqrt(p * (1 - p) / trials + spread / (4 * trials))
    # Exact at the ends: the two terms cancel there but for rounding.
    low = 0.0 if successes == 0 else float(middle - half)
    high = 1.0 if successes == trials else float(middle + half)
    return low, high


def bootstrap_interval(
    values: ArrayLike, *, confidence: float = 0.95, resamples: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean of ``values`` [E]; NaN below two values. Same seed, same interval."""
    _check_confidence(confidence)
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
    """Student's t interval of the mean of ``values`` [E], for means of few runs; NaN below two values."""
    from scipy.special import stdtrit

    _check_confidence(confidence)
    v = _defined(values)
    if len(v) < 2:
        return float("nan"), float("nan")
    half = float(stdtrit(len(v) - 1, (1 + confidence) / 2)) * v.std(ddof=1) / np.sqrt(len(v))
    return float(v.mean() - half), float(v.mean() + half)


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise InputError(f"Expected a confidence between 0 and 1, e.g. 0.95, got {confidence}.")


def _defined(values: ArrayLike) -> NDArray[np.float64]:
    v = np.asarray(values, np.float64)
    if v.ndim != 1:
        raise InputError(f"Expected one value per episode, shape [E], got shape {list(v.shape)}.")
    return v[~np.isnan(v)]
