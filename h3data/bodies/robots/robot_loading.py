"""Robots from files: a URDF with meshes or MJCF, with a small ``robot.toml`` for data that URDF cannot hold."""

from __future__ import annotations

import hashlib
import logging
import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.robots.robot import Robot, RobotCamera, RobotLeg, RobotLink
from h3data.bodies.robots.robot_files import (
    DESCRIPTIONS,
    GUESSES,
    READERS,
    RobotFiles,
    RobotReader,
    find_robot,
    is_built_in,
)
from h3data.bodies.robots.robot_settings import CameraSettings, RobotSettings, read_settings
from h3data.bodies.robots.urdf import Urdf, UrdfJoint, UrdfLink, UrdfPart, mesh_files, missing_meshes, read_urdf
from h3data.bodies.robots.urdf_parts import UrdfGeometry
from h3data.errors import H3DataError, InputError
from h3data.geometry import IDENTITY_POSE, Array, normalized, pose_from_matrix
from h3data.mesh.gltf_primitives import DEFAULT_COLOR
from h3data.mesh.loading import load_mesh
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import flat_shaded, joined, moved, painted
from h3data.mesh.primitives import box_mesh, round_mesh
from h3data.scene.records import Box, Capsule, Cylinder, Hull, Shape
from h3data.scene.shape_bounds import shape_bounds


def load_robot(name_or_path: str | Path, *, up: Literal["z", "y"] = "z", fill_in: bool = True) -> Robot:
    """Load a robot once and share it until its files change.

    Args:
        name_or_path: A name (`robot_names`), or the path of a URDF, of a ``robot.toml``, or of the folder of either.
        up: The axis of the URDF base frame that points up: ``z`` by URDF's rule; Habitat's own robots have ``y``.
        fill_in: True guesses settings where there is no ``robot.toml`` (the group `h3data.robot_guesses`) and lets boxes
            stand in for missing meshes, with a warning. False uses the defaults; missing meshes are an error.

    Raises:
        InputError: There is no such robot.
        FormatError: Its files cannot be used.
        MissingAssetError: Meshes are missing and not filled in.
    """
    files = find_robot(name_or_path)
    return _loaded(files, up, fill_in, *map(_version, files))


def robot_name(robot: str | Path | Robot) -> str:
    """Return the name or path by which `load_robot` finds a robot again."""
    if not isinstance(robot, Robot):
        return str(robot)
    return robot.name if is_built_in(robot.name) and load_robot(robot.name).file == robot.file else str(robot.file)


def guess_robot_settings(urdf: str | Path, *, up: Literal["z", "y"] = "z") -> RobotSettings:
    """Return the settings that `load_robot` guesses for a URDF without a ``robot.toml``.

    Raises:
        InputError: There is no such file.
        FormatError: The file is not a usable URDF.
    """
    read, sure = with_stand_ins(_read(Path(urdf)))
    return GUESSES.get("settings")(_robot(read, RobotSettings(), up), sure, fold=not read.has_posture)


def robot_digest(name_or_path: str | Path) -> str:
    """Return the SHA-256 of a robot's files as 64 hex digits; empty for a built-in robot, which its name describes.

    Its parts are the bytes of the URDF, those of its ``robot.toml``, and those of each mesh, in the order of their paths.
    Before each part comes its length [bytes] as int64, little-endian; -1 stands for a file that does not exist.

    Raises:
        InputError: There is no such robot.
        FormatError: Its URDF cannot be used.
    """
    if is_built_in(name_or_path):
        return ""
    files = find_robot(name_or_path)
    parts = (*files, *_meshes_of(files.urdf, _version(files.urdf)))
    return _digest_of(*((file, _version(file)) for file in parts))


@lru_cache(maxsize=32)
def _meshes_of(urdf: Path, version: tuple[int, int]) -> tuple[Path, ...]:
    del version  # only part of the key: a changed file is read again
    reader = _reader(urdf)
    if reader is not None:
        return tuple(reader.files(urdf)[1:])
    return tuple(mesh_files(read_urdf(urdf, allow_missing=True, warn=False).links))


@lru_cache(maxsize=32)
def _digest_of(*parts: tuple[Path | None, tuple[int, int]]) -> str:
    """Return a digest of files and their versions, so that only changed files are read again."""
    digest = hashlib.sha256()
    for file, _ in parts:
        data = file.read_bytes() if file is not None and file.is_file() else None
        digest.update((-1 if data is None else len(data)).to_bytes(8, "little", signed=True))
        digest.update(data or b"")
    return digest.hexdigest()


