"""URDF files as typed records: links, joints, visual and collision geometry. Frames stay URDF's own (x forward, z up).

A minimal reader on the standard library. Read: box, cylinder, sphere, capsule, mesh; revolute, continuous, prismatic and
fixed joints; origins, axes, limits, material colours, inertial origins. Left aside with a log line: mimic. Refused: xacro
(expand it first), DOCTYPE and entities (they can read other files or blow up), other joint types.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args
from xml.etree import ElementTree

import numpy as np

from h3data.errors import FormatError, InputError, MissingAssetError
from h3data.geometry import Array

log = logging.getLogger(__name__)

JointKind = Literal["revolute", "continuous", "prismatic", "fixed"]
MAX_BYTES = 16 << 20
"""Larger files are refused: no robot description is."""


@dataclass(frozen=True, kw_only=True)
class UrdfGeometry:
    """One shape. ``box`` uses ``size``; ``cylinder`` and ``capsule`` lie along z with ``radius`` and ``length`` (a capsule's
    caps come on top of its length, as in Bullet); ``sphere`` has a ``radius``; ``mesh`` a ``file`` and a ``scale``."""

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


@dataclass(frozen=True, kw_only=True, eq=False)
class UrdfLink:
    """A rigid body."""

    name: str
    visuals: tuple[UrdfPart, ...]
    collisions: tuple[UrdfPart, ...]
    inertial: Array
    """Centre-of-mass frame to link frame, shape [4, 4]; identity if the file gives none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class UrdfJoint:
    """What holds ``child`` to ``parent``."""

    name: str
    kind: JointKind
    parent: str
    child: str
    origin: Array
    """Joint frame (= the child's link frame at position 0) to parent link frame, shape [4, 4]."""
    axis: Array
    """Unit vector in the joint frame, shape [3]."""
    lower: float
    upper: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Urdf:
    """A kinematic tree. Links and joints are in the order of the file."""

    name: str
    path: Path
    root: str
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]

    @property
    def movable(self) -> tuple[UrdfJoint, ...]:
        """The joints that have a position, in the order of the file."""
        return tuple(j for j in self.joints if j.kind != "fixed")


def read_urdf(path: str | Path) -> Urdf:
    """The robot described by a URDF file; all faults are told at once."""
    path = Path(path)
    robot = _parse(path)
    faults: list[str] = []
    materials = {
        m.get("name", ""): color
        for m in robot.findall("material")
        if (color := _rgba(m.find("color"), faults)) is not None
    }
    links = tuple(_link(e, path.parent, materials, faults) for e in robot.findall("link"))
    joints = tuple(j for e in robot.findall("joint") if (j := _joint(e, faults)) is not None)
    root = _tree_root(links, joints, faults)
    if faults:
        raise FormatError(f"Not a usable URDF: {'; '.join(faults[:8])}. File: {path}")
    missing = sorted({str(f) for f in _mesh_files(links) if not f.is_file()})
    if missing:
        raise MissingAssetError(
            f"The URDF names {len(missing)} mesh file(s) that are not there. Hint: keep the folder of the URDF whole. "
            f"Missing: {', '.join(missing[:4])}"
        )
    return Urdf(name=robot.get("name", path.stem), path=path, root=root, links=links, joints=joints)


