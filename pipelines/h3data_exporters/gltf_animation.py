"""Export of recordings as glTF 2.0 animations: one GLB of the moving scene, for three.js, Blender and others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.skinning import Influences
from h3data.errors import InputError
from h3data.files import part_file, size_text
from h3data.formats import Exported, ExportRequest
from h3data.geometry import Array, quat_sign_continuous
from h3data.mesh.glb import FLOAT32, GlbChunk, gltf_document, pack_glb
from h3data.mesh.mesh import Mesh
from h3data.recording.records import Recording
from h3data.replay import Replay
from h3data_exporters.glb_write import mesh_lists
from h3data_exporters.gltf_skin import Node, add_joints, local_poses, skin_record, trs
from h3data_exporters.posed_parts import PosedCamera, PosedPart
from h3data_exporters.posing import drawn_note, posed_cameras, posed_parts


@dataclass(frozen=True)
class GltfAnimationFile:
    """Result of writing a glTF animation."""

    path: Path
    nodes: int
    meshes: int
    joints: int
    channels: int
    seconds: float


def write_gltf_animation(
    recording: Recording, parts: Sequence[PosedPart], path: str | Path, *, cameras: Sequence[PosedCamera] = ()
) -> GltfAnimationFile:
    """Write a ``.glb`` file with one animation, whose key frames are the recorded steps from time 0 on.

    - Nodes have the names of the objects; those of an agent are below a node with its name. The world is +Y up, in
      metres.
    - Robots are their links, each moving in the world. People are skinned, their joints a tree of nodes.
    - Absent objects have scale 0, because glTF has no other method to hide them.
    - Cameras are glTF cameras; one that is absent at times stays where it was.

    The ``extras`` of the file have the uid, task and scene of the episode. Those of a node have its semantic id, and
    whether its file was missing (it is then a placeholder). ``parts`` and ``cameras`` come from
    `h3data_exporters.posing`.

    Raises:
        InputError: there is no row to write, or the name does not end in .glb.
    """
    path = Path(path)
    if path.suffix != ".glb":
        raise InputError(f"Expected a file that ends in .glb, got: {path}", code="H3-EXPORT-012")
    if not len(recording):
        raise InputError("A recording without steps has nothing to animate.", code="H3-EXPORT-013")
    times = recording.columns["time_ns"]
    # differences of whole nanoseconds first: float32 is too coarse for times since 1970
    writer = _Writer(((times - times[0]) * 1e-9).astype("<f4"))
    groups = {index: writer.group(agent.name) for index, agent in enumerate(recording.agents)}
    for part in parts:
        writer.add_part(part, groups.get(part.agent))
    for camera in cameras:
        writer.add_camera(camera)
    episode = recording.episode
    extras = {"uid": episode.uid, "episode_id": episode.episode_id, "task": episode.task, "scene": episode.scene}
    with part_file(path) as part:
        part.write_bytes(writer.glb(extras))
    return GltfAnimationFile(
        path=path,
        nodes=len(writer.nodes),
        meshes=len(writer.meshes),
        channels=len(writer.channels),
        joints=sum(len(skin["joints"]) for skin in writer.skins),
        seconds=float(writer.times[-1]),
    )


def export_gltf(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Export one recording for ``h3data export --to gltf``."""
    (recording,) = recordings
    replay = Replay(
        recording,
        assets=request.assets,
        people=request.people,
        detail=request.person_detail == "full",
        stand_ins=request.stand_ins,
    )
    cameras, missing = posed_cameras(replay), sorted(replay.missing)
    file = write_gltf_animation(replay.recording, posed_parts(replay), request.out, cameras=cameras)
    size = file.path.stat().st_size
    text = (
        f"{file.path}: {file.seconds:.1f} s, {file.nodes} nodes, {file.meshes} meshes, {file.joints} joints, "
        f"{len(cameras)} cameras, {size_text(size)}"
    )
    data = {
        "seconds": file.seconds,
        "nodes": file.nodes,
        "meshes": file.meshes,
        "joints": file.joints,
        "channels": file.channels,
        "cameras": len(cameras),
        "bytes": size,
        "missing": missing,
    }
    return Exported(text=text + drawn_note(missing, stand_ins=request.stand_ins), data=data)


