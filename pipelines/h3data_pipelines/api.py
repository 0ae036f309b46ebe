"""Python functions that run jobs, such as ``h3data.generate`` and ``h3data.evaluate``, and return objects.

Each function is imported at first use, from the module of its command.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.moved import lazy_names

if TYPE_CHECKING:
    from h3data_pipelines.commands.benchmarking import run_benchmark as run_benchmark
    from h3data_pipelines.commands.benchmarking import verify_benchmark as verify_benchmark
    from h3data_pipelines.commands.evaluating import evaluate as evaluate
    from h3data_pipelines.commands.exporting import export as export
    from h3data_pipelines.commands.generate import generate as generate
    from h3data_pipelines.commands.importing import import_ as import_
    from h3data_pipelines.hub.card import card as card
    from h3data_pipelines.hub.pulling import pull as pull
    from h3data_pipelines.hub.pushing import push as push
    from h3data_pipelines.hub.syncing import sync as sync
    from h3data_pipelines.pictures.rerender import rerender as rerender

__getattr__ = lazy_names(
    __name__,
    {
        "card": "h3data_pipelines.hub.card",
        "evaluate": "h3data_pipelines.commands.evaluating",
        "export": "h3data_pipelines.commands.exporting",
        "generate": "h3data_pipelines.commands.generate",
        "import_": "h3data_pipelines.commands.importing",
        "pull": "h3data_pipelines.hub.pulling",
        "push": "h3data_pipelines.hub.pushing",
        "rerender": "h3data_pipelines.pictures.rerender",
        "run_benchmark": "h3data_pipelines.commands.benchmarking",
        "sync": "h3data_pipelines.hub.syncing",
        "verify_benchmark": "h3data_pipelines.commands.benchmarking",
    },
)
