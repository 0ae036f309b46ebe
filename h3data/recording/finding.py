"""Search of paths and their subfolders for datasets, logs, and the episodes in them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from h3data.errors import H3DataError, InputError
from h3data.recording.episodes import StoredEpisode
from h3data.recording.opening import logs_in, open_recording, open_steps
from h3data.recording.parquet.dataset import Dataset
from h3data.recording.parquet.files import is_dataset
from h3data.recording.parquet.videos import EpisodeVideo
from h3data.recording.records import Recording
from h3data.recording.schema import episode_to_dict
from h3data.recording.storage import AnyPath, RemotePath, place


def find_sources(paths: Iterable[str | os.PathLike[str] | RemotePath]) -> Iterator[AnyPath]:
    """Yield the datasets and MCAP logs at paths; for any other folder, the logs and then the datasets below it."""
    for path in map(place, paths):
        # a folder with `meta` is taken for a dataset even without info.json, so that its damage is reported
        if not path.is_dir() or (path / "meta").is_dir() or is_dataset(path):
            yield path
            continue
        datasets = sorted({file.parent.parent for file in path.rglob("meta/info.json")})
        logs = [log for log in logs_in(path, below=True) if not any(root in log.parents for root in datasets)]
        if not logs and not datasets:
            raise InputError(f"No recording (.mcap) and no dataset in this folder: {path}", code="H3-RECORDING-007")
        yield from (*logs, *datasets)


def find_episodes(paths: Iterable[str | os.PathLike[str] | RemotePath]) -> list[StoredEpisode]:
    """Find every episode of ``.mcap`` files, datasets, single episodes (``ds#3``), and folders of all of these.

    Episodes that cannot be opened are listed too, and raise an error when they are read.

    Raises:
        InputError: there is no such path, or it contains no episodes.
    """
    stored: list[StoredEpisode] = []
    for path in map(place, paths):
        if not path.is_dir():
            stored.append(stored_log(path))
        elif is_dataset(path):
            stored += _of_dataset(path)
        else:
            for source in find_sources([path]):
                stored += _of_dataset(source) if source.is_dir() else [stored_log(source)]
    return stored


def stored_log(path: AnyPath) -> StoredEpisode:
    """Return the episode in a log, or one episode of a dataset (``ds#3``), which is opened when it is read."""

    def in_dataset() -> tuple[Dataset, int] | None:
        root, sign, number = str(path).rpartition("#")
        # a file of that very name is a file, although its name ends like the number of an episode
        return (Dataset(root), int(number)) if sign and number.isdecimal() and not path.exists() else None

    def read() -> Recording:
        opened = open_recording(path)
        if isinstance(opened, Dataset):
            raise InputError(f"Expected a recording (.mcap), this is a dataset: {path}", code="H3-RECORDING-006")
        return opened

    def read_facts() -> Mapping[str, Any]:
        if found := in_dataset():
            return found[0].row(found[1])
        with open_steps(path) as steps:
            episode = steps.recording(0, 0).episode
            # `Steps.recording` notes the window of steps that it cut out, which is no fact of the episode
            info = {name: value for name, value in episode.info.items() if name != "window"}
            return {**episode_to_dict(episode), "info": info, "length": len(steps)}

    def read_videos() -> Sequence[EpisodeVideo]:
        return found[0].videos(found[1]) if (found := in_dataset()) else ()

    return StoredEpisode(str(path), path, read, read_facts, read_videos=read_videos)


def _of_dataset(root: AnyPath) -> list[StoredEpisode]:
    try:
        return list(Dataset(root).all().stored)
    except H3DataError as error:
        fault = error  # Python deletes the name of the `except` at its end

    def fail() -> Any:
        raise fault

    # one entry that fails when it is read: jobs over many datasets report it and go on with the others
    return [StoredEpisode(str(root), root, fail, fail)]
