"""Habitat's articulated objects, which are URDFs whose links are posed by the initial joint positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError
from h3data.geometry import normalized, pose_from_matrix, pose_multiply, quat_from_matrix
from h3data.mesh.loading import frame_rotation, load_mesh
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import joined, painted
from h3data.scene.records import Box, Capsule, Cylinder, Hull, Shape
from h3data_habitat.scenes.config_values import flag, mapping

if TYPE_CHECKING:
    from h3data.bodies.robots.robot import Robot
    from h3data.bodies.robots.urdf import UrdfLink

_BALL = 3
_AXES = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """Appearance and collision shapes of a link, in a frame whose +Y is near the world's at joint positions 0."""

    name: str
    index: int
    mesh: Mesh
    shapes: tuple[Shape, ...]
    turn: NDArray[np.float64]
    """Rotation from the URDF link frame to the frame of this link, shape [3, 3]."""


def read_links(urdf: Path) -> tuple[Robot, tuple[Link, ...]]:
    """Return the kinematic tree of a URDF file and its visible or colliding links.

    Raises:
        FormatError, SceneError: the file, or a mesh that it names, cannot be used.
    """
    from h3data.bodies import load_robot
    from h3data.bodies.robots.urdf import read_urdf

    robot = load_robot(urdf, up="y", fill_in=False)
    described = {link.name: link for link in read_urdf(urdf, warn=False).links}  # `load_robot` has warned
    frames = link_frames(robot, default_positions(robot))
    links = []
    for index, link in enumerate(robot.links):
        if link.mesh is not None or link.shapes:
            turn = _upright(frames[index, :3, :3])
            links.append(
                Link(
                    name=link.name,
                    index=index,
                    mesh=_moved(_textured(described[link.name]) or link.mesh or empty_mesh(), turn),
                    shapes=tuple(_turned_shape(s, turn) for s in link.shapes),
                    turn=turn,
                )
            )
    return robot, tuple(links)


def link_frames(robot: Robot, positions: NDArray[np.float64], *, scale: float = 1.0) -> NDArray[np.float64]:
    """Return the URDF link frames in the frame of the base link, [L, 4, 4], of a robot that is scaled as a whole.

    Args:
        robot: The tree.
        positions: Joint positions, shape [J] [rad or m]; metres are not scaled.
        scale: Factor on all lengths of the URDF.
    """
    slides = robot.kinds[robot.joint_links] == 2
    # frames are scaled as a whole at the end, and positions in metres must not be
    given = np.where(slides, positions / scale, positions)
    here = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
    frames = np.linalg.inv(robot.to_base) @ robot.link_matrices(here, given[None])[0]
    frames[:, :3, 3] *= scale
    return frames


def pose_of_links(
    robot: Robot, base: NDArray[np.float64], frames: NDArray[np.float64], *, scale: float
) -> NDArray[np.float64]:
    """Return world matrices [L, 4, 4] of URDF link frames.

    ``base`` [4, 4] is the centre of mass of the base link, as Habitat gives the pose of an articulated object
    (habitat-findings, "what habitat-sim itself does" 2).
    """
    inertial = np.array(robot.links[0].inertial, np.float64)
    inertial[:3, 3] *= scale
    return base @ np.linalg.inv(inertial) @ frames


def default_positions(robot: Robot) -> NDArray[np.float64]:
    """Return joint positions that are all 0, with spherical joints unrotated, shape [J]."""
    positions = np.zeros(len(robot.joint_names))
    positions[robot.columns[robot.kinds == _BALL] + 3] = 1.0
    return positions


def joint_order(robot: Robot, link_order: str) -> NDArray[np.int64]:
    """Return the columns of the joint positions in the order in which habitat-sim numbers them, shape [J].

    ``urdf_order`` is that of the file; else ("tree_traversal") depth first, children by the name of their link.
    """
    if link_order == "urdf_order":
        return np.arange(len(robot.joint_names))
    children: dict[int, list[int]] = {}
    for index, link in enumerate(robot.links):
        children.setdefault(link.parent, []).append(index)
    order: list[int] = []
    waiting = list(children.get(-1, ()))
    while waiting:
        here = waiting.pop()
        order += np.flatnonzero(robot.joint_links == here).tolist()
        # reversed, as the last one is taken first
        waiting += sorted(children.get(here, ()), key=lambda k: robot.links[k].name, reverse=True)
    return np.array(order, np.int64)


