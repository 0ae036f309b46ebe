"""Execution of shards by the workers of a Ray cluster, or of Ray on this machine.

Ray only transports shards and results; the shards and their results equal those of `Processes`. If a worker or node
dies, its shards are tried again. A slow shard is started a second time when no other shard is left to start, and the
first result counts.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import socket
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field
from typing import Any

from h3data.commands.executors import LostShardError, R, S
from h3data.errors import H3DataError, InputError, MissingExtraError
from h3data_pipelines.execution.ray_worker import Origin, portable_task

TRIES = 4
"""Number of times that a shard is started before it is given up because its process died each time."""
NODE_TRIES = 20
"""Number of times that a shard is started if the whole node dies, which is hardly caused by the shard."""
_AHEAD = 4
"""Number of results that may wait for an earlier one, per worker."""
_SLOW = 3.0
"""Multiple of the median time of earlier shards above which a shard counts as a straggler."""
_SLOW_S = 30.0
"""Least time after which a shard counts as a straggler: workers take seconds to start."""
_DIAL_S = 5.0
_REASONS = {
    "NodeDiedError": "its node died",
    "WorkerCrashedError": "its process died",
    "OutOfMemoryError": "its node ran out of memory",
    "ObjectLostError": "its node died with the result",
}
_NODE_DEATHS = ("NodeDiedError", "ObjectLostError", "OwnerDiedError", "LocalRayletDiedError")
_log = logging.getLogger(__name__)


@contextmanager
def ray_cluster(address: str, workers: int) -> Iterator[RayWorkers]:
    """Connect to a Ray cluster for the executors ``ray`` and ``ray://host:port``.

    Args:
        address: a Ray Client server, usually on the cluster's head node. Empty means the cluster that runs on this
            machine or that RAY_ADDRESS names; if there is none, Ray is started on this machine.
        workers: number of workers.

    Raises:
        MissingExtraError: Ray is not installed.
        InputError: there is no cluster at the address, or it has another version of Ray or Python.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray tells its makers otherwise
    try:
        import ray
    except ImportError:
        raise MissingExtraError(
            '--executor ray needs Ray. Hint: pip install "h3data[ray]"', code="H3-JOB-005"
        ) from None
    if ray.is_initialized():  # from Python, by somebody who will end it
        yield RayWorkers(workers)
        return
    with _signals_kept():
        _connect(ray, address, workers)
    try:
        # Ray prints twenty lines on stdout, which is for results, when a node dies; `_UnderWay` says it in one, in the log
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
            yield RayWorkers(workers)
    finally:
        ray.shutdown()


def _connect(ray: Any, address: str, workers: int) -> None:
    where = address or os.environ.get("RAY_ADDRESS", "")
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    try:
        if where.startswith("ray://") or where not in ("", "auto", "local"):
            _dial(where)
            ray.init(where, **quiet)
        else:
            try:
                if where == "local":
                    raise ConnectionError
                ray.init("auto", **quiet)
            except ConnectionError:
                ray.init("local", num_cpus=workers, include_dashboard=False, **quiet)
    except ImportError as error:  # the client's own packages
        raise MissingExtraError(
            f'{where} needs Ray\'s client ({error}). Hint: pip install "h3data[ray]"', code="H3-JOB-006"
        ) from None
    except (RuntimeError, ValueError, OSError) as error:
        ray.shutdown()
        text = " ".join(str(error).split())
        if "ersion mismatch" in text or "versions are different" in text:
            raise InputError(f"The cluster has another version of Ray or Python: {text}", code="H3-JOB-009") from None
        raise InputError(
            f"There is no Ray cluster at {where or 'this machine'} ({text[:200]}). Start one with `ray start --head`, or "
            "use --executor ray without an address.",
            code="H3-JOB-007",
        ) from None


