"""Recorded file names to meshes: looked up below the user's folders, generated, or taken from a scene."""

from __future__ import annotations

import logging
import os
import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from h3data.errors import SceneError
from h3data.habitat.placeholders import placeholder_mesh
from h3data.habitat.scenes.object_handles import CONFIG_ENDING, HANDLE, file_of_template, template_mesh
from h3data.habitat.skinned_meshes import SkinnedMesh, load_skinned_mesh
from h3data.mesh.loading import MESH_SUFFIXES, is_file, load_mesh
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import painted
from h3data.mesh.primitives import box_mesh, is_primitive, primitive_mesh
from h3data.recording.records import AssetRef, Body
from h3data.scene.records import Scene

_log = logging.getLogger(__name__)

ASSETS_VARIABLE = "H3DATA_ASSETS"
"""Environment variable with the default asset folders, separated as in PATH."""

EMPTY_URI = "primitive:empty"
"""An instance that the recording shows as nothing (Habitat's ``invalid_filepath``)."""

_ALIASES = ("data/fpss", "data/scene_datasets/hssd-hab", "data/scene_datasets/fphab", "hssd-hab")
"""Folder names under which the same files have been published (spec/habitat.md 6.6)."""

_GENERIC_FOLDERS = {
    "",
    "google_16k",
    "visual",
    "visuals",
    "collision",
    "mesh",
    "meshes",
    "assets",
    "textured",
    "objects",
}
_TELLING = re.compile(r"[0-9a-f]{12,}|\d{3,}|\d+-\d+")


