"""Charts of an HTML report: estimates next to the paper's, distributions, distance over time, and learning curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.metrics import Metric
from h3data.metrics.paper.profiles import SOCIAL_NAV_PROFILE
from h3data.metrics.paper.published import published_results
from h3data_viewers.html_report.data import Run
from h3data_viewers.html_report.episode import GRID_S
from h3data_viewers.html_report.svg import Scale, Svg, add_x_axis, linear, tick_text, ticks
from h3data_viewers.html_report.tables import Table

_WIDTH, _LABEL, _ROW = 360.0, 118.0, 24.0
"""Widths of a chart and of the labels left of it, and height of a row, in units of the drawing."""
Interval = tuple[float, float, float]
"""Interval of an estimate as mean, lower and upper end; NaN if it is unknown."""


@dataclass(frozen=True, kw_only=True)
class StudyTables:
    """Tables and charts about the episodes of a study's participants, for one task of a report."""

    tables: tuple[Table, ...] = ()
    charts: Mapping[str, Sequence[Svg]] = field(default_factory=dict)
    """Charts that follow a table, by the key of the table."""
    missing: str = ""
    """Reason why there are no tables of means; empty if there are tables."""


def series_class(place: int) -> str:
    """Return the CSS class with the colour of the run at index ``place``.

    There are eight colours, which repeat if there are more runs, as in the macro ``legend``.
    """
    return f"s{place % 8 + 1}"


# --- a row for each run or condition ----------------------------------------------------------------------------------
def _rows_chart(metric: Metric, bottom: float, low: float, high: float, *, alt: str, caption: str) -> tuple[Svg, Scale]:
    """Return a chart with labels left of rows that end at ``bottom``, and values from ``low`` to ``high`` along it."""
    svg = Svg(_WIDTH, bottom + 38, alt, caption=f"{metric.name}: {metric.title.lower()}{caption}")
    x = linear(low, high, _LABEL, _WIDTH - 12)
    unit = metric.unit if metric.unit != "1" else ""
    add_x_axis(svg, x, ticks(low, high, 4), (_LABEL, 2.0, _WIDTH - 12, bottom), title=unit)
    return svg, x


def _add_interval(svg: Svg, x: Scale, y: float, name: str, interval: Interval, colour: str) -> None:
    mean, low, high = interval
    svg.text(_LABEL - 8, y + 4, name, "label", anchor="end", most=16)
    if np.isfinite(low):
        svg.line(x(low), y, x(high), y, f"whisker {colour}")
    if np.isfinite(mean):
        svg.circle(x(mean), y, 5, f"dot {colour}", title=f"{mean:.3f} [{low:.3f}, {high:.3f}]")


def _highest(metric: Metric, values: Sequence[float]) -> float:
    """Return the right end of an axis with these values."""
    # shares all have the axis 0 to 1, so that panels compare; others have 8% of room on the right
    return 1.0 if metric.range == (0.0, 1.0) else max((v for v in values if np.isfinite(v)), default=1.0) * 1.08 or 1.0


def estimate_charts(runs: Sequence[Run]) -> list[Svg]:
    """Return one panel per metric of social navigation, with our means and intervals above the paper's expert and RL."""
    paper = [row for row in published_results().social_nav.rows if row.policies]
    return [_estimates(metric, runs, paper) for metric in SOCIAL_NAV_PROFILE.metrics]


def _estimates(metric: Metric, runs: Sequence[Run], paper: Sequence) -> Svg:
    summaries = [run.means()[metric.name] for run in runs]
    published = [(row.name, row.values[metric.name]) for row in paper if metric.name in row.values]
    high = _highest(metric, [v for s in summaries for v in (s.mean, s.high)] + [v[0] for _, v in published])
    bottom = 8 + _ROW * (len(runs) + len(published)) + (8 if published else 0)
    alt = f"{metric.title}: " + "; ".join(f"{r.name} {s.mean:.2f}" for r, s in zip(runs, summaries, strict=True))
    svg, x = _rows_chart(metric, bottom, 0, high, alt=alt, caption="")
    for k, (run, s) in enumerate(zip(runs, summaries, strict=True)):
        _add_interval(svg, x, 8 + _ROW * (k + 0.5), run.name, (s.mean, s.low, s.high), series_class(k))
    for k, (name, values) in enumerate(published):
        y, short = 16 + _ROW * (len(runs) + k + 0.5), {"Heuristic Expert": "expert", "End-to-end RL": "RL"}
        svg.text(_LABEL - 8, y + 4, f"paper: {short.get(name, name)}", "label quiet", anchor="end", most=20)
        if len(values) == 2:
            svg.line(x(values[0] - values[1]), y, x(values[0] + values[1]), y, "whisker paper")
        at = x(values[0])
        svg.path([(at - 5, y), (at, y - 5), (at + 5, y), (at, y + 5)], "diamond", closed=True)
    return svg


