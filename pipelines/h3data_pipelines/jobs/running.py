"""Jobs carried out by this process or by several, in their order; what raises is listed, not fatal."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context, parent_process
from typing import TypeVar

from h3data.errors import H3DataError
from h3data.recording import Recording
from h3data_pipelines.jobs.episodes import Job
from h3data_pipelines.jobs.failed_episodes import failed_recording

J = TypeVar("J")
R = TypeVar("R")


def simulate_job(job: Job) -> Recording:
    """One episode, or `failed_recording` of it. It depends on the job alone, so any process may run it."""
    try:
        recording = job.record()
    except MemoryError:
        raise
    except Exception as fault:
        recording = failed_recording(job, fault)
    info = {**recording.episode.info, "job": job.to_json()}
    if job.origin is not None:
        info["origin"] = job.origin
    return replace(recording, episode=replace(recording.episode, info=info))


def simulate_jobs(jobs: Sequence[Job], *, workers: int) -> Generator[Recording]:
    """Recordings in the order of ``jobs``, by this process or by several."""
    yield from run_jobs(simulate_job, jobs, workers=workers)


def run_jobs(work: Callable[[J], R], jobs: Sequence[J], *, workers: int) -> Generator[R]:
    """What ``work`` makes of each job, in their order, by this process or by several."""
    if workers <= 1 or len(jobs) <= 1:
        yield from map(work, jobs)
        return
    # spawn: forked children would share the thread pools of numba and torch
    size = min(workers, len(jobs), os.cpu_count() or 1)
    with ProcessPoolExecutor(size, mp_context=get_context("spawn"), initializer=_start_worker) as pool:
        try:
            with _ctrl_c_held():  # workers inherit that, for as long as they live
                results = pool.map(work, jobs)
            yield from results
        except BrokenProcessPool:
            raise H3DataError(
                "A worker process died, perhaps for lack of memory. Finished episodes are kept: go on with --resume and "
                "fewer --workers."
            ) from None


@contextmanager
def _ctrl_c_held() -> Iterator[None]:
    """It takes effect at the end of the block; processes that are started in it never see any."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker() -> None:
    """Do not outlive the parent."""
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
