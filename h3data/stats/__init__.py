"""Statistics for comparing runs, computed from plain arrays.

The functions do not depend on recordings or metrics. Random methods are seeded, and NaN stands for an undefined value.
Mixed models and the other statistics of studies with people are in `h3data_studies.statistics`.

================= ======================================================================================================
intervals         `wilson_interval` (rates), `bootstrap_interval` and `bootstrap_intervals` (means over episodes),
                  `t_interval` and `over_seeds` (means over a few training seeds)
paired tests      `compare_paired`: permutation, Student's t, Wilcoxon, McNemar, with effect sizes
many tests        `adjust_p_values`: Holm, Bonferroni, Benjamini-Hochberg
================= ======================================================================================================
"""

from h3data.stats.intervals import (
    SeedSummary,
    bootstrap_interval,
    bootstrap_intervals,
    over_seeds,
    t_interval,
    wilson_interval,
)
from h3data.stats.multiple_tests import PAdjustment, adjust_p_values
from h3data.stats.paired_tests import PairedComparison, PairedMethod, compare_paired

__all__ = [
    "PAdjustment",
    "PairedComparison",
    "PairedMethod",
    "SeedSummary",
    "adjust_p_values",
    "bootstrap_interval",
    "bootstrap_intervals",
    "compare_paired",
    "over_seeds",
    "t_interval",
    "wilson_interval",
]
