"""Models of objects with mass and grasps, from folders of the YCB set and from Habitat's object configs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, SceneError
from h3data.geometry import heading_from_quat, quat_from_heading
from h3data.mesh.loading import is_file, load_mesh
from h3data.recording.assets.folders import CONFIG_ENDING
from h3data.scene.kinds import KINDS, Grasp, grasp_point_in
from h3data.scene.records import Asset, Instance, Scene, instance_matrix
from h3data_habitat.scenes.collision_geometry import hull_shape
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.config_values import number
from h3data_habitat.scenes.referenced_files import ReferencedFiles
from h3data_habitat.scenes.scene_dataset import Template
from h3data_habitat.scenes.templates import TemplateReader

MESHES = ("textured.obj", "textured.dae", "textured.ply", "nontextured.ply", "nontextured.stl")
"""Names of mesh files in a folder of the YCB set, in order of preference."""
VARIANTS = ("google_16k", "google_64k", "google_512k", "poisson", "tsdf", "")
"""Subfolders of an object with mesh files, in order of preference; empty for the object's own folder."""
DENSITY_KG_M3 = 400.0
"""Density of an object whose mass is unknown, typical of half-full packages, wood and fruit [kg/m3]."""
GROWTH_M = 0.08
"""Largest difference along each axis by which a model may be larger than the thing that it replaces [m]."""
GAP_M = 0.01
"""Distance between a model and the things around it [m]."""
_MOST_XML = 1_000_000
_NUMBER = re.compile(r"^\d+(-[a-z])?_")


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectModel:
    """An object that agents can take."""

    name: str
    """Name of the model, such as ``003_cracker_box``."""
    asset: Asset
    """Mesh and collision hull, +Y up, metres, at ``scale`` 1; its category is the name without the number."""
    scale: NDArray[np.float64]
    """Scale of the model along each axis, shape [3]."""
    semantic_id: int
    mass_kg: float
    mass_from: Literal["file", "kind", "volume"]
    """Source of the mass: the model's ``kinbody.xml`` or config, the typical mass of its kind (`h3data.scene.kinds.KINDS`), or
    its volume."""
    grasp: Grasp
    """Part that a hand grasps: that of the object's kind, else the whole body."""
    grasp_point: NDArray[np.float64]
    """Point of the grasp in the asset's frame with its scale, shape [3] [m]."""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Smallest and largest corner with its scale, shape [2, 3] [m]."""
        return self.asset.mesh.bounds.astype(np.float64) * self.scale

    def facts(self) -> dict[str, object]:
        """Return the mass and grasp as JSON types."""
        return {
            "mass_kg": self.mass_kg,
            "mass_from": self.mass_from,
            "grasp": self.grasp,
            "grasp_point": self.grasp_point.round(4).tolist(),
        }


def load_object_models(path: str | Path, *, assets: Sequence[str | Path] = ()) -> dict[str, ObjectModel]:
    """Load objects by name.

    They come from one folder of the YCB set (``003_cracker_box`` with ``google_16k/textured.obj``), one
    ``*.object_config.json``, or a folder of these, such as Habitat's ``objects/ycb``.

    Args:
        path: folder or file.
        assets: further folders in which the meshes that a config names are searched.

    Raises:
        InputError: there is no such path, or no object in it.
        SceneError: a file of an object is missing, damaged or has no volume.
    """
    root = Path(path)
    if not root.exists():
        raise InputError(
            f"There is no such folder or file. Expected objects of the YCB set or of Habitat: {root}",
            code="H3-HABITAT-099",
        )
    found = {model.name: model for model in _models(root, tuple(assets))}
    if not found:
        raise InputError(
            f"Found no object in this folder. Expected folders such as 003_cracker_box/google_16k/textured.obj, or files "
            f"*{CONFIG_ENDING}: {root}",
            code="H3-HABITAT-100",
        )
    return found


def _models(root: Path, assets: Sequence[str | Path]) -> Iterator[ObjectModel]:
    if root.is_file():
        yield _of_config(root, assets)
        return
    # configs first: beside them lie meshes that they name
    configs = sorted(root.rglob(f"*{CONFIG_ENDING}"))
    if configs:
        yield from (_of_config(config, assets) for config in configs)
        return
    if (mesh := _mesh_below(root)) is not None:
        yield _of_folder(root, mesh)
        return
    for folder in sorted(each for each in root.iterdir() if each.is_dir()):
        if (mesh := _mesh_below(folder)) is not None:
            yield _of_folder(folder, mesh)
        elif folder.name in ("ycb", "models", "meshes", "objects"):
            yield from _models(folder, assets)


def _mesh_below(folder: Path) -> Path | None:
    files = (folder / variant / name for variant in VARIANTS for name in MESHES)
    return next((file for file in files if is_file(file)), None)


# --- the two layouts ----------------------------------------------------------------------------------------------------
def _of_folder(folder: Path, file: Path) -> ObjectModel:
    """Return an object of the YCB set: Z is up in its meshes."""
    mesh = load_mesh(file, up=(0, 0, 1), front=(0, 1, 0))
    asset = Asset(name=folder.name, mesh=mesh, category=_kind_name(folder.name), shapes=(hull_shape(mesh.vertices),))
    kinbody = next((k for k in (file.parent / "kinbody.xml", folder / "kinbody.xml") if is_file(k)), None)
    mass = None if kinbody is None else _mass_of_kinbody(kinbody, _volume_m3(asset, np.ones(3)))
    return _model(folder.name, asset, np.ones(3), 0, mass)


def _of_config(config: Path, assets: Sequence[str | Path]) -> ObjectModel:
    name = config.name.removesuffix(CONFIG_ENDING)
    files = ReferencedFiles(config, assets)
    reader = TemplateReader(files=files, keys=KeyNotes())
    read = reader.rigid(Template(handle=name, path=config))
    if read is None:
        why = "; ".join([*reader.warnings, *(f"{missing!r} is not found" for missing in files.missing)])
        raise SceneError(
            f"The object {name!r} cannot be used: {why or 'it is jointed'}. File: {config}", code="H3-HABITAT-101"
        )
    mass = number(read.attributes, "mass", 0.0, where=config)
    semantic = int(number(read.attributes, "semantic_id", 0, where=config))
    asset = replace(reader.assets[read.asset], name=name, category=_kind_name(name))
    return _model(name, asset, read.scale, semantic, mass if mass > 0 else None)


def _model(name: str, asset: Asset, scale: NDArray[np.float64], semantic_id: int, mass_kg: float | None) -> ObjectModel:
    words = asset.category.split("_")
    # the whole name first, then its last word: a coffee_mug is a mug
    kind = next((KINDS[word] for word in (asset.category, *reversed(words)) if word in KINDS), None)
    if kind is not None and kind.role != "thing":
        kind = None
    source: Literal["file", "kind", "volume"] = "file"
    if mass_kg is None:
        exact = kind is not None and kind.name == asset.category
        source = "kind" if exact else "volume"
        mass_kg = kind.mass_kg if kind is not None and exact else DENSITY_KG_M3 * _volume_m3(asset, scale)
    grasp: Grasp = "body" if kind is None or kind.grasp == "none" else kind.grasp
    bounds = asset.mesh.bounds.astype(np.float64) * scale
    return ObjectModel(
        name=name,
        asset=asset,
        scale=scale,
        semantic_id=semantic_id or (kind.semantic_id if kind is not None and kind.name == asset.category else 0),
        mass_kg=round(float(mass_kg), 4),
        mass_from=source,
        grasp=grasp,
        grasp_point=grasp_point_in(grasp, bounds),
    )


def _kind_name(name: str) -> str:
    """Return the name of a kind, such as ``cracker_box`` for ``003_cracker_box``."""
    return _NUMBER.sub("", name) or name


def _volume_m3(asset: Asset, scale: NDArray[np.float64]) -> float:
    """Return the volume of the convex hull of an object."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(asset.mesh.vertices.astype(np.float64) * scale).volume)
    except (QhullError, ValueError) as fault:
        raise SceneError(
            f"The object {asset.name!r} has no volume: its mesh is flat or empty.", code="H3-HABITAT-104"
        ) from fault


