"""Elements of a URDF that stand for shapes: visual and collision geometry, origins, colours, mesh paths."""

from __future__ import annotations

import glob
import os
import re
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.mesh.mesh import Mesh

PLANE_SIDE_M, PLANE_THICKNESS_M = 30.0, 0.1
MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".stl", ".ply", ".dae", ".off")
"""Suffixes of mesh files that a URDF may name; no other file is ever opened for it."""
MAX_PATH, MAX_LEVELS = 1024, 7
"""Largest number of characters of a file's path, and largest number of folders above the URDF in which packages are
searched."""


@dataclass
class UrdfIssues:
    """Faults that are found while a URDF is read."""

    faults: list[str] = field(default_factory=list)
    """Faults for which the file is refused."""
    warnings: list[str] = field(default_factory=list)
    """Deviations from the standard that were interpreted in the usual manner."""


@dataclass(frozen=True, kw_only=True)
class UrdfGeometry:
    """Shape in a URDF.

    ``box`` uses ``size``; ``cylinder`` and ``capsule`` lie along z with ``radius`` and ``length`` (the caps of a
    capsule are added to its length, as in Bullet); ``sphere`` has a ``radius``; ``mesh`` a ``file`` and a ``scale``.
    Bullet's infinite ``plane`` is read as a ``box`` of 30 m with the plane as its top.
    """

    kind: Literal["box", "cylinder", "capsule", "sphere", "mesh"]
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.0
    length: float = 0.0
    file: Path | None = None
    """File of the mesh; None for shapes without a file of their own."""
    mesh: Mesh | None = None
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class UrdfPart:
    """A visual or collision element of a link."""

    geometry: UrdfGeometry
    origin: Array
    """Transform from the geometry to the link frame, shape [4, 4]."""
    color: tuple[int, int, int] | None = None
    """Colour (sRGB) of the material, if it has one."""


def read_numbers(
    text: str | None, count: int, default: tuple[float, ...], where: str, issues: UrdfIssues
) -> tuple[float, ...]:
    """Return ``count`` numbers from an attribute, or ``default`` where it is missing or blank.

    Further numbers are ignored with a warning, as in Bullet, whose own robots have such files.
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
    """Return the 4x4 matrix of ``<origin xyz rpy>``: fixed-axis roll, pitch, yaw, so R = Rz(yaw) Ry(pitch) Rx(roll)."""
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
    """Return half the sides [3] [m] of the solid box with the mass and the moments of inertia of ``<inertial>``.

    The box is in the element's own frame, with I_x = m (b^2 + c^2) / 12, and so on, for a box of sides a, b, c. Returns
    None if mass or moments are missing or cannot be read: they only help to guess sizes.
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
    """Return the colour of a ``<color>`` element as (red, green, blue) of 0..255; None without an element."""
    if element is None:
        return None
    text = element.get("rgba")
    if text is not None and len(text.replace(",", " ").split()) == 3:
        issues.warnings.append(f"color: expected 4 numbers, got 3 ({text[:40]}), read as opaque")
        text += " 1"
    values = read_numbers(text, 4, (0.5, 0.5, 0.5, 1.0), "color", issues)
    red, green, blue = (int(round(255 * min(max(v, 0.0), 1.0))) for v in values[:3])
    return red, green, blue


def read_parts(
    link: ElementTree.Element, tag: str, folder: Path, materials: dict[str, tuple[int, int, int]], issues: UrdfIssues
) -> Iterator[UrdfPart]:
    """Yield the shapes of a link in elements ``tag`` (``visual`` or ``collision``), and add faults to ``issues``."""
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
        issues.warnings.append(f"{where}: it has no geometry, it is left out")
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
            if file is None:
                return None
            return UrdfGeometry(kind="mesh", file=file, scale=(sx, sy, sz))
    issues.faults.append(f"{where}: expected box, cylinder, sphere, capsule, plane or mesh, got {shape.tag}")
    return None


def _plane_frame(element: ElementTree.Element, where: str, issues: UrdfIssues) -> Array:
    """Return the frame of the box [4, 4] whose top stands in for ``<plane normal>``."""
    normal = np.array(read_numbers(element.get("normal"), 3, (0.0, 0.0, 1.0), f"{where}, normal", issues))
    if not normal.any():
        issues.faults.append(f"{where}, normal: expected a direction, got zeros")
        return np.eye(4)
    up = normal / np.linalg.norm(normal)
    # the axis that is least along the normal, whose cross product is never short
    side = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([side / np.linalg.norm(side), np.cross(up, side / np.linalg.norm(side)), up], axis=1)
    frame[:3, 3] = -up * PLANE_THICKNESS_M / 2
    return frame


