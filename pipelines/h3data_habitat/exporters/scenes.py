"""Export of homes as a Habitat scene dataset, which habitat-sim and h3data's reader can load."""

from __future__ import annotations

import hashlib
import json
import logging
import re
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError, SceneError
from h3data.geometry import IDENTITY_POSE, normalized
from h3data.mesh.mesh import Mesh
from h3data.scene.freespace.free_space import FreeSpace
from h3data.scene.records import Asset, Instance, Receptacle, Room, Scene, instance_matrix
from h3data.scene.scene_json import asset_record
from h3data_exporters.glb_write import GlbNode, glb_bytes
from h3data_habitat.exporters.articulated import ArticulatedExport, articulated_instance
from h3data_habitat.exporters.building import building_parts, parts_by_class, speck
from h3data_habitat.exporters.lights import SHADER, light_setup
from h3data_habitat.navmesh.file import navmesh_bytes
from h3data_habitat.navmesh.navmesh import NavMeshSettings, navmesh_from_free_space
from h3data_habitat.scenes.colliders import part_mesh, scaled_asset
from h3data_habitat.scenes.scene_dataset import DATASET_ENDING

_log = logging.getLogger(__name__)

STAGE_CATEGORIES = frozenset(("wall", "floor", "ceiling", "door", "window", "trim", "stairs", "railing", "stage"))
"""Categories of static instances that make up the building, which becomes Habitat's stage. All other instances become
objects.
"""

_AGENT_HEIGHT_M, _AGENT_RADIUS_M = 1.41, 0.25

NAVMESH_SETTINGS: Mapping[str, float | bool] = {
    "cellSize": 0.05,
    "cellHeight": 0.2,
    "agentHeight": _AGENT_HEIGHT_M,
    "agentRadius": _AGENT_RADIUS_M,
    "agentMaxClimb": 0.2,
    "agentMaxSlope": 45.0,
    "regionMinSize": 20.0,
    "regionMergeSize": 20.0,
    "edgeMaxLen": 12.0,
    "edgeMaxError": 1.3,
    "vertsPerPoly": 6.0,
    "detailSampleDist": 6.0,
    "detailSampleMaxError": 1.0,
    "filterLowHangingObstacles": True,
    "filterLedgeSpans": True,
    "filterWalkableLowHeightSpans": True,
}
"""Navmesh settings: habitat-sim's defaults with the agent of Rearrange (spec/habitat.md 6.7). Its JSON reader knows no
``includeStaticObjects``, so furniture has to be requested in Python (h3data docs habitat)."""

_AXES = {"up": [0, 1, 0], "front": [0, 0, -1]}
"""Axes of the stage, which are always written: without them habitat-sim reads a stage as Z-up (habitat-findings 13)."""
_LEXICON = "semantics/h3data_semantic_lexicon.json"
_ROOM_HEIGHT_M = 2.6
_MARK = "h3data.habitat_export"
"""Mark in the dataset config; ``force`` deletes no folder without it."""


def export_habitat(scene: Scene, folder: str | Path, *, split_building: bool = False, force: bool = False) -> Path:
    """Return the path of the ``*.scene_dataset_config.json`` of a new folder with one scene in Habitat's formats.

    The options are those of `export_habitat_dataset`.
    """
    return export_habitat_dataset([scene], folder, split_building=split_building, force=force)


