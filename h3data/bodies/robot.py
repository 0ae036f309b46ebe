"""Robots: a URDF with meshes and, beside it, a small ``robot.toml`` with what URDF cannot say (posture, discs, cameras).

Link frames are URDF's. The agent root frame (x forward, y up, z right, on the floor) is turned into the URDF base frame
(x forward, y left, z up) and lifted by ``base_height_m``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.meshes import DEFAULT_COLOR, box_mesh, load_mesh, moved, round_mesh
from h3data.bodies.urdf import Urdf, UrdfJoint, UrdfLink, UrdfPart, read_urdf
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data.geometry import Array, normalized, pose_from_matrix, pose_to_matrix
from h3data.scene.meshes import joined
from h3data.scene.records import Box, Capsule, Cylinder, Hull, Mesh, Shape

Z_UP_TO_ROOT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""URDF base frame (x forward, y left, z up) to agent root axes (x forward, y up, z right)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotLink:
    """One rigid part."""

    name: str
    parent: int
    """Index of the parent link, -1 for the base; parents come first."""
    mesh: Mesh | None
    """All visuals in the link frame."""
    shapes: tuple[Shape, ...]
    """Collision parts in the link frame."""
    inertial: Array
    """Centre-of-mass frame in the link frame, 4x4: Habitat gives link poses in it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotCamera:
    """A camera fixed to a link."""

    name: str
    link: int
    pose: Array
    """4x4, camera (OpenCV: x right, y down, z forward) to link frame."""
    width: int
    height: int
    hfov_deg: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Robot:
    """A kinematic tree with looks, shapes and cameras. Immutable: share it freely."""

    name: str
    links: tuple[RobotLink, ...]
    joint_names: tuple[str, ...]
    """Movable joints, in the order of the URDF: columns of ``joint_pos``."""
    rest: Array
    """Joint positions of the resting posture, shape [J] [rad or m]."""
    lower: Array
    """Joint limits, shape [J]; infinite where there are none."""
    upper: Array
    joint_links: NDArray[np.int64]
    """The link that each joint moves, shape [J]."""
    base_height_m: float
    """Height of the URDF base frame above the floor, feet down in the resting posture."""
    body_height_m: float
    """Height of the highest point that counts as the body's, for ``base_shapes`` [m]."""
    base_discs: Array
    """Places along x of the discs in which the base must stay free, shape [D] [m]."""
    base_radius_m: float
    cameras: tuple[RobotCamera, ...]
    to_base: Array
    """URDF base frame to agent root frame, 4x4."""
    origins: NDArray[np.float64]
    """Joint frame in the parent link's frame for each link, shape [L, 4, 4]."""
    axes: NDArray[np.float64]
    """Joint axis of each link, shape [L, 3]."""
    kinds: NDArray[np.int64]
    """0 fixed, 1 turns, 2 slides, shape [L]."""

    @property
    def link_names(self) -> tuple[str, ...]:
        return tuple(link.name for link in self.links)

    @cached_property
    def base_shapes(self) -> tuple[Cylinder, ...]:
        """The base as the paper has it: upright cylinders over ``base_discs``, in the agent root frame."""
        half = self.body_height_m / 2
        return tuple(
            Cylinder(pose=np.array([x, half, 0, 0, 0, 0, 1.0]), radius=self.base_radius_m, half_height=half)
            for x in self.base_discs
        )

    @cached_property
    def _parents(self) -> NDArray[np.int64]:
        return np.array([link.parent for link in self.links], np.int64)

    @cached_property
    def _joint_of_link(self) -> NDArray[np.int64]:
        joints = np.zeros(len(self.links), np.int64)
        joints[self.joint_links] = np.arange(len(self.joint_links))
        return joints

    def link_matrices(self, base_pose: ArrayLike, joint_pos: ArrayLike) -> NDArray[np.float64]:
        """World matrices of the link frames, [T, L, 4, 4], from agent roots [T, 7] and joint positions [T, J]."""
        from h3data.bodies.kinematics import link_frames

        roots = np.ascontiguousarray(pose_to_matrix(np.asarray(base_pose, np.float64)) @ self.to_base)
        positions = np.ascontiguousarray(joint_pos, np.float64)
        if positions.shape != (len(roots), len(self.joint_names)):
            raise InputError(
                f"Expected joint positions [{len(roots)}, {len(self.joint_names)}] of {self.name}, got {list(positions.shape)}."
            )
        out = np.empty((len(roots), len(self.links), 4, 4))
        link_frames(roots, positions, self._parents, self.origins, self.kinds, self.axes, self._joint_of_link, out)
        return out

    def camera(self, name: str) -> RobotCamera:
        """The camera of that name."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(c.name for c in self.cameras) or "none"
        raise InputError(f"Robot {self.name} has no camera {name!r}. It has: {known}.")

    def camera_poses(self, name: str, link_matrices: Array) -> Array:
        """Camera (OpenCV) to world, [T, 4, 4], of what `link_matrices` returned."""
        camera = self.camera(name)
        return link_matrices[:, camera.link] @ camera.pose

    def __repr__(self) -> str:
        triangles = sum(len(link.mesh.faces) for link in self.links if link.mesh is not None)
        return (
            f"Robot({self.name!r}, {len(self.links)} links, {len(self.joint_names)} joints, {triangles} triangles, "
            f"cameras {', '.join(c.name for c in self.cameras) or 'none'})"
        )


@lru_cache(maxsize=32)
def load_robot(name_or_path: str | Path, *, up: Literal["z", "y"] = "z") -> Robot:
    """A built-in robot by name (``quad_arm``), or any URDF by its path. Loaded once, then shared.

    ``up`` is the axis of the URDF base frame that points up: ``z`` by URDF's rule; Habitat's own robots have ``y``.
    """
    path = _find(name_or_path)
    urdf = read_urdf(path)
    return _robot(urdf, _read_settings(path.with_name("robot.toml"), urdf), up)


def _find(name_or_path: str | Path) -> Path:
    if str(name_or_path).endswith(".urdf"):
        return Path(name_or_path)
    folder = builtin_path("robots")
    known = sorted(p.parent.name for p in folder.glob("*/robot.urdf"))
    if str(name_or_path) not in known:
        raise InputError(
            f"No built-in robot {str(name_or_path)!r}. There are: {', '.join(known) or 'none'}; or give the path of a .urdf."
        )
    return folder / str(name_or_path) / "robot.urdf"


# --- robot.toml -------------------------------------------------------------------------------------------------------
class CameraSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ``[[cameras]]`` table."""

    name: str
    link: str
    position: tuple[float, float, float]
    """In the link frame [m]."""
    forward: tuple[float, float, float]
    """Viewing direction in the link frame."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction in the link frame that the picture shows upwards."""
    width: int
    height: int
    hfov_deg: float


class RobotSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What ``robot.toml`` says."""

    base_height_m: float = 0.0
    body_height_m: float = 0.5
    base_discs_m: tuple[float, ...] = (0.0,)
    base_radius_m: float = 0.25
    rest: tuple[float, ...] = ()
    """Joint positions in URDF order; empty = zeros, put inside the limits."""
    cameras: tuple[CameraSettings, ...] = ()


def _read_settings(path: Path, urdf: Urdf) -> RobotSettings:
    if not path.is_file():
        return RobotSettings()
    try:
        settings = msgspec.toml.decode(path.read_bytes(), type=RobotSettings)
    except msgspec.MsgspecError as error:
        raise FormatError(f"Not a robot description: {error}. File: {path}") from error
    faults = []
    if settings.rest and len(settings.rest) != len(urdf.movable):
        faults.append(f"rest has {len(settings.rest)} positions, the URDF {len(urdf.movable)} movable joints")
    names = {link.name for link in urdf.links}
    faults += [
        f"camera {c.name} is fixed to {c.link!r}, which is no link" for c in settings.cameras if c.link not in names
    ]
    if faults:
        raise FormatError(f"The robot description does not fit its URDF: {'; '.join(faults)}. File: {path}")
    return settings


# --- building ---------------------------------------------------------------------------------------------------------
def _robot(urdf: Urdf, settings: RobotSettings, up: Literal["z", "y"]) -> Robot:
    order = _parents_first(urdf)
    index = {link.name: k for k, link in enumerate(order)}
    above: dict[str, UrdfJoint] = {j.child: j for j in urdf.joints}
    movable = urdf.movable
    lower, upper = np.array([j.lower for j in movable]), np.array([j.upper for j in movable])
    rest = np.array(settings.rest, np.float64) if settings.rest else np.clip(np.zeros(len(movable)), lower, upper)
    kinds = {"fixed": 0, "revolute": 1, "continuous": 1, "prismatic": 2}
    to_base = Z_UP_TO_ROOT.copy() if up == "z" else np.eye(4)
    to_base[1, 3] = settings.base_height_m
    joints = [above.get(link.name) for link in order]
    return Robot(
        name=urdf.name,
        links=tuple(
            _robot_link(link, -1 if (j := above.get(link.name)) is None else index[j.parent]) for link in order
        ),
        joint_names=tuple(j.name for j in movable),
        rest=rest,
        lower=lower,
        upper=upper,
        joint_links=np.array([index[j.child] for j in movable], np.int64),
        base_height_m=settings.base_height_m,
        body_height_m=settings.body_height_m,
        base_discs=np.array(settings.base_discs_m, np.float64),
        base_radius_m=settings.base_radius_m,
        cameras=tuple(_camera(c, index[c.link]) for c in settings.cameras),
        to_base=to_base,
        origins=np.stack([np.eye(4) if j is None else j.origin for j in joints]).astype(np.float64),
        axes=np.stack([np.array([1.0, 0, 0]) if j is None else j.axis for j in joints]).astype(np.float64),
        kinds=np.array([0 if j is None else kinds[j.kind] for j in joints], np.int64),
    )


def _parents_first(urdf: Urdf) -> list[UrdfLink]:
    links = {link.name: link for link in urdf.links}
    order, waiting = [], [urdf.root]
    while waiting:
        name = waiting.pop(0)
        order.append(links[name])
        waiting = [j.child for j in urdf.joints if j.parent == name] + waiting
    return order


def _robot_link(link: UrdfLink, parent: int) -> RobotLink:
    meshes = [_visual(part) for part in link.visuals]
    shapes = tuple(_shape(part) for part in link.collisions)
    return RobotLink(
        name=link.name, parent=parent, mesh=joined(meshes) if meshes else None, shapes=shapes, inertial=link.inertial
    )


def _visual(part: UrdfPart) -> Mesh:
    g = part.geometry
    color = part.color or DEFAULT_COLOR
    match g.kind:
        case "box":
            return moved(box_mesh(g.size, color), part.origin)
        case "mesh":
            assert g.file is not None
            return moved(load_mesh(g.file, color=part.color), part.origin, g.scale)
        case kind:
            return moved(round_mesh(g.radius, g.length, color, caps=kind != "cylinder"), part.origin)


def _shape(part: UrdfPart) -> Shape:
    g, origin = part.geometry, part.origin
    match g.kind:
        case "box":
            return Box(pose=pose_from_matrix(origin).astype(np.float64), half_extents=np.array(g.size) / 2)
        case "cylinder":  # ours stand along y, URDF's along z
            y_to_z = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
            return Cylinder(
                pose=pose_from_matrix(origin @ y_to_z).astype(np.float64), radius=g.radius, half_height=g.length / 2
            )
        case "mesh":
            assert g.file is not None
            return Hull(points=_hull_points(moved(load_mesh(g.file), origin, g.scale)))
        case _:
            along = origin[:3, 2] * g.length / 2
            return Capsule(start=origin[:3, 3] - along, end=origin[:3, 3] + along, radius=g.radius)


def _hull_points(mesh: Mesh) -> NDArray[np.float64]:
    from scipy.spatial import ConvexHull, QhullError

    points = mesh.vertices.astype(np.float64)
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # flat: all its points are as good
        return np.unique(points, axis=0)


def _camera(settings: CameraSettings, link: int) -> RobotCamera:
    forward = normalized(np.array(settings.forward))
    right = normalized(np.cross(forward, np.array(settings.up)))
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = settings.position
    return RobotCamera(
        name=settings.name,
        link=link,
        pose=pose,
        width=settings.width,
        height=settings.height,
        hfov_deg=settings.hfov_deg,
    )
