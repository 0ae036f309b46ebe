"""URDF files as typed records: links, joints, visual and collision geometry. Frames stay URDF's own (x forward, z up).

A minimal reader on the standard library. Read: box, cylinder, sphere, capsule, plane, mesh; revolute, continuous, prismatic
and fixed joints, mimic, and the spherical joints that Bullet and Habitat add to URDF; origins, axes, limits, material
colours, inertial origins. Read with a warning, as by Bullet and ROS: a lower limit above the upper one (no limit), vectors of
too many numbers, floating and planar joints (held in place), mimics of joints that cannot lead (they move on their own).
Refused: xacro (expand it first), DOCTYPE and entities (they can read other files or blow up), other joint types, joints that
do not make one tree, meshes by paths that climb out of their package or far above the URDF.
"""

from __future__ import annotations

import logging
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from h3data.bodies.robots.urdf_parts import (
    UrdfIssues,
    UrdfPart,
    read_color,
    read_inertia,
    read_numbers,
    read_origin,
    read_parts,
)
from h3data.errors import FormatError, InputError, MissingAssetError
from h3data.geometry import Array

JointKind = Literal["revolute", "continuous", "prismatic", "fixed", "spherical"]
MAX_BYTES = 16 << 20
"""Size above which a file is refused, as no robot description is larger [bytes]."""
MAX_LINKS = 10_000


@dataclass(frozen=True, kw_only=True, eq=False)
class UrdfLink:
    """Link of a URDF: one rigid body."""

    name: str
    visuals: tuple[UrdfPart, ...]
    collisions: tuple[UrdfPart, ...]
    inertial: Array
    """Transform from the centre-of-mass frame to the link frame, shape [4, 4]; identity if the file gives none."""
    inertia_box: Array | None = None
    """Half the sides [3] [m] of a box with the link's mass and moments of inertia; None if the file gives none."""


@dataclass(frozen=True, kw_only=True)
class UrdfMimic:
    """Rule of a joint that follows another: position = ``multiplier`` * position of ``joint`` + ``offset``."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class UrdfJoint:
    """Joint of a URDF, which connects the link ``child`` to the link ``parent``."""

    name: str
    kind: JointKind
    parent: str
    child: str
    origin: Array
    """Transform from the joint frame (= the child's link frame at position 0) to the parent link frame, shape [4,
    4]."""
    axis: Array
    """Unit vector in the joint frame, shape [3]."""
    lower: float
    """Lower limit of the position [rad or m]; -inf if the file gives none."""
    upper: float
    mimic: UrdfMimic | None = None
    """Joint that this joint follows, if it has no position of its own."""

    @property
    def width(self) -> int:
        """Number of values in the joint's position: 1, or 4 of a spherical joint (a quaternion xyzw)."""
        return 4 if self.kind == "spherical" else 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Urdf:
    """Kinematic tree of a URDF, with links and joints in the order of the file."""

    name: str
    path: Path
    root: str
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]
    rest: Mapping[str, float] = field(default_factory=dict)
    """Resting positions of joints [rad or m]; empty for URDF files, which cannot state them."""
    has_posture: bool = False
    """True if ``rest`` is a resting posture that the file defines, including the arms."""

    @property
    def movable(self) -> tuple[UrdfJoint, ...]:
        """Joints that have a position of their own (neither fixed nor mimic), in the order of the file."""
        return tuple(j for j in self.joints if j.kind != "fixed" and j.mimic is None)


