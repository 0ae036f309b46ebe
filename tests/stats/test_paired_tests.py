"""Two runs on the same episodes: tests against scipy.stats, effect sizes, and runs that cannot be paired."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import scipy.stats

from h3data.errors import InputError
from h3data.metrics import MetricsTable, compare_runs
from h3data.stats import compare_paired


def runs(n: int = 30, shift: float = 0.4, seed: int = 0) -> tuple[dict[str, float], dict[str, float]]:
    random = np.random.default_rng(seed)
    first = random.normal(2, 1, n)
    second = first - shift + random.normal(0, 0.8, n)
    return (
        {f"e{k}": float(v) for k, v in enumerate(first)},
        {f"e{k}": float(second[k]) for k in reversed(range(n))},
    )


def arrays(first, second):
    return np.array(list(first.values())), np.array([second[k] for k in first])


def test_t():
    first, second = runs()
    a, b = arrays(first, second)
    got, expected = compare_paired(first, second, method="t"), scipy.stats.ttest_rel(a, b)
    assert got.p == pytest.approx(expected.pvalue)
    assert got.effect == pytest.approx((a - b).mean() / (a - b).std(ddof=1))
    assert (got.first_mean, got.second_mean, got.difference) == pytest.approx((a.mean(), b.mean(), (a - b).mean()))
    assert got.low < got.difference < got.high
    assert (got.pairs, got.undefined) == (30, 0)


def test_permutation_agrees_with_scipy_and_is_the_default():
    first, second = runs()
    a, b = arrays(first, second)
    got = compare_paired(first, second)
    expected = scipy.stats.permutation_test(
        (a, b),
        lambda x, y, axis: np.mean(x - y, axis=axis),
        permutation_type="samples",
        vectorized=True,
        random_state=0,
    )
    assert got.method == "permutation"
    assert got.p == pytest.approx(expected.pvalue, abs=0.01)
    assert compare_paired(first, second, seed=0) == got


@pytest.mark.parametrize("pairs", range(2, 21, 3))
@pytest.mark.parametrize("method", ["permutation", "wilcoxon"])
def test_few_pairs_have_the_exact_p(pairs, method):
    """All differences positive: 2 of 2^n patterns of signs are as extreme; equal ones, which tie, too."""
    second = {str(k): 0.1 * k for k in range(pairs)}
    for rise in (0.3, None):
        first = {key: value + (rise or 1 + value) for key, value in second.items()}
        for one, other in ((first, second), (second, first)):
            assert compare_paired(one, other, method=method).p == pytest.approx(2 / 2**pairs, rel=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_exact_p_is_that_of_all_patterns_of_signs(seed):
    random = np.random.default_rng(seed)
    d = random.choice([0, 0.1, 0.2, 0.3, -0.1, -0.3, *random.normal(size=2)], int(random.integers(3, 9)))
    patterns = np.array(list(itertools.product([1, -1], repeat=len(d))))
    names = [str(k) for k in range(len(d))]
    got = compare_paired(dict(zip(names, d, strict=True)), dict.fromkeys(names, 0.0), method="permutation")
    assert got.p == (np.abs(np.round(patterns @ d, 9)) >= abs(np.round(d.sum(), 9))).mean()
    assert got.method == "exact permutation"


def test_rounding_makes_no_sum_less_extreme():
    """.1 + .2 - .3 is 0 in exact arithmetic, so every pattern is as extreme."""
    d = {"a": 0.1, "b": 0.2, "c": -0.3}
    assert compare_paired(d, dict.fromkeys(d, 0.0), method="permutation").p == 1


def test_pairs_of_0_1_values_and_few_pairs_are_noted():
    first, second = {str(k): float(k < 4) for k in range(12)}, {str(k): 0.0 for k in range(12)}
    got = compare_paired(first, second)
    assert got.p == 2 / 2**4
    assert "of 12 pairs only the 4 that differ" in got.notes[0]
    assert "no p below 0.125" in got.notes[1]
    assert "mcnemar" in " ".join(compare_paired(first, second, method="t").notes)
    assert not compare_paired(*runs()).notes
    assert compare_paired({"a": 2.0, "b": 3.5}, {"a": 1.0, "b": 1.0}).notes[0].startswith("With 2 pairs")


def test_wilcoxon():
    first, second = runs()
    first["e0"] = second["e0"]
    a, b = arrays(first, second)
    got = compare_paired(first, second, method="wilcoxon")
    assert got.p == pytest.approx(scipy.stats.wilcoxon(a[1:], b[1:]).pvalue)
    assert -1 <= got.effect <= 1
    every = compare_paired({k: v + 5 for k, v in second.items()}, second, method="wilcoxon")
    assert every.effect == 1


def test_mcnemar_of_0_1_values():
    first = {str(k): float(k < 12) for k in range(20)}
    second = {str(k): float(k < 3 or k == 19) for k in range(20)}
    got = compare_paired(first, second)
    assert got.method == "exact McNemar"
    assert got.p == pytest.approx(scipy.stats.binomtest(9, 10).pvalue)
    assert got.effect == pytest.approx(9.5 / 1.5)
    assert got.difference == pytest.approx(8 / 20)


@pytest.mark.parametrize("method", ["permutation", "t", "wilcoxon", "mcnemar"])
def test_swapping_the_runs_swaps_the_signs(method):
    first, second = runs(12)
    if method == "mcnemar":
        first, second = ({k: float(v > 1.5) for k, v in run.items()} for run in (first, second))
    ahead, back = compare_paired(first, second, method=method), compare_paired(second, first, method=method)
    assert ahead.difference == pytest.approx(-back.difference)
    assert ahead.p == pytest.approx(back.p, abs=0.01)
    assert ahead.effect == pytest.approx(1 / back.effect if method == "mcnemar" else -back.effect)


@pytest.mark.parametrize("method", ["permutation", "t", "wilcoxon"])
def test_equal_runs_do_not_differ(method):
    first, _ = runs(10)
    got = compare_paired(first, dict(first), method=method)
    assert (got.p, got.difference) == (1.0, 0.0)


def test_undefined_episodes_are_left_out_and_counted():
    first, second = runs(10)
    first["e3"] = math.nan
    second["e7"] = math.nan
    got = compare_paired(first, second)
    assert (got.pairs, got.undefined) == (8, 2)
    empty = compare_paired({"a": math.nan}, {"a": 1.0})
    assert empty.pairs == 0
    assert all(math.isnan(v) for v in (empty.p, empty.difference, empty.first_mean, empty.low))


def test_different_episodes_are_named():
    first, second = runs(8)
    del first["e2"], first["e4"]
    second.pop("e7")
    with pytest.raises(InputError, match=r"(?s)e7.*e4, e2.*H3-STATS-031"):
        compare_paired(first, second)
    with pytest.raises(InputError, match=r"(?s)e0, e1, e2, e3, e4 and 3 more.*none.*H3-STATS-031"):
        compare_paired({f"e{k}": 1.0 for k in range(9)}, {"e8": 1.0})
    with pytest.raises(InputError, match="H3-STATS-032"):
        compare_paired({}, {})


def test_nonsense_is_refused():
    with pytest.raises(InputError, match="H3-STATS-029"):
        compare_paired({"a": 2.0}, {"a": 1.0}, method="mcnemar")
    with pytest.raises(InputError, match=r"(?s)'anova'.*H3-STATS-030"):
        compare_paired({"a": 2.0}, {"a": 1.0}, method="anova")  # type: ignore[arg-type]


def table(ids, **columns) -> MetricsTable:
    """What `compare_runs` reads of a table."""
    values = {k: np.asarray(v, np.float64) for k, v in columns.items()}
    episodes = [SimpleNamespace(episode_id=name, policy="", partner="") for name in ids]
    return cast(
        MetricsTable, SimpleNamespace(profile="paper", episode_ids=tuple(ids), columns=values, episodes=episodes)
    )


def test_all_metrics_of_two_tables_together():
    ids = [f"e{k}" for k in range(20)]
    random = np.random.default_rng(0)
    td = random.normal(3, 1, 20)
    first = table(ids, S=[1.0] * 20, TD=td)
    second = table(ids[::-1], S=[0.0] * 9 + [1.0] * 11, TD=td[::-1] + random.normal(0, 0.1, 20))
    got = compare_runs(first, second)
    assert got["S"].method == "exact McNemar"
    assert got["S"].p_adjusted == pytest.approx(2 * got["S"].p)
    assert got["TD"].p_adjusted == pytest.approx(max(got["TD"].p, 2 * got["S"].p))
    assert compare_runs(first, second, metrics=["TD"])["TD"].p_adjusted == got["TD"].p
    with pytest.raises(InputError, match=r"(?s)'XX'.*S, TD.*H3-METRIC-007"):
        compare_runs(first, second, metrics=["XX"])
    with pytest.raises(InputError, match=r"(?s)second.*e0.*H3-METRIC-009"):
        compare_runs(first, table(["e0", *ids[:-1]], S=[1.0] * 20, TD=td))
