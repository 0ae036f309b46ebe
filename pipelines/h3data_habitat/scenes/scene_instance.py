"""Habitat's scenes (dataset configs, scene instances, stages, objects, articulated objects) as `Scene` records."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from h3data.errors import FormatError, SceneError
from h3data.mesh.loading import MESH_SUFFIXES
from h3data.scene.records import Scene
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.config_values import mapping, objects, read_object, text, texts
from h3data_habitat.scenes.lights import read_lights
from h3data_habitat.scenes.referenced_files import ReferencedFiles
from h3data_habitat.scenes.scene_builder import SceneBuilder
from h3data_habitat.scenes.scene_dataset import (
    DATASET_ENDING,
    SceneDataset,
    Template,
    dataset_above,
    load_scene_dataset,
)
from h3data_habitat.scenes.semantics import read_lexicon, read_rooms
from h3data_habitat.scenes.templates import TemplateReader

INSTANCE_ENDING = ".scene_instance.json"
_SINGLE_ENDINGS = (".stage_config.json", ".object_config.json", ".ao_config.json", ".urdf", *MESH_SUFFIXES)
HABITAT_ENDINGS = (DATASET_ENDING, INSTANCE_ENDING, *_SINGLE_ENDINGS)
"""Endings of the files that `load_habitat_scene` opens."""


def load_habitat_scene(
    path: str | Path,
    scene: str | None = None,
    *,
    allow_missing: bool = False,
    strict: bool = False,
    assets: Sequence[str | Path] | None = None,
) -> Scene:
    """Return a Habitat scene, from any of the files by which Habitat users name one (spec/habitat.md 6.1-6.4).

    ``path`` is a ``*.scene_dataset_config.json`` (then ``scene``, or what follows a ``#`` after the path, names one of
    its scene instances; a part of the name is enough), a ``*.scene_instance.json``, or one thing alone: a
    ``*.stage_config.json``, ``*.object_config.json``, ``*.ao_config.json``, ``*.urdf`` or a stage mesh. As in habitat-sim
    a bare stage mesh is taken as Z-up, (x, y, z) -> (x, z, -y); a config without axes as Y-up. A stage instance's own
    translation is ignored, as habitat-sim ignores it.

    Object poses are those of the asset's frame: positions that are given for the centre of mass (the default, Habitat's
    ``COM``) are moved to the asset's origin. Objects collide as one convex hull per node and connected piece of their
    collision asset, else of what is seen; the stage has no parts. Links of articulated objects stand where the initial
    joint positions put them, as static instances ``<object>/<link>``. Regions become rooms, lighting configs
    ``Scene.lights``, and a receptacle filter decides which receptacles are in use.

    Files are searched by the rules of `ReferencedFiles`, last below ``assets`` (default: H3DATA_ASSETS).
    ``Scene.source`` states what was left out or guessed (``warnings``), which keys were not read (``ignored_keys``,
    reasons in `h3data_habitat.scenes.config_keys`), and the file of the navmesh (``navmesh``), if the scene has one.

    Raises:
        FormatError: a config has the wrong form; the message names key and file.
        MissingAssetError: files do not exist, unless ``allow_missing`` leaves out their instances with a warning.
        SceneError: there is no such scene, or its stage cannot be used; with ``strict`` also any warning.
    """
    # a # may be part of the name of another file, so only behind the ending of a dataset
    path = Path(path)
    config, named = dataset_and_scene(path)
    if config is not None and scene is None:
        path, scene = config, named
    if not path.exists():
        raise SceneError(f"There is no such scene file: {path}", code="H3-HABITAT-125")
    if path.name.endswith(DATASET_ENDING):
        dataset = load_scene_dataset(path)
        template = _chosen(dataset, scene)
        return _from_instance(_builder(path, dataset.keys, allow_missing, strict, assets), dataset, template)
    if scene is not None:
        raise SceneError(
            f"A scene name ({scene!r}) can only be given with a *{DATASET_ENDING}, not with: {path}",
            code="H3-HABITAT-126",
        )
    if path.name.endswith(INSTANCE_ENDING):
        dataset = dataset_above(path)
        template = next(t for t in dataset.sections["scene_instances"] if t.path.resolve() == path.resolve())
        return _from_instance(_builder(dataset.path, dataset.keys, allow_missing, strict, assets), dataset, template)
    if path.name.lower().endswith(_SINGLE_ENDINGS):
        return _alone(_builder(path, KeyNotes(), allow_missing, strict, assets), path)
    raise FormatError(
        f"Expected a Habitat scene ({', '.join('*' + e for e in HABITAT_ENDINGS)}): {path}", code="H3-HABITAT-124"
    )


def dataset_and_scene(path: str | os.PathLike[str]) -> tuple[Path | None, str | None]:
    """Return the dataset config and the scene that ``x.scene_dataset_config.json#scene`` names.

    Other paths give (None, None).
    """
    before, mark, scene = os.fspath(path).rpartition(DATASET_ENDING + "#")
    return (Path(before + DATASET_ENDING), scene) if mark else (None, None)


def _builder(
    config: Path, keys: KeyNotes, allow_missing: bool, strict: bool, assets: Sequence[str | Path] | None
) -> SceneBuilder:
    templates = TemplateReader(files=ReferencedFiles(config, assets), keys=keys)
    return SceneBuilder(templates=templates, allow_missing=allow_missing, strict=strict)


def _alone(builder: SceneBuilder, path: Path) -> Scene:
    """Return a stage, or one object whose own origin is the world's."""
    template = Template(handle=path.name.split(".")[0], path=path)
    if path.name.endswith(".object_config.json"):
        builder.add_object(template, {}, origin="asset_local", where=path)
    elif path.name.endswith((".ao_config.json", ".urdf")):
        builder.add_articulated(template, {}, where=path)
    else:
        builder.add_stage(template)
    scene = builder.scene(template.handle, config=path, scene="")
    if not scene.instances and not builder.allow_missing:  # there is nothing else in this scene
        raise SceneError(
            "; ".join(scene.source["warnings"]) or f"There is nothing to be seen in: {path}", code="H3-HABITAT-127"
        )
    return scene


