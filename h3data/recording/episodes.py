"""Collections of episodes in datasets and logs, which can be filtered, split and merged, and are read one at a time."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol, overload

import numpy as np

from h3data.errors import H3DataError, InputError, suggest
from h3data.recording.records import Recording, notebook
from h3data.recording.storage import AnyPath, RemotePath

if TYPE_CHECKING:
    from h3data.recording.parquet.videos import EpisodeVideo, VideoFeature


@dataclass(frozen=True, eq=False)
class StoredEpisode:
    """Episode that can be read from a file or a dataset."""

    name: str
    """Path of the file, or dataset and number such as ``ds#3``."""
    path: AnyPath
    """Path of the file, or of the dataset's folder."""
    read: Callable[[], Recording]
    """Function that returns the recording, or raises an `H3DataError`."""
    read_facts: Callable[[], Mapping[str, Any]]
    """Function that reads `facts` without the entries of ``info``."""
    index: int | None = None
    """Number of the episode in a dataset; None for a file."""
    read_videos: Callable[[], Sequence[EpisodeVideo]] = tuple
    """Function that returns the videos of the episode in its dataset."""
    read_together: Callable[[range], Iterator[Recording]] | None = None
    """Function that reads consecutive episodes of its dataset, by number; faster than one after the other."""

    @cached_property
    def facts(self) -> Mapping[str, Any]:
        """Facts known without reading the steps: uid, task, scene, seed, length, ``info``, and the entries of ``info``."""
        row = self.read_facts()
        info = json.loads(row["info"]) if isinstance(row["info"], str) else row["info"]
        # the row goes last: where info has a key such as seed, the seed of the episode counts
        return {**info, **row, "info": info}


def common_cameras(stored: Iterable[StoredEpisode]) -> list[str]:
    """Return cameras of which all of the given episodes have a video of the same size.

    Episodes without steps and episodes that cannot be read do not count.
    """
    common: list[VideoFeature] | None = None
    for of in stored:
        try:
            features = [video.feature for video in of.read_videos()]
            if not features and not of.facts["length"]:
                continue
        except H3DataError:
            continue
        common = [feature for feature in (features if common is None else common) if feature in features]
        if not common:
            return []
    return [feature.camera for feature in common or ()]


class HasEpisodes(Protocol):
    """Protocol of objects that hold episodes, such as a dataset or `Episodes`."""

    def all(self) -> Episodes:
        """Return all episodes, in the order in which they are stored."""
        ...


class Episodes(Sequence[Recording]):
    """Ordered collection of episodes from any number of datasets and logs, which are read on demand.

    Slices, `filter`, `split` and `merge` return new collections without reading steps; `save` writes them as a dataset.
    """

    def __init__(self, stored: Iterable[StoredEpisode]) -> None:
        self.stored = tuple(stored)

    def __len__(self) -> int:
        return len(self.stored)

    @overload
    def __getitem__(self, index: int) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> Episodes: ...
    def __getitem__(self, index: int | slice) -> Recording | Episodes:
        if isinstance(index, slice):
            return Episodes(self.stored[index])
        if not -len(self) <= index < len(self):
            raise IndexError(f"There are {len(self)} episodes, there is no {index}.")  # also ends a for loop
        return self.stored[index].read()

    def __iter__(self) -> Iterator[Recording]:
        return (stored.read() for stored in self.stored)

    def all(self) -> Episodes:
        """Return all episodes of the collection."""
        return self

    @property
    def facts(self) -> list[Mapping[str, Any]]:
        """Facts of each episode that are known without reading steps: uid, task, scene, seed, length, policy, ..."""
        return [stored.facts for stored in self.stored]

    def filter(self, keep: Callable[[Mapping[str, Any]], bool] | None = None, **equal: Any) -> Episodes:
        """Return the episodes whose facts are accepted by the function ``keep`` and have the given values.

        Examples: ``ds.filter(policy="rollout_expert")``, ``ds.filter(lambda facts: facts["length"] > 300)``.

        Raises:
            InputError: no episode has such a fact.
        """
        facts = self.facts
        for name in equal:
            known = sorted(set().union(*facts))
            if facts and name not in known:
                raise InputError(
                    f"No episode has a {name!r}.{suggest(name, known, lead='They have')}", code="H3-RECORDING-003"
                )
        chosen = (
            stored
            for stored, of in zip(self.stored, facts, strict=True)
            if all(of.get(name) == value for name, value in equal.items()) and (keep is None or keep(of))
        )
        return Episodes(chosen)

    def split(self, *shares: float, seed: int = 0, by: str = "uid") -> tuple[Episodes, ...]:
        """Split the episodes at random into parts that depend only on the seed.

        ``by="scene"`` puts all episodes of a scene into the same part.

        Args:
            shares: Sizes of the parts, as shares of the groups; if they sum to less than 1, the rest is the last part.
            seed: Seed of the random assignment of groups to parts.
            by: Fact whose equal values stay together.

        Raises:
            InputError: a share is not positive, or the sum of shares is more than 1.
        """
        if not shares or min(shares) <= 0 or sum(shares) > 1 + 1e-9:
            raise InputError(
                f"Expected shares above 0 that are at most 1 together, such as 0.8, 0.1, got {shares}.",
                code="H3-RECORDING-001",
            )
        facts = self.facts
        # in the order of the episodes: a set of texts has another order in each process
        groups = list(dict.fromkeys(str(of.get(by)) for of in facts))
        order = np.random.default_rng(seed).permutation(len(groups))
        ends = [round(end * len(groups)) for end in np.cumsum(shares)]
        # shares such as 0.7, 0.2, 0.1 add up to a little less than 1, and leave no last part
        if sum(shares) < 1 - 1e-9:
            ends.append(len(groups))
        part_of = {groups[g]: int(np.searchsorted(ends, place, side="right")) for place, g in enumerate(order)}
        parts: list[list[StoredEpisode]] = [[] for _ in ends]
        for stored, of in zip(self.stored, facts, strict=True):
            parts[part_of[str(of.get(by))]].append(stored)
        return tuple(map(Episodes, parts))

    def merge(self, *others: HasEpisodes) -> Episodes:
        """Return these episodes followed by those of ``others``, each episode once."""
        stored = {of.facts["uid"]: of for of in self.stored}
        for other in others:
            stored |= {of.facts["uid"]: of for of in other.all().stored if of.facts["uid"] not in stored}
        return Episodes(stored.values())

    def save(self, root: str | os.PathLike[str] | RemotePath, *, overwrite: bool = False) -> None:
        """Write the episodes as a dataset, with the videos of those cameras that all of them have.

        Raises:
            InputError: there are no episodes to write, or the folder is not empty.
        """
        from h3data.recording.parquet.writer import DatasetWriter

        if not self.stored:
            raise InputError(f"There are no episodes to write: {root}", code="H3-RECORDING-002")
        rate = round(1e9 / max(self[0].episode.dt_ns, 1))
        cameras = common_cameras(self.stored)
        # `like` reads every episode once more, so that the columns fit the widest one from the beginning
        with DatasetWriter(root, fps=rate, overwrite=overwrite, like=self) as writer:
            for of in self.stored:
                writer.add(of.read(), videos=[video for video in of.read_videos() if video.feature.camera in cameras])

    def _repr_html_(self) -> str:
        return notebook().episodes_html(self, "Episodes")

    def __repr__(self) -> str:
        names = ", ".join(stored.name for stored in self.stored[:3]) + (", ..." if len(self) > 3 else "")
        return f"Episodes({len(self)}: {names})"
