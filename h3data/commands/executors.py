"""Option ``--executor``: the processes or the cluster that execute the work of a command."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager
from typing import Annotated, Protocol, TypeVar

import tyro

from h3data.errors import H3DataError, InputError, did_you_mean
from h3data.plugins import Registry

S = TypeVar("S")
R = TypeVar("R")


class LostShardError(H3DataError):
    """Error about a shard whose process died in every attempt."""


class Executor(Protocol):
    """Processes that work on shards."""

    @property
    def workers(self) -> int:
        """Number of shards that are processed at the same time."""
        ...

    @property
    def threads(self) -> int:
        """Number of threads that each process may use."""
        ...

    def run(
        self,
        work: Callable[[S], R],
        shards: Sequence[S],
        *,
        lost: Callable[[S, LostShardError], R] | None = None,
        writes: bool = False,
    ) -> Generator[R]:
        """Yield the result of ``work`` for each shard, in order.

        An error that ``work`` raises ends the job.

        Args:
            work: A function of a module, or a `functools.partial` of one.
            shards: Values that can be pickled, one for each call.
            lost: Function that returns the result of a shard whose process died in every attempt; None ends the job
                with a `LostShardError`.
            writes: True if ``work`` writes files, so that no shard may run twice at once.
        """
        ...


ExecutorOption = Annotated[
    str,
    tyro.conf.arg(
        help="Where the work is done: local (processes of this machine), ray (a Ray cluster that runs here or that RAY_ADDRESS "
        "names, else Ray on this machine) or ray://HOST:PORT. The results are the same (h3data docs scale)."
    ),
]


def check_workers(executor: str, workers: int | None) -> None:
    """Check the executor and the number of workers before any work starts.

    Raises:
        InputError: there is no such executor, or fewer than one worker.
    """
    name = executor.partition("://")[0]
    # the names are checked here without importing Ray, which takes seconds
    if name not in ("local", "ray") or (name == "local" and executor != "local") or executor == "ray://":
        near = did_you_mean(name, ("local", "ray"))
        raise InputError(
            f"--executor: expected local, ray or ray://HOST:PORT, got {executor!r}.{near}", code="H3-JOB-001"
        )
    if workers is not None and workers < 1:
        raise InputError(f"--workers must be at least 1, got {workers}.", code="H3-JOB-002")


def opened(executor: str, workers: int) -> AbstractContextManager[Executor]:
    """Return the executor with a name, for use in a ``with`` statement.

    Raises:
        InputError: there is no such executor, or no cluster at its address.
        MissingExtraError: Ray is not installed.
    """
    check_workers(executor, workers)
    # each is a function of its name and address, empty where there is no address, and of the number of workers
    executors: Registry[Callable[[str, int], AbstractContextManager[Executor]]]
    executors = Registry("h3data.executors", {}, what="executor")
    return executors.get(executor.partition("://")[0])(executor if "://" in executor else "", workers)
