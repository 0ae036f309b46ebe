"""Measurement of one episode: values, notes about them, and the rows in which notable events happened."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.metrics.metric import ARROWS, Metric
from h3data.recording.records import STEP_NS, notebook
from h3data.terminal import aligned

NEVER = -1
"""Row number of an event that did not happen."""


@dataclass(frozen=True, kw_only=True, repr=False)
class EpisodeMetrics:
    """The metrics of one episode."""

    episode_id: str
    uid: str
    profile: str
    metrics: tuple[Metric, ...]
    """Definitions of the metrics, in the order of ``values``."""
    values: Mapping[str, float]
    """Values by metric name; NaN = this recording does not determine it, see ``notes``."""
    notes: Mapping[str, str]
    """Notes by metric name: the reason why the metric is undefined, or the replacement of missing data."""
    robot: int = -1
    """Index of the robot that was measured; -1 = none in particular."""
    human: int = -1
    """Index of the human that was measured; -1 = none in particular."""
    moments: Mapping[str, int] = field(default_factory=dict)
    """First row in which a flag of the profile's series held: ``found``, ``collision``, ``done``; absent if never."""
    rows: int
    task: str
    """Task of the metrics; for profiles that measure any task, the task of the recording."""
    task_is_assumed: bool = False
    """True if the recording, a gfx-replay, does not state its task, so that ``task`` is an assumption."""
    scene: str = ""
    dt_ns: int = STEP_NS
    """Nominal time between steps of the recording [ns]."""
    units: str = "SI"
    """Entry ``info:units`` of the recording."""
    protocol_deviations: str = ""
    """Rules of the episode that differ from the paper's; empty for other profiles."""
    participant: str = ""
    """Participant of a study, ``info:participant``."""
    condition: str = ""
    """Condition of a study, ``info:condition``."""
    policy: str = ""
    """Policy of the robot, ``info:policy``."""
    partner: str = ""
    """Policy of the person, ``info:partner``; one of them if several partners share the recording
    (`for_each_partner`)."""
    max_steps: int = 0
    """Longest duration, ``info:max_steps``; the number of rows if it is not recorded."""

    @property
    def encounter_row(self) -> int:
        """Row in which the robot first found the human; -1 = never, or not computed."""
        return self.moments.get("found", NEVER)

    @property
    def contact_row(self) -> int:
        """Row of the first recorded contact; -1 = none known."""
        return self.moments.get("collision", NEVER)

    def _repr_html_(self) -> str:
        return notebook().metrics_html(self)

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value:.3g}" for name, value in self.values.items())
        return f"EpisodeMetrics({self.episode_id!r}, {self.profile!r}: {values})"

    def __str__(self) -> str:
        return self.to_text()

    def to_text(self) -> str:
        """Return an aligned table with a line per metric, followed by the notes."""
        by_text: dict[str, list[str]] = {}
        for name, text in self.notes.items():
            by_text.setdefault(text, []).append(name)
        assumed = assumed_task([self])
        lines = [*([assumed] if assumed else []), *note_lines(by_text), *deviation_lines([self.protocol_deviations])]
        return "\n".join([aligned(self.to_rows()), *lines])

    def to_rows(self) -> list[list[str]]:
        """Return the cells of the table, its head first, then a row per metric."""
        rows = [["metric", "value", "unit", "", "what"]]
        for metric in self.metrics:
            value = self.values[metric.name]
            number = "undefined" if np.isnan(value) else f"{value:.3f}"
            unit = "" if metric.unit == "1" else metric.unit
            rows.append([metric.name, number, unit, ARROWS[metric.direction], metric.title])
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics and notes as JSON types; NaN and infinities become None."""
        return {
            "episode_id": self.episode_id,
            "uid": self.uid,
            "profile": self.profile,
            "scene": self.scene,
            **({"participant": self.participant} if self.participant else {}),
            **({"condition": self.condition} if self.condition else {}),
            **({"policy": self.policy} if self.policy else {}),
            **({"partner": self.partner} if self.partner else {}),
            **({"assumed_task": self.task} if self.task_is_assumed else {}),
            "steps": self.rows,
            "robot": self.robot,
            "human": self.human,
            "encounter_row": self.encounter_row,
            "contact_row": self.contact_row,
            # NaN is no JSON: an undefined value is null, and its note says why
            "values": {k: float(v) if np.isfinite(v) else None for k, v in self.values.items()},
            "notes": dict(self.notes),
            "set_up": self.protocol_deviations,  # the key that stored results have
        }


def assumed_task(episodes: Iterable[EpisodeMetrics]) -> str:
    """Return a sentence about recordings whose task is assumed, which names the profiles of other tasks.

    The text is empty if all recordings state their task.
    """
    tasks = [episode.task for episode in episodes if episode.task_is_assumed]
    if not tasks:
        return ""
    which = (
        f"{len(tasks)} gfx-replays, which do not say their"
        if len(tasks) > 1
        else "a gfx-replay, which does not say its"
    )
    return (
        f"Taken for {tasks[0]}: {which} task. Of another task these numbers mean nothing. "
        "Hint: h3data metrics --profile field measures any two agents."
    )


def deviation_lines(deviations: Iterable[str]) -> list[str]:
    """Return lines about episodes whose rules differ from the paper's (`h3data.metrics.paper.protocol`).

    The most frequent deviations come first.
    """
    counted = Counter(text for text in deviations if text)
    lines = [f"  {text}: {times} episode{'s' if times != 1 else ''}" for text, times in counted.most_common()]
    return ["Rules that differ from the paper's, so its numbers do not compare:", *lines] if lines else []


def note_lines(notes: Mapping[str, Iterable[str]]) -> list[str]:
    """Return a line for each note, with the names of its metrics; no lines if there are no notes."""
    lines = [f"  {', '.join(names)}: {text}" for text, names in notes.items()]
    return ["Notes", *lines] if lines else []


def shared_by(info: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the partners that share a recording because they have the same plan.

    The partners are in ``info["partners"]`` of recordings that ``h3data evaluate --save-recordings`` writes.
    """
    partners = info.get("partners")
    return tuple(map(str, partners)) if isinstance(partners, list) else ()


def for_each_partner(measured: EpisodeMetrics, info: Mapping[str, Any]) -> list[EpisodeMetrics]:
    """Return the measurement once for each partner that shares its recording, or only itself if no partner shares it."""
    return [replace(measured, partner=partner) for partner in shared_by(info)] or [measured]


@dataclass
class Notes:
    """Collection of notes on metrics, in the order in which they are added."""

    lines: dict[str, list[str]] = field(default_factory=dict)

    def add(self, names: Iterable[str], text: str) -> None:
        """Add ``text`` to each of these metrics."""
        for name in names:
            self.lines.setdefault(name, []).append(text)

    def joined(self, names: Iterable[str]) -> dict[str, str]:
        """Return the notes as one text for each metric that has some."""
        return {name: "; ".join(self.lines[name]) for name in names if name in self.lines}


def first_moments(series: Mapping[str, NDArray[Any]], flags: Iterable[str]) -> dict[str, int]:
    """Return the first row in which each of these flags [T] holds; flags that are absent or never hold are left out."""
    # asked first whether any row holds: of none, argmax is row 0
    return {name: int(np.argmax(series[name])) for name in flags if name in series and series[name].any()}
