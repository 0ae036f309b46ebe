"""Division of the episodes below paths into shards, for jobs that read recordings."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from h3data.recording.episodes import StoredEpisode
from h3data.recording.finding import find_episodes
from h3data.recording.storage import AnyPath


@dataclass(frozen=True)
class EpisodePart:
    """Shard with some of the episodes that `find_episodes` finds below paths."""

    paths: tuple[AnyPath, ...]
    indices: range
    count: int
    """Total number of parts."""
    job: str
    """Name of the job to which the part belongs; within a job, each process searches the paths once."""

    def sources(self) -> Sequence[StoredEpisode]:
        """Return the sources of the episodes of this part."""
        found = _found(self.paths, self.job)
        return [found[index] for index in self.indices]


def episode_parts(paths: Sequence[AnyPath], *, together: int) -> list[EpisodePart]:
    """Return all episodes below paths, in order, in parts of at most ``together`` episodes.

    Raises:
        InputError: a path does not exist, or there is no recording below it.
    """
    job, where = uuid.uuid4().hex, tuple(paths)
    count = len(_found(where, job))
    return [EpisodePart(where, range(k, min(k + together, count)), count, job) for k in range(0, count, together)]


@lru_cache(maxsize=1)
def _found(paths: tuple[AnyPath, ...], job: str) -> list[StoredEpisode]:
    return find_episodes(paths)
