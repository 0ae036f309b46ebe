"""Habitat's gfx-replay files as recordings."""

from __future__ import annotations

import hashlib
import re
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import FormatError, InputError, SceneError
from h3data.geometry import IDENTITY_POSE, quat_sign_continuous
from h3data.interop.assets import EMPTY_URI, clean_path
from h3data.interop.gfx_agents import add_agents
from h3data.interop.gfx_keyframes import Fold, Life, Load, Transform, fold_keyframes, read_keyframes
from h3data.interop.meshes import frame_rotation
from h3data.interop.primitives import is_primitive
from h3data.recording.records import STEP_NS, AssetRef, Body, Episode, Recording
from h3data.srgb import linear_to_bytes

_DIFFUSE = re.compile(r"_dif_(\d{1,20})")
_SCENE_FOLDER = re.compile(r"(^|/)(stages?|scenes?|navmesh)/")
_UNTELLING_STEMS = {"textured", "mesh", "model", "visual", "collider", "textured_simple"}
_UNTELLING_FOLDERS = {"google_16k", "visual", "visuals", "meshes", "mesh", "assets", "tsdf", "poisson"}


def read_gfx_replay(path: str | Path, *, fps: float | None = None) -> Recording:
    """The recording in a ``.gfx_replay.json`` (or ``.json.gz``) file of habitat-sim or its HITL tools.

    A gfx-replay is a visual log (spec/habitat.md 5.1): poses of the drawn nodes, asset names, nothing else. So:

    - One body per created instance. A body's pose is its node's world transform, the mesh frame after the asset's
      ``frame`` has been turned to +Y up. Bodies that were always there and never moved are static, the others have
      tracks.
    - The format has no time stamps: row k is keyframe k, at ``fps`` keyframes per second (default: the nominal 30).
    - User transforms become columns ``user.<name>`` [T, 7], pose7 in the world, NaN where absent. Those that are
      cameras keep Habitat's camera frame: x right, y up, looking along -z.
    - Bones become columns ``rig.<id>`` [T, bones, 7], pose7 in the world; ``episode.info["rigs"]`` names the bones and the
      body that they deform (`h3data.interop.skinned_meshes`).
    - Robots and people are recognised by their file names, see `h3data.interop.gfx_agents`.

    ``episode.info`` holds the lights, the rigs, how each agent's floor position was found, and ``warnings``.
    """
    path = Path(path)
    dt_ns = STEP_NS if fps is None else _step_ns(fps)
    data, keyframes = read_keyframes(path)
    fold = fold_keyframes(keyframes)
    assets, refs, notes = _assets(fold, path)
    poses = [_life_poses(life, path) for life in fold.lives]
    bodies, tracks = _bodies(fold, refs, poses)
    columns: dict[str, NDArray[Any]] = {"time_ns": np.arange(fold.steps, dtype=np.int64) * dt_ns}
    if tracks:
        columns["object_pose"] = np.stack(tracks, axis=1)
    columns |= _user_columns(fold, path) | _rig_columns(fold, path)
    agents, bodies, agent_columns, agent_info = add_agents(bodies, assets, columns.get("object_pose"), fold.steps)
    columns |= agent_columns
    warnings = (
        notes + [f"{count} {what}" for what, count in fold.counts.items()] + [w for a in agent_info for w in a.warnings]
    )
    stage = next((life.creation.filepath for life in fold.lives if _is_stage(life)), "")
    info: dict[str, Any] = {
        "source": {"format": "gfx_replay", "file": path.name, "sha256": hashlib.sha256(data).hexdigest()},
        "nominal_fps": 1e9 / dt_ns,
        "agents": [a.record for a in agent_info],
        "lights": fold.lights[0][1] if fold.lights else [],
        "warnings": warnings,
    }
    if len(fold.lights) > 1:
        info["light_changes"] = [{"step": step, "lights": lights} for step, lights in fold.lights]
    rigs = _rig_info(fold, bodies)
    if rigs:
        info["rigs"] = rigs
    name = path.name.removesuffix(".gz").removesuffix(".json").removesuffix(".gfx_replay")
    return Recording(
        episode=Episode(
            uid=str(uuid.uuid5(uuid.NAMESPACE_URL, "gfx_replay:" + info["source"]["sha256"])),
            episode_id=name or path.name,
            task="gfx_replay",
            scene=PurePosixPath(clean_path(stage)).stem if stage else "",
            dt_ns=dt_ns,
            created_by="habitat-sim gfx-replay",
            info=info,
        ),
        assets=tuple(assets),
        bodies=tuple(bodies),
        agents=tuple(agents),
        columns=columns,
    )


def _step_ns(fps: float) -> int:
    if not (np.isfinite(fps) and fps > 0):
        raise InputError(f"fps must be a positive number of keyframes per second. Got {fps}.")
    return STEP_NS if fps == 30 else round(1e9 / fps)