def read_urdf(path: str | Path, *, allow_missing: bool = False, warn: bool = True) -> Urdf:
    """Read the robot described by a URDF file; all faults are reported at once.

    Args:
        path: The file.
        allow_missing: True if mesh files may be missing (`missing_meshes`).
        warn: True logs one line that names irregularities of the file and the interpretation of each.

    Raises:
        InputError: There is no such file.
        FormatError: The file is not a URDF, or it uses unsupported features.
        MissingAssetError: Mesh files are missing.
    """
    path = Path(path)
    robot = _parse(path)
    issues = UrdfIssues()
    materials = _materials(robot, issues)
    _warn_of_skipped(robot, issues)
    # before the links are read, of which each may look for files
    count = len(robot.findall("link"))
    if count > MAX_LINKS:
        raise FormatError(
            f"Expected a URDF of at most {MAX_LINKS} links, got {count}. File: {path}", code="H3-BODY-113"
        )
    links = tuple(_link(e, path.parent, materials, issues) for e in robot.findall("link"))
    joints = tuple(j for e in robot.findall("joint") if (j := _joint(e, issues)) is not None)
    joints = _followers(joints, issues)
    root = _tree_root(links, joints, issues)
    if issues.faults:
        raise FormatError(f"Not a usable URDF: {'; '.join(issues.faults[:8])}. File: {path}", code="H3-BODY-114")
    if issues.warnings and warn:
        rest = f" and {len(issues.warnings) - 6} more" if len(issues.warnings) > 6 else ""
        logging.getLogger(__name__).warning("%s: %s%s. File: %s", path.stem, "; ".join(issues.warnings[:6]), rest, path)
    missing = missing_meshes(links)
    if missing and not allow_missing:
        raise MissingAssetError(
            f"The URDF names {len(missing)} mesh file(s) that do not exist. Hint: keep the folder of the URDF whole. "
            f"Missing: {', '.join(map(str, missing[:4]))}",
            code="H3-BODY-115",
        )
    return Urdf(name=robot.get("name", path.stem), path=path, root=root, links=links, joints=joints)


def _materials(robot: ElementTree.Element, issues: UrdfIssues) -> dict[str, tuple[int, int, int]]:
    """Return the colours by name: those of the robot, then those that are first defined inside links.

    Other links may use the names of the latter before or after their definition.
    """
    colors: dict[str, tuple[int, int, int]] = {}
    unheard = UrdfIssues()  # materials inside links are read, and warned of, with their links
    for element, heard in (
        *((m, issues) for m in robot.findall("material")),
        *((m, unheard) for m in robot.findall("link/visual/material")),
    ):
        color = read_color(element.find("color"), heard)
        if color is not None and (name := element.get("name", "")):
            colors.setdefault(name, color)
    return colors


def _warn_of_skipped(robot: ElementTree.Element, issues: UrdfIssues) -> None:
    """Warn of elements other than links, joints and colours, and of textures, which are not read."""
    skipped = Counter(e.tag for e in robot if e.tag not in ("link", "joint", "material"))
    skipped["texture"] += sum(1 for m in robot.iter("material") if m.find("texture") is not None)
    named = ", ".join(f"<{tag[:40]}>" + (f" ({n})" if n > 1 else "") for tag, n in skipped.items() if n)
    if named:
        issues.warnings.append(f"left out: {named[:300]}")


