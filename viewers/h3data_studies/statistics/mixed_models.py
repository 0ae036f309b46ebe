"""Generalised linear mixed models with crossed random intercepts, fitted by maximum likelihood (Laplace)."""

# Written out because no maintained pure-Python package fits these by maximum likelihood (see `__init__`). Checked
# against lme4 1.1-31 on four simulated data sets (tests/data/glmm/make_reference.R): estimates, standard errors,
# deviations, modes and log-likelihoods within 0.1%.

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data_studies.statistics.glmm_design import Family, FixedDesign, MixedDesign, mixed_design
from h3data_studies.statistics.laplace import LaplaceModel, Mode

if TYPE_CHECKING:
    import pyarrow as pa

_SINGULAR = 1e-4
"""Deviations below this count as 0, as in lme4's isSingular."""
_OVERDISPERSED = 1.5
"""Pearson's statistic per degree of freedom above which a model without an observation effect is called unsound."""
_DECREMENT = 1e-7
"""A fit has converged if another Newton step would lower the deviance by less than this."""
_ROUNDING = 1e-4
"""Decrement accepted where no step lowers the deviance any more: the error of the finite differences."""
_STEP = 0.02
"""Step of the finite differences, in standard errors."""
_ALIKE = 5.0
"""Log-odds. With a deviation beyond this, two of three people of a binomial model nearly always answer alike: the likelihood
says only that it is large, Laplace's approximation of it fails, and means of "a typical person" run to 0 or 1."""
_PENALTY = 2.5
"""Log-odds. Scale of the half-normal penalty of deviations that then applies: odds of typical people within a factor of 12."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GlmmFit:
    """Fitted generalised linear mixed model.

    All estimates are on the link scale: natural logarithm for Poisson, log-odds for binomial.
    """

    formula: str
    """Model in lme4's notation."""
    family: Family
    rows: int
    fixed: FixedDesign
    coefficients: NDArray[np.float64]
    """Coefficients of the fixed effects in treatment coding, shape [P], named by ``fixed.names``."""
    covariance: NDArray[np.float64]
    """Covariance of the coefficients, shape [P, P], from the observed information of coefficients and deviations."""
    deviations: Mapping[str, float]
    """Standard deviation of each random intercept on the link scale; 0 for a singular fit."""
    modes: Mapping[str, Mapping[str, float]]
    """Most likely intercept of each level, by random factor and level."""
    log_likelihood: float
    """Log-likelihood by Laplace's approximation, including constants."""
    dispersion: float
    """Pearson's statistic over the residual degrees of freedom; far above 1, the standard errors are too small."""
    converged: bool
    notes: tuple[str, ...]
    """Warnings about the estimates: singular, over-dispersed, always alike, not converged."""
    overdispersed: bool = False
    """True if the response varies so much more than the family allows that standard errors and p values are too
    small."""
    penalised: bool = False
    """True if people (or other levels of a random intercept) always answer alike, so that their deviation has no finite
    estimate. A penalty then makes the estimates finite, and they depend on that penalty."""

    @property
    def sound(self) -> bool:
        """Return whether standard errors and p values can be relied on."""
        return self.converged and not self.overdispersed and not self.penalised

    @property
    def standard_errors(self) -> NDArray[np.float64]:
        """Standard errors of the coefficients, shape [P]."""
        return np.sqrt(np.diag(self.covariance))

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        return f"GlmmFit({self.formula!r}, {self.family}, {self.rows} rows, {state})"

    def to_text(self) -> str:
        """Return a table of the coefficients with standard errors and of the deviations, followed by the notes."""
        state = "" if self.converged else "  NOT CONVERGED"
        lines = [f"{self.formula}   {self.family}, {self.rows} rows{state}", ""]
        width = max(map(len, (*self.fixed.names, *self.deviations)))
        lines.append(f"{'fixed effect'.ljust(width)}  {'estimate':>10}  {'std. error':>10}")
        for name, value, error in zip(self.fixed.names, self.coefficients, self.standard_errors, strict=True):
            lines.append(f"{name.ljust(width)}  {value:10.4f}  {error:10.4f}")
        lines += ["", f"{'random intercept'.ljust(width)}  {'std. dev.':>10}  {'levels':>10}"]
        for name, value in self.deviations.items():
            lines.append(f"{name.ljust(width)}  {value:10.4f}  {len(self.modes[name]):10d}")
        lines += ["", f"log-likelihood {self.log_likelihood:.2f}, dispersion {self.dispersion:.2f}"]
        return "\n".join([*lines, *(f"Note: {note}" for note in self.notes)])