# --- assets -----------------------------------------------------------------------------------------------------------
def _assets(fold: Fold, path: Path) -> tuple[list[AssetRef], list[str], list[str]]:
    """Assets of the recording, the asset name of each life, and warnings."""
    by_path: dict[str, list[Load]] = {}
    for filepath, loads in fold.loads.items():
        by_path.setdefault(filepath.split("?", 1)[0], []).extend(loads)
    refs: dict[tuple[Any, ...], AssetRef] = {}
    used: set[str] = set()
    names, unloaded, hidden = [], set(), 0
    for life in fold.lives:
        plain = life.creation.filepath.split("?", 1)[0]
        if plain in ("", "invalid_filepath"):
            hidden += 1
            key: tuple[Any, ...] = (EMPTY_URI,)
            values: dict[str, Any] = {"uri": EMPTY_URI}
        else:
            loads = by_path.get(plain, [])
            if not loads and not is_primitive(plain):
                unloaded.add(plain)
            load = loads[-1] if loads else Load(filepath=plain)  # the last load of a path wins, as in the player
            color = _color(life.creation.filepath, loads)
            uri = f"primitive:{plain}" if is_primitive(plain) else clean_path(plain)
            values = {"uri": uri, "color": color, "units_m": load.virtualUnitToMeters,
                      "up": _plus_zero(load.frame.up), "front": _plus_zero(load.frame.front)}  # fmt: skip
            try:
                frame_rotation(load.frame.up, load.frame.front)
            except SceneError as fault:
                raise FormatError(f"Not a valid gfx-replay: asset {plain!r}: {fault} {path}") from None
            key = tuple(values.values())
        if key not in refs:
            refs[key] = AssetRef(name=_unique(_short_name(values["uri"]), used), **values)
        names.append(refs[key].name)
    notes = []
    if hidden:
        notes.append(
            f"{hidden} instances were recorded without a file (hidden while recording): they are drawn as nothing"
        )
    if unloaded:
        notes.append(f"{len(unloaded)} assets have no load entry, their frame is taken as +Y up: {sorted(unloaded)[0]}")
    return list(refs.values()), names, notes


def _color(filepath: str, loads: Sequence[Load]) -> tuple[int, int, int] | None:
    """sRGB override of an instance's material, or None.

    The suffix ``?phong_amb_.._dif_.._spec_..`` of the creation belongs to this instance (sRGB, one uint32 RGBA each).
    The ``overridePhongMaterial`` of ``loads`` (linear) is shared by the path, and counts only if no plain load
    exists.
    """
    _, _, suffix = filepath.partition("?")
    match = _DIFFUSE.search(suffix)
    if match:
        rgba = int(match.group(1)) & 0xFFFFFFFF
        return (rgba >> 24 & 255, rgba >> 16 & 255, rgba >> 8 & 255)
    overrides = [load.overridePhongMaterial for load in loads]
    if not overrides or any(o is None or o.diffuse is None for o in overrides):
        return None
    last = overrides[-1]
    assert last is not None
    assert last.diffuse is not None
    r, g, b = (int(v) for v in linear_to_bytes(last.diffuse[:3]))
    return (r, g, b)


def _plus_zero(axis: Sequence[float]) -> tuple[float, float, float]:
    """The same axis with -0.0 written as 0.0, so that equal frames compare and print equal."""
    x, y, z = (float(v) + 0.0 for v in axis)
    return (x, y, z)


def _short_name(uri: str) -> str:
    """A telling name for an asset: its file's stem, or the folder that names a YCB object."""
    if uri.startswith("primitive:"):
        return uri.removeprefix("primitive:").split("_", 1)[0]
    parts = PurePosixPath(uri)
    if parts.stem not in _UNTELLING_STEMS:
        return parts.stem
    return next((p for p in reversed(parts.parts[:-1]) if p not in _UNTELLING_FOLDERS), parts.stem)


def _unique(name: str, used: set[str]) -> str:
    candidate, number = name, 2
    while candidate in used:
        candidate, number = f"{name}~{number}", number + 1
    used.add(candidate)
    return candidate


def _is_stage(life: Life) -> bool:
    return life.creation.isStatic or _SCENE_FOLDER.search(life.creation.filepath) is not None


# --- bodies -----------------------------------------------------------------------------------------------------------
def _bodies(
    fold: Fold, refs: Sequence[str], poses: Sequence[NDArray[np.float64]]
) -> tuple[list[Body], list[NDArray[np.float32]]]:
    """One body per life and the track [T, 7] of each moving one."""
    used: set[str] = set()
    bodies, tracks = [], []
    for life, ref, pose in zip(fold.lives, refs, poses, strict=True):
        end = fold.steps if life.end < 0 else life.end
        moves = life.start > 0 or end < fold.steps or bool(np.any(pose != pose[0]))
        if moves:
            starts = [life.start] if not life.steps or life.steps[0] > life.start else []
            tracks.append(_filled(fold.steps, starts + life.steps, pose, end=end))
        bodies.append(
            Body(
                name=_unique(f"{ref}_{life.key}", used),
                asset=ref,
                pose=pose[0].astype(np.float32),
                scale=np.array(life.creation.scale, np.float32),
                semantic_id=life.semantic_id,
                moving=len(tracks) - 1 if moves else -1,
            )
        )
    return bodies, tracks


