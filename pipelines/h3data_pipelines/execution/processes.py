"""Execution of shards in this process, or in several processes of this machine."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from h3data.commands.executors import LostShardError, R, S

_log = logging.getLogger(__name__)

TRIES = 3
"""Number of times that a shard is started before it is given up because its process died each time."""
_AHEAD = 4
"""Number of shards that are under way or wait to be fetched, per worker: memory stays bounded while an early one takes long."""


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local_processes(address: str, workers: int) -> Iterator[Processes]:
    """Provide the executor ``local`` for a block; it takes no address."""
    yield Processes(workers)


@dataclass(frozen=True)
class Processes:
    """Executor ``local``, which runs shards in processes of this machine."""

    workers: int

    @property
    def threads(self) -> int:
        """Number of threads that each process may use."""
        return max(core_count() // self.workers, 1)

    def run(
        self,
        work: Callable[[S], R],
        shards: Sequence[S],
        *,
        lost: Callable[[S, LostShardError], R] | None = None,
        writes: bool = False,
    ) -> Generator[R]:
        """Run shards as `Executor.run` does.

        If a process dies, each shard that was being processed is tried again alone on the machine.
        """
        if self.workers <= 1 or len(shards) <= 1:
            yield from map(work, shards)
            return
        count = min(self.workers, len(shards), core_count())
        done: dict[int, R] = {}
        given = 0
        while given < len(shards):
            waiting: deque[tuple[int, Future[R]]] = deque()
            try:
                with _pool(count) as pool:
                    left = iter([k for k in range(given, len(shards)) if k not in done])
                    while given < len(shards):
                        for k in islice(left, _AHEAD * count - len(waiting)):
                            waiting.append((k, _submitted(pool, work, shards[k])))
                        if given not in done:
                            done[given] = waiting[0][1].result()
                            waiting.popleft()
                        yield done.pop(given)
                        given += 1
            except BrokenProcessPool:
                done |= {
                    k: future.result() for k, future in waiting if not future.cancelled() and future.exception() is None
                }
                suspects = [k for k, _ in waiting if k not in done][:count]  # shards are begun in their order
                _log.warning("a worker process died: its shard is tried again, alone")
                for k in suspects:
                    done[k] = _alone(work, shards[k], lost)


@contextmanager
def _pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Yield processes that leave at once when the block ends, whatever they are at."""
    context = get_context("spawn")  # forked children would share the thread pools of numba and torch
    gate, opener = context.Pipe(duplex=False)  # workers leave when the other end closes
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker, initargs=(gate,))
    try:
        yield pool
    finally:
        opener.close()  # waiting for shards under way would hold up Ctrl-C for seconds
        pool.shutdown(cancel_futures=True)
        gate.close()


def _submitted(pool: ProcessPoolExecutor, work: Callable[[S], R], shard: S) -> Future[R]:
    with _ctrl_c_held():  # the workers that this starts inherit that, for as long as they live
        return pool.submit(partial(_at_work, work), shard)


def _alone(work: Callable[[S], R], shard: S, lost: Callable[[S, LostShardError], R] | None) -> R:
    """Return the result of a shard that may have ended a process, by another that has the machine to itself."""
    for _ in range(TRIES - 1):
        try:
            with _pool(1) as pool:
                return _submitted(pool, work, shard).result()
        except BrokenProcessPool:
            continue
    fault = LostShardError(f"No process survived it in {TRIES} tries, perhaps for lack of memory", code="H3-JOB-003")
    if lost is None:
        raise fault
    return lost(shard, fault)


@contextmanager
def _ctrl_c_held() -> Iterator[None]:
    """Delay Ctrl-C to the end of the block. Processes started in it never see one: their parent stops them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker:
    """This process as a worker that exits at once when its parent closes the pool or dies.

    It exits in the middle of a shard or between two shards, but not while it sends a result: the parent would wait for
    the rest of it forever.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.is_working = False
        self.is_stopped = False

    def watch(self, gate: Connection, parent: BaseProcess) -> None:
        """Wait for the parent to close the gate or to die."""
        wait((gate, parent.sentinel))
        with self.lock:
            self.is_stopped = True
            if self.is_working or not parent.is_alive():
                os._exit(1)
        parent.join()  # between two shards: the pool ends this process, unless the parent dies first
        os._exit(1)

    def work(self, function: Callable[[S], R], shard: S) -> R:
        """Return the result of a shard."""
        with self.lock:
            if self.is_stopped:
                os._exit(1)
            self.is_working = True
        try:
            return function(shard)
        finally:
            with self.lock:
                self.is_working = False


_worker = _Worker()


def _start_worker(gate: Connection) -> None:
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_worker.watch, args=(gate, parent), daemon=True).start()


def _at_work(function: Callable[[S], R], shard: S) -> R:
    return _worker.work(function, shard)
