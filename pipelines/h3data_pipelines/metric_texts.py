"""Explanations of metrics, with their definition and the reason for a value in one episode."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.metrics.metric import Metric
from h3data.metrics.registry import all_profiles, find_profile
from h3data.metrics.requirements import lacks
from h3data.recording.records import Recording

_RUNS = 4
"""Number of runs of a flag that are listed."""


def explain(metric: Metric) -> str:
    """Return the description of one metric as a few lines of plain text."""
    low, high = metric.range
    better = {"higher": "higher is better", "lower": "lower is better", "neither": "no better direction"}
    optional = [f"{name} (if present)" for name in metric.optional]
    lines = [
        f"{metric.name}: {metric.title}  ({metric.id})",
        f"  formula    {metric.formula}",
        f"  unit       {'ratio' if metric.unit == '1' else metric.unit}, {low:g} to {high:g}, {better[metric.direction]}",
        f"  source     {metric.source}",
        f"  reads      {', '.join((*metric.columns, *optional))}",
    ]
    for head, text in (("undefined", metric.undefined), ("reading", metric.reading), ("habitat", metric.habitat)):
        if text:
            lines.append(f"  {head:<9}  {text}")
    return "\n".join(lines)


def explain_episode(metric: Metric, recording: Recording, *, profile: str | None = None) -> str:
    """Return text about a metric in one episode: its value and data, why it is 0 or undefined, and the decisive rows.

    ``profile`` names the metric's profile if it has no registered name, such as ``module:name``.
    """
    chosen = find_profile(profile or metric.profile, recording.episode.task)
    metric = next((m for m in chosen.metrics if m.name == metric.name), metric)  # CR is defined once per task
    measured = chosen.measure(recording)
    if metric.name not in measured.values:
        return (
            f"{metric.id} is not measured in episodes of task {recording.episode.task!r}; there, {chosen.name} measures "
            f"{', '.join(measured.values)}."
        )
    value = measured.values[metric.name]
    unit = "" if metric.unit == "1" or np.isnan(value) else f" {metric.unit}"
    missing = [entry for entry in metric.columns if lacks(recording, entry)]
    read = [name for name in (*metric.columns, *metric.optional) if name not in missing]
    lines = [
        f"{metric.name} = {_number(value)}{unit}  in episode {measured.episode_id!r} ({measured.rows} rows)",
        f"  formula    {metric.formula}",
        f"  read       {', '.join(read) or 'nothing'}",
    ]
    if missing:
        lines.append(f"  lacked     {', '.join(missing)}")
    for name, content in _info(metric, recording):
        lines.append(f"  {name} = {content}")
    if metric.name in measured.notes:
        lines.append(f"  note       {measured.notes[metric.name]}")
    if np.isnan(value) and metric.undefined:
        lines.append(f"  undefined  {metric.undefined}")
    series = chosen.series(recording) if measured.rows else {}
    lines += [f"  {describe(name, series[name])}" for name in metric.series if name in series]
    return "\n".join(lines)


def describe(name: str, values: NDArray) -> str:
    """Return one line about a series [T]: the rows in which a flag holds, or the extremes of a quantity."""
    if values.dtype == np.bool_:
        spans = runs(values)
        if not len(spans):
            return f"{name}: in no row of {len(values)}"
        shown = ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in spans[:_RUNS])
        more = f", ... ({len(spans)} runs)" if len(spans) > _RUNS else ""
        return f"{name}: in {int(values.sum())} of {len(values)} rows: {shown}{more}"
    defined = np.flatnonzero(~np.isnan(values))
    if not len(defined):
        return f"{name}: undefined in all {len(values)} rows"
    low, high = defined[np.argmin(values[defined])], defined[np.argmax(values[defined])]
    gaps = f", undefined in {len(values) - len(defined)} rows" if len(defined) < len(values) else ""
    return f"{name}: {_number(float(values[low]))} (row {low}) to {_number(float(values[high]))} (row {high}){gaps}"


def runs(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the first and last row of each run in which a flag [T] holds, shape [R, 2]."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))
    return np.stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1], axis=1)


def list_metrics() -> str:
    """Return a list of all metrics of all registered profiles, one line each."""
    profiles = all_profiles()
    every = [m for p in profiles for m in p.metrics]
    widths = max(len(m.id) for m in every), max(len(m.unit) for m in every)
    lines = []
    for profile in profiles:
        lines += ["", f"{profile.name}: {profile.title}"]
        lines += [f"  {m.id:<{widths[0]}}  {m.unit:<{widths[1]}}  {m.title}" for m in profile.metrics]
    return "\n".join(lines[1:])


def _info(metric: Metric, recording: Recording) -> list[tuple[str, object]]:
    keys = [n.partition(":")[2] for n in (*metric.columns, *metric.optional) if n.startswith("info:")]
    return [(f"info:{key}", recording.episode.info[key]) for key in keys if key in recording.episode.info]


def _number(value: float) -> str:
    return "undefined" if np.isnan(value) else f"{float(value):.6g}"
