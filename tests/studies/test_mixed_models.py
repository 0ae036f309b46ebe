"""Mixed models against lme4 on stored fits, against a plain dense Laplace approximation, laws, and data that cannot be fitted.

`tests/data/glmm/make_reference.R` made the data and the reference.
"""

from __future__ import annotations

import time

import numpy as np
import pyarrow as pa
import pytest
from scipy.optimize import minimize
from scipy.special import gammaln
from scipy.stats import norm, poisson

from h3data.errors import InputError
from h3data_studies.statistics import SeparationError, fit_glmm
from h3data_studies.statistics.glmm_design import mixed_design
from h3data_studies.statistics.laplace import LaplaceModel
from h3data_studies.statistics.mixed_models import _newton
from tests.studies.glmm_reference import CROSSED, FITS, columns, reference, stored_fit


def r_name(name: str) -> str:
    """``robot[plan]:home[small]`` as R spells it: ``robotplan:homesmall``."""
    return name.replace("[", "").replace("]", "")


@pytest.mark.parametrize("name", FITS)
def test_estimates_and_standard_errors_as_lme4(name):
    fit, expected = stored_fit(name), reference(name, "coefficient")
    assert [r_name(n) for n in fit.fixed.names] == list(expected)
    assert fit.converged
    assert fit.coefficients == pytest.approx([row["value"] for row in expected.values()], rel=1e-4)
    assert fit.standard_errors == pytest.approx([row["se"] for row in expected.values()], rel=1e-3)


@pytest.mark.parametrize("name", FITS)
def test_deviations_modes_and_likelihood_as_lme4(name):
    fit = stored_fit(name)
    deviations = {k.replace("row", "observation"): v["value"] for k, v in reference(name, "deviation").items()}
    assert dict(fit.deviations) == pytest.approx(deviations, rel=1e-3, abs=1e-6)
    assert fit.log_likelihood == pytest.approx(reference(name, "log_likelihood")[""]["value"], abs=1e-3)
    assert fit.dispersion == pytest.approx(reference(name, "dispersion")[""]["value"], rel=1e-3)
    modes = {k: v["value"] for k, v in reference(name, "participant").items()}
    assert dict(fit.modes["participant"]) == pytest.approx(modes, rel=1e-3, abs=2e-4)


def test_what_a_reader_has_to_know_is_said():
    assert "singular: the variance of scene" in stored_fit("counts").to_text()
    assert "over-dispersed" in stored_fit("steps").to_text()
    assert stored_fit("collided").notes == stored_fit("steps_observation").notes == ()
    text = stored_fit("offload").to_text()
    assert "cbind(moved, objects - moved) ~ robot + home + experience + robot:home + (1 | participant)" in text
    assert "robot[plan]:home[small]" in text
    assert "NOT" not in text


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("observation", [False, True])
def test_the_eliminated_form_equals_a_dense_one(observation, nested):
    """log-likelihood by plain optimisation of u and a determinant of the whole matrix."""
    random = np.random.default_rng(5)
    table = {
        "y": random.poisson(4, 40),
        "a": np.array(list("ppqqrrr"))[np.arange(40) % 7] if nested else random.choice(["p", "q", "r"], 40),
        "b": np.arange(40) % 7,
        "x": random.normal(size=40),
    }
    design = mixed_design(
        table, "y", "poisson", ["x"], ["a", "b"], trials=None, levels={}, observation_effect=observation
    )
    theta, beta = np.array([0.7, 0.4, 0.5])[: 3 if observation else 2], np.array([1.2, -0.3])
    z = np.hstack([t * np.eye(g.max() + 1)[g] for t, g in zip(theta, design.groups.values(), strict=True)])
    y = table["y"]

    def penalised(u):
        eta = design.x @ beta + z @ u
        return 2 * np.sum(np.exp(eta) - y * eta + gammaln(y + 1)) + u @ u, 2 * (z.T @ (np.exp(eta) - y) + u)

    best = minimize(penalised, np.zeros(z.shape[1]), jac=True, method="BFGS", options={"gtol": 1e-9})
    weight = np.exp(design.x @ beta + z @ best.x)
    expected = best.fun + np.linalg.slogdet(np.eye(z.shape[1]) + z.T @ (weight[:, None] * z))[1]
    model = LaplaceModel(design)
    assert model.mode(theta, beta).deviance == pytest.approx(expected, abs=1e-7)
    model.mode(theta * 3)  # the next mode starts from this one
    assert model.mode(theta, beta).deviance == pytest.approx(expected, abs=1e-7)
    free = model.mode(theta)
    assert model.mode(theta, free.coefficients).deviance == pytest.approx(free.deviance, abs=1e-7)


