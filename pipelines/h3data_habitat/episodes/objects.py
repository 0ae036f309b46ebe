"""Objects that an episode adds to its scene, read from templates, with striped boxes for missing objects."""

from __future__ import annotations

import posixpath
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError
from h3data.geometry import quat_rotate
from h3data.mesh.loading import is_file
from h3data.recording.assets.handles import HANDLE, file_of_template
from h3data.recording.assets.placeholders import placeholder_mesh
from h3data.recording.task_episodes.rearrange_episode import template_name
from h3data.recording.task_episodes.stored_rearrangements import EpisodeObject
from h3data.scene.records import Asset, Instance, Scene
from h3data.scene.sources import SceneFile, SceneSource
from h3data_habitat.scene_files import dataset_at, folders_of
from h3data_habitat.scenes.collision_geometry import box_shape
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.referenced_files import ReferencedFiles
from h3data_habitat.scenes.scene_dataset import DATASET_ENDING, Template, dataset_above
from h3data_habitat.scenes.scene_instance import INSTANCE_ENDING
from h3data_habitat.scenes.templates import TemplateReader


class ObjectSearch(NamedTuple):
    """Search for templates of objects."""

    dataset: str = ""
    """Path of a ``*.scene_dataset_config.json`` whose object templates are searched first."""
    paths: tuple[str, ...] = ()
    """Folders in Habitat's ``additional_obj_config_paths``: searched as given, then below the asset folders."""
    assets: tuple[str, ...] = ()
    """Asset folders; empty for those of H3DATA_ASSETS."""


class ReadObject(NamedTuple):
    """An object template that has been read."""

    asset: Asset
    scale: NDArray[np.float64]
    """Scale of the object along each axis, shape [3]."""
    origin: NDArray[np.float64]
    """Centre of mass in the asset's frame, [3] [m]."""
    semantic_id: int
    missing: str
    """Reason why a box replaces the object; empty if the object is available."""


def search_of(scene: Scene, paths: Sequence[str], assets: Sequence[str]) -> ObjectSearch:
    """Return the search for an episode that is played in a scene."""
    config = str(scene.source.get("config", ""))
    return ObjectSearch(config if config.endswith(DATASET_ENDING) else "", tuple(paths), tuple(assets))


def search_in(source: SceneSource, paths: Sequence[str]) -> ObjectSearch:
    """Return the folders in which objects are searched, before the scene has been opened."""
    if not isinstance(source, SceneFile):
        return ObjectSearch(paths=tuple(paths))
    config = source.path
    if config.endswith(INSTANCE_ENDING):
        config = str(dataset_above(Path(config)).path)
    return ObjectSearch(config if config.endswith(DATASET_ENDING) else "", tuple(paths), source.assets)


def with_objects(
    scene: Scene, objects: Sequence[EpisodeObject], search: ObjectSearch
) -> tuple[Scene, Mapping[str, NDArray[np.float64]]]:
    """Return the scene with an episode's objects, and each object's centre of mass [3] [m] in its asset's frame."""
    own = {thing.name for thing in objects}
    taken = {i.name for i in scene.instances}
    instances = [replace(i, name=_free(i.name, own | taken)) if i.name in own else i for i in scene.instances]
    assets, origins = dict(scene.assets), {}
    names: dict[str, str] = {}
    missing: dict[str, str] = {}
    for thing in objects:
        read = read_object_template(thing.config, search)
        if thing.config not in names:
            name = read.asset.name if read.asset.name not in assets else _free(read.asset.name, assets)
            assets[name], names[thing.config] = replace(read.asset, name=name), name
        if read.missing:
            missing[thing.config] = read.missing
        pose = np.array(thing.pose, np.float64)
        # episodes give poses of the centre of mass, instances have those of the asset's origin
        pose[:3] -= quat_rotate(pose[3:], read.origin)
        instances.append(
            Instance(
                name=thing.name,
                asset=names[thing.config],
                pose=pose,
                scale=read.scale,
                semantic_id=read.semantic_id,
                motion="kinematic",
            )
        )
        origins[thing.name] = read.origin
    warnings = [*scene.source.get("warnings", ()), *missing.values()]
    source = {**scene.source, **({"warnings": warnings} if warnings else {})}
    return replace(scene, assets=assets, instances=tuple(instances), source=source), origins


def _free(name: str, taken: Container[str]) -> str:
    """Return the name with as many tildes as make it unique; Habitat counts an episode's objects without the scene's."""
    name += "~"
    return name if name not in taken else _free(name, taken)


@lru_cache(maxsize=4096)
def read_object_template(config: str, search: ObjectSearch) -> ReadObject:
    """Return the object of a template (``024_bowl.object_config.json``), or a box of 10 cm if it is not available."""
    handle = template_name(config)
    try:
        template = _find(config, search)
        why = "its template is not found"
        if template is not None:
            files = ReferencedFiles(template.path, search.assets)
            reader = TemplateReader(files=files, keys=KeyNotes())
            rigid = reader.rigid(template)
            if rigid is not None and np.all(rigid.scale):
                return ReadObject(
                    reader.assets[rigid.asset],
                    rigid.scale,
                    np.asarray(rigid.origin(rigid.scale), np.float64),
                    int(rigid.attributes.get("semantic_id", 0) or 0),
                    "",
                )
            why = (
                "; ".join([*reader.warnings, *(f"{name!r} is not found" for name in files.missing)]) or "it is jointed"
            )
    except H3DataError as fault:
        why = str(fault)
    mesh = placeholder_mesh(HANDLE + handle)
    box = Asset(name=handle, mesh=mesh, shapes=(box_shape(mesh.vertices),))
    return ReadObject(box, np.ones(3), np.zeros(3), 0, f"a box stands in for {handle!r}: {why}")


def _find(config: str, search: ObjectSearch) -> Template | None:
    handle = template_name(config)
    if search.dataset:
        found, _ = dataset_at(search.dataset).find("objects", handle)
        # the exact name only: a part of a name may find another object
        if found is not None and found.handle == handle:
            return found
    file = posixpath.basename(config) if config.endswith(".json") else f"{handle}.object_config.json"
    folders = folders_of(search.assets)
    for path in search.paths:
        direct = Path(path, file)
        resolved = direct if is_file(direct) else folders.resolve(posixpath.join(path, file))
        if resolved is not None:
            return Template(handle=handle, path=resolved)
    by_name = file_of_template(handle, folders.named(file), folders.named(f"{handle}.glb"))
    return None if by_name is None else Template(handle=handle, path=by_name)
