"""Conversion of the keyframes of a gfx-replay, which hold changes, to instances with lifetimes, poses and columns."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError
from h3data.formats.source_file import decode_json
from h3data.geometry import IDENTITY_POSE, quat_sign_continuous
from h3data_habitat.gfx.keyframes import BonePose, Creation, Keyframe, Load, Transform
from h3data_habitat.limits import MAX_BODIES, MAX_STEPS, check_count, check_size

_BLOCK = 1 << 14
LIGHT_BYTES = 4 << 20
"""Largest size of stored text about lights; a light takes 90 bytes."""


@dataclass(eq=False)
class Updates:
    """Poses of one thing and the keyframes that wrote them, in 32 bytes each, because a long file has millions."""

    steps: array[int] = field(default_factory=lambda: array("i"))
    """Numbers of the keyframes, not decreasing."""
    _values: array[float] = field(default_factory=lambda: array("f"))
    _tidy: bool = False
    """True if the values are pose7 already; before, they are x y z and w x y z."""

    def add(self, step: int, transform: Transform) -> None:
        """Add the pose of a node."""
        self.steps.append(step)
        self._values.extend(transform.translation)
        self._values.extend(transform.rotation)

    def add_bones(self, step: int, bones: list[BonePose]) -> None:
        """Add the poses of all bones of a rig."""
        self.steps.append(step)
        for bone in bones:
            self._values.extend(bone.t)
            self._values.extend(bone.r)

    def poses(self, bones: int = 1) -> NDArray[np.float32]:
        """Return the poses (pose7) [U, bones, 7] of all updates, with sign-continuous unit quaternions on axis 0.

        Files round to 4 decimals. A quaternion of 0 gives NaN. The result is a view: updates can neither be added nor
        removed while it is held.
        """
        if not self.steps:
            return np.zeros((0, bones, 7), np.float32)
        # no copy: the poses of a long replay take gigabytes
        poses = np.frombuffer(self._values, np.float32).reshape(-1, bones, 7)
        if not self._tidy:
            for start in range(0, len(poses), _BLOCK):
                part = poses[start : start + _BLOCK]
                quats = part[..., [4, 5, 6, 3]].astype(np.float64)
                with np.errstate(invalid="ignore", divide="ignore"):
                    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
                # the last one of the block before decides on the sign
                before = poses[max(start - 1, 0) : start, :, 3:]
                part[..., 3:] = quat_sign_continuous(np.concatenate([before, quats]))[len(before) :]
            self._tidy = True
        return poses

    def drop_after(self, step: int) -> None:
        """Drop the updates after the latest one at or before ``step``."""
        # the latest one before a block is its first pose, and stays
        keep = bisect_right(self.steps, step)
        width = len(self._values) // max(len(self.steps), 1)
        del self.steps[keep:]
        del self._values[keep * width :]


@dataclass(eq=False)
class Life:
    """Lifetime of an instance, from its creation to its deletion."""

    key: int
    creation: Creation
    start: int
    """First keyframe in which the instance exists."""
    end: int = -1
    """First keyframe in which it no longer exists; -1 if it exists to the end."""
    semantic_id: int = 0
    updates: Updates = field(default_factory=Updates)
    track: int = -1
    """Number of the instance's track among those of moving instances; -1 if it never moves."""

    @property
    def placed(self) -> bool:
        """Return whether the instance was created with a pose; without one, the player leaves it at the origin."""
        return bool(self.updates.steps) and self.updates.steps[0] == self.start

    def first_pose(self) -> NDArray[np.float32]:
        """Return the first pose (pose7) of the instance [7]."""
        return self.updates.poses()[0, 0].copy() if self.placed else IDENTITY_POSE.astype(np.float32)

    def moves(self, steps: int) -> bool:
        """Return whether the instance has more than one pose in ``steps`` keyframes; absence counts as a pose."""
        lasts = self.start == 0 and self.end in (-1, steps)
        return not lasts or bool(np.any(self.updates.poses() != self.first_pose()))


@dataclass(eq=False)
class Loaded:
    """Load entries of one path."""

    last: Load
    always_painted: bool = True
    """True if every instance of the asset overrides the material."""

    def add(self, load: Load) -> None:
        """Add a load entry."""
        phong = load.overridePhongMaterial
        self.last = load
        self.always_painted &= phong is not None and phong.diffuse is not None


