"""Statistics of studies with people, which map arrays to numbers.

The package does not depend on recordings or metrics. All random numbers are seeded, and NaN stands for an undefined
value.

================= ======================================================================================================
mixed models `fit_glmm`: Poisson and binomial models with crossed random intercepts, as lme4's ``glmer`` after the fit
`marginal_means`, `contrasts` (with `contrasts_text`), `relative_efficiency`, as R's emmeans ranks `rank_agreement`:
Kendall's tau and Spearman's rho of two evaluations of the same methods =================
======================================================================================================
"""

# Mixed models and marginal means are written out here because no maintained pure-Python package fits them by maximum
# likelihood: pymer4 calls R, statsmodels' PoissonBayesMixedGLM and BinomialBayesMixedGLM approximate a posterior, bambi
# samples one with MCMC, gpboost is a compiled boosting library; and none has emmeans' contrasts. Each file names the
# references that its tests compare with.

from h3data_studies.statistics.glmm_design import Family, FixedDesign, SeparationError
from h3data_studies.statistics.mixed_models import GlmmFit, fit_glmm
from h3data_studies.statistics.posthoc import (
    Adjustment,
    Contrast,
    MarginalMeans,
    RelativeEfficiency,
    contrasts,
    contrasts_text,
    marginal_means,
    relative_efficiency,
)
from h3data_studies.statistics.rank_agreement import RankAgreement, rank_agreement

__all__ = [
    "Adjustment",
    "Contrast",
    "Family",
    "FixedDesign",
    "GlmmFit",
    "MarginalMeans",
    "RankAgreement",
    "RelativeEfficiency",
    "SeparationError",
    "contrasts",
    "contrasts_text",
    "fit_glmm",
    "marginal_means",
    "rank_agreement",
    "relative_efficiency",
]
