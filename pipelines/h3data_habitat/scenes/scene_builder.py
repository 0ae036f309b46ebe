"""Assets and instances of one Habitat scene, from templates and the entries of a scene instance that place them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import MissingAssetError, SceneError
from h3data.geometry import IDENTITY_POSE, IDENTITY_QUAT, normalized, pose_to_matrix, quat_rotate
from h3data.scene.records import Articulation, Instance, LightSource, Motion, Room, Scene
from h3data_habitat.scenes.articulated import initial_positions, link_frames, link_pose, pose_of_links
from h3data_habitat.scenes.config_values import flag, number, numbers, text, whole_number
from h3data_habitat.scenes.joints import articulation_of
from h3data_habitat.scenes.scene_dataset import SceneDataset, Section, Template
from h3data_habitat.scenes.templates import TemplateReader

REACH_MAX_M = 1e5
"""Largest distance of things from the origin [m]: 100 km, where float32 still resolves centimetres."""


@dataclass
class SceneBuilder:
    """Builder of the assets and instances of one Habitat scene.

    An object that cannot be used (a damaged mesh, a size of 0) is left out with a warning; a config of the wrong form is a
    `FormatError`. With ``strict`` every warning is an error in the end.
    """

    templates: TemplateReader
    allow_missing: bool = False
    strict: bool = False
    instances: list[Instance] = field(default_factory=list)
    rooms: tuple[Room, ...] = ()
    lights: tuple[LightSource, ...] | None = None
    articulations: list[Articulation] = field(default_factory=list)
    more: dict[str, Any] = field(default_factory=dict)
    """Additional entries of ``Scene.source``."""
    _counts: dict[str, int] = field(default_factory=dict)

    def warn(self, warning: str) -> None:
        """Add a warning unless it was given before."""
        if warning not in self.templates.warnings:
            self.templates.warnings.append(warning)

    def find(self, dataset: SceneDataset, section: Section, name: str) -> Template | None:
        """Return the template of a name in a scene; warn if others fit as well."""
        template, others = dataset.find(section, name)
        if template is not None and others:
            self.warn(f"{others + 1} templates match {name!r}, {template.handle!r} is taken: {template.path}")
        return template

    # --- placing ------------------------------------------------------------------------------------------------------
    def add_stage(self, template: Template) -> None:
        """Add the stage of a scene, and its navmesh if the template names one."""
        read = self.templates.stage(template)
        if read is None:
            return
        where = template.path
        navmesh = text(read.attributes, "nav_asset", where=where) or text(read.attributes, "navmesh_asset", where=where)
        if navmesh:
            self.use_navmesh(navmesh, where.parent, where=where)
        if not np.all(read.scale):
            self.warn(f"the stage is left out: its size is 0 ({read.scale.tolist()}): {where}")
            return
        pose = IDENTITY_POSE.copy()
        self._add(Instance(name="stage", asset=read.asset, pose=pose, scale=read.scale, motion="static"), where)

    def add_object(self, template: Template, entry: Mapping[str, Any], *, origin: Any, where: Path) -> None:
        """Add a rigid object; ``origin`` is the scene's ``translation_origin``, which the entry may override."""
        self.templates.keys.note("object_instance", entry)
        # counted before anything can fail: Habitat numbers instances that it cannot show too
        name = self._next_name(template)
        read = self.templates.rigid(template)
        if read is None:
            return
        scale = read.scale * number(entry, "uniform_scale", 1.0, where=where)
        scale = scale * numbers(entry, "non_uniform_scale", (1, 1, 1), where=where)
        if not np.all(scale):
            self.warn(f"object {name!r} is left out: its size is 0 ({scale.tolist()}): {where}")
            return
        position, rotation = self._pose(entry, name, where)
        given = str(text(entry, "translation_origin", where=where) or origin or "COM").lower()
        # positions of Habitat are of the centre of mass by default, ours of the origin of the mesh
        if given != "asset_local":
            position = position - quat_rotate(rotation, read.origin(scale))
        motion: Motion = "static" if str(entry.get("motion_type", "")).upper() == "STATIC" else "kinematic"
        self._add(
            Instance(
                name=name,
                asset=self._seen(read.asset, entry, where),
                pose=np.concatenate([position, rotation]).astype(np.float64),
                scale=scale,
                semantic_id=whole_number(read.attributes, "semantic_id", 0, where=template.path),
                motion=motion,
            ),
            where,
        )

    def add_articulated(self, template: Template, entry: Mapping[str, Any], *, where: Path) -> None:
        """Add an articulated object: a static instance ``<name>/<link>`` for each visible or colliding link, and its joints."""
        self.templates.keys.note("articulated_instance", entry)
        name = self._next_name(template)
        read = self.templates.articulated(template)
        if read is None:
            return
        scale = number(read.attributes, "uniform_scale", 1.0, where=template.path)
        scale *= number(entry, "uniform_scale", 1.0, where=where)
        if scale <= 0:
            self.warn(f"articulated object {name!r} is left out: its uniform_scale is {scale:g}: {where}")
            return
        if numbers(entry, "non_uniform_scale", (1, 1, 1), where=where) != (1, 1, 1):
            self.warn(
                f"non_uniform_scale of {name!r} is ignored: articulated objects have one scale, as in habitat-sim"
            )
        order, mode = (
            text(entry, key, where=where) or text(read.attributes, key, where=template.path) or "default"
            for key in ("link_order", "render_mode")
        )
        positions, warnings = initial_positions(read.robot, entry, link_order=order, where=where)
        for warning in warnings:
            self.warn(f"{warning}: {where}")
        if read.attributes.get("render_asset") and mode in ("default", "skin", "both"):
            self.warn(f"the skin of {template.handle!r} is not bent: the visuals of its links are drawn instead")
        base = pose_to_matrix(np.concatenate(self._pose(entry, name, where))).astype(np.float64)
        frames = link_frames(read.robot, positions, scale=scale)
        frames = pose_of_links(read.robot, base, frames, scale=scale)
        hidden = {**entry, "is_instance_visible": False} if mode == "none" else entry
        instances = {
            link.name: Instance(
                name=f"{name}/{link.name}",
                asset=self._seen(asset, hidden, where),
                pose=link_pose(frames[link.index], link.turn),
                scale=np.full(3, scale),
                semantic_id=whole_number(read.attributes, "semantic_id", 0, where=template.path),
            )
            for link, asset in zip(read.links, read.assets, strict=True)
        }
        placed = {link: i for link, i in instances.items() if self._add(i, where)}
        thing, warnings = articulation_of(name, read.robot, frames, positions, placed, self.templates.assets)
        for warning in warnings:
            self.warn(f"{warning}: {where}")
        # a thing that has lost a link cannot be opened as a whole
        if thing is not None and len(placed) == len(instances):
            self.articulations.append(thing)

    def use_navmesh(self, name: str, folder: Path, *, where: Path) -> None:
        """Record the file of the scene's navmesh, if it exists."""
        file = self.templates.files.find(name, folder)
        if file is None:
            self.warn(f"the navmesh {name!r} does not exist: {where}")
        else:
            self.more["navmesh"] = str(file)

    def use_receptacles(self, active: Sequence[str]) -> None:
        """Use only receptacles with given names, ``<object>|<receptacle>`` as habitat-lab writes them."""
        names = set(active)
        for index, instance in enumerate(self.instances):
            # links are instances of their own, and the filter names the object
            owner = instance.name.split("/")[0]
            all_names = [r.name for r in self.templates.assets[instance.asset].receptacles]
            used = tuple(n for n in all_names if f"{owner}|{n}" in names)
            if len(used) < len(all_names):
                self.instances[index] = replace(instance, receptacles=used)

    def scene(self, name: str, *, config: Path, scene: str) -> Scene:
        """Return the scene that was collected.

        Raises:
            MissingAssetError: files do not exist, and that is not allowed.
            SceneError: there were warnings, and ``strict`` makes them errors.
        """
        missing, keys = self.templates.missing, self.templates.keys
        if missing and not self.allow_missing:
            raise MissingAssetError(
                f"{len(missing)} assets of scene {name!r} do not exist. Hint: download the dataset completely, give its "
                "folders as assets=[DIR] or in H3DATA_ASSETS, or leave them out with allow_missing=True. "
                f"The first: {missing[0]}",
                code="H3-HABITAT-119",
            )
        if missing:
            self.warn(f"{len(missing)} assets do not exist, their instances are left out: {missing[0]}")
        if keys.unknown:
            self.warn(f"keys that are not known are ignored: {', '.join(sorted(keys.unknown)[:8])}")
        warnings = list(dict.fromkeys(self.templates.warnings))
        if self.strict and warnings:
            raise SceneError(
                f"Scene {name!r} has {len(warnings)} warnings, and strict makes them errors: {'; '.join(warnings[:5])}. "
                f"{config}",
                code="H3-HABITAT-120",
            )
        source = {
            "kind": "habitat",
            "config": str(config),
            "scene": scene,
            "warnings": warnings,
            "ignored_keys": sorted(keys.ignored),
            **self.more,
        }
        return Scene(
            name=name,
            assets=self.templates.assets,
            instances=tuple(self.instances),
            rooms=self.rooms,
            lights=self.lights,
            source=source,
            articulations=tuple(self.articulations),
        )

    def _next_name(self, template: Template) -> str:
        """Return Habitat's name of the next instance; instances that are left out count as well."""
        count = self._counts[template.handle] = self._counts.get(template.handle, -1) + 1
        return f"{template.handle}_:{count:04d}"

    def _add(self, instance: Instance, where: Path) -> bool:
        """Add an instance unless it is too far away or too large; return whether it did.

        Next to such an instance nothing else in the scene would be larger than a point.
        """
        mesh = self.templates.assets[instance.asset].mesh
        # sizes of damaged files may overflow, which the comparison below refuses
        with np.errstate(over="ignore", invalid="ignore"):
            size = np.abs(instance.scale).max() * np.abs(mesh.vertices).max(initial=0).astype(np.float64)
            reach = float(np.abs(instance.pose[:3]).max() + size)
        if reach <= REACH_MAX_M and np.isfinite(instance.pose).all():
            self.instances.append(instance)
            return True
        self.warn(f"{instance.name!r} is left out: it reaches {reach:.3g} m from the origin: {where}")
        return False

    def _pose(
        self, entry: Mapping[str, Any], name: str, where: Path
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the position [3] and unit quaternion (xyzw) of an entry."""
        w, x, y, z = numbers(entry, "rotation", (1, 0, 0, 0), where=where)
        rotation = normalized(np.array([x, y, z, w])).astype(np.float64)
        if not np.any(rotation):
            self.warn(f"the rotation of {name!r} is zero, so it is not turned: {where}")
            rotation = IDENTITY_QUAT
        return np.array(numbers(entry, "translation", (0, 0, 0), where=where)), rotation

    def _seen(self, asset: str, entry: Mapping[str, Any], where: Path) -> str:
        """Return the asset, or one of the same shapes that is not drawn if the entry says so."""
        if flag(entry, "is_instance_visible", True, where=where):
            return asset
        return self.templates.hidden(asset)
