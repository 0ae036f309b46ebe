"""Reading of Habitat's gfx-replay files as recordings."""

from __future__ import annotations

import hashlib
import os
import re
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from h3data.errors import FormatError, InputError, SceneError
from h3data.formats import SourceFile
from h3data.mesh.loading import frame_rotation
from h3data.mesh.primitives import is_primitive
from h3data.recording.assets.folders import clean_path
from h3data.recording.assets.library import EMPTY_URI, OWN_FOLDER_ENDING
from h3data.recording.records import STEP_NS, AssetRef, Body, Episode, Recording
from h3data.srgb import linear_to_bytes
from h3data_habitat.gfx.agents import add_agents, person_roots
from h3data_habitat.gfx.fold import Fold, Life, Loaded, fold_keyframes, pose_columns
from h3data_habitat.gfx.keyframes import Load, Undecodable, explain, read_keyframes
from h3data_habitat.json_stream import ArrayFault

_DIFFUSE = re.compile(r"_dif_(\d{1,20})")
_SCENE_FOLDER = re.compile(r"(^|/)(stages?|scenes?|navmesh)/")
_GENERIC_STEMS = {"textured", "mesh", "model", "visual", "collider", "textured_simple"}
_GENERIC_FOLDERS = {"google_16k", "visual", "visuals", "meshes", "mesh", "assets", "tsdf", "poisson"}


