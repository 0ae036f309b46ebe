"""Estimated marginal means of a mixed model, their pairwise contrasts, and relative efficiency, as in R's emmeans."""

# No Python package has emmeans' grids and contrasts for mixed models (see `__init__`). tests/studies/test_posthoc.py compares
# means, standard errors, intervals and contrasts with emmeans 1.8.4 on tests/data/glmm, and the published study's
# differences and efficiencies with its published means.

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.stats.intervals import check_confidence
from h3data.stats.multiple_tests import adjust_p_values
from h3data_studies.statistics.glmm_design import Family
from h3data_studies.statistics.mixed_models import GlmmFit

Scale = Literal["link", "response"]
Adjustment = Literal["tukey", "holm", "none"]


@dataclass(frozen=True, kw_only=True, eq=False)
class MarginalMeans:
    """Mean of each level of a factor for a typical participant in a typical scene (all random intercepts are 0)."""

    factor: str
    family: Family
    levels: tuple[str, ...]
    link: NDArray[np.float64]
    """Means on the link scale (logarithm or log-odds), shape [L]."""
    covariance: NDArray[np.float64]
    """Covariance of ``link``, shape [L, L]."""

    @property
    def means(self) -> NDArray[np.float64]:
        """Means on the response scale: counts or rates, shape [L]."""
        from scipy.special import expit

        return np.exp(self.link) if self.family == "poisson" else expit(self.link)

    @property
    def standard_errors(self) -> NDArray[np.float64]:
        """Standard errors of `means` by the delta method, shape [L]."""
        return np.sqrt(np.diag(self.covariance)) * self.slopes

    @property
    def slopes(self) -> NDArray[np.float64]:
        """Derivatives of the means, d mean / d link, shape [L]."""
        return self.means if self.family == "poisson" else self.means * (1 - self.means)

    def intervals(self, confidence: float = 0.95) -> NDArray[np.float64]:
        """Return the ends of the intervals on the response scale, shape [L, 2]; they are symmetric on the link scale."""
        from scipy.special import expit, ndtri

        check_confidence(confidence)
        half = ndtri((1 + confidence) / 2) * np.sqrt(np.diag(self.covariance))
        ends = np.column_stack([self.link - half, self.link + half])
        return np.exp(ends) if self.family == "poisson" else expit(ends)

    def to_text(self, *, confidence: float = 0.95) -> str:
        """Return a table with mean, standard error and interval of each level."""
        width = max(map(len, (*self.levels, self.factor)))
        lines = [f"{self.factor.ljust(width)}  {'mean':>10}  {'std. error':>10}  {100 * confidence:g}% interval"]
        rows = zip(self.levels, self.means, self.standard_errors, self.intervals(confidence), strict=True)
        lines += [f"{name.ljust(width)}  {m:10.4g}  {e:10.3g}  [{a:.4g}, {b:.4g}]" for name, m, e, (a, b) in rows]
        return "\n".join(lines)


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """Difference ``first - second`` of two estimated means."""

    first: str
    second: str
    scale: Scale
    difference: float
    """Difference of logarithms or log-odds (scale ``link``), or of counts or rates (scale ``response``)."""
    standard_error: float
    low: float
    """Lower end of the interval, which is adjusted for the number of contrasts."""
    high: float
    """Upper end of the interval, which is adjusted for the number of contrasts."""
    z: float
    p: float
    """Two-sided p value, adjusted for the number of contrasts."""
    adjust: Adjustment

    @property
    def ratio(self) -> tuple[float, float, float]:
        """Ratio exp(difference) of means (Poisson) or odds (binomial), with its interval; only on the ``link`` scale."""
        if self.scale != "link":
            raise InputError(
                "A ratio needs contrasts on the link scale: contrasts(means, scale='link').", code="H3-STATS-036"
            )
        return tuple(float(np.exp(v)) for v in (self.difference, self.low, self.high))  # type: ignore[return-value]


@dataclass(frozen=True, kw_only=True)
class RelativeEfficiency:
    """Relative efficiency: steps without a robot over steps with it, in percent; above 100 the robot helps."""

    level: str
    percent: float
    low: float
    high: float


def marginal_means(fit: GlmmFit, factor: str) -> MarginalMeans:
    """Return the marginal means of ``factor``, with equal weights of the other factors' levels on the link scale."""
    rows = fit.fixed.marginal(factor)
    return MarginalMeans(
        factor=factor,
        family=fit.family,
        levels=fit.fixed.levels[factor],
        link=rows @ fit.coefficients,
        covariance=rows @ fit.covariance @ rows.T,
    )


