"""People: a skinned mesh on the 55-joint skeleton, with gait and collision shapes.

`h3data.bodies.people.humanoid_file` reads people from files.

Frames. The body frame has +Z forward, +Y up, +X left (SMPL-X). The agent root frame has x forward, y up, z right and
lies on the floor below the pelvis; the body frame is turned into it by R_y(+90 deg), which the clips' pelvis rotation
contains.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.people.arms import draw_in
from h3data.bodies.people.clips import (
    Clip,
    ClipTable,
    Gaits,
    clip_table,
    make_clips,
    nearest_clip,
    pose_at_speed,
    sample_clips,
)
from h3data.bodies.people.skeleton import HALF_JOINTS, JOINT_COUNT, JOINT_INDEX, JOINT_NAMES, PARENT_ARRAY, PARENTS
from h3data.bodies.people.skinning import (
    FEW_FRAMES,
    Influences,
    Skin,
    SkinBounds,
    apply_skin,
    apply_skin_frames,
    build_skin,
    build_skin_bounds,
    skin_chunks,
    with_half_joints,
)
from h3data.bodies.robots.robot import RobotCamera
from h3data.geometry import Array, normalized
from h3data.mesh.mesh import Mesh

if TYPE_CHECKING:
    from h3data.bodies.people.kernels.planted import GaitTables

BONE_BOX_M, BONE_PAD_M, BONE_PAD_PART = 0.02, 0.02, 1 / 25
"""Width of Habitat's collision boxes along bones [m], and the distance from joints at which the boxes end [m]
(spec/habitat.md 1.6)."""

HEAD_CAMERA = RobotCamera(
    name="human_head",
    link=JOINT_INDEX["head"],
    pose=np.array([[-1.0, 0, 0, 0], [0, -1, 0, 0.07], [0, 0, 1, 0.07], [0, 0, 0, 1]]),
    width=640,
    height=480,
    hfov_deg=90.0,
    near_m=0.12,
)
"""Camera between the eyes of a person, in the frame of the joint ``head`` (z forward, y up, x left)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinnedMesh:
    """Mesh in the rest pose with its skin weights."""

    mesh: Mesh
    """Rest pose (arms in A-pose) in the body frame; colours and normals per vertex."""
    joints: NDArray[np.uint8]
    """Indices of the four joints that move each vertex, shape [V, 4]."""
    weights: NDArray[np.float32]
    """Weights of the joints that move each vertex, which sum to 1, shape [V, 4]."""
    regions: NDArray[np.uint8]
    """Index into `Humanoid.region_names` per vertex: skin, hair, top, bottom, ... Shape [V]."""

    @cached_property
    def skin(self) -> Skin:
        """Sparse skinning operators, built at first use (20 ms for the full mesh)."""
        return build_skin(self.mesh.vertices, self.mesh.normals, *self.influences, JOINT_COUNT + len(HALF_JOINTS))

    @cached_property
    def plain_skin(self) -> Skin:
        """Skinning operators without half joints, built at first use."""
        return build_skin(self.mesh.vertices, self.mesh.normals, self.joints, self.weights, JOINT_COUNT)

    @cached_property
    def influences(self) -> Influences:
        """Joints and half joints that move the skin, computed from `joints` and `weights` at first use."""
        return with_half_joints(self.joints, self.weights)

    @cached_property
    def owners(self) -> NDArray[np.uint8]:
        """Index of the joint that moves each vertex most, shape [V]."""
        return np.take_along_axis(self.joints, self.weights.argmax(1)[:, None], 1)[:, 0]


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyCapsule:
    """Collision capsule that moves with one joint."""

    name: str
    joint: int
    start: Array
    """Start of the axis in the joint frame, shape [3] [m]."""
    end: Array
    """End of the axis in the joint frame, shape [3] [m]."""
    radius: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Humanoid:
    """Body of a person that can be posed, rendered and tested for collisions; it is immutable and can be shared."""

    name: str
    height_m: float
    """Height of the person [m], without hair and soles."""
    joint_names: tuple[str, ...] = JOINT_NAMES
    parents: tuple[int, ...] = PARENTS
    joint_offsets: Array
    """Position of each joint in the frame of its parent, shape [55, 3] [m]; for the pelvis, its height in the T-pose."""
    inverse_bind: Array
    """Transforms from the body frame of the rest mesh to the joint frames, shape [55, 4, 4]; they include the change
    from T-pose to A-pose."""
    full: SkinnedMesh
    lod: SkinnedMesh
    """Mesh of about 3,000 vertices, the default for cameras that are not close (surface error below 5 mm)."""
    region_names: tuple[str, ...]
    capsules: tuple[BodyCapsule, ...]
    gaits: Gaits
    """Walking gait of the body, from which `clips` are sampled."""
    outfit: str = ""
    """Name of the clothes; empty where they are part of the body's own mesh."""
    phenotype: Mapping[str, float] = field(default_factory=dict)
    """Shape parameters from which the body was generated."""
    acts: Mapping[str, Any] = field(default_factory=dict)
    """Motions of files that the body can play, by name of the activity (`h3data_motion.acts.Act`)."""
    camera_names: ClassVar[tuple[str, ...]] = (HEAD_CAMERA.name,)
    """Names of the cameras of the body: one between the eyes that looks in the direction of the head."""
    climbs_stairs: ClassVar[bool] = True
    """Ability to climb stairs: always True for people, unlike for robots."""
    climbing_length_m: ClassVar[float] = 0.0
    """Length over which the body pitches on stairs [m]: always 0, because people, unlike robots, stay upright."""
    rest: ClassVar[Array] = np.zeros(0)
    """Positions of moving joints at rest: none, because people move by clips and postures."""
    arm_columns: ClassVar[tuple[int, ...]] = ()
    """Columns of `rest` that move the hand: none."""
    semantic_id: ClassVar[int] = 100
    """Semantic id of people in recordings, which is Habitat's, whose detector counts their pixels."""
    model_prefix: ClassVar[str] = "humanoid/"
    """Text before the name of the body in `h3data.recording.Agent.model`."""

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the links of the skeleton, which are those of the joints."""
        return self.joint_names

    @property
    def eye_height_m(self) -> float:
        """Height of the eyes above the floor [m]."""
        return 0.936 * self.height_m

    def require_arm(self) -> tuple[int, ...]:
        """Return `arm_columns`; every person has arms, whatever the number of moving joints."""
        return self.arm_columns

    def camera(self, name: str) -> RobotCamera:
        """Return the only camera of a person, between the eyes, whatever its ``name``."""
        return HEAD_CAMERA

    def camera_poses(self, name: str, joint_matrices: Array) -> Array:
        """Return the poses of the camera (OpenCV) in the world, [T, 4, 4], from the result of `joint_matrices`."""
        return joint_matrices[:, HEAD_CAMERA.link] @ HEAD_CAMERA.pose

    @property
    def mesh(self) -> Mesh:
        """Full mesh in the rest pose, in the body frame [m]."""
        return self.full.mesh

    @property
    def lod_mesh(self) -> Mesh:
        """Simplified mesh in the rest pose, in the body frame [m]."""
        return self.lod.mesh

    @cached_property
    def clips(self) -> tuple[Clip, ...]:
        """Motion clips of the body: standing first, then the walks, the jog and the turns on the spot.

        They are computed at first use (30 ms).
        """
        return make_clips(self.gaits)

    @property
    def motion_names(self) -> tuple[str, ...]:
        """Names of the clips, in the order of motion ids."""
        return tuple(c.name for c in self.clips)

    @cached_property
    def _clip_table(self) -> ClipTable:
        return clip_table(self.clips, self.gaits.legs)

    @cached_property
    def gait_tables(self) -> GaitTables:
        """Gait tables for `h3data.bodies.people.planted_gait`, computed at first use (40 ms)."""
        from h3data.bodies.people.planted_gait import gait_tables

        return gait_tables(self.gaits)

    @cached_property
    def _capsule_arrays(self) -> tuple[NDArray[np.intp], Array, Array, Array]:
        # as arrays, since contact needs all of them in every step
        rows = [(c.joint, c.start, c.end, c.radius) for c in self.capsules]
        joints, start, end, radius = (np.array(column) for column in zip(*rows, strict=True))
        return joints, start, end, radius

    def clip_for_speed(self, speed_mps: float) -> int:
        """Return the motion id of the clip that fits ``speed_mps``; 0 (standing) at speeds near 0."""
        return nearest_clip(self.clips, speed_mps)

    def clip_pose(
        self,
        motion_id: ArrayLike,
        phase: ArrayLike,
        blend: ArrayLike = 1.0,
        *,
        arms: ArrayLike | None = None,
        ground: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Return local rotations [T, 55, 4] and pelvis positions [T, 3] [m] of clips in the agent root frame.

        `h3data.bodies.people.clips.sample_clips` describes ``motion_id``, ``phase`` and ``blend`` [T]: a blend of 0 is
        the standing pose, 1 the clip. ``arms`` [T, 2] is the degree, 0 to 1, to which the left and right arm are folded
        (`h3data.bodies.people.arms`). ``ground`` [T, 2] is the height of the floor under the left and right foot
        relative to the root [m].
        """
        quats, pelvis = sample_clips(self._clip_table, motion_id, phase, blend, ground)
        if arms is not None:
            draw_in(quats, arms)
        return quats, pelvis

    def walk_pose(
        self, speed_mps: ArrayLike, phase: ArrayLike, blend: ArrayLike = 1.0, *, ground: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Return local rotations [T, 55, 4] and pelvis positions [T, 3] [m] for walking at speeds [T] [m/s].

        Above 2 m/s, the pose is of jogging.

        Unlike `clip_pose`, the pose is computed exactly instead of read from a table.

        The phase [T] advances by distance / `stride_m`. While the speed changes within a step, the planted foot creeps
        by the change of the stride; change it between steps to avoid that.
        """
        return pose_at_speed(self.gaits, speed_mps, phase, blend, ground)

    def stride_m(self, speed_mps: ArrayLike) -> Array:
        """Return the distance per cycle of two steps [...] [m] at speeds [...] [m/s]."""
        return self.gaits.stride_m(speed_mps)

    def joint_matrices(self, base_pose: ArrayLike, quats: Array, pelvis: Array) -> Array:
        """Return world matrices of the joints, [T, 55, 4, 4], from agent roots [T, 7] and the result of `clip_pose`.

        If ``quats`` has only the first J joints, the result is [T, J, 4, 4].
        """
        from h3data.bodies.people.kernels.clips import joint_frames

        base = _doubles(base_pose).reshape(-1, 7)
        frames = np.empty((*quats.shape[:2], 4, 4))
        parents = PARENT_ARRAY[: quats.shape[1]]
        joint_frames(base, _doubles(quats), _doubles(pelvis), self.joint_offsets, parents, frames)
        return frames

    def joint_matrices_free(self, root_pose: ArrayLike, joint_quat: ArrayLike) -> Array:
        """Return the world matrices [T, 55, 4, 4] of the joints in a free-form pose.

        Args:
            root_pose: frames of the pelvis in the world [T, 7] (body axes: +Z forward).
            joint_quat: local rotations of the other joints [T, 54, 4], in SMPL-X order.
        """
        from h3data.bodies.people.kernels.clips import free_joint_frames

        quats = _doubles(joint_quat)
        frames = np.empty((len(quats), JOINT_COUNT, 4, 4))
        free_joint_frames(_doubles(root_pose), quats, self.joint_offsets, PARENT_ARRAY, frames)
        return frames

    @cached_property
    def skin_bind(self) -> Array:
        """Transforms from the body frame of the rest mesh to the frames of joints and half joints, shape [63, 4, 4]."""
        return np.concatenate([self.inverse_bind, self.inverse_bind[self.half_joints[0]]])

    @cached_property
    def half_joints(self) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """Joints and parents [H] of the half joints, and rotations of the joints in the parents at rest [H, 3, 3]."""
        joints = np.fromiter(HALF_JOINTS.values(), np.intp)
        bind, parent_bind = self.inverse_bind[joints, :3, :3], self.inverse_bind[PARENT_ARRAY[joints], :3, :3]
        return joints, PARENT_ARRAY[joints], np.ascontiguousarray(parent_bind @ bind.transpose(0, 2, 1))

    def skin_matrices(self, joint_matrices: Array) -> Array:
        """Return the matrices [..., 63, 4, 4] from the rest mesh to the world for joint frames [..., 55, 4, 4].

        They are those of the joints, then of the half joints (`h3data.bodies.people.skeleton.HALF_JOINTS`).
        """
        from h3data.bodies.people.kernels.skin import skin_palette

        frames = _doubles(joint_matrices).reshape(-1, *joint_matrices.shape[-3:])
        out = np.empty((len(frames), len(self.skin_bind), 4, 4))
        skin_palette(frames, *self.half_joints, self.skin_bind, out)
        return out.reshape(*joint_matrices.shape[:-3], *out.shape[1:])

    def skin_frames(self, joint_matrices: Array) -> Array:
        """Return the frames [..., 63, 4, 4] of joints and half joints in the world for joint frames [..., 55, 4, 4]."""
        return self.skin_matrices(joint_matrices) @ np.linalg.inv(self.skin_bind)

    def skin(self, joint_matrices: Array, *, lod: bool = True, plain: bool = False) -> NDArray[np.float32]:
        """Return the world positions of the vertices, float32 [..., V, 3] [m], for joint frames [..., 55, 4, 4].

        Leading axes are frames, worlds, or both. The computation is one sparse matrix product. ``plain`` leaves out the
        half joints (`h3data.bodies.people.skinning`); postures that recordings depend on are computed so.
        """
        part = self.lod if lod else self.full
        skin = part.plain_skin if plain else part.skin
        matrices = joint_matrices @ self.inverse_bind if plain else self.skin_matrices(joint_matrices)
        # few frames, as while an episode runs, have a faster product with the same bits
        if matrices.ndim == 4 and len(matrices) <= FEW_FRAMES:
            return apply_skin_frames(skin.frame, matrices)
        return apply_skin(skin.points, matrices)

    def skin_chunks(self, joint_matrices: Array, *, lod: bool = True) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        """Yield slices of the joint frames [T, 55, 4, 4] with the skinned vertices [t, V, 3] [m], for long recordings."""
        return skin_chunks((self.lod if lod else self.full).skin.points, self.skin_matrices(joint_matrices))

    def skin_normals(self, joint_matrices: Array, *, lod: bool = True) -> NDArray[np.float32]:
        """Return the world shading normals, float32 [T, V, 3], unit length, for the vertices of `skin`."""
        part = self.lod if lod else self.full
        # blended normals are shorter than 1 where joints bend
        return normalized(apply_skin(part.skin.normals, self.skin_matrices(joint_matrices))).astype(np.float32)

    def capsules_world(self, joint_matrices: Array) -> tuple[Array, Array, Array]:
        """Return the segment starts [T, C, 3], ends [T, C, 3] and radii [C] [m] of the collision capsules."""
        joints, start, end, radius = self._capsule_arrays
        frames = joint_matrices[:, joints]
        rotation, origin = frames[..., :3, :3], frames[..., :3, 3]
        return (rotation @ start[..., None])[..., 0] + origin, (rotation @ end[..., None])[..., 0] + origin, radius

    def bone_boxes_world(self, joint_matrices: Array) -> tuple[Array, Array]:
        """Return Habitat's collision profile: a thin box along every bone (spec/habitat.md 1.6, 3.1).

        A bone leads from a joint to each of its children; head, toes and fingertips have no bone. Boxes are 2 cm
        thick and end before both joints, by 2 cm or 1/25 of the bone, whichever is less.

        Returns centres with rotations, [T, K, 4, 4] with y along the bone, and full sizes [K, 3] [m].
        """
        start, end = self._bones
        frame, b = joint_matrices[:, start], joint_matrices[:, end][..., :3, 3]
        a = frame[..., :3, 3]
        # of the skeleton, which no pose changes
        length = np.linalg.norm(self.joint_offsets[end], axis=1)
        y = (b - a) / length[:, None]
        z = np.cross(frame[..., :3, 0], y)
        flat = np.linalg.norm(z, axis=-1, keepdims=True) < 0.3  # the bone runs along the joint's x axis
        z = normalized(np.where(flat, np.cross(frame[..., :3, 2], y), z))
        frames = np.zeros((*a.shape[:2], 4, 4))
        frames[..., :3, :3] = np.stack([np.cross(y, z), y, z], axis=-1)
        frames[..., :3, 3] = (a + b) / 2
        frames[..., 3, 3] = 1
        across = np.full_like(length, BONE_BOX_M)
        return frames, np.stack([across, length - 2 * np.minimum(length * BONE_PAD_PART, BONE_PAD_M), across], axis=1)

    @cached_property
    def _bones(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Start and end joints [K] of the bones; a joint that is where its parent is ends none."""
        length = np.linalg.norm(self.joint_offsets, axis=1)
        end = np.array([j for j, parent in enumerate(self.parents) if parent >= 0 and length[j] > 1e-3])
        return np.array(self.parents)[end], end

    @cached_property
    def bounds(self) -> tuple[SkinBounds, SkinBounds]:
        """Spheres that bound the full mesh and the simplified mesh in any pose, built at first use."""
        full, light = (build_skin_bounds(part.mesh.vertices, *part.influences) for part in (self.full, self.lod))
        return full, light

    def light_enough(self, focal_px: float, distance_m: float) -> bool:
        """Return whether the simplified mesh is accurate enough for a camera of a focal length [px] at a distance [m]."""
        # the height in the picture, focal * height / distance, without dividing by a distance of 0
        # 220.0: height in a picture [px] up to which a person is drawn with the light mesh, whose error (4
        # mm) is then below half a pixel
        return focal_px * self.height_m < 220.0 * max(distance_m, 1e-6)

    def __repr__(self) -> str:
        return (
            f"Humanoid({self.name!r}, {self.height_m:.2f} m, {self.mesh}, LOD {self.lod_mesh}, "
            f"{len(self.capsules)} capsules, clips {', '.join(self.motion_names)})"
        )


def _doubles(values: ArrayLike) -> Array:
    """Return an array in the form that the kernels take."""
    return np.ascontiguousarray(values, np.float64)
