"""Reader of USD stages as scenes.

An instance is a prim with a semantic label, a rigid body, an instance of a prototype, a copy of a point instancer, or a
model of kind ``component``, with all prims below it. Any other surface is an instance of its own. Rigid bodies without
a joint can be moved. Stages that h3data wrote keep their rooms, receptacles and names.
"""

from __future__ import annotations

import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, MissingAssetError, SceneError
from h3data.geometry import Array, pose_from_matrix, transform_points
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import joined
from h3data.scene.kinds import KINDS
from h3data.scene.records import Articulation, Asset, Instance, Part, Scene, Shape
from h3data.scene.scene_json import read_articulation, read_asset, read_instance, read_light, read_room
from h3data_worlds.usd.colliders import collider_shapes, hulls_of
from h3data_worlds.usd.joints import JointReader
from h3data_worlds.usd.stages import OpenStage, open_stage, reading
from h3data_worlds.usd.surfaces import SurfaceReader
from h3data_worlds.usd.things import Gprim, Thing, ThingFinder, records_of

_NEAR = 1e-5
"""Difference of numbers in a stage and in our records below which they are the same [m, or as share]."""
_NOTES_MAX = 20
_EMPTY = Mesh(
    vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32), colors=np.zeros((0, 3), np.uint8)
)


def read_usd(path: Any, *, allow_missing: bool = False, strict: bool = False) -> tuple[Scene, list[str] | None]:
    """Return the scene of a USD file, and the files on which it depends (None if some are missing).

    `Scene.source` lists what was omitted or guessed (``warnings``). The world of the scene has +Y up and metres for any
    ``upAxis`` and ``metersPerUnit`` of the stage.

    Args:
        path: A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
        allow_missing: True to omit, with a warning, content that refers to missing files.
        strict: True to make warnings errors.

    Raises:
        MissingExtraError: usd-core is not installed.
        FormatError: the file is not a USD file, or is damaged.
        MissingAssetError: files to which the stage refers are missing.
        SceneError: the stage is empty or too large; with ``strict`` also any warning.
    """
    opened = open_stage(path)
    with reading(path):
        reader = _StageReader(opened)
        scene, warnings, missing = reader.read()
    if missing and not allow_missing:
        named = ", ".join(missing[:5]) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        raise MissingAssetError(
            f"The stage refers to {len(missing)} files that are not there: {named}. "
            f"Hint: --allow-missing leaves them out. File: {path}",
            code="H3-WORLD-001",
        )
    warnings += [f"{name} was not found" for name in missing]
    if strict and warnings:
        raise SceneError(
            f"The stage cannot be read without loss: {'; '.join(warnings[:5])}. File: {path}", code="H3-WORLD-002"
        )
    if not scene.instances:
        raise SceneError(
            f"There is nothing to be seen in the stage{': ' + '; '.join(warnings[:3]) if warnings else ''}. File: {path}",
            code="H3-WORLD-003",
        )
    layers = {str(layer.realPath) for layer in opened.stage.GetUsedLayers() if layer.realPath}
    files = sorted({name.partition("[")[0] for name in layers | reader.surfaces.files})
    source = {**scene.source, **({"warnings": warnings} if warnings else {})}
    return replace(scene, source=source), None if missing else files