def export_habitat_dataset(
    scenes: Sequence[Scene],
    folder: str | Path,
    *,
    name: str | None = None,
    split_building: bool = False,
    force: bool = False,
) -> Path:
    """Return the path of the ``*.scene_dataset_config.json`` of a new folder with scenes that share their objects.

    The building (`STAGE_CATEGORIES`) becomes the stage, everything else objects with ``asset_local`` poses and a centre
    of mass at the asset's origin, so that both of Habitat's origins are the same point (spec/habitat.md 6.1-6.4, 6.7;
    what is written and what Habitat has no place for: h3data docs scenes). Equal scenes give equal bytes. The folder
    appears when it is complete.

    Args:
        scenes: Scenes to export, whose names must differ.
        folder: Output folder, which must not exist or be empty.
        name: Name of the dataset; by default the name of its only scene, or of the folder.
        split_building: True exports floors, walls, ceilings, windows, doors and trim as one static object each, so that
            they have semantic ids; the stage is then used for collisions only. Habitat's stages have no ids without a
            semantic mesh.
        force: True replaces a folder that an earlier export made; other folders are still refused.
    """
    if not scenes:
        raise InputError("Expected at least one scene to export.", code="H3-EXPORT-017")
    # as files: names that differ may become the same one
    handles = [_file_name(s.name) for s in scenes]
    if len(set(handles)) < len(handles):
        raise InputError(
            f"Scenes of one dataset need different names, got {', '.join(sorted(handles))}.", code="H3-EXPORT-018"
        )
    name = name or (handles[0] if len(scenes) == 1 else Path(folder).name)
    dataset = DatasetExport(folder, name, split_building=split_building, force=force)
    for scene in scenes:
        dataset.add_scene(scene)
    return dataset.write()


class DatasetExport:
    """Builder of a scene dataset, to which scenes are added one by one; see `export_habitat_dataset`."""

    def __init__(self, folder: str | Path, name: str, *, split_building: bool = False, force: bool = False) -> None:
        """Check that the folder is empty, or that ``force`` is True and an earlier export made it."""
        self.folder, self._force = Path(folder), force
        self.config = self.folder / f"{_file_name(name)}{DATASET_ENDING}"
        self._files = _Files(split_building)
        _refuse(self.folder, force=force)

    def add_scene(self, scene: Scene) -> tuple[Path, Mapping[str, str]]:
        """Add a scene; return the path of its scene instance, and Habitat's names of its receptacles by h3data's.

        All scenes must have different names.
        """
        handle = _file_name(scene.name)
        return self.folder / f"scenes/{handle}.scene_instance.json", _add_scene(self._files, handle, scene)

    def add_object(self, scene: Scene, instance: Instance) -> str:
        """Add the template of an object that no scene of the dataset has, and return its file name."""
        asset = scene.assets[instance.asset]
        self._files.classes.setdefault(int(instance.semantic_id), asset.category)
        return (
            f"{self._files.template(scaled_asset(asset, instance.scale), int(instance.semantic_id))}.object_config.json"
        )

    def write(self) -> Path:
        """Write the folder; return the path of the dataset's config."""
        files = self._files
        opens = {"articulated_objects": {"paths": {".json": ["urdf/*"]}}} if files.articulated else {}
        files.json(self.config.name, {**_dataset_config(), **opens, "navmesh_instances": files.navmeshes})
        files.json(_LEXICON, {"classes": [{"id": k, "name": v} for k, v in sorted(files.classes.items())]})
        _write(self.folder, files.content, force=self._force)
        return self.config


