"""Laplace's approximation of the likelihood of a mixed model, by penalised iteratively reweighted least squares.

Bates, Maechler, Bolker, Walker 2015, "Fitting Linear Mixed-Effects Models Using lme4", J. Stat. Softw. 67(1), and the
computational notes of lme4. The random intercepts are b = theta * u with u ~ N(0, I); eta = X beta + sum_k theta_k Z_k u_k.
"""

# Written out because no maintained pure-Python package has this likelihood (see `h3data.stats`). Checked against lme4
# 1.1-31 (log-likelihoods and modes of tests/data/glmm) and against a plain dense Laplace approximation that
# tests/stats/test_mixed_models.py computes with scipy.optimize.

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from h3data.stats.glmm_design import MixedDesign

Array: TypeAlias = NDArray[np.floating[Any]]

_TOLERANCE = 1e-9
"""Largest change of a spherical random effect or a coefficient in the last iteration."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mode:
    """The most likely random effects for given deviations (and coefficients), and the deviance there."""

    deviance: float
    """-2 log-likelihood; infinite if the iteration failed."""
    largest: Array
    """Spherical effects u of the factor with the most levels."""
    rest: Array
    """Spherical effects of the other factors, followed by the coefficients if these were free."""
    coefficients: Array
    fixed_factor: Array
    """Lower Cholesky factor [P, P] of the coefficients' information; shape [0, 0] unless they were free."""
    eta: Array
    """Linear predictor, shape [N]."""


