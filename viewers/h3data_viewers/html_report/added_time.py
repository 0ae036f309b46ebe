"""Table of the time that robots add to the ways of people, from a second simulation of each recording without robots."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from h3data.errors import H3DataError
from h3data.progress import progress
from h3data.recording.finding import find_episodes
from h3data.stats.intervals import bootstrap_interval
from h3data_viewers.html_report.report import SECTIONS
from h3data_viewers.html_report.tables import Cell, Column, Row, Section, Table, counted, number


def added_time_table(paths: Iterable[Path]) -> Table:
    """Return a table of the added time of people [s], with a row for each policy of robots.

    Episodes of other tasks, or of people who are not of a crowd, are left out, and the caption counts them.

    Raises:
        H3DataError: No episode can be simulated again without robots.
    """
    added_time = SECTIONS.get("added_time")
    delays: dict[str, list[list[float]]] = {}
    faults: list[H3DataError] = []
    for source in progress(find_episodes(paths), desc="without robots", unit="episode"):
        try:
            recording = source.read()
            seconds = [one.seconds for one in added_time(recording) if one.seconds is not None]
        except H3DataError as fault:
            faults.append(fault)
        else:
            delays.setdefault(str(recording.episode.info.get("policy", "")), []).append(seconds)
    if faults and not delays:
        raise faults[0]
    left_out = f" {counted(len(faults), 'episode')} left out: {faults[0]}" if faults else ""
    return Table(
        key="added-time",
        title="Added time of people",
        caption="Time at which people leave their last common goal, minus the time without robots from the same seed [s]. "
        f"Mean over episodes of each episode's mean over people, with 95% interval.{left_out}",
        name_head="Policy",
        columns=(Column(head="Mean [s]"), Column(head="Median of people [s]"), Column(head="Least to most [s]")),
        sections=(Section(title="", rows=tuple(_row(name, episodes) for name, episodes in delays.items())),),
    )


def _row(policy: str, episodes: list[list[float]]) -> Row:
    """Return the row of a policy from the delays of people in each episode [s]; people without a goal have none."""
    means, everybody = [float(np.mean(one)) for one in episodes if one], [s for one in episodes for s in one]
    size = f"{counted(len(means), 'episode')}, {len(everybody)} people"
    if not means:
        return Row(name=policy, cells=(Cell(text="no goal to compare"), Cell(text=""), Cell(text="")), small=size)
    (low, high), mean, median = bootstrap_interval(means), float(np.mean(means)), float(np.median(everybody))
    interval = f" [{number(low)}, {number(high)}]" if np.isfinite([low, high]).all() else ""
    cells = (
        Cell(text=number(mean) + interval, value=mean),
        Cell(text=number(median), value=median),
        Cell(text=f"{number(min(everybody))} to {number(max(everybody))}", value=max(everybody)),
    )
    return Row(name=policy, cells=cells, small=size)