def _life_poses(life: Life, path: Path) -> NDArray[np.float64]:
    """pose7 of each update of an instance, shape [U, 7]; preceded by the identity if it was created without a pose."""
    poses = _pose7(life.transforms)
    bad = np.flatnonzero(_invalid(poses))
    if len(bad):
        raise FormatError(
            f"Not a valid gfx-replay: the rotation is not a quaternion (length 0) at keyframe {life.steps[bad[0]]}, "
            f"stateUpdates, instance {life.key}: {path}"
        )
    if not life.steps or life.steps[0] > life.start:  # the player leaves the node where it was made: at the origin
        poses = np.concatenate([IDENTITY_POSE[None], poses])
    return poses


def _pose7(transforms: Sequence[Transform]) -> NDArray[np.float64]:
    """pose7 [N, 7] of recorded transforms (w x y z), quaternions of unit length and sign-continuous."""
    flat = np.array([(*t.translation, *t.rotation) for t in transforms], np.float64).reshape(-1, 7)
    return _tidy(flat[:, [0, 1, 2, 4, 5, 6, 3]])


def _tidy(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same poses [N, ..., 7], quaternions of unit length (files round to 4 decimals) and sign-continuous on axis 0."""
    length = np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        poses[..., 3:] /= length
    poses[..., 3:] = quat_sign_continuous(poses[..., 3:])
    return poses


def _invalid(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which poses [N, ..., 7] hold something that is not finite, shape [N]."""
    return np.logical_not(np.isfinite(poses).all(tuple(range(1, poses.ndim))))


def _filled(
    steps: int, at: Sequence[int], values: NDArray[np.float64], *, end: int | None = None
) -> NDArray[np.float32]:
    """Rows [T, ...] that hold the latest of ``values`` [U, ...] written at steps ``at``; NaN before, and from ``end``."""
    rows = np.full((steps, *values.shape[1:]), np.nan, np.float32)
    latest = np.searchsorted(np.asarray(at), np.arange(steps), side="right") - 1
    present = latest >= 0
    present[steps if end is None else end :] = False
    rows[present] = values[latest[present]]
    return rows


# --- user transforms and rigs -----------------------------------------------------------------------------------------
def _user_columns(fold: Fold, path: Path) -> dict[str, NDArray[Any]]:
    columns: dict[str, NDArray[Any]] = {}
    for name, entries in fold.user.items():
        poses = _pose7([transform for _, transform in entries])
        if _invalid(poses).any():
            raise FormatError(f"Not a valid gfx-replay: user transform {name!r} has a rotation of length 0: {path}")
        rows = np.full((fold.steps, 7), np.nan, np.float32)
        rows[[step for step, _ in entries]] = poses  # not sticky: only the keyframes that have it
        columns[f"user.{name}"] = rows
    return columns


def _rig_columns(fold: Fold, path: Path) -> dict[str, NDArray[Any]]:
    ends = {life.creation.rigId: life.end for life in fold.lives if life.creation.rigId >= 0}
    columns: dict[str, NDArray[Any]] = {}
    for rig, updates in sorted(fold.rig_poses.items()):
        bones = len(fold.bone_names.get(rig) or updates[0][1])
        wrong = next(((step, len(pose)) for step, pose in updates if len(pose) != bones), None)
        if wrong is not None:
            raise FormatError(
                f"Not a valid gfx-replay: rig {rig} has {bones} bones, {wrong[1]} came at keyframe {wrong[0]}, "
                f"rigUpdates: {path}"
            )
        flat: ArrayLike = [[(*bone.t, *bone.r[1:], bone.r[0]) for bone in pose] for _, pose in updates]
        poses = _tidy(np.array(flat, np.float64).reshape(len(updates), bones, 7))
        if _invalid(poses).any():
            raise FormatError(f"Not a valid gfx-replay: rig {rig} has a bone rotation of length 0: {path}")
        end = ends.get(rig, -1)
        columns[f"rig.{rig}"] = _filled(fold.steps, [s for s, _ in updates], poses, end=None if end < 0 else end)
    return columns


def _rig_info(fold: Fold, bodies: Sequence[Body]) -> list[Mapping[str, Any]]:
    rigs = sorted(set(fold.bone_names) | set(fold.rig_poses))
    owner = {life.creation.rigId: body.name for life, body in zip(fold.lives, bodies, strict=True)}
    return [{"id": rig, "bones": fold.bone_names.get(rig, []), "body": owner.get(rig, "")} for rig in rigs]
