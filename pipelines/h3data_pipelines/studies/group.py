"""``h3data study``: studies with people, from the file to the report."""

from __future__ import annotations

from h3data_pipelines.command import Group
from h3data_pipelines.studies.bots import StudyBots
from h3data_pipelines.studies.fitting import StudyFit
from h3data_pipelines.studies.handing_out import StudyData, StudyPay
from h3data_pipelines.studies.managing import StudyForget, StudyStatus
from h3data_pipelines.studies.reporting import StudyCompare, StudyReport
from h3data_pipelines.studies.running import StudyNew, StudyRun

STUDY = Group(
    "Run studies with people in the browser, and analyse them.",
    {
        "new": StudyNew,
        "run": StudyRun,
        "bots": StudyBots,
        "status": StudyStatus,
        "report": StudyReport,
        "compare": StudyCompare,
        "pay": StudyPay,
        "data": StudyData,
        "forget": StudyForget,
        "fit": StudyFit,
    },
)
