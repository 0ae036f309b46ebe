"""Metrics of many recordings: datasets and logs, on all cores, with a few episodes in memory per worker.

Only the columns that a profile reads are decoded from a dataset.
"""

# Threads, not processes: decoding Parquet and the arithmetic on columns release the interpreter's lock.

from __future__ import annotations

import copy
import itertools
import os
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TypeVar

from h3data.errors import FormatError, InputError
from h3data.metrics.episode import EpisodeMetrics, for_each_partner
from h3data.metrics.metric import Metric
from h3data.metrics.reading import chunks_of, read_chunk, read_log
from h3data.metrics.registry import profile_for, profiles_named
from h3data.metrics.requirements import UnmeasurableError
from h3data.metrics.table import MetricsTable, tabulate
from h3data.progress import progress
from h3data.recording import Dataset, Recording, open_recording
from h3data.recording.finding import find_sources
from h3data.recording.storage import AnyPath, RemotePath


@dataclass(frozen=True)
class Part:
    """Episodes that one worker measures together."""

    source: AnyPath
    episodes: range | None
    """Numbers of the episodes in a dataset; None for a log."""
    job: str
    """Name of the job to which the part belongs; datasets stay open until the job ends."""


F = TypeVar("F")
Spread = Callable[[Callable[[Part], F], Sequence[Part]], Iterable[F]]
"""Function that applies a function to parts, on any machine, and returns the results in the order of the parts; `map`
does it in this process."""
Measured = EpisodeMetrics | tuple[str, str, str]
"""Metrics without the functions that compute them, or the name, message and reason of an episode that was left out.

Both can be sent between processes.
"""


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """An episode that cannot be measured."""

    name: str
    """Path of the log, or dataset and number such as ``ds#3``."""
    error: UnmeasurableError | FormatError

    @property
    def reason(self) -> str:
        """Reason why the episodes were left out: a reason that several share, or the fault of a damaged one."""
        return self.error.reason if isinstance(self.error, UnmeasurableError) else str(self.error)


def measure_files(
    paths: Iterable[str | os.PathLike[str] | RemotePath],
    profile: str | None = None,
    *,
    workers: int | None = None,
    spread: Spread[list[Measured]] | None = None,
) -> MetricsTable:
    """Return the metrics of every recording in MCAP logs, datasets, and folders of these, which are walked.

    Episodes that are damaged, or lack agents or data that every metric needs, are listed in `MetricsTable.left_out`.

    Args:
        paths: Files and folders.
        profile: Name of a profile (default: that of each recording's task).
        workers: Number of threads (default: one per core). The result does not depend on it.
        spread: Function that distributes the work to other processes or machines instead of threads.

    Raises:
        InputError: there is no recording; an episode occurs twice; metrics, steps or units differ; see `tabulate`.
        UnmeasurableError: none of the episodes can be measured.
    """
    rows, left_out = _measured(paths, profile, workers, spread)
    return tabulate(rows, profile=profile, left_out=_counted(left_out))


def measure_tables(
    paths: Iterable[str | os.PathLike[str] | RemotePath],
    profile: str | None = None,
    *,
    workers: int | None = None,
    spread: Spread[list[Measured]] | None = None,
) -> tuple[MetricsTable, ...]:
    """Measure files as `measure_files` does, with a table for each task whose metrics differ.

    The first table lists the episodes that are left out.
    """
    rows, left_out = _measured(paths, profile, workers, spread)
    groups: dict[tuple[str, ...], list[EpisodeMetrics]] = {}
    for row in rows:
        groups.setdefault(tuple(metric.id for metric in row.metrics), []).append(row)
    some = _counted(left_out)
    return tuple(
        tabulate(group, profile=profile, left_out={} if k else some) for k, group in enumerate(groups.values())
    )


def measure_sources(
    sources: Sequence[AnyPath],
    profile: str | None = None,
    *,
    workers: int | None = None,
    spread: Spread[list[Measured]] | None = None,
) -> Iterator[EpisodeMetrics | LeftOut]:
    """Yield the metrics of each episode of datasets and logs in order, or the reason for failure.

    Each worker holds a chunk of episodes in memory.
    """
    if profile is not None:
        profiles_named(profile)  # a misspelt name fails before the first episode is read
    if spread is not None:
        for measured in spread(partial(measure_part, profile=profile), parts_of(sources)):
            for each in measured:
                if isinstance(each, EpisodeMetrics):
                    yield each
                else:
                    name, message, reason = each
                    yield LeftOut(name=name, error=UnmeasurableError(message, reason, code="H3-METRIC-003"))
        return
    # the cores that this process may use, which taskset or a cpuset may limit
    count = workers if workers is not None else len(os.sched_getaffinity(0))
    if count < 1:
        raise InputError(f"Expected at least one worker, got {count}.", code="H3-METRIC-001")
    yield from _in_order(_jobs(sources, profile), workers=count)


def parts_of(sources: Sequence[AnyPath]) -> list[Part]:
    """Split the episodes of datasets and logs into parts that each take about a second to measure, in order."""
    job = uuid.uuid4().hex
    parts: list[Part] = []
    for source in sources:
        if not source.is_dir():
            parts.append(Part(source, None, job))
            continue
        # 2,048 episodes take about a second: few enough to share out, enough to be worth sending
        count = len(open_part(source, job))
        parts += [Part(source, range(k, min(k + 2048, count)), job) for k in range(0, count, 2048)]
    return parts


