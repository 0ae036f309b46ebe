"""The keyframes of a gfx-replay file, as typed records, and the fold that turns them into instances with lives.

The format stores changes: a keyframe holds what is new since the one before (spec/habitat.md 5.1). Lists that are empty
are left out, unknown members are ignored, the enumeration ``type`` changed over the years and is never used.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec

from h3data.errors import FormatError
from h3data.interop.sniff import KIND_WORDS, decode_json, json_kind, not_json, read_bytes

Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""What fits a float32 also after a product or two."""
Vec3 = tuple[Number, Number, Number]
Quat = tuple[Number, Number, Number, Number]
Key = Annotated[int, msgspec.Meta(ge=0)]


class Transform(msgspec.Struct):
    """``rotation`` is w x y z."""

    translation: Vec3
    rotation: Quat


class Frame(msgspec.Struct):
    up: Vec3 = (0.0, 1.0, 0.0)
    front: Vec3 = (0.0, 0.0, -1.0)


class Phong(msgspec.Struct):
    diffuse: Annotated[list[Number], msgspec.Meta(min_length=3)] | None = None


class Load(msgspec.Struct):
    filepath: str
    frame: Frame = msgspec.field(default_factory=Frame)
    virtualUnitToMeters: Annotated[float, msgspec.Meta(gt=0, le=1e9)] = 1.0
    overridePhongMaterial: Phong | None = None


class Creation(msgspec.Struct):
    filepath: str
    scale: Vec3 = (1.0, 1.0, 1.0)
    isStatic: bool = False
    rigId: int = -1


class CreationItem(msgspec.Struct):
    instanceKey: Key
    creation: Creation


class State(msgspec.Struct):
    absTransform: Transform
    semanticId: int | None = None


class StateItem(msgspec.Struct):
    instanceKey: Key
    state: State


class Metadata(msgspec.Struct):
    semanticId: int | None = None
    objectId: int | None = None


class MetadataItem(msgspec.Struct):
    instanceKey: Key
    metadata: Metadata


class BonePose(msgspec.Struct):
    t: Vec3
    r: Quat


class RigCreation(msgspec.Struct):
    id: int
    boneNames: list[str] = []


class RigUpdate(msgspec.Struct):
    id: int
    pose: list[BonePose]


class UserTransform(msgspec.Struct):
    name: str
    transform: Transform


class Keyframe(msgspec.Struct):
    loads: list[Load] = []
    rigCreations: list[RigCreation] = []
    creations: list[CreationItem] = []
    metadata: list[MetadataItem] = []
    deletions: list[Key] = []
    stateUpdates: list[StateItem] = []
    rigUpdates: list[RigUpdate] = []
    userTransforms: list[UserTransform] = []
    lights: list[dict[str, Any]] = []
    lightsChanged: bool = False


class _File(msgspec.Struct):
    keyframes: list[Keyframe] | None = None
    keyframe: Keyframe | None = None


@dataclass(eq=False)
class Life:
    """One instance from its creation to its deletion."""

    key: int
    creation: Creation
    start: int
    """First keyframe in which it exists."""
    end: int = -1
    """First keyframe in which it no longer exists; -1 = it stays to the end."""
    semantic_id: int = 0
    steps: list[int] = field(default_factory=list)
    """Keyframes in which its pose was written, increasing."""
    transforms: list[Transform] = field(default_factory=list)


