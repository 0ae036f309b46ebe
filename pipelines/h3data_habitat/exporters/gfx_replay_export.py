"""Export of recordings as Habitat's gfx-replay files (spec/habitat.md 5.1), with GLB files of bodies without a file.

The file contains only rendered data, without times, names, actions or joint positions. Keyframe k is row k. Empty lists
are left out, and poses are written when they change, as in habitat-sim.
"""

from __future__ import annotations

import gzip
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.files import part_file, size_text
from h3data.formats import Exported, ExportRequest
from h3data.geometry import Array
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import is_primitive
from h3data.recording.assets.handles import HANDLE
from h3data.recording.assets.library import EMPTY_URI
from h3data.recording.records import AssetRef, Recording
from h3data.replay import Replay
from h3data_exporters.glb_write import glb_bytes
from h3data_exporters.gltf_skin import skinned_glb_bytes
from h3data_exporters.posed_parts import PosedCamera, PosedPart, spans
from h3data_exporters.posing import missing_note, posed_cameras, posed_parts
from h3data_habitat.exporters.lights import replay_lights
from h3data_habitat.gfx.agents import PERSON_ROOT_PREFIX

DECIMALS = 7
"""Number of decimals that are written, as in habitat-sim; single precision has no more."""
CAMERA_PREFIX = "sensor_"
"""Prefix that habitat-sim's replay viewer expects before a camera's name."""

_NO_FILE = "invalid_filepath"
_Item = dict[str, Any]


@dataclass(frozen=True)
class GfxReplayFiles:
    """Result of writing a gfx-replay."""

    path: Path
    assets: tuple[Path, ...]
    """GLB files, named in the replay relative to its own folder."""
    instances: int
    keyframes: int


@dataclass
class _Keyframes:
    """Everything that is new at each step, in the order of the format's members."""

    steps: int
    loads: list[_Item] = field(default_factory=list)
    rigs: list[_Item] = field(default_factory=list)
    lists: dict[str, dict[int, list[Any]]] = field(default_factory=lambda: defaultdict(lambda: defaultdict(list)))

    def add(self, member: str, step: int, item: Any) -> None:
        self.lists[member][step].append(item)

    def __iter__(self) -> Iterator[_Item]:
        order = ("creations", "metadata", "deletions", "stateUpdates", "rigUpdates", "userTransforms")
        lights = self.lists["lights"]
        for step in range(self.steps):
            keyframe: _Item = {"loads": self.loads} if step == 0 and self.loads else {}
            if step == 0 and self.rigs:
                keyframe["rigCreations"] = self.rigs
            keyframe |= {name: self.lists[name][step] for name in order if step in self.lists[name]}
            if step in lights:
                keyframe |= {"lightsChanged": True, "lights": lights[step]}
            yield keyframe


