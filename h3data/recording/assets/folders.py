"""Files that recordings and configs refer to, searched below the user's asset folders."""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from h3data.errors import SceneError
from h3data.mesh.loading import MESH_SUFFIXES, is_file

CONFIG_ENDING = ".object_config.json"
ASSETS_VARIABLE = "H3DATA_ASSETS"
"""Environment variable with the default asset folders, separated as in PATH."""


class AssetFolders:
    """Asset folders of the user, searched in order; by default the folders in the environment variable H3DATA_ASSETS.

    A root may be the folder that holds ``data``, ``data`` itself, or any folder that contains the files at any depth.

    Raises:
        SceneError: a root is not a folder.
    """

    def __init__(self, roots: Sequence[str | Path] | None = None) -> None:
        given = list(roots or ()) or [r for r in os.environ.get(ASSETS_VARIABLE, "").split(os.pathsep) if r]
        self.roots: tuple[Path, ...] = tuple(Path(r).expanduser() for r in given)
        absent = [str(r) for r in self.roots if not r.is_dir()]
        if absent:
            raise SceneError(
                f"An asset root must be a folder that exists. Not so: {', '.join(absent)}", code="H3-HABITAT-001"
            )
        self._index: dict[str, list[tuple[tuple[str, ...], Path]]] | None = None
        self._resolved: dict[str, Path | None] = {}

    def resolve(self, uri: str) -> Path | None:
        """Return the file of a recorded path, or None.

        The search tries the path below each root, then known aliases of its folder, then the file below a root whose
        path shares the longest end with it. A shared file name alone is not enough (every YCB object is called
        ``textured.glb``): the shared end must hold a hash or number, three names, or a distinctive folder name.
        """
        if uri not in self._resolved:
            path = clean_path(uri)
            found = next((p for p in self._candidates(path) if is_file(p)), None)
            self._resolved[uri] = found or self._longest_end(path)
        return self._resolved[uri]

    def named(self, name: str) -> list[Path]:
        """Return all files with this name, in upper or lower case, in any folder below the roots."""
        return [path for _, path in self._files().get(name.lower(), ())]

    def _candidates(self, path: str) -> Iterable[Path]:
        names = [path]
        # folder names under which the same files have been published (spec/habitat.md 6.6)
        aliases = ("data/fpss", "data/scene_datasets/hssd-hab", "data/scene_datasets/fphab", "hssd-hab")
        for alias in aliases:
            if path.startswith(alias + "/"):
                names += [other + path[len(alias) :] for other in aliases if other != alias]
                names.append(path[len(alias) + 1 :])  # the root is the dataset's own folder
        names += [n.removeprefix("data/") for n in names if n.startswith("data/")]
        for root in self.roots:
            yield from (root / n.lstrip("/") for n in names)

    def _longest_end(self, path: str) -> Path | None:
        parts = tuple(p for p in path.lower().split("/") if p and p != "..")
        if not parts:
            return None
        best: tuple[int, int, str] | None = None
        chosen: Path | None = None
        for names, file in self._files().get(parts[-1], []):
            shared = 0
            while shared < min(len(names), len(parts)) and names[-1 - shared] == parts[-1 - shared]:
                shared += 1
            # the longest shared end, then the shallowest file; the name makes the choice the same on all machines
            rank = (-shared, len(names), str(file))
            if _telling_enough(parts[len(parts) - shared :]) and (best is None or rank < best):
                best, chosen = rank, file
        return chosen

    def _files(self) -> Mapping[str, list[tuple[tuple[str, ...], Path]]]:
        """Return the meshes and object configs below the roots by lower-case name, walked once."""
        if self._index is None:
            self._index = {}
            for root in self.roots:
                for folder, _, names in os.walk(root):
                    for name in names:
                        if name.lower().endswith((*MESH_SUFFIXES, CONFIG_ENDING)):
                            file = Path(folder, name)
                            parts = tuple(p.lower() for p in (root.name, *file.relative_to(root).parts))
                            self._index.setdefault(name.lower(), []).append((parts, file))
        return self._index


def clean_path(uri: str) -> str:
    """Return a recorded path without its material suffix (``?phong_...``) and without ``..``, with forward slashes."""
    path = posixpath.normpath(uri.split("?", 1)[0].replace("\\", "/"))
    while path.startswith("../"):  # relative to a folder that we do not know: never look outside the roots
        path = path[3:]
    return path


def _telling_enough(shared: Sequence[str]) -> bool:
    """Return whether a shared end of two paths is enough to say that they mean the same file."""
    telling = re.compile(r"[0-9a-f]{12,}|\d{3,}|\d+-\d+")
    if len(shared) >= 3 or any(telling.search(name) for name in shared):
        return len(shared) > 0
    # folders that every object of some dataset lies in tell nothing about which object it is
    generic = {"", "google_16k", "visual", "visuals", "collision", "mesh", "meshes", "assets", "textured", "objects"}
    return len(shared) == 2 and shared[0] not in generic
