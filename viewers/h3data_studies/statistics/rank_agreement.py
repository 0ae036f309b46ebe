"""Agreement of two rankings of methods, such as one by automatic evaluation and one by a study with people."""

# The coefficients are scipy's (tests compare them); written out here over all resamples at once, because 10,000 calls of
# scipy.stats.kendalltau take seconds.

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.stats.intervals import check_confidence


@dataclass(frozen=True, kw_only=True)
class RankAgreement:
    """Rank correlations of the means of the same methods in two evaluations."""

    names: tuple[str, ...]
    first_means: tuple[float, ...]
    second_means: tuple[float, ...]
    kendall: float
    """Kendall's tau-b: 1 for the same order, -1 for the reverse order; NaN if all means of one evaluation are equal."""
    kendall_low: float
    """Lower end of the bootstrap interval; NaN if no method has two values."""
    kendall_high: float
    spearman: float
    """Spearman's rank correlation rho."""
    spearman_low: float
    spearman_high: float


def rank_agreement(
    first: Mapping[str, ArrayLike],
    second: Mapping[str, ArrayLike],
    *,
    confidence: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> RankAgreement:
    """Correlate the ranks of the means of methods, with percentile bootstrap intervals.

    The bootstrap resamples the values of each method (episodes) in both evaluations; with few methods the coefficients
    take few values, and the interval is wide.

    Args:
        first: Values of each method, one per episode; NaN is ignored.
        second: Values of the same methods in the other evaluation.
        confidence: Confidence of the intervals.
        resamples: Number of bootstrap samples.
        seed: The same seed gives the same intervals.

    Raises:
        InputError: the methods differ, there are fewer than two, or one has no value.
    """
    check_confidence(confidence)
    if set(first) != set(second) or len(first) < 2:
        raise InputError(
            f"Ranks need the same two methods or more in both evaluations, got {', '.join(first) or 'none'} and "
            f"{', '.join(second) or 'none'}.",
            code="H3-STATS-037",
        )
    names = tuple(first)
    values = [[_defined(side[name], name) for name in names] for side in (first, second)]
    random = np.random.default_rng(seed)
    means = [np.array([v.mean() for v in side]) for side in values]
    tau, rho = (float(f(means[0][None], means[1][None])[0]) for f in (_tau, _rho))
    ends = np.full((2, 2), np.nan)
    if any(len(v) > 1 for side in values for v in side):
        a, b = (
            np.stack([v[random.integers(0, len(v), (resamples, len(v)))].mean(axis=1) for v in side], axis=1)
            for side in values
        )
        tail = 100 * (1 - confidence) / 2
        for k, coefficients in enumerate((_tau(a, b), _rho(a, b))):
            known = coefficients[~np.isnan(coefficients)]
            if len(known):
                ends[k] = np.percentile(known, [tail, 100 - tail])
    return RankAgreement(
        names=names,
        first_means=tuple(map(float, means[0])),
        second_means=tuple(map(float, means[1])),
        kendall=tau,
        kendall_low=float(ends[0, 0]),
        kendall_high=float(ends[0, 1]),
        spearman=rho,
        spearman_low=float(ends[1, 0]),
        spearman_high=float(ends[1, 1]),
    )


def _defined(values: ArrayLike, name: str) -> NDArray[np.float64]:
    array = np.asarray(values, np.float64).ravel()
    array = array[~np.isnan(array)]
    if not len(array):
        raise InputError(f"{name!r} has no defined value to rank.", code="H3-STATS-038")
    return array


def _tau(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Kendall's tau-b of each row of two arrays [B, M]."""
    i, j = np.array(list(itertools.combinations(range(a.shape[1]), 2))).T
    x, y = np.sign(a[:, i] - a[:, j]), np.sign(b[:, i] - b[:, j])
    with np.errstate(invalid="ignore"):
        return (x * y).sum(1) / np.sqrt((x != 0).sum(1) * (y != 0).sum(1))


def _rho(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Spearman's rho of each row of two arrays [B, M]: Pearson's correlation of mean ranks."""
    from scipy.stats import rankdata

    x, y = (ranks - ranks.mean(axis=1, keepdims=True) for ranks in (rankdata(a, axis=1), rankdata(b, axis=1)))
    with np.errstate(invalid="ignore"):
        return (x * y).sum(1) / np.sqrt((x**2).sum(1) * (y**2).sum(1))
