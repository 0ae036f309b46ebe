"""Planning of a study with people, its statistical power, and the estimated means of its conditions with contrasts.

`tables` and `ranks` provide the study sections of ``h3data report``.
"""

from h3data_studies.analysis.estimates import Estimate, FittedMeans, StudyAnalysis, StudyModel, analyse_study
from h3data_studies.analysis.planning import (
    Block,
    Session,
    latin_square,
    plan_sessions,
    read_session,
    study_rows,
    write_sessions,
)
from h3data_studies.analysis.power import Power, simulate_power, simulate_study

__all__ = [
    "Block",
    "Estimate",
    "FittedMeans",
    "Power",
    "Session",
    "StudyAnalysis",
    "StudyModel",
    "analyse_study",
    "latin_square",
    "plan_sessions",
    "read_session",
    "simulate_power",
    "simulate_study",
    "study_rows",
    "write_sessions",
]
