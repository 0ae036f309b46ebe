"""Reader of robots in MuJoCo's format MJCF (needs the extra ``mjcf``).

MuJoCo itself reads and compiles the file, which resolves defaults, includes and frames. The compiled model is converted
to the records of `h3data.bodies.robots.urdf`. The reader supports bodies, hinge, slide and ball joints with their
anchors, references and ranges, linear couplings of joints (as mimics), geoms of all kinds but planes, height fields and
signed distances, colours, inertias, and the keyframe ``home`` as resting posture. The robot is the body of the world
with the most joints; its free joint is ignored, because its base drives. Other bodies, tendons, further constraints and
textures are ignored with a warning. Actuators, sensors and cameras are not read. Meshes are thinned to `MAX_TRIANGLES`
in total, once, in the cache folder ``robots``.

Some files are refused: those with DOCTYPE and entities, includes that are missing or include themselves, elements that
make many others (``replicate``, ``composite``, ``flexcomp``) or huge pictures, plug-ins, files far above the model,
free joints within the robot, and files that MuJoCo refuses.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.robots.robot_files import RobotReader
from h3data.bodies.robots.urdf import MAX_BYTES, MAX_LINKS, Urdf, UrdfJoint, UrdfLink, UrdfMimic
from h3data.bodies.robots.urdf_parts import UrdfGeometry, UrdfPart
from h3data.errors import FormatError, InputError, MissingAssetError, MissingExtraError
from h3data.files import cache_folder, part_file
from h3data.geometry import Array, pose_to_matrix
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import round_mesh
from h3data.mesh.thinning import thin_mesh

_log = logging.getLogger(__name__)

MAX_TRIANGLES = 20_000
"""Largest number of triangles of all visible meshes; above it, all are thinned by the same factor."""
LEAST_VERTICES = 40
"""Smallest number of vertices to which a mesh is thinned."""
ROUNDS = 4
MAX_ASSET_BYTES = 1 << 30
"""Largest size of all meshes and pictures of a model together [bytes]."""
MAX_SIDE = 8192
"""Largest number of rows or columns of pictures and height fields that the file generates."""
FOLDERS_UP = 2
"""Largest number of folder levels above a model in which its files may be."""
FARTHEST_M = 1e4
"""Largest coordinate or size [m]."""
_SIDES = {"texture": ("width", "height"), "hfield": ("nrow", "ncol")}
_RUNNING = {"memory", "nstack", "njmax", "nconmax"}
"""Memory of a running simulation, which is never reserved here."""
_MAKERS = ("replicate", "composite", "flexcomp", "plugin")
_FORMAT = 2
_DRAWN_GROUPS = 3
"""Number of geom groups that MuJoCo's viewer draws, 0 to 2; many robots have their collision shapes in group 3."""


def read_mjcf(path: str | Path, *, warn: bool = True) -> Urdf:
    """Read the robot of an MJCF file.

    Args:
        path: MJCF file.
        warn: True to log ignored content, and the model's licence, in one line each.

    Raises:
        InputError: There is no such file.
        FormatError: The file is not MJCF, or has unsupported content.
        MissingAssetError: Files that it includes or names are missing.
        MissingExtraError: MuJoCo is not installed.
    """
    path = Path(path)
    files = mjcf_files(path)
    mujoco = _mujoco()
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, RuntimeError) as error:
        said = " ".join(str(error).split())
        raise FormatError(
            f"MuJoCo cannot compile this MJCF file: {said[:300]} File: {path}", code="H3-BODY-164"
        ) from error
    for name in ("body_pos", "jnt_pos", "geom_pos", "geom_size", "mesh_vert"):
        if not (np.abs(getattr(model, name)) <= FARTHEST_M).all():
            raise FormatError(
                f"Expected a robot whose places and sizes are at most {FARTHEST_M:g} m, {name} has others. File: {path}",
                code="H3-BODY-181",
            )
    reader = _Reader(mujoco, model, path)
    urdf = reader.robot(files)
    if warn and reader.left_out:
        _log.warning("%s: left out: %s. File: %s", urdf.name, "; ".join(reader.left_out[:8]), path)
    if warn and (licence := licence_of(path)):
        _log.info("%s: the model is its makers': %s", urdf.name, licence)
    return urdf