def initial_positions(
    robot: Robot, entry: Mapping[str, Any], *, link_order: str, where: Path
) -> tuple[NDArray[np.float64], list[str]]:
    """Return the joint positions [J] of an instance's ``initial_joint_pose``, and warnings.

    A list is in the order of `joint_order`. An object maps names of joints to values; if a name is not that of a joint,
    the values are taken as a list in the order of the names, which is what habitat-sim does in any case.
    """
    positions, order = default_positions(robot), joint_order(robot, link_order)
    warnings: list[str] = []
    given = entry.get("initial_joint_pose")
    # habitat-sim goes by the order of the values, even where they have names
    values = _values(given, where)
    if len(values) > len(order):
        warnings.append(
            f"{len(values)} initial joint positions are given, {robot.name!r} has {len(order)}: the rest is left out"
        )
    positions[order[: len(values)]] = values[: len(order)]
    if isinstance(given, dict) and set(given) <= set(robot.joint_names):
        named = default_positions(robot)
        named[[robot.joint_names.index(name) for name in given]] = list(given.values())
        if not np.array_equal(named, positions):
            warnings.append(f"initial joint positions of {robot.name!r} go by name; habitat-sim goes by their order")
        positions = named
    for column in robot.columns[robot.kinds == _BALL]:
        # zeros, as exporters write them, mean unturned
        quat = positions[column : column + 4]
        if not np.any(quat):
            quat[3] = 1.0
        positions[column : column + 4] = normalized(quat)
    if flag(entry, "auto_clamp_joint_limits", False, where=where):
        positions = np.clip(positions, robot.lower, robot.upper)
    return positions, warnings


def _values(given: Any, where: Path) -> list[float]:
    values = [given[k] for k in sorted(given)] if isinstance(given, dict) else given or []
    fine = isinstance(values, list) and all(isinstance(v, int | float) and abs(v) < 1e6 for v in values)
    if not fine:
        raise FormatError(
            f"Expected numbers, in a list or by name, under 'initial_joint_pose', got {str(given)[:60]}: {where}",
            code="H3-HABITAT-110",
        )
    return [float(v) for v in values]


def receptacles_by_link(user_defined: Mapping[str, Any], *, where: Path) -> dict[str, dict[str, Any]]:
    """Return entries of ``user_defined`` that name the link on which they lie (``parent_link``), by link."""
    found: dict[str, dict[str, Any]] = {}
    for key in user_defined:
        if key.startswith("receptacle_"):
            entry = mapping(user_defined, key, where=where)
            found.setdefault(str(entry.get("parent_link", "")), {})[key] = entry
    return found


# --- turning a link so that its +Y points up --------------------------------------------------------------------------
def _upright(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation by right angles after which +Y of a link frame is nearest to the +Y of ``rotation``'s target."""
    # right angles only: boxes along the axes stay boxes along the axes
    up = _nearest(rotation.T @ [0, 1, 0], _AXES)
    if up[1] > 0:
        return np.eye(3)
    front = _nearest(rotation.T @ [0, 0, -1], _AXES[np.abs(_AXES @ up) < 0.5])
    return frame_rotation(up, front)


def _nearest(direction: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    return axes[int(np.argmax(axes @ direction))]


def _textured(link: UrdfLink) -> Mesh | None:
    """Return the looks of a link with the textures of its files, in its frame; None if not all of them are files."""
    parts = link.visuals
    if not parts or any(p.geometry.file is None for p in parts):
        return None
    meshes = []
    for part in parts:
        assert part.geometry.file is not None
        mesh = load_mesh(part.geometry.file)
        mesh = mesh if part.color is None else painted(mesh, part.color)
        meshes.append(_moved(mesh, part.origin[:3, :3], part.origin[:3, 3], part.geometry.scale))
    return joined(meshes)


def _moved(
    mesh: Mesh,
    rotation: NDArray[np.floating],
    shift: NDArray[np.floating] | Sequence[float] = (0, 0, 0),
    scale: Sequence[float] = (1, 1, 1),
) -> Mesh:
    """Return the mesh scaled along its own axes, turned, and shifted."""
    stretch = np.asarray(scale, np.float64)
    normals = None
    if mesh.normals is not None:
        # normals stretch by the inverse
        normals = normalized((mesh.normals / stretch) @ rotation.T).astype(np.float32)
    vertices = (mesh.vertices * stretch) @ rotation.T + shift
    faces = mesh.faces if np.prod(stretch) > 0 else np.ascontiguousarray(mesh.faces[:, ::-1])
    return replace(mesh, vertices=vertices.astype(np.float32), faces=faces, normals=normals)


def empty_mesh() -> Mesh:
    """Return an empty mesh, for invisible collision shapes."""
    none = np.zeros((0, 3), np.float32)
    return Mesh(vertices=none, faces=none.astype(np.int32), colors=none.astype(np.uint8))


def _turned_shape(shape: Shape, turn: NDArray[np.float64]) -> Shape:
    pose = np.concatenate([np.zeros(3), quat_from_matrix(turn)])
    if isinstance(shape, Hull):
        return Hull(points=np.asarray(shape.points) @ turn.T)
    if isinstance(shape, Capsule):
        return Capsule(start=turn @ shape.start, end=turn @ shape.end, radius=shape.radius)
    moved = pose_multiply(pose, shape.pose).astype(np.float64)
    if isinstance(shape, Box):
        return Box(pose=moved, half_extents=shape.half_extents)
    return Cylinder(pose=moved, radius=shape.radius, half_height=shape.half_height)


def link_pose(matrix: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose (pose7) of a `Link` whose URDF frame is at ``matrix`` [4, 4]."""
    back = np.eye(4)
    # the mesh was turned, so its frame is turned back
    back[:3, :3] = turn.T
    return pose_from_matrix(matrix @ back).astype(np.float64)