def test_many_levels_and_an_observation_effect_take_less_than_a_few_seconds():
    """The shape of lme4's grouseticks: 403 chicks in 118 broods in 63 locations, which took 50 CPU-seconds."""
    random = np.random.default_rng(1)
    place = np.sort(random.integers(0, 63, 118))
    place[:63] = np.arange(63)
    brood = np.concatenate([np.arange(118), random.integers(0, 118, 403 - 118)])
    location = place[brood]
    year, height = random.integers(95, 98, 63)[location], random.normal(0, 0.35, 63)[location]
    eta = 0.5 + (year == 96) - (year == 97) - 2 * height + random.normal(0, 0.55, 403)
    eta += random.normal(0, 0.53, 63)[location] + random.normal(0, 0.75, 118)[brood]
    table = {
        "ticks": random.poisson(np.exp(eta)),
        "year": year.astype(str),
        "height": height,
        "brood": brood.astype(str),
        "location": location.astype(str),
    }
    start = time.process_time()
    fit = fit_glmm(
        table, "ticks", "poisson", fixed=["year", "height"], random=["brood", "location"], observation_effect=True
    )
    assert time.process_time() - start < 4, "0.6 s on an idle core; a dense factor of the broods takes 20"
    assert fit.sound
    assert fit.deviations["brood"] == pytest.approx(0.75, abs=0.25)
    assert fit.deviations["observation"] == pytest.approx(0.55, abs=0.1)


def test_laplace_is_near_the_integral():
    """One group, many counts: the integral over its intercept by quadrature."""
    y = np.random.default_rng(0).poisson(6, 30)
    table = {"y": y, "g": ["a"] * 15 + ["b"] * 15}
    design = mixed_design(table, "y", "poisson", [], ["g"], trials=None, levels={}, observation_effect=False)
    at = LaplaceModel(design).mode(np.array([0.5]), np.array([1.7]))
    nodes = np.linspace(-4, 4, 4001)
    log_l = 0.0
    for part in (y[:15], y[15:]):
        inside = poisson.logpmf(part[:, None], np.exp(1.7 + 0.5 * nodes)).sum(axis=0) + norm.logpdf(nodes)
        log_l += np.log(np.trapezoid(np.exp(inside), nodes))
    assert -at.deviance / 2 == pytest.approx(log_l, abs=2e-2)


def test_rows_may_come_in_any_order_from_any_table():
    table = columns("counts")
    fit = stored_fit("counts")
    shuffled = np.random.default_rng(1).permutation(len(table["events"]))
    again = fit_glmm(
        pa.table({k: v[shuffled] for k, v in table.items()}), "events", "poisson", fixed=["condition"], random=CROSSED
    )
    assert again.coefficients == pytest.approx(fit.coefficients, rel=1e-5)
    assert again.covariance == pytest.approx(fit.covariance, rel=1e-3, abs=1e-8)


def test_successes_out_of_five_equal_five_single_trials():
    table = columns("offload")
    fit = fit_glmm(table, "moved", "binomial", fixed=["robot"], random=CROSSED, trials="objects")
    single = {k: np.repeat(v, 5) for k, v in table.items()}
    single["moved"] = (np.tile(np.arange(5), len(table["moved"])) < single["moved"]).astype(int)
    again = fit_glmm(single, "moved", "binomial", fixed=["robot"], random=CROSSED)
    assert again.coefficients == pytest.approx(fit.coefficients, rel=1e-4)
    assert again.standard_errors == pytest.approx(fit.standard_errors, rel=1e-3)
    assert dict(again.deviations) == pytest.approx(dict(fit.deviations), rel=1e-3)


def test_the_reference_level_moves_the_coefficients_only():
    table = columns("counts")
    fit = stored_fit("counts")
    other = fit_glmm(table, "events", "poisson", fixed=["condition"], random=CROSSED, levels={"condition": ["b", "a"]})
    assert other.fixed.names == ("(Intercept)", "condition[a]")
    assert other.coefficients[1] == pytest.approx(-fit.coefficients[1], rel=1e-4)
    assert other.log_likelihood == pytest.approx(fit.log_likelihood, abs=1e-5)
    numbers = dict(table, condition=(table["condition"] == "b").astype(int))
    as_factor = fit_glmm(
        numbers, "events", "poisson", fixed=["condition"], random=CROSSED, levels={"condition": ["0", "1"]}
    )
    as_covariate = fit_glmm(numbers, "events", "poisson", fixed=["condition"], random=CROSSED)
    assert as_factor.coefficients == pytest.approx(fit.coefficients, rel=1e-6)
    assert as_covariate.coefficients == pytest.approx(fit.coefficients, rel=1e-6)