def licence_of(path: Path) -> str:
    """Return the first line and path of the licence in the folder of a model; empty if there is none."""
    for name in ("LICENSE", "LICENSE.txt", "LICENSE.md", "LICENCE", "LICENCE.txt", "LICENCE.md", "COPYING"):
        file = path.parent / name
        if file.is_file():
            lines = file.read_text(encoding="utf-8", errors="replace")[:4000].splitlines()
            first = next((line.strip() for line in lines if line.strip()), "")
            return f"{first[:80]} ({file})"
    return ""


# --- the files of a model ---------------------------------------------------------------------------------------------
def mjcf_files(path: Path) -> list[Path]:
    """Return the paths of the model, its included files, and its meshes and pictures, without repetitions.

    Raises:
        InputError: There is no such file.
        FormatError: One of the XML files is refused.
        MissingAssetError: Files are missing.
    """
    if not path.is_file():
        raise InputError(f"Expected an MJCF file, found none there: {path}", code="H3-BODY-159")
    scan = _Scan(path)
    scan.read(path, ())
    if scan.missing:
        raise MissingAssetError(
            f"The MJCF file names {len(scan.missing)} file(s) that do not exist. Hint: keep the folder of the model whole. "
            f"Missing: {', '.join(scan.missing[:4])}. File: {path}",
            code="H3-BODY-160",
        )
    size = sum(file.stat().st_size for file in scan.assets)
    if size > MAX_ASSET_BYTES:
        raise FormatError(
            f"Expected meshes and pictures of at most {MAX_ASSET_BYTES >> 20} MiB, got {size >> 20}. File: {path}",
            code="H3-BODY-161",
        )
    return list(dict.fromkeys((*scan.models, *scan.assets)))


@dataclass
class _Scan:
    """Reader of the XML of a model and its included files, before MuJoCo reads them."""

    main: Path
    models: list[Path] = field(default_factory=list)
    assets: list[Path] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    folders: dict[str, str] = field(default_factory=dict)
    """Folders that compilers name: ``meshdir``, ``texturedir``, ``assetdir``."""

    def read(self, path: Path, above: tuple[Path, ...]) -> None:
        at = path.resolve()
        if at in above:
            raise FormatError(f"The MJCF file includes itself: {path}. File: {self.main}", code="H3-BODY-165")
        if at in self.models or len(self.models) > 200:
            raise FormatError(
                f"Expected each file to be included once, {path} is there again. File: {self.main}", code="H3-BODY-166"
            )
        self.models.append(at)
        root = _elements(path)
        if root.tag != ("mujocoinclude" if above and root.tag == "mujocoinclude" else "mujoco"):
            raise FormatError(
                f"Expected MJCF with the root element <mujoco>, got <{root.tag[:40]}>. Hint: name a URDF .urdf. File: {path}",
                code="H3-BODY-167",
            )
        for element in root.iter():
            self._check(element, path)
        for compiler in root.iter("compiler"):
            self.folders |= {k: v for k, v in compiler.attrib.items() if k in ("meshdir", "texturedir", "assetdir")}
        for include in root.iter("include"):
            found = self._find(include.get("file", ""), ("",), path)
            if found is None:
                self.missing.append(include.get("file", "")[:120])
            else:
                self.read(found, (*above, at))
        for element in root.iter():
            if element.tag in ("mesh", "texture", "hfield", "skin", "model"):
                self._name(element, path)

    def _check(self, element: ElementTree.Element, path: Path) -> None:
        if element.tag in _MAKERS:
            raise FormatError(
                f"MJCF files with <{element.tag}> are not read as robots. Hint: save the compiled model. File: {path}",
                code="H3-BODY-168",
            )
        if element.tag == "mesh" and element.get("builtin"):
            raise FormatError(f"Meshes that MuJoCo makes itself are not read. File: {path}", code="H3-BODY-169")
        # ``size`` reserves memory, by numbers of things that the file need not have
        asked = set(element.attrib) - _RUNNING if element.tag == "size" else _SIDES.get(element.tag, ())
        for name in asked:
            if (text := element.get(name)) is not None:
                side = int(text) if re.fullmatch(r"\s*-?\d{1,9}\s*", text) else MAX_SIDE + 1
                if side > MAX_SIDE:
                    raise FormatError(
                        f"Expected a {element.tag} of at most {MAX_SIDE} {name}, got {text[:20]!r}. File: {path}",
                        code="H3-BODY-175",
                    )

    def _name(self, element: ElementTree.Element, path: Path) -> None:
        kinds = {"mesh": "meshdir", "texture": "texturedir", "hfield": "meshdir", "skin": "meshdir"}
        own = self.folders.get(kinds.get(element.tag, ""), self.folders.get("assetdir", ""))
        for key, name in element.attrib.items():
            if not key.startswith("file") or not name:
                continue
            found = self._find(name, (own, ""), path)
            if found is None:
                self.missing.append(name[:120])
            else:
                self.assets.append(found)

    def _find(self, name: str, folders: tuple[str, ...], inside: Path) -> Path | None:
        for folder in folders:
            for start in (self.main.parent, inside.parent):
                if name and (file := start / folder / name).is_file():
                    top = [self.main.resolve().parent, *self.main.resolve().parent.parents][: FOLDERS_UP + 1][-1]
                    if not file.resolve().is_relative_to(top):
                        raise FormatError(
                            f"Expected files at most {FOLDERS_UP} folders above the MJCF file, got {name[:120]}. "
                            f"File: {self.main}",
                            code="H3-BODY-176",
                        )
                    return file.resolve()
        return None


