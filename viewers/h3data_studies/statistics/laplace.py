"""Laplace's approximation of the likelihood of a mixed model, by penalised iteratively reweighted least squares.

Bates, Maechler, Bolker, Walker 2015, "Fitting Linear Mixed-Effects Models Using lme4", J. Stat. Softw. 67(1), and the
computational notes of lme4. The random intercepts are b = theta * u with u ~ N(0, I); eta = X beta + sum_k theta_k Z_k u_k.
"""

# Written out because no maintained pure-Python package has this likelihood (see `__init__`). Checked against lme4
# 1.1-31 (log-likelihoods and modes of tests/data/glmm) and against a plain dense Laplace approximation that
# tests/studies/test_mixed_models.py computes with scipy.optimize.

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from h3data_studies.statistics.glmm_design import MixedDesign
from h3data_studies.statistics.nested_elimination import NestedElimination

Array: TypeAlias = NDArray[np.floating[Any]]

_TOLERANCE = 1e-9
"""Largest change of a spherical random effect or a coefficient in the last iteration."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mode:
    """Most likely random effects for given deviations (and optionally coefficients), with their deviance."""

    deviance: float
    """Deviance: -2 log-likelihood; infinite if the iteration failed."""
    effects: tuple[Array, ...]
    """Spherical effects u of each factor, each of shape [levels]."""
    coefficients: Array
    fixed_factor: Array
    """Lower Cholesky factor [P, P] of the information matrix of the coefficients; [0, 0] if these were fixed."""
    eta: Array
    """Linear predictor, shape [N]."""


class LaplaceModel:
    """Laplace's approximation of the likelihood for one design; each search starts from the previous mode.

    Nested factors are eliminated from the normal equations in closed form (`NestedElimination`). The remaining system
    is dense and has the size of the crossed factors and the coefficients.
    """

    def __init__(self, design: MixedDesign) -> None:
        from scipy.special import gammaln

        y, n, x = design.response, design.trials, design.x
        self.names = list(design.groups)
        self.level_counts = np.array([len(design.group_levels[name]) for name in self.names])
        """Levels of each random factor, shape [K]."""
        self._poisson = design.family == "poisson"
        self._y, self._n, self._x = y, n, x
        groups = [design.groups[name] for name in self.names]
        self._bound = NestedElimination(groups, self.level_counts.tolist(), np.zeros((len(y), 0)))
        self._free = NestedElimination(groups, self.level_counts.tolist(), x)
        if self._poisson:
            self._constant = gammaln(y + 1).sum()
            start = np.log(y + 0.5)
        else:
            self._constant = (gammaln(y + 1) + gammaln(n - y + 1) - gammaln(n + 1)).sum()
            start = np.log((y + 0.5) / (n - y + 0.5))
        self._effects: Sequence[Array] = [np.zeros(count) for count in self.level_counts]
        self._beta = np.linalg.lstsq(x, start, rcond=None)[0]

    def mode(self, theta: Array, coefficients: Array | None = None) -> Mode:
        """Return the mode for deviations ``theta`` [K] and ``coefficients`` [P]; None: the most likely coefficients.

        The deviance is -2 log f(y | u, beta) + |u|² + log |I + Λ'Z'WZΛ|, Laplace's approximation of -2 log ∫ f(y | u)
        φ(u) du.
        """
        free = coefficients is None
        normal = self._free if free else self._bound
        u: Sequence[Array] = self._effects
        beta = self._beta if coefficients is None else coefficients

        def predict(u: Sequence[Array], beta: Array) -> tuple[Array, float]:
            eta = self._x @ beta + normal.effect(theta, u)
            return eta, self._fit(eta) + sum(float(effects @ effects) for effects in u)

        eta, value = predict(u, beta)
        for _ in range(60):
            mean, weight = self._moments(eta)
            try:
                solution = normal.solve(theta, weight, self._y - mean, u)
            except np.linalg.LinAlgError:
                break
            step, step_beta = solution.effects, solution.coefficients
            if max(float(np.abs(change).max(initial=0)) for change in (*step, step_beta)) < _TOLERANCE:
                self._effects = u
                self._beta = beta if free else self._beta
                return Mode(
                    deviance=value + solution.log_determinant,
                    effects=tuple(u),
                    coefficients=beta,
                    fixed_factor=solution.fixed_factor,
                    eta=eta,
                )
            size = 1.0
            for _ in range(40):
                ahead = [a + size * b for a, b in zip(u, step, strict=True)]
                beta_ahead = beta + size * step_beta if free else beta
                eta, value_ahead = predict(ahead, beta_ahead)
                if value_ahead <= value + 1e-9 * abs(value):
                    break
                size /= 2
            else:
                break
            u, beta, value = ahead, beta_ahead, value_ahead
        return Mode(
            deviance=float("inf"), effects=tuple(u), coefficients=self._beta, fixed_factor=np.zeros((0, 0)), eta=eta
        )

    def intercepts(self, mode: Mode, theta: Array) -> Mapping[str, Array]:
        """Return the random intercepts b = theta * u on the link scale by factor, each of shape [levels]."""
        return {name: theta[k] * mode.effects[k] for k, name in enumerate(self.names)}

    def pearson(self, mode: Mode) -> float:
        """Return the sum of the squared Pearson residuals at a mode."""
        mean, weight = self._moments(mode.eta)
        return float(np.sum((self._y - mean) ** 2 / weight))

    def _fit(self, eta: Array) -> float:
        """Return -2 log f(y | eta)."""
        with np.errstate(over="ignore"):
            partition = np.exp(eta) if self._poisson else self._n * np.logaddexp(0, eta)
        return 2 * float(self._constant + np.sum(partition - self._y * eta))

    def _moments(self, eta: Array) -> tuple[Array, Array]:
        """Return the mean and variance [N]. The links are canonical, so the variance is also the weight."""
        from scipy.special import expit

        if self._poisson:
            mean = np.exp(eta)
            return mean, mean
        return self._n * expit(eta), self._n * expit(eta) * expit(-eta)
