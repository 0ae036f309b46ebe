"""Reading and measuring of recordings for a report, in this process or in workers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.metrics import EpisodeMetrics, Profile
from h3data.metrics.batch import Part, open_part, sendable
from h3data.metrics.reading import chunks_of, read_chunk, read_log
from h3data.metrics.registry import all_profiles, profile_for
from h3data.metrics.requirements import UnmeasurableError
from h3data.recording import Recording
from h3data.recording.storage import AnyPath
from h3data_viewers.html_report.episode import GRID_S, TRACK_S, ReportEpisode, Track


@dataclass(frozen=True, eq=False)
class Read:
    """Episode that was read and measured, in a form that can be sent between processes."""

    episode: ReportEpisode
    task: str
    info: Mapping[str, Any]
    """Entries ``profile`` and ``partners`` of `h3data.recording.Episode.info`, if they exist."""


@dataclass(frozen=True)
class Unread:
    """Episode that cannot be measured, with the reason."""

    name: str
    reason: str


Found = list[Read | Unread]


def _recordings(part: Part) -> Iterator[tuple[int, Recording | FormatError]]:
    """Yield the recordings of a part with their numbers; a damaged recording is replaced by its error."""
    if part.episodes is None:
        yield 0, read_log(part.source)
        return
    dataset = open_part(part.source, part.job)
    for chunk in chunks_of(dataset, part.episodes):
        yield from read_chunk(dataset, chunk, None)


def read_part(part: Part) -> Found:
    """Return the episodes of one part of the datasets, measured by the profiles of their tasks."""
    found: Found = []
    for index, recording in _recordings(part):
        if isinstance(recording, FormatError):
            found.append(Unread(_name(part, index), str(recording)))
            continue
        info = recording.episode.info
        try:
            profile = profile_for(recording.episode.task, info)
            episode = _episode(part.source, index, recording, profile)
        except InputError as fault:
            # the message names the episode: hundreds of them would be as many reasons
            reason = fault.reason if isinstance(fault, UnmeasurableError) else str(fault)
            found.append(Unread(_name(part, index), reason))
        else:
            # not all of info, which may hold a large instruction or plan: workers send what they found
            some = {key: info[key] for key in ("profile", "partners") if key in info}
            found.append(Read(episode, recording.episode.task, some))
    return found


def lost_part(part: Part, fault: Exception) -> Found:
    """Return the episodes of a part that no worker could read, with the fault as the reason."""
    return [Unread(_name(part, index), str(fault)) for index in part.episodes or (0,)]


def _name(part: Part, index: int) -> str:
    return part.source.name if part.episodes is None else f"{part.source.name}#{index}"


def _episode(source: AnyPath, index: int, recording: Recording, profile: Profile) -> ReportEpisode:
    metrics = sendable(profile.measure(recording))
    info = recording.episode.info
    stride = max(1, round(TRACK_S * 1e9 / metrics.dt_ns))
    floor = [recording.agent_column(i, "base_pose")[:, [0, 2]] for i in range(len(recording.agents))]
    # the last row too: the dot at the end of a path is where the agent really ended
    tracks = tuple(
        Track(kind=agent.kind, xz=np.concatenate([xz[::stride], xz[-1:]]).astype(np.float32))
        for agent, xz in zip(recording.agents, floor, strict=True)
    )
    human = next((a for a in recording.agents if a.kind == "human"), None)
    body = "" if human is None else human.model.rpartition("/")[2] or human.name
    population = _said(info, "population").lower()
    return ReportEpisode(
        source=source,
        index=index,
        metrics=metrics,
        seed=recording.episode.seed,
        policy=_said(info, "policy"),
        partner=_said(info, "partner") or body,
        population=next((kind for kind in ("train", "zsc") if population.startswith(kind)), ""),
        participant=_said(info, "participant"),
        condition=_said(info, "condition"),
        distance_m=_distances(recording),
        tracks=tracks,
        beside=_beside(recording),
        imported=_said(told, "summary") if isinstance(told := info.get("imported"), Mapping) else "",
    )


@cache
def profiles_beside() -> tuple[Profile, ...]:
    """Return the additional profiles that measure recordings with a certain key in their info."""
    return tuple(profile for profile in all_profiles() if profile.beside)


def _beside(recording: Recording) -> tuple[EpisodeMetrics, ...]:
    found = []
    for profile in profiles_beside():
        if profile.beside in recording.episode.info:
            with suppress(UnmeasurableError):  # of a malformed entry there is nothing to tell
                found.append(sendable(profile.measure(recording)))
    return tuple(found)


def _said(info: Mapping[str, Any], key: str) -> str:
    """Return the text or number of a key; anything else that a foreign file holds there counts as nothing."""
    value = info.get(key, "")
    return str(value) if isinstance(value, str | int | float) else ""


def _distances(recording: Recording) -> NDArray[np.float32]:
    kinds = [agent.kind for agent in recording.agents]
    if not {"robot", "human"} <= set(kinds) or not len(recording):
        return np.zeros(0, np.float32)
    stride = max(1, round(GRID_S * 1e9 / recording.episode.dt_ns))
    places = [recording.columns[f"agent_{i}.base_pose"][::stride, :3] for i in range(len(kinds))]
    robot = places[kinds.index("robot")]
    gaps = [np.linalg.norm(robot - at, axis=1) for at, kind in zip(places, kinds, strict=True) if kind == "human"]
    # fmin: a person who is not there (NaN) does not hide the others
    return np.fmin.reduce(gaps, axis=0).astype(np.float32)
