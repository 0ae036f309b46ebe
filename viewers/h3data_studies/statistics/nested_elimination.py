"""Normal equations of a mixed model's random effects and coefficients, with nested factors eliminated in closed form.

The method is block elimination of (I + Λ'Z'WZΛ, Λ'Z'WX; X'WZΛ, X'WX). The block of one factor is diagonal. It stays
diagonal when the factor with the most levels is eliminated, if each of its levels lies within a single level of the
first factor (rows within broods within locations). Factors that cross the eliminated ones remain in a dense system
together with the coefficients.
"""

# A general sparse Cholesky factor (CHOLMOD, as in lme4) is in no dependency of ours. A dense one of the same matrix takes 60
# times as long on 403 rows in 118 broods in 63 locations with an effect per row, and BLAS threads that wait for each other on
# busy cores multiply that by 8: the small products here are therefore einsum's and bincount's, not BLAS's.

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.floating[Any]]

_SMALL = 1 << 20
"""Multiplications up to which einsum is used instead of BLAS."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Solution of the normal equations in one iteration."""

    effects: list[Array]
    """Change of the spherical effects of each factor."""
    coefficients: Array
    """Change of the coefficients; empty if they are held fixed."""
    log_determinant: float
    """Logarithm of the determinant, log |I + Λ'Z'WZΛ|."""
    fixed_factor: Array
    """Lower Cholesky factor [P, P] of the information matrix of the coefficients."""


