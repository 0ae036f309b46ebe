"""Robots: links, joints, appearance, shapes and cameras, and their poses (`h3data.bodies.load_robot` loads one).

Link frames are URDF's. The agent root frame (x forward, y up, z right, on the floor) is turned into the URDF base frame
(x forward, y left, z up) and lifted by ``base_height_m``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, Array, pose_to_matrix
from h3data.mesh.mesh import Mesh
from h3data.scene.records import Cylinder, Shape

if TYPE_CHECKING:
    from torch import Tensor

    from h3data.bodies.robots.kinematics import JointTree


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotLink:
    """Link of a robot: one rigid part."""

    name: str
    parent: int
    """Index of the parent link, -1 for the base; parents come first."""
    mesh: Mesh | None
    """Mesh of all visual elements in the link frame [m]."""
    shapes: tuple[Shape, ...]
    """Collision parts in the link frame."""
    inertial: Array
    """Centre-of-mass frame in the link frame, 4x4, in which Habitat gives poses of links."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotCamera:
    """Camera that is fixed to a link of a robot, or to a person's head, and provides both colour and depth.

    A pair of an RGB and a depth camera is one such camera.
    """

    name: str
    link: int
    pose: Array
    """Matrix 4x4 from the frame of the camera (OpenCV: x right, y down, z forward) to that of its link."""
    width: int
    height: int
    hfov_deg: float
    near_m: float = 0.0
    """Distance of the near plane [m], which cuts a person's own face away."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotLeg:
    """A leg with hip roll, hip pitch and knee."""

    columns: tuple[int, int, int]
    """Columns of the leg's joints in the joint positions."""
    foot: Array
    """Middle of the foot in the frame of the link that the knee moves, shape [3] [m]."""


