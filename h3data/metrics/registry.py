"""Which profiles there are, and how a recording finds its metrics.

A profile is one way to define the metrics of a task: `paper` (as published), `habitat` and `habitat@0.3.0` (as that
code computes them), `field` (what social navigation papers report), `partnr`. A profile may hold metrics of several
tasks; the task of the recording decides.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from dataclasses import dataclass

from h3data.errors import InputError, did_you_mean
from h3data.metrics.metric import EpisodeMetrics, Metric, Series
from h3data.recording.records import Recording

REARRANGE_TASKS = ("rearrange", "social_rearrange", "rearrangement")
"""Values of `Episode.task` that mean rearrangement; all others are social navigation to profiles that know both."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """The metrics of one task by one definition. Their module is imported at first use."""

    name: str
    task: str
    """``social_nav``, ``rearrange``, or ``any``."""
    title: str
    module: str
    """Module of `h3data.metrics` with ``<prefix>_metrics``, ``measure_<prefix>`` and ``<prefix>_series``."""
    prefix: str
    variant: str = ""
    """Passed on to the module's functions, if it tells two profiles apart."""

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """Its metrics, in the order of tables."""
        return self._call("{}_metrics")

    def measure(self, recording: Recording) -> EpisodeMetrics:
        """All its metrics of one recording."""
        return self._call("measure_{}", recording)

    def series(self, recording: Recording) -> Series:
        """The per-row quantities and flags [T] that its metrics come from."""
        return self._call("{}_series", recording)

    def _call(self, pattern: str, *arguments: Recording):
        function = getattr(importlib.import_module(f"h3data.metrics.{self.module}"), pattern.format(self.prefix))
        return function(*arguments, **({"variant": self.variant} if self.variant else {}))


_ALL = (
    Profile(
        name="paper",
        task="social_nav",
        title="Habitat 3.0 as published: social navigation",
        module="paper.social_nav",
        prefix="social_nav",
    ),
    Profile(
        name="paper",
        task="rearrange",
        title="Habitat 3.0 as published: social rearrangement",
        module="paper.rearrangement",
        prefix="rearrangement",
    ),
    Profile(
        name="habitat",
        task="social_nav",
        title="habitat-lab's main branch, bug for bug",
        module="habitat.measures",
        prefix="habitat",
        variant="habitat",
    ),
    Profile(
        name="habitat@0.3.0",
        task="social_nav",
        title="habitat-lab 0.3.0, the paper's release, where it differs",
        module="habitat.measures",
        prefix="habitat",
        variant="habitat@0.3.0",
    ),
    Profile(
        name="field",
        task="any",
        title="what papers on social navigation report: proxemics, efficiency, smoothness",
        module="field.measures",
        prefix="field",
    ),
    Profile(
        name="partnr",
        task="any",
        title="PARTNR's measures of people and robots tidying up together",
        module="partnr",
        prefix="partnr",
    ),
)
PROFILES: dict[str, tuple[Profile, ...]] = {
    name: tuple(p for p in _ALL if p.name == name) for name in dict.fromkeys(p.name for p in _ALL)
}


def find_profile(name: str, task: str = "social_nav") -> Profile:
    """The profile of this name for recordings of a task; an `InputError` names the profiles there are."""
    if name not in PROFILES:
        raise InputError(
            f"No metrics profile {name!r}.{did_you_mean(name, PROFILES)} Available: {', '.join(PROFILES)}."
        )
    kind = "rearrange" if task in REARRANGE_TASKS else "social_nav"
    for profile in PROFILES[name]:
        if profile.task in ("any", kind):
            return profile
    raise InputError(
        f"Profile {name!r} has no metrics of {kind}. Use one of: "
        f"{', '.join(p.name for p in _ALL if p.task in ('any', kind))}."
    )


def metrics_of(profile: str, task: str = "social_nav") -> tuple[Metric, ...]:
    """All metrics of a profile for a task."""
    return find_profile(profile, task).metrics


def find_metric(name: str, *, profile: str = "paper") -> Metric:
    """The metric with this id or short name (``S``, ``paper/social_nav/S``, ``paper/social_nav/S@1``).

    A short name that several profiles have is that of ``profile``, else of the first that has it.
    """
    every = sorted(all_metrics(), key=lambda m: m.profile != profile)
    tests = (
        lambda m: name in (m.id, m.id.rpartition("@")[0]),
        lambda m: name == m.name,
        lambda m: name.lower() == m.name.lower(),
    )
    for test in tests:
        for metric in every:
            if test(metric):
                return metric
    near = did_you_mean(name, [m.name for m in every] + [m.id.rpartition("@")[0] for m in every])
    raise InputError(f"No metric {name!r}.{near} `h3data metrics list` shows all: {', '.join(m.id for m in every)}.")


def all_metrics() -> list[Metric]:
    """Every metric of every profile."""
    return [metric for profile in _ALL for metric in profile.metrics]


def measure(recording: Recording, profile: str = "paper") -> EpisodeMetrics:
    """Metrics of one recording, between its first robot and its first human. Reads only columns, never a simulator.

    Raises:
        InputError: no such profile, or it needs agents that the recording does not have.
        MissingColumnsError: the recording lacks what every metric of the profile needs.
    """
    return find_profile(profile, recording.episode.task).measure(recording)


def series_of(recording: Recording, profile: str = "paper") -> Series:
    """Per-row quantities and flags [T] that the metrics of a profile come from, by name."""
    return find_profile(profile, recording.episode.task).series(recording)


def one_task(episodes: Iterable[EpisodeMetrics]) -> str:
    """The task that all episodes of a table share; ``social_nav`` if there are none."""
    tasks = sorted({e.task for e in episodes})
    if len(tasks) > 1:
        raise InputError(f"Episodes of different tasks cannot share a table: {', '.join(tasks)}. Measure them apart.")
    return tasks[0] if tasks else "social_nav"