def check_robot(name_or_path: str | Path, sha256: str, *, agent: str) -> None:
    """Raise an InputError unless the recorded robot of ``agent`` exists and has the recorded digest (`robot_digest`).

    An empty ``sha256`` (built-in robots, recordings made before there were digests) allows any robot.
    """
    if not sha256:
        return
    try:
        found = robot_digest(name_or_path)
    except H3DataError as error:
        raise InputError(
            f"Agent {agent!r} was recorded with the robot {str(name_or_path)!r} (SHA-256 {sha256}), which cannot be read "
            f"from here: put its folder back at that path, or run from the folder that the path starts from. Cause: {error}",
            code="H3-BODY-108",
        ) from error
    if found != sha256:
        raise InputError(
            f"The robot {str(name_or_path)!r} of agent {agent!r} has changed since it was recorded: expected SHA-256 "
            f"{sha256}, got {found or 'a built-in robot'}. Hint: put back its URDF, robot.toml and meshes of then, or record "
            "the episode again.",
            code="H3-BODY-107",
        )


@lru_cache(maxsize=32)
def _loaded(files: RobotFiles, up: Literal["z", "y"], fill_in: bool, *versions: tuple[int, int]) -> Robot:
    del versions  # only part of the key: changed files are read again
    read = _read(files.urdf, allow_missing=fill_in)
    urdf, sure = with_stand_ins(read) if fill_in else (read, frozenset[str]())
    if fill_in and files.settings is None:
        settings = GUESSES.get("settings")(_robot(urdf, RobotSettings(), up), sure, fold=not urdf.has_posture)
    else:
        settings = read_settings(files.settings, urdf)
    robot = _robot(urdf, settings, up)
    return robot if len(robot.hull_discs) else replace(robot, hull_discs=resting_hull(robot))


def _version(path: Path | None) -> tuple[int, int]:
    """Return the time stamp [ns] and the size of a file; zeros if there is none."""
    # not a digest of the contents: robots are asked for at every reset
    if path is None or not path.is_file():
        return 0, 0
    status = path.stat()
    return status.st_mtime_ns, status.st_size


def _read(path: Path, *, allow_missing: bool = True) -> Urdf:
    """Return the description of a robot, in URDF or in a format of `READERS`."""
    reader = _reader(path)
    return read_urdf(path, allow_missing=allow_missing) if reader is None else reader.read(path)


def _reader(path: Path) -> RobotReader | None:
    """Return the reader of a file by its suffix; None for URDF."""
    suffix = path.suffix.lower()
    return READERS.get(suffix[1:]) if suffix in DESCRIPTIONS[1:] else None


# --- building ---------------------------------------------------------------------------------------------------------
def _robot(urdf: Urdf, settings: RobotSettings, up: Literal["z", "y"]) -> Robot:
    order = _parents_first(urdf)
    index = {link.name: k for k, link in enumerate(order)}
    above: dict[str, UrdfJoint] = {j.child: j for j in urdf.joints}
    joints = [above.get(link.name) for link in order]
    names, lower, upper, rest, moves = [], [], [], [], []
    column: dict[str, int] = {}
    for joint in urdf.movable:
        column[joint.name] = len(names)
        ball = joint.kind == "spherical"
        names += [f"{joint.name}.{part}" for part in "xyzw"] if ball else [joint.name]
        lower += [-1.0] * 4 if ball else [joint.lower]
        upper += [1.0] * 4 if ball else [joint.upper]
        # zero may be outside the limits, as of knees that never get straight
        rest += [0.0, 0.0, 0.0, 1.0] if ball else [min(max(urdf.rest.get(joint.name, 0.0), joint.lower), joint.upper)]
        moves += [index[joint.child]] * joint.width
    # a follower reads the column of its leader
    leaders = [None if j is None else j.mimic for j in joints]
    # numbers of `kinematics`, which would import numba: robots can be read without it
    kinds = {"fixed": 0, "revolute": 1, "continuous": 1, "prismatic": 2, "spherical": 3}
    # URDF base frame (x forward, y left, z up) to agent root axes (x forward, y up, z right)
    to_base = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]) if up == "z" else np.eye(4)
    to_base[1, 3] = settings.base_height_m
    return Robot(
        name=urdf.name,
        file=urdf.path,
        links=tuple(
            _robot_link(link, -1 if j is None else index[j.parent]) for link, j in zip(order, joints, strict=True)
        ),
        joint_names=tuple(names),
        rest=np.array(settings.rest or rest, np.float64),
        lower=np.array(lower, np.float64),
        upper=np.array(upper, np.float64),
        joint_links=np.array(moves, np.int64),
        base_height_m=settings.base_height_m,
        body_height_m=settings.body_height_m,
        base_discs=np.array(settings.base_discs_m, np.float64),
        base_profiles={name: np.array(places) for name, places in settings.base_profiles.items()},
        base_radius_m=settings.base_radius_m,
        hull_discs=np.array(settings.hull_discs_m, np.float64),
        max_speed_mps=settings.max_speed_mps,
        max_turn_rad_s=settings.max_turn_rad_s,
        hand_link=index[settings.hand_link] if settings.hand_link else -1,
        hand_position=np.array(settings.hand_position),
        hand_axes=_hand_axes(settings),
        reach_bearing=None if settings.reach_bearing_deg is None else np.radians(settings.reach_bearing_deg),
        legs=tuple(
            RobotLeg(
                columns=(column[leg.joints[0]], column[leg.joints[1]], column[leg.joints[2]]), foot=np.array(leg.foot)
            )
            for leg in settings.legs
        ),
        climbs_stairs=bool(settings.legs) if settings.climbs_stairs is None else settings.climbs_stairs,
        cameras=tuple(_camera(c, index[c.link]) for c in settings.cameras),
        to_base=to_base,
        origins=np.stack([np.eye(4) if j is None else j.origin for j in joints]).astype(np.float64),
        axes=np.stack([np.array([1.0, 0, 0]) if j is None else j.axis for j in joints]).astype(np.float64),
        kinds=np.array([0 if j is None else kinds[j.kind] for j in joints], np.int64),
        columns=np.array(
            [0 if j is None else column.get(m.joint if m else j.name, 0) for j, m in zip(joints, leaders, strict=True)],
            np.int64,
        ),
        gains=np.array([1.0 if m is None else m.multiplier for m in leaders]),
        offsets=np.array([0.0 if m is None else m.offset for m in leaders]),
    )


