"""Interface through which commands distribute work to processes.

A *shard* is an independent part of a job: if the process that works on it dies, another process can repeat the work
with the same result. Results are returned as values, so machines need no shared disk.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import Protocol, TypeVar

from h3data.errors import H3DataError

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
