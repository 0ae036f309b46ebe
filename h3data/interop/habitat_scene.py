"""Habitat's scenes (dataset configs, scene instances, stage configs, bare stage meshes) as `Scene` records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, MissingAssetError, SceneError
from h3data.geometry import IDENTITY_POSE, IDENTITY_QUAT, normalized, quat_rotate
from h3data.interop.habitat_dataset import (
    DATASET_ENDING,
    SceneDataset,
    Template,
    dataset_above,
    load_scene_dataset,
    number,
    numbers,
    objects,
)
from h3data.interop.habitat_receptacles import read_receptacles
from h3data.interop.meshes import MESH_SUFFIXES, frame_rotation, is_file, load_mesh, node_box
from h3data.interop.primitives import is_primitive, primitive_mesh
from h3data.scene.records import Asset, Box, Hull, Instance, Mesh, Motion, Scene, Shape

_Y_UP = ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0))
_Z_UP = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
_MIN_HALF_EXTENT_M = 1e-3


def load_habitat_scene(path: str | Path, scene: str | None = None, *, allow_missing: bool = False) -> Scene:
    """A Habitat scene, from any of the files by which Habitat users name one (spec/habitat.md 6.1-6.4).

    ``path`` is a ``*.scene_dataset_config.json`` (then ``scene`` names one of its scene instances; a part of the name
    is enough), a ``*.scene_instance.json``, a ``*.stage_config.json``, or a stage mesh. As in habitat-sim a bare
    stage mesh is taken as Z-up, (x, y, z) -> (x, z, -y); a stage config without axes as Y-up. A stage instance's own
    translation is ignored, as habitat-sim ignores it.

    Object poses are those of the asset's frame: positions that are given for the centre of mass (the default,
    Habitat's ``COM``) are moved to the asset's origin. Collision shapes are one box or one convex hull per object;
    the stage has none. Articulated objects are left out. ``Scene.source["warnings"]`` says what was left out or
    guessed. Assets that do not exist raise `MissingAssetError`, unless ``allow_missing`` drops their instances with a
    warning.
    """
    path = Path(path)
    if not path.exists():
        raise SceneError(f"There is no such scene file: {path}")
    builder = _Builder(allow_missing=allow_missing)
    if path.name.endswith(DATASET_ENDING):
        dataset = load_scene_dataset(path)
        return _from_instance(builder, dataset, _chosen(dataset, scene))
    if scene is not None:
        raise SceneError(f"A scene name ({scene!r}) can only be given with a *{DATASET_ENDING}, not with: {path}")
    if path.name.endswith(".scene_instance.json"):
        dataset = load_scene_dataset(dataset_above(path))
        own = next(t for t in dataset.sections["scene_instances"] if t.path.resolve() == path.resolve())
        return _from_instance(builder, dataset, own)
    if path.name.endswith(".stage_config.json") or path.suffix.lower() in MESH_SUFFIXES:
        template = Template(handle=path.name.split(".")[0], path=path)
        builder.add_stage(template)
        return builder.scene(template.handle, config=path, scene="")
    raise FormatError(
        f"Expected a Habitat scene: *{DATASET_ENDING}, *.scene_instance.json, *.stage_config.json or a stage mesh "
        f"({', '.join(MESH_SUFFIXES)}): {path}"
    )


def _chosen(dataset: SceneDataset, scene: str | None) -> Template:
    names = dataset.names("scene_instances")
    if scene is None and len(names) == 1:
        scene = names[0]
    shown = ", ".join(names[:12]) + (f", ... ({len(names)} in all)" if len(names) > 12 else "") or "none"
    if scene is None:
        raise SceneError(f"Which scene? This dataset has: {shown}. {dataset.path}")
    template, others = dataset.find("scene_instances", scene)
    if template is None:
        raise SceneError(f"No scene matches {scene!r}. This dataset has: {shown}. {dataset.path}")
    if others:
        raise SceneError(f"{others + 1} scenes match {scene!r}: say more. This dataset has: {shown}. {dataset.path}")
    return template


def _from_instance(builder: _Builder, dataset: SceneDataset, template: Template) -> Scene:
    content = template.attributes()
    where = template.path
    stage = content.get("stage_instance")
    if stage is not None:
        name = _template_name(stage, where)
        found = builder.find(dataset, "stages", name)
        if found is None:
            raise SceneError(f"The stage {name!r} of this scene is not in the dataset {dataset.path.name}: {where}")
        if stage.get("translation") or stage.get("rotation"):
            builder.warnings.append("the stage instance's own translation and rotation are ignored, as in habitat-sim")
        builder.add_stage(found)
    absent: list[str] = []
    for entry in objects(content, "object_instances", where=where):
        name = _template_name(entry, where)
        found = builder.find(dataset, "objects", name)
        if found is None:
            absent.append(name)
        else:
            builder.add_object(found, entry, origin=content.get("translation_origin"), where=where)
    if absent:
        fault = f"{len(absent)} objects have no template in the dataset, the first is {absent[0]!r}"
        if not builder.allow_missing:
            raise SceneError(f"{fault}. Hint: allow_missing=True leaves them out. {where}")
        builder.warnings.append(fault)
    articulated = len(objects(content, "articulated_object_instances", where=where))
    if articulated:
        builder.warnings.append(f"{articulated} articulated objects are left out: they are not supported yet")
    return builder.scene(template.handle, config=dataset.path, scene=template.handle)


def _template_name(entry: Any, where: Path) -> str:
    name = entry.get("template_name") if isinstance(entry, dict) else None
    if not isinstance(name, str) or not name:
        raise FormatError(f"An instance without a template_name: {where}")
    return name


@dataclass
class _Builder:
    """Collects assets and instances of one scene."""

    allow_missing: bool
    assets: dict[str, Asset] = field(default_factory=dict)
    instances: list[Instance] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    missing: list[Path] = field(default_factory=list)
    _by_template: dict[int, tuple[str, Mapping[str, Any]] | None] = field(default_factory=dict)
    _middle: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    _counts: dict[str, int] = field(default_factory=dict)
    _alive: list[Template] = field(default_factory=list)

    def find(self, dataset: SceneDataset, section: Any, name: str) -> Template | None:
        template, others = dataset.find(section, name)
        if template is not None and others:
            self._warn(f"{others + 1} templates match {name!r}, {template.handle!r} is taken")
        return template

    def add_stage(self, template: Template) -> None:
        loaded = self._load(template, stage=True)
        if loaded is None:
            return
        name, attributes = loaded
        scale = np.array(numbers(attributes, "scale", (1, 1, 1), where=template.path), np.float64)
        self.instances.append(
            Instance(name="stage", asset=name, pose=IDENTITY_POSE.copy(), scale=scale, motion="static")
        )

    def add_object(self, template: Template, entry: Mapping[str, Any], *, origin: Any, where: Path) -> None:
        loaded = self._load(template, stage=False)
        if loaded is None:
            return
        name, attributes = loaded
        scale = np.array(numbers(attributes, "scale", (1, 1, 1), where=template.path), np.float64)
        scale *= number(entry, "uniform_scale", 1.0, where=where)
        scale *= numbers(entry, "non_uniform_scale", (1, 1, 1), where=where)
        w, x, y, z = numbers(entry, "rotation", (1, 0, 0, 0), where=where)
        rotation = normalized(np.array([x, y, z, w]))
        if not np.any(rotation):
            rotation = IDENTITY_QUAT
        position = np.array(numbers(entry, "translation", (0, 0, 0), where=where))
        given = str(entry.get("translation_origin") or origin or "COM").lower()
        if given != "asset_local":
            position = position - quat_rotate(rotation, self._center_of_mass(name, attributes, scale, template))
        count = self._counts.get(template.handle, 0)
        self._counts[template.handle] = count + 1
        motion: Motion = "static" if str(entry.get("motion_type", "")).upper() == "STATIC" else "kinematic"
        self.instances.append(
            Instance(
                name=f"{template.handle}_:{count:04d}",
                asset=name,
                pose=np.concatenate([position, rotation]).astype(np.float64),
                scale=scale,
                semantic_id=int(number(attributes, "semantic_id", 0, where=template.path)),
                motion=motion,
            )
        )

    def _center_of_mass(
        self, name: str, attributes: Mapping[str, Any], scale: NDArray[np.float64], template: Template
    ) -> NDArray[np.float64]:
        """Habitat's object origin in the asset's frame [3]: the config's COM, else the middle of the scaled node box."""
        if attributes.get("COM") is not None and not attributes.get("compute_COM_from_shape"):
            return np.array(numbers(attributes, "COM", (0, 0, 0), where=template.path))
        if name not in self._middle:
            asset = str(attributes.get("render_asset") or attributes.get("collision_asset"))
            axes = {
                "up": numbers(attributes, "up", _Y_UP[0], where=template.path),
                "front": numbers(attributes, "front", _Y_UP[1], where=template.path),
            }
            units = number(attributes, "units_to_meters", 1.0, where=template.path)
            box = (
                np.zeros((2, 3))
                if is_primitive(asset)
                else node_box(template.path.parent / asset, **axes, units_m=units)
            )
            self._middle[name] = box.mean(0)
        return self._middle[name] * scale

    def scene(self, name: str, *, config: Path, scene: str) -> Scene:
        if self.missing and not self.allow_missing:
            raise MissingAssetError(
                f"{len(self.missing)} assets of scene {name!r} do not exist. Hint: download the dataset completely, or use "
                f"allow_missing=True. The first: {self.missing[0]}"
            )
        if self.missing:
            self._warn(f"{len(self.missing)} assets do not exist, their instances are left out: {self.missing[0]}")
        source = {"kind": "habitat", "config": str(config), "scene": scene, "warnings": list(self.warnings)}
        return Scene(name=name, assets=self.assets, instances=tuple(self.instances), source=source)

    def _warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def _load(self, template: Template, *, stage: bool) -> tuple[str, Mapping[str, Any]] | None:
        """Name of the asset and the attributes of a template; None if its mesh is missing."""
        if id(template) not in self._by_template:
            self._alive.append(template)  # keeps the id unique while this builder lives
            self._by_template[id(template)] = self._read(template, stage=stage)
        return self._by_template[id(template)]

    def _read(self, template: Template, *, stage: bool) -> tuple[str, Mapping[str, Any]] | None:
        attributes = template.attributes()
        folder = template.path.parent
        bare = not template.is_config and not template.inline
        up, front = _Z_UP if stage and bare and not template.defaults else _Y_UP
        up = numbers(attributes, "up", up, where=template.path)
        front = numbers(attributes, "front", front, where=template.path)
        try:
            frame = frame_rotation(up, front)
        except SceneError as fault:
            raise SceneError(f"{fault} Hint: give both up and front. {template.path}") from None
        mesh = self._mesh(attributes, folder, up, front, template)
        if mesh is None:
            return None
        user = attributes.get("user_defined")
        receptacles, notes = read_receptacles(
            user if isinstance(user, dict) else {},
            folder=folder,
            frame=frame,
            stage=stage,
            where=template.path,
        )
        self.warnings += notes
        collides = bool(attributes.get("is_collidable", True)) and not stage
        name = template.handle
        while name in self.assets:  # another folder of the dataset, or the stage, has the same file name
            name += "~"
        self.assets[name] = Asset(
            name=name,
            mesh=mesh,
            category="stage" if stage else "object",
            shapes=(self._shape(attributes, mesh, folder, up, front, template),) if collides else (),
            receptacles=tuple(receptacles),
        )
        return name, attributes

    def _mesh(
        self, attributes: Mapping[str, Any], folder: Path, up: Sequence[float], front: Sequence[float], template:
        Template, *, key: str = "render_asset",
    ) -> Mesh | None:  # fmt: skip
        asset = attributes.get(key) or attributes.get("collision_asset")
        if not isinstance(asset, str):
            raise FormatError(f"The template {template.handle!r} names no {key}: {template.path}")
        if is_primitive(asset):
            return primitive_mesh(asset)
        file = folder / asset
        if not is_file(file):
            self.missing.append(file)
            return None
        units = number(attributes, "units_to_meters", 1.0, where=template.path)
        return load_mesh(file, up=up, front=front, units_m=units)

    def _shape(
        self, attributes: Mapping[str, Any], mesh: Mesh, folder: Path, up: Sequence[float], front: Sequence[float],
        template: Template,
    ) -> Shape:  # fmt: skip
        """One convex part for an object: its collision asset's hull, or its box if the config asks for that."""
        asset = attributes.get("collision_asset")
        if isinstance(asset, str) and is_primitive(asset):
            size = np.array(numbers(attributes, "collision_asset_size", (1, 1, 1), where=template.path), np.float32)
            solid = primitive_mesh(asset)
            mesh = replace(solid, vertices=solid.vertices * size, normals=None)
        elif isinstance(asset, str) and is_file(folder / asset):
            mesh = self._mesh(attributes, folder, up, front, template, key="collision_asset") or mesh
        if attributes.get("use_bounding_box_for_collision"):
            return _box(mesh)
        return _hull(mesh)


def _box(mesh: Mesh) -> Box:
    lo, hi = mesh.bounds.astype(np.float64)
    return Box(
        pose=np.concatenate([(lo + hi) / 2, IDENTITY_QUAT]),
        half_extents=np.maximum((hi - lo) / 2, _MIN_HALF_EXTENT_M),
    )


def _hull(mesh: Mesh) -> Shape:
    """The convex hull of all vertices (one part: hollows are filled); a box if the mesh is flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(mesh.vertices.astype(np.float64))
    except (QhullError, ValueError):
        return _box(mesh)
    return Hull(points=mesh.vertices[hull.vertices].astype(np.float64))
