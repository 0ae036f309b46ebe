"""``--executor``: who does the work of a command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import tyro

from h3data.errors import InputError, did_you_mean
from h3data_pipelines.execution.processes import Processes
from h3data_pipelines.execution.shards import Executor

ExecutorOption = Annotated[
    str,
    tyro.conf.arg(
        help="Who does the work: local (processes of this machine), ray (a Ray cluster that runs here or that RAY_ADDRESS "
        "names, else Ray on this machine) or ray://HOST:PORT. The results are the same (h3data docs scale)."
    ),
]


def check_workers(executor: str, workers: int | None) -> None:
    """Refuses what cannot be, before anything is done.

    Raises:
        InputError: there is no such executor, or fewer than one worker.
    """
    name = executor.partition("://")[0]
    if name not in ("local", "ray") or (name == "local" and executor != "local") or executor == "ray://":
        near = did_you_mean(name, ("local", "ray"))
        raise InputError(f"--executor: expected local, ray or ray://HOST:PORT, got {executor!r}.{near}")
    if workers is not None and workers < 1:
        raise InputError(f"--workers must be at least 1, got {workers}.")


@contextmanager
def opened(executor: str, workers: int) -> Iterator[Executor]:
    """The executor of that name.

    Raises:
        InputError: there is no such executor, or no cluster at its address.
        MissingExtraError: Ray is not installed.
    """
    check_workers(executor, workers)
    if executor == "local":
        yield Processes(workers)
        return
    from h3data_pipelines.execution.ray_cluster import ray_cluster

    with ray_cluster(executor if "://" in executor else "", workers) as cluster:
        yield cluster
