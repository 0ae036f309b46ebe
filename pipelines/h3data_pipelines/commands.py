"""All commands by name, in the order of the first page of help."""

from __future__ import annotations

from h3data_pipelines.bench import Bench
from h3data_pipelines.bodies import BODIES
from h3data_pipelines.command import Command, Group
from h3data_pipelines.converting import Convert
from h3data_pipelines.demo import Demo
from h3data_pipelines.doctor import Doctor
from h3data_pipelines.evaluating import Evaluate
from h3data_pipelines.exporting import Export
from h3data_pipelines.generate import Generate
from h3data_pipelines.importing import Import
from h3data_pipelines.informing import Info
from h3data_pipelines.measuring import Metrics
from h3data_pipelines.motion import MOTION
from h3data_pipelines.recovering import Recover
from h3data_pipelines.replaying import ReplayCommand
from h3data_pipelines.report import ReportCommand
from h3data_pipelines.rerender import Rerender
from h3data_pipelines.robots import ROBOTS
from h3data_pipelines.scenes import SCENES
from h3data_pipelines.sql import Sql
from h3data_pipelines.validating import Validate
from h3data_pipelines.viewing import View

COMMANDS: dict[str, type[Command] | Group] = {
    "demo": Demo,
    "generate": Generate,
    "evaluate": Evaluate,
    "import": Import,
    "export": Export,
    "rerender": Rerender,
    "info": Info,
    "metrics": Metrics,
    "sql": Sql,
    "view": View,
    "report": ReportCommand,
    "scenes": SCENES,
    "bodies": BODIES,
    "motion": MOTION,
    "robots": ROBOTS,
    "replay": ReplayCommand,
    "convert": Convert,
    "validate": Validate,
    "recover": Recover,
    "doctor": Doctor,
    "bench": Bench,
}
