"""What a metric is, what measuring one episode gives, and how a metric says that something is missing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.metrics.set_up import set_up_differences
from h3data.recording.records import STEP_NS, Recording

Direction = Literal["higher", "lower", "neither"]
NAN = float("nan")
INF = float("inf")
Series = Mapping[str, NDArray[Any]]
"""Per-row arrays [T] by name: flags (bool) or quantities (float64)."""


class MissingColumnsError(InputError):
    """A recording lacks what the metrics that were asked for read; the message says which metric needs which."""

    def __init__(self, episode_id: str, needs: Mapping[str, Sequence[str]]) -> None:
        self.needs = {name: tuple(columns) for name, columns in needs.items()}
        """Metric name to what it lacks."""
        each = "; ".join(f"{name} needs {', '.join(columns)}" for name, columns in self.needs.items())
        super().__init__(f"Episode {episode_id!r} has nothing to measure: {each}.")


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One metric of one profile."""

    id: str
    """``profile/task/name@version``; a change of meaning gets a new version."""
    name: str
    """Key in results: ``S``."""
    title: str
    formula: str
    unit: str
    """``1`` for ratios and flags."""
    range: tuple[float, float]
    direction: Direction
    """Which way is better; ``neither`` if its source names none."""
    source: str
    columns: tuple[str, ...]
    """What it reads. ``<robot>`` and ``<human>`` are agent numbers, ``<i>`` is every agent; ``info:<key>`` is a key of
    `Episode.info`, ``events:<kind>`` a kind of event."""
    optional: tuple[str, ...] = ()
    """What it reads if it is there; a note says what is used instead."""
    undefined: str = ""
    """In which episodes it has no value."""
    series: tuple[str, ...] = ()
    """Per-row series of its profile that decide it."""
    binary: bool = False
    """0 or 1 per episode: its mean is a proportion and gets a Wilson interval."""
    reading: str = ""
    """How points that the source leaves open are read here."""
    habitat: str = ""
    """Where Habitat's code computes something else (spec/habitat.md 1.6)."""

    @property
    def profile(self) -> str:
        """Which definition it follows: ``paper``."""
        return self.id.split("/")[0]

    @property
    def task(self) -> str:
        """Which task it belongs to: ``social_nav``."""
        return self.id.split("/")[1]