def _chosen(dataset: SceneDataset, scene: str | None) -> Template:
    names = dataset.scenes
    if scene is None and len(names) == 1:
        scene = names[0]
    shown = ", ".join(names[:12]) + (f", ... ({len(names)} in all)" if len(names) > 12 else "") or "none"
    if scene is None:
        raise SceneError(
            f"Which scene? Give it as path#scene. This dataset has: {shown}. {dataset.path}", code="H3-HABITAT-128"
        )
    template, others = dataset.find("scene_instances", scene)
    if template is None:
        raise SceneError(
            f"No scene matches {scene!r}. This dataset has: {shown}. {dataset.path}", code="H3-HABITAT-129"
        )
    if others:
        raise SceneError(
            f"{others + 1} scenes match {scene!r}: say more. This dataset has: {shown}. {dataset.path}",
            code="H3-HABITAT-130",
        )
    return template


def _from_instance(builder: SceneBuilder, dataset: SceneDataset, template: Template) -> Scene:
    content, where = template.attributes(), template.path
    builder.templates.keys.note("scene_instance", content)
    _add_semantics(builder, dataset, content, where)
    _add_stage(builder, dataset, content, where)
    # all of them, before any error: the first missing template is rarely the only one
    absent: list[str] = []
    origin = text(content, "translation_origin", where=where)
    for entry in objects(content, "object_instances", where=where):
        name = _template_name(entry, where)
        if (found := builder.find(dataset, "objects", name)) is None:
            absent.append(name)
        else:
            builder.add_object(found, entry, origin=origin, where=where)
    for entry in objects(content, "articulated_object_instances", where=where):
        name = _template_name(entry, where)
        if (found := builder.find(dataset, "articulated_objects", name)) is None:
            absent.append(name)
        else:
            builder.add_articulated(found, entry, where=where)
    if absent:
        fault = f"Objects without a template in the dataset: {len(absent)}, the first is {absent[0]!r}"
        if dataset.empty_paths:
            fault += f"; nothing is found below its paths {', '.join(map(repr, dataset.empty_paths[:5]))}"
        if not builder.allow_missing:
            raise SceneError(f"{fault}. Hint: allow_missing=True leaves them out. {where}", code="H3-HABITAT-133")
        builder.warn(fault)
    _add_lights(builder, dataset, content, where)
    _add_navmesh(builder, dataset, content, where)
    _use_filter(builder, dataset, content, where)
    return builder.scene(template.handle, config=dataset.path, scene=template.handle)