def _dial(where: str) -> None:
    """Fail fast if no cluster listens, because Ray itself tries for half a minute."""
    host, _, port = where.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise InputError(
            f"Expected --executor ray://HOST:PORT, such as ray://10.0.0.5:10001, got {where!r}.", code="H3-JOB-004"
        )
    socket.create_connection((host.strip("[]"), int(port)), timeout=_DIAL_S).close()


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Keep the former meaning of SIGTERM, which Ray handles for itself: stop, and keep what is finished."""
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        with suppress(ValueError):  # not in the main thread
            for number, handler in before.items():
                signal.signal(number, handler)


@dataclass(frozen=True)
class RayWorkers:
    """Executor ``ray``, which runs shards on the workers of a Ray cluster."""

    workers: int
    threads: int = 1

    def run(
        self,
        work: Callable[[S], R],
        shards: Sequence[S],
        *,
        lost: Callable[[S, LostShardError], R] | None = None,
        writes: bool = False,
    ) -> Generator[R]:
        """Run shards; an exception ends the job, but a process that dies affects only its own shards."""
        under_way = _UnderWay(work, shards, self.workers, writes)
        try:
            for index in range(len(shards)):
                outcome = under_way.result(index)
                if isinstance(outcome, LostShardError) and lost is not None:
                    yield lost(shards[index], outcome)
                elif isinstance(outcome, Exception):
                    raise outcome
                else:
                    yield outcome
        finally:
            under_way.cancel()


@dataclass
class _Attempt:
    index: int
    """Index of the shard."""
    since: float


@dataclass(eq=False)
class _UnderWay:
    """The shards of one job: begun, tried again, and their results until they are asked for."""

    work: Callable[[Any], Any]
    shards: Sequence[Any]
    workers: int
    writes: bool
    attempts: dict[Any, _Attempt] = field(default_factory=dict)
    """Running attempts, by Ray's reference."""
    done: dict[int, Any] = field(default_factory=dict)
    tries: Counter[tuple[int, int]] = field(default_factory=Counter)
    """Number of times that a shard was lost, by its index, and the greatest number allowed."""
    took_s: list[float] = field(default_factory=list)
    begun: int = 0
    again: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        import ray

        self.task = ray.remote(num_cpus=1, max_retries=0)(portable_task())
        self.origin = Origin.of_this_process().to_json()

    def result(self, wanted: int) -> Any:
        """Return the result of a shard, or the error with which it ended; those before it must have been asked for."""
        wait_s = 0.0
        while True:
            self._begin(wanted)
            self._collect(wait_s)
            if wanted in self.done:
                return self.done.pop(wanted)
            wait_s = 1.0

    def cancel(self) -> None:
        """Stop everything that runs."""
        for reference in self.attempts:
            _cancel(reference)
        self.attempts.clear()

    def _begin(self, wanted: int) -> None:
        """Fill the workers: what was lost first, then new shards, then a second try of the slowest."""
        while len(self.attempts) < self.workers:
            if self.again:
                self._submit(self.again.pop(0))
            elif self.begun < min(len(self.shards), wanted + _AHEAD * self.workers):
                self.begun += 1
                self._submit(self.begun - 1)
            elif (slow := self._straggler()) is not None:
                _log.warning("shard %d takes long: it is tried a second time", slow)
                self._submit(slow)
            else:
                return

    def _straggler(self) -> int | None:
        """Return the first shard that runs once and takes much longer than others did."""
        if self.writes or not self.took_s:
            return None
        usual = sorted(self.took_s)[len(self.took_s) // 2]
        running = Counter(attempt.index for attempt in self.attempts.values())
        now, limit = time.monotonic(), max(_SLOW * usual, _SLOW_S)
        slow = [a.index for a in self.attempts.values() if running[a.index] == 1 and now - a.since > limit]
        return min(slow, default=None)

    def _submit(self, index: int) -> None:
        # pickled here, as for processes of this machine: what arrives is the same
        payload = pickle.dumps((self.work, self.shards[index]))
        self.attempts[self.task.remote(self.origin, payload)] = _Attempt(index, time.monotonic())

    def _collect(self, wait_s: float) -> None:
        import ray
        from ray.exceptions import RayError, RayTaskError

        if not self.attempts:
            return
        ready, _ = ray.wait([*self.attempts], num_returns=1, timeout=wait_s)
        for reference in ready:
            attempt = self.attempts.pop(reference)
            try:
                kind, answer = ray.get(reference)
            except RayTaskError as error:
                raise H3DataError(
                    f"A Ray worker could not begin: {' '.join(str(error.cause).split())}", code="H3-JOB-011"
                ) from None
            except RayError as error:
                self._lost(attempt.index, error)
                continue
            if kind == "refused":
                raise InputError(answer, code="H3-JOB-010")
            self._finished(attempt, pickle.loads(answer))

    def _finished(self, attempt: _Attempt, result: Any) -> None:
        self.took_s.append(time.monotonic() - attempt.since)
        self.done[attempt.index] = result
        if attempt.index in self.again:
            self.again.remove(attempt.index)
        for reference, other in [*self.attempts.items()]:
            if other.index == attempt.index:
                _cancel(reference)
                del self.attempts[reference]

    def _lost(self, index: int, error: Exception) -> None:
        """Handle the loss of a worker that died with a shard, or of its result with a node."""
        if index in self.done or any(attempt.index == index for attempt in self.attempts.values()):
            return
        name = type(error).__name__
        most = NODE_TRIES if name in _NODE_DEATHS else TRIES
        self.tries[index, most] += 1
        tried, reason = self.tries[index, most], _REASONS.get(name, name)
        if tried < most:
            _log.warning("shard %d was lost (%s): it is tried again (%d of %d)", index, reason, tried + 1, most)
            self.again.append(index)
        else:
            text = f"No worker finished it in {most} tries; at the last one {reason}"
            _log.warning("shard %d is given up: %s", index, text)
            self.done[index] = LostShardError(text, code="H3-JOB-008")


def _cancel(reference: Any) -> None:
    import ray

    with suppress(Exception):  # it may be over, or the cluster gone
        ray.cancel(reference, force=True)