class NestedElimination:
    """Normal equations of one design, with its nested factors eliminated.

    Args:
        groups: Level number of each row for each factor, each of shape [N].
        counts: Number of levels of each factor.
        x: Columns of the free coefficients, shape [N, P]; P = 0 if they are fixed.
    """

    def __init__(self, groups: Sequence[NDArray[np.int64]], counts: Sequence[int], x: Array) -> None:
        self._groups, self._counts = list(groups), list(counts)
        order = sorted(range(len(counts)), key=lambda k: -counts[k])
        self._nested: list[int] = []
        self._parents: dict[tuple[int, int], NDArray[np.int64]] = {}
        for factor in order:
            parents = {child: self._parent(child, factor) for child in self._nested}
            if all(parent is not None for parent in parents.values()):
                self._parents |= {(child, factor): p for child, p in parents.items() if p is not None}
                self._nested.append(factor)
        self._crossed = [k for k in range(len(counts)) if k not in self._nested]
        indicators = [np.eye(counts[k])[groups[k]] for k in self._crossed]
        self._rest = np.hstack([np.zeros((len(x), 0)), *indicators, x])
        self._crossed_levels = sum(counts[k] for k in self._crossed)
        self._sums = [_indicator(groups[k], counts[k]) for k in range(len(counts))]
        self._sums_of_levels = {
            (child, parent): _indicator(levels, counts[parent]) for (child, parent), levels in self._parents.items()
        }

    def effect(self, theta: Array, effects: Sequence[Array]) -> Array:
        """Return the contribution [N] of spherical effects to the linear predictor, with deviations ``theta`` [K]."""
        total = theta[0] * effects[0][self._groups[0]]
        for k in range(1, len(effects)):
            total = total + theta[k] * effects[k][self._groups[k]]
        return total

    def solve(self, theta: Array, weight: Array, residual: Array, effects: Sequence[Array]) -> Solution:
        """Return the solution of the normal equations for weights [N] and residuals [N] at ``effects``.

        Raises:
            LinAlgError: the matrix is not positive definite.
        """
        nested, crossed = self._nested, self._crossed
        scale = np.concatenate([*(np.full(self._counts[k], theta[k]) for k in crossed), np.ones(self._free)])
        penalty = np.concatenate([np.ones(self._crossed_levels), np.zeros(self._free)])
        weighted = self._rest * weight[:, None]
        inner = _inner(self._rest, weighted) * np.outer(scale, scale) + np.diag(penalty)
        held = np.concatenate([*(effects[k] for k in crossed), np.zeros(self._free)])
        right = scale * np.einsum("nr,n->r", self._rest, residual) - penalty * held
        sums, blocks, pivot, cross, rights = {}, {}, {}, {}, {}
        for place, k in enumerate(nested):
            # each factor's sums are those of the factor within it, summed up: fewer rows every time
            up = self._sums_of_levels[nested[place - 1], k] if place else self._sums[k]
            sums[k] = up @ (sums[nested[place - 1]] if place else weight)
            blocks[k] = up @ (blocks[nested[place - 1]] if place else weighted)
            pivot[k] = theta[k] ** 2 * sums[k] + 1
            cross[k] = theta[k] * blocks[k] * scale
            rights[k] = theta[k] * (self._sums[k] @ residual) - effects[k]
        links = {(i, j): theta[i] * theta[j] * sums[i] for i, j in self._parents}
        for place, k in enumerate(nested):
            part = rights[k] / pivot[k]
            for j in nested[place + 1 :]:
                up, link = self._sums_of_levels[k, j], links[k, j]
                ratio = link / pivot[k]
                pivot[j] = pivot[j] - up @ (link * ratio)
                cross[j] = cross[j] - up @ (cross[k] * ratio[:, None])
                rights[j] = rights[j] - up @ (link * part)
                for m in nested[nested.index(j) + 1 :]:
                    links[j, m] = links[j, m] - up @ (ratio * links[k, m])
            inner -= _inner(cross[k], cross[k] / pivot[k][:, None])
            right = right - np.einsum("nr,n->r", cross[k], part)
        factor = np.linalg.cholesky(inner)
        step_rest = _cholesky_solve(factor, right)
        steps: dict[int, Array] = {}
        for place in range(len(nested) - 1, -1, -1):
            k = nested[place]
            known = rights[k] - np.einsum("nr,r->n", cross[k], step_rest)
            for j in nested[place + 1 :]:
                known = known - links[k, j] * steps[j][self._parents[k, j]]
            steps[k] = known / pivot[k]
        ends = np.cumsum([self._counts[k] for k in crossed], dtype=np.int64)
        steps |= dict(zip(crossed, np.split(step_rest, ends)[: len(crossed)], strict=True))
        q = self._crossed_levels
        determinant = sum(float(np.log(pivot[k]).sum()) for k in nested) + 2 * float(np.log(np.diag(factor)[:q]).sum())
        return Solution(
            effects=[steps[k] for k in range(len(self._counts))],
            coefficients=step_rest[q:],
            log_determinant=determinant,
            fixed_factor=factor[q:, q:],
        )

    @property
    def _free(self) -> int:
        return self._rest.shape[1] - self._crossed_levels

    def _parent(self, child: int, factor: int) -> NDArray[np.int64] | None:
        """Return the level of ``factor`` in which each level of ``child`` lies; None if one lies in several."""
        parent = np.zeros(self._counts[child], np.int64)
        parent[self._groups[child]] = self._groups[factor]
        return parent if (parent[self._groups[child]] == self._groups[factor]).all() else None


def _indicator(levels: NDArray[np.int64], count: int) -> Any:
    """Return the sparse matrix [count, N] that sums rows by level."""
    from scipy.sparse import csr_matrix

    rows = len(levels)
    return csr_matrix((np.ones(rows), (levels, np.arange(rows))), shape=(count, rows))


def _inner(first: Array, second: Array) -> Array:
    """Return ``first' second``, the product of the transposed first matrix and the second."""
    if first.shape[0] * first.shape[1] ** 2 > _SMALL:
        return first.T @ second
    return np.einsum("nr,ns->rs", first, second)


def _cholesky_solve(factor: Array, right: Array) -> Array:
    from scipy.linalg import cho_solve

    return cho_solve((factor, True), right, check_finite=False) if len(right) else right
