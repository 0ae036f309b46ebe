"""Grouping of the prims of a stage into instances, which have surfaces and colliders that move together."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, SceneError
from h3data_worlds.usd.colliders import is_collider
from h3data_worlds.usd.stages import OpenStage, pxr
from h3data_worlds.usd.surfaces import MAKERS

KEY = "h3data"
"""Key of h3data's records in ``customData``."""
MAX_PRIMS = 2_000_000
"""Largest number of prims of a stage, where prims of instances are counted each time."""
MAX_COPIES = 200_000
"""Largest number of instances in a stage, including copies of point instancers and nested instances."""
_SHOWN = ("default", "render")


@dataclass(frozen=True, kw_only=True, eq=False)
class Gprim:
    """Prim with a surface, and its transform."""

    prim: Any
    world: NDArray[np.float64]
    """Transform from the prim to the world of the stage, in its units, shape [4, 4]."""
    shown: bool
    collides: bool


@dataclass(kw_only=True, eq=False)
class Thing:
    """Future instance of the scene: the prims at and below ``prim`` that belong to no instance further down."""

    prim: Any
    name: str
    world: NDArray[np.float64]
    """Transform from the instance's prim to the world of the stage, shape [4, 4]."""
    body: str
    """Path of the rigid body to which the instance belongs; empty if there is none."""
    label: str = ""
    """Semantic label of the instance; empty if it has none."""
    shared: str = ""
    """Key that copies of the same object share; empty if unknown."""
    loose: bool = False
    """True for a single surface that is not marked as an object, such as a wall."""
    gprims: list[Gprim] = field(default_factory=list)


def records_of(prim: Any) -> Mapping[str, Any]:
    """Return h3data's record at a prim; empty if it has none.

    Raises:
        FormatError: the record is not JSON.
    """
    text = prim.GetCustomDataByKey(KEY)
    if text is None:
        return {}
    try:
        record = json.loads(text) if isinstance(text, str) else None
    except (ValueError, RecursionError):
        record = None
    if not isinstance(record, dict):
        raise FormatError(
            f"Expected JSON that h3data wrote in customData of {prim.GetPath()}, got {text!r:.60}. "
            f"File: {prim.GetStage().GetRootLayer().realPath}",
            code="H3-WORLD-013",
        )
    return record


def matrix_of(value: Any) -> NDArray[np.float64]:
    """Return a `Gf.Matrix4d`, which acts on rows, as a matrix [4, 4] that acts on columns."""
    return np.array(value, np.float64).T


def label_of(prim: Any) -> str:
    """Return the semantic label of a prim itself, by UsdSemantics or Isaac's older schema; empty if it has none."""
    labels = pxr("UsdSemantics").LabelsAPI
    for taxonomy in sorted(labels.GetDirectTaxonomies(prim), key=lambda name: name != "class"):
        found = labels(prim, taxonomy).GetLabelsAttr().Get()
        if found:
            return str(found[0])
    for attribute in prim.GetAttributes() if "SemanticsAPI" in str(prim.GetMetadata("apiSchemas")) else ():
        name = attribute.GetName()
        if name.startswith("semantic:") and name.endswith(":params:semanticData"):
            kind = prim.GetAttribute(name.replace("semanticData", "semanticType")).Get()
            if kind in (None, "class") and attribute.Get():
                return str(attribute.Get())
    return ""


