"""People: a skinned mesh on the 55-joint skeleton, its walk, its collision capsules; read from one baked npz file.

Frames. The body frame has +Z forward, +Y up, +X left (SMPL-X). The agent root frame has x forward, y up, z right and lies
on the floor below the pelvis; the body frame is turned into it by R_y(+90 deg), which the clips' pelvis rotation contains.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.motion import Clip, ClipTable, clip_table, nearest_clip, sample_clips
from h3data.bodies.skeleton import JOINT_NAMES, PARENTS, forward_kinematics
from h3data.bodies.skinning import Skin, apply_skin, build_skin
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data.geometry import Array, normalized, pose_to_matrix, quat_to_matrix
from h3data.scene.records import Mesh

FILE_FORMAT = "h3data.humanoid/1"
VERTEX_UNIT_M = 1e-4
"""Vertices are stored in whole tenths of a millimetre (int16: within 3.2 m of the origin)."""
QUAT_UNIT = 1 / 32767
WEIGHT_UNIT = 1 / 255


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinnedMesh:
    """A rest mesh with its skin weights."""

    mesh: Mesh
    """Rest pose (arms in A-pose) in the body frame; colours and normals per vertex."""
    joints: NDArray[np.uint8]
    """Joints of the four weights, shape [V, 4]."""
    weights: NDArray[np.float32]
    """They sum to 1, shape [V, 4]."""
    regions: NDArray[np.uint8]
    """Index into `Humanoid.region_names` per vertex: skin, shirt, trousers, ... Shape [V]."""

    @cached_property
    def skin(self) -> Skin:
        """The sparse skinning operators, built at first use (20 ms for the full mesh)."""
        mesh = self.mesh
        assert mesh.normals is not None
        return build_skin(mesh.vertices, mesh.normals, self.joints, self.weights, len(JOINT_NAMES))


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyCapsule:
    """A collision capsule that moves with one joint."""

    name: str
    joint: int
    start: Array
    """In the joint frame, shape [3] [m]."""
    end: Array
    """In the joint frame, shape [3] [m]."""
    radius: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Humanoid:
    """A person that can be posed, drawn and bumped into. Immutable: share it freely."""

    name: str
    height_m: float
    """Stature [m], hair and soles not counted."""
    joint_names: tuple[str, ...] = JOINT_NAMES
    parents: tuple[int, ...] = PARENTS
    joint_offsets: Array
    """Each joint in its parent's frame, shape [55, 3] [m]; the pelvis' row is its height in the T-pose."""
    inverse_bind: Array
    """Body frame of the rest mesh to joint frames, shape [55, 4, 4]; holds the step from T-pose to A-pose."""
    full: SkinnedMesh
    lod: SkinnedMesh
    """About 3,000 vertices: the default for cameras that are not close (surface error below 5 mm)."""
    region_names: tuple[str, ...]
    capsules: tuple[BodyCapsule, ...]
    clips: tuple[Clip, ...]
    """The first one stands."""
    phenotype: Mapping[str, float] = field(default_factory=dict)
    """The shape parameters from which the body was baked."""

    @property
    def mesh(self) -> Mesh:
        """The full mesh in the rest pose, body frame."""
        return self.full.mesh

    @property
    def lod_mesh(self) -> Mesh:
        """The light mesh in the rest pose, body frame."""
        return self.lod.mesh

    @property
    def motion_names(self) -> tuple[str, ...]:
        """Names of the clips, in the order of motion ids."""
        return tuple(c.name for c in self.clips)

    @cached_property
    def _clip_table(self) -> ClipTable:
        return clip_table(self.clips)

    @cached_property
    def _capsule_arrays(self) -> tuple[NDArray[np.intp], Array, Array, Array]:
        joints = np.array([c.joint for c in self.capsules])
        start, end = np.array([c.start for c in self.capsules]), np.array([c.end for c in self.capsules])
        return joints, start, end, np.array([c.radius for c in self.capsules])

    def clip_for_speed(self, speed_mps: float) -> int:
        """Motion id of the clip that fits ``speed_mps``; 0 (standing) when there is hardly any."""
        return nearest_clip(self.clips, speed_mps)

    def clip_pose(self, motion_id: ArrayLike, phase: ArrayLike, blend: ArrayLike = 1.0) -> tuple[Array, Array]:
        """Local rotations [T, 55, 4] and pelvis places [T, 3] in the agent root frame.

        ``motion_id``, ``phase`` and ``blend`` [T] as in `h3data.bodies.motion.sample_clips`: blend 0 stands, 1 is the clip.
        """
        return sample_clips(self._clip_table, motion_id, phase, blend)

    def joint_matrices(self, base_pose: ArrayLike, quats: Array, pelvis: Array) -> Array:
        """World matrices of the joints, [T, 55, 4, 4], from agent roots [T, 7] and what `clip_pose` returned."""
        root = np.broadcast_to(np.eye(4), (len(quats), 4, 4)).copy()
        root[:, :3, :3] = quat_to_matrix(np.asarray(quats, np.float64)[:, 0])
        root[:, :3, 3] = pelvis
        world = pose_to_matrix(np.asarray(base_pose, np.float64)) @ root
        return forward_kinematics(np.asarray(quats, np.float64), world, self.joint_offsets)

    def joint_matrices_free(self, root_pose: ArrayLike, joint_quat: ArrayLike) -> Array:
        """World matrices [T, 55, 4, 4] of a free-form pose: pelvis frames [T, 7] in the world (body axes: +Z forward) and
        the local rotations of the other joints [T, 54, 4], SMPL-X order."""
        root, rest = np.asarray(root_pose, np.float64), np.asarray(joint_quat, np.float64)
        quats = np.concatenate([root[:, None, 3:], rest], axis=1)
        return forward_kinematics(quats, pose_to_matrix(root), self.joint_offsets)

    def skin(self, joint_matrices: Array, *, lod: bool = True) -> NDArray[np.float32]:
        """World vertices, float32 [T, V, 3], of joint frames [T, 55, 4, 4] (one sparse matrix product)."""
        part = self.lod if lod else self.full
        return apply_skin(part.skin.points, joint_matrices @ self.inverse_bind)

    def skin_normals(self, joint_matrices: Array, *, lod: bool = True) -> NDArray[np.float32]:
        """World shading normals, float32 [T, V, 3], unit length, for the vertices of `skin`."""
        part = self.lod if lod else self.full
        return normalized(apply_skin(part.skin.normals, joint_matrices @ self.inverse_bind)).astype(np.float32)

    def capsules_world(self, joint_matrices: Array) -> tuple[Array, Array, Array]:
        """Segment starts [T, C, 3], ends [T, C, 3] and radii [C] [m] of the collision capsules."""
        joints, start, end, radius = self._capsule_arrays
        frames = joint_matrices[:, joints]
        rotation, origin = frames[..., :3, :3], frames[..., :3, 3]
        return (rotation @ start[..., None])[..., 0] + origin, (rotation @ end[..., None])[..., 0] + origin, radius

    def __repr__(self) -> str:
        return (
            f"Humanoid({self.name!r}, {self.height_m:.2f} m, {self.mesh}, LOD {self.lod_mesh}, "
            f"{len(self.capsules)} capsules, clips {', '.join(self.motion_names)})"
        )


@lru_cache(maxsize=32)
def load_humanoid(name: str | Path) -> Humanoid:
    """A built-in body by name (``female_0``), or one from a file that ends in ``.npz``. Loaded once, then shared."""
    path = Path(name) if str(name).endswith(".npz") else _builtin_body(str(name))
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            data = {key: file[key] for key in file.files}
    except FileNotFoundError:
        raise InputError(f"Expected a humanoid file, found none there: {path}") from None
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise FormatError(f"Expected a humanoid file ({FILE_FORMAT}), this is none ({error}): {path}") from error
    found = str(data.get("format", "another npz file"))
    if found != FILE_FORMAT:
        raise FormatError(f"Expected a humanoid file ({FILE_FORMAT}), got {found}. Hint: bake it again. File: {path}")
    try:
        return _humanoid(data)
    except KeyError as error:
        raise FormatError(f"The humanoid file lacks the array {error}. Hint: bake it again. File: {path}") from error


def _builtin_body(name: str) -> Path:
    folder = builtin_path("bodies")
    known = sorted(p.stem for p in folder.glob("*.npz"))
    if name not in known:
        raise InputError(f"No built-in humanoid {name!r}. There are: {', '.join(known) or 'none'}.")
    return folder / f"{name}.npz"


def _humanoid(data: Mapping[str, NDArray[Any]]) -> Humanoid:
    names = tuple(str(n) for n in data["joint_names"])
    if names != JOINT_NAMES:
        raise FormatError(f"Expected the {len(JOINT_NAMES)} SMPL-X joints in their order, got {len(names)} others.")
    bind = np.tile(np.eye(4), (len(names), 1, 1))
    bind[:, :3, :3], bind[:, :3, 3] = data["bind_rotation"], data["bind_position"]
    return Humanoid(
        name=str(data["name"]),
        height_m=float(data["height_m"]),
        joint_offsets=data["joint_offsets"].astype(np.float64),
        inverse_bind=np.linalg.inv(bind),
        full=_skinned_mesh(data, "full"),
        lod=_skinned_mesh(data, "lod"),
        region_names=tuple(str(n) for n in data["region_names"]),
        capsules=_capsules(data),
        clips=_clips(data),
        phenotype=json.loads(str(data["phenotype"])),
    )


def _skinned_mesh(data: Mapping[str, NDArray[Any]], prefix: str) -> SkinnedMesh:
    vertices = (data[f"{prefix}_vertices"] * np.float32(VERTEX_UNIT_M)).astype(np.float32)
    faces = data[f"{prefix}_faces"].astype(np.int32)
    regions = data[f"{prefix}_regions"]
    weights = data[f"{prefix}_weights"].astype(np.float32) * np.float32(WEIGHT_UNIT)
    return SkinnedMesh(
        mesh=Mesh(
            vertices=vertices,
            faces=faces,
            colors=data["region_colors"][regions],
            normals=vertex_normals(vertices, faces),
        ),
        joints=data[f"{prefix}_joints"],
        weights=weights / weights.sum(axis=1, keepdims=True),
        regions=regions,
    )


def vertex_normals(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """Unit normals per vertex, float32 [V, 3]: the mean of the faces around, weighted by their areas."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    face_normals = np.cross(b - a, c - a)
    corners = faces.ravel()
    total = [np.bincount(corners, np.repeat(face_normals[:, k], 3), minlength=len(vertices)) for k in range(3)]
    return normalized(np.stack(total, axis=1)).astype(np.float32)


