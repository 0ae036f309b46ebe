"""Search for the files that Habitat's configs name, within the folders that a config may reach."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from h3data.errors import SceneError
from h3data.mesh.loading import is_file
from h3data.recording.assets.folders import AssetFolders
from h3data_habitat.scenes.scene_dataset import DATASET_ENDING

_LEVELS = 4
"""Number of levels above a config at which its dataset's config is looked for."""


class ReferencedFiles:
    """Search for the files of one scene.

    As in habitat-sim a path is tried as it stands (absolute, or relative to the working directory), then relative to
    the config that names it; after that below the user's asset folders (`AssetFolders`: with the known aliases of
    dataset folders, or H3DATA_ASSETS). A file must lie in the config's dataset, in a folder ``data`` around it, in the
    working directory or in an asset folder: a dataset from another source cannot cause other files to be opened.
    """

    def __init__(self, config: Path, assets: Sequence[str | Path] | None = None) -> None:
        self._folders = AssetFolders(assets)
        self._inside = (*trusted_folders(config), Path.cwd(), *(Path(os.path.abspath(r)) for r in self._folders.roots))
        self.missing: dict[str, tuple[Path, ...]] = {}
        """Places at which each missing file was searched."""

    def find(self, name: str, folder: Path) -> Path | None:
        """Return the file that a config in ``folder`` refers to; None if it does not exist.

        Raises:
            SceneError: the file is outside the folders that may be reached.
        """
        # made absolute without following links: what is linked into a dataset belongs to it
        tried = tuple(Path(os.path.abspath(p)) for p in dict.fromkeys((Path(name), folder / name)))
        outside: Path | None = None
        for path in tried:
            if is_file(path):
                if any(path.is_relative_to(root) for root in self._inside):
                    return path
                outside = path
        found = self._folders.resolve(name)
        if found is not None:
            return found
        # only after the asset folders, which may hold the same file
        if outside is not None:
            raise SceneError(
                f"{name!r} leads out of the dataset, so it is not opened. Hint: give the folder that holds it as an asset "
                f"folder (assets=[DIR] or H3DATA_ASSETS). {outside}",
                code="H3-HABITAT-118",
            )
        self.missing[name] = (*tried, *self._folders.roots)
        return None


def trusted_folders(config: Path) -> tuple[Path, ...]:
    """Return the folder of the dataset to which a config belongs, and the nearest folder ``data`` around it, if there is one.

    The dataset's folder is the nearest one above with a ``*.scene_dataset_config.json``, else the one that holds the
    config's folder (YCB: ``configs`` beside ``meshes``). Links are not followed: files that are linked into a dataset
    belong to it.
    """
    above = Path(os.path.abspath(config)).parents
    dataset = next((f for f in above[:_LEVELS] if any(f.glob("*" + DATASET_ENDING))), None)
    if dataset is None:
        dataset = above[1] if len(above) > 2 else above[0]  # never the root of the file system
    data = next((f for f in above if f.name == "data"), None)
    return (dataset,) if data is None else (dataset, data)
