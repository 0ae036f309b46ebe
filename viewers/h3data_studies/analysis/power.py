"""Statistical power of a planned study, from simulated studies in which the expected differences are tested."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.stats import wilson_interval
from h3data_studies.analysis.planning import Session, study_rows
from h3data_studies.statistics import Adjustment, Family, SeparationError, contrasts, fit_glmm, marginal_means

_GROUPS = ("participant", "scene", "observation")


@dataclass(frozen=True, kw_only=True)
class Power:
    """Statistical power for one pair of conditions: the share of simulated studies that find their difference."""

    first: str
    second: str
    power: float
    low: float
    """Lower end of the Wilson interval, which covers simulation error only."""
    high: float
    runs: int
    failed: int
    """Number of runs without a converged fit, as after separation; they count as runs without an effect."""


def simulate_study(
    sessions: Sequence[Session],
    means: Mapping[str, float],
    family: Family,
    *,
    deviations: Mapping[Literal["participant", "scene", "observation"], float],
    seed: int = 0,
) -> dict[str, NDArray[Any]]:
    """Return the columns of `study_rows` and a ``response`` sampled from the mixed model.

    Args:
        sessions: Sessions of the study, from `plan_sessions`.
        means: Expected steps or rate of a typical participant in a typical scene, by condition.
        family: ``poisson`` (log link) or ``binomial`` (logit link, one trial per row).
        deviations: Standard deviations on the link scale of participants, scenes and single episodes (in addition to
            the family's own variance).
        seed: The same seed gives the same study.
    """
    table: dict[str, NDArray[Any]] = {name: np.array(column) for name, column in study_rows(sessions).items()}
    unknown = [name for name in deviations if name not in _GROUPS]
    if unknown or any(not value >= 0 for value in deviations.values()):
        raise InputError(
            f"Expected deviations >= 0 of {', '.join(_GROUPS)}, got {dict(deviations)}.", code="H3-METRIC-041"
        )
    wanted = sorted(set(table["condition"].tolist()))
    if sorted(means) != wanted:
        raise InputError(
            f"Expected a mean of each condition ({', '.join(wanted)}), got {', '.join(sorted(means))}.",
            code="H3-METRIC-042",
        )
    ends = (0, np.inf) if family == "poisson" else (0, 1)
    if not all(ends[0] < m < ends[1] for m in means.values()):
        raise InputError(
            f"Expected means between {ends[0]} and {ends[1]} for the {family} family, got {dict(means)}.",
            code="H3-METRIC-043",
        )
    random = np.random.default_rng(seed)
    mean = np.array([means[c] for c in table["condition"]])
    eta = np.log(mean) if family == "poisson" else np.log(mean / (1 - mean))
    for name in ("participant", "scene"):
        levels, codes = np.unique(table[name], return_inverse=True)
        eta += deviations.get(name, 0.0) * random.standard_normal(len(levels))[codes]
    eta += deviations.get("observation", 0.0) * random.standard_normal(len(eta))
    if family == "poisson":
        table["response"] = random.poisson(np.exp(eta))
    else:
        table["response"] = (random.random(len(eta)) < 1 / (1 + np.exp(-eta))).astype(np.int64)
    return table


def simulate_power(
    sessions: Sequence[Session],
    means: Mapping[str, float],
    family: Family,
    *,
    deviations: Mapping[Literal["participant", "scene", "observation"], float],
    runs: int = 100,
    alpha: float = 0.05,
    adjust: Adjustment = "tukey",
    seed: int = 0,
) -> tuple[Power, ...]:
    """Return the power for each pair of conditions by simulating, fitting and testing many studies.

    Each run calls `simulate_study`, `fit_glmm` and `contrasts`, and counts p < ``alpha``. Poisson models get the
    observation-level effect if the simulation has one. A run takes 0.1 to 0.3 s.
    """
    if runs < 1 or not 0 < alpha < 1:
        raise InputError(
            f"Expected one run or more and 0 < alpha < 1, got {runs} runs and alpha {alpha}.", code="H3-METRIC-044"
        )
    observation = family == "poisson" and deviations.get("observation", 0.0) > 0
    levels = sorted(means)
    detections = {(a, b): 0 for k, a in enumerate(levels) for b in levels[k + 1 :]}
    failed = 0
    for run in range(runs):
        table = simulate_study(sessions, means, family, deviations=deviations, seed=seed + run)
        random = [name for name in ("participant", "scene") if len(np.unique(table[name])) > 1]
        try:
            fit = fit_glmm(
                table, "response", family, fixed=["condition"], random=random, observation_effect=observation
            )
        except SeparationError:
            failed += 1
            continue
        if not fit.converged:
            failed += 1
            continue
        for c in contrasts(marginal_means(fit, "condition"), adjust=adjust):
            detections[c.first, c.second] += c.p < alpha
    result = []
    for (a, b), times in detections.items():
        low, high = wilson_interval(times, runs)
        result.append(Power(first=a, second=b, power=times / runs, low=low, high=high, runs=runs, failed=failed))
    return tuple(result)