@dataclass
class _Files:
    """Files that the folder will hold, and the templates that assets already have."""

    split_building: bool = False
    content: dict[str, bytes] = field(default_factory=dict)
    classes: dict[int, str] = field(default_factory=lambda: {0: "unknown"})
    articulated: bool = False
    """True if any object of the scene can be opened."""
    navmeshes: dict[str, str] = field(default_factory=dict)
    """Paths of the navmeshes by handle."""
    _templates: dict[tuple[int, int], str] = field(default_factory=dict)
    _alive: list[Asset] = field(default_factory=list)

    def json(self, path: str, value: Mapping[str, Any]) -> None:
        self.content[path] = (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()

    def template(self, asset: Asset, semantic_id: int) -> str:
        """Handle of the object template of an asset; written at its first use. Equal assets have the same."""
        if (id(asset), semantic_id) not in self._templates:
            self._alive.append(asset)  # keeps its id unique
            self._templates[id(asset), semantic_id] = _add_object(self, asset, semantic_id)
        return self._templates[id(asset), semantic_id]

    def glb(self, folder: str, mesh: Mesh) -> str:
        """Return the name of the GLB with a mesh, beside which a config may name it; equal meshes share one file."""
        data = glb_bytes([mesh])
        file = f"{hashlib.sha256(data).hexdigest()[:16]}.glb"
        self.content[f"{folder}/{file}"] = data
        return file


def _dataset_config() -> dict[str, Any]:
    """List the folders, as HSSD's own config does."""
    return {
        "stages": {"default_attributes": {"shader_type": SHADER, **_AXES}, "paths": {".json": ["stages"]}},
        "objects": {"default_attributes": {"shader_type": SHADER, **_AXES}, "paths": {".json": ["objects"]}},
        "light_setups": {"paths": {".json": ["lighting"]}},
        "semantic_scene_descriptor_instances": {
            "default_attributes": {"semantic_descriptor_filename": f"../{Path(_LEXICON).name}"},
            "paths": {".json": ["semantics/scenes"]},
        },
        "scene_instances": {"paths": {".json": ["scenes"]}},
        "user_defined": {"made_by": _MARK},
    }


# --- one scene --------------------------------------------------------------------------------------------------------
def _add_scene(files: _Files, handle: str, scene: Scene) -> Mapping[str, str]:
    """Add the files of a scene; return Habitat's names of its receptacles by ours."""
    # before anything is added: a scene is written whole or not at all
    for instance in scene.instances:
        if not (np.isfinite(instance.pose).all() and np.isfinite(instance.scale).all() and np.all(instance.scale)):
            raise SceneError(
                f"Scene {scene.name!r}: {instance.name!r} has a pose or scale that cannot be written.",
                code="H3-EXPORT-021",
            )
    stage = tuple(
        i
        for i in scene.static_instances
        if scene.assets[i.asset].category in STAGE_CATEGORIES and len(scene.assets[i.asset].mesh.faces)
    )
    if not stage:
        raise SceneError(
            f"Scene {scene.name!r} has no building, so there is no stage to write. Expected static instances of a "
            f"category among: {', '.join(sorted(STAGE_CATEGORIES))}.",
            code="H3-EXPORT-019",
        )
    objects = _add_stage(files, handle, scene, stage, split=files.split_building)
    articulated = ArticulatedExport(files.content, _receptacle, _receptacle_key)
    receptacles = {ours: f"stage|{e['name']}" for ours, _, e in _stage_receptacles(scene, stage)}
    counts: dict[str, int] = {}
    # what is part of the stage or of a thing that opens is no object besides
    inside = {i.name for i in stage} | articulated.members(scene)
    for instance in scene.instances:
        asset = scene.assets[instance.asset]
        if instance.name in inside or not len(asset.mesh.faces):
            continue
        files.classes.setdefault(int(instance.semantic_id), asset.category)
        # scale goes into the mesh: habitat-lab does not scale receptacles, nor Bullet mirrored parts
        template = files.template(scaled_asset(asset, instance.scale), int(instance.semantic_id))
        objects.append(_object_instance(instance, template, asset.category))
        number = counts[template] = counts.get(template, -1) + 1
        receptacles |= {f"{instance.name}|{r.name}": f"{template}_:{number:04d}|{r.name}" for r in asset.receptacles}
    opening = []
    for thing in scene.articulations:
        first = next(i for i in scene.instances if i.name in (thing.base, *thing.parts[0].instances))
        category, semantic_id = scene.assets[first.asset].category, int(first.semantic_id)
        files.classes.setdefault(semantic_id, category)
        template, names = articulated.add(scene, thing, _file_name(category), semantic_id)
        opening.append(articulated_instance(thing, template))
        number = counts[template] = counts.get(template, -1) + 1
        receptacles |= {ours: f"{template}_:{number:04d}|{theirs}" for ours, theirs in names.items()}
    files.articulated |= bool(opening)
    regions = _region_annotations(scene.rooms)
    filter_file = f"scene_filter_files/{handle}.rec_filter.json"
    instance_file = {
        "translation_origin": "asset_local",
        "stage_instance": {"template_name": f"stages/{handle}.stage_config.json", "translation_origin": "asset_local"},
        "object_instances": objects,
        **({"articulated_object_instances": opening} if opening else {}),
        "default_lighting": f"lighting/{handle}.lighting_config.json",
        **({"navmesh_instance": handle} if _add_navmesh(files, handle, scene) else {}),
        **({"semantic_scene_instance": f"{handle}.semantic_config.json"} if regions else {}),
        "user_defined": {"scene_filter_file": filter_file},
    }
    files.json(f"scenes/{handle}.scene_instance.json", instance_file)
    files.json(filter_file, _receptacle_filter(list(receptacles.values())))
    files.json(f"lighting/{handle}.lighting_config.json", light_setup())
    files.json(f"navmeshes/{handle}.navmesh_settings.json", NAVMESH_SETTINGS)
    if regions:
        files.json(f"semantics/scenes/{handle}.semantic_config.json", {"region_annotations": regions})
    return receptacles


def _add_navmesh(files: _Files, handle: str, scene: Scene) -> bool:
    """Add the navmesh of the free floor, furniture included; False, with a warning, for a scene without one."""
    try:
        free = FreeSpace.from_scene(scene, radius_m=_AGENT_RADIUS_M, height_m=_AGENT_HEIGHT_M)
        if free.polygon.is_empty:
            raise SceneError("no floor is free", code="H3-EXPORT-022")
        settings = NavMeshSettings(
            agent_height=_AGENT_HEIGHT_M, agent_radius=_AGENT_RADIUS_M, include_static_objects=True
        )  # else equal to the defaults: whoever asks habitat-sim for these settings gets this navmesh, not a new one
        content = navmesh_bytes(navmesh_from_free_space(free, settings=settings))
    except H3DataError as fault:
        _log.warning("%s has no navmesh, habitat-sim has to bake one: %s", scene.name, fault)
        return False
    files.navmeshes[handle] = f"navmeshes/{handle}.navmesh"
    files.content[files.navmeshes[handle]] = content
    return True


def _object_instance(instance: Instance, template: str, category: str) -> dict[str, Any]:
    ours = {"name": instance.name, "category": category, "layer": instance.layer}
    return _instance_record(instance.pose, template, instance.motion, ours)


def _instance_record(pose: NDArray[np.float64], template: str, motion: str, ours: Mapping[str, Any]) -> dict[str, Any]:
    # Habitat writes w first
    x, y, z, w = normalized(pose[3:]).tolist()
    return {
        "template_name": template,
        "translation_origin": "asset_local",
        "translation": pose[:3].tolist(),
        "rotation": [w, x, y, z],
        "motion_type": motion.upper(),
        "user_defined": {"h3data": dict(ours)},
    }


def _add_stage(
    files: _Files, handle: str, scene: Scene, stage: Sequence[Instance], *, split: bool
) -> list[dict[str, Any]]:
    """Add the building; return its object instances if it is ``split``."""
    meshes, nodes = building_parts(scene, stage)
    for node in nodes:
        ours = node.extras["h3data"]
        files.classes.setdefault(ours["semantic_id"], ours["category"])
    files.content[f"stages/{handle}.glb"] = glb_bytes(meshes, nodes)
    render_asset = f"{handle}.glb"
    if split:
        # the stage then only collides; drawn as well, the building would be there twice
        render_asset = f"{handle}.speck.glb"
        files.content[f"stages/{render_asset}"] = glb_bytes([speck(scene, stage)])
    config = {
        "render_asset": render_asset,
        "collision_asset": f"{handle}.glb",
        **_AXES,
        "origin": [0, 0, 0],
        "scale": [1, 1, 1],
        "gravity": [0, -9.8, 0],
        "units_to_meters": 1.0,
        "is_collidable": True,
        "shader_type": SHADER,
        "user_defined": {key: entry for _, key, entry in _stage_receptacles(scene, stage)},
    }
    files.json(f"stages/{handle}.stage_config.json", config)
    if not split:
        return []
    return [_add_building_object(files, handle, *alike) for alike in parts_by_class(meshes, nodes)]


def _add_building_object(
    files: _Files, handle: str, meshes: Sequence[Mesh], nodes: Sequence[GlbNode]
) -> dict[str, Any]:
    """Add an object of all parts of the building that look alike to a semantic sensor; the stage does their collisions."""
    ours = nodes[0].extras["h3data"]
    content = glb_bytes(meshes, nodes)
    name = f"{handle}_{ours['category']}_{hashlib.sha256(content).hexdigest()[:16]}"
    files.content[f"objects/{name}.glb"] = content
    config = {**_object_config(f"{name}.glb", ours["semantic_id"]), "is_collidable": False}
    files.json(
        f"objects/{name}.object_config.json", {**config, "user_defined": {"h3data": {"category": ours["category"]}}}
    )
    return _instance_record(IDENTITY_POSE, name, "static", {"name": f"{ours['category']}s", **ours})


def _stage_receptacles(scene: Scene, stage: Sequence[Instance]) -> list[tuple[str, str, dict[str, Any]]]:
    """Return receptacles of the building (our name, key, entry), in the world frame."""
    found = []
    for instance in stage:
        matrix = instance_matrix(instance)
        size = np.abs(instance.scale)
        x, y, z, w = normalized(instance.pose[3:]).tolist()
        for receptacle in scene.assets[instance.asset].receptacles:
            entry = _receptacle(receptacle, size, f"{instance.name}_{receptacle.name}")
            entry["position"] = (matrix[:3, :3] @ np.array(entry["position"]) + matrix[:3, 3]).tolist()
            entry["rotation"] = [w, x, y, z]
            found.append((f"{instance.name}|{receptacle.name}", _receptacle_key(entry["name"]), entry))
    return found


def _receptacle_filter(names: list[str]) -> dict[str, list[str]]:
    """Return all receptacles are to be used; habitat-lab expects the other lists as well (spec/habitat.md 6.4)."""
    empty = ("manually_filtered", "access_filtered", "stability_filtered", "height_filtered", "within_set")
    return {"active": names, **{key: [] for key in empty}}


def _region_annotations(rooms: Sequence[Room]) -> list[dict[str, Any]]:
    """Return rooms as Habitat's semantic regions: a prism over each rectangle (spec/habitat.md 6.3)."""
    found = []
    for room in rooms:
        rectangles = np.asarray(room.rectangles, np.float64).tolist()
        for k, (x0, z0, x1, z1) in enumerate(rectangles):
            y = float(room.floor_y)
            height = _ROOM_HEIGHT_M if room.ramp is None else _ROOM_HEIGHT_M + float(room.ramp.top_y) - y
            found.append(
                {
                    "name": room.name if len(rectangles) == 1 else f"{room.name}.{k}",
                    "label": room.category,
                    "poly_loop": [[x0, y, z0], [x0, y, z1], [x1, y, z1], [x1, y, z0]],
                    "floor_height": y,
                    "extrusion_height": height,
                    "min_bounds": [x0, y, z0],
                    "max_bounds": [x1, y + height, z1],
                }
            )
    return found


# --- one object -------------------------------------------------------------------------------------------------------
def _add_object(files: _Files, asset: Asset, semantic_id: int) -> str:
    """Write the config and the GLBs of one kind of object; give its handle.

    Handles end in a hash, so that none is a part of another: habitat-sim takes the first that *contains* a name.
    Collision parts go into a GLB of their own, one mesh each, and stay apart (``join_collision_meshes`` false).
    Habitat's ``use_bounding_box_for_collision`` is not used: it puts the box's middle at the centre of mass.
    """
    # without its name: equal objects of several scenes are one template
    identity = json.dumps([asset_record(replace(asset, name=""), None), semantic_id], sort_keys=True).encode()
    file = files.glb("objects", asset.mesh)
    digest = hashlib.sha256(identity + file.encode()).hexdigest()[:16]
    handle = f"{_file_name(asset.category)}_{digest}"
    config = {
        **_object_config(file, semantic_id),
        "is_collidable": bool(asset.shapes),
        "use_bounding_box_for_collision": False,
        "join_collision_meshes": False,
    }
    if asset.shapes:
        collider = f"{handle}.collider.glb"
        files.content[f"objects/{collider}"] = glb_bytes([part_mesh(s) for s in asset.shapes])
        config["collision_asset"] = collider
    entries = [_receptacle(r, np.ones(3), r.name) for r in asset.receptacles]
    config["user_defined"] = {
        **{_receptacle_key(e["name"]): e for e in entries},
        "h3data": {"category": asset.category},
    }
    files.json(f"objects/{handle}.object_config.json", config)
    return handle


def _object_config(render_asset: str, semantic_id: int) -> dict[str, Any]:
    return {
        "render_asset": render_asset,
        **_AXES,
        "scale": [1, 1, 1],
        "units_to_meters": 1.0,
        "COM": [0, 0, 0],
        "compute_COM_from_shape": False,
        "semantic_id": semantic_id,
        "shader_type": SHADER,
    }


def _receptacle(receptacle: Receptacle, scale: NDArray[np.float64], name: str) -> dict[str, Any]:
    """Return a box above the surface, with the clearance as its height (half extents, spec/habitat.md 6.4)."""
    lift = np.array([0.0, receptacle.clearance_m / 2, 0.0])
    half = np.array([receptacle.half_size[0], lift[1], receptacle.half_size[1]]) * scale
    return {
        "name": name,
        "position": (np.asarray(receptacle.center, np.float64) + lift).tolist(),
        "rotation": [1, 0, 0, 0],
        "scale": half.tolist(),
        "up": [0, 1, 0],
    }


def _receptacle_key(name: str) -> str:
    return f"receptacle_aabb_{_file_name(name)}"


# --- the folder -------------------------------------------------------------------------------------------------------
def _file_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", text) or "scene"


def _refuse(folder: Path, *, force: bool) -> None:
    """Raise an `InputError` unless the folder is absent, empty, or an earlier export that may be replaced."""
    try:
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return
        if not folder.is_dir():
            raise InputError(f"Expected a folder to export to, this is a file: {folder}", code="H3-EXPORT-023")
        if not force:
            raise InputError(
                f"The folder to export to is not empty. Replace it with force=True, or choose another: {folder}",
                code="H3-EXPORT-024",
            )
        configs = [p.read_text(errors="replace") for p in folder.glob("*" + DATASET_ENDING)]
    except OSError as error:
        raise InputError(
            f"Cannot look into the folder to export to ({error.strerror}): {folder}", code="H3-EXPORT-025"
        ) from None
    # a wrong path with force=True must not delete somebody's dataset
    if not any(_MARK in text for text in configs):
        raise InputError(
            f"force would delete this, but h3data did not export it. Remove it yourself: {folder}", code="H3-EXPORT-020"
        )


def _write(folder: Path, content: Mapping[str, bytes], *, force: bool) -> None:
    """Write all files into ``<folder>.part``, which then takes the place of the folder."""
    part, old = (folder.with_name(folder.name + ending) for ending in (".part", ".old"))
    try:
        if part.exists():
            shutil.rmtree(part)  # of an export that was killed
        part.mkdir(parents=True)
        for path, data in sorted(content.items()):
            file = part / path
            file.parent.mkdir(exist_ok=True, parents=True)
            file.write_bytes(data)
        # moved aside and deleted last, so that a failure leaves the old export
        if force and folder.exists():
            if old.exists():
                shutil.rmtree(old)
            folder.replace(old)
        part.replace(folder)
    except OSError as error:
        with suppress(OSError):
            shutil.rmtree(part)
        raise InputError(
            f"Cannot write the Habitat dataset ({error.strerror or error}): {folder}", code="H3-EXPORT-026"
        ) from None
    shutil.rmtree(old, ignore_errors=True)