def read_gfx_replay(path: str | os.PathLike[str], *, fps: float | None = None) -> Recording:
    """Read the recording in a ``.gfx_replay.json`` (or ``.json.gz``) file of habitat-sim or its HITL tools.

    A gfx-replay is a visual log (spec/habitat.md 5.1): poses of the rendered nodes, asset names, nothing else. So:

    - Each created instance becomes one body. A body's pose is its node's world transform, the mesh frame after the
      asset's ``frame`` has been rotated to +Y up. Bodies that always exist and never move are static, the others have
      tracks.
    - The format has no time stamps: row k is keyframe k, at ``fps`` keyframes per second (default: the nominal 30).
    - User transforms become columns ``user.<name>`` [T, 7], pose7 in the world, NaN where absent. Those that are
      cameras keep Habitat's camera frame: x right, y up, looking along -z.
    - Bones become columns ``rig.<id>`` [T, bones, 7], pose7 in the world; ``episode.info["rigs"]`` names the bones and the
      body that they deform (`h3data.recording.assets.skinned_meshes`).
    - Robots and people are recognised by their file names, see `h3data_habitat.gfx.agents`.

    ``episode.info`` holds the lights, the rigs, how each agent's floor position was found, and ``warnings``.

    Raises:
        FormatError: the file is something else, truncated or damaged.
    """
    file = SourceFile.of(path)
    path = file.path
    dt_ns = STEP_NS if fps is None else _step_ns(fps)
    digest = hashlib.sha256()
    try:
        fold = fold_keyframes(read_keyframes(file, digest.update), path)
    except (Undecodable, ArrayFault) as fault:
        raise explain(path, fault) from None
    # before the columns, which consume the poses
    assets, bodies, notes = _assets_and_bodies(fold, path)
    columns = {"time_ns": np.arange(fold.steps, dtype=np.int64) * dt_ns, **pose_columns(fold)}
    roots = person_roots(fold.lives, bodies, columns)
    agents, bodies, agent_columns, agent_info = add_agents(
        bodies, assets, columns.get("object_pose"), fold.steps, path, roots=roots
    )
    columns |= agent_columns
    warnings = (
        notes + [f"{count} {what}" for what, count in fold.counts.items()] + [w for a in agent_info for w in a.warnings]
    )
    stage = next((life.creation.filepath for life in fold.lives if _is_stage(life)), "")
    info: dict[str, Any] = {
        "source": {"format": "gfx_replay", "file": path.name, "sha256": digest.hexdigest()},
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
    own = path.with_name(name + OWN_FOLDER_ENDING)
    # only where the replay names files in it: any folder may have this name
    if own.is_dir() and any(ref.uri.startswith(f"{own.name}/") for ref in assets):
        info["source"]["assets"] = str(own.absolute())
    return Recording(
        episode=Episode(
            # of the contents: importing a file again gives the same episode
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
        raise InputError(f"fps must be a positive number of keyframes per second. Got {fps}.", code="H3-HABITAT-065")
    return STEP_NS if fps == 30 else round(1e9 / fps)


def _assets_and_bodies(fold: Fold, path: Path) -> tuple[list[AssetRef], list[Body], list[str]]:
    """Return the assets of the recording, one body for each life, and warnings."""
    refs: dict[tuple[Any, ...], AssetRef] = {}
    used: dict[str, int] = {}
    names, unloaded, hidden = [], set(), 0
    for life in fold.lives:
        plain = life.creation.filepath.split("?", 1)[0]
        if plain in ("", "invalid_filepath"):
            hidden += 1
            key: tuple[Any, ...] = (EMPTY_URI,)
            values: dict[str, Any] = {"uri": EMPTY_URI}
        else:
            # by path without its suffix, which is of the instance
            loaded = fold.loads.get(plain)
            if loaded is None and not is_primitive(plain):
                unloaded.add(plain)
            load = Load(filepath=plain) if loaded is None else loaded.last  # as the player does
            color = _color(life.creation.filepath, loaded)
            uri = f"primitive:{plain}" if is_primitive(plain) else clean_path(plain)
            values = {
                "uri": uri,
                "color": color,
                "units_m": load.virtualUnitToMeters,
                "up": _plus_zero(load.frame.up),
                "front": _plus_zero(load.frame.front),
            }
            try:
                frame_rotation(load.frame.up, load.frame.front)
            except SceneError as fault:
                raise FormatError(
                    f"Not a valid gfx-replay: asset {plain!r}: {fault} {path}", code="H3-HABITAT-067"
                ) from None
            key = tuple(values.values())
        if key not in refs:
            refs[key] = AssetRef(name=_unique(_short_name(values["uri"]), used), **values)
        names.append(refs[key].name)
    notes = []
    if hidden:
        notes.append(f"{hidden} instances were recorded without a file (hidden while recording): they are invisible")
    if unloaded:
        notes.append(f"{len(unloaded)} assets have no load entry, their frame is taken as +Y up: {sorted(unloaded)[0]}")
    taken: dict[str, int] = {}
    bodies = [
        Body(
            name=_unique(f"{name}_{life.key}", taken),
            asset=name,
            pose=life.first_pose(),
            scale=np.array(life.creation.scale, np.float32),
            semantic_id=life.semantic_id,
            moving=life.track,
        )
        for life, name in zip(fold.lives, names, strict=True)
    ]
    return list(refs.values()), bodies, notes


def _color(filepath: str, loaded: Loaded | None) -> tuple[int, int, int] | None:
    """Return sRGB override of an instance's material, or None.

    The suffix ``?phong_amb_.._dif_.._spec_..`` of the creation belongs to this instance (sRGB, one uint32 RGBA each).
    The ``overridePhongMaterial`` of the loads (linear) is shared by the path, and counts only if no plain load exists.
    """
    _, _, suffix = filepath.partition("?")
    match = _DIFFUSE.search(suffix)
    if match:
        rgba = int(match.group(1)) & 0xFFFFFFFF
        return (rgba >> 24 & 255, rgba >> 16 & 255, rgba >> 8 & 255)
    if loaded is None or not loaded.always_painted:
        return None
    phong = loaded.last.overridePhongMaterial
    assert phong is not None
    assert phong.diffuse is not None
    r, g, b = (int(v) for v in linear_to_bytes(phong.diffuse[:3]))
    return (r, g, b)


def _plus_zero(axis: Sequence[float]) -> tuple[float, float, float]:
    """Return the axis with -0.0 written as 0.0, so that equal frames compare and print equal."""
    x, y, z = (float(v) + 0.0 for v in axis)
    return (x, y, z)


def _short_name(uri: str) -> str:
    """Return a descriptive name of an asset: its file's stem, or the folder that names a YCB object."""
    if uri.startswith("primitive:"):
        return uri.removeprefix("primitive:").split("_", 1)[0]
    parts = PurePosixPath(uri)
    if parts.stem not in _GENERIC_STEMS:
        return parts.stem
    return next((p for p in reversed(parts.parts[:-1]) if p not in _GENERIC_FOLDERS), parts.stem)


def _unique(name: str, used: dict[str, int]) -> str:
    """Return the name, with the first free number appended if it is taken; ``used`` has the last number of each name."""
    # from the last number on: thousands of instances share a name, and counting from 1 takes their square
    candidate, number = name, used.get(name, 0)
    while candidate in used:
        number += 1
        candidate = f"{name}~{number + 1}"
    used[name] = number
    used.setdefault(candidate, 0)
    return candidate


def _is_stage(life: Life) -> bool:
    return life.creation.isStatic or _SCENE_FOLDER.search(life.creation.filepath) is not None


def _rig_info(fold: Fold, bodies: Sequence[Body]) -> list[Mapping[str, Any]]:
    owner = {life.creation.rigId: body.name for life, body in zip(fold.lives, bodies, strict=True)}
    return [
        {"id": number, "bones": rig.bone_names, "body": owner.get(number, "")}
        for number, rig in sorted(fold.rigs.items())
    ]