def _mass_of_kinbody(file: Path, volume_m3: float) -> float | None:
    """Return the mass [kg] that OpenRAVE's ``<Mass>`` gives, in total or by density [kg/m3]; None if it gives none."""
    data = file.read_bytes()
    # nested entities grow to gigabytes while they are read
    if len(data) > _MOST_XML or re.search(rb"<!(DOCTYPE|ENTITY)", data, re.IGNORECASE):
        raise SceneError(
            f"A kinbody with a DOCTYPE, entities or more than 1 MB is refused: {file}", code="H3-HABITAT-102"
        )
    try:
        elements = list(ElementTree.fromstring(data).iter())
    except ElementTree.ParseError as fault:
        raise SceneError(f"Expected XML of OpenRAVE ({fault}): {file}", code="H3-HABITAT-105") from None
    total = 0.0
    for mass in (e for e in elements if e.tag.lower() == "mass"):
        values = {child.tag.lower(): child.text or "" for child in mass}
        try:
            total += float(values["total"]) if "total" in values else float(values.get("density", 0)) * volume_m3
        except ValueError:
            raise SceneError(
                f"Expected a number as mass or density, got {values}: {file}", code="H3-HABITAT-106"
            ) from None
    if not np.isfinite(total) or total < 0:
        raise SceneError(f"Expected a mass of more than 0 kg, got {total}: {file}", code="H3-HABITAT-103")
    return total or None


