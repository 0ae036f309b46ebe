"""Elements of a URDF that stand for shapes: visual and collision geometry, origins, colours, mesh paths."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".stl", ".ply", ".dae", ".off")
"""Kinds of files that a URDF may name; nothing else is ever opened for it."""
MAX_PATH = 1024
PLANE_SIDE_M = 30.0
PLANE_THICKNESS_M = 0.1


@dataclass
class UrdfIssues:
    """Everything found wrong while a URDF is read."""

    faults: list[str] = field(default_factory=list)
    """Reasons to refuse the file."""
    warnings: list[str] = field(default_factory=list)
    """Deviations that have one usual reading, which was taken."""


@dataclass(frozen=True, kw_only=True)
class UrdfGeometry:
    """One shape. ``box`` uses ``size``; ``cylinder`` and ``capsule`` lie along z with ``radius`` and ``length`` (a capsule's
    caps come on top of its length, as in Bullet); ``sphere`` has a ``radius``; ``mesh`` a ``file`` and a ``scale``. Bullet's
    endless ``plane`` is read as a ``box`` of `PLANE_SIDE_M` whose top it is."""

    kind: Literal["box", "cylinder", "capsule", "sphere", "mesh"]
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.0
    length: float = 0.0
    file: Path | None = None
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class UrdfPart:
    """A visual or collision element of a link."""

    geometry: UrdfGeometry
    origin: Array
    """Geometry to link frame, shape [4, 4]."""
    color: tuple[int, int, int] | None = None
    """sRGB of the material, if it has one."""


def read_numbers(
    text: str | None, count: int, default: tuple[float, ...], where: str, issues: UrdfIssues
) -> tuple[float, ...]:
    """Returns ``count`` numbers from an attribute, or ``default`` where it is missing or blank.

    Vectors with more numbers than that lose the rest, with a warning: Bullet, whose own robots have such files, reads them so.
    """
    if text is None or not text.strip():
        return default
    try:
        values = tuple(float(v) for v in text.replace(",", " ").split())  # some files of Habitat's have commas
    except ValueError:
        values = ()
    if len(values) > count > 1:
        issues.warnings.append(
            f"{where}: expected {count} numbers, got {len(values)} ({text[:40]}), the rest is ignored"
        )
        values = values[:count]
    if len(values) != count or not all(np.isfinite(values)):
        issues.faults.append(f"{where}: expected {count} finite number(s), got {text[:40]!r}")
        return default
    return values


def read_origin(element: ElementTree.Element | None, where: str, issues: UrdfIssues) -> Array:
    """4x4 of ``<origin xyz rpy>``: fixed-axis roll, pitch, yaw, so R = Rz(yaw) Ry(pitch) Rx(roll)."""
    matrix = np.eye(4)
    origin = None if element is None else element.find("origin")
    if origin is None:
        return matrix
    zero = (0.0, 0.0, 0.0)
    matrix[:3, 3] = read_numbers(origin.get("xyz"), 3, zero, f"{where}, origin xyz", issues)
    roll, pitch, yaw = read_numbers(origin.get("rpy"), 3, zero, f"{where}, origin rpy", issues)
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    matrix[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return matrix


def read_inertia(element: ElementTree.Element | None) -> NDArray[np.float64] | None:
    """Returns half the sides [3] [m] of the solid box with the mass and the moments of inertia of ``<inertial>``, in its own
    frame; None without them, or if they cannot be read: they only help to guess sizes.

    From I_x = m (b^2 + c^2) / 12, and so on, for a box of sides a, b, c.
    """
    ignored = UrdfIssues()
    mass_element = None if element is None else element.find("mass")
    inertia = None if element is None else element.find("inertia")
    if mass_element is None or inertia is None:
        return None
    (mass,) = read_numbers(mass_element.get("value"), 1, (0.0,), "mass", ignored)
    ix, iy, iz = (read_numbers(inertia.get(name), 1, (0.0,), name, ignored)[0] for name in ("ixx", "iyy", "izz"))
    differences = np.array([iy + iz - ix, ix + iz - iy, ix + iy - iz])
    if mass <= 0 or differences.min() < -0.05 * max(ix, iy, iz):  # no body has such moments: a place-holder
        return None
    return np.sqrt(np.maximum(6 / mass * differences, 0.0)) / 2


def read_color(element: ElementTree.Element | None, issues: UrdfIssues) -> tuple[int, int, int] | None:
    if element is None:
        return None
    values = read_numbers(element.get("rgba"), 4, (0.5, 0.5, 0.5, 1.0), "color", issues)
    red, green, blue = (int(round(255 * min(max(v, 0.0), 1.0))) for v in values[:3])
    return red, green, blue


def read_parts(
    link: ElementTree.Element, tag: str, folder: Path, materials: dict[str, tuple[int, int, int]], issues: UrdfIssues
) -> Iterator[UrdfPart]:
    for element in link.findall(tag):
        where = f"link {link.get('name')}, {tag}"
        geometry = _geometry(element.find("geometry"), folder, where, issues)
        if geometry is None:
            continue
        origin = read_origin(element, where, issues)
        plane = element.find("geometry/plane")
        if plane is not None:
            origin = origin @ _plane_frame(plane, where, issues)
        material = element.find("material")
        color = None
        if material is not None:
            color = read_color(material.find("color"), issues) or materials.get(material.get("name", ""))
        yield UrdfPart(geometry=geometry, origin=origin, color=color)


def _geometry(element: ElementTree.Element | None, folder: Path, where: str, issues: UrdfIssues) -> UrdfGeometry | None:
    shape = None if element is None or not len(element) else element[0]
    if shape is None:
        issues.faults.append(f"{where}: it has no geometry")
        return None

    def number(name: str) -> float:
        value = read_numbers(shape.get(name), 1, (0.0,), f"{where}, {name}", issues)[0]
        if value < 0:
            issues.faults.append(f"{where}, {name}: expected no negative number, got {value:g}")
        return value

    match shape.tag:
        case "box":
            x, y, z = read_numbers(shape.get("size"), 3, (0.0, 0.0, 0.0), f"{where}, size", issues)
            if min(x, y, z) < 0:
                issues.faults.append(f"{where}, size: expected no negative numbers, got {x:g} {y:g} {z:g}")
            return UrdfGeometry(kind="box", size=(x, y, z))
        case "sphere":
            return UrdfGeometry(kind="sphere", radius=number("radius"))
        case "cylinder":
            return UrdfGeometry(kind="cylinder", radius=number("radius"), length=number("length"))
        case "capsule":
            return UrdfGeometry(kind="capsule", radius=number("radius"), length=number("length"))
        case "plane":
            return UrdfGeometry(kind="box", size=(PLANE_SIDE_M, PLANE_SIDE_M, PLANE_THICKNESS_M))
        case "mesh":
            sx, sy, sz = read_numbers(shape.get("scale"), 3, (1.0, 1.0, 1.0), f"{where}, scale", issues)
            if not (sx and sy and sz):
                issues.faults.append(f"{where}, scale: expected no zero, got {sx:g} {sy:g} {sz:g}")
            file = _mesh_path(shape.get("filename", ""), folder, where, issues)
            return UrdfGeometry(kind="mesh", file=file, scale=(sx, sy, sz))
    issues.faults.append(f"{where}: expected box, cylinder, sphere, capsule, plane or mesh, got {shape.tag}")
    return None


def _plane_frame(element: ElementTree.Element, where: str, issues: UrdfIssues) -> Array:
    """Frame of the box [4, 4] whose top stands in for ``<plane normal>``."""
    normal = np.array(read_numbers(element.get("normal"), 3, (0.0, 0.0, 1.0), f"{where}, normal", issues))
    if not normal.any():
        issues.faults.append(f"{where}, normal: expected a direction, got zeros")
        return np.eye(4)
    up = normal / np.linalg.norm(normal)
    side = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([side / np.linalg.norm(side), np.cross(up, side / np.linalg.norm(side)), up], axis=1)
    frame[:3, 3] = -up * PLANE_THICKNESS_M / 2
    return frame


def _mesh_path(filename: str, folder: Path, where: str, issues: UrdfIssues) -> Path | None:
    """Where a mesh lies: relative to the URDF; of ``package://name/rest`` the rest is tried here and two folders up.

    Two folders up is also as far as a path may climb, and it must end as meshes do. An absolute path, which some other
    machine had, is looked for beside the URDF by the file's name alone.
    """
    scheme, _, rest = filename[:MAX_PATH].rpartition("://")
    above = list(Path(os.path.abspath(folder)).parents)[:2]
    above = [p for p in above if p != p.parent] or [Path(os.path.abspath(folder))]  # never the root of the disk
    file = folder / rest
    if scheme == "package":
        rest = rest.partition("/")[2]
        file = next((base / rest for base in (folder, *above) if (base / rest).is_file()), folder / rest)
    elif not Path(os.path.abspath(file)).is_relative_to(above[-1]) and Path(rest).is_absolute():
        file = folder / Path(rest).name
        issues.warnings.append(
            f"{where}: {filename[:80]!r} is a path of another machine, expected {file.name} beside the URDF"
        )
    fault = None
    if scheme not in ("", "file", "package"):
        fault = "expected the path of a file"
    elif len(filename) > MAX_PATH:
        fault = f"expected at most {MAX_PATH} characters"
    elif not Path(os.path.abspath(file)).is_relative_to(above[-1]):
        fault = "expected a path that climbs at most two folders above the URDF"
    elif not filename.lower().endswith(MESH_SUFFIXES):
        fault = f"expected one of {', '.join(MESH_SUFFIXES)}"
    if fault is None:
        return file
    issues.faults.append(f"{where}, filename: {fault}, got {filename[:80]!r}")
    return None
