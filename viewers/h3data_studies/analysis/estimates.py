"""Analysis of a study with people: estimated means per condition and their contrasts, from the metrics of its episodes.

The analysis follows Habitat 3.0 (appendix, "Human-in-the-loop (HITL) Evaluation"). Task completion steps have a Poisson
mixed model with random intercepts of participants and scenes, and 0/1 metrics a binomial one. Relative efficiency is a
ratio of estimated means. The paper does not mention over-dispersion, which counts of people's steps nearly always have.
A model with an observation-level effect is therefore fitted as well, because the standard errors of the Poisson model
are then too small.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from h3data.errors import H3DataError, InputError
from h3data.metrics.episode import EpisodeMetrics
from h3data.metrics.metric import NAN, Metric
from h3data.metrics.profile import Profile
from h3data.metrics.report_layout import FailedEpisodes, StepsModel, StudyLayout
from h3data.stats import bootstrap_interval, wilson_interval
from h3data.terminal import aligned
from h3data_studies.statistics import (
    Contrast,
    GlmmFit,
    MarginalMeans,
    contrasts,
    fit_glmm,
    marginal_means,
    relative_efficiency,
)

GROUPS = ("participant", "scene")
"""Columns with random intercepts in the paper's models."""


@dataclass(frozen=True, kw_only=True)
class StudyModel:
    """Choices of the statistical analysis of a study."""

    steps: StepsModel = "auto"
    """Model of the steps. ``poisson`` is the paper's model. ``observation`` adds a random intercept per episode, for
    counts that vary more than Poisson allows. ``auto`` is the paper's model unless it is over-dispersed. An
    over-dispersed model never appears alone."""
    failed: FailedEpisodes = "leave-out"
    """Treatment of episodes without success: left out, as they have no steps to success, or counted as the longest
    duration E (``limit``)."""
    random: tuple[str, ...] = GROUPS
    """Columns with random intercepts; columns with only one level are ignored."""

    def __post_init__(self) -> None:
        for name, value, choices in (("steps", self.steps, StepsModel), ("failed", self.failed, FailedEpisodes)):
            if value not in get_args(choices):
                raise InputError(
                    f"Expected {name} to be one of {', '.join(get_args(choices))}, got {value!r}.", code="H3-METRIC-032"
                )
        if strangers := [name for name in self.random if name not in GROUPS]:
            raise InputError(
                f"Expected random intercepts of {' and '.join(GROUPS)}, got {strangers[0]!r}.", code="H3-METRIC-031"
            )


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimated mean of a metric under a condition, with its interval."""

    mean: float = NAN
    low: float = NAN
    """Lower end of the 95% interval; NaN if there is none."""
    high: float = NAN
    episodes: int = 0
    """Number of episodes in which the metric is defined."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedMeans:
    """Fitted model of the compared metric, with its means and their pairwise differences."""

    label: str
    """Name of the model: ``Poisson``, ``Poisson with an observation effect``, ``binomial``."""
    fit: GlmmFit
    means: MarginalMeans
    differences: tuple[Contrast, ...]
    """Pairwise differences on the response scale, with p adjusted by Tukey's method."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyAnalysis:
    """Results of a study: estimated means by condition, and contrasts of one metric."""

    conditions: tuple[str, ...]
    """Names of the conditions; that of people alone is first."""
    participants: int
    episodes: Mapping[str, int]
    """Number of episodes by condition."""
    metrics: tuple[Metric, ...]
    estimates: Mapping[str, Mapping[str, Estimate]]
    """Estimates by metric and condition."""
    compared: str
    """Name of the metric whose means are contrasted; empty if none could be."""
    models: tuple[FittedMeans, ...]
    """Fitted models of the compared metric: first the model of the table, then one for comparison if either is unsound."""
    notes: tuple[str, ...]

    def to_text(self) -> str:
        """Return tables of means and contrasts, followed by the notes."""
        lines = [["condition", *(m.name for m in self.metrics), "episodes"]]
        for condition in self.conditions:
            cells = [_shown(m, self.estimates[m.name].get(condition, Estimate())) for m in self.metrics]
            lines.append([condition, *cells, str(self.episodes[condition])])
        blocks = [f"{self.participants} participants. Estimated means [95% interval].\n{aligned(lines)}"]
        for model in self.models:
            rows = [[f"{self.compared}: {model.label}", "difference", "interval", "p (Tukey)"]]
            rows += [
                [f"{c.first} - {c.second}", f"{c.difference:.3g}", f"[{c.low:.3g}, {c.high:.3g}]", _p(c.p)]
                for c in model.differences
            ]
            blocks.append(aligned(rows))
        return "\n\n".join([*blocks, "\n".join(["Notes", *(f"  {note}" for note in self.notes)])])

    def to_dict(self) -> dict[str, object]:
        """Return the analysis as JSON types; NaN becomes None."""
        return {
            "participants": self.participants,
            "episodes": dict(self.episodes),
            "estimates": {
                name: {
                    condition: {k: _or_none(getattr(e, k)) for k in ("mean", "low", "high")} | {"episodes": e.episodes}
                    for condition, e in by_condition.items()
                }
                for name, by_condition in self.estimates.items()
            },
            "compared": self.compared,
            "models": [
                {
                    "label": model.label,
                    "formula": model.fit.formula,
                    "rows": model.fit.rows,
                    "dispersion": _or_none(model.fit.dispersion),
                    "sound": model.fit.sound,
                    "contrasts": [
                        {"first": c.first, "second": c.second, "difference": c.difference, "low": c.low, "high": c.high}
                        | {"p": _or_none(c.p)}
                        for c in model.differences
                    ],
                }
                for model in self.models
            ],
            "notes": list(self.notes),
        }


def study_layout(profile: Profile) -> StudyLayout:
    """Return the rules by which a study analyses a profile's metrics.

    A profile may declare them. Otherwise all its metrics are analysed, and its number of steps, if it has one, is
    contrasted.
    """
    if profile.report.study is not None:
        return profile.report.study
    names = profile.report.columns or tuple(m.name for m in profile.metrics)
    steps = next((m.name for m in profile.metrics if m.unit == "steps" and m.name in names), "")
    return StudyLayout(columns=names, steps=steps)


def analyse_study(
    episodes: Sequence[EpisodeMetrics], profile: Profile, model: StudyModel | None = None
) -> StudyAnalysis:
    """Estimate means and contrasts from the episodes of a study's participants.

    Args:
        episodes: Metrics with participant and condition; others are left out.
        profile: Profile of metrics with which they were measured.
        model: Choices of the analysis (default: `StudyModel`).

    Raises:
        InputError: there are fewer than two conditions or participants.
    """
    model = model or StudyModel()
    kept = [e for e in episodes if e.participant and e.condition]
    conditions = tuple(sorted({e.condition for e in kept}, key=lambda c: (not _alone(c), c)))
    people = len({e.participant for e in kept})
    if len(conditions) < 2 or people < 2:
        raise InputError(
            f"The study needs two conditions and two participants or more, got {len(conditions)} and {people}. Hint: name "
            "them when importing: h3data import ... --manifest sessions.csv (h3data docs import).",
            code="H3-METRIC-030",
        )
    layout = study_layout(profile)
    metrics = tuple(m for name in layout.columns for m in profile.metrics if m.name == name)
    analyser = _Analyser(kept, conditions, model)
    if len(kept) < len(episodes):
        analyser.notes.append(f"{len(episodes) - len(kept)} episodes without a participant or condition are left out.")
    steps = next((m for m in profile.metrics if m.name == layout.steps), None)
    models = analyser.steps_models(steps) if steps is not None else ()
    estimates: dict[str, dict[str, Estimate]] = {}
    for metric in metrics:
        if steps is not None and metric.name == steps.name and models:
            estimates[metric.name] = analyser.from_means(metric, models[0].means)
        elif layout.efficiency and metric.name == layout.efficiency:
            estimates[metric.name] = analyser.efficiency(metric, models[0].means if models else None)
        else:
            estimates[metric.name] = analyser.plain(metric)
    compared = layout.steps if models else ""
    for metric in metrics:
        if metric.binary and (fitted := analyser.rates(metric, estimates[metric.name])) is not None and not compared:
            compared, models = metric.name, (fitted,)
    return StudyAnalysis(
        conditions=conditions,
        participants=people,
        episodes={c: sum(e.condition == c for e in kept) for c in conditions},
        metrics=metrics,
        estimates=estimates,
        compared=compared,
        models=models,
        notes=tuple(analyser.notes),
    )


class _Analyser:
    """Analyser that fits one metric after the other and collects notes."""

    def __init__(self, episodes: Sequence[EpisodeMetrics], conditions: Sequence[str], model: StudyModel) -> None:
        self._episodes, self._conditions, self._model = episodes, conditions, model
        self.notes: list[str] = []

    def steps_models(self, metric: Metric) -> tuple[FittedMeans, ...]:
        """Return the chosen model of a count of steps, and a sound one as well if that model is not sound."""
        values = self._steps(metric)
        try:
            plain = self._fitted(metric, values, "Poisson", observation=False)
            sound = None
            if self._model.steps == "observation" or not plain.fit.sound:
                sound = self._fitted(metric, values, "Poisson with an observation effect", observation=True)
        except H3DataError as fault:
            self.notes.append(f"No mixed model of {metric.name}: {fault}")
            return ()
        models = [plain] if sound is None else [sound, plain]
        if self._model.steps == "poisson":
            models.reverse()
        if self._model.steps == "observation" and plain.fit.sound:
            models = models[:1]
        for place, fitted in enumerate(models):
            which = "Model" if place == 0 else "Beside it, the paper's model" if fitted is plain else "Beside it"
            self.notes.append(f"{which} of {metric.name}: {fitted.fit.formula}, {fitted.fit.rows} rows.")
            self.notes += [f"{metric.name}, {fitted.label}: {without_hint(note)}" for note in fitted.fit.notes]
        return tuple(models)

    def from_means(self, metric: Metric, means: MarginalMeans) -> dict[str, Estimate]:
        """Return the estimates of a fitted model."""
        return {
            c: Estimate(mean=float(m), low=float(a), high=float(b), episodes=len(self._defined(metric, c)))
            for c, m, (a, b) in zip(means.levels, means.means, means.intervals(), strict=True)
        }

    def efficiency(self, metric: Metric, means: MarginalMeans | None) -> dict[str, Estimate]:
        """Return RE in percent of the condition in which people work alone, if there is one."""
        solo = next((c for c in (means.levels if means else ()) if _alone(c)), None)
        if means is None or solo is None:
            self.notes.append(f"{metric.name} needs a condition whose name begins with solo.")
            return {}
        others = {r.level: Estimate(mean=r.percent, low=r.low, high=r.high) for r in relative_efficiency(means, solo)}
        return {solo: Estimate(mean=100.0), **others}

    def plain(self, metric: Metric) -> dict[str, Estimate]:
        """Return the means over episodes with bootstrap intervals, of 0/1 metrics with Wilson's."""
        estimates: dict[str, Estimate] = {}
        for condition in self._conditions:
            values = self._defined(metric, condition)
            low, high = bootstrap_interval(values) if values and not metric.binary else (NAN, NAN)
            if metric.binary and not _alone(condition):  # nobody alone can touch a robot: 0 is no estimate there
                low, high = wilson_interval(int(sum(values)), len(values))
            mean = float(np.mean(values)) if values else NAN
            estimates[condition] = Estimate(mean=mean, low=low, high=high, episodes=len(values))
        return estimates

    def rates(self, metric: Metric, estimates: dict[str, Estimate]) -> FittedMeans | None:
        """Replace the shares of a 0/1 metric by those of a binomial model, except 0 and 1, which have no log-odds."""
        between = [c for c, e in estimates.items() if 0 < e.mean < 1]
        extreme = [c for c, e in estimates.items() if e.mean in (0, 1)]
        if extreme and between:
            self.notes.append(
                f"{metric.name} of {', '.join(extreme)} is a plain share: at 0 or 1 there is no estimate."
            )
        if len(between) < 2:
            return None
        rows = {id(e): e.values[metric.name] for e in self._episodes if e.condition in between}
        values = {key: int(value) for key, value in rows.items() if value == value}
        try:
            fitted = self._fitted(metric, values, "binomial", observation=False)
        except H3DataError as fault:
            self.notes.append(f"{metric.name}: plain shares, as no mixed model could be fitted: {fault}")
            return None
        if fitted.fit.penalised:
            why = next(note for note in fitted.fit.notes if note.startswith("always alike")).partition(" A penalty")[0]
            self.notes.append(f"{metric.name}: plain shares, as a mixed model has no finite estimate: {why}")
            return None
        self.notes.append(f"Model of {metric.name}: {fitted.fit.formula}, {fitted.fit.rows} rows.")
        self.notes += [f"{metric.name}: {without_hint(note)}" for note in fitted.fit.notes]
        estimates |= self.from_means(metric, fitted.means)
        return fitted

    def _steps(self, metric: Metric) -> dict[int, int]:
        """Return the steps of each episode, by its identity, and note how many episodes have none."""
        steps = {id(e): int(v) for e in self._episodes if (v := e.values[metric.name]) == v}
        missing = [e for e in self._episodes if id(e) not in steps]
        if self._model.failed == "limit":
            steps |= {id(e): e.max_steps for e in missing}
        if missing:
            each = [f"{sum(e.condition == c for e in missing)} under {c}" for c in self._conditions]
            what = "count the longest duration E" if self._model.failed == "limit" else "are left out"
            self.notes.append(f"{metric.name}: {len(missing)} episodes without success {what} ({', '.join(each)}).")
        return steps

    def _fitted(self, metric: Metric, values: Mapping[int, int], label: str, *, observation: bool) -> FittedMeans:
        chosen = [e for e in self._episodes if id(e) in values]
        rows: dict[str, list[str] | list[int]] = {
            "condition": [e.condition for e in chosen],
            "participant": [e.participant for e in chosen],
            "scene": [e.scene for e in chosen],
            metric.name: [values[id(e)] for e in chosen],
        }
        fit = fit_glmm(
            rows,
            metric.name,
            "binomial" if metric.binary else "poisson",
            fixed=["condition"],
            random=[name for name in self._model.random if len(set(rows[name])) > 1],
            observation_effect=observation,
        )
        means = marginal_means(fit, "condition")
        return FittedMeans(label=label, fit=fit, means=means, differences=contrasts(means, scale="response"))

    def _defined(self, metric: Metric, condition: str) -> list[float]:
        return [v for e in self._episodes if e.condition == condition and (v := e.values[metric.name]) == v]


def without_hint(note: str) -> str:
    """Return a note about a fit without its hint on how to call the function from Python."""
    return note.partition(" Hint:")[0]


def _alone(condition: str) -> bool:
    """Return whether people work without a robot under a condition."""
    return condition.lower().startswith("solo")


def _shown(metric: Metric, estimate: Estimate) -> str:
    if np.isnan(estimate.mean):
        return "-"
    digits = 1 if metric.unit in ("steps", "%") else 2
    interval = "" if np.isnan(estimate.low) else f" [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"
    return f"{estimate.mean:.{digits}f}{interval}"


def _p(p: float) -> str:
    return "-" if np.isnan(p) else "< .0001" if p < 1e-4 else f"{p:.4f}"


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