def fit_glmm(
    table: pa.Table | Mapping[str, ArrayLike],
    response: str,
    family: Family,
    *,
    fixed: Sequence[str],
    random: Sequence[str],
    trials: str | None = None,
    levels: Mapping[str, Sequence[str]] | None = None,
    observation_effect: bool = False,
) -> GlmmFit:
    """Fit ``response ~ fixed + (1 | random[0]) + (1 | random[1]) + ...`` by maximum likelihood.

    Equivalent to lme4's ``glmer(..., nAGQ = 1)``: canonical links, penalised iteratively reweighted least squares for
    the random intercepts, Laplace's approximation of the likelihood, standard errors from the observed information.
    Habitat 3.0 (appendix, Human-in-the-loop Evaluation) uses Poisson for steps and binomial for collisions.

    Args:
        table: One row per episode.
        response: Column of counts (Poisson), or of 0/1 or successes out of ``trials`` (binomial).
        family: ``poisson`` with the log link or ``binomial`` with the logit link.
        fixed: Columns of the fixed effects: text and booleans are factors, numbers covariates; ``"a:b"`` is an
            interaction of ``a`` and ``b``.
        random: Columns that group the rows, each with a random intercept; crossed or nested, balanced or not.
        trials: Column of the numbers of trials.
        levels: Order of a factor's levels, the reference first (default: alphabetical). Turns numbers into a factor.
        observation_effect: Adds a random intercept per row, for counts that vary more than Poisson allows.

    Raises:
        SeparationError: a level or a combination of levels decides the response.
        InputError: unknown columns, undefined values, a response that is not a count, a factor with one level, linearly
            dependent fixed effects, an interaction with an empty cell, random effects that cannot be separated.
    """
    design = mixed_design(
        table,
        response,
        family,
        fixed,
        random,
        trials=trials,
        levels=levels or {},
        observation_effect=observation_effect,
    )
    model, alike = LaplaceModel(design), _always_alike(design)
    theta, coefficients, covariance, converged = _maximum(model, design, penalised=bool(alike))
    if not alike and family == "binomial":
        alike = [name for name, deviation in zip(design.groups, theta, strict=True) if deviation > _ALIKE]
        if alike:
            model = LaplaceModel(design)
            theta, coefficients, covariance, converged = _maximum(model, design, penalised=True)
    mode = model.mode(theta, coefficients)
    notes = _notes(design, theta, converged)
    if alike:
        notes.append(
            f"always alike: rows of the same {' and '.join(alike)} hardly differ, so the deviation has no finite estimate. A "
            "penalty holds it back; means, standard errors and p values depend on that penalty. Report plain shares too."
        )
    dispersion = model.pearson(mode) / max(len(design.response) - len(theta) - len(coefficients), 1)
    binary = family == "binomial" and bool((design.trials == 1).all())
    overdispersed = bool(dispersion > _OVERDISPERSED) and not observation_effect and not binary
    if overdispersed:
        notes.append(
            f"over-dispersed: the response varies {dispersion:.1f} times as much as the {family} family allows, so the "
            "standard errors are too small. Hint: observation_effect=True."
        )
    return GlmmFit(
        formula=design.formula,
        family=family,
        rows=len(design.response),
        fixed=design.fixed,
        coefficients=coefficients,
        covariance=covariance,
        deviations=dict(zip(design.groups, map(float, theta), strict=True)),
        modes={
            name: dict(zip(design.group_levels[name], map(float, values), strict=True))
            for name, values in model.intercepts(mode, theta).items()
        },
        log_likelihood=-mode.deviance / 2,
        dispersion=float(dispersion),
        converged=converged,
        notes=tuple(notes),
        overdispersed=overdispersed,
        penalised=bool(alike),
    )


def _always_alike(design: MixedDesign) -> list[str]:
    """Return the random factors of a binomial model that have only levels with a single outcome in several rows."""
    if design.family != "binomial":
        return []
    found = []
    for name, codes in design.groups.items():
        trials, successes = (np.bincount(codes, weights=values) for values in (design.trials, design.response))
        constant = bool(((successes == 0) | (successes == trials)).all())
        if constant and trials.sum() > len(trials) and 0 < successes.sum() < trials.sum():
            found.append(name)
    return found


def _maximum(
    model: LaplaceModel, design: MixedDesign, *, penalised: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], bool]:
    """Return deviations [K], coefficients [P] and their covariance [P, P] at the maximum, and whether it is proper."""

    def penalty(theta: NDArray[np.float64]) -> float:
        return float(np.sum((theta / _PENALTY) ** 2)) if penalised else 0.0

    start, mode = _profiled(model, penalty)
    k = len(start)
    if not np.isfinite(mode.deviance):
        raise InputError(
            f"No likelihood could be computed: {design.formula}. Hint: scale covariates to about 1.",
            code="H3-STATS-026",
        )
    scale = np.zeros((k + design.x.shape[1],) * 2)
    scale[:k, :k] = np.diag(np.maximum(start, 0.05) / np.sqrt(2.0 * model.level_counts))
    scale[k:, k:] = np.linalg.inv(mode.fixed_factor).T

    def deviance(at: NDArray[np.float64]) -> float:
        return model.mode(at[:k], at[k:]).deviance + penalty(at[:k])

    optimum, inverse, converged = _newton(deviance, np.append(start, mode.coefficients).astype(np.float64), scale)
    theta = np.abs(optimum[:k])
    theta[theta < _SINGULAR] = 0
    return theta, optimum[k:], 2 * inverse[k:, k:], converged  # the information is half the Hessian of -2 log L


