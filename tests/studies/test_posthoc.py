"""Estimated means and contrasts against emmeans on stored fits; the published study's numbers from its own means."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.errors import InputError
from h3data_studies.statistics import (
    MarginalMeans,
    contrasts,
    contrasts_text,
    fit_glmm,
    marginal_means,
    relative_efficiency,
)
from tests.studies.glmm_reference import FITS, columns, reference, stored_fit


def means_of(name: str) -> MarginalMeans:
    return marginal_means(stored_fit(name), "robot" if name == "offload" else "condition")


@pytest.mark.parametrize("name", FITS)
def test_means_as_emmeans(name):
    means = means_of(name)
    link, response = reference(name, "mean_link"), reference(name, "mean_response")
    assert means.levels == tuple(link)
    assert means.link == pytest.approx([r["value"] for r in link.values()], rel=1e-4)
    assert np.sqrt(np.diag(means.covariance)) == pytest.approx([r["se"] for r in link.values()], rel=1e-3)
    assert means.means == pytest.approx([r["value"] for r in response.values()], rel=2e-4)
    assert means.standard_errors == pytest.approx([r["se"] for r in response.values()], rel=1e-3)
    ends = [[r["low"], r["high"]] for r in response.values()]
    assert means.intervals() == pytest.approx(np.array(ends), rel=1e-3)


@pytest.mark.parametrize("name", FITS)
@pytest.mark.parametrize("scale", ["link", "response"])
@pytest.mark.parametrize("adjust", ["tukey", "holm", "none"])
def test_contrasts_as_emmeans(name, scale, adjust):
    expected = reference(name, f"contrast_{scale}_{adjust}")
    rows = contrasts(means_of(name), scale=scale, adjust=adjust)
    assert [f"{c.first} - {c.second}" for c in rows] == list(expected)
    for c, r in zip(rows, expected.values(), strict=True):
        assert c.difference == pytest.approx(r["value"], rel=1e-3)
        assert c.standard_error == pytest.approx(r["se"], rel=1e-3)
        width = r["high"] - r["low"]
        assert (c.low, c.high) == pytest.approx((r["low"], r["high"]), abs=2e-3 * width)
        # emmeans prints exactly 0 far out in the tail of the studentised range.
        assert c.p == pytest.approx(r["p"], rel=0.01, abs=1e-11)


def published() -> MarginalMeans:
    """Habitat 3.0, table of the HITL study: estimated steps and their intervals; the correlation is not printed."""
    levels = ("learn_single", "plan_pop3", "solo")
    mean = np.array([936.60, 1015.05, 1253.17])
    ends = np.log([[762.50, 1146.62], [826.42, 1242.60], [1020.90, 1533.26]])
    error = (ends[:, 1] - ends[:, 0]) / 2 / 1.959964
    correlation = 0.92 + 0.08 * np.eye(3)
    covariance = error[:, None] * correlation * error
    return MarginalMeans(factor="condition", family="poisson", levels=levels, link=np.log(mean), covariance=covariance)


def test_published_differences_and_relative_efficiency():
    rows = {(c.first, c.second): c.difference for c in contrasts(published(), scale="response")}
    assert rows["plan_pop3", "solo"] == pytest.approx(-238.12, abs=0.005)
    assert rows["learn_single", "solo"] == pytest.approx(
        -316.58, abs=0.015
    )  # printed 316.58, from rounded means 316.57
    assert rows["learn_single", "plan_pop3"] == pytest.approx(-78.45, abs=0.005)
    efficiency = {e.level: round(e.percent, 2) for e in relative_efficiency(published(), "solo")}
    assert efficiency == {"learn_single": 133.80, "plan_pop3": 123.46}
    ends = np.array([[762.50, 1146.62], [826.42, 1242.60], [1020.90, 1533.26]])
    assert published().intervals() == pytest.approx(ends, rel=2e-3)


def test_relative_efficiency_is_the_ratio_of_the_contrast():
    means = means_of("steps_observation")
    plain = {c.first: c.ratio for c in contrasts(means, adjust="none") if c.second == "solo"}
    for e in relative_efficiency(means, "solo"):
        ratio, low, high = plain[e.level]
        assert (e.percent, e.low, e.high) == pytest.approx((100 / ratio, 100 / high, 100 / low))


def test_the_paper_s_design_finds_what_was_put_in():
    """The simulated study was drawn with the published means and sd 0.25 per episode."""
    means = means_of("steps_observation")
    ratios = means.means[[0, 1]] / means.means[2]
    assert ratios == pytest.approx([936.60 / 1253.17, 1015.05 / 1253.17], rel=0.04)
    assert all(c.p < 0.001 for c in contrasts(means))


def test_holm_and_tukey_are_between_none_and_bonferroni():
    means = published()
    p = {a: np.array([c.p for c in contrasts(means, adjust=a)]) for a in ("none", "holm", "tukey")}
    assert (p["none"] <= p["holm"] + 1e-15).all()
    assert (p["none"] <= p["tukey"] + 1e-12).all()
    assert (p["tukey"] <= 3 * p["none"] + 1e-12).all()
    width = {a: [c.high - c.low for c in contrasts(means, adjust=a)] for a in ("none", "holm", "tukey")}
    assert np.all(np.array(width["none"]) < width["tukey"])
    assert np.all(np.array(width["tukey"]) < width["holm"])


def test_two_levels_need_no_adjustment():
    means = means_of("collided")
    assert {contrasts(means, adjust=a)[0].p for a in ("none", "tukey", "holm")} == {contrasts(means)[0].p}


def test_texts():
    text = contrasts_text(contrasts(published(), adjust="none"))
    assert text.splitlines()[1].startswith("learn_single / plan_pop3      0.9227")
    assert "< .0001" in text
    assert "plan_pop3 - solo" in contrasts_text(contrasts(published(), scale="response"))
    assert published().to_text().splitlines()[3].split()[:2] == ["solo", "1253"]
    assert contrasts_text([]) == "no contrasts"


def test_nonsense_is_refused():
    fit = stored_fit("collided")
    with pytest.raises(InputError, match=r"(?s)condition.*H3-STATS-015"):
        marginal_means(fit, "scene")
    means = marginal_means(fit, "condition")
    with pytest.raises(InputError, match="H3-STATS-034"):
        relative_efficiency(means, "plan_pop3")
    with pytest.raises(InputError, match=r"(?s)'alone'.*H3-STATS-035"):
        relative_efficiency(published(), "alone")
    with pytest.raises(InputError, match=r"(?s)'dunnett'.*H3-STATS-033"):
        contrasts(means, adjust="dunnett")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="H3-STATS-036"):
        _ = contrasts(means, scale="response")[0].ratio


def test_a_covariate_only_shifts_all_means():
    table = columns("offload")
    centred = dict(table, experience=table["experience"] - 100)
    fixed = ["robot", "experience"]
    a, b = (
        marginal_means(fit_glmm(t, "moved", "binomial", fixed=fixed, random=["participant"], trials="objects"), "robot")
        for t in (table, centred)
    )
    assert a.link == pytest.approx(b.link, abs=1e-4)
