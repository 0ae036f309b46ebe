"""Paired comparison of one value per episode in two runs: test, interval of the difference, effect size."""

# The permutation test is written out so that a seed gives the same p value with every version of scipy.
# tests/stats/test_paired_tests.py compares the p values of all four with scipy.stats.

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.stats.intervals import bootstrap_interval

PairedMethod = Literal["auto", "permutation", "t", "wilcoxon", "mcnemar"]

_ENUMERATED = 20
"""Number of differences other than 0 up to which all 2^n patterns of signs are evaluated (half a million sums)."""


@dataclass(frozen=True, kw_only=True)
class PairedComparison:
    """Difference ``first - second`` over the episodes in which both are defined."""

    first_mean: float
    second_mean: float
    difference: float
    low: float
    """Lower end of the bootstrap interval of the mean difference over episodes."""
    high: float
    """Upper end of the bootstrap interval of the mean difference over episodes."""
    p: float
    """Two-sided p value; NaN below two pairs."""
    p_adjusted: float
    """P value adjusted for all metrics compared together; equals ``p`` for a single metric."""
    method: str
    effect: float
    """Size of the effect, of the kind in ``effect_name``; positive if the first run is larger, NaN if undefined."""
    effect_name: Literal["Cohen's d_z", "rank-biserial correlation", "odds ratio"]
    pairs: int
    undefined: int
    """Number of episodes in which one of the two values, or both, are undefined."""
    notes: tuple[str, ...] = ()
    """Reservations about the test: pairs of 0/1 values, too few pairs for a p value below .05."""


def compare_paired(
    first: Mapping[str, float],
    second: Mapping[str, float],
    *,
    method: PairedMethod = "auto",
    confidence: float = 0.95,
    seed: int = 0,
) -> PairedComparison:
    """Compare one value per episode id of two runs.

    Methods (all two-sided) and their effect sizes:

    - ``permutation``: signs of the differences; exact over all 2^n patterns with up to 20 differences other than 0, else
      10,000 seeded random patterns; Cohen's d_z = mean / std of the differences.
    - ``t``: Student's paired t test; d_z.
    - ``wilcoxon``: signed ranks, exact up to 20, with ties too; matched-pairs rank-biserial correlation (Kerby 2014),
      zeros left out.
    - ``mcnemar``: for 0/1 values, exact; odds ratio of the discordant pairs, (b + 1/2) / (c + 1/2).
    - ``auto``: ``mcnemar`` if all values are 0 or 1, else ``permutation``.

    The ``notes`` of the result state limits of a test: of 0/1 values only the pairs that differ count, and n such pairs
    give no p value below 2 / 2^n.

    Raises:
        InputError: the runs hold different episodes (the message names them), or the method does not fit the values.
    """
    _check_same_episodes(first, second)
    a = np.array([first[k] for k in first], np.float64)
    b = np.array([second[k] for k in first], np.float64)
    both = ~(np.isnan(a) | np.isnan(b))
    undefined = int((~both).sum())
    a, b = a[both], b[both]
    binary = bool(len(a)) and bool(np.isin(np.append(a, b), (0, 1)).all())
    if method == "auto":
        method = "mcnemar" if binary else "permutation"
    if method == "mcnemar" and len(a) and not binary:
        raise InputError(
            "McNemar's test compares 0/1 values; these are others. Hint: method='permutation'.", code="H3-STATS-029"
        )
    tests = {
        "permutation": ("permutation", _permutation, "Cohen's d_z"),
        "t": ("paired t", _student, "Cohen's d_z"),
        "wilcoxon": ("Wilcoxon signed-rank", _wilcoxon, "rank-biserial correlation"),
        "mcnemar": ("exact McNemar", _mcnemar, "odds ratio"),
    }
    if method not in tests:
        raise InputError(f"Expected a method of auto, {', '.join(tests)}, got {method!r}.", code="H3-STATS-030")
    name, test, effect_name = tests[method]
    d = a - b
    if method == "permutation" and np.count_nonzero(d) <= _ENUMERATED:
        name = "exact permutation"
    p, effect = test(d, seed) if len(d) > 1 else (float("nan"), float("nan"))
    low, high = bootstrap_interval(d, confidence=confidence, seed=seed)
    first_mean, second_mean, difference = (
        float(values.mean()) if len(values) else float("nan") for values in (a, b, d)
    )
    return PairedComparison(
        first_mean=first_mean,
        second_mean=second_mean,
        difference=difference,
        low=low,
        high=high,
        p=p,
        p_adjusted=p,
        method=name,
        effect=effect,
        effect_name=effect_name,
        pairs=len(d),
        undefined=undefined,
        notes=tuple(_notes(d, method, binary=binary)) if len(d) > 1 else (),
    )


