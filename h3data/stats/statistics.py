"""Confidence intervals of means (Wilson for proportions, percentile bootstrap, Student's t), seeds, many tests at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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

    check_confidence(confidence)
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
    """Student's t interval of the mean of ``values`` [E], for means of few runs; NaN below two values."""
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
    """Of the seeds, n - 1 below; NaN of one seed."""
    low: float
    """Lower end of Student's t interval of the mean; NaN of one seed."""
    high: float
    seeds: int

    def __str__(self) -> str:
        return f"{self.mean:.3g} ± {self.std:.2g}"


def over_seeds(values: ArrayLike, *, confidence: float = 0.95) -> SeedSummary:
    """Mean ± standard deviation of one value per seed, shape [S], as papers print it; undefined values are left out."""
    v = _defined(values)
    low, high = t_interval(v, confidence=confidence)
    return SeedSummary(
        mean=float(v.mean()) if len(v) else float("nan"),
        std=float(v.std(ddof=1)) if len(v) > 1 else float("nan"),
        low=low,
        high=high,
        seeds=len(v),
    )


def adjust_p_values(
    p: ArrayLike, *, method: Literal["holm", "bonferroni", "benjamini-hochberg", "none"] = "holm"
) -> NDArray[np.float64]:
    """p values [M] of M tests made together, in their order; NaN stays NaN and does not count as a test.

    ``holm`` and ``bonferroni`` bound the chance of any false finding (Holm 1979), ``benjamini-hochberg`` the expected share
    of false ones among the findings (1995).
    """
    values = np.asarray(p, np.float64)
    if values.ndim != 1 or (values < 0).any() or (values > 1).any():
        raise InputError(f"Expected p values between 0 and 1, shape [M], got {p!r}.")
    result = values.copy()
    tested = np.flatnonzero(~np.isnan(values))
    order = tested[np.argsort(values[tested], kind="stable")]
    ranked, m = values[order], len(order)
    match method:
        case "none":
            pass
        case "bonferroni":
            result[order] = np.minimum(m * ranked, 1)
        case "holm":
            result[order] = np.minimum(np.maximum.accumulate(ranked * np.arange(m, 0, -1)), 1)
        case "benjamini-hochberg":
            result[order] = np.minimum.accumulate((ranked * m / np.arange(1, m + 1))[::-1])[::-1]
        case _:
            raise InputError(f"Expected holm, bonferroni, benjamini-hochberg or none, got {method!r}.")
    return result


def check_confidence(confidence: float) -> None:
    """Refuses percentages and nonsense."""
    if not 0 < confidence < 1:
        raise InputError(f"Expected a confidence between 0 and 1, e.g. 0.95, got {confidence}.")


def _defined(values: ArrayLike) -> NDArray[np.float64]:
    v = np.asarray(values, np.float64)
    if v.ndim != 1:
        raise InputError(f"Expected one value per episode, shape [E], got shape {list(v.shape)}.")
    return v[~np.isnan(v)]
