"""Reader of humanoids from npz files that hold integers as planes of bytes, which compress well, and no pickles.

The built-in bodies share a base (``common.npz``) and a wardrobe (``wardrobe.npz``: skin, clothes and hair as patches
over the base); a body's own file holds its base vertices as differences from the mean, its skeleton, look,
collision capsules and gait. A file may also hold meshes of its own instead of a base.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.clips import Gaits
from h3data.bodies.people.humanoid import BodyCapsule, Humanoid, SkinnedMesh
from h3data.bodies.people.legs import Legs
from h3data.bodies.people.look.colors import SLOTS
from h3data.bodies.people.look.dressing import dressed, read_look
from h3data.bodies.people.look.patches import vertex_normals
from h3data.bodies.people.look.wardrobe import OUTFITS, SEPARATOR, WARDROBE_FILE, builtin_wardrobe, split_outfit
from h3data.bodies.people.random_humanoid import is_random, random_arrays
from h3data.bodies.people.skeleton import JOINT_INDEX, JOINT_NAMES
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError, suggest
from h3data.geometry import Array
from h3data.mesh.mesh import Mesh

FILE_FORMAT, COMMON_FORMAT = "h3data.humanoid/2", "h3data.humanoid-common/3"
COMMON_FILE = "common.npz"
VERTEX_UNIT_M = 1e-4
"""Unit of stored vertices: a tenth of a millimetre (int16: within 3.2 m of the origin)."""
WEIGHT_UNIT = 1 / 255
ADULTS = tuple(f"{kind}_{k}" for kind in ("female", "male", "neutral") for k in range(4))
"""Names of the bodies from which ``any`` samples; children and older people are used only by name."""

Arrays = Mapping[str, NDArray[Any]]


def humanoid_names() -> tuple[str, ...]:
    """Return the names of the built-in bodies, sorted."""
    others = (COMMON_FILE, WARDROBE_FILE)
    return tuple(sorted(p.stem for p in builtin_path("bodies").glob("*.npz") if p.name not in others))


@lru_cache(maxsize=32)
def _builtin_arrays(name: str) -> dict[str, Any]:
    return read_arrays(builtin_path(f"bodies/{name}.npz"), FILE_FORMAT)


@lru_cache(maxsize=64)
def load_humanoid(name: str | Path) -> Humanoid:
    """Load a body by name, once; later calls return the same object.

    The name is a built-in body (``female_0``), ``random:SEED`` (`h3data.bodies.people.random_humanoid`), or a file that
    ends in ``.npz``; a colon and an outfit may follow (``female_0:dress``).
    """
    body, outfit = split_outfit(str(name))
    if is_random(body):
        # handed over, because this module imports that one
        return _humanoid(random_arrays(body, _builtin_arrays, (to_planes, from_planes)), outfit)
    if body.endswith(".npz"):
        path = Path(body)
    elif body in humanoid_names():
        path = builtin_path(f"bodies/{body}.npz")
    else:
        before, _, after = body.partition(SEPARATOR)
        if before in humanoid_names() or is_random(before) or before.endswith(".npz"):
            raise InputError(f"No outfit {after!r}.{suggest(after, OUTFITS, lead='There are')}", code="H3-BODY-079")
        near = suggest(body, humanoid_names(), lead="There are", more=", and random:SEED")
        raise InputError(f"No built-in humanoid {body!r}.{near}", code="H3-BODY-072")
    data = read_arrays(path, FILE_FORMAT)
    try:
        # differences from the mean fit one base only: on another one they would tear the skin apart
        if "full_faces" not in data and str(data["common"]) != builtin_common().name:
            raise FormatError(
                f"The humanoid was baked on another topology ({data['common']}) than the built-in one "
                f"({builtin_common().name}). Hint: bake it again. File: {path}",
                code="H3-BODY-073",
            )
        return _humanoid(data, outfit)
    except KeyError as error:
        raise FormatError(
            f"The humanoid file lacks the array {error}. Hint: bake it again. File: {path}", code="H3-BODY-074"
        ) from error
    except (ValueError, IndexError, TypeError) as error:
        raise FormatError(
            f"The humanoid file is damaged ({error}). Hint: bake it again. File: {path}", code="H3-BODY-075"
        ) from error


def read_arrays(path: Path, expected: str) -> dict[str, NDArray[Any]]:
    """Return all arrays of an npz file whose ``format`` is ``expected``, without unpickling."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            data = {key: file[key] for key in file.files}
    except FileNotFoundError:
        raise InputError(f"Expected a humanoid file, found none there: {path}", code="H3-BODY-076") from None
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise FormatError(
            f"Expected a humanoid file ({expected}), this is none ({error}): {path}", code="H3-BODY-077"
        ) from error
    # files of other programs may have arrays of the same names
    found = str(data.get("format", "another npz file"))
    if found != expected:
        raise FormatError(
            f"Expected a humanoid file ({expected}), got {found}. Hint: bake it again. File: {path}", code="H3-BODY-070"
        )
    return data


@dataclass(frozen=True, kw_only=True, eq=False)
class _Common:
    name: str
    base_mean: NDArray[np.int16]
    base_faces: NDArray[np.int32]
    capsule_names: tuple[str, ...]
    capsule_joints: tuple[int, ...]


@lru_cache(maxsize=1)
def builtin_common() -> _Common:
    """Return the arrays that all built-in bodies share, read once."""
    data = read_arrays(builtin_path(f"bodies/{COMMON_FILE}"), COMMON_FORMAT)
    return _Common(
        name=str(data["common"]),
        base_mean=from_planes(data["base_mean"]),
        base_faces=data["base_faces"].astype(np.int32),
        **_capsule_places(data),
    )


