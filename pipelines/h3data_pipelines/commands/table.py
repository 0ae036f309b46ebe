"""All commands by name, in the order in which help lists them."""

from __future__ import annotations

from h3data.commands.command import Command, Group
from h3data.plugins import Registry
from h3data_pipelines.assets.bodies import BODIES
from h3data_pipelines.assets.robots import ROBOTS
from h3data_pipelines.assets.scenes import SCENES
from h3data_pipelines.commands.benchmarking import BENCHMARK
from h3data_pipelines.commands.converting import Convert
from h3data_pipelines.commands.demo import Demo
from h3data_pipelines.commands.evaluating import Evaluate
from h3data_pipelines.commands.exporting import Export
from h3data_pipelines.commands.generate import Generate
from h3data_pipelines.commands.importing import Import
from h3data_pipelines.commands.informing import Info
from h3data_pipelines.commands.measuring import Metrics
from h3data_pipelines.commands.recovering import Recover
from h3data_pipelines.commands.replaying import ReplayCommand
from h3data_pipelines.commands.sql import Sql
from h3data_pipelines.commands.validating import Validate
from h3data_pipelines.hub.card import Card
from h3data_pipelines.hub.pulling import Pull
from h3data_pipelines.hub.pushing import Push
from h3data_pipelines.hub.syncing import Sync
from h3data_pipelines.machine.bench import Bench
from h3data_pipelines.machine.caches import CACHE
from h3data_pipelines.machine.completion import Completion
from h3data_pipelines.machine.doctor import Doctor
from h3data_pipelines.machine.pages import Docs
from h3data_pipelines.machine.planning import Plan
from h3data_pipelines.machine.warmup import Warmup
from h3data_pipelines.pictures.rerender import Rerender

TABLE: dict[str, type[Command] | Group | None] = {
    "demo": Demo,
    "generate": Generate,
    "evaluate": Evaluate,
    "benchmark": BENCHMARK,
    "train": None,
    "play": None,
    "serve": None,
    "language": None,
    "llm": None,
    "import": Import,
    "export": Export,
    "rerender": Rerender,
    "info": Info,
    "metrics": Metrics,
    "sql": Sql,
    "view": None,
    "report": None,
    "study": None,
    "scenes": SCENES,
    "bodies": BODIES,
    "motion": None,
    "robots": ROBOTS,
    "replay": ReplayCommand,
    "convert": Convert,
    "card": Card,
    "push": Push,
    "pull": Pull,
    "sync": Sync,
    "validate": Validate,
    "recover": Recover,
    "docs": Docs,
    "doctor": Doctor,
    "cache": CACHE,
    "warmup": Warmup,
    "bench": Bench,
    "plan": Plan,
    "completion": Completion,
}
"""Commands in the order in which help lists them. None stands for a command that another package registers. All other
commands follow in alphabetical order.
"""
REGISTRY: Registry[type[Command] | Group] = Registry(
    "h3data.commands", {name: command for name, command in TABLE.items() if command is not None}, what="command"
)


def all_commands() -> dict[str, type[Command] | Group]:
    """Return every command by name, including those that installed packages register in ``h3data.commands``."""
    found = REGISTRY.load_all()
    listed = (*(name for name in TABLE if name in found), *sorted(found.keys() - TABLE.keys()))
    Completion.commands = commands = {name: found[name] for name in listed}
    return commands
