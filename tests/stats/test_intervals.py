"""Intervals and adjusted p values against scipy.stats."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats

from h3data.errors import InputError
from h3data.stats import (
    adjust_p_values,
    bootstrap_interval,
    bootstrap_intervals,
    over_seeds,
    t_interval,
    wilson_interval,
)


@pytest.mark.parametrize(("k", "n"), [(0, 1), (1, 1), (0, 20), (20, 20), (3, 7), (451, 500), (702, 1000)])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_wilson(k, n, confidence):
    expected = scipy.stats.binomtest(k, n).proportion_ci(confidence, method="wilson")
    got = wilson_interval(k, n, confidence=confidence)
    assert got == pytest.approx((expected.low, expected.high), abs=1e-12)
    assert 0 <= got[0] <= k / n <= got[1] <= 1


@pytest.mark.parametrize("n", [2, 3, 30])
def test_student(n):
    values = np.random.default_rng(n).normal(3, 2, n)
    expected = scipy.stats.t.interval(0.9, n - 1, values.mean(), scipy.stats.sem(values))
    assert t_interval(values, confidence=0.9) == pytest.approx(expected)


@pytest.mark.parametrize("n", [8, 200])
def test_bootstrap(n):
    values = np.random.default_rng(n).exponential(1, n)
    reference = scipy.stats.bootstrap((values,), np.mean, n_resamples=10_000, method="percentile", random_state=1)
    low, high = bootstrap_interval(values)
    width = high - low
    assert abs(low - reference.confidence_interval.low) < 0.04 * width
    assert abs(high - reference.confidence_interval.high) < 0.04 * width


def test_the_bootstrap_is_seeded_and_in_blocks_equal_to_itself(monkeypatch):
    values = np.random.default_rng(0).normal(size=50)
    assert bootstrap_interval(values, seed=3) == bootstrap_interval(values, seed=3)
    assert bootstrap_interval(values, seed=3) != bootstrap_interval(values, seed=4)
    whole = bootstrap_interval(values, resamples=2000)
    monkeypatch.setattr("h3data.stats.intervals._BLOCK", 777)
    assert bootstrap_interval(values, resamples=2000) == whole


def test_columns_together_are_columns_alone_on_however_many_threads(monkeypatch):
    random = np.random.default_rng(1)
    columns = [random.normal(size=40), random.exponential(size=40), random.normal(size=31), random.normal(size=40)]
    columns[3][5:14] = np.nan  # as many values as the third
    columns += [np.array([1.0]), np.array([])]
    alone = [bootstrap_interval(values, resamples=900, seed=2) for values in columns]
    by_hand = np.random.default_rng(2)
    means = columns[0][by_hand.integers(0, 40, (900, 40))].mean(axis=1)
    assert alone[0] == tuple(np.quantile(means, [(1 - 0.95) / 2, (1 + 0.95) / 2]))
    monkeypatch.setattr("h3data.stats.intervals._BLOCK", 500)
    for least in (1, 10**9):
        monkeypatch.setattr("h3data.stats.intervals._WORTH_THREADS", least)
        np.testing.assert_array_equal(bootstrap_intervals(columns, resamples=900, seed=2), alone)


def test_undefined_values_are_left_out():
    values = np.array([1.0, np.nan, 2.0, 4.0])
    assert t_interval(values) == t_interval(values[~np.isnan(values)])
    assert bootstrap_interval(values) == bootstrap_interval([1.0, 2.0, 4.0])
    for too_few in ([], [1.0], [np.nan, 2.0]):
        assert all(math.isnan(x) for x in (*bootstrap_interval(too_few), *t_interval(too_few)))
    assert all(math.isnan(x) for x in wilson_interval(0, 0))


def test_nonsense_is_refused():
    with pytest.raises(InputError, match=r"(?s)3.*2.*H3-STATS-023"):
        wilson_interval(3, 2)
    with pytest.raises(InputError, match="H3-STATS-024"):
        t_interval([1.0, 2.0], confidence=95)
    with pytest.raises(InputError, match="H3-STATS-025"):
        bootstrap_interval([[1.0, 2.0]])


@pytest.mark.parametrize("method", ["holm", "bonferroni", "benjamini-hochberg", "none"])
def test_adjusted_p_values_are_ordered_and_never_smaller(method):
    p = np.random.default_rng(4).random(25) ** 3
    adjusted = adjust_p_values(p, method=method)
    assert (adjusted >= p).all()
    assert (adjusted <= 1).all()
    assert (np.diff(adjusted[np.argsort(p)]) >= 0).all()
    shuffled = np.random.default_rng(5).permutation(25)
    np.testing.assert_array_equal(adjust_p_values(p[shuffled], method=method), adjusted[shuffled])


def test_adjusted_p_values_by_hand():
    p = [0.01, 0.04, 0.03, math.nan]
    assert adjust_p_values(p, method="holm")[:3] == pytest.approx([0.03, 0.06, 0.06])
    assert adjust_p_values(p, method="bonferroni")[:3] == pytest.approx([0.03, 0.12, 0.09])
    assert math.isnan(adjust_p_values(p)[3])
    values = np.random.default_rng(6).random(40)
    np.testing.assert_allclose(
        adjust_p_values(values, method="benjamini-hochberg"), scipy.stats.false_discovery_control(values)
    )
    assert adjust_p_values([]).shape == (0,)


def test_seeds():
    summary = over_seeds([0.9, 0.94, math.nan, 0.95])
    assert (summary.mean, summary.std, summary.seeds) == pytest.approx((0.93, 0.0264575, 3), rel=1e-5)
    assert (summary.low, summary.high) == t_interval([0.9, 0.94, 0.95])
    assert str(summary) == "0.93 ± 0.026"
    assert math.isnan(over_seeds([0.5]).std)
    assert math.isnan(over_seeds([]).mean)


def test_bad_p_values_are_refused():
    with pytest.raises(InputError, match="H3-STATS-027"):
        adjust_p_values([0.2, 1.2])
    with pytest.raises(InputError, match=r"(?s)'fdr'.*H3-STATS-028"):
        adjust_p_values([0.2], method="fdr")  # type: ignore[arg-type]
