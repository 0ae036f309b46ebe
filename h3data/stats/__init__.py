"""Statistics for studies and comparisons of runs: arrays in, numbers out.

Knows neither recordings nor metrics. Everything random is seeded, and NaN stands for an undefined value.

================= ======================================================================================================
intervals         `wilson_interval` (rates), `bootstrap_interval` and `bootstrap_intervals` (means over episodes),
                  `t_interval` and `over_seeds` (means over a few training seeds)
paired tests      `compare_paired`: permutation, Student's t, Wilcoxon, McNemar, with effect sizes
ranks             `rank_agreement`: Kendall's tau and Spearman's rho of two evaluations of the same methods
many tests        `adjust_p_values`: Holm, Bonferroni, Benjamini-Hochberg
mixed models      `fit_glmm`: Poisson and binomial models with crossed random intercepts, as lme4's ``glmer``
after the fit     `marginal_means`, `contrasts` (with `contrasts_text`), `relative_efficiency`, as R's emmeans
================= ======================================================================================================
"""

# Mixed models and marginal means are written out here because no maintained pure-Python package fits them by maximum
# likelihood: pymer4 calls R, statsmodels' PoissonBayesMixedGLM and BinomialBayesMixedGLM approximate a posterior, bambi
# samples one with MCMC, gpboost is a compiled boosting library; and none has emmeans' contrasts. Each file names the
# references that its tests compare with.

from h3data.stats.glmm_design import Family, FixedDesign, SeparationError
from h3data.stats.intervals import (
    SeedSummary,
    bootstrap_interval,
    bootstrap_intervals,
    over_seeds,
    t_interval,
    wilson_interval,
)
from h3data.stats.mixed_models import GlmmFit, fit_glmm
from h3data.stats.multiple_tests import PAdjustment, adjust_p_values
from h3data.stats.paired_tests import PairedComparison, PairedMethod, compare_paired
from h3data.stats.posthoc import (
    Adjustment,
    Contrast,
    MarginalMeans,
    RelativeEfficiency,
    contrasts,
    contrasts_text,
    marginal_means,
    relative_efficiency,
)
from h3data.stats.rank_agreement import RankAgreement, rank_agreement

__all__ = [
    "Adjustment",
    "Contrast",
    "Family",
    "FixedDesign",
    "GlmmFit",
    "MarginalMeans",
    "PAdjustment",
    "PairedComparison",
    "PairedMethod",
    "RankAgreement",
    "RelativeEfficiency",
    "SeedSummary",
    "SeparationError",
    "adjust_p_values",
    "bootstrap_interval",
    "bootstrap_intervals",
    "compare_paired",
    "contrasts",
    "contrasts_text",
    "fit_glmm",
    "marginal_means",
    "over_seeds",
    "rank_agreement",
    "relative_efficiency",
    "t_interval",
    "wilson_interval",
]
