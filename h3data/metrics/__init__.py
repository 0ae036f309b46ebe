"""What an episode was worth: task metrics of recordings, from their columns alone."""

from h3data.metrics.explaining import explain, explain_episode, list_metrics
from h3data.metrics.metric import EpisodeMetrics, Metric, MissingColumnsError, find_agents
from h3data.metrics.registry import (
    PROFILES,
    Profile,
    all_metrics,
    find_metric,
    find_profile,
    measure,
    metrics_of,
    series_of,
)
from h3data.metrics.statistics import bootstrap_interval, t_interval, wilson_interval
from h3data.metrics.table import MetricsTable, Summary, measure_many, tabulate

__all__ = [
    "PROFILES",
    "EpisodeMetrics",
    "Metric",
    "MetricsTable",
    "MissingColumnsError",
    "Profile",
    "Summary",
    "all_metrics",
    "bootstrap_interval",
    "explain",
    "explain_episode",
    "find_agents",
    "find_metric",
    "find_profile",
    "list_metrics",
    "measure",
    "measure_many",
    "metrics_of",
    "series_of",
    "t_interval",
    "tabulate",
    "wilson_interval",
]