def contrasts(
    means: MarginalMeans, *, scale: Scale = "link", adjust: Adjustment = "tukey", confidence: float = 0.95
) -> tuple[Contrast, ...]:
    """Return the contrasts of all pairs of levels with z tests, as emmeans' ``pairs`` (``response``: after ``regrid``).

    Args:
        means: Marginal means from `marginal_means`.
        scale: ``link`` tests ratios (the better normal approximation); ``response`` tests differences of counts or
            rates.
        adjust: ``tukey``: studentised range of all levels; ``holm``: step-down on the p values, Bonferroni for
            intervals.
        confidence: Joint confidence of all intervals.
    """
    from scipy.special import ndtr, ndtri
    from scipy.stats import studentized_range

    check_confidence(confidence)
    if scale not in ("link", "response") or adjust not in ("tukey", "holm", "none"):
        raise InputError(
            f"Expected scale link or response and adjust tukey, holm or none; got {scale!r} and {adjust!r}.",
            code="H3-STATS-033",
        )
    count = len(means.levels)
    pairs = list(itertools.combinations(range(count), 2))
    rows = np.array([np.eye(count)[i] - np.eye(count)[j] for i, j in pairs])
    slopes = np.ones(count) if scale == "link" else means.slopes
    difference = rows @ (means.link if scale == "link" else means.means)
    error = np.sqrt(np.diag((rows * slopes) @ means.covariance @ (rows * slopes).T))
    z = difference / error
    p = 2 * ndtr(-np.abs(z))
    half = ndtri((1 + confidence) / 2)
    if adjust == "holm":
        p = adjust_p_values(p, method="holm")
        half = -ndtri((1 - confidence) / 2 / len(pairs))
    elif adjust == "tukey" and count > 2:  # for two means Tukey's test is the plain one
        p = np.clip(studentized_range.sf(np.abs(z) * np.sqrt(2), count, np.inf), 0, 1)
        half = _tukey_half_width(confidence, count)
    return tuple(
        Contrast(
            first=means.levels[i],
            second=means.levels[j],
            scale=scale,
            difference=float(difference[k]),
            standard_error=float(error[k]),
            low=float(difference[k] - half * error[k]),
            high=float(difference[k] + half * error[k]),
            z=float(z[k]),
            p=float(p[k]),
            adjust=adjust,
        )
        for k, (i, j) in enumerate(pairs)
    )


def relative_efficiency(
    means: MarginalMeans, baseline: str, *, confidence: float = 0.95
) -> tuple[RelativeEfficiency, ...]:
    """Return the relative efficiency: 100 * mean steps of ``baseline`` / mean steps of each other level.

    Source: Habitat 3.0, appendix, HITL evaluation.

    The interval of the ratio is not adjusted for the number of levels.
    """
    from scipy.special import ndtri

    check_confidence(confidence)
    if means.family != "poisson":
        raise InputError(
            "Relative efficiency is a ratio of steps: expected means of a Poisson model, got binomial.",
            code="H3-STATS-034",
        )
    if baseline not in means.levels:
        raise InputError(
            f"No level {baseline!r} in {means.factor!r}. Its levels are: {', '.join(means.levels)}.",
            code="H3-STATS-035",
        )
    base = means.levels.index(baseline)
    result = []
    for k, level in enumerate(means.levels):
        if k == base:
            continue
        row = np.eye(len(means.levels))[base] - np.eye(len(means.levels))[k]
        ratio, half = row @ means.link, ndtri((1 + confidence) / 2) * np.sqrt(row @ means.covariance @ row)
        percent, low, high = 100 * np.exp([ratio, ratio - half, ratio + half])
        result.append(RelativeEfficiency(level=level, percent=float(percent), low=float(low), high=float(high)))
    return tuple(result)


def contrasts_text(rows: Sequence[Contrast]) -> str:
    """Return a table of contrasts: the difference (a ratio on the link scale), its interval, z and p."""
    if not rows:
        return "no contrasts"
    width = max(len(f"{c.first} - {c.second}") for c in rows)
    head = "ratio" if rows[0].scale == "link" else "difference"
    lines = [f"{'contrast'.ljust(width)}  {head:>10}  {'interval':>20}  {'z':>7}  p ({rows[0].adjust})"]
    for c in rows:
        value, low, high = c.ratio if c.scale == "link" else (c.difference, c.low, c.high)
        p = "< .0001" if c.p < 1e-4 else f"{c.p:.4f}"
        name = f"{c.first} / {c.second}" if c.scale == "link" else f"{c.first} - {c.second}"
        lines.append(f"{name.ljust(width)}  {value:10.4g}  {f'[{low:.4g}, {high:.4g}]':>20}  {c.z:7.2f}  {p}")
    return "\n".join(lines)


@functools.cache
def _tukey_half_width(confidence: float, count: int) -> float:
    """Return half the width of Tukey's intervals, in standard errors of a difference."""
    from scipy.stats import studentized_range

    return float(studentized_range.ppf(confidence, count, np.inf) / np.sqrt(2))