# --- in a home ------------------------------------------------------------------------------------------------------------
def with_object_models(scene: Scene, models: Mapping[str, ObjectModel], *, seed: int = 0) -> tuple[Scene, int]:
    """Return the scene with models in place of its movable things, and the number of replaced things.

    A model has the position and rotation of the thing that it replaces. Models that are larger than the thing by more
    than `GROWTH_M`, or would touch objects around it, are not used; a thing without a suitable model is not replaced.
    ``scene.source["objects"]`` has mass and grasp of each model that is used, by asset.
    """
    rng = np.random.default_rng(seed)
    names = sorted(models)
    boxes = {i.name: _world_box(scene.assets[i.asset], i) for i in scene.instances if i.motion == "kinematic"}
    instances, assets, used = [], dict(scene.assets), dict[str, ObjectModel]()
    count = 0
    for instance in scene.instances:
        if instance.motion != "kinematic" or not len(scene.assets[instance.asset].mesh.faces):
            instances.append(instance)
            continue
        # in random order, so that the same model does not stand everywhere
        for name in (names[k] for k in rng.permutation(len(names))):
            model = models[name]
            own = replace(model.asset, name=f"object_{name}")
            placed = _in_place_of(instance, boxes[instance.name], model, own)
            box = _world_box(own, placed)
            others = [b for other, b in boxes.items() if other != instance.name]
            if _fits(box, boxes[instance.name], others):
                instances.append(placed)
                boxes[instance.name], assets[own.name], used[own.name] = box, own, model
                count += 1
                break
        else:
            instances.append(instance)
    kept = {i.asset for i in instances}
    source = {**scene.source, "objects": {name: model.facts() for name, model in sorted(used.items())}}
    assets = {name: asset for name, asset in assets.items() if name in kept or name not in scene.assets}
    return replace(scene, assets=assets, instances=tuple(instances), source=source), count


def _in_place_of(thing: Instance, box: NDArray[np.float64], model: ObjectModel, asset: Asset) -> Instance:
    """Return the model upright on the spot where the thing stands, with its heading."""
    # upright: a thing that lay on its side would put its model there too
    turn = quat_from_heading(heading_from_quat(thing.pose[3:]))
    pose = np.concatenate([np.zeros(3), turn]).astype(np.float64)
    placed = Instance(
        name=thing.name,
        asset=asset.name,
        pose=pose,
        scale=model.scale,
        semantic_id=model.semantic_id,
        motion="kinematic",
        layer=thing.layer,
    )
    own = _world_box(asset, placed)
    middle = (box[0] + box[1]) / 2 - (own[0] + own[1]) / 2
    pose[:3] = [middle[0], box[0, 1] - own[0, 1], middle[2]]
    return replace(placed, pose=pose)


def _world_box(asset: Asset, instance: Instance) -> NDArray[np.float64]:
    """Return the axis-aligned box around an instance in the world, shape [2, 3] [m]."""
    if not len(asset.mesh.vertices):
        return np.tile(instance.pose[:3], (2, 1))
    matrix = instance_matrix(instance)
    points = asset.mesh.vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return np.stack([points.min(0), points.max(0)])


def _fits(box: NDArray[np.float64], before: NDArray[np.float64], others: Sequence[NDArray[np.float64]]) -> bool:
    if ((box[1] - box[0]) > (before[1] - before[0]) + GROWTH_M).any():
        return False
    return not any((box[0] < other[1] + GAP_M).all() and (other[0] < box[1] + GAP_M).all() for other in others)