def _mesh_path(filename: str, folder: Path, where: str, issues: UrdfIssues) -> Path | None:
    """Return the path of a mesh file: relative to the URDF, or in the package of that name.

    Packages are searched by `_packages`, or else `_folders_called`. Returns None, with a fault or a warning, if there
    is no such file.

    Backslashes, percent-encoded characters, and other case on disk are accepted. A relative path climbs at most two
    folders above the URDF, and one in a package stays inside it. An absolute path of another machine is searched by its
    tail, the longest first, in the folders above the URDF.
    """
    if not filename.strip():
        issues.warnings.append(f"{where}: its mesh has no file name, it is left out")
        return None
    scheme, _, rest = filename[:MAX_PATH].strip().replace("\\", "/").rpartition("://")
    scheme = scheme.lower()
    here = Path(os.path.abspath(folder))
    above = [p for p in (here, *here.parents) if p != p.parent][:MAX_LEVELS] or [here]  # never the root of the disk
    # packages have their URDFs in a folder beside that of the meshes, so paths climb a little
    top = above[min(2, len(above) - 1)]
    fault = None
    if scheme not in ("", "file", "package", "model"):
        fault = "expected the path of a file"
    elif len(filename) > MAX_PATH:
        fault = f"expected at most {MAX_PATH} characters"
    file = folder / rest
    climbs = "expected a path that climbs at most two folders above the URDF"
    if fault is None and scheme in ("package", "model"):
        name, _, inner = rest.partition("/")
        found = _packages(unquote(name), above)
        called = [] if found else _folders_called(unquote(name), above)
        bases = found or called or above[:3]
        if not all(
            Path(os.path.abspath(b / t)).is_relative_to(b if found or called else top)
            for b in bases
            for t in _spellings(inner)
        ):
            fault = "expected a path that stays in its package" if found or called else climbs
        else:
            file = next((f for base in bases if (f := _on_disk(base, inner)) is not None), bases[0] / inner)
            if called:
                taken = (
                    f"there is no package {name!r}, the folder of that name is taken, of another package: {called[0]}"
                )
                issues.warnings += [taken] if taken not in issues.warnings else []
            elif not found and file.is_file():
                issues.warnings.append(f"{where}: there is no package {name!r}, {file} is taken for {filename[:80]!r}")
    elif fault is None:
        drive = rest[1:3] == ":/"
        if drive or (rest.startswith("/") and not Path(os.path.abspath(file)).is_relative_to(top)):
            file = _by_tail(rest, folder, above)
            issues.warnings.append(f"{where}: {filename[:80]!r} is a path of another machine, {file} is taken for it")
        elif not all(Path(os.path.abspath(folder / t)).is_relative_to(top) for t in _spellings(rest)):
            fault = climbs
        else:
            file = _on_disk(folder, rest) or file
    if fault is None and not rest.lower().endswith(MESH_SUFFIXES):
        fault = f"expected one of {', '.join(MESH_SUFFIXES)}"
    if fault is None:
        return file
    issues.faults.append(f"{where}, filename: {fault}, got {filename[:80]!r}")
    return None


def _spellings(path: str) -> tuple[str, ...]:
    """Return a path as it is written and with ``%20`` and the like decoded."""
    decoded = unquote(path).replace("\0", "")
    return (path,) if decoded == path else (path, decoded)


def _on_disk(base: Path, path: str) -> Path | None:
    """Return the file at ``path`` below ``base``, by the spelling on disk if only case or the form of accents differs."""
    for text in _spellings(path):
        if (base / text).is_file():
            return base / text
    # only then through the folders, which is slow and may be ambiguous
    for text in _spellings(path):
        at = base
        for part in Path(text).parts:
            step = at / part
            if part != ".." and not step.exists() and at.is_dir():
                alike = [p for p in at.iterdir() if _folded(p.name) == _folded(part)]
                step = alike[0] if len(alike) == 1 else step
            at = step
        if at.is_file():
            return at
    return None


def _folded(name: str) -> str:
    # archives that were packed on macOS have accents in two characters
    return unicodedata.normalize("NFC", name).casefold()


def _by_tail(path: str, folder: Path, above: list[Path]) -> Path:
    """Return the file that ends as a foreign path does, in the folders above; by its name alone only beside the URDF."""
    parts = [p for p in path.split("/") if p]
    if ".." not in _spellings(path)[-1].split("/"):
        # two names at least: many robots have a base_link.stl
        for start in range(len(parts) - 1):
            for base in above:
                if (file := _on_disk(base, "/".join(parts[start:]))) is not None:
                    return file
    return _on_disk(folder, parts[-1]) or folder / parts[-1]


def _packages(name: str, above: list[Path]) -> list[Path]:
    """Return folders of the package of a name, nearest first: above the URDF, beside these, and where ROS looks.

    A package is named by the ``<name>`` of its ``package.xml``, or else by its folder.
    """
    if not name or name in (".", "..") or "/" in name or "\0" in name:
        return []
    found: list[Path] = []
    for base in above:
        found += [p for p in (base, base / name) if p.is_dir() and _package_name(p) == name]
    ros = [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
    ros += [Path(p) / "share" for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    found += [q for p in ros for q in (p, p / name) if q.is_dir() and _package_name(q) == name]
    if not found:  # folders of another name, and groups of packages
        for base in (*above[:4], *ros):
            found += sorted(p.parent for p in base.glob("*/package.xml") if _package_name(p.parent) == name)
            found += sorted(p for p in base.glob(f"*/{glob.escape(name)}") if p.is_dir() and _package_name(p) == name)
    return [Path(os.path.abspath(p)) for p in dict.fromkeys(found)]


def _folders_called(name: str, above: list[Path]) -> list[Path]:
    """Return folders of a name, above the URDF and beside these, nearest first, whatever their ``package.xml`` calls them."""
    if not name or name in (".", "..") or "/" in name or "\0" in name:
        return []
    folders = [p for base in above for p in (base, base / name) if p.name == name and p.is_dir()]
    return [Path(os.path.abspath(p)) for p in dict.fromkeys(folders)]


def _package_name(folder: Path) -> str:
    manifest = folder / "package.xml"
    if not manifest.is_file():
        return folder.name
    # the beginning alone, which holds the name; the rest need not even be well-formed
    with manifest.open("rb") as file:
        match = re.search(rb"<name>\s*([^<\s]+)\s*</name>", file.read(1 << 16))
    return match[1].decode(errors="replace") if match else folder.name
