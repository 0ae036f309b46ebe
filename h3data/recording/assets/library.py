"""Meshes for recorded file names: found below the user's folders, generated, or taken from a scene."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from h3data.errors import SceneError
from h3data.mesh.loading import is_file, load_mesh
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import painted
from h3data.mesh.primitives import box_mesh, is_primitive, primitive_mesh
from h3data.recording.assets.folders import CONFIG_ENDING, AssetFolders, clean_path
from h3data.recording.assets.handles import HANDLE, file_of_template
from h3data.recording.assets.placeholders import placeholder_mesh
from h3data.recording.assets.skinned_meshes import SkinnedMesh, load_skinned_mesh
from h3data.recording.records import AssetRef, Body
from h3data.scene.records import Scene
from h3data.scene.sources import object_mesh

OWN_FOLDER_ENDING = ".assets"
"""Suffix of the folder of GLB files that `h3data export --to gfx-replay` writes next to a replay of the same name."""
EMPTY_URI = "primitive:empty"
"""URI of instances without a visible mesh (Habitat's ``invalid_filepath``)."""


class AssetLibrary:
    """Library of meshes for the assets of a recording.

    ``roots`` are folders, or an existing `AssetFolders`. Requested assets that are not found are collected in
    `missing`, and files that cannot be read in `unreadable`.
    """

    def __init__(
        self,
        roots: Sequence[str | Path] | AssetFolders | None = None,
        *,
        scene: Scene | None = None,
        own_folder: Path | None = None,
    ) -> None:
        """Store the user's asset folders, a scene for names ``scene:<asset>``, and the folder of a replay file."""
        self.own_folder = own_folder
        self.folders = roots if isinstance(roots, AssetFolders) else AssetFolders(roots)
        self.scene = scene
        self.missing: list[str] = []
        self.unreadable: dict[str, str] = {}
        """Reasons why asset files could not be read, by URI."""

    def __repr__(self) -> str:
        scene = f", scene {self.scene.name!r}" if self.scene else ""
        return f"AssetLibrary({len(self.roots)} roots{scene}, {len(self.missing)} missing)"

    def with_scene(self, scene: Scene) -> AssetLibrary:
        """Return a library with the same roots and a scene for uris ``scene:<asset>``."""
        return AssetLibrary(self.folders, scene=scene, own_folder=self.own_folder)

    def with_own_folder(self, recorded: object) -> AssetLibrary:
        """Return a library that also searches a replay's own asset folder (``info["source"]["assets"]``), if it still exists.

        The folder is searched after the roots, for paths that start with its name; no other files next to the replay
        are read.
        """
        folder = Path(recorded) if isinstance(recorded, str) and recorded.endswith(OWN_FOLDER_ENDING) else None
        if folder is None or not folder.is_dir():
            return self
        return AssetLibrary(self.folders, scene=self.scene, own_folder=folder)

    @property
    def roots(self) -> tuple[Path, ...]:
        """Folders in which assets are searched."""
        return self.folders.roots

    def resolve(self, uri: str) -> Path | None:
        """Return the file of a recorded path, or None; see `AssetFolders.resolve`."""
        return self.folders.resolve(uri) or self._beside(uri)

    def mesh(self, ref: AssetRef) -> Mesh | None:
        """Return the mesh of an asset in h3data's frame (+Y up, metres); None if it is missing or unreadable."""
        mesh = self._mesh(ref)
        if mesh is not None and ref.color is not None:
            mesh = painted(mesh, ref.color)
        return mesh

    def skinned(self, ref: AssetRef) -> SkinnedMesh | None:
        """Return the skinned mesh of an asset; None if its file is missing, unreadable or has no skin."""
        # a colon marks generated meshes, those of the scene, and handles: no file, so no skin
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
        """Return a striped placeholder for a missing asset, whose size is plausible after ``body.scale`` is applied."""
        del body  # its scale is applied by the renderer; nothing else in the file is known to affect the size
        return placeholder_mesh(clean_path(ref if isinstance(ref, str) else ref.uri))

    def _beside(self, uri: str) -> Path | None:
        """Return a file in the folder that came with the replay."""
        path = PurePosixPath(clean_path(uri))
        # only below the folder itself: a recorded path must not reach what lies beside it
        if self.own_folder is None or path.parts[:1] != (self.own_folder.name,):
            return None
        file = self.own_folder.parent / path
        return file if is_file(file) else None

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
        """Return the mesh of an object that a log names by its handle."""
        configs, meshes = (self.folders.named(name + ending) for ending in (CONFIG_ENDING, ".glb"))
        try:
            file = file_of_template(name, configs, meshes)
            return self._note_missing(uri) if file is None else object_mesh(name, file, self.roots)
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
        # once for each file, as the mesh is asked for again with every body that has it
        if uri not in self.unreadable:
            logging.getLogger(__name__).warning("asset cannot be used: %s", reason)
            self.unreadable[uri] = reason
