"""Reading of recordings to measure: only what a profile reads, and many short episodes of a dataset at a time."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence

from h3data.errors import FormatError, InputError
from h3data.metrics.profile import Profile
from h3data.metrics.registry import profile_for, profiles_named
from h3data.metrics.requirements import stored_columns
from h3data.recording import Dataset, Recording, open_recording
from h3data.recording.storage import AnyPath

_CHUNK, _CHUNK_ROWS = 128, 50_000
"""Largest numbers of episodes and of rows that are read together from a dataset, which amount to some MB."""


def recordings(sources: Sequence[AnyPath], profile: str | None = None) -> Iterator[Recording]:
    """Yield the recordings of datasets and logs; from datasets, only the columns that the profile reads are read.

    Args:
        sources: Sources found by `find_sources`.
        profile: Profile of metrics, as in `measure_files`.
    """
    for source in sources:
        opened = open_recording(source)
        if isinstance(opened, Recording):
            yield opened
        else:
            for chunk in chunks_of(opened, range(len(opened))):
                yield from _stored(opened, chunk, profile)


def only(source: AnyPath) -> Recording:
    """Return the single recording in a file that is not a dataset."""
    opened = open_recording(source)
    if isinstance(opened, Dataset):
        raise InputError(f"Expected a recording (.mcap), this is a dataset: {source}", code="H3-METRIC-022")
    return opened


def read_log(source: AnyPath) -> Recording | FormatError:
    """Return the recording in a log, or the reason if it is damaged."""
    try:
        return only(source)
    except FormatError as error:
        return error


def read_chunk(dataset: Dataset, chunk: range, profile: str | None) -> Iterator[tuple[int, Recording | FormatError]]:
    """Read episodes of a dataset by their numbers, together up to the first damaged one, and one by one from there."""
    first = chunk.start
    try:
        for index, recording in zip(chunk, _stored(dataset, chunk, profile), strict=True):
            yield index, recording
            first = index + 1
    except FormatError as error:
        # read by itself, it is the damaged one
        if len(chunk) == 1:
            yield chunk.start, error
            return
        # one damaged episode must not take its neighbours with it
        for index in range(first, chunk.stop):
            yield from read_chunk(dataset, range(index, index + 1), profile)


def chunks_of(dataset: Dataset, episodes: range) -> Iterator[range]:
    """Yield ranges of consecutive episodes to be read together, all of one shard, so that no file is opened twice."""
    start, steps, shard = episodes.start, 0, -1
    for index in episodes:
        row = dataset.rows[index]
        # an episode of more rows than a chunk is a chunk of its own (index > start)
        full = index - start == _CHUNK or steps + row["length"] > _CHUNK_ROWS
        if index > start and (full or dataset.shard_of(row) != shard):
            yield range(start, index)
            start, steps = index, 0
        steps, shard = steps + row["length"], dataset.shard_of(row)
    if len(episodes):
        yield range(start, episodes.stop)


def _stored(dataset: Dataset, chunk: range, profile: str | None) -> Iterator[Recording]:
    """Return episodes of a dataset with no more than the profile reads of them."""
    declared = [c.name for c in dataset.schema.columns]
    # the schema has columns for as many agents as any episode of the dataset
    agents = sum(name.endswith(".base_pose") for name in declared)
    if profile is not None:
        profiles: Iterable[Profile] = profiles_named(profile)
    else:
        rows = [dataset.rows[index] for index in chunk]
        # info is parsed only if it can matter: that of a generated episode is some kilobytes
        infos = [json.loads(row["info"]) if row["info"] and '"profile"' in row["info"] else {} for row in rows]
        profiles = [profile_for(row["task"], info) for row, info in zip(rows, infos, strict=True)]
    metrics = {m.id: m for p in profiles for m in p.metrics}.values()
    wanted = set(stored_columns(metrics, agents))
    columns = [name for name in declared if name in wanted]
    events = any(name.startswith("events:") for m in metrics for name in (*m.columns, *m.optional))
    poses = ("bodies", "assets") if "object_pose" in columns else ()  # poses of bodies that were not read fit no body
    return dataset.recordings(chunk, columns=columns, records=("agents", *(("events",) if events else ()), *poses))
