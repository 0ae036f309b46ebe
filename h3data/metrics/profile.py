"""Profiles: definitions of the metrics of some tasks, with the functions that compute them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from h3data.errors import InputError
from h3data.metrics.episode import EpisodeMetrics, Notes, first_moments
from h3data.metrics.metric import NAN, Metric, Series
from h3data.metrics.report_layout import ReportLayout
from h3data.metrics.requirements import UnmeasurableError, note_missing, require_whole
from h3data.recording.records import Recording

GFX_REPLAY = "gfx_replay"
"""Value of `Episode.task` for imported gfx-replays, which do not state their task. A profile that lists it measures
them."""


@dataclass(frozen=True, kw_only=True)
class Computed:
    """Values that a profile computes for one recording."""

    values: Mapping[str, float]
    """Values by metric name; metrics left out are undefined."""
    robot: int = -1
    """Index of the robot that was measured; -1 = none in particular."""
    human: int = -1
    moments: Mapping[str, int] = field(default_factory=dict)
    """Steps of notable events by name (`EpisodeMetrics.moments`)."""
    protocol_deviations: str = ""


def _no_series(_recording: Recording) -> Series:
    return {}


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Set of metric definitions for some tasks.

    Example::

        def grasped(recording):
            return float((recording.columns["agent_0.grasp_body"] >= 0).any())

        PROFILE = Profile(
            name="fetch",
            title="Fetching a cup",
            tasks=("fetch",),
            metrics=(
                Metric(
                    id="fetch/fetch/grasped@1",
                    name="grasped",
                    title="Cup grasped",
                    formula="1 if the robot holds something in any row, else 0",
                    columns=("agent_<robot>.grasp_body",),
                    binary=True,
                    value=grasped,
                ),
            ),
        )
    """

    name: str
    """Name of the profile, such as ``paper``: the first part of the ids of its metrics."""
    title: str
    """Title of the profile, one line for lists."""
    metrics: tuple[Metric, ...]
    """Metrics of the profile, in the order of tables."""
    tasks: tuple[str, ...] = ()
    """Values of `Episode.task` that the profile measures, its own name of the task first; empty = any task."""
    compute: Callable[[Recording, Notes], Computed] | None = None
    """Function that computes all metrics of a recording together and adds notes; None if each metric has a
    `Metric.value`."""
    compute_many: Callable[[Sequence[Recording], Sequence[Notes]], Sequence[Computed]] | None = None
    """Function that computes the metrics of several recordings at once, instead of `compute`: on one episode, NumPy's
    calls take longer than the arithmetic."""
    series: Callable[[Recording], Series] = _no_series
    """Function that computes the per-row quantities and flags [T] behind the metrics."""
    report: ReportLayout = field(default_factory=ReportLayout)
    beside: str = ""
    """Key of `Episode.info`. Reports also measure recordings that have this key by this profile, in a separate
    table."""

    def __post_init__(self) -> None:
        wrong = [m.id for m in self.metrics if m.profile != self.name]
        alone = self.compute is None and self.compute_many is None
        without = [m.name for m in self.metrics if alone and m.value is None]
        if not self.metrics:
            raise InputError(f"Profile {self.name!r} has no metrics.", code="H3-METRIC-019")
        if wrong:
            raise InputError(
                f"Expected ids that begin with {self.name}/ in profile {self.name!r}, got {wrong[0]!r}.",
                code="H3-METRIC-020",
            )
        if without:
            raise InputError(
                f"Profile {self.name!r} has no function for {', '.join(without)}: give each metric a value=, "
                "or the profile a compute= or compute_many=.",
                code="H3-METRIC-021",
            )

    def measures(self, task: str) -> bool:
        """Return whether the profile measures recordings of a task."""
        return not self.tasks or task in self.tasks

    def measure(self, recording: Recording) -> EpisodeMetrics:
        """Compute all metrics of the profile for one recording.

        Raises:
            UnmeasurableError: the recording lacks agents, what every metric needs, or its last row.
        """
        require_whole(recording)
        notes = Notes()
        return self._measured(recording, notes, self._computed(recording, notes))

    def measure_many(self, recordings: Sequence[Recording]) -> list[EpisodeMetrics | UnmeasurableError]:
        """Compute all metrics of the profile for several recordings.

        A recording that cannot be measured gets the reason instead.
        """
        if self.compute_many is not None:
            notes = [Notes() for _ in recordings]
            with suppress(UnmeasurableError):  # one of them is enough: each by itself, to tell which
                for recording in recordings:
                    require_whole(recording)
                computed = self.compute_many(recordings, notes)
                return [self._measured(*each) for each in zip(recordings, notes, computed, strict=True)]
        measured: list[EpisodeMetrics | UnmeasurableError] = []
        for recording in recordings:
            try:
                measured.append(self.measure(recording))
            except UnmeasurableError as error:
                measured.append(error)
        return measured

    def _computed(self, recording: Recording, notes: Notes) -> Computed:
        if self.compute_many is not None:
            return self.compute_many([recording], [notes])[0]
        return self._each(recording, notes) if self.compute is None else self.compute(recording, notes)

    def _measured(self, recording: Recording, notes: Notes, computed: Computed) -> EpisodeMetrics:
        names = [m.name for m in self.metrics]
        episode = recording.episode
        # info is whatever the writer of the file put there, such as True or a text
        limit = episode.info.get("max_steps")
        return EpisodeMetrics(
            episode_id=episode.episode_id,
            uid=episode.uid,
            profile=self.name,
            metrics=self.metrics,
            # every metric has a value, so that rows of a table fit each other
            values={name: float(computed.values.get(name, NAN)) for name in names},
            notes=notes.joined(names),
            robot=computed.robot,
            human=computed.human,
            moments=computed.moments,
            rows=len(recording),
            task=self.tasks[0] if self.tasks else episode.task,
            task_is_assumed=bool(self.tasks) and episode.task == GFX_REPLAY,
            scene=episode.scene,
            dt_ns=episode.dt_ns,
            units=str(episode.info.get("units", "SI")),
            protocol_deviations=computed.protocol_deviations,
            participant=str(episode.info.get("participant") or ""),
            condition=str(episode.info.get("condition") or ""),
            policy=str(episode.info.get("policy") or ""),
            partner=str(episode.info.get("partner") or ""),
            max_steps=limit if type(limit) is int and limit > 0 else len(recording),
        )

    def _each(self, recording: Recording, notes: Notes) -> Computed:
        missing = note_missing(self.metrics, recording, notes)
        if not len(recording):
            notes.add((m.name for m in self.metrics if m.name not in missing), "the recording has no rows")
            return Computed(values={})
        values = {m.name: m.value(recording) for m in self.metrics if m.value and m.name not in missing}
        # series are computed only where a report shows when something happened
        flags = [milestone.flag for milestone in self.report.milestones]
        return Computed(values=values, moments=first_moments(self.series(recording), flags) if flags else {})