def test_without_groups_to_tell_apart_it_is_the_plain_model():
    """Balanced groups of equal totals: variances 0, and the estimates are those of the means."""
    table = {
        "y": [2, 4, 8, 10] * 4,
        "c": ["a", "a", "b", "b"] * 4,
        "p": np.repeat(["p1", "p2", "p3", "p4"], 4),
    }
    fit = fit_glmm(table, "y", "poisson", fixed=["c"], random=["p"])
    assert fit.deviations == {"p": 0}
    assert fit.coefficients == pytest.approx([np.log(3), np.log(3)], rel=1e-5)
    assert fit.standard_errors[0] == pytest.approx(1 / np.sqrt(24), rel=1e-3)
    assert fit.converged
    assert set(fit.modes["p"].values()) == {0.0}


def test_a_variance_that_starts_at_0_may_grow():
    """The first search ends at deviations 0, where the deviance is flat and falls to both sides."""
    table = columns("counts")
    design = mixed_design(
        table, "events", "poisson", ["condition"], ["participant"], trials=None, levels={}, observation_effect=False
    )
    model = LaplaceModel(design)
    beta = stored_fit("counts").coefficients

    def deviance(at):
        return model.mode(at[:1], at[1:]).deviance

    scale = np.diag([1e-3, 0.1, 0.1])
    optimum, _, converged = _newton(deviance, np.array([0.0, *beta]), scale)
    assert converged
    assert abs(optimum[0]) == pytest.approx(stored_fit("counts").deviations["participant"], rel=1e-3)


