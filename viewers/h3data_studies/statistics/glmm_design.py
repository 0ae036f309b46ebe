"""Design matrices of a mixed model from columns: factors, treatment coding, and checks that it can be fitted."""

# Written out because patsy and formulaic code fixed effects only and neither detects separation, which is frequent in
# studies (nobody collides while alone) and which glmer reports as an estimate of about 20 with an enormous standard
# error. tests/studies/test_mixed_models.py holds coefficient names and estimates to lme4 1.1-31 on tests/data/glmm.

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError, did_you_mean

if TYPE_CHECKING:
    import pyarrow as pa

Family = Literal["poisson", "binomial"]


class SeparationError(InputError):
    """Error about a coefficient without a finite estimate, because a combination of levels determines the response."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FixedDesign:
    """Coding of the fixed effects of a model: an intercept, factors in treatment coding, and covariates."""

    terms: tuple[tuple[str, ...], ...]
    """Variables of each term: one for a main effect, several for an interaction."""
    levels: Mapping[str, tuple[str, ...]]
    """Levels of each factor; the first is the reference."""
    covariate_means: Mapping[str, float]
    """Mean of each numeric variable over all rows."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns: ``(Intercept)``, ``condition[solo]``, ``trial``, ``condition[solo]:home[small]``."""
        names = ["(Intercept)"]
        for term in self.terms:
            parts = [[f"{v}[{level}]" for level in self.levels[v][1:]] if v in self.levels else [v] for v in term]
            names += [":".join(p) for p in itertools.product(*parts)]
        return tuple(names)

    def matrix(self, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
        """Return the design matrix [N, P] of ``columns``: level numbers of factors, values of covariates, each [N]."""
        rows = len(next(iter(columns.values()))) if columns else 1
        blocks = [np.ones((rows, 1))]
        for term in self.terms:
            block = np.ones((rows, 1))
            for variable in term:
                column = columns[variable]
                if variable in self.levels:
                    part = (column[:, None] == np.arange(1, len(self.levels[variable]))).astype(np.float64)
                else:
                    part = column[:, None]
                block = (block[:, :, None] * part[:, None, :]).reshape(rows, -1)
            blocks.append(block)
        return np.hstack(blocks)

    def marginal(self, factor: str) -> NDArray[np.float64]:
        """Return the rows [L, P] of the marginal means of ``factor``.

        The levels of the other factors get equal weights, and covariates have their mean (the reference grid of
        emmeans).
        """
        if factor not in self.levels:
            raise InputError(
                f"{factor!r} is no factor of this model. Its factors are: {', '.join(self.levels) or 'none'}.",
                code="H3-STATS-015",
            )
        cells = np.array(list(itertools.product(*(range(len(v)) for v in self.levels.values()))))
        columns: dict[str, NDArray[Any]] = dict(zip(self.levels, cells.T, strict=True))
        columns |= {name: np.full(len(cells), mean) for name, mean in self.covariate_means.items()}
        rows = self.matrix(columns)
        return np.array([rows[columns[factor] == k].mean(axis=0) for k in range(len(self.levels[factor]))])


@dataclass(frozen=True, kw_only=True, eq=False)
class MixedDesign:
    """Response, fixed effects and the groups of the random intercepts of a model to fit."""

    family: Family
    formula: str
    """Model in lme4's notation."""
    response: NDArray[np.float64]
    """Response of each row, shape [N]: counts (Poisson) or numbers of successes (binomial)."""
    trials: NDArray[np.float64]
    """Number of trials of each row, shape [N]; ones unless the response counts successes out of several trials."""
    fixed: FixedDesign
    x: NDArray[np.float64]
    """Columns of the fixed effects, shape [N, P]."""
    groups: Mapping[str, NDArray[np.int64]]
    """Level number of each row by random factor, shape [N]."""
    group_levels: Mapping[str, tuple[str, ...]]


def mixed_design(
    table: pa.Table | Mapping[str, ArrayLike],
    response: str,
    family: Family,
    fixed: Sequence[str],
    random: Sequence[str],
    *,
    trials: str | None,
    levels: Mapping[str, Sequence[str]],
    observation_effect: bool,
) -> MixedDesign:
    """Return the design of a model from the columns of a table, after checking them.

    The arguments and errors are those of `fit_glmm`.
    """
    if family not in ("poisson", "binomial"):
        raise InputError(f"Expected the family 'poisson' or 'binomial', got {family!r}.", code="H3-STATS-003")
    if isinstance(fixed, str) or isinstance(random, str):
        raise InputError(
            "Expected lists of column names for fixed and random, e.g. fixed=['condition'].", code="H3-STATS-004"
        )
    if not random and not observation_effect:
        raise InputError(
            "A mixed model needs at least one random intercept, e.g. random=['participant', 'scene'].",
            code="H3-STATS-005",
        )
    terms = tuple(tuple(term.split(":")) for term in fixed)
    variables = list(dict.fromkeys(v for term in terms for v in term))
    both = sorted(set(variables) & set(random))
    if both:
        raise InputError(
            f"{both[0]!r} is both a fixed and a random effect. Name it in one of the two.", code="H3-STATS-006"
        )
    for term in terms:
        for variable in term if len(term) > 1 else ():
            if (variable,) not in terms:
                raise InputError(
                    f"The interaction {':'.join(term)!r} needs {variable!r} as a fixed effect of its own.",
                    code="H3-STATS-021",
                )
    columns = _read(table, [response, *([trials] if trials else []), *variables, *random], optional=sorted(levels))
    y, n = _response(columns, response, trials, family)

    coded: dict[str, NDArray[Any]] = {}
    factor_levels: dict[str, tuple[str, ...]] = {}
    for variable in variables:
        if variable in levels or columns[variable].dtype.kind not in "iuf":
            coded[variable], factor_levels[variable] = _factor(variable, columns[variable], levels.get(variable))
        else:
            coded[variable] = columns[variable].astype(np.float64)
    means = {v: float(column.mean()) for v, column in coded.items() if v not in factor_levels}
    design = FixedDesign(terms=terms, levels=factor_levels, covariate_means=means)
    x = design.matrix(coded) if coded else np.ones((len(y), 1))
    _check_rank(design, x, coded)
    _check_separation(response, y, n if family == "binomial" else None, x, design)

    groups, group_levels = {}, {}
    for name in random:
        groups[name], group_levels[name] = _factor(name, columns[name], None)
    if observation_effect:
        groups["observation"] = np.arange(len(y))
        group_levels["observation"] = tuple(str(k) for k in range(len(y)))
    _check_groups(groups, bernoulli=family == "binomial" and bool((n == 1).all()))
    left = response if trials is None else f"cbind({response}, {trials} - {response})"
    right = " + ".join([*(fixed or ["1"]), *(f"(1 | {name})" for name in groups)])
    return MixedDesign(
        family=family,
        formula=f"{left} ~ {right}",
        response=y,
        trials=n,
        fixed=design,
        x=x,
        groups=groups,
        group_levels=group_levels,
    )


def _read(
    table: pa.Table | Mapping[str, ArrayLike], names: Sequence[str], *, optional: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """Return the named columns, all of one length, without missing values."""
    available = list(table) if isinstance(table, Mapping) else table.column_names
    unknown = [n for n in (*names, *optional) if n not in available]
    if unknown:
        near = did_you_mean(unknown[0], available)
        raise InputError(
            f"The table has no column {', '.join(map(repr, unknown))}.{near} It has: {', '.join(available)}.",
            code="H3-STATS-007",
        )
    columns, missing = {}, []
    for name in names:
        values = np.asarray(table[name]) if isinstance(table, Mapping) else np.asarray(table[name].to_pylist())
        if values.ndim != 1:
            raise InputError(
                f"Expected one value per row in {name!r}, got an array of shape {list(values.shape)}.",
                code="H3-STATS-016",
            )
        if values.dtype.kind == "O":
            gaps = np.array([v is None or v != v for v in values])
            kinds = {type(v) for v in values[~gaps]}
            values = values if len(kinds) > 1 or gaps.any() else np.array(values.tolist())
        else:
            gaps = ~np.isfinite(values) if values.dtype.kind == "f" else np.zeros(len(values), bool)
        if gaps.any():
            rows = np.flatnonzero(gaps)
            shown = ", ".join(map(str, rows[:5])) + (", ..." if len(rows) > 5 else "")
            missing.append(f"{name!r} in {len(rows)} of {len(values)} rows ({shown})")
        columns[name] = values
    if missing:
        raise InputError(
            f"Undefined values: {'; '.join(missing)}. Hint: leave these rows out, and say so in the report.",
            code="H3-STATS-008",
        )
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(f"All columns must have the same length, got {lengths}.", code="H3-STATS-009")
    if not next(iter(lengths.values())):
        raise InputError("The table has no rows.", code="H3-STATS-010")
    return columns


def _response(
    columns: Mapping[str, NDArray[Any]], response: str, trials: str | None, family: Family
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    y = columns[response]
    if y.dtype.kind not in "biuf" or (y < 0).any() or (y % 1 != 0).any():
        raise InputError(
            f"Expected counts 0, 1, 2, ... in the response {response!r}, got e.g. {_odd(y)}.", code="H3-STATS-011"
        )
    if family == "poisson":
        if trials:
            raise InputError("Trials belong to the binomial family; a Poisson response has none.", code="H3-STATS-017")
        return y.astype(np.float64), np.ones(len(y))
    n = columns[trials] if trials else np.ones(len(y))
    if n.dtype.kind not in "iuf" or (n < 1).any() or (n % 1 != 0).any():
        raise InputError(
            f"Expected numbers of trials 1, 2, ... in {trials!r}, got e.g. {_odd(n, least=1)}.", code="H3-STATS-012"
        )
    if (y > n).any():
        row = int(np.argmax(y > n))
        hint = "" if trials else " Hint: name the column of the numbers of trials: trials=..."
        raise InputError(
            f"Expected at most {n[row]:g} in {response!r}, got {y[row]:g} in row {row}.{hint}", code="H3-STATS-013"
        )
    return y.astype(np.float64), n.astype(np.float64)


def _odd(values: NDArray[Any], *, least: int = 0) -> str:
    if values.dtype.kind not in "biuf":
        return repr(values[0])
    return f"{values[(values < least) | (values % 1 != 0)][0]:g}"


def _factor(name: str, values: NDArray[Any], order: Sequence[str] | None) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return the level number of each row, and the levels in ``order``, else sorted."""
    unique, codes = np.unique(values.astype(str), return_inverse=True)
    levels = unique.tolist()
    if order is not None:
        unknown, unused = sorted(set(levels) - set(order)), sorted(set(order) - set(levels))
        if unknown or unused or len(set(order)) != len(order):
            raise InputError(
                f"The levels given for {name!r} do not match its values: values without a level {unknown}; "
                f"levels without a row {unused}.",
                code="H3-STATS-018",
            )
        codes = np.array([list(order).index(level) for level in levels])[codes]
        levels = list(order)
    if len(levels) < 2:
        raise InputError(
            f"{name!r} has only one level ({levels[0]!r}): it has no effect to estimate. Leave it out.",
            code="H3-STATS-014",
        )
    return codes.astype(np.int64), tuple(levels)


def _check_rank(design: FixedDesign, x: NDArray[np.float64], coded: Mapping[str, NDArray[Any]]) -> None:
    from scipy.linalg import qr

    scaled = x / np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    parts: Any = qr(scaled, mode="economic", pivoting=True)
    _, r, order = parts
    diagonal = np.zeros(x.shape[1])
    diagonal[: len(r)] = np.abs(np.diag(r))
    rank = int((diagonal > 1e-9).sum())
    if rank == x.shape[1]:
        return
    for term in design.terms:
        factors = [v for v in term if v in design.levels]
        for cell in itertools.product(*(range(len(design.levels[v])) for v in factors)) if len(factors) > 1 else ():
            if not np.logical_and.reduce([coded[v] == k for v, k in zip(factors, cell, strict=True)]).any():
                where = ", ".join(f"{v} = {design.levels[v][k]}" for v, k in zip(factors, cell, strict=True))
                raise InputError(
                    f"No row has {where}: the interaction {':'.join(term)!r} cannot be estimated. "
                    "Hint: leave the interaction out, or the levels that lack rows.",
                    code="H3-STATS-022",
                )
    names = [design.names[k] for k in order[rank:]]
    raise InputError(
        f"The fixed effects are linearly dependent ({len(x)} rows): {', '.join(names)} follows from the others. "
        "Leave it out.",
        code="H3-STATS-001",
    )


def _check_separation(
    response: str,
    y: NDArray[np.float64],
    n: NDArray[np.float64] | None,
    x: NDArray[np.float64],
    design: FixedDesign,
) -> None:
    """Raise a `SeparationError` if some change of the coefficients makes no row less likely, however far it goes.

    Found by a linear programme (Konis 2007): rows at 0 may only go down, rows where all trials succeeded only up, all
    others must stay. The condition does not involve the random effects, so it decides the mixed model too.
    """
    from scipy.optimize import linprog

    side = np.where(y == 0, -1.0, 0.0) if n is None else np.where(y == 0, -1.0, np.where(y == n, 1.0, 0.0))
    rows = np.unique(np.column_stack([x, side]), axis=0)
    xs, s = rows[:, :-1], rows[:, -1]
    moving, fixed = s != 0, s == 0
    if not moving.any():
        return
    gain = s[moving, None] * xs[moving]
    solution = linprog(
        -gain.sum(axis=0),
        A_ub=-gain,
        b_ub=np.zeros(len(gain)),
        A_eq=xs[fixed] if fixed.any() else None,
        b_eq=np.zeros(fixed.sum()) if fixed.any() else None,
        bounds=(-1, 1),
    )
    if solution.x is None or gain.sum(axis=0) @ solution.x < 1e-7:
        return
    rising = np.abs(x @ solution.x) > 1e-7
    at = [
        f"{name} = {level}"
        for name, levels in design.levels.items()
        for k, level in enumerate(levels)
        if (same := _rows_of(design, x, name, k)).any() and (same <= rising).all() and _one_sided(side[same])
    ]
    where = f"every row with {at[0]}" if at else f"{int(rising.sum())} rows"
    what = (
        "is 0"
        if (side[rising] < 0).all()
        else "is at its largest"
        if (side[rising] > 0).all()
        else "is 0 or at its largest"
    )
    raise SeparationError(
        f"Separation: {response!r} {what} in {where}, so the estimate would be infinite. "
        "Hint: leave these rows out and report their rate with a Wilson interval.",
        code="H3-STATS-002",
    )


def _rows_of(design: FixedDesign, x: NDArray[np.float64], factor: str, level: int) -> NDArray[np.bool_]:
    names = design.names
    others = [x[:, names.index(f"{factor}[{v}]")] for v in design.levels[factor][1:]]
    return others[level - 1] == 1 if level else np.sum(others, axis=0) == 0


def _one_sided(side: NDArray[np.float64]) -> bool:
    return bool((side == -1).all() or (side == 1).all())


def _check_groups(groups: Mapping[str, NDArray[np.int64]], *, bernoulli: bool) -> None:
    for name, codes in groups.items():
        if bernoulli and codes.max() + 1 == len(codes):
            raise InputError(
                f"Every row has its own level of {name!r}: with 0/1 responses its variance cannot be estimated. "
                "Leave it out.",
                code="H3-STATS-019",
            )
    for (a, first), (b, second) in itertools.combinations(groups.items(), 2):
        pairs = len(np.unique(np.column_stack([first, second]), axis=0))
        if pairs == first.max() + 1 == second.max() + 1:
            raise InputError(
                f"{a!r} and {b!r} group the rows identically: their variances cannot be separated. Leave one out.",
                code="H3-STATS-020",
            )
