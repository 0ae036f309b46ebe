"""What an episode was worth: task metrics of recordings, from their columns alone."""

from h3data.metrics.batch import measure_files
from h3data.metrics.differences import Differences, compare_runs, compare_tables
from h3data.metrics.explaining import explain, explain_episode, list_metrics
from h3data.metrics.metric import EpisodeMetrics, Metric, MissingColumnsError, find_agents
from h3data.metrics.power import Power, simulate_power, simulate_study
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
from h3data.metrics.study import (
    Block,
    Session,
    anonymous_id,
    latin_square,
    plan_sessions,
    read_session,
    study_rows,
    write_sessions,
)
from h3data.metrics.table import MetricsTable, Summary, measure_many, tabulate
from h3data.metrics.table_files import events_of, write_events, write_series, write_table

__all__ = [
    "PROFILES",
    "Block",
    "Differences",
    "EpisodeMetrics",
    "Metric",
    "MetricsTable",
    "MissingColumnsError",
    "Power",
    "Profile",
    "Session",
    "Summary",
    "all_metrics",
    "anonymous_id",
    "compare_runs",
    "compare_tables",
    "events_of",
    "explain",
    "explain_episode",
    "find_agents",
    "find_metric",
    "find_profile",
    "latin_square",
    "list_metrics",
    "measure",
    "measure_files",
    "measure_many",
    "metrics_of",
    "plan_sessions",
    "read_session",
    "series_of",
    "simulate_power",
    "simulate_study",
    "study_rows",
    "tabulate",
    "write_events",
    "write_series",
    "write_sessions",
    "write_table",
]
