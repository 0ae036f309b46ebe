"""What an episode was worth: task metrics of recordings, from their columns alone."""

from h3data.metrics.registry import PROFILES, Metric, explain, find_metric, metrics_of
from h3data.metrics.social_nav import EpisodeMetrics, find_agents, measure
from h3data.metrics.statistics import bootstrap_interval, t_interval, wilson_interval
from h3data.metrics.table import MetricsTable, Summary, measure_many, tabulate

__all__ = [
    "PROFILES",
    "EpisodeMetrics",
    "Metric",
    "MetricsTable",
    "Summary",
    "bootstrap_interval",
    "explain",
    "find_agents",
    "find_metric",
    "measure",
    "measure_many",
    "metrics_of",
    "t_interval",
    "tabulate",
    "wilson_interval",
]