def _profiled(model: LaplaceModel, penalty: Callable[[NDArray[np.float64]], float]) -> tuple[NDArray[np.float64], Mode]:
    """Return deviations [K] and mode near the optimum, with coefficients in the inner iteration (``nAGQ = 0``)."""
    from scipy.optimize import minimize

    k = len(model.level_counts)
    first = np.full(k, np.log(0.3))
    result = minimize(
        lambda log_theta: model.mode(np.exp(log_theta)).deviance + penalty(np.exp(log_theta)),
        first,
        method="Nelder-Mead",
        bounds=[(-12, 5)] * k,
        options={"initial_simplex": first + np.vstack([np.zeros(k), np.eye(k)]), "xatol": 0.02, "fatol": 0.01},
    )
    theta = np.exp(result.x)
    return theta, model.mode(theta)


def _newton(
    function: Callable[[NDArray[np.float64]], float], x: NDArray[np.float64], scale: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """Return the minimum, the inverse Hessian there, and whether it converged to a proper minimum.

    Derivatives are taken along the columns of ``scale``, each about one standard error long.
    """
    best = function(x)
    scale = _unit_curvature(function, x, scale, best)
    hessian, converged = np.eye(len(x)), False
    for _ in range(30):
        gradient, hessian = _differences(function, x, scale, best)
        if not np.isfinite(hessian).all():
            return x, np.zeros_like(scale), False
        values, vectors = np.linalg.eigh(hessian)
        slopes = vectors.T @ gradient
        lengths = slopes / np.maximum(np.abs(values), 1e-4)
        # The deviance is even in each standard deviation, so at 0 the gradient vanishes even where it falls to both sides.
        saddle = (values < -1e-3) & (np.abs(lengths) < 1)
        step = -vectors @ np.where(saddle, np.copysign(1, slopes), lengths)
        minimum, decrement = bool(values.min() > 1e-6), float(-gradient @ step)
        if minimum and decrement < _DECREMENT:
            x, converged = x + scale @ step, True
            break
        for halved in range(20):
            trial = x + scale @ step * 0.5**halved
            value = function(trial)
            if value < best:
                break
        else:
            converged = minimum and decrement < _ROUNDING
            break
        x, best = trial, value
    return x, scale @ np.linalg.pinv(hessian, hermitian=True) @ scale.T, converged


def _unit_curvature(
    function: Callable[[NDArray[np.float64]], float], x: NDArray[np.float64], scale: NDArray[np.float64], middle: float
) -> NDArray[np.float64]:
    """Rescale the columns of ``scale`` until the second derivative along each is about 2, that of a standard error."""
    ends = np.array([function(x + s) + function(x - s) for s in _STEP * scale.T])
    curvature = np.abs(ends - 2 * middle) / _STEP**2
    return scale * np.clip(np.sqrt(2 / np.maximum(curvature, 1e-9)), 0.1, 30)


def _differences(
    function: Callable[[NDArray[np.float64]], float], x: NDArray[np.float64], scale: NDArray[np.float64], middle: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the gradient [D] and Hessian [D, D] by central differences along the columns of ``scale``."""
    steps = _STEP * scale.T
    ahead = np.array([function(x + s) for s in steps])
    behind = np.array([function(x - s) for s in steps])
    gradient = (ahead - behind) / (2 * _STEP)
    hessian = np.diag(ahead + behind - 2 * middle)
    for i, a in enumerate(steps):
        for j, b in enumerate(steps[:i]):
            both = function(x + a + b) + function(x - a - b)
            hessian[i, j] = hessian[j, i] = (both - ahead[i] - behind[i] - ahead[j] - behind[j] + 2 * middle) / 2
    return gradient, hessian / _STEP**2


def _notes(design: MixedDesign, theta: NDArray[np.float64], converged: bool) -> list[str]:
    notes = []
    if not converged:
        notes.append("did not converge: do not trust estimates or standard errors. Hint: fit a simpler model.")
    singular = [name for name, deviation in zip(design.groups, theta, strict=True) if deviation == 0]
    if singular:
        notes.append(f"singular: the variance of {', '.join(singular)} is estimated as 0.")
    return notes
