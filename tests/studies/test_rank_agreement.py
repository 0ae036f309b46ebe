"""Rank agreement against scipy, with ties, and what cannot be ranked."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kendalltau, spearmanr

from h3data.errors import InputError
from h3data_studies.statistics import rank_agreement


@pytest.mark.parametrize("seed", range(8))
def test_coefficients_are_those_of_scipy(seed):
    random = np.random.default_rng(seed)
    a, b = random.integers(0, 5, (2, 7)).astype(float)
    names = [f"m{k}" for k in range(7)]
    found = rank_agreement(
        {n: [v] for n, v in zip(names, a, strict=True)}, {n: [v] for n, v in zip(names, b, strict=True)}
    )
    assert found.kendall == pytest.approx(kendalltau(a, b).statistic)
    assert found.spearman == pytest.approx(spearmanr(a, b).statistic)
    assert np.isnan(found.kendall_low), "one value each: nothing to resample"


def test_intervals_narrow_with_more_episodes_and_repeat():
    random = np.random.default_rng(0)
    few, many = (
        {name: random.normal(mean, 1, count) for name, mean in {"a": 0, "b": 0.5, "c": 1.0}.items()}
        for count in (5, 500)
    )
    loose, tight = (rank_agreement(side, side, resamples=2000) for side in (few, many))
    assert tight.kendall == tight.kendall_low == tight.kendall_high == 1
    assert loose.kendall_low < 1
    assert rank_agreement(few, many) == rank_agreement(few, many)


def test_what_cannot_be_ranked_is_refused():
    with pytest.raises(InputError, match="H3-STATS-037"):
        rank_agreement({"a": [1], "b": [2]}, {"a": [1], "c": [2]})
    with pytest.raises(InputError, match="H3-STATS-037"):
        rank_agreement({"a": [1]}, {"a": [1]})
    with pytest.raises(InputError, match=r"(?s)'b'.*H3-STATS-038"):
        rank_agreement({"a": [1], "b": [np.nan]}, {"a": [1], "b": [2]})
    assert np.isnan(rank_agreement({"a": [1], "b": [1]}, {"a": [1], "b": [2]}).kendall)
