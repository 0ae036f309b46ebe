"""Task metrics of recordings, from their columns alone: profiles, tables, comparisons of runs."""

from h3data.metrics.batch import measure_files, measure_tables
from h3data.metrics.differences import Differences, compare_runs, compare_tables
from h3data.metrics.episode import EpisodeMetrics
from h3data.metrics.metric import Metric
from h3data.metrics.profile import Computed, Profile
from h3data.metrics.registry import (
    PROFILES,
    all_metrics,
    all_profiles,
    find_metric,
    find_profile,
    measure,
    metrics_of,
    profiles_named,
    series_of,
)
from h3data.metrics.report_layout import Milestone, PublishedRow, PublishedTable, ReportLayout
from h3data.metrics.requirements import MissingColumnsError, UnmeasurableError, find_agents
from h3data.metrics.table import MetricsTable, Summary, measure_many, tabulate
from h3data.pseudonyms import anonymous_id

__all__ = [
    "PROFILES",
    "Computed",
    "Differences",
    "EpisodeMetrics",
    "Metric",
    "MetricsTable",
    "Milestone",
    "MissingColumnsError",
    "Profile",
    "PublishedRow",
    "PublishedTable",
    "ReportLayout",
    "Summary",
    "UnmeasurableError",
    "all_metrics",
    "all_profiles",
    "anonymous_id",
    "compare_runs",
    "compare_tables",
    "find_agents",
    "find_metric",
    "find_profile",
    "measure",
    "measure_files",
    "measure_many",
    "measure_tables",
    "metrics_of",
    "profiles_named",
    "series_of",
    "tabulate",
]