def _parents_first(urdf: Urdf) -> list[UrdfLink]:
    links = {link.name: link for link in urdf.links}
    below: dict[str, list[str]] = {}
    for joint in urdf.joints:
        below.setdefault(joint.parent, []).append(joint.child)
    # depth first in the order of the file; parents first, because kinematics goes through them once
    order, waiting = [], [urdf.root]
    while waiting:
        name = waiting.pop()
        order.append(links[name])
        waiting += reversed(below.get(name, []))
    return order


def _robot_link(link: UrdfLink, parent: int) -> RobotLink:
    meshes = [_visual(part) for part in link.visuals]
    if any(mesh.normals is not None for mesh in meshes):  # `joined` would drop those of the others
        meshes = [flat_shaded(mesh) if mesh.normals is None else mesh for mesh in meshes]
    shapes = tuple(_shape(part) for part in link.collisions)
    return RobotLink(
        name=link.name, parent=parent, mesh=joined(meshes) if meshes else None, shapes=shapes, inertial=link.inertial
    )


def _visual(part: UrdfPart) -> Mesh:
    g = part.geometry
    color = part.color or DEFAULT_COLOR
    match g.kind:
        case "box":
            return moved(flat_shaded(box_mesh(np.array(g.size) / 2, color=color)), part.origin)
        case "mesh":
            mesh = _mesh_of(part)
            return moved(mesh if part.color is None else painted(mesh, part.color), part.origin, g.scale)
        case kind:
            return moved(round_mesh(g.radius, g.length, color, caps=kind != "cylinder"), part.origin)


def _mesh_of(part: UrdfPart) -> Mesh:
    if part.geometry.mesh is not None:
        return part.geometry.mesh
    assert part.geometry.file is not None
    return load_mesh(part.geometry.file)


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
            from scipy.spatial import ConvexHull, QhullError

            points = moved(_mesh_of(part), origin, g.scale).vertices.astype(np.float64)
            try:
                return Hull(points=points[ConvexHull(points).vertices])
            except QhullError:  # flat: all its points are as good
                return Hull(points=np.unique(points, axis=0))
        case _:
            along = origin[:3, 2] * g.length / 2
            return Capsule(start=origin[:3, 3] - along, end=origin[:3, 3] + along, radius=g.radius)


def _hand_axes(settings: RobotSettings) -> Array:
    forward = normalized(np.array(settings.hand_forward))
    left = normalized(np.cross(settings.hand_up, forward))
    return np.stack([forward, left, np.cross(forward, left)], axis=1)


def _camera(settings: CameraSettings, link: int) -> RobotCamera:
    forward = normalized(np.array(settings.forward))
    right = normalized(np.cross(forward, np.array(settings.up)))
    pose = np.eye(4)
    # axes of OpenCV: right, down, forward
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