def measure_part(part: Part, profile: str | None) -> list[Measured]:
    """Return the results of `measure_sources` for a part, in a form that can be sent between processes."""
    if part.episodes is None:
        results = _attempts([(str(part.source), read_log(part.source))], profile)
    else:
        dataset = open_part(part.source, part.job)
        results = (
            each for chunk in chunks_of(dataset, part.episodes) for each in _measure_chunk(dataset, chunk, profile)
        )
    return [
        sendable(each) if isinstance(each, EpisodeMetrics) else (each.name, str(each.error), each.reason)
        for each in results
    ]


def lost_part(part: Part, fault: Exception) -> list[Measured]:
    """Return the results of a part whose worker failed: a reason for each episode."""
    names = [str(part.source)] if part.episodes is None else [f"{part.source}#{index}" for index in part.episodes]
    return [(name, str(fault), str(fault)) for name in names]


@lru_cache(maxsize=1)
# `job` is part of the key, so that a later job sees a dataset that has grown
def open_part(source: AnyPath, job: str) -> Dataset:
    """Return the dataset of the parts of a job."""
    return Dataset(source)


def sendable(measured: EpisodeMetrics) -> EpisodeMetrics:
    """Return metrics without the functions that compute them, so that they can be sent between processes."""
    return replace(measured, metrics=_described(measured.metrics))


@lru_cache(maxsize=64)
# cached: episodes of a profile share one tuple of metrics, and `tabulate` compares them by identity first
def _described(metrics: tuple[Metric, ...]) -> tuple[Metric, ...]:
    return tuple(replace(metric, value=None) for metric in metrics)


def _measured(
    paths: Iterable[str | os.PathLike[str] | RemotePath],
    profile: str | None,
    workers: int | None,
    spread: Spread[list[Measured]] | None = None,
) -> tuple[list[EpisodeMetrics], list[LeftOut]]:
    sources = list(find_sources(paths))
    if not sources:
        raise InputError("Expected at least one recording (.mcap) or dataset.", code="H3-METRIC-002")
    measured = measure_sources(sources, profile, workers=workers, spread=spread)
    results = list(progress(measured, desc="measure", unit="episode", delay=1.0, leave=False))
    left_out = [result for result in results if isinstance(result, LeftOut)]
    if left_out and len(left_out) == len(results):
        # a table without any episode would hide why
        raise left_out[0].error
    return [result for result in results if isinstance(result, EpisodeMetrics)], left_out


def _counted(left_out: Iterable[LeftOut]) -> dict[str, tuple[str, ...]]:
    """Return names of the episodes by the reason why they are left out."""
    reasons: dict[str, tuple[str, ...]] = {}
    for episode in left_out:
        reasons[episode.reason] = (*reasons.get(episode.reason, ()), episode.name)
    return reasons


def _attempts(
    episodes: Iterable[tuple[str, Recording | FormatError]], profile: str | None
) -> list[EpisodeMetrics | LeftOut]:
    """Return metrics of episodes by their names, or why there are none; those that have one profile are measured together."""
    chosen = [
        (
            name,
            found,
            None if isinstance(found, FormatError) else profile_for(found.episode.task, found.episode.info, profile),
        )
        for name, found in episodes
    ]
    results: list[EpisodeMetrics | LeftOut] = []
    # neighbours with one profile: its kernels take many short episodes at once
    for _, group in itertools.groupby(chosen, key=lambda each: id(each[2])):
        names, found, profiles = zip(*group, strict=True)
        measured = found if profiles[0] is None else profiles[0].measure_many(found)
        for name, recording, each in zip(names, found, measured, strict=True):
            if isinstance(each, EpisodeMetrics):
                results += for_each_partner(each, recording.episode.info)
            else:
                results.append(LeftOut(name=name, error=each))
    return results


def _measure_chunk(dataset: Dataset, chunk: range, profile: str | None) -> list[EpisodeMetrics | LeftOut]:
    episodes = read_chunk(dataset, chunk, profile)
    return _attempts(((f"{dataset.root}#{index}", recording) for index, recording in episodes), profile)


def _jobs(sources: Sequence[AnyPath], profile: str | None) -> Iterator[Callable[[], list[EpisodeMetrics | LeftOut]]]:
    for source in sources:
        if not source.is_dir():
            # bound now: the job may run when the loop is at another source
            yield lambda source=source: _attempts([(str(source), read_log(source))], profile)
            continue
        dataset = open_recording(source)
        assert isinstance(dataset, Dataset)
        per_thread = _PerThread(dataset)
        for chunk in chunks_of(dataset, range(len(dataset))):
            yield lambda opened=per_thread, chunk=chunk: _measure_chunk(opened.dataset, chunk, profile)


class _PerThread:
    """A dataset for every thread, with its own open files, which cannot be shared; the episode table is."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._local = threading.local()

    @property
    def dataset(self) -> Dataset:
        if not hasattr(self._local, "dataset"):
            self._local.dataset = copy.copy(self._dataset)
        return self._local.dataset


def _in_order(
    jobs: Iterator[Callable[[], list[EpisodeMetrics | LeftOut]]], *, workers: int
) -> Iterator[EpisodeMetrics | LeftOut]:
    """Yield results in the order of the jobs; a few more jobs than workers are under way at any time."""
    if workers == 1:
        for job in jobs:
            yield from job()
        return
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[list[EpisodeMetrics | LeftOut]]] = deque()
        try:
            for job in jobs:
                waiting.append(pool.submit(job))
                # one job under way and one ready for each worker; more would fill memory with results
                if len(waiting) >= 2 * workers:
                    yield from waiting.popleft().result()
            while waiting:
                yield from waiting.popleft().result()
        finally:
            # a reader who stops does not wait for jobs that have not begun
            for future in waiting:
                future.cancel()