def _capsule_places(data: Arrays) -> dict[str, Any]:
    names = tuple(str(n) for n in data["joint_names"])
    if names != JOINT_NAMES:
        raise FormatError(
            f"Expected the {len(JOINT_NAMES)} SMPL-X joints in their order, got {len(names)} others.",
            code="H3-BODY-071",
        )
    return {
        "capsule_names": tuple(str(n) for n in data["capsule_names"]),
        "capsule_joints": tuple(int(j) for j in data["capsule_joints"]),
    }


def to_planes(vertices: NDArray[np.int16]) -> NDArray[np.uint8]:
    """Convert vertices [V, 3] to planes of low and high bytes, uint8 [2, 3, V], which compress by a third better."""
    flat = np.ascontiguousarray(vertices.astype("<i2").T)
    return np.ascontiguousarray(flat.view(np.uint8).reshape(3, -1, 2).transpose(2, 0, 1))


def from_planes(planes: NDArray[np.uint8]) -> NDArray[np.int16]:
    """Convert planes of bytes, uint8 [2, 3, V], back to vertices [V, 3]: the inverse of `to_planes`."""
    low, high = planes.astype(np.uint16)
    # the cast to int16 gives back the negative ones, which are stored in two's complement
    return np.ascontiguousarray((low | high << 8).astype(np.int16).T)


def _humanoid(data: Arrays, outfit: str) -> Humanoid:
    bind = np.tile(np.eye(4), (len(JOINT_NAMES), 1, 1))
    bind[:, :3, :3], bind[:, :3, 3] = data["bind_rotation"], data["bind_position"]
    offsets = data["joint_offsets"].astype(np.float64)
    height = float(data["height_m"])
    if "full_faces" in data:
        if outfit:
            raise InputError(
                f"The body {data['name']} has a mesh of its own, which wears nothing else.", code="H3-BODY-078"
            )
        places = _capsule_places(data)
        drawn: dict[str, Any] = {part: _own_mesh(data, part) for part in ("full", "lod")}
        drawn |= {"region_names": tuple(str(n) for n in data["region_names"])}
    else:
        common = builtin_common()
        places = {"capsule_names": common.capsule_names, "capsule_joints": common.capsule_joints}
        vertices = (common.base_mean + from_planes(data["base_delta"])) * np.float32(VERTEX_UNIT_M)
        normals = vertex_normals(vertices, common.base_faces)
        look = read_look(str(data["look"]))
        worn = outfit or look.outfit
        meshes = {
            detail: dressed(builtin_wardrobe(), look, worn, vertices, normals, detail) for detail in ("full", "lod")
        }
        drawn = {**meshes, "region_names": SLOTS, "outfit": worn}
    return Humanoid(
        name=str(data["name"]) + (f"{SEPARATOR}{outfit}" if outfit else ""),
        height_m=height,
        joint_offsets=offsets,
        inverse_bind=np.linalg.inv(bind),
        **drawn,
        capsules=tuple(
            BodyCapsule(name=name, joint=joint, start=start, end=end, radius=float(radius))
            for name, joint, start, end, radius in zip(
                places["capsule_names"],
                places["capsule_joints"],
                data["capsule_start"].astype(np.float64),
                data["capsule_end"].astype(np.float64),
                data["capsule_radius"],
                strict=True,
            )
        ),
        gaits=Gaits(
            legs=legs_from_offsets(offsets, data["feet"].astype(np.float64), float(data["ankle_height"])),
            height_m=height,
            walk=data["walk"].astype(np.float64),
            jog=data["jog"].astype(np.float64),
        ),
        phenotype=json.loads(str(data["phenotype"])),
    )


def legs_from_offsets(offsets: Array, feet: Array, ankle_height: float) -> Legs:
    """Return the leg measures of a body from ``joint_offsets`` [55, 3] and the ``feet`` of `Legs` [2, 3, 3] [m]."""
    return Legs(
        hips=offsets[[JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]],
        thigh=float(np.linalg.norm(offsets[JOINT_INDEX["left_knee"]])),
        shank=float(np.linalg.norm(offsets[JOINT_INDEX["left_ankle"]])),
        ankle_height=ankle_height,
        feet=feet,
    )


def _own_mesh(data: Arrays, prefix: str) -> SkinnedMesh:
    weights = data[f"{prefix}_weights"].astype(np.float32) * np.float32(WEIGHT_UNIT)
    vertices = (from_planes(data[f"{prefix}_mean"]) + from_planes(data[f"{prefix}_delta"])) * np.float32(VERTEX_UNIT_M)
    faces, regions = data[f"{prefix}_faces"].astype(np.int32), data[f"{prefix}_regions"]
    colors = data["region_colors"].astype(np.uint8)
    _, shade = np.unique(colors, axis=0, return_inverse=True)
    # vertices at one place are shaded as one, unless their colours differ: hems keep their edge
    surface = data[f"{prefix}_weld"].astype(np.int64) * len(colors) + shade.ravel()[regions]
    normals = vertex_normals(vertices, faces, surface)
    return SkinnedMesh(
        mesh=Mesh(vertices=vertices, faces=faces, colors=colors[regions], normals=normals),
        joints=data[f"{prefix}_joints"],
        # whole 255ths do not sum to 1 exactly
        weights=weights / weights.sum(axis=1, keepdims=True),
        regions=regions,
    )
