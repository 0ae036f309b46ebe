"""Shards by this process, or by several of this machine."""

from __future__ import annotations

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
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from h3data.errors import H3DataError
from h3data_pipelines.execution.shards import LostShardError, R, S

_AHEAD = 4
"""Shards that are under way or wait to be fetched, per worker: memory stays bounded while an early one takes long."""


def core_count() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Processes:
    """The executor ``local``."""

    workers: int

    @property
    def threads(self) -> int:
        return max(core_count() // self.workers, 1)

    def run(
        self,
        work: Callable[[S], R],
        shards: Sequence[S],
        *,
        lost: Callable[[S, LostShardError], R] | None = None,
        writes: bool = False,
    ) -> Generator[R]:
        """As `Executor.run`. A process that dies ends the job: on one machine it was most likely memory, and will be again."""
        if self.workers <= 1 or len(shards) <= 1:
            yield from map(work, shards)
            return
        # spawn: forked children would share the thread pools of numba and torch
        context = get_context("spawn")
        gate, opener = context.Pipe(duplex=False)  # workers leave when the other end closes
        count = min(self.workers, len(shards), os.cpu_count() or 1)
        pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker, initargs=(gate,))
        waiting: deque[Future[R]] = deque()
        try:
            for shard in shards:
                with _ctrl_c_held():  # workers inherit that, for as long as they live
                    waiting.append(pool.submit(partial(_at_work, work), shard))
                if len(waiting) >= _AHEAD * count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool:
            raise H3DataError(
                "A worker process died, perhaps for lack of memory. What is finished is kept: go on with --resume and "
                "fewer --workers."
            ) from None
        finally:
            opener.close()  # waiting for shards under way would hold up Ctrl-C for seconds
            pool.shutdown(cancel_futures=True)
            gate.close()


@contextmanager
def _ctrl_c_held() -> Iterator[None]:
    """Delays Ctrl-C to the end of the block. Processes started in it never see one: their parent stops them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker:
    """This process as a worker that leaves at once when its parent closes the pool or dies, in the middle of a shard or
    between two, but not while it sends a result: the parent would wait for the rest of it forever."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.is_working = False
        self.is_stopped = False

    def watch(self, gate: Connection, parent: BaseProcess) -> None:
        """Waits for the parent to close the gate or to die."""
        wait((gate, parent.sentinel))
        with self.lock:
            self.is_stopped = True
            if self.is_working or not parent.is_alive():
                os._exit(1)
        parent.join()  # between two shards: the pool ends this process, unless the parent dies first
        os._exit(1)

    def work(self, function: Callable[[S], R], shard: S) -> R:
        """The result of a shard."""
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
