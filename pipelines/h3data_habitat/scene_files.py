"""Search for scene files of recordings and episodes below the user's asset folders."""

from __future__ import annotations

import functools
import os
from pathlib import Path, PurePosixPath
from typing import Protocol

from h3data.recording.assets.folders import AssetFolders, clean_path
from h3data_habitat.scenes.scene_dataset import SceneDataset, load_scene_dataset
from h3data_habitat.scenes.scene_instance import HABITAT_ENDINGS


class Folders(Protocol):
    """Protocol of asset folders, such as `AssetFolders` or `AssetLibrary`."""

    @property
    def roots(self) -> tuple[Path, ...]:
        """Folders in which files are searched."""
        ...

    def resolve(self, uri: str) -> Path | None:
        """Return the file of a recorded path."""
        ...


def find_scene_file(path: str, folders: Folders | None) -> Path | None:
    """Return the recorded path below a root, the longest end of it that leads to a file, or the only file of its name."""
    path = clean_path(path) if path else ""
    if folders is None or not path.lower().endswith(HABITAT_ENDINGS):
        return None
    found = folders.resolve(path)
    if found is not None:
        return found
    parts = PurePosixPath(path).parts
    tails = [Path(root, *parts[k:]) for root in folders.roots for k in range(len(parts)) if parts[k] != "/"]
    tail = next((tail for tail in tails if tail.is_file()), None)
    if tail is not None:
        return tail
    named = {file for root in folders.roots for file in _files_named(root, parts[-1])}
    # several files of the name may be several scenes
    return named.pop() if len(named) == 1 else None


@functools.cache  # every episode of a session names the same scene, and a set such as HSSD has 100,000 files
def _files_named(root: Path, name: str) -> tuple[Path, ...]:
    return tuple(Path(folder, name).resolve() for folder, _, files in os.walk(root) if name in files)


@functools.lru_cache(maxsize=16)
def folders_of(assets: tuple[str, ...]) -> AssetFolders:
    """Return asset folders, each searched only once; an empty tuple selects those of H3DATA_ASSETS."""
    return AssetFolders(assets)


@functools.lru_cache(maxsize=16)
def dataset_at(path: str) -> SceneDataset:
    """Return the scene dataset of a config, which is read only once."""
    return load_scene_dataset(Path(path))
