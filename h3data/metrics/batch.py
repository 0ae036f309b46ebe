"""Metrics of many recordings at once: datasets and logs, on all cores, a few episodes in memory per worker.

Of a dataset only the columns that the profile reads are decoded. Decoding and kernels run without the interpreter's lock,
so threads are enough.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from h3data.errors import InputError
from h3data.metrics.metric import EpisodeMetrics, stored_columns
from h3data.metrics.registry import PROFILES, find_profile, measure
from h3data.metrics.table import MetricsTable, tabulate
from h3data.recording import Dataset, Recording, open_recording
from h3data.recording.opening import logs_in
from h3data.recording.storage import AnyPath, RemotePath, place

_CHUNK = 16
"""Episodes that are read together."""

Work = Callable[[Recording], EpisodeMetrics]


def measure_files(
    paths: Iterable[str | os.PathLike[str] | RemotePath], profile: str = "paper", *, workers: int | None = None
) -> MetricsTable:
    """The metrics of every recording in these files: MCAP logs, datasets, folders of MCAP logs.

    ``workers`` threads; by default one per core. The result does not depend on their number.

    Raises:
        InputError: there is no recording; an episode comes twice; steps, units or tasks differ; see `tabulate`.
    """
    sources = list(find_sources(paths))
    if not sources:
        raise InputError("Expected at least one recording (.mcap) or dataset.")
    return tabulate(measure_sources(sources, profile, workers=workers), profile=profile)


def find_sources(paths: Iterable[str | os.PathLike[str] | RemotePath]) -> Iterator[AnyPath]:
    """Datasets and MCAP logs, in order; a folder that is no dataset gives the logs in it."""
    for path in map(place, paths):
        if not path.is_dir() or (path / "meta").is_dir() or (path / "h3").is_dir():
            yield path
        elif logs := logs_in(path):
            yield from logs
        else:
            raise InputError(f"No recording (.mcap) and no dataset in this folder: {path}")


def measure_sources(
    sources: Sequence[AnyPath], profile: str = "paper", *, workers: int | None = None
) -> Iterator[EpisodeMetrics]:
    """The metrics of each episode of datasets and logs, in order; as many in memory as there are workers."""
    find_profile(profile)
    count = workers if workers is not None else len(os.sched_getaffinity(0))
    if count < 1:
        raise InputError(f"Expected at least one worker, got {count}.")
    yield from _in_order(_jobs(sources, profile), workers=count)


def recordings(sources: Sequence[AnyPath], profile: str | None = None) -> Iterator[Recording]:
    """Every recording of datasets and logs, one after the other; with ``profile`` only what it reads."""
    for source in sources:
        opened = open_recording(source)
        if isinstance(opened, Recording):
            yield opened
        else:
            for chunk in _chunks(opened):
                yield from _read(opened, chunk, profile)


def _jobs(sources: Sequence[AnyPath], profile: str) -> Iterator[Callable[[], list[EpisodeMetrics]]]:
    for source in sources:
        if not source.is_dir():
            yield lambda source=source: [measure(only(source), profile)]
            continue
        dataset = open_recording(source)
        assert isinstance(dataset, Dataset)
        own = _PerThread(source)
        for chunk in _chunks(dataset):
            yield lambda own=own, chunk=chunk: [measure(r, profile) for r in _read(own.dataset, chunk, profile)]


def only(source: AnyPath) -> Recording:
    """The recording in a file that is no dataset."""
    opened = open_recording(source)
    if isinstance(opened, Dataset):
        raise InputError(f"Expected a recording (.mcap), this is a dataset: {source}")
    return opened


def _chunks(dataset: Dataset) -> Iterator[range]:
    return (range(start, min(start + _CHUNK, len(dataset))) for start in range(0, len(dataset), _CHUNK))


def _read(dataset: Dataset, chunk: range, profile: str | None) -> Iterator[Recording]:
    """Episodes of a dataset, with what the profile needs of them."""
    if profile is None:
        return map(dataset.recording, chunk)
    declared = [c.name for c in dataset.schema.columns]
    agents = sum(name.endswith(".base_pose") for name in declared)
    metrics = [m for p in PROFILES[profile] for m in p.metrics]
    wanted = set(stored_columns(metrics, agents))
    columns = [name for name in declared if name in wanted]
    events = any(name.startswith("events:") for m in metrics for name in (*m.columns, *m.optional))
    return dataset.recordings(chunk, columns=columns, records=("agents", "events") if events else ("agents",))


class _PerThread:
    """A dataset that every thread opens for itself: its open files are not to be shared."""

    def __init__(self, root: AnyPath) -> None:
        self._root = root
        self._local = threading.local()

    @property
    def dataset(self) -> Dataset:
        if not hasattr(self._local, "dataset"):
            self._local.dataset = Dataset(self._root)
        return self._local.dataset


def _in_order(jobs: Iterator[Callable[[], list[EpisodeMetrics]]], *, workers: int) -> Iterator[EpisodeMetrics]:
    """Results in the order of the jobs, of which a few more than workers are under way at any time."""
    if workers == 1:
        for job in jobs:
            yield from job()
        return
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[list[EpisodeMetrics]]] = deque()
        try:
            for job in jobs:
                waiting.append(pool.submit(job))
                if len(waiting) >= 2 * workers:
                    yield from waiting.popleft().result()
            while waiting:
                yield from waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
