"""Adjustment of the p values of several tests for multiple testing."""

# Three formulas of two lines each are no reason to depend on statsmodels (its `multipletests`), the only other package
# with all three. tests/stats/test_intervals.py checks Benjamini-Hochberg against scipy.stats, the others by hand.

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError

PAdjustment = Literal["holm", "bonferroni", "benjamini-hochberg", "none"]


def adjust_p_values(p: ArrayLike, *, method: PAdjustment = "holm") -> NDArray[np.float64]:
    """Return the adjusted p values [M] of M tests, in their order; NaN stays NaN and does not count as a test.

    ``holm`` and ``bonferroni`` bound the chance of any false finding (Holm 1979), ``benjamini-hochberg`` bounds the
    expected share of false findings among all findings (1995).
    """
    values = np.asarray(p, np.float64)
    if values.ndim != 1 or (values < 0).any() or (values > 1).any():
        raise InputError(f"Expected p values between 0 and 1, shape [M], got {p!r}.", code="H3-STATS-027")
    result = values.copy()
    tested = np.flatnonzero(~np.isnan(values))
    order = tested[np.argsort(values[tested], kind="stable")]
    ranked, m = values[order], len(order)
    match method:
        case "none":
            pass
        case "bonferroni":
            result[order] = np.minimum(m * ranked, 1)
        # from the smallest p on, each times the number of tests that are left; a later one is never smaller
        case "holm":
            result[order] = np.minimum(np.maximum.accumulate(ranked * np.arange(m, 0, -1)), 1)
        # from the largest p down: p times m over its rank, and never above that of the next larger p
        case "benjamini-hochberg":
            result[order] = np.minimum.accumulate((ranked * m / np.arange(1, m + 1))[::-1])[::-1]
        case _:
            raise InputError(
                f"Expected holm, bonferroni, benjamini-hochberg or none, got {method!r}.", code="H3-STATS-028"
            )
    return result