class AssetLibrary:
    """Finds meshes for the assets of a recording.

    ``roots`` are the user's folders, searched in order; without any, those of the environment variable H3DATA_ASSETS.
    A root may be the folder that holds ``data``, ``data`` itself, or any folder in which the files lie somewhere.
    What was asked for and not found collects in `missing`, files that cannot be read in `unreadable`.
    """

    def __init__(self, roots: Sequence[str | Path] | None = None, *, scene: Scene | None = None) -> None:
        given = list(roots or ()) or [r for r in os.environ.get(ASSETS_VARIABLE, "").split(os.pathsep) if r]
        self.roots: tuple[Path, ...] = tuple(Path(r).expanduser() for r in given)
        absent = [str(r) for r in self.roots if not r.is_dir()]
        if absent:
            raise SceneError(f"An asset root must be a folder that exists. Not so: {', '.join(absent)}")
        self.scene = scene
        self.missing: list[str] = []
        self.unreadable: dict[str, str] = {}
        """Reason by uri."""
        self._index: dict[str, list[tuple[tuple[str, ...], Path]]] | None = None
        self._resolved: dict[str, Path | None] = {}

    def __repr__(self) -> str:
        scene = f", scene {self.scene.name!r}" if self.scene else ""
        return f"AssetLibrary({len(self.roots)} roots{scene}, {len(self.missing)} missing)"

    def with_scene(self, scene: Scene) -> AssetLibrary:
        """The same roots with a scene that answers ``scene:<asset>``."""
        other = AssetLibrary(self.roots, scene=scene)
        other._index, other._resolved = self._index, self._resolved
        return other

    def resolve(self, uri: str) -> Path | None:
        """The file that a recorded path means, or None.

        Tried in this order: the path below each root, the same with the known aliases of its folder, then the file
        below a root that shares the longest end of the path. A shared file name alone is not enough (every YCB object
        is called ``textured.glb``): the shared end must hold a hash or number, three names, or a telling folder.
        """
        if uri not in self._resolved:
            path = clean_path(uri)
            found = next((p for p in self._candidates(path) if is_file(p)), None)
            self._resolved[uri] = found or self._longest_end(path)
        return self._resolved[uri]

    def mesh(self, ref: AssetRef) -> Mesh | None:
        """The mesh of an asset in our frame and metres; None if it is missing or unreadable."""
        mesh = self._mesh(ref)
        if mesh is not None and ref.color is not None:
            mesh = painted(mesh, ref.color)
        return mesh

    def skinned(self, ref: AssetRef) -> SkinnedMesh | None:
        """The skinned mesh of an asset; None if its file is missing, unreadable or has no skin."""
        path = None if ":" in ref.uri else self.resolve(ref.uri)
        if path is None:
            return None
        try:
            found = load_skinned_mesh(path, up=ref.up, front=ref.front, units_m=ref.units_m)
        except SceneError as fault:
            self._note_unreadable(ref.uri, str(fault))
            return None
        return found if found is None or ref.color is None else replace(found, mesh=painted(found.mesh, ref.color))

    def placeholder(self, ref: AssetRef | str, body: Body | None = None) -> Mesh:
        """A clearly marked stand-in for a missing asset, of a plausible size once ``body.scale`` is applied."""
        del body  # its scale is applied by whoever draws it; nothing else of it is known to bear on the size
        return placeholder_mesh(clean_path(ref if isinstance(ref, str) else ref.uri))

    def _mesh(self, ref: AssetRef) -> Mesh | None:
        kind, _, name = ref.uri.partition(":")
        if ref.uri == EMPTY_URI:
            return primitive_mesh("cubeWireframe")
        if kind == "primitive":
            return box_mesh((1, 1, 1)) if name == "box" else self._generated(ref.uri, name)
        if is_primitive(ref.uri):
            return self._generated(ref.uri, ref.uri)
        if kind == "scene":
            asset = None if self.scene is None else self.scene.assets.get(name)
            return self._note_missing(ref.uri) if asset is None else asset.mesh
        if ref.uri.startswith(HANDLE):
            return self._template(ref.uri, name)
        path = self.resolve(ref.uri)
        if path is None:
            return self._note_missing(ref.uri)
        try:
            return load_mesh(path, up=ref.up, front=ref.front, units_m=ref.units_m)
        except SceneError as fault:
            return self._note_unreadable(ref.uri, str(fault))

    def _template(self, uri: str, name: str) -> Mesh | None:
        """The mesh of an object that a log names by its handle."""
        configs, meshes = (
            [path for _, path in self._files().get(name.lower() + ending, ())] for ending in (CONFIG_ENDING, ".glb")
        )
        try:
            file = file_of_template(name, configs, meshes)
            return self._note_missing(uri) if file is None else template_mesh(name, file, self.roots)
        except SceneError as fault:
            return self._note_unreadable(uri, str(fault))

    def _generated(self, uri: str, name: str) -> Mesh | None:
        try:
            return primitive_mesh(name)
        except SceneError as fault:
            return self._note_unreadable(uri, str(fault))

    def _note_missing(self, uri: str) -> None:
        if uri not in self.missing:
            self.missing.append(uri)

    def _note_unreadable(self, uri: str, reason: str) -> None:
        if uri not in self.unreadable:
            _log.warning("asset cannot be used: %s", reason)
            self.unreadable[uri] = reason

    # --- looking for files --------------------------------------------------------------------------------------------
    def _candidates(self, path: str) -> Iterable[Path]:
        names = [path]
        for alias in _ALIASES:
            if path.startswith(alias + "/"):
                names += [other + path[len(alias) :] for other in _ALIASES if other != alias]
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
            rank = (-shared, len(names), str(file))
            if _telling_enough(parts[len(parts) - shared :]) and (best is None or rank < best):
                best, chosen = rank, file
        return chosen

    def _files(self) -> Mapping[str, list[tuple[tuple[str, ...], Path]]]:
        """Meshes and object configs below the roots by lower-case name, walked once."""
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
    """A recorded path without its material suffix (``?phong_...``) and without ``..``, with forward slashes."""
    path = posixpath.normpath(uri.split("?", 1)[0].replace("\\", "/"))
    while path.startswith("../"):  # relative to a folder that we do not know: never look outside the roots
        path = path[3:]
    return path


def _telling_enough(shared: Sequence[str]) -> bool:
    """Whether a shared end of two paths is enough to say that they mean the same file."""
    if len(shared) >= 3 or any(_TELLING.search(name) for name in shared):
        return len(shared) > 0
    return len(shared) == 2 and shared[0] not in _GENERIC_FOLDERS