def _parse(path: Path) -> ElementTree.Element:
    if not path.is_file():
        raise InputError(f"Expected a URDF file, found none there: {path}")
    if path.stat().st_size > MAX_BYTES:
        raise FormatError(
            f"Expected a URDF of at most {MAX_BYTES >> 20} MiB, got {path.stat().st_size >> 20}. File: {path}"
        )
    text = path.read_bytes()
    if re.search(rb"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE) or b"\0" in text:
        raise FormatError(
            f"A URDF with a DOCTYPE, entities or UTF-16 is refused. Hint: save it as plain UTF-8. File: {path}"
        )
    try:
        robot = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise FormatError(f"Expected URDF, this is not well-formed XML ({error}). File: {path}") from error
    if robot.tag != "robot":
        raise FormatError(f"Expected URDF with the root element <robot>, got <{robot.tag}>. File: {path}")
    if any("xacro" in e.tag for e in robot.iter()):
        raise FormatError(f"This is xacro, not URDF. Hint: expand it first (xacro in.xacro > out.urdf). File: {path}")
    return robot


def _mesh_files(links: tuple[UrdfLink, ...]) -> Iterator[Path]:
    for link in links:
        for part in (*link.visuals, *link.collisions):
            if part.geometry.file is not None:
                yield part.geometry.file


def _numbers(
    text: str | None, count: int, default: tuple[float, ...], where: str, faults: list[str]
) -> tuple[float, ...]:
    if text is None:
        return default
    try:
        values = tuple(float(v) for v in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(np.isfinite(values)):
        faults.append(f"{where}: expected {count} finite number(s), got {text[:40]!r}")
        return default
    return values


def _origin(element: ElementTree.Element | None, where: str, faults: list[str]) -> Array:
    """4x4 of ``<origin xyz rpy>``: fixed-axis roll, pitch, yaw, so R = Rz(yaw) Ry(pitch) Rx(roll)."""
    matrix = np.eye(4)
    origin = None if element is None else element.find("origin")
    if origin is None:
        return matrix
    zero = (0.0, 0.0, 0.0)
    matrix[:3, 3] = _numbers(origin.get("xyz"), 3, zero, f"{where}, origin xyz", faults)
    roll, pitch, yaw = _numbers(origin.get("rpy"), 3, zero, f"{where}, origin rpy", faults)
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    matrix[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return matrix


def _rgba(element: ElementTree.Element | None, faults: list[str]) -> tuple[int, int, int] | None:
    if element is None:
        return None
    values = _numbers(element.get("rgba"), 4, (0.5, 0.5, 0.5, 1.0), "color", faults)
    red, green, blue = (int(round(255 * min(max(v, 0.0), 1.0))) for v in values[:3])
    return red, green, blue


def _link(
    element: ElementTree.Element, folder: Path, materials: dict[str, tuple[int, int, int]], faults: list[str]
) -> UrdfLink:
    name = element.get("name", "")
    if not name:
        faults.append("a link has no name")
    return UrdfLink(
        name=name,
        visuals=tuple(_parts(element, "visual", folder, materials, faults)),
        collisions=tuple(_parts(element, "collision", folder, materials, faults)),
        inertial=_origin(element.find("inertial"), f"link {name}, inertial", faults),
    )


def _parts(
    link: ElementTree.Element, tag: str, folder: Path, materials: dict[str, tuple[int, int, int]], faults: list[str]
) -> Iterator[UrdfPart]:
    for element in link.findall(tag):
        where = f"link {link.get('name')}, {tag}"
        geometry = _geometry(element.find("geometry"), folder, where, faults)
        if geometry is None:
            continue
        material = element.find("material")
        color = None
        if material is not None:
            color = _rgba(material.find("color"), faults) or materials.get(material.get("name", ""))
        yield UrdfPart(geometry=geometry, origin=_origin(element, where, faults), color=color)


def _geometry(element: ElementTree.Element | None, folder: Path, where: str, faults: list[str]) -> UrdfGeometry | None:
    shape = None if element is None or not len(element) else element[0]
    if shape is None:
        faults.append(f"{where}: it has no geometry")
        return None

    def number(name: str) -> float:
        return _numbers(shape.get(name), 1, (0.0,), f"{where}, {name}", faults)[0]

    match shape.tag:
        case "box":
            x, y, z = _numbers(shape.get("size"), 3, (0.0, 0.0, 0.0), f"{where}, size", faults)
            return UrdfGeometry(kind="box", size=(x, y, z))
        case "sphere":
            return UrdfGeometry(kind="sphere", radius=number("radius"))
        case "cylinder":
            return UrdfGeometry(kind="cylinder", radius=number("radius"), length=number("length"))
        case "capsule":
            return UrdfGeometry(kind="capsule", radius=number("radius"), length=number("length"))
        case "mesh":
            sx, sy, sz = _numbers(shape.get("scale"), 3, (1.0, 1.0, 1.0), f"{where}, scale", faults)
            file = _mesh_path(shape.get("filename", ""), folder)
            return UrdfGeometry(kind="mesh", file=file, scale=(sx, sy, sz))
    faults.append(f"{where}: expected box, cylinder, sphere, capsule or mesh, got {shape.tag}")
    return None


def _mesh_path(filename: str, folder: Path) -> Path:
    """Where a mesh lies: relative to the URDF; of ``package://name/rest`` the rest is tried here and two folders up."""
    if filename.startswith("package://"):
        rest = filename.removeprefix("package://").partition("/")[2]
        for base in (folder, *list(folder.resolve().parents)[:2]):
            if (base / rest).is_file():
                return base / rest
        return folder / rest
    return folder / filename.removeprefix("file://")


def _joint(element: ElementTree.Element, faults: list[str]) -> UrdfJoint | None:
    name, kind = element.get("name", ""), element.get("type", "")
    where = f"joint {name}"
    parent, child = element.find("parent"), element.find("child")
    known = get_args(JointKind)
    if kind not in known:
        faults.append(f"{where}: expected type {', '.join(known)}, got {kind!r}")
        return None
    if parent is None or child is None:
        faults.append(f"{where}: it needs <parent> and <child>")
        return None
    if element.find("mimic") is not None:
        log.warning("%s mimics another one: it is read as a joint of its own", where)
    axis_element, limit = element.find("axis"), element.find("limit")
    default = (1.0, 0.0, 0.0)
    axis = np.array(default if axis_element is None else _numbers(axis_element.get("xyz"), 3, default, where, faults))
    length = float(np.linalg.norm(axis))
    if length == 0:
        faults.append(f"{where}: its axis is zero")
    lower, upper = -np.inf, np.inf
    if limit is not None and kind != "continuous":
        lower, upper = (_numbers(limit.get(side), 1, (0.0,), where, faults)[0] for side in ("lower", "upper"))
        if lower > upper:
            faults.append(f"{where}: its lower limit {lower} is above the upper one {upper}")
    return UrdfJoint(
        name=name,
        kind=kind,  # pyright: ignore[reportArgumentType]  # one of the known ones, see above
        parent=parent.get("link", ""),
        child=child.get("link", ""),
        origin=_origin(element, where, faults),
        axis=axis / (length or 1.0),
        lower=lower,
        upper=upper,
    )


def _tree_root(links: tuple[UrdfLink, ...], joints: tuple[UrdfJoint, ...], faults: list[str]) -> str:
    """Name of the one link without a parent; faults if the joints do not make one tree of all links."""
    names = [link.name for link in links]
    faults += [f"link {n} is there twice" for n in sorted({n for n in names if names.count(n) > 1})]
    joint_names = [j.name for j in joints]
    faults += [f"joint {n} is there twice" for n in sorted({n for n in joint_names if joint_names.count(n) > 1})]
    faults += [
        f"joint {j.name}: there is no link {end!r}" for j in joints for end in (j.parent, j.child) if end not in names
    ]
    children = [j.child for j in joints]
    faults += [f"link {c} has two parents" for c in sorted({c for c in children if children.count(c) > 1})]
    roots = [n for n in names if n not in children]
    if faults:
        return ""
    if len(roots) != 1:
        found = ", ".join(roots[:4]) or "none (the joints form a cycle)"
        faults.append(f"expected one link without a parent, got {found}")
        return ""
    reached, waiting = {roots[0]}, [roots[0]]
    while waiting:
        here = waiting.pop()
        new = [j.child for j in joints if j.parent == here and j.child not in reached]
        reached.update(new)
        waiting += new
    if len(reached) != len(names):
        faults.append(f"links {', '.join(sorted(set(names) - reached)[:4])} hang in a cycle, not on {roots[0]}")
    return roots[0]
