"""Commands ``h3data study``: studies with people, from the study file to the report."""

from __future__ import annotations

from h3data.commands.command import Group
from h3data_studies.commands.bots import StudyBots
from h3data_studies.commands.fitting import StudyFit
from h3data_studies.commands.handing_out import StudyData, StudyPay
from h3data_studies.commands.managing import StudyForget, StudyStatus
from h3data_studies.commands.reporting import StudyCompare, StudyReport
from h3data_studies.commands.running import StudyNew, StudyRun

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