def _add_stage(builder: SceneBuilder, dataset: SceneDataset, content: Mapping[str, Any], where: Path) -> None:
    if content.get("stage_instance") is None:
        builder.warn(f"the scene has no stage_instance: {where}")
        return
    entry = mapping(content, "stage_instance", where=where)
    builder.templates.keys.note("stage_instance", entry)
    name = _template_name(entry, where)
    if name == "NONE":  # habitat-sim's name of an empty stage
        return
    found = builder.find(dataset, "stages", name)
    if found is None:
        raise SceneError(
            f"The stage {name!r} of this scene is not in the dataset {dataset.path.name}: {where}",
            code="H3-HABITAT-131",
        )
    if entry.get("translation") or entry.get("rotation"):
        builder.warn("the stage instance's own translation and rotation are ignored, as in habitat-sim")
    builder.add_stage(found)


def _add_semantics(builder: SceneBuilder, dataset: SceneDataset, content: Mapping[str, Any], where: Path) -> None:
    """Add rooms, and the names of the classes that semantic ids stand for."""
    name = text(content, "semantic_scene_instance", where=where)
    if not name:
        return
    found = builder.find(dataset, "semantic_scene_descriptor_instances", dataset.descriptors.get(name, name))
    if found is None:
        builder.warn(f"the semantic scene {name!r} is not in the dataset {dataset.path.name}")
        return
    semantics = found.attributes()
    builder.rooms, warnings = read_rooms(semantics, builder.templates.keys, where=found.path)
    for warning in warnings:
        builder.warn(warning)
    lexicon = text(semantics, "semantic_descriptor_filename", where=found.path)
    if not lexicon:
        return
    file = builder.templates.files.find(lexicon, found.path.parent)
    if file is None:
        builder.warn(f"the lexicon {lexicon!r} does not exist: {found.path}")
    elif file.name.endswith(".json"):
        builder.templates.classes = read_lexicon(read_object(file), where=file)


def _add_lights(builder: SceneBuilder, dataset: SceneDataset, content: Mapping[str, Any], where: Path) -> None:
    name = text(content, "default_lighting", where=where)
    if not name or name == "default":
        return
    if name == "no_lights":
        builder.lights = ()
        return
    found = builder.find(dataset, "light_setups", name)
    if found is None:
        builder.warn(f"the lighting {name!r} is not in the dataset {dataset.path.name}")
    else:
        builder.lights = read_lights(found.attributes(), builder.templates.keys, where=found.path)


def _add_navmesh(builder: SceneBuilder, dataset: SceneDataset, content: Mapping[str, Any], where: Path) -> None:
    name = text(content, "navmesh_instance", where=where)
    if name:
        builder.use_navmesh(dataset.navmeshes.get(name, name), dataset.path.parent, where=where)


def _use_filter(builder: SceneBuilder, dataset: SceneDataset, content: Mapping[str, Any], where: Path) -> None:
    """Use the receptacles of the filter file that the scene names, relative to the dataset (spec/habitat.md 6.4)."""
    name = text(mapping(content, "user_defined", where=where), "scene_filter_file", where=where)
    if not name:
        return
    file = builder.templates.files.find(name, dataset.path.parent)
    if file is None:
        builder.warn(f"the receptacle filter {name!r} does not exist, so all receptacles are in use: {where}")
        return
    lists = read_object(file)
    builder.templates.keys.note("rec_filter", lists)
    builder.use_receptacles(texts(lists, "active", where=file))
    builder.more["receptacles_within"] = list(texts(lists, "within_set", where=file))


def _template_name(entry: Mapping[str, Any], where: Path) -> str:
    name = text(entry, "template_name", where=where)
    if not name:
        raise FormatError(f"An instance without a template_name: {where}", code="H3-HABITAT-132")
    return name