@dataclass
class _Writer:
    """The lists of a glTF document while they grow."""

    times: NDArray[np.float32]
    """Seconds, shape [T]."""
    chunk: GlbChunk = field(default_factory=GlbChunk)
    nodes: list[Node] = field(default_factory=list)
    roots: list[int] = field(default_factory=list)
    meshes: list[Mesh] = field(default_factory=list)
    influences: dict[int, Influences] = field(default_factory=dict)
    skins: list[dict[str, Any]] = field(default_factory=list)
    cameras: list[dict[str, Any]] = field(default_factory=list)
    samplers: list[dict[str, Any]] = field(default_factory=list)
    channels: list[dict[str, Any]] = field(default_factory=list)
    _slots: dict[tuple[int, bool], int] = field(default_factory=dict)
    _time: int = -1

    def group(self, name: str) -> int:
        self.nodes.append({"name": name})
        self.roots.append(len(self.nodes) - 1)
        return len(self.nodes) - 1

    def _hang(self, node: int, group: int | None) -> None:
        if group is None:
            self.roots.append(node)
        else:
            self.nodes[group].setdefault("children", []).append(node)

    def _mesh(self, part: PosedPart) -> int:
        # bodies that share a mesh share it in the file; one that is skinned has joints besides
        key = (id(part.mesh), part.skeleton is not None)
        if key not in self._slots:
            self._slots[key] = len(self.meshes)
            self.meshes.append(part.mesh)
            if part.skeleton is not None:
                self.influences[self._slots[key]] = part.skeleton.influences
        return self._slots[key]

    # --- things -------------------------------------------------------------------------------------------------------
    def add_part(self, part: PosedPart, group: int | None) -> None:
        """Add a node for a part and for what moves it."""
        if part.skeleton is not None:
            self._add_skinned(part, group)
            return
        poses, there = _held(part.poses)
        node: Node = {"name": part.name, **trs(poses[0], part.scale), "extras": _extras(part)}
        if len(part.mesh.faces):
            node["mesh"] = self._mesh(part)
        self.nodes.append(node)
        self._hang(len(self.nodes) - 1, group)
        self._animate(len(self.nodes) - 1, poses)
        self._hide(len(self.nodes) - 1, there, part.scale)

    def _add_skinned(self, part: PosedPart, group: int | None) -> None:
        """Add the mesh at the top of the file, as skinned meshes should be, because its joints alone place it."""
        skeleton = part.skeleton
        assert skeleton is not None
        poses, there = _held(skeleton.poses)
        local = local_poses(poses, skeleton.parents)
        # viewers interpolate between keys, and q and -q are far apart
        local[..., 3:] = quat_sign_continuous(local[..., 3:])
        self.nodes.append(
            {"name": part.name, "mesh": self._mesh(part), "skin": len(self.skins), "extras": _extras(part)}
        )
        self.roots.append(len(self.nodes) - 1)
        first = len(self.nodes)
        size = np.full(3, skeleton.scale)
        for root in add_joints(self.nodes, skeleton, local[0]):
            self._hang(root, group)
            if skeleton.scale != 1:
                self.nodes[root]["scale"] = size.tolist()
            self._hide(root, there, size)
        for joint in range(len(skeleton.names)):
            self._animate(first + joint, local[:, joint])
        self.skins.append({"name": part.name, **skin_record(self.chunk, skeleton, first=first)})

    def add_camera(self, camera: PosedCamera) -> None:
        """Add a camera and the node that carries it."""
        # glTF asks for a near plane, which cameras of recordings may have at 0
        lens = {"yfov": camera.vfov_rad, "aspectRatio": camera.aspect, "znear": max(camera.near_m, 0.01)}
        self.cameras.append({"name": camera.name, "type": "perspective", "perspective": lens})
        poses, _ = _held(camera.poses)
        self.nodes.append({"name": camera.name, "camera": len(self.cameras) - 1, **trs(poses[0])})
        self.roots.append(len(self.nodes) - 1)
        self._animate(len(self.nodes) - 1, poses)

    # --- animation ----------------------------------------------------------------------------------------------------
    def _animate(self, node: int, poses: Array) -> None:
        for target, values, kind in (("translation", poses[:, :3], "VEC3"), ("rotation", poses[:, 3:], "VEC4")):
            # what changes by less [m, or quaternion component] keeps the pose of its node
            if len(values) > 1 and float(np.ptp(values, axis=0).max()) > 1e-7:
                self._channel(node, target, values, kind, "LINEAR")

    def _hide(self, node: int, there: NDArray[np.bool_], scale: Array) -> None:
        if len(there) == len(self.times) and not there.all():
            # in steps: between two keys a scale would grow
            self._channel(node, "scale", there[:, None] * scale, "VEC3", "STEP")
        elif not there.all():
            self.nodes[node]["scale"] = [0.0, 0.0, 0.0]

    def _channel(self, node: int, target: str, values: NDArray[Any], kind: str, interpolation: str) -> None:
        # all channels share one array of times
        if self._time < 0:
            limits: dict[str, Any] = {"min": [float(self.times[0])], "max": [float(self.times[-1])]}
            self._time = self.chunk.array(self.times, "SCALAR", FLOAT32, **limits)
        output = self.chunk.array(np.ascontiguousarray(values, "<f4"), kind, FLOAT32)
        self.channels.append({"sampler": len(self.samplers), "target": {"node": node, "path": target}})
        self.samplers.append({"input": self._time, "output": output, "interpolation": interpolation})

    # --- the file -----------------------------------------------------------------------------------------------------
    def glb(self, extras: dict[str, Any]) -> bytes:
        """Return the bytes of the file."""
        meshes = mesh_lists(self.chunk, self.meshes, self.influences) if self.meshes else {}
        animation = {"name": "recording", "channels": self.channels, "samplers": self.samplers}
        members = {
            "nodes": self.nodes,
            "skins": self.skins,
            "cameras": self.cameras,
            "animations": [animation] if self.channels else [],
            **meshes,
            **(self.chunk.lists() if self.chunk.size else {}),
        }
        # glTF does not allow empty lists
        members = {name: value for name, value in members.items() if value != []}
        shown = {"nodes": self.roots} if self.roots else {}
        return pack_glb(gltf_document(shown, about=extras, **members), self.chunk)


def _held(poses: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return poses [T, ..., 7] with gaps filled, and which steps [T] had no gap.

    An absent pose is replaced by the last one before it; at the beginning, by the first one after it.
    """
    there: NDArray[np.bool_] = np.asarray(np.isfinite(poses).reshape(len(poses), -1).all(1))
    if not there.any():
        still = np.zeros_like(poses)
        still[..., 6] = 1
        return still, there
    latest = np.maximum.accumulate(np.where(there, np.arange(len(poses)), -1))
    held = poses[np.where(latest < 0, int(np.argmax(there)), latest)].copy()
    held[..., 3:] /= np.linalg.norm(held[..., 3:], axis=-1, keepdims=True)
    held[..., 3:] = quat_sign_continuous(held[..., 3:])
    return held, there


def _extras(part: PosedPart) -> dict[str, Any]:
    extras: dict[str, Any] = {"semantic_id": int(part.semantic_id)}
    return {**extras, "placeholder": True} if part.placeholder else extras
