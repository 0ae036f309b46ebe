"""Export of opening furniture as Habitat's articulated objects (URDF, ``ao_config``, scene instance entry).

All frames of the URDF have the axes of the thing (Y-up, as habitat-sim takes them), with every joint at 0; a part's frame is
on its axis. Meshes are written in the frame of their link, scale included.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, normalized, pose_from_matrix, pose_to_matrix
from h3data.mesh.mesh import Mesh
from h3data.scene.articulation import joints_of, posed
from h3data.scene.records import Articulation, Box, Instance, Part, Receptacle, Scene, Shape, instance_matrix
from h3data_exporters.glb_write import glb_bytes
from h3data_habitat.scenes.colliders import part_mesh

_MASS = '<inertial><origin xyz="0 0 0"/><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
"""Element with a mass, which habitat-sim requires; things stand still all the same (``fixed_base``, ``KINEMATIC``)."""

ReceptacleEntry = Callable[[Receptacle, NDArray[np.float64], str], dict[str, Any]]


class ArticulatedExport:
    """Writer of the articulated objects of one dataset, which writes each template once."""

    def __init__(self, content: dict[str, bytes], entry: ReceptacleEntry, key: Callable[[str], str]) -> None:
        """Create a writer of files in ``content``, with functions ``entry`` and ``key`` that convert receptacles."""
        self._content, self._entry, self._key = content, entry, key

    def members(self, scene: Scene) -> set[str]:
        """Return the instances that become links, which are the bodies and moving parts of things that open."""
        by_name = {i.name: i for i in scene.instances}
        found = {thing.base for thing in scene.articulations if thing.base}
        moved = (name for thing in scene.articulations for part in thing.parts for name in part.instances)
        return found | {name for name in moved if by_name[name].motion == "static"}

    def add(self, scene: Scene, thing: Articulation, kind: str, semantic_id: int) -> tuple[str, dict[str, str]]:
        """Write the files of an articulated object of a scene, with its template.

        Returns:
            The handle of the template, and Habitat's names of its receptacles by ours. Habitat's names lack the name of the
            object.
        """
        joints = joints_of(scene)
        # a URDF describes its links at joint positions of 0, a scene at rest
        closed = posed(scene, np.zeros(len(joints)))
        at_zero = next(other for other in closed.articulations if other.name == thing.name)
        by_name = {i.name: i for i in closed.instances}
        frame = pose_to_matrix(np.asarray(thing.pose, np.float64))
        links, frames = {"": _free_name("base", thing)}, {"": np.eye(4)}
        for part in at_zero.parts:
            links[part.name], frames[part.name] = part.name, np.eye(4)
            frames[part.name][:3, 3] = part.joint.origin
        bodies: list[tuple[str, list[Instance]]] = [("", [by_name[thing.base]] if thing.base else [])]
        for part in at_zero.parts:
            own = [by_name[name] for name in part.instances]
            bodies.append((part.name, [i for i in own if i.motion == "static"]))
        text, files, entries, names = [], dict[str, bytes](), dict[str, Any](), dict[str, str]()
        for name, own in bodies:
            back = np.linalg.inv(frame @ frames[name])
            text += [f"  <link name={quoteattr(links[name])}>{_MASS}"]
            for instance in own:
                asset, local = closed.assets[instance.asset], back @ instance_matrix(instance)
                if len(asset.mesh.faces):
                    file = _file(files, _moved(asset.mesh, local))
                    text.append(f'    <visual><geometry><mesh filename="{file}"/></geometry></visual>')
                text += [f"    <collision>{_geometry(files, s, local)}</collision>" for s in asset.shapes]
                for receptacle in asset.receptacles:
                    called = f"{links[name]}_{receptacle.name}"
                    entries[self._key(called)] = self._receptacle(receptacle, called, links[name], local)
                    names[f"{instance.name}|{receptacle.name}"] = called
            text.append("  </link>")
        limits = {part.name: (part.joint.lower, part.joint.upper) for part in thing.parts}
        text += [_joint(part, links, frames, limits[part.name]) for part in at_zero.parts]
        body = "\n".join(text)
        # equal things share one template
        digest = hashlib.sha256(json.dumps([body, entries, semantic_id], sort_keys=True).encode()).hexdigest()[:16]
        handle = f"{kind}_{digest}"
        urdf = f'<?xml version="1.0"?>\n<robot name="{handle}">\n{body}\n</robot>\n'
        config = {
            "urdf_filepath": f"{handle}.urdf",
            "render_mode": "link_visuals",
            "semantic_id": semantic_id,
            "user_defined": entries,
        }
        folder = f"urdf/{handle}"
        self._content |= {f"{folder}/{file}": data for file, data in files.items()}
        self._content[f"{folder}/{handle}.urdf"] = urdf.encode()
        self._content[f"{folder}/{handle}.ao_config.json"] = (
            json.dumps(config, indent=1, allow_nan=False) + "\n"
        ).encode()
        return handle, names

    def _receptacle(self, receptacle: Receptacle, name: str, link: str, local: Array) -> dict[str, Any]:
        # the scale of the instance, which links of a URDF have no place for
        size = np.linalg.norm(local[:3, :3], axis=0)
        entry = self._entry(receptacle, size, name)
        entry["position"] = (local[:3, :3] @ np.array(entry["position"]) + local[:3, 3]).tolist()
        x, y, z, w = _rotation(local)
        return {**entry, "rotation": [w, x, y, z], "parent_link": link}


def articulated_instance(thing: Articulation, handle: str) -> dict[str, Any]:
    """Return the entry of a scene instance that places a thing, its joints at rest."""
    x, y, z, w = normalized(thing.pose[3:]).tolist()
    return {
        "template_name": handle,
        "translation": np.asarray(thing.pose[:3], np.float64).tolist(),
        "rotation": [w, x, y, z],
        "fixed_base": True,
        "motion_type": "KINEMATIC",
        # a list, in the order in which habitat-sim numbers joints: depth first, children by the name of their link
        "initial_joint_pose": [float(part.joint.rest) for part in _depth_first(thing.parts)],
        "user_defined": {"h3data": {"name": thing.name}},
    }


def _depth_first(parts: Sequence[Part], parent: str = "") -> list[Part]:
    found = []
    for part in sorted((part for part in parts if part.parent == parent), key=lambda part: part.name):
        found += [part, *_depth_first(parts, part.name)]
    return found


def _free_name(name: str, thing: Articulation) -> str:
    while name in {part.name for part in thing.parts}:
        name += "_"
    return name


def _joint(part: Part, links: Mapping[str, str], frames: Mapping[str, Array], limits: tuple[float, float]) -> str:
    shift = frames[part.name][:3, 3] - frames[part.parent][:3, 3]
    return (
        f'  <joint name={quoteattr(part.name)} type="{part.joint.kind}">'
        f"<parent link={quoteattr(links[part.parent])}/><child link={quoteattr(links[part.name])}/>"
        f'<origin xyz="{_numbers(shift)}" rpy="0 0 0"/><axis xyz="{_numbers(part.joint.axis)}"/>'
        f'<limit lower="{limits[0]!r}" upper="{limits[1]!r}" effort="100" velocity="10"/></joint>'
    )


def _geometry(files: dict[str, bytes], shape: Shape, local: Array) -> str:
    """Return the origin and geometry of a collision part that ``local`` [4, 4] brings into the frame of its link."""
    size = np.linalg.norm(local[:3, :3], axis=0)
    # a box that is stretched and turned is none any more
    if isinstance(shape, Box) and (np.ptp(size) < 1e-9 or shape.pose[6] == 1):
        matrix = local @ pose_to_matrix(np.asarray(shape.pose, np.float64))
        full = 2 * np.asarray(shape.half_extents) * size
        at = f'<origin xyz="{_numbers(matrix[:3, 3])}" rpy="{_numbers(_rpy(matrix[:3, :3] / size))}"/>'
        return f'{at}<geometry><box size="{_numbers(full)}"/></geometry>'
    return f'<geometry><mesh filename="{_file(files, _moved(part_mesh(shape), local))}"/></geometry>'


def _file(files: dict[str, bytes], mesh: Mesh) -> str:
    data = glb_bytes([mesh])
    name = f"{hashlib.sha256(data).hexdigest()[:16]}.glb"
    files[name] = data
    return name


def _moved(mesh: Mesh, matrix: Array) -> Mesh:
    vertices = mesh.vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    normals = None
    if mesh.normals is not None:
        # by the inverse transpose, which keeps them upright on stretched faces
        normals = normalized(mesh.normals.astype(np.float64) @ np.linalg.inv(matrix[:3, :3])).astype(np.float32)
    # a mirror image is inside out
    faces = mesh.faces if np.linalg.det(matrix[:3, :3]) > 0 else np.ascontiguousarray(mesh.faces[:, ::-1])
    return replace(mesh, vertices=vertices.astype(np.float32), normals=normals, faces=faces)


def _rotation(matrix: Array) -> list[float]:
    rigid = matrix.copy()
    rigid[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)
    return pose_from_matrix(rigid)[3:].tolist()


def _rpy(turn: Array) -> NDArray[np.float64]:
    """Return the angles of URDF: about the fixed axes x, y, then z."""
    pitch = np.arctan2(-turn[2, 0], np.hypot(turn[0, 0], turn[1, 0]))
    if abs(turn[2, 0]) > 1 - 1e-9:  # x and z turn about the same axis: z stays
        return np.array([np.arctan2(-turn[1, 2], turn[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(turn[2, 1], turn[2, 2]), pitch, np.arctan2(turn[1, 0], turn[0, 0])])


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> str:
    # -0.0 becomes 0.0, so that equal things have equal files
    return " ".join(repr(float(v)) for v in np.round(np.asarray(values, np.float64), 12) + 0.0)