def _capsules(data: Mapping[str, NDArray[Any]]) -> tuple[BodyCapsule, ...]:
    return tuple(
        BodyCapsule(
            name=str(data["capsule_names"][k]),
            joint=int(data["capsule_joints"][k]),
            start=data["capsule_start"][k].astype(np.float64),
            end=data["capsule_end"][k].astype(np.float64),
            radius=float(data["capsule_radius"][k]),
        )
        for k in range(len(data["capsule_names"]))
    )


def _clips(data: Mapping[str, NDArray[Any]]) -> tuple[Clip, ...]:
    quats = normalized(data["clip_quats"].astype(np.float64) * QUAT_UNIT)
    pelvis = data["clip_pelvis"].astype(np.float64)
    ends = np.cumsum(data["clip_frames"])
    clips = []
    for k, end in enumerate(ends):
        rows = slice(int(end - data["clip_frames"][k]), int(end))
        clips.append(
            Clip(
                name=str(data["clip_names"][k]),
                speed_mps=float(data["clip_speed_mps"][k]),
                stride_m=float(data["clip_stride_m"][k]),
                period_s=float(data["clip_period_s"][k]),
                stance=float(data["clip_stance"][k]),
                quats=quats[rows],
                pelvis=pelvis[rows],
            )
        )
    return tuple(clips)
