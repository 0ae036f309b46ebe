"""What an episode was worth: task metrics of recordings, from their columns alone."""

from h3data.metrics.batch import measure_files
from h3data.metrics.differences import Differences, compare_tables
from h3data.metrics.explaining import explain, explain_episode, list_metrics
from h3data.metrics.metric import EpisodeMetrics, Metric, MissingColumnsError, find_agents
from h3data.metrics.mixed_models import GlmmFit, fit_glmm
from h3data.metrics.paired import PairedComparison, compare_paired, compare_runs
from h3data.metrics.posthoc import (
    Contrast,
    MarginalMeans,
    RelativeEfficiency,
    contrasts,
    contrasts_text,
    marginal_means,
    relative_efficiency,
)
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
from h3data.metrics.statistics import (
    SeedSummary,
    adjust_p_values,
    bootstrap_interval,
    over_seeds,
    t_interval,
    wilson_interval,
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
    "Contrast",
    "Differences",
    "EpisodeMetrics",
    "GlmmFit",
    "MarginalMeans",
    "Metric",
    "MetricsTable",
    "MissingColumnsError",
    "PairedComparison",
    "Power",
    "Profile",
    "RelativeEfficiency",
    "SeedSummary",
    "Session",
    "Summary",
    "adjust_p_values",
    "all_metrics",
    "anonymous_id",
    "bootstrap_interval",
    "compare_paired",
    "compare_runs",
    "compare_tables",
    "contrasts",
    "contrasts_text",
    "events_of",
    "explain",
    "explain_episode",
    "find_agents",
    "find_metric",
    "find_profile",
    "fit_glmm",
    "latin_square",
    "list_metrics",
    "marginal_means",
    "measure",
    "measure_files",
    "measure_many",
    "metrics_of",
    "over_seeds",
    "plan_sessions",
    "read_session",
    "relative_efficiency",
    "series_of",
    "simulate_power",
    "simulate_study",
    "study_rows",
    "t_interval",
    "tabulate",
    "wilson_interval",
    "write_events",
    "write_series",
    "write_sessions",
    "write_table",
]