class LaplaceModel:
    """Laplace's approximation for one design. Each mode starts from the previous one, which an optimiser keeps near.

    The diagonal block of the factor with the most levels (the observation-level effect, if there is one) is eliminated
    from the normal matrix in closed form; the dense remainder has the size of the other factors and the coefficients.
    All large products are sparse because BLAS threads wait for each other on busy cores: 32 ms for a product of 900 x 40
    that takes 0.08 ms alone.
    """

    def __init__(self, design: MixedDesign) -> None:
        from scipy.sparse import csr_matrix
        from scipy.special import gammaln

        y, n, x = design.response, design.trials, design.x
        self.names = list(design.groups)
        self.level_counts = np.array([len(design.group_levels[name]) for name in self.names])
        """Levels of each random factor, shape [K]."""
        self._poisson = design.family == "poisson"
        self._y, self._n, self._x = y, n, x
        self._big = int(np.argmax(self.level_counts))
        self._others = [k for k in range(len(self.names)) if k != self._big]
        self._group = design.groups[self.names[self._big]]
        big = csr_matrix((np.ones(len(y)), (np.arange(len(y)), self._group)))
        small = [np.eye(self.level_counts[k])[design.groups[self.names[k]]] for k in self._others]
        effects = np.hstack([np.zeros((len(y), 0)), *small])
        self._small_count = effects.shape[1]
        self._bound = _Products(big, csr_matrix(effects))
        self._free = _Products(big, csr_matrix(np.hstack([effects, x])))
        if self._poisson:
            self._constant = gammaln(y + 1).sum()
            start = np.log(y + 0.5)
        else:
            self._constant = (gammaln(y + 1) + gammaln(n - y + 1) - gammaln(n + 1)).sum()
            start = np.log((y + 0.5) / (n - y + 0.5))
        self._largest = np.zeros(self.level_counts[self._big])
        self._rest = np.zeros(self._small_count)
        self._beta = np.linalg.lstsq(x, start, rcond=None)[0]

    def mode(self, theta: Array, coefficients: Array | None = None) -> Mode:
        """Returns the mode for deviations ``theta`` [K] and ``coefficients`` [P], or the most likely ones if None.

        deviance = -2 log f(y | u, beta) + |u|² + log |I + Λ'Z'WZΛ|, Laplace's approximation of -2 log ∫ f(y | u) φ(u) du.
        """
        q = self._small_count
        free = coefficients is None
        products = self._free if free else self._bound
        spread = theta[self._big]
        scale = np.repeat(theta[self._others], self.level_counts[self._others])
        penalty = np.ones(q)
        u, v, offset = self._largest, self._rest, np.zeros(len(self._y))
        if coefficients is None:
            scale, penalty = np.append(scale, np.ones(len(self._beta))), np.append(penalty, np.zeros(len(self._beta)))
            v = np.append(v, self._beta)
        else:
            offset = self._x @ coefficients

        def predict(u: Array, v: Array) -> tuple[Array, float]:
            eta = offset + spread * u[self._group] + products.small @ (scale * v)
            return eta, self._fit(eta) + float(u @ u + penalty @ v**2)

        eta, value = predict(u, v)
        for _ in range(60):
            mean, weight = self._moments(eta)
            diagonal = spread * spread * products.sum_big(weight) + 1
            cross, inner = products.normal(weight, spread * spread / diagonal)
            try:
                factor = np.linalg.cholesky(inner * np.outer(scale, scale) + np.diag(penalty))
            except np.linalg.LinAlgError:
                break
            right_u = spread * products.sum_big(self._y - mean) - u
            right_v = (
                scale * (products.small_t @ (self._y - mean) - cross @ (spread * right_u / diagonal)) - penalty * v
            )
            step_v = np.linalg.solve(factor.T, np.linalg.solve(factor, right_v))
            step_u = (right_u - spread * (cross.T @ (scale * step_v))) / diagonal
            if max(np.abs(step_u).max(), np.abs(step_v).max(initial=0)) < _TOLERANCE:
                self._largest, self._rest = u, v[:q]
                self._beta = v[q:] if free else self._beta
                return Mode(
                    deviance=value + float(np.log(diagonal).sum() + 2 * np.log(np.diag(factor)[:q]).sum()),
                    largest=u,
                    rest=v,
                    coefficients=self._beta if coefficients is None else coefficients,
                    fixed_factor=factor[q:, q:],
                    eta=eta,
                )
            for _ in range(40):
                eta, ahead = predict(u + step_u, v + step_v)
                if ahead <= value + 1e-9 * abs(value):
                    break
                step_u, step_v = step_u / 2, step_v / 2
            else:
                break
            u, v, value = u + step_u, v + step_v, ahead
        return Mode(deviance=float("inf"), largest=u, rest=v, coefficients=self._beta, fixed_factor=np.eye(0), eta=eta)

    def intercepts(self, mode: Mode, theta: Array) -> Mapping[str, Array]:
        """Returns the random intercepts b = theta * u on the link scale by factor, each of shape [levels]."""
        ends = np.cumsum(self.level_counts[self._others])
        parts = dict(zip(self._others, np.split(mode.rest, ends)[: len(ends)], strict=True)) | {self._big: mode.largest}
        return {name: theta[k] * parts[k] for k, name in enumerate(self.names)}

    def pearson(self, mode: Mode) -> float:
        """Sum of the squared Pearson residuals."""
        mean, weight = self._moments(mode.eta)
        return float(np.sum((self._y - mean) ** 2 / weight))

    def _fit(self, eta: Array) -> float:
        """-2 log f(y | eta)."""
        with np.errstate(over="ignore"):
            partition = np.exp(eta) if self._poisson else self._n * np.logaddexp(0, eta)
        return 2 * float(self._constant + np.sum(partition - self._y * eta))

    def _moments(self, eta: Array) -> tuple[Array, Array]:
        """Mean and variance [N]. The links are canonical, so the variance is also the weight."""
        from scipy.special import expit

        if self._poisson:
            mean = np.exp(eta)
            return mean, mean
        return self._n * expit(eta), self._n * expit(eta) * expit(-eta)


class _Products:
    """Products with the sparse indicators of the largest factor, and of the smaller factors and coefficients.

    Matrices are scipy's ``csr_matrix``.
    """

    def __init__(self, big: Any, small: Any) -> None:
        self.small = small
        self.small_t = small.T.tocsr()
        self._big, self._big_t = big, big.T.tocsr()

    def sum_big(self, values: Array) -> Array:
        """Sum of ``values`` [N] over the rows of each level of the large factor."""
        return self._big_t @ values

    def normal(self, weight: Array, eliminated: Array) -> tuple[Any, Array]:
        """Returns the small-by-large block M'WZ (sparse) and the Schur complement of the large block in M'WM."""
        weighted = _scale_columns(self.small_t, weight)
        cross = weighted @ self._big
        return cross, (weighted @ self.small).toarray() - (_scale_columns(cross, eliminated) @ cross.T).toarray()


def _scale_columns(matrix: Any, by: Array) -> Any:
    return type(matrix)((matrix.data * by[matrix.indices], matrix.indices, matrix.indptr), shape=matrix.shape)
