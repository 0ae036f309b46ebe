"""Stored data sets, what lme4 and emmeans found in them, and our fits of them."""

from __future__ import annotations

import csv
from functools import cache

import numpy as np

from h3data_studies.statistics import GlmmFit, fit_glmm
from tests.paths import DATA

FOLDER = DATA / "glmm"
CROSSED = ["participant", "scene"]


@cache
def columns(name: str) -> dict[str, np.ndarray]:
    """The columns of a stored data set: numbers where all values are."""
    with (FOLDER / f"{name}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    table = {}
    for key in rows[0]:
        values = [row[key] for row in rows]
        try:
            table[key] = np.array(values, np.float64)
        except ValueError:
            table[key] = np.array(values)
    return table


def reference(fit: str, quantity: str) -> dict[str, dict[str, float]]:
    """What R found: value, se, low, high, p by name."""
    with (FOLDER / "reference.csv").open(newline="") as file:
        return {
            row["name"]: {k: float(row[k]) if row[k] else float("nan") for k in ("value", "se", "low", "high", "p")}
            for row in csv.DictReader(file)
            if row["fit"] == fit and row["quantity"] == quantity
        }


@cache
def stored_fit(name: str) -> GlmmFit:
    """The fit that the reference calls ``name``."""
    study = columns("study")
    robots = {k: v[study["condition"] != "solo"] for k, v in study.items()}
    match name:
        case "steps":
            return fit_glmm(study, "steps", "poisson", fixed=["condition"], random=CROSSED)
        case "steps_observation":
            return fit_glmm(study, "steps", "poisson", fixed=["condition"], random=CROSSED, observation_effect=True)
        case "collided":
            return fit_glmm(robots, "collided", "binomial", fixed=["condition"], random=CROSSED)
        case "offload":
            fixed = ["robot", "home", "experience", "robot:home"]
            return fit_glmm(columns("offload"), "moved", "binomial", fixed=fixed, random=CROSSED, trials="objects")
        case _:
            return fit_glmm(columns("counts"), "events", "poisson", fixed=["condition"], random=CROSSED)


FITS = ["steps", "steps_observation", "collided", "offload", "counts"]
