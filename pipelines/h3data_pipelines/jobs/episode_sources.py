"""Every episode below some paths, each with a name, to be read one after the other."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from h3data.errors import H3DataError
from h3data.recording.storage import AnyPath, place
from h3data_pipelines.command import open_episode

if TYPE_CHECKING:
    from h3data.recording import Dataset, Recording


@dataclass(frozen=True, eq=False)
class EpisodeSource:
    """One episode that can be read."""

    name: str
    """Path of the file, or ``ds#3``."""
    path: AnyPath
    """The file, or the dataset's folder."""
    dataset: Dataset | None = None
    index: int = 0
    """Its number in the dataset."""
    fault: H3DataError | None = None
    """Why there is nothing to read."""

    def read(self) -> Recording:
        """The recording.

        Raises:
            H3DataError: it cannot be read.
        """
        if self.fault is not None:
            raise self.fault
        return open_episode(self.path) if self.dataset is None else self.dataset.recording(self.index)


def find_episodes(paths: Iterable[AnyPath]) -> list[EpisodeSource]:
    """Every episode of ``.mcap`` files, datasets, single episodes (``ds#3``), and folders of all of these, which are walked.

    What cannot be opened is in the list too: reading it fails.

    Raises:
        InputError: there is no such path, or nothing below it.
    """
    from h3data.metrics.batch import find_sources
    from h3data.recording.parquet.files import is_dataset

    sources: list[EpisodeSource] = []
    for path in map(place, paths):
        if not path.is_dir():
            sources.append(EpisodeSource(str(path), path))
        elif is_dataset(path):
            sources += _of_dataset(path)
        else:
            for source in find_sources([path]):
                sources += _of_dataset(source) if source.is_dir() else [EpisodeSource(str(source), source)]
    return sources


def _of_dataset(root: AnyPath) -> list[EpisodeSource]:
    from h3data.recording import Dataset

    try:
        dataset = Dataset(root)
        return [EpisodeSource(f"{root}#{k}", root, dataset, k) for k in range(len(dataset))]
    except H3DataError as fault:
        return [EpisodeSource(str(root), root, fault=fault)]