class _StageReader:
    """Reader of one stage."""

    def __init__(self, opened: OpenStage) -> None:
        self.opened = opened
        root = opened.stage.GetDefaultPrim()
        self.head: Mapping[str, Any] = records_of(root) if root else {}
        self.ours = "version" in self.head
        self.surfaces = SurfaceReader(open=opened, ours=self.ours)
        self.finder = ThingFinder(opened)
        self.assets: dict[str, Asset] = {}
        self._asset_of: dict[Any, str] = {}
        self._asset_names = _Names()
        self.changed = False
        """True if a stage that h3data wrote lacks some of its content."""

    def read(self) -> tuple[Scene, list[str], list[str]]:
        """Return the scene, what was left out or guessed, and which files are missing."""
        notes = self.surfaces.notes
        self.finder.walk()
        notes |= self.finder.notes
        for fault in self.opened.faults:
            notes[f"a reference cannot be followed ({fault})"] = None
        instances, names, members = self._instances()
        try:
            things = self._things(names, members, {i.name for i in instances})
            scene = self._scene(instances, things)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as fault:
            raise FormatError(
                f"Damaged records of h3data in a stage ({type(fault).__name__}: {fault}). File: {self.opened.path}",
                code="H3-WORLD-004",
            ) from fault
        missing = [*self.opened.missing, *(name for name in self.surfaces.missing if name not in self.opened.missing)]
        warnings = [*notes][:_NOTES_MAX] + ([f"{len(notes) - _NOTES_MAX} more"] if len(notes) > _NOTES_MAX else [])
        return scene, warnings, missing

    def _scene(self, instances: Sequence[Instance], things: tuple[Articulation, ...]) -> Scene:
        name = self.opened.path.name.split(".")[0]
        source: dict[str, Any] = {"kind": "usd", "path": str(self.opened.path)}
        if not self.ours:
            return Scene(
                name=name, assets=self.assets, instances=tuple(instances), articulations=things,
                source={**source, "metersPerUnit": self.opened.metres},
            )  # fmt: skip
        order = {name: k for k, name in enumerate(self.head["instances"])}
        kept = tuple(sorted(instances, key=lambda i: order.get(i.name, len(order))))
        whole = not self.changed and [i.name for i in kept] == self.head["instances"]
        used = {i.asset for i in kept}
        lights = self.head.get("lights")
        return Scene(
            name=str(self.head["name"]),
            assets={key: self.assets[key] for key in self.head["assets"] if key in used},
            instances=kept,
            rooms=tuple(read_room(dict(record)) for record in self.finder.rooms),
            lights=None if lights is None else tuple(read_light(light) for light in lights),
            source=dict(self.head["source"]) if whole else {**source, "changed": True},
            articulations=things,
        )

    # --- instances ------------------------------------------------------------------------------------------------------
    def _instances(self) -> tuple[list[Instance], dict[str, str], dict[str, list[str]]]:
        """Return the instances; their names by path; the names of those of each rigid body, by its path."""
        out: list[Instance] = []
        names: dict[str, str] = {}
        members: dict[str, list[str]] = {}
        used = _Names()
        jointed = self._jointed()
        for path, thing in self.finder.things.items():
            if thing.body:
                members.setdefault(thing.body, [])
            record = records_of(thing.prim).get("instance") if self.ours else None
            if not thing.gprims and record is None:
                continue
            try:
                made = self._ours(thing, record) if record else self._foreign(thing, jointed)
            except (KeyError, TypeError, ValueError, AttributeError) as fault:
                raise FormatError(
                    f"Damaged record of h3data at {path} ({fault}). File: {self.opened.path}", code="H3-WORLD-005"
                ) from fault
            if made is None:
                continue
            name = used.take(made.name)
            if name != made.name:
                made = replace(made, name=name)
                self.changed = self.changed or bool(record)
            names[path] = made.name
            out.append(made)
            if thing.body:
                members[thing.body].append(made.name)
        return out, names, members

    def _jointed(self) -> set[str]:
        """Return paths of prims that joints name as bodies."""
        out: set[str] = set()
        for prim in self.finder.joints:
            for name in ("physics:body0", "physics:body1"):
                relation = prim.GetRelationship(name)
                out |= {str(target) for target in relation.GetTargets()} if relation else set()
        return out

    def _ours(self, thing: Thing, record: Mapping[str, Any]) -> Instance | None:
        kept = read_instance(dict(record))
        key = self._our_asset(kept.asset, thing)
        matrix = self.opened.in_metres(thing.world)
        scale = np.linalg.norm(matrix[:3, :3], axis=0)
        if not np.isfinite(matrix).all() or not scale.all():
            self.surfaces.notes[f"{thing.name} has a place that is not finite, or no size"] = None
            return None
        turn = matrix.copy()
        turn[:3, :3] /= scale
        if np.abs(turn[:3, :3].T @ turn[:3, :3] - np.eye(3)).max() > 1e-4 or np.linalg.det(turn[:3, :3]) < 0:
            self.changed = True
            return self._foreign(thing, set())
        made = replace(kept, asset=key, pose=pose_from_matrix(turn), scale=scale)
        same = np.allclose(made.pose[:3], kept.pose[:3], atol=_NEAR) and np.allclose(scale, kept.scale, atol=_NEAR)
        if same and 1 - abs(made.pose[3:] @ kept.pose[3:]) < _NEAR**2:
            return replace(kept, asset=key)
        self.changed = True
        return made

    def _our_asset(self, key: str, thing: Thing) -> str:
        """Return the asset of an instance of ours: its record, which meshes and colliders of the stage may have changed."""
        if key in self.assets:
            return key
        record = self.finder.assets.get(key) or records_of(
            thing.prim.GetPrototype() if thing.prim.IsInstance() else thing.prim
        )
        record = record if "key" in record else _asset_record(self.opened, key)
        back = np.linalg.inv(self.opened.in_metres(thing.world))
        mesh, shapes = self._content(thing, back, moves=True)
        if mesh is None:
            mesh = replace(_EMPTY, normals=np.zeros((0, 3), np.float32)) if record.get("has_normals") else _EMPTY
        asset = read_asset(dict(record), mesh)
        if not _same_shapes(asset.shapes, shapes):
            self.changed = True
            asset = replace(asset, shapes=tuple(shapes))
        self.assets[key] = asset
        return key

    def _foreign(self, thing: Thing, jointed: set[str]) -> Instance | None:
        matrix = self.opened.in_metres(thing.world)
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-18:
            self.surfaces.notes[f"{thing.name} has a place that is not finite, or no size"] = None
            return None
        frame = _rigid_part(matrix)
        stretch = np.linalg.inv(frame) @ matrix
        free = bool(thing.body) and thing.body not in jointed and not self._is_held(thing)
        key = (
            (thing.shared, thing.label, np.round(stretch, 6).tobytes(), bool(thing.body))
            if thing.shared
            else thing.name
        )
        if key not in self._asset_of:
            mesh, shapes = self._content(thing, np.linalg.inv(frame), moves=bool(thing.body))
            if mesh is None and not shapes:
                return None
            if mesh is not None and not shapes and not thing.loose:
                shapes = hulls_of(mesh.vertices.astype(np.float64), mesh.faces)
            category = _category(thing)
            name = self._asset_names.take(_plain_name(thing.prim.GetName()), beside=self.assets)
            self.assets[name] = Asset(
                name=name, mesh=_EMPTY if mesh is None else mesh, category=category, shapes=tuple(shapes)
            )
            self._asset_of[key] = name
        asset = self._asset_of[key]
        category = self.assets[asset].category
        return Instance(
            name=_plain_name(thing.name.rpartition("/")[2]),
            asset=asset,
            pose=np.asarray(pose_from_matrix(frame), np.float64),
            semantic_id=KINDS[category].semantic_id if category in KINDS else 0,
            motion="kinematic" if free else "static",
            layer="ceiling" if category == "ceiling" else "",
        )

    def _is_held(self, thing: Thing) -> bool:
        """Return whether a body follows its animation only, so that nothing moves it."""
        prim = self.opened.stage.GetPrimAtPath(thing.body)
        return bool(prim and prim.GetAttribute("physics:kinematicEnabled").Get())

    def _content(self, thing: Thing, back: Array, *, moves: bool) -> tuple[Mesh | None, list[Shape]]:
        """Return mesh and shapes of a thing in the frame to which ``back`` [4, 4] leads from the world, +Y up [m]."""
        meshes: list[Mesh] = []
        shapes: list[Shape] = []
        for gprim in thing.gprims:
            matrix = back @ self.opened.in_metres(gprim.world)
            matrix = np.eye(4) if np.abs(matrix - np.eye(4)).max() < 1e-12 else matrix
            if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-18:
                self.surfaces.notes[f"{gprim.prim.GetPath()} has a place that is not finite, or no size"] = None
                continue
            mesh = self._surface(gprim)
            if gprim.shown and mesh is not None:
                meshes.append(_moved(mesh, matrix))
            if gprim.collides:
                shapes += collider_shapes(self.opened, gprim.prim, mesh, matrix, moves=moves)
        return joined(meshes) if meshes else None, shapes

    def _surface(self, gprim: Gprim) -> Mesh | None:
        needs = gprim.shown or gprim.prim.GetTypeName() in ("Mesh", "Cone", "Plane")
        return self.surfaces.mesh(gprim.prim) if needs else None

    # --- things that open -----------------------------------------------------------------------------------------------
    def _things(
        self, names: Mapping[str, str], members: Mapping[str, list[str]], there: set[str]
    ) -> tuple[Articulation, ...]:
        found = JointReader(self.opened, self.surfaces.notes).read(self.finder.joints, members, names)
        if not self.finder.articulated:
            return tuple(found)
        by_name = {thing.name: thing for thing in found}
        out: list[Articulation] = []
        for path, record in self.finder.articulated.items():
            kept = read_articulation(dict(record))
            read = by_name.pop(path.rpartition("/")[2], None)
            if read is None or len(read.parts) != len(kept.parts):
                self.changed = True
                out += [] if read is None else [read]
                continue
            parts = []
            for old, new in zip(kept.parts, sorted(read.parts, key=lambda part: _order(kept.parts, part)), strict=True):
                carried = tuple(name for name in old.instances if name in there)
                same = _same_joint(old, new) and len(carried) == len(old.instances)
                self.changed |= not same
                parts.append(
                    replace(old, instances=carried) if same else replace(old, joint=new.joint, instances=carried)
                )
            pose = kept.pose if np.allclose(kept.pose, read.pose, atol=_NEAR) else read.pose
            self.changed |= pose is read.pose
            base = kept.base if kept.base in there else ""
            out.append(replace(kept, pose=pose, parts=tuple(parts), base=base))
        return (*out, *by_name.values())


