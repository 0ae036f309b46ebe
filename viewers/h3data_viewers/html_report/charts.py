"""The charts of a report: estimates beside the paper's, distributions, distance over time, learning curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from h3data.metrics import Metric, metrics_of
from h3data.metrics.paper.published import published_results
from h3data_viewers.html_report.data import Run
from h3data_viewers.html_report.episode import GRID_S
from h3data_viewers.html_report.svg import Svg, axes, linear, tick_text, ticks, x_axis

COLORS = 8
"""Colours of runs; further runs share colours."""
_WIDTH = 360.0
_LABEL = 118.0
_ROW = 24.0
_BINS = 24
_FEWEST = 0.1
"""Quartiles over time are drawn while this share of the episodes lasts."""


def series_class(place: int) -> str:
    """Class that colours run number ``place``."""
    return f"s{place % COLORS + 1}"


def legend(names: Sequence[str]) -> str:
    """Return a legend of the colours of the runs."""
    items = "".join(
        f'<li><span class="chip {series_class(k)}"></span>{escape(name)}</li>' for k, name in enumerate(names)
    )
    return f'<ul class="legend">{items}</ul>'


# --- beside the paper -------------------------------------------------------------------------------------------------
def estimate_charts(runs: Sequence[Run]) -> list[str]:
    """Return one panel per metric of social navigation: our means with intervals, the paper's expert and RL below."""
    paper = [row for row in published_results().social_nav.rows if row.policies]
    return [_estimates(metric, runs, paper) for metric in metrics_of("paper", "social_nav")]


def _estimates(metric: Metric, runs: Sequence[Run], paper: Sequence) -> str:
    summaries = [run.means()[metric.name] for run in runs]
    published = [(row.name, row.values[metric.name]) for row in paper if metric.name in row.values]
    ends = [v for s in summaries for v in (s.mean, s.high) if np.isfinite(v)] + [v[0] for _, v in published]
    high = 1.0 if metric.range == (0.0, 1.0) else max(ends, default=1.0) * 1.08
    bottom = 8 + _ROW * (len(runs) + len(published)) + (8 if published else 0)
    alt = f"{metric.title}: " + "; ".join(f"{r.name} {s.mean:.2f}" for r, s in zip(runs, summaries, strict=True))
    svg = Svg(_WIDTH, bottom + 38, alt)
    x, box = linear(0, high, _LABEL, _WIDTH - 12), (_LABEL, 2.0, _WIDTH - 12, bottom)
    x_axis(svg, x, ticks(0, high, 4), box, title=_unit(metric))
    for k, (run, s) in enumerate(zip(runs, summaries, strict=True)):
        y = 8 + _ROW * (k + 0.5)
        svg.text(_LABEL - 8, y + 4, run.name, "label", anchor="end", most=16)
        if np.isfinite(s.low):
            svg.line(x(s.low), y, x(s.high), y, f"whisker {series_class(k)}")
        if np.isfinite(s.mean):
            svg.circle(x(s.mean), y, 5, f"dot {series_class(k)}", title=f"{s.mean:.3f} [{s.low:.3f}, {s.high:.3f}]")
    for k, (name, values) in enumerate(published):
        y = 16 + _ROW * (len(runs) + k + 0.5)
        svg.text(_LABEL - 8, y + 4, f"paper: {_short(name)}", "label quiet", anchor="end", most=20)
        at = x(values[0])
        if len(values) == 2:
            svg.line(x(values[0] - values[1]), y, x(values[0] + values[1]), y, "whisker paper")
        svg.shape(f"M{at - 5:.1f} {y:.1f}L{at:.1f} {y - 5:.1f}L{at + 5:.1f} {y:.1f}L{at:.1f} {y + 5:.1f}Z", "diamond")
    return _figure(svg, f"{metric.name}: {metric.title.lower()}")


def mean_charts(
    metrics: Sequence[Metric],
    conditions: Sequence[str],
    estimates: Mapping[str, Mapping[str, tuple[float, float, float]]],
    names: Sequence[str],
) -> list[str]:
    """Return one panel per metric of a study: the estimated means of conditions with intervals.

    ``estimates`` has mean, lower and upper end, or NaN, by metric and condition; ``names`` are those of all runs.
    """
    colours = {c: series_class(names.index(c) if c in names else k) for k, c in enumerate(conditions)}
    panels = (_mean_chart(metric, conditions, estimates[metric.name], colours) for metric in metrics)
    return [figure for figure in panels if figure]