def base(rows: int = 24) -> dict[str, list]:
    random = np.random.default_rng(2)
    return {
        "y": random.poisson(5, rows).tolist(),
        "hit": random.integers(0, 2, rows).tolist(),
        "c": ["a", "b"] * (rows // 2),
        "d": (["u"] * 3 + ["v"] * 3) * (rows // 6),
        "p": [f"p{k % 4}" for k in range(rows)],
        "s": [f"s{k % 3}" for k in range(rows)],
    }


@pytest.mark.parametrize(
    ("change", "call", "message"),
    [
        ({}, {"fixed": ["condition"]}, r"(?s)'condition'.*y, hit.*H3-STATS-007"),
        ({}, {"fixed": "c"}, "H3-STATS-004"),
        ({}, {"random": []}, "H3-STATS-005"),
        ({}, {"family": "gauss"}, "H3-STATS-003"),
        ({}, {"random": ["c"]}, "H3-STATS-006"),
        ({}, {"fixed": ["c", "c:d"]}, r"(?s)'d'.*H3-STATS-021"),
        ({}, {"trials": "hit"}, "H3-STATS-017"),
        ({}, {"family": "binomial"}, r"(?s)1.*'y'.*H3-STATS-013"),
        ({}, {"levels": {"c": ["a", "z"]}}, r"(?s)\['b'\].*\['z'\].*H3-STATS-018"),
        ({}, {"levels": {"k": ["a"]}}, r"(?s)'k'.*H3-STATS-007"),
        ({"y": [1.5] * 24}, {}, r"(?s)1\.5.*H3-STATS-011"),
        ({"y": [-1] + [2] * 23}, {}, r"(?s)-1.*H3-STATS-011"),
        ({"y": ["many"] * 24}, {}, r"(?s)'many'.*H3-STATS-011"),
        ({"y": [float("nan"), 3, *[2] * 21, float("inf")]}, {}, r"(?s)'y'.*2 of 24.*\(0, 23\).*H3-STATS-008"),
        ({"c": [None, *["a", "b"] * 11, "a"]}, {}, r"(?s)'c'.*1 of 24.*\(0\).*H3-STATS-008"),
        ({"c": ["a"] * 24}, {}, r"(?s)'c'.*H3-STATS-014"),
        ({"p": ["p"] * 24}, {}, r"(?s)'p'.*H3-STATS-014"),
        ({"y": [1, 2]}, {}, "H3-STATS-009"),
        ({k: [] for k in base()}, {}, "H3-STATS-010"),
        ({"y": np.ones((24, 2))}, {}, r"(?s)\[24, 2\].*H3-STATS-016"),
        ({"d": ["a", "b"] * 12}, {"fixed": ["c", "d"]}, "H3-STATS-001"),
        ({"d": ["u", "v", "u", "u"] * 6}, {"fixed": ["c", "d", "c:d"]}, r"(?s)c = a, d = v.*H3-STATS-022"),
        ({"s": [f"x{k % 4}" for k in range(24)]}, {}, r"(?s)'p'.*'s'.*H3-STATS-020"),
        ({"p": [str(k) for k in range(24)]}, {"observation_effect": True}, "H3-STATS-020"),
        ({}, {"response": "hit", "family": "binomial", "observation_effect": True}, r"(?s)'observation'.*H3-STATS-019"),
    ],
)
def test_what_cannot_be_fitted_is_refused_in_words(change, call, message):
    arguments = {"response": "y", "family": "poisson", "fixed": ["c"], "random": ["p", "s"]} | call
    with pytest.raises(InputError, match=message):
        fit_glmm(base() | change, **arguments)


def test_separation_names_its_level():
    table = columns("study")
    with pytest.raises(SeparationError, match=r"(?s)'collided' is 0.*every row.*condition = solo.*H3-STATS-002"):
        fit_glmm(table, "collided", "binomial", fixed=["condition"], random=CROSSED)
    never = base() | {"y": [0, 4] * 12}
    with pytest.raises(SeparationError, match=r"(?s)every row.*c =.*H3-STATS-002"):
        fit_glmm(never, "y", "poisson", fixed=["c"], random=["p"])
    with pytest.raises(InputError, match=r"(?s)'hit' is at its largest.*24.*H3-STATS-002"):
        fit_glmm(base() | {"hit": [1] * 24}, "hit", "binomial", fixed=[], random=["p"])


def test_separation_by_a_covariate_is_seen():
    table = base() | {"x": np.arange(24.0), "hit": [0] * 12 + [1] * 12}
    with pytest.raises(InputError, match=r"(?s)'hit' is 0 or at its largest.*H3-STATS-002"):
        fit_glmm(table, "hit", "binomial", fixed=["x"], random=["p"])
    mixed = table | {"hit": [0] * 11 + [1, 0] + [1] * 11}
    assert fit_glmm(mixed, "hit", "binomial", fixed=["x"], random=["p"]).coefficients[1] > 0


def test_a_fit_that_does_not_converge_says_so(monkeypatch):
    for name in ("_DECREMENT", "_ROUNDING"):
        monkeypatch.setattr(f"h3data_studies.statistics.mixed_models.{name}", -1.0)
    fit = fit_glmm(base(), "y", "poisson", fixed=["c"], random=["p"])
    assert not fit.converged
    assert "NOT CONVERGED" in fit.to_text()
    assert "NOT CONVERGED" in repr(fit)
    assert "did not converge" in fit.notes[0]


def test_a_column_of_booleans_is_a_factor_and_a_response():
    table = base() | {"c": [k % 2 == 0 for k in range(24)]}
    table["hit"] = [bool(v) for v in table["hit"]]
    fit = fit_glmm(table, "hit", "binomial", fixed=["c"], random=["p"])
    assert fit.fixed.names == ("(Intercept)", "c[True]")
    assert fit.fixed.levels == {"c": ("False", "True")}


def always_alike(ones: int, zeros: int, rows: int, undecided: int = 0):
    """People who answer 1 each time, who answer 0 each time, and who answer both in turn, under two conditions."""
    people = np.repeat([f"p{k}" for k in range(ones + zeros + undecided)], rows)
    turns = np.arange(undecided * rows) // 2 % 2
    answers = np.concatenate([np.ones(ones * rows, int), np.zeros(zeros * rows, int), turns])
    return {"y": answers, "person": people, "condition": np.tile(["a", "b"], len(people) // 2)}


@pytest.mark.parametrize(
    ("ones", "zeros", "rows", "undecided"), [(5, 5, 10, 0), (30, 10, 10, 0), (8, 4, 10, 1), (3, 1, 2, 0)]
)
@pytest.mark.parametrize("fixed", [[], ["condition"]])
def test_people_who_always_answer_alike(ones, zeros, rows, undecided, fixed):
    table = always_alike(ones, zeros, rows, undecided)
    fit, flipped = (
        fit_glmm(table | {"y": y}, "y", "binomial", fixed=fixed, random=["person"])
        for y in (table["y"], 1 - table["y"])
    )
    assert fit.coefficients == pytest.approx(-flipped.coefficients, abs=1e-3)
    assert fit.penalised
    assert not fit.sound
    assert "always alike: rows of the same person" in fit.to_text()
    assert fit.deviations["person"] < 10
    if ones == zeros:
        assert fit.coefficients == pytest.approx(np.zeros(1 + len(fixed)), abs=1e-6)


def test_people_who_succeed_in_all_trials_or_in_none_answer_alike():
    table = {"y": [5, 0, 5, 0, 5, 0], "n": [5] * 6, "person": list("aabbcc"), "block": list("pqrpqr")}
    fit = fit_glmm(table, "y", "binomial", fixed=[], random=["block"], trials="n")
    assert not fit.penalised
    table["y"] = [5, 5, 0, 0, 5, 5]
    fit = fit_glmm(table, "y", "binomial", fixed=[], random=["person"], trials="n")
    assert fit.penalised


def test_people_who_differ_as_usual_are_not_penalised():
    assert not any(stored_fit(name).penalised for name in FITS)