def _elements(path: Path) -> ElementTree.Element:
    if path.stat().st_size > MAX_BYTES:
        raise FormatError(
            f"Expected MJCF of at most {MAX_BYTES >> 20} MiB, got {path.stat().st_size >> 20}. File: {path}",
            code="H3-BODY-162",
        )
    text = path.read_bytes()
    if re.search(rb"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE) or b"\0" in text:
        raise FormatError(
            f"MJCF with a DOCTYPE, entities or UTF-16 is refused. Hint: save it as plain UTF-8. File: {path}",
            code="H3-BODY-163",
        )
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise FormatError(
            f"Expected MJCF, this is not well-formed XML ({error}). File: {path}", code="H3-BODY-170"
        ) from error


def _mujoco() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtraError(
            "Robots in MJCF need MuJoCo's compiler. Hint: pip install 'h3data[mjcf]'", code="H3-BODY-171"
        ) from error
    return mujoco


# --- from the compiled model ------------------------------------------------------------------------------------------
class _Reader:
    """A compiled model, and what of it has been left out."""

    def __init__(self, mujoco: Any, model: Any, path: Path) -> None:
        self.mj, self.m, self.path = mujoco, model, path
        self.left_out: list[str] = []
        self._taken: set[tuple[str, str]] = set()

    def robot(self, files: list[Path]) -> Urdf:
        m = self.m
        roots = [b for b in range(1, m.nbody) if m.body_parentid[b] == 0]
        if not roots:
            raise FormatError(
                f"Expected a robot of bodies, the world of this MJCF file has none. File: {self.path}",
                code="H3-BODY-172",
            )
        count = [int(m.body_jntnum[m.body_rootid == b].sum()) for b in roots]
        root = roots[int(np.argmax(count))]
        if len(roots) > 1:
            self.left_out.append(f"{len(roots) - 1} other bodies of the world")
        bodies = [b for b in range(1, m.nbody) if m.body_rootid[b] == root]
        if len(bodies) + m.njnt > MAX_LINKS:
            raise FormatError(f"Expected a robot of at most {MAX_LINKS} bodies. File: {self.path}", code="H3-BODY-173")
        self._links = {b: self._unique(m.body(b).name or f"body_{b}") for b in bodies}
        self._joints = {j: self._unique(m.jnt(j).name or f"joint_{j}", "joint") for j in range(m.njnt)}
        self._meshes = self._thinned(bodies, files)
        links, joints = [], []
        drawn = any(self._drawn(b) for b in bodies)
        for b in bodies:
            for link, joint in self._chain(b, root):
                links += [link] if link is not None else []
                joints += [joint] if joint is not None else []
            links.append(self._link(b, drawn))
        self._tell_rest()
        name = self.m.names.split(b"\0", 1)[0].decode("utf-8", "replace")
        return Urdf(
            name=re.sub(r"[^\w.-]+", "_", name).strip("_") or self.path.stem,
            path=self.path,
            root=self._root(links, joints),
            links=tuple(links),
            joints=self._led(joints),
            rest=self._rest(),
            has_posture=any(self.m.key(k).name == "home" for k in range(self.m.nkey)),
        )

    def _unique(self, name: str, what: str = "link") -> str:
        while (what, name) in self._taken:
            name += "_"
        self._taken.add((what, name))
        return name

    @staticmethod
    def _root(links: list[UrdfLink], joints: list[UrdfJoint]) -> str:
        below = {joint.child for joint in joints}
        return next(link.name for link in links if link.name not in below)

    def _chain(self, b: int, root: int) -> Iterator[tuple[UrdfLink | None, UrdfJoint | None]]:
        """Yield link and joints that lead to the frame of a body, with a link if the frame is not at an anchor.

        As `mj_kinematics`: joints turn one after the other about their anchors, in the axes that those before have turned.
        """
        m, kinds = self.m, self.mj.mjtJoint
        own = range(int(m.body_jntadr[b]), int(m.body_jntadr[b]) + int(m.body_jntnum[b]))
        free = [j for j in own if m.jnt_type[j] == kinds.mjJNT_FREE]
        if free and b != root:
            raise FormatError(
                f"A free joint within the robot is not read: {self._joints[free[0]]}. File: {self.path}",
                code="H3-BODY-174",
            )
        own = [j for j in own if j not in free]
        place = _matrix(m.body_pos[b], m.body_quat[b])
        if b == root:
            # where the file places its robot in the world means nothing here; its height over the floor does
            place[:2, 3] = 0.0
            if free or (not own and np.allclose(place[:3, :3], np.eye(3))):
                return
            parent = self._unique("world")
            yield _bare(parent), None
        else:
            parent = self._links[int(m.body_parentid[b])]
        for j in own:
            anchor, start = _shift(m.jnt_pos[j]), float(m.qpos0[m.jnt_qposadr[j]])
            axis = m.jnt_axis[j] / max(float(np.linalg.norm(m.jnt_axis[j])), 1e-12)
            kind = {
                int(kinds.mjJNT_HINGE): "revolute" if m.jnt_limited[j] else "continuous",
                int(kinds.mjJNT_SLIDE): "prismatic",
                int(kinds.mjJNT_BALL): "spherical",
            }[int(m.jnt_type[j])]
            # a joint of a URDF is at rest at 0, one of MJCF at its reference
            back = np.eye(4)
            if kind == "prismatic":
                back = _shift(-start * axis)
            elif kind != "spherical":
                back[:3, :3] = _rotation(axis, -start)
            last = j == own[-1] and not m.jnt_pos[j].any()
            child = self._links[b] if last else self._unique(f"{self._links[b]}/{self._joints[j]}")
            lower, upper = m.jnt_range[j].tolist() if m.jnt_limited[j] else (-np.inf, np.inf)
            joint = UrdfJoint(
                name=self._joints[j],
                kind=kind,  # type: ignore[arg-type]
                parent=parent,
                child=child,
                origin=place @ anchor @ back,
                axis=axis,
                lower=-np.inf if kind == "spherical" else lower,
                upper=np.inf if kind == "spherical" else upper,
            )
            yield (None if last else _bare(child)), joint
            if last:
                return
            parent, place = child, _shift(-m.jnt_pos[j])
        fixed = self._unique(f"{self._links[b]}/fixed", "joint")
        yield None, UrdfJoint(
            name=fixed, kind="fixed", parent=parent, child=self._links[b], origin=place, axis=np.array([1.0, 0, 0]),
            lower=-np.inf, upper=np.inf,
        )  # fmt: skip

    def _led(self, joints: list[UrdfJoint]) -> tuple[UrdfJoint, ...]:
        """Return the joints, with linear couplings as mimics."""
        m, mimics, kept = self.m, {}, 0
        numbers = {joint.name: joint for joint in joints if joint.kind in ("revolute", "continuous", "prismatic")}
        for e in range(m.neq):
            couples = m.eq_type[e] == self.mj.mjtEq.mjEQ_JOINT and m.eq_obj2id[e] >= 0 and m.eq_active0[e]
            follower, leader = (self._joints.get(int(k), "") for k in (m.eq_obj1id[e], m.eq_obj2id[e]))
            # a mimic of a URDF has one leader, which follows nobody
            led = {leader, *(one.joint for one in mimics.values())}
            if not couples or m.eq_data[e][2:5].any() or not {follower, leader} <= {*numbers} or follower in led:
                kept += 1
                continue
            at = [float(m.qpos0[m.jnt_qposadr[k]]) for k in (m.eq_obj1id[e], m.eq_obj2id[e])]
            shift, gain = float(m.eq_data[e][0]), float(m.eq_data[e][1])
            offset = at[0] + shift - gain * at[1]
            if leader in mimics:  # which follows another one
                first = mimics[leader]
                leader, gain, offset = first.joint, gain * first.multiplier, offset + gain * first.offset
            mimics[follower] = UrdfMimic(joint=leader, multiplier=gain, offset=offset)
        for what, count in (("constraints", kept), ("tendons", int(m.ntendon)), ("pictures", int(m.ntex))):
            if count:
                self.left_out.append(f"{count} {what}")
        return tuple(replace(joint, mimic=mimics.get(joint.name)) for joint in joints)

    def _rest(self) -> dict[str, float]:
        """Return positions of joints in the keyframe ``home``, else at their references."""
        m = self.m
        home = [k for k in range(m.nkey) if m.key(k).name == "home"]
        posture = m.key_qpos[home[0]] if home else m.qpos0
        one = (int(self.mj.mjtJoint.mjJNT_HINGE), int(self.mj.mjtJoint.mjJNT_SLIDE))
        return {
            name: float(posture[m.jnt_qposadr[j]])
            for j, name in self._joints.items()
            if int(m.jnt_type[j]) in one and np.isfinite(posture[m.jnt_qposadr[j]])
        }

    def _tell_rest(self) -> None:
        odd = [
            g for g in range(self.m.ngeom) if self.m.geom_bodyid[g] > 0 and self._kind(g) in ("hfield", "sdf", "plane")
        ]
        if odd:
            self.left_out.append(f"{len(odd)} planes, height fields or distance fields")

    # --- geoms ----------------------------------------------------------------------------------------------------------
    def _geoms(self, b: int) -> range:
        first, count = int(self.m.body_geomadr[b]), int(self.m.body_geomnum[b])
        return range(first, first + count)

    def _kind(self, g: int) -> str:
        return self.mj.mjtGeom(int(self.m.geom_type[g])).name.removeprefix("mjGEOM_").lower()

    def _drawn(self, b: int) -> list[int]:
        """Return the visible geoms of a body: those that touch nothing, else those of the groups that MuJoCo shows."""
        seen = [g for g in self._geoms(b) if float(self._rgba(g)[3]) > 0]
        pure = [g for g in seen if not self._collides(g)]
        return pure or [g for g in seen if int(self.m.geom_group[g]) < _DRAWN_GROUPS]

    def _collides(self, g: int) -> bool:
        return bool(self.m.geom_contype[g] or self.m.geom_conaffinity[g])

    def _rgba(self, g: int) -> NDArray[np.floating]:
        material = int(self.m.geom_matid[g])
        # the default of MuJoCo, which a material overrides; another colour of the geom itself goes before its material
        plain = np.allclose(self.m.geom_rgba[g], (0.5, 0.5, 0.5, 1.0))
        return self.m.mat_rgba[material] if material >= 0 and plain else self.m.geom_rgba[g]

    def _link(self, b: int, drawn: bool) -> UrdfLink:
        m = self.m
        mass, (ix, iy, iz) = float(m.body_mass[b]), m.body_inertia[b].tolist()
        # half extents of the box with this mass and these moments: I_x = m / 3 (b^2 + c^2), and so on
        squares = 1.5 / max(mass, 1e-12) * np.array([iy + iz - ix, iz + ix - iy, ix + iy - iz])
        visuals = [self._part(g) for g in (self._drawn(b) if drawn else self._geoms(b))]
        return UrdfLink(
            name=self._links[b],
            visuals=tuple(part for part in visuals if part is not None),
            collisions=tuple(part for g in self._geoms(b) if self._collides(g) and (part := self._part(g)) is not None),
            inertial=_matrix(m.body_ipos[b], m.body_iquat[b]),
            inertia_box=np.sqrt(np.maximum(squares, 0.0)) if mass > 0 else None,
        )

    def _part(self, g: int) -> UrdfPart | None:
        m, kind = self.m, self._kind(g)
        a, b, c = m.geom_size[g].tolist()
        match kind:
            case "sphere":
                shape = UrdfGeometry(kind="sphere", radius=a)
            case "capsule" | "cylinder":
                shape = UrdfGeometry(kind=kind, radius=a, length=2 * b)
            case "box":
                shape = UrdfGeometry(kind="box", size=(2 * a, 2 * b, 2 * c))
            case "ellipsoid":
                ball = round_mesh(1.0, 0.0, (128, 128, 128), caps=True)
                shape = UrdfGeometry(kind="mesh", mesh=ball, scale=(a, b, c))
            case "mesh" if int(m.geom_dataid[g]) in self._meshes:
                shape = UrdfGeometry(kind="mesh", mesh=self._meshes[int(m.geom_dataid[g])])
            case _:
                return None
        red, green, blue = (int(round(255 * min(max(float(v), 0.0), 1.0))) for v in self._rgba(g)[:3])
        return UrdfPart(geometry=shape, origin=_matrix(m.geom_pos[g], m.geom_quat[g]), color=(red, green, blue))

    # --- meshes -----------------------------------------------------------------------------------------------------------
    def _thinned(self, bodies: list[int], files: list[Path]) -> dict[int, Mesh]:
        """Return the meshes of the geoms of bodies by number, thinned together; read from the cache if they are there."""
        m = self.m
        used = Counter(int(m.geom_dataid[g]) for b in bodies for g in self._geoms(b) if self._kind(g) == "mesh")
        numbers = sorted(k for k in used if k >= 0)
        triangles = sum(used[k] * int(m.mesh_facenum[k]) for k in numbers)
        if triangles <= MAX_TRIANGLES:
            return {k: self._mesh(k) for k in numbers}
        folder = cache_folder("robots")
        store = None if folder is None else folder / f"{_digest(files)}.npz"
        if store is not None and (cached := _cached(store, numbers)) is not None:
            return cached
        thinned = {k: self._mesh(k) for k in numbers}
        for _ in range(ROUNDS):  # how many triangles a number of vertices has differs from mesh to mesh
            share = 0.9 * MAX_TRIANGLES / triangles
            thinned = {
                k: _thin(mesh, max(int(share * len(mesh.faces) / 2), LEAST_VERTICES)) for k, mesh in thinned.items()
            }
            triangles = sum(used[k] * len(mesh.faces) for k, mesh in thinned.items())
            if triangles <= MAX_TRIANGLES:
                break
        if store is not None:
            _store(store, thinned)
        return thinned

    def _mesh(self, k: int) -> Mesh:
        m = self.m
        points = m.mesh_vert[m.mesh_vertadr[k] : m.mesh_vertadr[k] + m.mesh_vertnum[k]]
        faces = m.mesh_face[m.mesh_faceadr[k] : m.mesh_faceadr[k] + m.mesh_facenum[k]]
        return Mesh(
            vertices=np.ascontiguousarray(points, np.float32),
            faces=np.ascontiguousarray(faces, np.int32),
            colors=np.full((len(points), 3), 128, np.uint8),
        )


def _thin(mesh: Mesh, most: int) -> Mesh:
    thin = thin_mesh(mesh, most)
    if not len(thin.faces):
        return mesh
    _, first = np.unique(np.sort(thin.faces, axis=1), axis=0, return_index=True)  # sides of thin walls become one
    return Mesh(vertices=mesh.vertices[thin.keep], faces=thin.faces[np.sort(first)], colors=mesh.colors[thin.keep])


def _digest(files: list[Path]) -> str:
    digest = hashlib.sha256(f"{_FORMAT} {MAX_TRIANGLES}".encode())
    for file in files:
        data = file.read_bytes()
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()


def _cached(path: Path, numbers: list[int]) -> dict[int, Mesh] | None:
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {k: (file[f"v{k}"], file[f"f{k}"]) for k in numbers}
    except (OSError, ValueError, KeyError, EOFError):
        return None  # cut or foreign: made anew
    return {k: Mesh(vertices=v, faces=f, colors=np.full((len(v), 3), 128, np.uint8)) for k, (v, f) in found.items()}


def _store(path: Path, meshes: dict[int, Mesh]) -> None:
    arrays: dict[str, NDArray[Any]] = {f"v{k}": mesh.vertices for k, mesh in meshes.items()}
    arrays |= {f"f{k}": mesh.faces for k, mesh in meshes.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part_file(path, shared=True) as part, part.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    except OSError as error:
        _log.info("Thinned meshes are not kept: %s", error)


# --- frames -----------------------------------------------------------------------------------------------------------
def _bare(name: str) -> UrdfLink:
    return UrdfLink(name=name, visuals=(), collisions=(), inertial=np.eye(4))


def _shift(by: Array) -> Array:
    out = np.eye(4)
    out[:3, 3] = by
    return out


def _rotation(axis: Array, angle: float) -> Array:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _matrix(position: Array, quaternion: Array) -> Array:
    """Return the 4x4 matrix of a position and a quaternion wxyz, as MuJoCo has them."""
    w, x, y, z = np.asarray(quaternion, np.float64) / max(float(np.linalg.norm(quaternion)), 1e-12)
    return np.asarray(pose_to_matrix(np.array([*position, x, y, z, w], np.float64)), np.float64)


READER = RobotReader(read=read_mjcf, files=mjcf_files)
"""Reader of MJCF files of robots: an entry point of the group ``h3data.robot_files``."""