def _mean_chart(
    metric: Metric,
    conditions: Sequence[str],
    estimates: Mapping[str, tuple[float, float, float]],
    colours: Mapping[str, str],
) -> str:
    means = {c: estimates[c] for c in conditions if c in estimates and np.isfinite(estimates[c][0])}
    if not means:
        return ""
    ends = [v for mean, _, upper in means.values() for v in (mean, upper) if np.isfinite(v)]
    most = 1.0 if metric.range == (0.0, 1.0) else max(ends) * 1.08 or 1.0
    bottom = 8 + _ROW * len(conditions)
    alt = "; ".join(f"{c} {mean:.2f}" for c, (mean, _, _) in means.items())
    svg = Svg(_WIDTH, bottom + 38, f"{metric.title}, estimated means: {alt}")
    x = linear(0, most, _LABEL, _WIDTH - 12)
    x_axis(svg, x, ticks(0, most, 4), (_LABEL, 2.0, _WIDTH - 12, bottom), title=_unit(metric))
    for k, condition in enumerate(conditions):
        y = 8 + _ROW * (k + 0.5)
        svg.text(_LABEL - 8, y + 4, condition, "label", anchor="end", most=16)
        if condition not in means:
            continue
        mean, low, high = means[condition]
        if np.isfinite(low):
            svg.line(x(low), y, x(high), y, f"whisker {colours[condition]}")
        svg.circle(x(mean), y, 5, f"dot {colours[condition]}", title=f"{mean:.3f} [{low:.3f}, {high:.3f}]")
    return _figure(svg, f"{metric.name}: {metric.title.lower()}, estimated means with 95 % intervals")


def _short(name: str) -> str:
    return {"Heuristic Expert": "expert", "End-to-end RL": "RL"}.get(name, name)


# --- distributions ----------------------------------------------------------------------------------------------------
def distribution_charts(runs: Sequence[Run]) -> list[str]:
    """Return one panel per metric that is not 0 or 1: a histogram per run, its mean marked."""
    metrics = [m for m in runs[0].table.metrics if not m.binary] if runs else []
    return [figure for metric in metrics if (figure := _distribution(metric, runs))]


def _distribution(metric: Metric, runs: Sequence[Run]) -> str:
    columns = [run.table.columns[metric.name] for run in runs]
    columns = [c[np.isfinite(c)] for c in columns]
    if not sum(map(len, columns)):
        return ""
    everything = np.concatenate(columns)
    low, high = (
        (0.0, 1.0)
        if metric.range == (0.0, 1.0)
        else (min(0.0, everything.min()), float(everything.max()) * 1.02 or 1.0)
    )
    lane = 44.0
    bottom = 6 + lane * len(runs)
    means = "; ".join(f"{r.name} {c.mean():.2f}" for r, c in zip(runs, columns, strict=True) if len(c))
    svg = Svg(_WIDTH, bottom + 38, f"Distribution of {metric.title} over episodes; means: {means}")
    x, box = linear(low, high, _LABEL, _WIDTH - 12), (_LABEL, 2.0, _WIDTH - 12, bottom)
    x_axis(svg, x, ticks(low, high, 4), box, title=_unit(metric))
    edges = np.linspace(low, high, _BINS + 1)
    for k, (run, column) in enumerate(zip(runs, columns, strict=True)):
        base = 6 + lane * (k + 1)
        svg.text(_LABEL - 8, base - 18, run.name, "label", anchor="end", most=16)
        svg.text(_LABEL - 8, base - 4, f"n = {len(column)}", "tick", anchor="end")
        counts = np.histogram(column, edges)[0]
        for i in np.flatnonzero(counts):
            tall = (lane - 8) * counts[i] / counts.max()
            svg.rect(x(edges[i]) + 0.5, base - tall, x(edges[i + 1]) - x(edges[i]) - 1, tall, f"bar {series_class(k)}")
        if len(column):
            svg.line(x(column.mean()), base - lane + 6, x(column.mean()), base, "mean")
        svg.line(_LABEL, base, _WIDTH - 12, base, "grid")
    return _figure(svg, f"{metric.name}: {metric.title.lower()}")


# --- over time --------------------------------------------------------------------------------------------------------
def time_charts(runs: Sequence[Run]) -> list[str]:
    """Distance over time with quartiles, and the shares of episodes that have reached each milestone of their profile."""
    kept = [(k, run) for k, run in enumerate(runs) if any(len(e.distance_m) for e in run.episodes)]
    if not kept:
        return []
    longest = _longest(kept)
    layout = runs[0].profile.report
    charts = [_distance(kept, longest, zone=layout.distance_zone_m)]
    for milestone in layout.milestones:
        known = [
            (k, run, [e for e in run.episodes if not np.isnan(e.metrics.values[milestone.metric])]) for k, run in kept
        ]
        times = [
            (k, run, [e.seconds(e.metrics.moments[flag]) if flag in e.metrics.moments else np.inf for e in episodes])
            for flag in (milestone.flag,)
            for k, run, episodes in known
            if episodes
        ]
        if times:
            charts.append(_share(milestone.title, times, longest))
    return charts


def _longest(kept: Sequence[tuple[int, Run]]) -> float:
    return max(e.seconds(e.metrics.rows - 1) for _, run in kept for e in run.episodes)