def write_gfx_replay(
    recording: Recording, parts: Sequence[PosedPart], path: str | Path, *, cameras: Sequence[PosedCamera] = ()
) -> GfxReplayFiles:
    """Write ``<name>.gfx_replay.json`` (or ``.json.gz``) and the folder ``<name>.assets`` with its GLB files.

    - Assets that are files keep their recorded paths, frames and units; primitives keep their names; meshes of the
      attached scene, of robots and of people become GLB files. Paths are relative to the replay's folder: start
      habitat-sim there.
    - A body that is absent at times is deleted and created again, each time as a new instance.
    - People rendered by a model are skinned: a rig of 55 bones; the instance has the pose of its root bone, as
      habitat-sim needs it. The user transform `PERSON_ROOT_PREFIX` and the rig's number give the person's position for
          h3data's importer.
    - Cameras become user transforms, ``sensor_<name>``; ``user.<name>`` columns keep their names.

    Poses are rounded to `DECIMALS`. ``parts`` and ``cameras`` come from `h3data_exporters.posing`.

    Raises:
        InputError: there is no row to write, or the name does not end in .json or .json.gz.
    """
    path = Path(path)
    if not path.name.endswith((".json", ".json.gz")):
        raise InputError(
            f"Expected a file that ends in .gfx_replay.json or .gfx_replay.json.gz, got: {path}", code="H3-EXPORT-009"
        )
    if not len(recording):
        raise InputError("A recording without steps has no keyframes to write.", code="H3-EXPORT-010")
    folder = assets_folder(path)
    files = _Assets(folder)
    keyframes = _Keyframes(len(recording))
    rigs = {rig["body"]: rig for rig in recording.episode.info.get("rigs", ())}
    refs = {ref.name: ref for ref in recording.assets}
    loaded: set[str] = set()
    key = 0
    for part in parts:
        ref = None if part.body is None else refs[part.body.asset]
        filepath, load = files.file_of(part, ref, recording)
        if load is not None and load["filepath"] not in loaded:
            loaded.add(load["filepath"])
            keyframes.loads.append(load)
        rig = _rig_of(part, rigs, recording, len(keyframes.rigs))
        if rig is not None:
            keyframes.rigs.append({"id": rig.number, "boneNames": list(rig.names)})
            if part.body is None:  # the pose of the person, which the instance of a rig has no place for
                _add_user_transform(keyframes, f"{PERSON_ROOT_PREFIX}{rig.number}", np.asarray(part.poses))
                part = replace(part, poses=_root_bone(part, rig))
        static = ref is not None and bool(recording.episode.scene) and Path(filepath).stem == recording.episode.scene
        key = _add_part(keyframes, part, filepath, key, rig=rig, static=static)
    # after the parts, whose people have user transforms too
    for name, poses in _user_transforms(recording, cameras):
        _add_user_transform(keyframes, name, poses)
    for step, lights in _lights(recording):
        keyframes.lists["lights"][step] = lights
    files.write()
    _write(path, keyframes)
    return GfxReplayFiles(path=path, assets=tuple(files.contents), instances=key, keyframes=len(recording))