class ThingFinder:
    """Traversal of a stage, from parents to children, that assigns prims to instances."""

    def __init__(self, opened: OpenStage) -> None:
        self.opened = opened
        self.things: dict[str, Thing] = {}
        """By path, in the order of the stage."""
        self.joints: list[Any] = []
        self.rooms: list[Mapping[str, Any]] = []
        self.articulated: dict[str, Mapping[str, Any]] = {}
        """h3data's records of things that open, by path."""
        self.assets: dict[str, Mapping[str, Any]] = {}
        """h3data's records of assets, by their key."""
        self.receptacles: dict[str, list[Any]] = {}
        self.notes: dict[str, None] = {}
        """Sentences on what was left out, in order."""
        self.copies = 0
        usd, geom = pxr("Usd"), pxr("UsdGeom")
        self._time = usd.TimeCode.EarliestTime()
        self._places = geom.XformCache(self._time)
        self._imageable, self._gprim, self._instancer = geom.Imageable, geom.Gprim, geom.PointInstancer
        self._joint, self._body = pxr("UsdPhysics").Joint, pxr("UsdPhysics").RigidBodyAPI
        self._model = usd.ModelAPI

    def walk(self) -> None:
        """Assign all prims to instances.

        Raises:
            SceneError: there are too many prims or instances.
        """
        usd = pxr("Usd")
        walk = iter(usd.PrimRange(self.opened.stage.GetPseudoRoot(), usd.TraverseInstanceProxies()))
        state: dict[str, tuple[str, str, bool, str]] = {"/": ("", "", True, "default")}
        for count, prim in enumerate(walk):
            if count > MAX_PRIMS:
                raise SceneError(
                    f"The stage has more than {MAX_PRIMS:,} prims, which is the limit. File: {self.opened.path}",
                    code="H3-WORLD-015",
                )
            if prim.IsPseudoRoot():
                continue
            path = str(prim.GetPath())
            above = state[str(prim.GetPath().GetParentPath())]
            thing, body, visible, purpose = above
            if prim.IsA(self._joint):
                self.joints.append(prim)
            record = records_of(prim)
            if "room" in record:
                self.rooms.append(record["room"])
                walk.PruneChildren()
                continue
            if "receptacle" in record:
                continue
            if "thing" in record:
                self.articulated[path] = record["thing"]
            if "key" in record:
                self.assets[str(record["key"])] = record
            imageable = self._imageable(prim)
            if imageable:
                visible = visible and imageable.GetVisibilityAttr().Get(self._time) != "invisible"
                own = imageable.GetPurposeAttr().Get()
                purpose = own if own not in (None, "default") else purpose
            is_body = prim.HasAPI(self._body) and self._body(prim).GetRigidBodyEnabledAttr().Get() is not False
            body = path if is_body else body
            label = label_of(prim)
            if "instance" in record or is_body or label or prim.IsInstance() or self._is_component(prim):
                thing = path
                self._add(prim, path, body, label)
            state[path] = (thing, body, visible, purpose)
            if prim.IsA(self._instancer):
                self._copies(prim, body, visible)
                walk.PruneChildren()
            elif prim.IsA(self._gprim):
                self._place(prim, path, *state[path])

    def _is_component(self, prim: Any) -> bool:
        return self._model(prim).GetKind() in ("component", "subcomponent")

    def _world(self, prim: Any) -> NDArray[np.float64]:
        return matrix_of(self._places.GetLocalToWorldTransform(prim))

    def _add(self, prim: Any, path: str, body: str, label: str, *, loose: bool = False) -> Thing:
        self._allow(1)
        shared = str(prim.GetPrototype().GetPath()) if prim.IsInstance() else ""
        made = Thing(prim=prim, name=path, world=self._world(prim), body=body, label=label, shared=shared, loose=loose)
        self.things[path] = made
        return made

    def _place(self, prim: Any, path: str, thing: str, body: str, visible: bool, purpose: str) -> None:
        shown, collides = visible and purpose in _SHOWN, is_collider(prim)
        if not (shown or collides):
            return
        owner = self.things[thing] if thing else self._add(prim, path, body, "", loose=True)
        owner.gprims.append(Gprim(prim=prim, world=self._world(prim), shown=shown, collides=collides))

    def _allow(self, more: int) -> None:
        """Count things before they are made, because a few nested instances may stand for millions."""
        self.copies += more
        if self.copies > MAX_COPIES:
            raise SceneError(
                f"The stage has more than {MAX_COPIES:,} things and copies, which is the limit. File: {self.opened.path}",
                code="H3-WORLD-014",
            )

    def _copies(self, prim: Any, body: str, visible: bool) -> None:
        """Add the copies that a point instancer makes of its prototypes, as separate things."""
        instancer = self._instancer(prim)
        which = np.asarray(instancer.GetProtoIndicesAttr().Get(self._time) or (), np.int64)
        prototypes = instancer.GetPrototypesRel().GetForwardedTargets()
        self._allow(len(which))
        placed = instancer.ComputeInstanceTransformsAtTime(self._time, self._time, instancer.IncludeProtoXform)
        mask = instancer.ComputeMaskAtTime(self._time)
        if not visible:
            return
        if len(placed) != len(which):
            self.notes[f"the point instancer {prim.GetPath()} is left out: its places do not fit its copies"] = None
            return
        here = self._world(prim)
        parts = [list(self._below(self.opened.stage.GetPrimAtPath(path))) for path in prototypes]
        for k, (number, local) in enumerate(zip(which.tolist(), placed, strict=True)):
            if not 0 <= number < len(parts) or (len(mask) and not mask[k]):
                continue
            proto = self.opened.stage.GetPrimAtPath(prototypes[number])
            path = f"{prim.GetPath()}/{prototypes[number].name}_{k}"
            world = here @ matrix_of(local)
            made = Thing(
                prim=proto, name=path, world=world, body=body, label=label_of(proto) or label_of(prim),
                shared=f"{prim.GetPath()}:{number}",
            )  # fmt: skip
            made.gprims = [
                Gprim(prim=p, world=world @ place, shown=True, collides=is_collider(p)) for p, place in parts[number]
            ]
            self.things[path] = made

    def _below(self, prototype: Any) -> Iterator[tuple[Any, NDArray[np.float64]]]:
        """Yield surfaces at and below a prototype, each with its transform to the prototype's frame."""
        usd = pxr("Usd")
        if not prototype:
            return
        back = np.linalg.pinv(self._world(prototype))
        for prim in usd.PrimRange(prototype, usd.TraverseInstanceProxies()):
            if prim.IsA(self._instancer):
                self.notes[f"a point instancer in a prototype is not read: {prim.GetPath()}"] = None
            elif prim.IsA(self._gprim) and self._imageable(prim).ComputePurpose() in _SHOWN:
                if prim.GetTypeName() in MAKERS:
                    yield prim, back @ self._world(prim)
                else:
                    self.notes[f"{prim.GetTypeName()} prims are not read, such as {prim.GetPath()}"] = None
