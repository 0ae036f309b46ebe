"""Handles of Habitat's objects, ``chair_:0000``: an instance of the template ``chair``, whose config or mesh lies somewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from h3data.errors import SceneError

if TYPE_CHECKING:
    from h3data.mesh.mesh import Mesh

HANDLE = "handle:"
"""Begins the uri of an asset that is known by its template's name only."""
_LISTED = 4


def template_of(handle: str) -> str:
    """The template's name in a handle: without the number of the instance and without folders."""
    return handle.split("_:")[0].rsplit("/", 1)[-1] or "object"


def file_of_template(name: str, configs: Sequence[Path], meshes: Sequence[Path]) -> Path | None:
    """The one file that makes the template ``name``: a config goes before a bare mesh; None if there is no file.

    Raises:
        SceneError: several would do; the message lists them.
    """
    for files in (configs, meshes):
        distinct = sorted({file.resolve() for file in files})
        if len(distinct) > 1:
            listed = ", ".join(map(str, distinct[:_LISTED])) + (", ..." if len(distinct) > _LISTED else "")
            raise SceneError(
                f"{len(distinct)} files fit the object handle {name!r}: {listed}. "
                "Hint: give the folder of one dataset only (assets=[DIR])."
            )
        if distinct:
            return distinct[0]
    return None


def template_mesh(name: str, file: Path, roots: Sequence[Path]) -> Mesh:
    """The mesh of an object template, in the frame of the object's logged poses: around its centre of mass [m].

    Habitat puts that at the config's ``COM``, else in the middle of the mesh's box (spec/habitat.md 6.1).

    Raises:
        SceneError: the template cannot be used.
    """
    from h3data.habitat.scenes.config_keys import KeyNotes
    from h3data.habitat.scenes.referenced_files import ReferencedFiles
    from h3data.habitat.scenes.scene_dataset import Template
    from h3data.habitat.scenes.templates import TemplateReader

    files = ReferencedFiles(file, roots)
    reader = TemplateReader(files=files, keys=KeyNotes())
    rigid = reader.rigid(Template(handle=name, path=file))
    if rigid is None:
        why = [*reader.warnings, *(f"{missing!r} was not found" for missing in files.missing)]
        raise SceneError(f"The object template {name!r} cannot be used: {'; '.join(why) or 'it is jointed'}: {file}")
    mesh = reader.assets[rigid.asset].mesh
    placed = mesh.vertices * rigid.scale - rigid.origin(rigid.scale)
    return replace(mesh, vertices=placed.astype(np.float32))