def _distance(kept: Sequence[tuple[int, Run]], longest: float, *, zone: tuple[float, float] | None) -> str:
    quartiles = [(k, run, _quartiles([e.distance_m for e in run.episodes])) for k, run in kept]
    high = max([2.5, *(float(np.nanmax(q)) for _, _, q in quartiles if q.size and not np.isnan(q).all())])
    several = any(e.people > 1 for _, run in kept for e in run.episodes)
    who = "nearest person" if several else "person"
    svg, x, y = _panel(longest, high, f"Distance of robot and {who} over time: median and quartiles", "seconds")
    if zone:
        near, far = zone
        svg.rect(x(0), y(far), x(longest) - x(0), y(near) - y(far), "zone")
    for k, _, q in quartiles:
        t = np.arange(q.shape[1]) * GRID_S
        known = ~np.isnan(q).any(0)
        there = np.flatnonzero(known)
        band = [(x(t[i]), y(q[0, i])) for i in there] + [(x(t[i]), y(q[2, i])) for i in there[::-1]]
        svg.path(band, f"band {series_class(k)}", closed=True)
    for k, _, q in quartiles:
        t = np.arange(q.shape[1]) * GRID_S
        svg.path([(x(a), y(b)) for a, b in zip(t, q[1], strict=True)], f"line {series_class(k)}")
    what = "Distance to the nearest person [m]" if several else "Distance [m]"
    caption = f"{what}: median and quartiles of the episodes that last"
    return _figure(svg, caption + (f"; shaded: {zone[0]:g}–{zone[1]:g} m, following" if zone else ""))


def _quartiles(rows: Sequence[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Quartiles over episodes, shape [3, G]; NaN where too few last so long."""
    grid = np.full((len(rows), max((len(r) for r in rows), default=0)), np.nan)
    for k, row in enumerate(rows):
        grid[k, : len(row)] = row
    known = (~np.isnan(grid)).sum(0)
    enough = known >= max(1.0, _FEWEST * len(rows))
    result = np.full((3, grid.shape[1]), np.nan)
    if enough.any():
        result[:, enough] = np.nanquantile(grid[:, enough], (0.25, 0.5, 0.75), axis=0)
    return result


def _share(title: str, times: Sequence[tuple[int, Run, Sequence[float]]], longest: float) -> str:
    shares = ", ".join(f"{run.name} {np.isfinite(t).mean():.2f}" for _, run, t in times)
    svg, x, y = _panel(longest, 1.0, f"{title}, share of episodes; at the end {shares}", "seconds")
    for k, _, values in times:
        known = np.sort([v for v in values if np.isfinite(v)])
        points = [(x(0), y(0))]
        for i, t in enumerate(known):
            points += [(x(t), y(i / len(values))), (x(t), y((i + 1) / len(values)))]
        points.append((x(longest), y(len(known) / len(values))))
        svg.path(points, f"line {series_class(k)}")
    return _figure(svg, f"{title}: share of episodes")


def _panel(longest: float, high: float, alt: str, x_title: str, low: float = 0.0, start: float = 0.0):
    svg = Svg(_WIDTH, 250, alt)
    x, y = linear(start, longest, 40, _WIDTH - 12), linear(low, high, 208, 10)
    axes(svg, x, y, ticks(start, longest, 5), ticks(low, high, 5), (40, 10, _WIDTH - 12, 208), x_title=x_title)
    return svg, x, y


# --- learning ---------------------------------------------------------------------------------------------------------
LEARNED: Mapping[str, str] = {
    "reward": "reward: mean of a step",
    "distance_m": "distance_m: mean distance between robot and person [m], the curve that the paper plots beside the reward",
}
"""Captions of quantities that the paper's training curves show too."""


def learning_charts(curves: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> list[str]:
    """Return one panel per logged quantity, one line per training."""
    quantities = dict.fromkeys(name for curve in curves.values() for name in curve if name != "step")
    return [figure for name in quantities if (figure := _learning(name, curves))]


def _learning(name: str, curves: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> str:
    lines = [(k, c["step"], c[name]) for k, c in enumerate(curves.values()) if name in c]
    finite = [v[np.isfinite(v) & np.isfinite(s)] for _, s, v in lines]
    if not sum(map(len, finite)):
        return ""
    low, high = (f(float(f(v)) for v in finite if len(v)) for f in (min, max))
    last = max(float(np.nanmax(s)) for _, s, _ in lines)
    svg, x, y = _panel(
        last,
        high if high > low else low + 1.0,
        f"Learning curve of {name}: from {tick_text(low)} to {tick_text(high)}",
        "training steps",
        low,
    )
    for k, steps, values in lines:
        keep = np.unique(np.linspace(0, len(steps) - 1, 400).astype(int))
        svg.path([(x(a), y(b)) for a, b in zip(steps[keep], values[keep], strict=True)], f"line {series_class(k)}")
    return _figure(svg, LEARNED.get(name, name))


# --- small things -----------------------------------------------------------------------------------------------------
def _unit(metric: Metric) -> str:
    return metric.unit if metric.unit != "1" else ""


def _figure(svg: Svg, caption: str) -> str:
    return f"<figure><figcaption>{escape(caption)}</figcaption>{svg.to_html()}</figure>"