@dataclass(frozen=True, kw_only=True)
class EpisodeMetrics:
    """The metrics of one episode."""

    episode_id: str
    uid: str
    profile: str
    values: Mapping[str, float]
    """By metric name; NaN = this recording cannot tell, see ``notes``."""
    notes: Mapping[str, str]
    """By metric name: why it is undefined, or what was used in place of missing data."""
    robot: int = -1
    """Index of the robot that was measured; -1 = none in particular."""
    human: int = -1
    """Index of the human that was measured; -1 = none in particular."""
    encounter_row: int = -1
    """Row in which the robot first found the human; -1 = never, or not looked for."""
    contact_row: int = -1
    """Row of the first robot-human contact; -1 = none known."""
    rows: int
    task: str = "social_nav"
    """Whose metrics: ``social_nav``, ``rearrange`` or ``any``."""
    scene: str = ""
    dt_ns: int = STEP_NS
    """Nominal step of the recording."""
    units: str = "SI"
    """``info:units`` of the recording."""
    set_up: str = ""
    """Of the profile ``paper``: in what the rules of the episode differ from the paper's."""

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON types; NaN and infinities become None."""
        return {
            "episode_id": self.episode_id,
            "uid": self.uid,
            "profile": self.profile,
            "scene": self.scene,
            "steps": self.rows,
            "robot": self.robot,
            "human": self.human,
            "encounter_row": self.encounter_row,
            "contact_row": self.contact_row,
            "values": {k: float(v) if np.isfinite(v) else None for k, v in self.values.items()},
            "notes": dict(self.notes),
            "set_up": self.set_up,
        }


@dataclass
class Notes:
    """Collects notes per metric, in order."""

    lines: dict[str, list[str]] = field(default_factory=dict)

    def add(self, names: Iterable[str], text: str) -> None:
        """Say ``text`` about each of these metrics."""
        for name in names:
            self.lines.setdefault(name, []).append(text)

    def joined(self, names: Iterable[str]) -> dict[str, str]:
        """One text per metric that has something to say."""
        return {name: "; ".join(self.lines[name]) for name in names if name in self.lines}


def episode_metrics(
    recording: Recording,
    metrics: Sequence[Metric],
    values: Mapping[str, float],
    notes: Notes,
    *,
    robot: int = -1,
    human: int = -1,
    encounter_row: int = -1,
    contact_row: int = -1,
) -> EpisodeMetrics:
    """The values of ``metrics`` in their order, with what the recording says about itself."""
    names = [m.name for m in metrics]
    episode = recording.episode
    return EpisodeMetrics(
        episode_id=episode.episode_id,
        uid=episode.uid,
        profile=metrics[0].profile,
        values={name: float(values[name]) for name in names},
        notes=notes.joined(names),
        robot=robot,
        human=human,
        encounter_row=encounter_row,
        contact_row=contact_row,
        rows=len(recording),
        task=metrics[0].task,
        scene=episode.scene,
        dt_ns=episode.dt_ns,
        units=str(episode.info.get("units", "SI")),
        set_up=set_up_differences(recording) if metrics[0].profile == "paper" else "",
    )


def find_agents(recording: Recording) -> tuple[int, int]:
    """Indices of the first robot and the first human; an `InputError` says who was found instead."""
    agents = recording.agents
    chosen = [next((i for i, a in enumerate(agents) if a.kind == kind), None) for kind in ("robot", "human")]
    robot, human = chosen
    if robot is not None and human is not None:
        return robot, human
    missing = " and ".join(f"no {kind}" for kind, i in zip(("robot", "human"), chosen, strict=True) if i is None)
    there = ", ".join(f"{a.name} ({a.kind})" for a in agents) or "no agents at all"
    raise InputError(
        f"These metrics need a robot and a human; recording {recording.episode.episode_id!r} has {missing} "
        f"(found: {there})." + (" Hint: the profile field measures any two agents." if len(agents) > 1 else "")
    )


def find_pair(recording: Recording) -> tuple[int, int]:
    """Indices of two agents of any kinds: the first robot and the first human, else the first two. The first of them is
    measured, near the second; an `InputError` says that there are not two."""
    agents = recording.agents
    if {"robot", "human"} <= {a.kind for a in agents}:
        return find_agents(recording)
    if len(agents) < 2:
        there = ", ".join(f"{a.name} ({a.kind})" for a in agents) or "nobody"
        raise InputError(f"These metrics need two agents; recording {recording.episode.episode_id!r} has {there}.")
    return 0, 1


def missing_columns(metric: Metric, recording: Recording) -> tuple[str, ...]:
    """Which of the things that a metric needs a recording does not have."""
    return tuple(name for name in metric.columns if not _has(recording, name))


def note_missing(metrics: Sequence[Metric], recording: Recording, notes: Notes) -> set[str]:
    """Names of the metrics that lack something, each with a note; if all do, a `MissingColumnsError`."""
    needs = {m.name: missing for m in metrics if (missing := missing_columns(m, recording))}
    if len(needs) == len(metrics):
        raise MissingColumnsError(recording.episode.episode_id, needs)
    for name, missing in needs.items():
        notes.add([name], f"needs {', '.join(missing)}, which this recording does not have")
    return set(needs)


def stored_columns(metrics: Iterable[Metric], agents: int) -> list[str]:
    """Columns that these metrics may read in recordings of up to ``agents`` agents."""
    names: dict[str, None] = {}
    for metric in metrics:
        for name in (*metric.columns, *metric.optional):
            if ":" in name:
                continue
            head, _, rest = name.partition(">.")
            each = [f"agent_{i}.{rest}" for i in range(agents)] if head.startswith("agent_<") else [name]
            names.update(dict.fromkeys(each))
    return list(names)


def _has(recording: Recording, name: str) -> bool:
    kind, colon, key = name.partition(":")
    if colon and kind == "info":
        return recording.episode.info.get(key) is not None
    if colon:
        return any(event.kind == key for event in recording.events)
    head, _, rest = name.partition(">.")
    if head.startswith("agent_<"):
        return any(f"agent_{i}.{rest}" in recording.columns for i in range(len(recording.agents)))
    return name in recording.columns