def mean_charts(
    metrics: Sequence[Metric],
    conditions: Sequence[str],
    estimates: Mapping[str, Mapping[str, Interval]],
    names: Sequence[str],
) -> list[Svg]:
    """Return one panel per metric of a study: the estimated means of conditions with intervals.

    ``estimates`` has mean, lower and upper end (or NaN) by metric and condition. ``names`` are the names of all runs.
    """
    charts = []
    for metric in metrics:
        means = {c: found for c, found in estimates[metric.name].items() if np.isfinite(found[0])}
        if not any(c in means for c in conditions):
            continue
        alt = "; ".join(f"{c} {means[c][0]:.2f}" for c in conditions if c in means)
        svg, x = _rows_chart(
            metric,
            8 + _ROW * len(conditions),
            0,
            _highest(metric, [v for mean, _, upper in means.values() for v in (mean, upper)]),
            alt=f"{metric.title}, estimated means: {alt}",
            caption=", estimated means with 95% intervals",
        )
        for k, condition in enumerate(conditions):
            colour = series_class(names.index(condition) if condition in names else k)
            unknown = (np.nan, np.nan, np.nan)
            _add_interval(svg, x, 8 + _ROW * (k + 0.5), condition, means.get(condition, unknown), colour)
        charts.append(svg)
    return charts


def distribution_charts(runs: Sequence[Run]) -> list[Svg]:
    """Return one panel with a histogram per run for each metric that has values other than 0 and 1; the mean is marked."""
    charts = []
    for metric in [m for m in runs[0].table.metrics if not m.binary] if runs else []:
        columns = [run.table.columns[metric.name] for run in runs]
        columns = [c[np.isfinite(c)] for c in columns]
        if sum(map(len, columns)):
            charts.append(_distribution(metric, runs, columns))
    return charts


def _distribution(metric: Metric, runs: Sequence[Run], columns: Sequence[NDArray[np.float64]]) -> Svg:
    everything = np.concatenate(columns)
    low, high = (
        (0.0, 1.0)
        if metric.range == (0.0, 1.0)
        else (min(0.0, everything.min()), float(everything.max()) * 1.02 or 1.0)
    )
    lane = 44.0
    means = "; ".join(f"{r.name} {c.mean():.2f}" for r, c in zip(runs, columns, strict=True) if len(c))
    alt = f"Distribution of {metric.title} over episodes; means: {means}"
    svg, x = _rows_chart(metric, 6 + lane * len(runs), low, high, alt=alt, caption="")
    # the same bins for all runs, so that their bars stand above each other
    edges = np.linspace(low, high, 25)
    for k, (run, column) in enumerate(zip(runs, columns, strict=True)):
        base = 6 + lane * (k + 1)
        svg.text(_LABEL - 8, base - 18, run.name, "label", anchor="end", most=16)
        svg.text(_LABEL - 8, base - 4, f"n = {len(column)}", "tick", anchor="end")
        counts = np.histogram(column, edges)[0]
        for i in np.flatnonzero(counts):
            # each run has its own scale: runs may differ in their number of episodes
            tall = (lane - 8) * counts[i] / counts.max()
            svg.rect(x(edges[i]) + 0.5, base - tall, x(edges[i + 1]) - x(edges[i]) - 1, tall, f"bar {series_class(k)}")
        if len(column):
            svg.line(x(column.mean()), base - lane + 6, x(column.mean()), base, "mean")
        svg.line(_LABEL, base, _WIDTH - 12, base, "grid")
    return svg


# --- over time --------------------------------------------------------------------------------------------------------
def time_charts(runs: Sequence[Run]) -> list[Svg]:
    """Return charts of distance over time with quartiles, and of the share of episodes that reached each milestone."""
    # with their numbers, so that each keeps its colour where others are left out
    kept = [(k, run) for k, run in enumerate(runs) if any(len(e.distance_m) for e in run.episodes)]
    if not kept:
        return []
    longest = max(e.seconds(e.metrics.rows - 1) for _, run in kept for e in run.episodes)
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


def _distance(kept: Sequence[tuple[int, Run]], longest: float, *, zone: tuple[float, float] | None) -> Svg:
    quartiles = [(k, run, _quartiles([e.distance_m for e in run.episodes])) for k, run in kept]
    # at least 2.5 m, so that the zone of following is in view
    high = max([2.5, *(float(np.nanmax(q)) for _, _, q in quartiles if q.size and not np.isnan(q).all())])
    several = any(e.people > 1 for _, run in kept for e in run.episodes)
    who = "nearest person" if several else "person"
    what = "Distance to the nearest person [m]" if several else "Distance [m]"
    svg, x, y = _time_chart(
        longest,
        (0.0, high),
        alt=f"Distance of robot and {who} over time: median and quartiles",
        caption=f"{what}: median and quartiles of the episodes that last"
        + (f"; shaded: {zone[0]:g}–{zone[1]:g} m, following" if zone else ""),
    )
    if zone:
        near, far = zone
        svg.rect(x(0), y(far), x(longest) - x(0), y(near) - y(far), "zone")
    for k, _, q in quartiles:
        t = np.arange(q.shape[1]) * GRID_S
        known = ~np.isnan(q).any(0)
        there = np.flatnonzero(known)
        # there along the lower quartile and back along the upper one
        band = [(x(t[i]), y(q[0, i])) for i in there] + [(x(t[i]), y(q[2, i])) for i in there[::-1]]
        svg.path(band, f"band {series_class(k)}", closed=True)
    for k, _, q in quartiles:
        t = np.arange(q.shape[1]) * GRID_S
        svg.path([(x(a), y(b)) for a, b in zip(t, q[1], strict=True)], f"line {series_class(k)}")
    return svg