@dataclass(eq=False)
class Fold:
    """Everything that the keyframes say, by instance."""

    steps: int
    lives: list[Life] = field(default_factory=list)
    loads: dict[str, list[Load]] = field(default_factory=dict)
    bone_names: dict[int, list[str]] = field(default_factory=dict)
    rig_poses: dict[int, list[tuple[int, list[BonePose]]]] = field(default_factory=dict)
    user: dict[str, list[tuple[int, Transform]]] = field(default_factory=dict)
    lights: list[tuple[int, list[dict[str, Any]]]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    """How often something odd was met, by what it was."""

    def note(self, what: str) -> None:
        self.counts[what] = self.counts.get(what, 0) + 1


def read_keyframes(path: Path) -> tuple[bytes, list[Keyframe]]:
    """Bytes and keyframes of a ``.gfx_replay.json`` or ``.json.gz``; also of a single ``{"keyframe": {...}}``."""
    data = read_bytes(path)
    try:
        file = decode_json(data, _File)
    except msgspec.ValidationError as fault:
        raise _explain(path, data, str(fault)) from None
    except msgspec.DecodeError as fault:
        raise not_json(path, data, fault) from None
    keyframes = file.keyframes if file.keyframes is not None else [file.keyframe] if file.keyframe is not None else None
    if keyframes is None:
        raise _other_kind(path, decode_json(data))
    if not keyframes:
        raise FormatError(f"A gfx-replay without keyframes: there is nothing to import. {path}")
    return data, keyframes


def fold_keyframes(keyframes: Sequence[Keyframe]) -> Fold:
    """Instances with their lives and poses: the keyframes applied one after another, as Habitat's player does."""
    fold = Fold(steps=len(keyframes))
    live: dict[int, Life] = {}
    for step, keyframe in enumerate(keyframes):
        for load in keyframe.loads:
            fold.loads.setdefault(load.filepath, []).append(load)
        for rig in keyframe.rigCreations:
            fold.bone_names[rig.id] = rig.boneNames
        _create_and_delete(fold, live, step, keyframe)
        for item in keyframe.metadata:
            if item.instanceKey in live and item.metadata.semanticId is not None:
                live[item.instanceKey].semantic_id = item.metadata.semanticId
        for item in keyframe.stateUpdates:
            life = live.get(item.instanceKey)
            if life is None:
                fold.note("pose updates of instances that do not exist")
                continue
            if item.state.semanticId is not None:
                life.semantic_id = item.state.semanticId
            life.steps.append(step)
            life.transforms.append(item.state.absTransform)
        for update in keyframe.rigUpdates:
            fold.rig_poses.setdefault(update.id, []).append((step, update.pose))
        for item in keyframe.userTransforms:
            fold.user.setdefault(item.name, []).append((step, item.transform))
        if keyframe.lightsChanged or keyframe.lights:
            fold.lights.append((step, keyframe.lights))
    return fold


def _create_and_delete(fold: Fold, live: dict[int, Life], step: int, keyframe: Keyframe) -> None:
    """Apply one keyframe's deletions and creations.

    The player creates first and then deletes. A key that lived before and is in both lists is another instance that
    re-uses the key: the old one ends, the new one stays. A key that did not live before cancels itself out.
    """
    created = {item.instanceKey for item in keyframe.creations}
    for key in keyframe.deletions:
        if key in live:
            live.pop(key).end = step
        elif key in created:
            created.discard(key)
        else:
            fold.note("deletions of instances that do not exist")
    for item in keyframe.creations:
        if item.instanceKey not in created:
            continue
        if item.instanceKey in live:
            fold.note("creations under a key that was still in use (the older instance ends there)")
            live[item.instanceKey].end = step
        live[item.instanceKey] = Life(key=item.instanceKey, creation=item.creation, start=step)
        fold.lives.append(live[item.instanceKey])


def _other_kind(path: Path, content: Any) -> FormatError:
    kind = json_kind(content, name=path.name)
    if isinstance(content, dict):
        keys = ", ".join(list(content)[:8]) or "none"
        shape = f"Its top-level keys are: {keys}; it looks like {KIND_WORDS.get(kind, kind)}."
    else:
        shape = f"It holds a JSON {type(content).__name__}."
    return FormatError(f"Expected a gfx-replay (JSON with the key 'keyframes'). {shape} {path}")


def _explain(path: Path, data: bytes, message: str) -> FormatError:
    """An error that names keyframe and instance instead of an index path."""
    try:
        content = json.loads(data)  # msgspec refuses numbers that are too large, which may be the very fault
    except (ValueError, RecursionError):
        return FormatError(f"Not a valid gfx-replay: {message}: {path}")
    if not isinstance(content, dict) or not content.keys() & {"keyframes", "keyframe"}:
        return _other_kind(path, content)
    reason, _, where = message.partition(" - at `")
    where = where.rstrip("`").removeprefix("$.")
    match = re.match(r"keyframes\[(\d+)\](?:\.(\w+)(?:\[(\d+)\])?)?", where)
    if match:
        number, group, index = match.groups()
        place = f"keyframe {number}"
        item = None
        if group is not None and index is not None:
            item = content["keyframes"][int(number)][group][int(index)]
        key = item.get("instanceKey", item.get("id", item.get("name"))) if isinstance(item, dict) else None
        place += f", {group}" if group else ""
        place += f", instance {key}" if key is not None else f"[{index}]" if index is not None else ""
        where = f"{place} ({where})"
    return FormatError(
        f"Not a valid gfx-replay: {reason[:1].lower() + reason[1:]} at {where or 'its top level'}: {path}"
    )
