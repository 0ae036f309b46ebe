"""Reader of Habitat's scenes by path, as an entry point of the group ``h3data.scenes``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from h3data.errors import SceneError
from h3data.mesh.mesh import Mesh
from h3data.scene.records import Scene
from h3data.scene.sources import SceneFile, SceneReader
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.referenced_files import ReferencedFiles
from h3data_habitat.scenes.scene_dataset import DATASET_ENDING, Template, load_scene_dataset
from h3data_habitat.scenes.scene_instance import HABITAT_ENDINGS, load_habitat_scene
from h3data_habitat.scenes.templates import TemplateReader


def read_scene(file: SceneFile) -> Scene:
    """Read a scene of Habitat with the options of the file; fail as `load_habitat_scene` does."""
    return load_habitat_scene(
        file.path, file.scene or None, allow_missing=file.allow_missing, strict=file.strict, assets=file.assets
    )


def template_mesh(name: str, file: Path, roots: Sequence[Path]) -> Mesh:
    """Return the mesh of an object template, in the frame of the object's logged poses: around its centre of mass [m].

    Habitat puts the centre of mass at the config's ``COM``, else in the middle of the mesh's box (spec/habitat.md 6.1).

    Raises:
        SceneError: the template cannot be used.
    """
    files = ReferencedFiles(file, roots)
    reader = TemplateReader(files=files, keys=KeyNotes())
    rigid = reader.rigid(Template(handle=name, path=file))
    if rigid is None:
        why = [*reader.warnings, *(f"{missing!r} was not found" for missing in files.missing)]
        raise SceneError(
            f"The object template {name!r} cannot be used: {'; '.join(why) or 'it is jointed'}: {file}",
            code="H3-HABITAT-115",
        )
    mesh = reader.assets[rigid.asset].mesh
    # logs have poses of the centre of mass
    placed = mesh.vertices * rigid.scale - rigid.origin(rigid.scale)
    return replace(mesh, vertices=placed.astype(np.float32))


def scenes_with_objects(
    scenes: Sequence[Scene], objects: Path, assets: Sequence[str | Path]
) -> tuple[list[Scene], int, Mapping[str, Mapping[str, Any]]]:
    """Return the scenes with objects of the YCB set or of Habitat's object configs, how many, and facts of every object."""
    from h3data_habitat.object_models import load_object_models, with_object_models

    models = load_object_models(objects, assets=assets)
    changed = [with_object_models(scene, models) for scene in scenes]
    facts = {name: model.facts() for name, model in models.items()}
    return [scene for scene, _ in changed], sum(count for _, count in changed), facts


def write_dataset(
    scenes: Sequence[Scene],
    folder: str | Path,
    *,
    name: str | None = None,
    split_building: bool = False,
    force: bool = False,
) -> Path:
    """Write scenes as a scene dataset; see `export_habitat_dataset`, which is imported at first use."""
    from h3data_habitat.exporters.scenes import export_habitat_dataset

    return export_habitat_dataset(scenes, folder, name=name, split_building=split_building, force=force)


HABITAT = SceneReader(
    endings=HABITAT_ENDINGS,
    read=read_scene,
    collection=DATASET_ENDING,
    open_collection=load_scene_dataset,
    scenes_in=lambda path: load_scene_dataset(path).scenes,
    object_mesh=template_mesh,
    write_collection=write_dataset,
    with_objects=scenes_with_objects,
)
