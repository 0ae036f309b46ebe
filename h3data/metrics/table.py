"""Metrics of many episodes: one column per metric, means with intervals, as text and as JSON."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.metrics.episode import EpisodeMetrics, assumed_task, deviation_lines, for_each_partner, note_lines
from h3data.metrics.metric import ARROWS, Metric
from h3data.metrics.registry import find_profile, measure
from h3data.recording.records import Recording, notebook
from h3data.stats import bootstrap_intervals, wilson_interval
from h3data.terminal import aligned


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Mean of one metric over the episodes in which it is defined."""

    mean: float
    low: float
    """Lower end of the interval; NaN if there are too few episodes."""
    high: float
    """Upper end of the interval; NaN if there are too few episodes."""
    count: int
    """Number of episodes with a value."""
    episodes: int
    """Number of all episodes, with and without a value."""
    method: Literal["bootstrap", "wilson"]


@dataclass(frozen=True, kw_only=True, eq=False)
class MetricsTable:
    """Table of metrics with one row per episode."""

    profile: str
    episode_ids: tuple[str, ...]
    columns: Mapping[str, NDArray[np.float64]]
    """Values [E] by metric name; NaN = undefined in that episode."""
    episodes: tuple[EpisodeMetrics, ...]
    """Metrics of each episode, with notes."""
    metrics: tuple[Metric, ...]
    """Definitions of the columns, in their order."""
    left_out: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of the episodes that could not be measured, by the reason."""
    _summaries: dict[tuple[float, int, int], dict[str, Summary]] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.episode_ids)

    def _repr_html_(self) -> str:
        return notebook().metrics_table_html(self)

    def __repr__(self) -> str:
        return f"MetricsTable({self.profile!r}, {len(self)} episodes, {', '.join(self.columns)})"

    def __str__(self) -> str:
        return self.to_text()

    def summary(self, *, confidence: float = 0.95, resamples: int = 10_000, seed: int = 0) -> dict[str, Summary]:
        """Return the mean and its interval of each metric, by metric name (see `summarize`)."""
        key = (confidence, resamples, seed)
        # 10,000 resamples of each metric: a report asks for the same summary many times
        if key not in self._summaries:
            self._summaries[key] = summarize_all(
                self.metrics, self.columns, confidence=confidence, resamples=resamples, seed=seed
            )
        # a copy, so that callers cannot change what is kept
        return dict(self._summaries[key])

    def notes(self) -> dict[str, dict[str, int]]:
        """Count the episodes that carry each note, by metric name."""
        counted: dict[str, dict[str, int]] = {}
        for episode in self.episodes:
            for name, text in episode.notes.items():
                per_metric = counted.setdefault(name, {})
                per_metric[text] = per_metric.get(text, 0) + 1
        return counted

    def to_text(self, *, confidence: float = 0.95) -> str:
        """Return an aligned table ``mean [low, high]`` with a line per metric, followed by the notes."""
        deviations = (e.protocol_deviations for e in self.episodes)
        lines = [*self._assumed_lines(), *self._note_lines(), *deviation_lines(deviations), *self._left_out_lines()]
        return "\n".join([aligned(self.to_rows(confidence=confidence)), *lines])

    def to_rows(self, *, confidence: float = 0.95) -> list[list[str]]:
        """Return the cells of the table, its head first, then a row per metric."""
        records = {m.name: m for m in self.metrics}
        lines = [["metric", "mean", f"{100 * confidence:g}% interval", "unit", "episodes", "", "what"]]
        for name, s in self.summary(confidence=confidence).items():
            metric = records[name]
            interval = "" if np.isnan(s.low) else f"[{s.low:.3f}, {s.high:.3f}]"
            mean = "undefined" if np.isnan(s.mean) else f"{s.mean:.3f}"
            unit = "" if metric.unit == "1" else metric.unit
            of = f"{s.count}" if s.count == s.episodes else f"{s.count} of {s.episodes}"
            lines.append([name, mean, interval, unit, of, ARROWS[metric.direction], metric.title])
        return lines

    def to_dict(self, *, confidence: float = 0.95) -> dict[str, Any]:
        """Return the summary, the notes and all episodes as JSON types; NaN becomes None."""
        summary = {
            name: {
                "mean": _or_none(s.mean),
                "low": _or_none(s.low),
                "high": _or_none(s.high),
                "count": s.count,
                "method": s.method,
            }
            for name, s in self.summary(confidence=confidence).items()
        }
        return {
            "profile": self.profile,
            "confidence": confidence,
            "metrics": {m.name: m.id for m in self.metrics},
            "summary": summary,
            "episodes": [e.to_dict() for e in self.episodes],
            "left_out": {reason: list(names) for reason, names in self.left_out.items()},
        }

    def to_json(self, *, confidence: float = 0.95, indent: int | None = 2) -> str:
        """Return `to_dict` as JSON text."""
        return json.dumps(self.to_dict(confidence=confidence), indent=indent, allow_nan=False)

    def _assumed_lines(self) -> list[str]:
        line = assumed_task(self.episodes)
        return [line] if line else []

    def _note_lines(self) -> list[str]:
        by_text: dict[str, list[str]] = {}
        for name, texts in self.notes().items():
            for text, times in texts.items():
                of = f" ({times} of {len(self)} episodes)" if len(self) > 1 else ""
                by_text.setdefault(text + of, []).append(name)
        return note_lines(by_text)

    def _left_out_lines(self) -> list[str]:
        lines = []
        for reason, names in self.left_out.items():
            more = f" and {len(names) - 4} more" if len(names) > 4 else ""
            lines.append(f"  {reason}: {', '.join(names[:4])}{more}")
        return ["Left out", *lines] if lines else []


def summarize_all(
    metrics: Sequence[Metric],
    columns: Mapping[str, NDArray[np.float64]],
    *,
    confidence: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> dict[str, Summary]:
    """Summarize metrics by name, as `summarize` does, in a third of the time, from ``columns`` of their values [E]."""
    # an undefined value is left out of the mean, never taken for 0
    defined = {m.name: columns[m.name][~np.isnan(columns[m.name])] for m in metrics}
    means = [m.name for m in metrics if not m.binary]
    sampled = bootstrap_intervals(
        [defined[name] for name in means], confidence=confidence, resamples=resamples, seed=seed
    )
    intervals = dict(zip(means, sampled, strict=True)) | {
        # of shares near 0 or 1 a bootstrap has an interval without width
        m.name: wilson_interval(int(defined[m.name].sum()), len(defined[m.name]), confidence=confidence)
        for m in metrics
        if m.binary
    }
    return {
        m.name: Summary(
            mean=float(defined[m.name].mean()) if len(defined[m.name]) else float("nan"),
            low=intervals[m.name][0],
            high=intervals[m.name][1],
            count=len(defined[m.name]),
            episodes=len(columns[m.name]),
            method="wilson" if m.binary else "bootstrap",
        )
        for m in metrics
    }


def measure_many(recordings: Iterable[Recording], profile: str | None = None) -> MetricsTable:
    """Measure recordings one at a time, so that only one is in memory, by default by the profile of their task."""
    measured = (
        each
        for recording in recordings
        for each in for_each_partner(measure(recording, profile), recording.episode.info)
    )
    return tabulate(measured, profile=profile)


def tabulate(
    episodes: Iterable[EpisodeMetrics],
    *,
    profile: str | None = None,
    left_out: Mapping[str, tuple[str, ...]] | None = None,
) -> MetricsTable:
    """Make the table of episodes that are measured already, such as by several workers.

    ``profile`` names the metrics of a table without episodes (default: ``paper``), ``left_out`` has the names of
    episodes that could not be measured, by the reason.

    Raises:
        InputError: an episode occurs twice, or episodes differ in their metrics, step length or units and cannot be
            averaged.
    """
    rows = tuple(episodes)
    _check_unique(rows)
    _check_alike(rows)
    metrics = rows[0].metrics if rows else find_profile(profile or "paper").metrics
    return MetricsTable(
        profile=metrics[0].profile,
        episode_ids=tuple(e.episode_id for e in rows),
        columns={m.name: np.array([e.values[m.name] for e in rows], np.float64) for m in metrics},
        episodes=rows,
        metrics=metrics,
        left_out=left_out or {},
    )


def legend(metrics: Iterable[Metric]) -> str:
    """Return one line that explains the short names of metrics, such as ``S: finding success; CR: collision rate.``."""
    return "; ".join(f"{m.name}: {m.title[:1].lower()}{m.title[1:]}" for m in metrics) + "."


def _check_unique(rows: Sequence[EpisodeMetrics]) -> None:
    # participants of a study play the same episodes, partners with the same plan share a recording
    times_each = Counter((e.uid, e.participant, e.partner) for e in rows)
    twice = list(dict.fromkeys(uid for (uid, *_), times in times_each.items() if times > 1))
    if twice:
        names = [e.episode_id for e in {e.uid: e for e in rows}.values() if e.uid in set(twice[:5])]
        raise InputError(
            f"{len(twice)} episodes occur more than once and would count more than once: "
            f"{', '.join(map(repr, names))}{', ...' if len(twice) > 5 else ''}. Name each recording once.",
            code="H3-METRIC-045",
        )


def _check_alike(rows: Sequence[EpisodeMetrics]) -> None:
    # By identity first: comparing 7 records for each of 10,000 episodes would take longer than measuring them.
    others = [e for e in rows if e.metrics is not rows[0].metrics and e.metrics != rows[0].metrics]
    if others:
        names = sorted({f"{e.task} ({e.profile})" for e in (rows[0], *others)})
        raise InputError(
            f"Episodes with different metrics cannot share a table: {', '.join(names)}. Measure them separately.",
            code="H3-METRIC-046",
        )
    # lengths of steps to a tenth of a millisecond: 30 Hz is 33,333,333 ns in one file and 33,333,334 ns in another
    kinds_of = (
        ("steps of different length", lambda e: round(e.dt_ns * 1e-6, 1), " ms"),
        ("different units", lambda e: e.units, ""),
    )
    for what, of, unit in kinds_of:
        kinds: dict[float | str, str] = {}
        for row in rows:
            kinds.setdefault(of(row), row.episode_id)
        if len(kinds) > 1:
            each = ", ".join(f"{kind}{unit} (such as {name!r})" for kind, name in kinds.items())
            raise InputError(
                f"Episodes with {what} cannot share a table: {each}. Measure them separately.", code="H3-METRIC-047"
            )


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