def _order(parts: Sequence[Part], part: Part) -> int:
    """Return the index among our records of the part that a body is, by a name that USD allows."""
    plain = [re.sub(r"[^A-Za-z0-9_]", "_", other.name).lstrip("_") for other in parts]
    name = part.name.lstrip("_")
    return plain.index(name) if name in plain else len(parts)


def _same_joint(old: Part, new: Part) -> bool:
    a, b = old.joint, new.joint
    line = np.cross(a.origin - b.origin, a.axis) if a.kind == "revolute" else np.zeros(3)
    numbers = np.array([a.lower - b.lower, a.upper - b.upper, a.rest - b.rest, *(a.axis - b.axis), *line])
    return a.kind == b.kind and bool(np.abs(numbers).max() < _NEAR)


def _same_shapes(old: Sequence[Shape], new: Sequence[Shape]) -> bool:
    """Return whether shapes of a stage are those of our record, within the precision of the stage."""
    if [type(s) for s in old] != [type(s) for s in new]:
        return False
    for a, b in zip(old, new, strict=True):
        for name, value in vars(a).items():
            one, other = np.asarray(value, np.float64), np.asarray(getattr(b, name), np.float64)
            if name == "pose" and one[3:] @ other[3:] < 0:
                other = np.concatenate([other[:3], -other[3:]])
            if name == "points":
                one, other = (np.stack([v.min(0), v.max(0)]) for v in (one, other))
            if one.shape != other.shape or not np.allclose(one, other, atol=_NEAR):
                return False
    return True