def _notes(d: NDArray[np.float64], method: PairedMethod, *, binary: bool) -> list[str]:
    notes, differ = [], int(np.count_nonzero(d))
    if binary:
        notes.append(f"The values are 0 or 1: of {len(d)} pairs only the {differ} that differ say which is larger.")
        if method in ("t", "wilcoxon"):
            notes.append("This test is approximate or ranks ties on 0/1 values; exact: method='mcnemar' (or auto).")
    least = 2.0 ** (1 - differ)
    if differ and least > 0.05 and method != "t":
        what = "1 pair that differs" if differ == 1 else f"{differ} pairs that differ"
        notes.append(f"With {what}, this test gives no p below {least:.3g}, whatever the values.")
    return notes


def _permutation(d: NDArray[np.float64], seed: int) -> tuple[float, float]:
    effect, moving = _cohen(d), d[d != 0]  # a sign of 0 changes nothing
    if len(moving) <= _ENUMERATED:
        return _exact_p(moving), effect
    random, extreme = np.random.default_rng(seed), 0
    observed = abs(d.sum()) - _rounding(d)
    resamples, per_block = 10_000, max(1, 2_000_000 // len(d))  # at most 2 MB of signs at a time
    for start in range(0, resamples, per_block):
        rows = min(per_block, resamples - start)
        signs = random.integers(0, 2, (rows, len(d)), np.int8) * 2 - 1
        extreme += int((np.abs(signs @ d) >= observed).sum())
    # the observed pattern is one of them, so that p is never 0 (Phipson and Smyth 2010)
    return (extreme + 1) / (resamples + 1), effect


def _exact_p(d: NDArray[np.float64]) -> float:
    """Return the share of all patterns of signs whose sum is at least as far from 0 as that of ``d``; 1 of no differences."""
    sums = d[:1]  # the other sign of the first mirrors all sums
    for value in d[1:]:
        sums = np.concatenate([sums + value, sums - value])
    return float((np.abs(sums) >= abs(d.sum()) - _rounding(d)).mean()) if len(d) else 1.0


def _rounding(d: NDArray[np.float64]) -> float:
    """Return sums that differ by less are equal but for rounding."""
    return 1e-12 * float(np.abs(d).sum())


def _student(d: NDArray[np.float64], _seed: int) -> tuple[float, float]:
    from scipy.special import stdtr

    spread = d.std(ddof=1)
    # t is infinite or 0/0 where all differences are equal
    if spread == 0:
        return (1.0 if d[0] == 0 else 0.0), _cohen(d)
    return float(2 * stdtr(len(d) - 1, -abs(d.mean()) / spread * np.sqrt(len(d)))), _cohen(d)


def _wilcoxon(d: NDArray[np.float64], _seed: int) -> tuple[float, float]:
    from scipy.stats import rankdata, wilcoxon

    d = d[d != 0]
    if not len(d):
        # runs that do not differ in any episode
        return 1.0, 0.0
    ranks = rankdata(np.abs(d))
    effect = float((ranks * np.sign(d)).sum() / ranks.sum())
    if len(d) <= _ENUMERATED:
        return _exact_p(ranks * np.sign(d)), effect
    result: Any = wilcoxon(d)
    return float(result.pvalue), effect


def _mcnemar(d: NDArray[np.float64], _seed: int) -> tuple[float, float]:
    from scipy.stats import binomtest

    up, down = int((d > 0).sum()), int((d < 0).sum())
    p = float(binomtest(up, up + down).pvalue) if up + down else 1.0
    # half a pair is added to each (Haldane and Anscombe), so that the ratio is finite without pairs
    return p, (up + 0.5) / (down + 0.5)


def _cohen(d: NDArray[np.float64]) -> float:
    spread = d.std(ddof=1)
    return float(d.mean() / spread) if spread > 0 else float("nan")


def _check_same_episodes(first: Mapping[str, float], second: Mapping[str, float]) -> None:
    only_first, only_second = [k for k in first if k not in second], [k for k in second if k not in first]
    if only_first or only_second:
        raise InputError(
            f"A paired comparison needs the same episodes in both runs. Only in the first: {some_of(only_first)}. "
            f"Only in the second: {some_of(only_second)}.",
            code="H3-STATS-031",
        )
    if not first:
        raise InputError("The runs have no episodes.", code="H3-STATS-032")


def some_of(names: Sequence[str], most: int = 5) -> str:
    """Return the first ``most`` names for an error text: ``e0, e1 and 3 more``; ``none`` if there are none."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more or "none"