# --- boxes for missing meshes -----------------------------------------------------------------------------------------
def with_stand_ins(urdf: Urdf) -> tuple[Urdf, frozenset[str]]:
    """Replace missing meshes of a URDF by boxes; return it with the names of the links that needed no replacement.

    A warning names the missing files. If no link has collision shapes, the visual shapes replace them.
    """
    missing = missing_meshes(urdf.links)
    if missing:
        named = ", ".join(str(path) for path in missing[:3]) + (", ..." if len(missing) > 3 else "")
        logging.getLogger(__name__).warning(
            "%s: boxes stand in for %d missing mesh file(s) (%s). Hint: keep the folder of the URDF whole. File: %s",
            *(urdf.name, len(missing), named, urdf.path),
        )
    there = [
        tuple(tuple(p for p in parts if p.geometry.file not in missing) for parts in (link.visuals, link.collisions))
        for link in urdf.links
    ]
    # where no link has any, what is seen is also what touches
    has_collisions = any(link.collisions for link in urdf.links)
    links = []
    for link, (visuals, collisions) in zip(urdf.links, there, strict=True):
        box = (_box(urdf, link),) if link.visuals or link.collisions else ()
        # a link whose files are all there stays as it is, also without any: frames have no shape
        shown = visuals if len(visuals) == len(link.visuals) else visuals or collisions or box
        solid = collisions if len(collisions) == len(link.collisions) else collisions or visuals or box
        links.append(replace(link, visuals=shown, collisions=solid if has_collisions else shown))
    sure = frozenset(link.name for link, (_, solid) in zip(urdf.links, there, strict=True) if solid == link.collisions)
    return replace(urdf, links=tuple(links)), sure


def _box(urdf: Urdf, link: UrdfLink) -> UrdfPart:
    ends = [joint.origin[:3, 3] for joint in urdf.joints if joint.parent == link.name]
    # distance of a joint beyond which a child is a sensor or a frame on the floor rather than the end of the
    # link [m]
    reach_m = 0.6
    points = [np.zeros(3), *(end for end in ends if np.linalg.norm(end) <= reach_m)]
    # limited, since moments that somebody made up may mean a box of many metres
    if link.inertia_box is not None:
        corners = np.array(np.meshgrid(*[(-half, half) for half in np.minimum(link.inertia_box, reach_m)])).reshape(
            3, -1
        )
        points += list((link.inertial[:3, :3] @ corners).T + link.inertial[:3, 3])
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    # 0.04: least side of a box
    spare = np.maximum(0.04 - (high - low), 0.0) / 2
    low, high = low - spare, high + spare
    origin = np.eye(4)
    origin[:3, 3] = (low + high) / 2
    x, y, z = (high - low).tolist()
    # the first colour of the visuals that are missing, so that the robot keeps its look
    color = next((part.color for part in link.visuals if part.color is not None), None)
    return UrdfPart(geometry=UrdfGeometry(kind="box", size=(x, y, z)), origin=origin, color=color)


def resting_bounds(robot: Robot) -> NDArray[np.float64]:
    """Return the lower and upper corners [S, 2, 3] [m] of all collision shapes of a resting robot, in its root frame."""
    frames = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0]
    bounds = [shape_bounds(shape, frames[k]) for k, link in enumerate(robot.links) for shape in link.shapes]
    return np.array(bounds).reshape(-1, 2, 3)


def resting_hull(robot: Robot) -> Array:
    """Return positions along x [H] [m] of discs of the base's radius that cover the whole resting robot and its base discs."""
    bounds, radius = resting_bounds(robot), robot.base_radius_m
    back, front = float(robot.base_discs.min()), float(robot.base_discs.max())
    # discs cover a radius beyond their places
    if len(bounds):
        back, front = min(back, bounds[:, 0, 0].min() + radius), max(front, bounds[:, 1, 0].max() - radius)
    # distance between two discs of a row, in radii: between them the row is 71% as wide as a disc
    spacing = 1.4
    # less a little, so that rounding does not add a disc
    gaps = math.ceil((front - back) / (spacing * radius) - 1e-9)
    return np.linspace(back, front, gaps + 1) if gaps > 0 else np.array([(back + front) / 2])


def row_radius(places: Array, points: Array) -> float:
    """Return the smallest radius [m] of discs at positions [D] [m] along x that cover floor points ``(x, z)`` [N, 2] [m]."""
    return float(np.hypot(points[:, None, 0] - places, points[:, None, 1]).min(1).max())