def _asset_record(opened: OpenStage, key: str) -> Mapping[str, Any]:
    """Return our record of an asset, from the class prims that instances refer to."""
    classes = opened.stage.GetPrimAtPath(opened.stage.GetDefaultPrim().GetPath().AppendChild("Assets"))
    for prim in classes.GetAllChildren() if classes else ():
        record = records_of(prim)
        if record.get("key") == key:
            return record
    raise ValueError(f"there is no asset {key!r}")


def _rigid_part(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation nearest to a matrix [4, 4], with its place."""
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    u[:, 2] *= np.sign(np.linalg.det(u @ vt))
    out = matrix.copy()
    out[:3, :3] = u @ vt
    return out


def _moved(mesh: Mesh, matrix: NDArray[np.float64]) -> Mesh:
    """Return the mesh under a matrix [4, 4] that may scale, shear and mirror."""
    if np.array_equal(matrix, np.eye(4)):
        return mesh
    normals = mesh.normals
    if normals is not None:
        turned = normals.astype(np.float64) @ np.linalg.inv(matrix[:3, :3])
        normals = (turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)).astype(np.float32)
    faces = mesh.faces if np.linalg.det(matrix[:3, :3]) > 0 else np.ascontiguousarray(mesh.faces[:, ::-1])
    vertices = transform_points(matrix, mesh.vertices.astype(np.float64)).astype(np.float32)
    return replace(mesh, vertices=vertices, faces=faces, normals=normals)


def _category(thing: Thing) -> str:
    """Return the semantic class of a thing: its label, or the kind that its name begins with; ``stage`` for loose surfaces."""
    if thing.label:
        return re.sub(r"[^a-z0-9]+", "_", thing.label.lower()).strip("_") or "object"
    plain = re.sub(r"[\d_]+$", "", thing.prim.GetName().lower())
    if plain in KINDS:
        return plain
    return "stage" if thing.loose else "object"


def _plain_name(text: str) -> str:
    return text.replace("|", "_") or "thing"


class _Names:
    """Names that are taken: thousands of prims may have the same one."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def take(self, name: str, beside: Container[str] = ()) -> str:
        """Return the name, with a number behind it if others have it, also among those in ``beside``."""
        number, made = self._last.get(name, 1), name
        while made in self._last or made in beside:
            number += 1
            made = f"{name}_{number}"
        self._last[name] = number
        self._last.setdefault(made, 1)
        return made