def export_gfx_replay(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Export one recording for ``h3data export --to gfx-replay``."""
    (recording,) = recordings
    folder = assets_folder(request.out)
    has_own_meshes = any(ref.uri.startswith("scene:") for ref in recording.assets) or any(
        agent.model for agent in recording.agents
    )
    if has_own_meshes and not request.force and folder.is_dir() and any(folder.iterdir()):
        raise InputError(
            f"The folder for assets is not empty. Use force=True to overwrite it, or another name: {folder}",
            code="H3-EXPORT-011",
        )
    replay = Replay(recording, assets=request.assets, people=request.people, detail=request.person_detail == "full")
    files = write_gfx_replay(recording, posed_parts(replay), request.out, cameras=posed_cameras(replay))
    size = files.path.stat().st_size
    text = f"{files.path}: {files.keyframes} keyframes, {files.instances} instances, {size_text(size)}"
    if files.assets:
        text += f"\n{folder}: {len(files.assets)} GLB files. Start habitat-sim in the folder of both."
    if files.path.suffix == ".gz":
        text += "\nhabitat-sim's read_keyframes_from_file does not read .json.gz. Hint: unpack it there, or export to .json."
    missing = sorted(replay.missing)
    data = {
        "keyframes": files.keyframes,
        "instances": files.instances,
        "bytes": size,
        "assets": len(files.assets),
        "missing": missing,
    }
    return Exported(text=text + missing_note(missing, "keep their recorded names"), data=data)


def assets_folder(path: Path) -> Path:
    """Return the folder of the GLB files of the replay ``path``."""
    name = path.name
    for suffix in (".gz", ".json", ".gfx_replay"):
        name = name.removesuffix(suffix)
    return path.with_name(f"{name}.assets")


def _write(path: Path, keyframes: _Keyframes) -> None:
    with part_file(path) as part, part.open("wb") as raw:
        # no name and no time of day inside: equal recordings have equal files
        stream = gzip.GzipFile("", "wb", 6, raw, mtime=0) if path.suffix == ".gz" else raw
        stream.write(b'{"keyframes":[')
        # one by one: the text of a long recording may be larger than the memory
        for number, keyframe in enumerate(keyframes):
            stream.write((b",\n" if number else b"") + msgspec.json.encode(keyframe))
        stream.write(b"]}")
        if stream is not raw:
            stream.close()


# --- instances --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Rig:
    number: int
    names: tuple[str, ...]
    poses: Array
    """Poses of the bones, pose7 [T, B, 7]."""


def _rig_of(part: PosedPart, rigs: Mapping[str, Any], recording: Recording, number: int) -> _Rig | None:
    if part.body is None:
        skeleton = part.skeleton
        return None if skeleton is None else _Rig(number, skeleton.names, skeleton.poses)
    rig = rigs.get(part.body.name)
    column = None if rig is None else recording.columns.get(f"rig.{rig['id']}")
    if rig is None or column is None:
        return None
    names = tuple(rig["bones"]) or tuple(f"bone_{k}" for k in range(column.shape[1]))
    return _Rig(number, names, column)


def _root_bone(part: PosedPart, rig: _Rig) -> Array:
    """Return pose7 [T, 7] of the bone that habitat-sim takes out of all others before it places the instance.

    It multiplies every bone by the inverse of the first one that it finds in the nodes of the file, depth first
    (`Drawable::buildSkinJointTransforms`, `ResourceManager::mapSkinnedModelToRig`), so the instance has to stand where that
    bone is: at the pelvis, tilt included. `skinned_glb_bytes` writes the joint without a parent first.
    """
    assert part.skeleton is not None
    return np.asarray(rig.poses)[:, part.skeleton.parents.index(-1)]


def _add_part(
    keyframes: _Keyframes, part: PosedPart, filepath: str, key: int, *, rig: _Rig | None, static: bool
) -> int:
    """Add the instances of a part, one for each time that it was present, and return the next free key."""
    poses = np.broadcast_to(part.poses, (keyframes.steps, 7)) if len(part.poses) == 1 else part.poses
    # compared as they are written: noise below the last decimal makes no update
    rounded, changed = _rounded(poses)
    for start, end in spans(np.asarray(np.isfinite(poses).all(1))):
        creation = {
            "filepath": filepath,
            "scale": np.asarray(part.scale, np.float64).tolist(),
            "isStatic": static,
            "isRGBD": True,
            "isSemantic": True,
            "isTextureSemantic": False,
            "lightSetupKey": "",
            "rigId": -1 if rig is None else rig.number,
        }
        keyframes.add("creations", start, {"instanceKey": key, "creation": creation})
        # parts of agents have no object id of their own
        metadata = {"objectId": -1 if part.body is None else key, "semanticId": int(part.semantic_id)}
        keyframes.add("metadata", start, {"instanceKey": key, "metadata": metadata})
        for step in (start, *(start + 1 + np.flatnonzero(changed[start + 1 : end])).tolist()):
            keyframes.add("stateUpdates", step, {"instanceKey": key, "state": {"absTransform": rounded(step)}})
        if end < keyframes.steps:
            keyframes.add("deletions", end, key)
        key += 1
    if rig is not None:
        _add_rig(keyframes, rig)
    return key


def _add_rig(keyframes: _Keyframes, rig: _Rig) -> None:
    # -0.0 becomes 0.0, which compares equal but is written differently
    poses = np.round(np.asarray(rig.poses, np.float64), DECIMALS) + 0.0
    changed = (poses[1:] != poses[:-1]).any((1, 2))
    there = np.isfinite(poses).all((1, 2))
    for step in np.flatnonzero(there & np.concatenate([[True], changed])).tolist():
        pose = [{"t": row[:3], "r": [row[6], *row[3:6]]} for row in poses[step].tolist()]
        keyframes.add("rigUpdates", step, {"id": rig.number, "pose": pose})


def _rounded(poses: Array) -> tuple[Any, NDArray[np.bool_]]:
    """Return a function from a step to its transform as it is written, and whether that differs from the step before."""
    values = np.round(np.asarray(poses, np.float64), DECIMALS) + 0.0
    changed = np.concatenate([[True], (values[1:] != values[:-1]).any(1)])

    def transform(step: int) -> _Item:
        x, y, z, qx, qy, qz, qw = values[step].tolist()
        return {"translation": [x, y, z], "rotation": [qw, qx, qy, qz]}

    return transform, changed


def _user_transforms(recording: Recording, cameras: Sequence[PosedCamera]) -> Iterator[tuple[str, Array]]:
    for name, column in recording.columns.items():
        if name.startswith("user.") and column.shape[1:] == (7,):
            yield name.removeprefix("user."), column
    for camera in cameras:
        if not camera.name.startswith("user."):
            yield CAMERA_PREFIX + camera.name, camera.poses


def _add_user_transform(keyframes: _Keyframes, name: str, poses: Array) -> None:
    poses = np.broadcast_to(poses, (keyframes.steps, 7)) if len(poses) == 1 else poses
    rounded, _ = _rounded(poses)
    for step in np.flatnonzero(np.isfinite(poses).all(1)).tolist():  # not sticky: every keyframe has its own
        keyframes.add("userTransforms", step, {"name": name, "transform": rounded(step)})


def _lights(recording: Recording) -> Iterator[tuple[int, list[Any]]]:
    info = recording.episode.info
    if "light_changes" in info:
        yield from ((int(change["step"]), change["lights"]) for change in info["light_changes"])
    elif info.get("lights"):
        yield 0, info["lights"]
    elif (
        recording.episode.task != "gfx_replay"
    ):  # one of ours: without lights, habitat-sim's four leave rooms half dark
        yield 0, replay_lights()


# --- assets -----------------------------------------------------------------------------------------------------------
@dataclass
class _Assets:
    """Names of files in the replay, and the GLB files to write."""

    folder: Path
    contents: dict[Path, bytes] = field(default_factory=dict)
    _known: dict[int, tuple[Mesh, str]] = field(default_factory=dict)
    """Assets by the id of their mesh, which is stored so that its id remains unique."""

    def file_of(self, part: PosedPart, ref: AssetRef | None, recording: Recording) -> tuple[str, _Item | None]:
        """Return the path under which an instance is created and the load entry of its file, if it has one."""
        if ref is None or ref.uri.startswith(("scene:", HANDLE)):
            if not len(part.mesh.faces):
                return _NO_FILE, None
            path = self._own(part, recording)
            return path, _load(path, AssetRef(name="", uri=path))
        # an instance that shows nothing has no load entry either
        if ref.uri == EMPTY_URI:
            return _NO_FILE, None
        path = ref.uri.removeprefix("primitive:")
        path = "cubeSolid" if path == "box" else path
        if ref.uri.startswith("primitive:") and not is_primitive(path):
            return _NO_FILE, None
        # the colour of one instance travels in its path, since the load entry is shared by all
        suffix = "" if ref.color is None else _phong(ref.color)
        return path + suffix, _load(path, ref)

    def _own(self, part: PosedPart, recording: Recording) -> str:
        if id(part.mesh) not in self._known:
            file = self._free_name(_place(part, recording))
            if part.skeleton is None:
                data = glb_bytes([part.mesh])
            else:
                data = skinned_glb_bytes(part.mesh, part.skeleton)
            self.contents[file] = data
            self._known[id(part.mesh)] = (part.mesh, file.relative_to(self.folder.parent).as_posix())
        return self._known[id(part.mesh)][1]

    def _free_name(self, place: str) -> Path:
        candidate, number = self.folder / f"{place}.glb", 2
        while candidate in self.contents:
            candidate, number = self.folder / f"{place}_{number}.glb", number + 1
        return candidate

    def write(self) -> None:
        for file, data in self.contents.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            with part_file(file) as part:
                part.write_bytes(data)


def _place(part: PosedPart, recording: Recording) -> str:
    """Return the path of a GLB file below the assets: the names by which readers know robots and people."""
    if part.body is not None:
        return "objects/" + _plain(part.body.asset)
    model = _plain(recording.agents[part.agent].model.partition("/")[2])
    if part.skeleton is not None:
        return f"humanoids/{model}/{model}"
    return f"robots/{model}/" + _plain(part.name.partition("/")[2])


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "mesh"


def _load(path: str, ref: AssetRef) -> _Item:
    return {
        "type": 1,
        "filepath": path,
        "frame": {"up": ref.up, "front": ref.front, "origin": (0.0, 0.0, 0.0)},
        "virtualUnitToMeters": ref.units_m,
        "forceFlatShading": False,
        "splitInstanceMesh": True,
        "shaderTypeToUse": "material",
        "hasSemanticTextures": False,
    }


def _phong(color: tuple[int, int, int]) -> str:
    """Return the material of an instance as habitat-sim appends it to the path: sRGB, one RGBA number each."""
    r, g, b = color
    value = r << 24 | g << 16 | b << 8 | 255
    return f"?phong_amb_{value}_dif_{value}_spec_{value}"