@dataclass(eq=False)
class Rig:
    """Poses of a rig's bones."""

    bone_names: list[str] = field(default_factory=list)
    bones: int = 0
    updates: Updates = field(default_factory=Updates)


@dataclass(eq=False)
class Fold:
    """Content of all keyframes, by instance."""

    steps: int = 0
    lives: list[Life] = field(default_factory=list)
    movers: list[Life] = field(default_factory=list)
    """Instances that have tracks, in their order."""
    loads: dict[str, Loaded] = field(default_factory=dict)
    """Loaded assets by path, without the suffix after its question mark."""
    rigs: dict[int, Rig] = field(default_factory=dict)
    user: dict[str, Updates] = field(default_factory=dict)
    lights: list[tuple[int, list[dict[str, Any]]]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    """Counts of irregularities, by description."""

    def note(self, what: str) -> None:
        """Count an irregularity."""
        self.counts[what] = self.counts.get(what, 0) + 1


def fold_keyframes(keyframes: Iterable[Keyframe], path: Path) -> Fold:
    """Apply the keyframes one after another, as Habitat's player does; ``path`` appears in error texts."""
    fold = Fold()
    live: dict[int, Life] = {}
    light_bytes = 0
    for step, keyframe in enumerate(keyframes):
        fold.steps = step + 1
        for load in keyframe.loads:
            fold.loads.setdefault(load.filepath.split("?", 1)[0], Loaded(load)).add(load)
        for rig in keyframe.rigCreations:
            fold.rigs.setdefault(rig.id, Rig()).bone_names = rig.boneNames
        _create_and_delete(fold, live, step, keyframe)
        for item in keyframe.metadata:
            if item.instanceKey in live and item.metadata.semanticId is not None:
                live[item.instanceKey].semantic_id = item.metadata.semanticId
        for item in keyframe.stateUpdates:
            life = live.get(item.instanceKey)
            # the player ignores them too
            if life is None:
                fold.note("pose updates of instances that do not exist")
                continue
            if item.state.semanticId is not None:
                life.semantic_id = item.state.semanticId
            life.updates.add(step, item.state.absTransform)
        for update in keyframe.rigUpdates:
            _pose_rig(fold.rigs.setdefault(update.id, Rig()), step, update.id, update.pose, path)
        for item in keyframe.userTransforms:
            fold.user.setdefault(item.name, Updates()).add(step, item.transform)
        lights = bytes(keyframe.lights)
        if keyframe.lightsChanged or lights:
            light_bytes += len(lights)
            # a damaged or strange file may change its lights in every keyframe
            if light_bytes > LIGHT_BYTES:
                fold.note("changes of lights are not kept: there are too many")
            else:
                fold.lights.append((step, _lights(lights, step, path)))
        check_count(step, MAX_STEPS, "keyframes", path)
        check_count(len(fold.loads), MAX_BODIES, "assets", path)
        check_count(len(fold.lives), MAX_BODIES, "instances", path)
    for life in fold.lives:
        # an instance that is there at times moves too: its absence is a pose of NaN
        if life.moves(fold.steps):
            life.track = len(fold.movers)
            fold.movers.append(life)
    bones = sum(rig.bones for rig in fold.rigs.values())
    _check_rotations(fold, path)
    check_size(fold.steps, max(len(fold.movers), len(fold.user), bones), path)
    return fold


def _check_rotations(fold: Fold, path: Path) -> None:
    """Raise a `FormatError` if a rotation is not a quaternion."""
    poses = [(f"stateUpdates, instance {life.key}", life.updates, 1) for life in fold.lives]
    poses += [(f"userTransforms, {name!r}", updates, 1) for name, updates in fold.user.items()]
    poses += [(f"rigUpdates, rig {number}", rig.updates, rig.bones) for number, rig in sorted(fold.rigs.items())]
    for where, updates, bones in poses:
        # a quaternion of length 0 became NaN when it was normalised
        bad = np.isnan(updates.poses(bones)).any((1, 2))
        if bad.any():
            step = updates.steps[int(np.argmax(bad))]
            raise FormatError(
                f"Not a valid gfx-replay: the rotation is not a quaternion (length 0) at keyframe {step}, {where}: {path}",
                code="H3-HABITAT-066",
            )


def pose_columns(fold: Fold) -> dict[str, NDArray[Any]]:
    """Return the columns of all poses (pose7), NaN where a thing is absent. Consumes the updates of instances.

    They are ``object_pose`` [T, M, 7] of the instances that move, ``user.<name>`` [T, 7] of each user transform and
    ``rig.<id>`` [T, bones, 7] of each rig.
    """
    columns: dict[str, NDArray[Any]] = {"object_pose": _tracks(fold)} if fold.movers else {}
    for name, updates in fold.user.items():
        rows = np.full((fold.steps, 7), np.nan, np.float32)
        # transforms do not persist: only keyframes that list one have it
        rows[np.array(updates.steps)] = updates.poses()[:, 0]
        columns[f"user.{name}"] = rows
    ends = {life.creation.rigId: life.end for life in fold.lives if life.creation.rigId >= 0}
    for number, rig in sorted(fold.rigs.items()):
        if rig.updates.steps and rig.bones:
            end = ends.get(number, -1)
            columns[f"rig.{number}"] = _filled(rig.updates, 0, fold.steps, bones=rig.bones, end=end)
    return columns


def _tracks(fold: Fold) -> NDArray[np.float32]:
    """Return poses (pose7) [T, M, 7] of the instances that move. Consumes their updates.

    Works from the last keyframes to the first and frees what it has used: tracks and updates are never both in memory as
    a whole.
    """
    tracks = np.empty((fold.steps, len(fold.movers), 7), np.float32)
    for stop in range(fold.steps, 0, -_BLOCK):
        start = max(stop - _BLOCK, 0)
        for k, life in enumerate(fold.movers):
            tracks[start:stop, k] = _rows(life, start, stop)
            life.updates.drop_after(start)
    return tracks


def _rows(life: Life, start: int, stop: int) -> NDArray[np.float32]:
    """Return pose7 [stop - start, 7] of an instance."""
    rows = _filled(life.updates, start, stop, end=life.end)[:, 0]
    if not life.placed:
        # created without a pose, it is at the origin until it gets one
        until = life.updates.steps[0] if life.updates.steps else stop
        until = min(until, stop if life.end < 0 else life.end)
        rows[max(life.start - start, 0) : max(until - start, 0)] = IDENTITY_POSE
    return rows


def _filled(updates: Updates, start: int, stop: int, *, bones: int = 1, end: int = -1) -> NDArray[np.float32]:
    """Return the latest poses at the keyframes from ``start`` to ``stop``, pose7 [stop - start, bones, 7].

    They are NaN before the first update, and from the keyframe ``end`` on unless that is -1.
    """
    at = np.arange(start, stop, dtype=np.int32)
    latest = np.searchsorted(np.array(updates.steps, np.int32), at, side="right") - 1
    rows = np.full((len(at), bones, 7), np.nan, np.float32)
    # poses hold until the next update, or until the thing is deleted
    there = (latest >= 0) & ((end < 0) | (at < end))
    rows[there] = updates.poses(bones)[latest[there]]
    return rows


def _pose_rig(rig: Rig, step: int, number: int, pose: list[BonePose], path: Path) -> None:
    rig.bones = rig.bones or len(rig.bone_names) or len(pose)
    if len(pose) != rig.bones:
        raise FormatError(
            f"Not a valid gfx-replay: rig {number} has {rig.bones} bones, {len(pose)} came at keyframe {step}, "
            f"rigUpdates: {path}",
            code="H3-HABITAT-056",
        )
    rig.updates.add_bones(step, pose)


def _lights(text: bytes, step: int, path: Path) -> list[dict[str, Any]]:
    try:
        return decode_json(text or b"[]", list[dict[str, Any]])
    except msgspec.DecodeError as fault:
        raise FormatError(
            f"Not a valid gfx-replay: {fault}, keyframe {step}, lights: {path}", code="H3-HABITAT-057"
        ) from None


def _create_and_delete(fold: Fold, live: dict[int, Life], step: int, keyframe: Keyframe) -> None:
    """Apply one keyframe's deletions and creations.

    The player creates first and then deletes. A key that existed before and is in both lists is another instance that
    re-uses the key: the old one ends, the new one stays. A key that did not exist before cancels itself out.
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