def _parse(path: Path) -> ElementTree.Element:
    if not path.is_file():
        raise InputError(f"Expected a URDF file, found none there: {path}", code="H3-BODY-116")
    if path.stat().st_size > MAX_BYTES:
        raise FormatError(
            f"Expected a URDF of at most {MAX_BYTES >> 20} MiB, got {path.stat().st_size >> 20}. File: {path}",
            code="H3-BODY-117",
        )
    text = path.read_bytes().strip(b"\0 \t\r\n")  # Bullet's own robots have blank lines before and a NUL at the end
    # As tinyxml does: comments may stand before the declaration and hold two dashes. No "<!--" of the head is left open.
    head, close, tail = text.removeprefix(b"\xef\xbb\xbf").rpartition(b"-->")
    text = (re.sub(rb"<!--.*?-->", b" ", head + close, flags=re.DOTALL) + tail).strip()
    # nested entities grow to gigabytes while they are read, and no robot needs any
    if re.search(rb"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE) or b"\0" in text:
        raise FormatError(
            f"A URDF with a DOCTYPE, entities or UTF-16 is refused. Hint: save it as plain UTF-8. File: {path}",
            code="H3-BODY-118",
        )
    try:
        robot = _elements(text)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise FormatError(
            f"Expected URDF, this is not well-formed XML ({error}). File: {path}", code="H3-BODY-121"
        ) from error
    bound = (item for e in robot.iter() for item in e.attrib.items())
    xacro = {"xacro", *(key.partition(":")[2] for key, value in bound if key.startswith("xmlns") and "xacro" in value)}
    names = [e.tag.rpartition(":") for e in robot.iter()]
    # by its elements: expanded files often still declare the prefix
    macros = {"arg", "attribute", "call", "element", "if", "include", "insert_block", "macro", "property", "unless"}
    if any(prefix in xacro and name in macros for prefix, _, name in names):
        raise FormatError(
            f"This is xacro, not URDF. Hint: expand it first (xacro in.xacro > out.urdf). File: {path}",
            code="H3-BODY-119",
        )
    common = robot.tag.rpartition(":")[0]  # some exporters give one prefix to all elements; others are extensions
    for element in robot.iter():
        prefix, _, name = element.tag.rpartition(":")
        element.tag = name if prefix == common else element.tag
    if robot.tag != "robot":
        raise FormatError(
            f"Expected URDF with the root element <robot>, got <{robot.tag}>. File: {path}", code="H3-BODY-120"
        )
    return robot


def _elements(text: bytes) -> ElementTree.Element:
    """Return XML as elements whose prefixes are part of their names, so that they need no declaration."""
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda tag, attributes: builder.start(tag, attributes)
    parser.EndElementHandler = lambda tag: builder.end(tag)
    parser.CharacterDataHandler = lambda data: builder.data(data)
    parser.Parse(text, True)
    return builder.close()


def mesh_files(links: Iterable[UrdfLink]) -> list[Path]:
    """Return the mesh files that links name, sorted."""
    named = {part.geometry.file for link in links for part in (*link.visuals, *link.collisions)}
    return sorted(file for file in named if file is not None)


def missing_meshes(links: Iterable[UrdfLink]) -> list[Path]:
    """Return the mesh files of links that do not exist, sorted."""
    return [file for file in mesh_files(links) if not file.is_file()]


def _link(
    element: ElementTree.Element, folder: Path, materials: dict[str, tuple[int, int, int]], issues: UrdfIssues
) -> UrdfLink:
    name = element.get("name", "")
    if not name:
        issues.faults.append("a link has no name")
    return UrdfLink(
        name=name,
        visuals=tuple(read_parts(element, "visual", folder, materials, issues)),
        collisions=tuple(read_parts(element, "collision", folder, materials, issues)),
        inertial=read_origin(element.find("inertial"), f"link {name}, inertial", issues),
        inertia_box=read_inertia(element.find("inertial")),
    )


def _joint(element: ElementTree.Element, issues: UrdfIssues) -> UrdfJoint | None:
    name, kind = element.get("name", ""), element.get("type", "")
    where = f"joint {name}"
    parent, child = element.find("parent"), element.find("child")
    known = get_args(JointKind)
    if kind in ("floating", "planar"):
        issues.warnings.append(f"{where}: a {kind} joint is held where the file puts it")
        kind = "fixed"
    if kind not in known:
        issues.faults.append(f"{where}: expected type {', '.join(known)}, got {kind!r}")
        return None
    if parent is None or child is None:
        issues.faults.append(f"{where}: it needs <parent> and <child>")
        return None
    axis_element, limit = element.find("axis"), element.find("limit")
    default = (1.0, 0.0, 0.0)
    moves = kind in ("revolute", "continuous", "prismatic")
    axis = np.array(default)
    if (
        moves and axis_element is not None
    ):  # fixed joints may have any: Habitat's Fetch has 0 0 0, others less than a vector
        axis = np.array(read_numbers(axis_element.get("xyz"), 3, default, where, issues))
    length = float(np.linalg.norm(axis))
    if length == 0:
        axis, length = np.array(default), 1.0
        issues.faults.append(f"{where}: its axis is zero")
    lower, upper = -np.inf, np.inf
    if limit is not None and kind not in ("continuous", "fixed"):
        lower, upper = (read_numbers(limit.get(side), 1, (0.0,), where, issues)[0] for side in ("lower", "upper"))
        if lower > upper:
            issues.warnings.append(f"{where}: its lower limit {lower} is above the upper one {upper}, read as no limit")
            lower, upper = -np.inf, np.inf
    return UrdfJoint(
        name=name,
        kind=kind,  # pyright: ignore[reportArgumentType]  # one of the known ones, see above
        parent=parent.get("link", ""),
        child=child.get("link", ""),
        origin=read_origin(element, where, issues),
        axis=axis / length,
        lower=lower,
        upper=upper,
        mimic=_mimic(element.find("mimic"), where, issues),
    )


def _mimic(element: ElementTree.Element | None, where: str, issues: UrdfIssues) -> UrdfMimic | None:
    if element is None:
        return None
    (multiplier,) = read_numbers(element.get("multiplier"), 1, (1.0,), f"{where}, mimic", issues)
    (offset,) = read_numbers(element.get("offset"), 1, (0.0,), f"{where}, mimic", issues)
    return UrdfMimic(joint=element.get("joint", ""), multiplier=multiplier, offset=offset)


def _followers(joints: tuple[UrdfJoint, ...], issues: UrdfIssues) -> tuple[UrdfJoint, ...]:
    """Return the joints, with every mimic traced to the joint that leads it."""
    by_name = {j.name: j for j in joints}
    one_number = ("revolute", "continuous", "prismatic")
    out = []
    for joint in joints:
        mimic, seen = joint.mimic, {joint.name}
        while mimic is not None:
            leader = by_name.get(mimic.joint)
            if leader is None or joint.kind not in one_number or leader.kind not in one_number:
                if joint.kind != "fixed":
                    reason = "is not there" if leader is None else f"is {leader.kind}"
                    issues.warnings.append(
                        f"joint {joint.name}: {mimic.joint!r}, which it mimics, {reason}; it moves on its own"
                    )
                mimic = None
                break
            if leader.name in seen:
                issues.faults.append(f"joint {joint.name}: it mimics itself in a circle")
                break
            seen.add(leader.name)
            if leader.mimic is None:
                break
            # a follower of a follower, as one that follows the leader itself
            mimic = UrdfMimic(
                joint=leader.mimic.joint,
                multiplier=mimic.multiplier * leader.mimic.multiplier,
                offset=mimic.multiplier * leader.mimic.offset + mimic.offset,
            )
        out.append(replace(joint, mimic=mimic))
    return tuple(out)


def _tree_root(links: tuple[UrdfLink, ...], joints: tuple[UrdfJoint, ...], issues: UrdfIssues) -> str:
    """Return the name of the one link without a parent; faults if the joints do not make one tree of all links."""
    names = [link.name for link in links]
    known, children = set(names), Counter(j.child for j in joints)
    issues.faults += [f"link {n} is there twice" for n, count in Counter(names).items() if count > 1]
    issues.faults += [f"joint {n} is there twice" for n, count in Counter(j.name for j in joints).items() if count > 1]
    issues.faults += [
        f"joint {j.name}: there is no link {end!r}" for j in joints for end in (j.parent, j.child) if end not in known
    ]
    issues.faults += [f"link {c} has two parents" for c, count in children.items() if count > 1]
    roots = [n for n in names if n not in children]
    # what follows relies on unique names and known ends
    if issues.faults:
        return ""
    if len(roots) != 1:
        found = ", ".join(roots[:4]) or ("none (the joints form a cycle)" if names else "a file without links")
        issues.faults.append(f"expected one link without a parent, got {found}")
        return ""
    below: dict[str, list[str]] = defaultdict(list)
    for joint in joints:
        below[joint.parent].append(joint.child)
    reached, waiting = {roots[0]}, [roots[0]]
    while waiting:
        here = waiting.pop()
        reached.update(below[here])
        waiting += below[here]
    # each link has one parent by now, so one that the root does not reach hangs in a cycle
    if len(reached) != len(names):
        issues.faults.append(f"links {', '.join(sorted(known - reached)[:4])} hang in a cycle, not on {roots[0]}")
    return roots[0]