def _quartiles(rows: Sequence[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Return the quartiles over episodes, shape [3, G]; NaN where fewer than a tenth of them last so long."""
    grid = np.full((len(rows), max((len(r) for r in rows), default=0)), np.nan)
    for k, row in enumerate(rows):
        grid[k, : len(row)] = row
    known = (~np.isnan(grid)).sum(0)
    # the few longest episodes would make the curves jump where the others end
    enough = known >= max(1.0, 0.1 * len(rows))
    result = np.full((3, grid.shape[1]), np.nan)
    if enough.any():
        result[:, enough] = np.nanquantile(grid[:, enough], (0.25, 0.5, 0.75), axis=0)
    return result


def _share(title: str, times: Sequence[tuple[int, Run, Sequence[float]]], longest: float) -> Svg:
    shares = ", ".join(f"{run.name} {np.isfinite(t).mean():.2f}" for _, run, t in times)
    alt = f"{title}, share of episodes; at the end {shares}"
    svg, x, y = _time_chart(longest, (0.0, 1.0), alt=alt, caption=f"{title}: share of episodes")
    for k, _, values in times:
        known = np.sort([v for v in values if np.isfinite(v)])
        points = [(x(0), y(0))]
        for i, t in enumerate(known):
            # stairs: the share is constant between two events, and counts episodes that never get there
            points += [(x(t), y(i / len(values))), (x(t), y((i + 1) / len(values)))]
        points.append((x(longest), y(len(known) / len(values))))
        svg.path(points, f"line {series_class(k)}")
    return svg


def _time_chart(
    longest: float, values: tuple[float, float], *, alt: str, caption: str, x_title: str = "seconds"
) -> tuple[Svg, Scale, Scale]:
    """Return a chart over time from 0 to ``longest``, with a grid from the lowest to the highest of ``values``."""
    svg, right, bottom = Svg(_WIDTH, 250, alt, caption=caption), _WIDTH - 12, 208.0
    x, y = linear(0, longest, 40, right), linear(*values, bottom, 10)
    for value in ticks(*values, 5):
        svg.line(40, y(value), right, y(value), "grid")
        svg.text(34, y(value) + 4, tick_text(value), "tick", anchor="end")
    add_x_axis(svg, x, ticks(0, longest, 5), (40, 10, right, bottom), title=x_title, grid=False)
    return svg, x, y


# --- learning ---------------------------------------------------------------------------------------------------------
LEARNED: Mapping[str, str] = {
    "reward": "reward: mean of a step",
    "distance_m": "distance_m: mean distance between robot and person [m], the curve that the paper plots beside the reward",
}
"""Captions of quantities that are also in the paper's training curves."""


def learning_charts(curves: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> list[Svg]:
    """Return one panel per logged training quantity, with one line per training run."""
    quantities = dict.fromkeys(name for curve in curves.values() for name in curve if name != "step")
    return [figure for name in quantities if (figure := _learning(name, curves))]


def _learning(name: str, curves: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> Svg | None:
    lines = [(k, c["step"], c[name]) for k, c in enumerate(curves.values()) if name in c]
    finite = [v[np.isfinite(v) & np.isfinite(s)] for _, s, v in lines]
    if not sum(map(len, finite)):
        return None
    low, high = (f(float(f(v)) for v in finite if len(v)) for f in (min, max))
    # the lines share one axis of steps: a shorter training ends earlier
    last = max(float(np.nanmax(s)) for _, s, _ in lines)
    svg, x, y = _time_chart(
        last,
        (low, high if high > low else low + 1.0),
        alt=f"Learning curve of {name}: from {tick_text(low)} to {tick_text(high)}",
        caption=LEARNED.get(name, name),
        x_title="training steps",
    )
    for k, steps, values in lines:
        # a chart is 308 units wide, and a log may have a hundred thousand rows
        keep = np.unique(np.linspace(0, len(steps) - 1, 400).astype(int))
        svg.path([(x(a), y(b)) for a, b in zip(steps[keep], values[keep], strict=True)], f"line {series_class(k)}")
    return svg
