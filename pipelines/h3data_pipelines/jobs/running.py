"""Jobs carried out by this process or by several, in their order; what raises is listed, not fatal."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from h3data.bodies.people.rigid_parts import PeopleStyle
from h3data.errors import H3DataError, InputError
from h3data.recording import Recording
from h3data.render.light.sources import LightMode
from h3data_pipelines.jobs.episodes import Job
from h3data_pipelines.jobs.failed_episodes import failed_recording, is_failed

if TYPE_CHECKING:
    from h3data.recording.parquet.videos import EpisodeVideo

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


@dataclass(frozen=True)
class Filming:
    """Videos to render of every episode."""

    cameras: tuple[str, ...]
    folder: Path
    """Parent of the folders that their files are put into."""
    threads: int
    """Threads that render, in each process."""
    people: PeopleStyle = "skin"
    light: LightMode = "flat"

    def of(self, job: Job) -> Path:
        """Folder for the videos of an episode."""
        return self.folder / str(job.index)


def film_job(job: Job, filming: Filming) -> tuple[Recording, list[EpisodeVideo]]:
    """One episode as `simulate_job` gives it, and its videos: none of one that failed.

    Raises:
        InputError: it has no such camera.
    """
    recording = simulate_job(job)
    if not filming.cameras or is_failed(recording):
        return recording, []
    from h3data.exporters.camera_videos import render_videos

    filming.of(job).mkdir()
    try:
        videos = render_videos(
            recording,
            filming.cameras,
            filming.of(job),
            threads=filming.threads,
            people=filming.people,
            light=filming.light,
        )
    except InputError as error:
        raise InputError(f"Episode {job.index}: {error}") from None
    return recording, videos


def film_jobs(
    jobs: Sequence[Job], *, filming: Filming, workers: int
) -> Generator[tuple[Recording, list[EpisodeVideo]]]:
    """Recordings and their videos in the order of ``jobs``, by this process or by several."""
    yield from run_jobs(partial(film_job, filming=filming), jobs, workers=workers)


def run_jobs(work: Callable[[J], R], jobs: Sequence[J], *, workers: int) -> Generator[R]:
    """What ``work`` makes of each job, in their order, by this process or by several."""
    if workers <= 1 or len(jobs) <= 1:
        yield from map(work, jobs)
        return
    # spawn: forked children would share the thread pools of numba and torch
    context = get_context("spawn")
    gate, opener = context.Pipe(duplex=False)  # workers leave when the other end closes
    pool = ProcessPoolExecutor(
        min(workers, len(jobs), os.cpu_count() or 1),
        mp_context=context,
        initializer=_start_worker,
        initargs=(gate,),
    )
    try:
        with _ctrl_c_held():  # workers inherit that, for as long as they live
            results = pool.map(partial(_at_work, work), jobs)
        yield from results
    except BrokenProcessPool:
        raise H3DataError(
            "A worker process died, perhaps for lack of memory. Finished episodes are kept: go on with --resume and "
            "fewer --workers."
        ) from None
    finally:
        opener.close()  # waiting for episodes under way would hold up Ctrl-C for seconds
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
    """This process as a worker that leaves at once when its parent closes the pool or dies, in the middle of a job or between
    two, but not while it sends a result: the parent would wait for the rest of it forever."""

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
        parent.join()  # between two jobs: the pool ends this process, unless the parent dies first
        os._exit(1)

    def work(self, function: Callable[[J], R], job: J) -> R:
        """The result of a job."""
        with self.lock:
            if self.is_stopped:
                os._exit(1)
            self.is_working = True
        try:
            return function(job)
        finally:
            with self.lock:
                self.is_working = False


_worker = _Worker()


def _start_worker(gate: Connection) -> None:
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_worker.watch, args=(gate, parent), daemon=True).start()


def _at_work(function: Callable[[J], R], job: J) -> R:
    return _worker.work(function, job)