class JointTargets(NamedTuple):
    """Joint positions that the robot can take."""

    positions: NDArray[np.float64]
    """Positions of the joints, inside their limits, shape [..., J] [rad or m]."""
    clamped: NDArray[np.bool_]
    """True if each requested position was beyond a limit, shape [..., J]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Robot:
    """Kinematic tree of a robot with appearance, shapes and cameras. It is immutable and can be shared."""

    name: str
    file: Path
    """File of the robot's description, a URDF."""
    links: tuple[RobotLink, ...]
    joint_names: tuple[str, ...]
    """Names of the columns of ``joint_pos``: joints that move on their own, in the order of the URDF. A spherical joint
    has four (``name.x`` to ``name.w``, a quaternion)."""
    rest: Array
    """Joint positions of the resting posture, shape [J] [rad or m]."""
    lower: Array
    """Lower joint limits, shape [J] [rad or m]; infinite where there are none."""
    upper: Array
    joint_links: NDArray[np.int64]
    """Link that each joint moves, shape [J]; links that follow a joint by mimic are left out."""
    base_height_m: float
    """Height of the URDF base frame above the floor, feet down in the resting posture."""
    body_height_m: float
    """Height of the cylinders in ``base_shapes`` above the floor [m]."""
    base_discs: Array
    """Positions along x of the discs in which the base must stay free, shape [D] [m]."""
    base_profiles: dict[str, Array] = field(default_factory=dict)
    """Further sets of base discs, by name."""
    base_radius_m: float
    """Radius of the base discs [m]."""
    hull_discs: Array
    """Positions along x of discs of the same radius that cover the whole robot at rest, shape [H] [m]: other agents
    avoid these."""
    max_speed_mps: float | None = None
    """Speed limit of the base [m/s]; None for the limit of the task."""
    max_turn_rad_s: float | None = None
    """Turn rate limit of the base [rad/s]; None for the limit of the task."""
    hand_link: int = -1
    """Link that grasps; -1 = none."""
    hand_position: Array = field(default_factory=lambda: np.zeros(3))
    """Position at which the hand holds things, in the frame of that link, shape [3] [m]."""
    hand_axes: Array = field(default_factory=lambda: np.eye(3))
    """Forward, left and upward directions of the hand in the frame of that link, as columns [3, 3]."""
    reach_bearing: float | None = None
    """Bearing at which the robot reaches for things [rad], to the left of its forward axis; None if it is not known."""
    legs: tuple[RobotLeg, ...] = ()
    climbs_stairs: bool = False
    """True if the robot walks up and down stairs; for other robots stairs are walls."""
    cameras: tuple[RobotCamera, ...]
    to_base: Array
    """Transform from the URDF base frame to the agent root frame, 4x4."""
    origins: NDArray[np.float64]
    """Joint frame in the parent link's frame for each link, shape [L, 4, 4]."""
    axes: NDArray[np.float64]
    """Joint axis of each link, shape [L, 3]."""
    kinds: NDArray[np.int64]
    """Kind of each link's joint: 0 fixed, 1 turns, 2 slides, 3 takes a quaternion (`h3data.bodies.robots.kinematics`), shape
    [L]."""
    columns: NDArray[np.int64]
    """Joint position that moves each link (the first of four for a quaternion), shape [L]; 0 where none does."""
    gains: NDArray[np.float64]
    """Factors by which links follow joint positions, shape [L]: a link moves by gain * position + offset (URDF
    mimic)."""
    offsets: NDArray[np.float64]
    semantic_id: ClassVar[int] = 200
    """Semantic id of robots in h3data's recordings."""
    model_prefix: ClassVar[str] = "robot/"
    """Text before the name of the body in `h3data.recording.Agent.model`."""

    @cached_property
    def eye_height_m(self) -> float:
        """Height of the eyes above the floor [m]: of the highest camera at rest, or of the body if there is none."""
        links = self.link_matrices(IDENTITY_POSE[None], self.rest[None])
        poses = [self.camera_poses(name, links) for name in self.camera_names]
        return max((float(pose[0, 1, 3]) for pose in poses), default=self.body_height_m)

    @cached_property
    def climbing_length_m(self) -> float:
        """Distance between front and hind feet, over which the base pitches on stairs [m].

        It is 0 for robots that do not climb.
        """
        if not self.climbs_stairs:
            return 0.0
        if not self.legs:
            return float(np.ptp(self.base_discs)) + self.base_radius_m
        links = self.link_matrices(IDENTITY_POSE[None], self.rest[None])[0]
        feet = [links[self.joint_links[leg.columns[2]]] @ [*leg.foot, 1.0] for leg in self.legs]
        return float(np.ptp([foot[0] for foot in feet]))

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of all links, in the order of `links`."""
        return tuple(link.name for link in self.links)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of all cameras, in the order of `cameras`, as in recordings and videos."""
        return tuple(camera.name for camera in self.cameras)

    @cached_property
    def base_shapes(self) -> tuple[Cylinder, ...]:
        """Collision shapes of the base as in the paper: upright cylinders over ``base_discs``, in the agent root frame."""
        return self.base_cylinders()

    def base_cylinders(self, profile: str = "") -> tuple[Cylinder, ...]:
        """Return upright cylinders over the discs of a profile, in the agent root frame.

        The profile is one of ``base_profiles``; an empty name means ``base_discs``.
        """
        if profile and profile not in self.base_profiles:
            known = ", ".join(self.base_profiles) or "none"
            raise InputError(f"Robot {self.name} has no base profile {profile!r}. It has: {known}.", code="H3-BODY-094")
        half = self.body_height_m / 2
        return tuple(
            Cylinder(pose=np.array([x, half, 0, 0, 0, 0, 1.0]), radius=self.base_radius_m, half_height=half)
            for x in (self.base_profiles[profile] if profile else self.base_discs)
        )

    @cached_property
    def arm_columns(self) -> tuple[int, ...]:
        """Columns of ``joint_pos`` that move the hand, in the order of the URDF.

        For ``quad_arm`` they are the seven joints of the arm, without the gripper. Empty without a hand.
        """
        chain: list[int] = []
        link = self.hand_link
        while link >= 0:
            chain.append(link)
            link = self.links[link].parent
        # by columns, not by `joint_links`: a link of the chain may follow a joint outside it by mimic
        moving = [k for k in chain if self.kinds[k] != 0]
        return tuple(sorted({int(self.columns[k]) + i for k in moving for i in range(4 if self.kinds[k] == 3 else 1)}))

    def require_arm(self) -> tuple[int, ...]:
        """Return `arm_columns`; raise an error if the robot has no arm.

        Raises:
            InputError: The robot has no hand, or no joint moves the hand.
        """
        if not self.arm_columns:
            why = "has no hand" if self.hand_link < 0 else f"has no joint that moves its hand {self.hand_name}"
            raise InputError(
                f"Robot {self.name} {why}, so it has no arm to move. Hint: name its hand_link in robot.toml (h3data robots "
                f"init writes one). File: {self.file}",
                code="H3-BODY-095",
            )
        return self.arm_columns

    @property
    def hand_name(self) -> str:
        """Name of the link that grasps; empty if there is none."""
        return self.links[self.hand_link].name if self.hand_link >= 0 else ""

    @cached_property
    def joint_tree(self) -> JointTree:
        """Links and joints in the form that forward kinematics takes."""
        from h3data.bodies.robots.kinematics import JointTree

        parents = np.array([link.parent for link in self.links], np.int64)
        return JointTree(parents, self.origins, self.kinds, self.axes, self.columns, self.gains, self.offsets)

    def link_index(self, name: str) -> int:
        """Return the index of a link in ``links``."""
        if name not in self.link_names:
            raise InputError(
                f"Robot {self.name} has no link {name!r}. It has: {', '.join(self.link_names[:40])}.",
                code="H3-BODY-096",
            )
        return self.link_names.index(name)

    def clamp(self, joint_pos: ArrayLike) -> JointTargets:
        """Return the nearest joint positions inside the limits, and which ones had to be moved there.

        Raises:
            InputError: the shape is not [..., J], or a number is NaN or infinite.
        """
        wanted = self._joints(joint_pos)
        # `clip` lets NaN pass, and no limit would be named
        if not np.isfinite(wanted).all():
            bad = sorted({self.joint_names[j] for j in np.argwhere(~np.isfinite(wanted))[:, -1]})
            raise InputError(
                f"Expected finite joint positions of {self.name}, got NaN or infinity for {', '.join(bad)}.",
                code="H3-BODY-097",
            )
        return JointTargets(np.clip(wanted, self.lower, self.upper), (wanted < self.lower) | (wanted > self.upper))

    def link_matrices(self, base_pose: ArrayLike, joint_pos: ArrayLike) -> NDArray[np.float64]:
        """Return the world matrices of the link frames, [T, L, 4, 4], from agent roots [T, 7] and joint positions [T, J]."""
        from h3data.bodies.robots.kinematics import link_frames  # numba: robots can be read without it

        bases = np.asarray(base_pose, np.float64)
        matrices = pose_to_matrix(bases[0])[None] if len(bases) == 1 else pose_to_matrix(bases)  # one alone is cheaper
        roots = np.ascontiguousarray(matrices @ self.to_base)
        positions = np.ascontiguousarray(joint_pos, np.float64)
        if positions.shape != (len(roots), len(self.joint_names)):
            raise InputError(
                f"Expected joint positions [{len(roots)}, {len(self.joint_names)}] of {self.name}, "
                f"got {list(positions.shape)}.",
                code="H3-BODY-098",
            )
        out = np.empty((len(roots), len(self.links), 4, 4))
        link_frames(roots, positions, *self.joint_tree, out)
        return out

    def link_matrices_torch(self, base: Tensor, joint_pos: Tensor) -> Tensor:
        """Return the link frames [*batch, L, 4, 4] as torch tensors, differentiable in both arguments.

        ``base`` are agent roots [*batch, 4, 4], ``joint_pos`` joint positions [*batch, J], whose device the result has.
        """
        from h3data.bodies.robots.kinematics import link_frames_torch

        if joint_pos.shape[-1:] != (len(self.joint_names),) or base.shape[-2:] != (4, 4):
            raise InputError(
                f"Expected roots [..., 4, 4] and joint positions [..., {len(self.joint_names)}] of {self.name}, got "
                f"{list(base.shape)} and {list(joint_pos.shape)}.",
                code="H3-BODY-099",
            )
        # the joints decide on device and precision
        to_base = joint_pos.new_tensor(self.to_base)
        return link_frames_torch(self.joint_tree, base.to(joint_pos) @ to_base, joint_pos)

    def _joints(self, joint_pos: ArrayLike) -> NDArray[np.float64]:
        try:
            positions = np.asarray(joint_pos, np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"Expected joint positions of {self.name}, got something else ({error}).", code="H3-BODY-101"
            ) from None
        if positions.shape[-1:] != (len(self.joint_names),):
            raise InputError(
                f"Expected joint positions [..., {len(self.joint_names)}] of {self.name}, got {list(positions.shape)}.",
                code="H3-BODY-100",
            )
        return positions

    def camera(self, name: str) -> RobotCamera:
        """Return a camera of the robot by its name."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(self.camera_names) or "none"
        raise InputError(f"Robot {self.name} has no camera {name!r}. It has: {known}.", code="H3-BODY-093")

    def camera_poses(self, name: str, link_matrices: Array) -> Array:
        """Return the poses of cameras (OpenCV) in the world, [T, 4, 4], from the result of `link_matrices`."""
        camera = self.camera(name)
        return link_matrices[:, camera.link] @ camera.pose

    def __repr__(self) -> str:
        triangles = sum(len(link.mesh.faces) for link in self.links if link.mesh is not None)
        return (
            f"Robot({self.name!r}, {len(self.links)} links, {len(self.joint_names)} joints, {triangles} triangles, "
            f"cameras {', '.join(self.camera_names) or 'none'})"
        )
