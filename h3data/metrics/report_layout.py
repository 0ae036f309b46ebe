"""Layout of a profile's report, declared with its metrics and rendered by `h3data_viewers.html_report`.

Everything has a default, so a profile without a layout gets a table of all its metrics, their distributions,
trajectories, and the best and worst episodes by its first metrics that have a better direction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class PublishedRow:
    """One row of a published table: a policy or a condition."""

    name: str
    policies: tuple[str, ...] = ()
    """Names of the same policy in recordings, in lower case."""
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Values by metric: (mean,), (mean, standard deviation) or (mean, lower end, upper end of the 95% interval)."""
    train: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Published values with the partners of the training population."""
    zsc: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Published values with unseen partners (zero-shot coordination)."""

    def with_partners(self, population: str) -> Mapping[str, tuple[float, ...]]:
        """Return the values with the partners of a population: ``train``, ``zsc``, or empty for all partners."""
        return {"train": self.train, "zsc": self.zsc}.get(population, self.values)


@dataclass(frozen=True, kw_only=True)
class PublishedTable:
    """A table of a paper, for comparison with measured values."""

    paper: str
    """Short name of the paper: ``Habitat 3.0``."""
    source: str
    """Paper, section and number of the table."""
    rows: tuple[PublishedRow, ...]

    def row_of(self, policy: str) -> PublishedRow | None:
        """Return the row of a policy, or None if there is none."""
        return next((row for row in self.rows if policy.lower() in row.policies), None)


@dataclass(frozen=True, kw_only=True)
class PublishedContrast:
    """Published difference between two conditions."""

    name: str
    difference: float
    p: str
    """The p-value as printed."""


@dataclass(frozen=True, kw_only=True)
class PublishedContrasts:
    """Published table of differences between pairs of conditions."""

    paper: str
    source: str
    rows: tuple[PublishedContrast, ...]


@dataclass(frozen=True, kw_only=True)
class Milestone:
    """An event of an episode, for key frames and for charts of the share of episodes that have reached it."""

    flag: str
    """Flag of the profile's series; the milestone is its first row."""
    title: str
    """Title of the chart, such as ``Person found by then``."""
    label: str
    """Caption of the key frame, such as ``finds the person``."""
    metric: str
    """Metric that is undefined if a recording does not determine the event; such episodes are left out of the chart."""


StepsModel = Literal["auto", "poisson", "observation"]
"""Statistical model of the number of steps in a study, described in `h3data_studies.analysis.StudyModel`."""
FailedEpisodes = Literal["leave-out", "limit"]
"""Treatment of episodes of a study without success: left out of the steps, or counted as the longest duration."""


@dataclass(frozen=True, kw_only=True)
class StudyLayout:
    """Analysis of the episodes of participants under several conditions (info ``participant``, ``condition``)."""

    columns: tuple[str, ...]
    """Metrics of the table: 0/1 metrics by a binomial mixed model, others by their bootstrapped mean."""
    steps: str = ""
    """Count metric for the Poisson mixed model, whose estimated means are contrasted; empty: the first 0/1 metric is
    contrasted."""
    efficiency: str = ""
    """Metric whose value follows from the means of ``steps``: steps alone over steps with the robot, in percent."""
    published: Callable[[], PublishedTable] | None = None
    published_contrasts: Callable[[], PublishedContrasts] | None = None


@dataclass(frozen=True, kw_only=True)
class ReportLayout:
    """Sections, columns and wording of a report on one profile; metrics are given by name."""

    title: str = ""
    """Heading of the profile's sections (default: the name of the task)."""
    columns: tuple[str, ...] = ()
    """Metrics of the main table (default: all)."""
    percent: tuple[str, ...] = ()
    """Ratios that the main table shows in percent, as the published table does."""
    findings: Mapping[str, str] = field(default_factory=dict)
    """Text before the value of a metric in the summary: ``{"S": "finds the person in"}`` (default: its title)."""
    ranking: tuple[str, ...] = ()
    """Metrics that rank episodes, most important first (default: the first three with a better direction)."""
    by_partner: tuple[str, ...] = ()
    """Metrics shown as heat maps of policies by partners (default: those of ``ranking``)."""
    milestones: tuple[Milestone, ...] = ()
    distance_zone_m: tuple[float, float] | None = None
    """Range of distances that is shaded in charts of robot and person [m]."""
    published: Callable[[], PublishedTable] | None = None
    """Function that loads the published results for these metrics."""
    study: StudyLayout | None = None
