"""Reading humanoids from baked npz files: no pickle, whole numbers, planes of bytes that compress well.

The built-in bodies share one topology (``common.npz``: faces, skin weights, regions, mean vertices); a body's own file holds
its vertices as differences from the mean, its skeleton, colours, collision capsules and gait. A file may also hold both.
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
from h3data.bodies.people.random_humanoid import is_random, random_arrays
from h3data.bodies.people.skeleton import JOINT_INDEX, JOINT_NAMES
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError, did_you_mean
from h3data.geometry import Array, normalized
from h3data.mesh.mesh import Mesh

FILE_FORMAT, COMMON_FORMAT = "h3data.humanoid/2", "h3data.humanoid-common/2"
COMMON_FILE = "common.npz"
VERTEX_UNIT_M = 1e-4
"""Vertices are stored in whole tenths of a millimetre (int16: within 3.2 m of the origin)."""
WEIGHT_UNIT = 1 / 255

Arrays = Mapping[str, NDArray[Any]]


def humanoid_names() -> tuple[str, ...]:
    """Names of the built-in bodies, sorted."""
    return tuple(sorted(p.stem for p in builtin_path("bodies").glob("*.npz") if p.name != COMMON_FILE))


def _builtin_arrays(name: str) -> dict[str, Any]:
    return read_arrays(builtin_path(f"bodies/{name}.npz"), FILE_FORMAT)


@lru_cache(maxsize=32)
def load_humanoid(name: str | Path) -> Humanoid:
    """A built-in body by name (``female_0``), ``random:SEED`` (`h3data.bodies.people.random_humanoid`), or one from a file
    that ends in ``.npz``. Loaded once, then shared."""
    if is_random(str(name)):
        common = builtin_common()
        planes = to_planes, from_planes
        return _humanoid(
            random_arrays(str(name), humanoid_names(), _builtin_arrays, common.region_names, planes), common
        )
    if str(name).endswith(".npz"):
        path = Path(name)
    elif str(name) in humanoid_names():
        path = builtin_path(f"bodies/{name}.npz")
    else:
        near = did_you_mean(str(name), humanoid_names())
        raise InputError(
            f"No built-in humanoid {str(name)!r}.{near} There are: {', '.join(humanoid_names()) or 'none'}, "
            "and random:SEED."
        )
    data = read_arrays(path, FILE_FORMAT)
    try:
        common = _common(data) if "full_faces" in data else builtin_common()
        if common.name != str(data["common"]):
            raise FormatError(
                f"The humanoid was baked on another topology ({data['common']}) than the built-in one ({common.name}). "
                f"Hint: bake it again. File: {path}"
            )
        return _humanoid(data, common)
    except KeyError as error:
        raise FormatError(f"The humanoid file lacks the array {error}. Hint: bake it again. File: {path}") from error
    except (ValueError, IndexError) as error:
        raise FormatError(f"The humanoid file is damaged ({error}). Hint: bake it again. File: {path}") from error


def read_arrays(path: Path, expected: str) -> dict[str, NDArray[Any]]:
    """All arrays of an npz file whose ``format`` is ``expected``; never unpickles."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            data = {key: file[key] for key in file.files}
    except FileNotFoundError:
        raise InputError(f"Expected a humanoid file, found none there: {path}") from None
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise FormatError(f"Expected a humanoid file ({expected}), this is none ({error}): {path}") from error
    found = str(data.get("format", "another npz file"))
    if found != expected:
        raise FormatError(f"Expected a humanoid file ({expected}), got {found}. Hint: bake it again. File: {path}")
    return data


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """What the full or the light meshes of several bodies have in common."""

    mean: NDArray[np.int16]
    faces: NDArray[np.int32]
    joints: NDArray[np.uint8]
    weights: NDArray[np.float32]
    regions: NDArray[np.uint8]
    weld: NDArray[np.uint16]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Common:
    name: str
    full: _Part
    lod: _Part
    region_names: tuple[str, ...]
    capsule_names: tuple[str, ...]
    capsule_joints: tuple[int, ...]


@lru_cache(maxsize=1)
def builtin_common() -> _Common:
    """What the built-in bodies share, read once."""
    return _common(read_arrays(builtin_path(f"bodies/{COMMON_FILE}"), COMMON_FORMAT))


def _common(data: Arrays) -> _Common:
    names = tuple(str(n) for n in data["joint_names"])
    if names != JOINT_NAMES:
        raise FormatError(f"Expected the {len(JOINT_NAMES)} SMPL-X joints in their order, got {len(names)} others.")
    return _Common(
        name=str(data["common"]),
        full=_part(data, "full"),
        lod=_part(data, "lod"),
        region_names=tuple(str(n) for n in data["region_names"]),
        capsule_names=tuple(str(n) for n in data["capsule_names"]),
        capsule_joints=tuple(int(j) for j in data["capsule_joints"]),
    )


def _part(data: Arrays, prefix: str) -> _Part:
    weights = data[f"{prefix}_weights"].astype(np.float32) * np.float32(WEIGHT_UNIT)
    return _Part(
        mean=from_planes(data[f"{prefix}_mean"]),
        faces=data[f"{prefix}_faces"].astype(np.int32),
        joints=data[f"{prefix}_joints"],
        weights=weights / weights.sum(axis=1, keepdims=True),
        regions=data[f"{prefix}_regions"],
        weld=data[f"{prefix}_weld"],
    )


def to_planes(vertices: NDArray[np.int16]) -> NDArray[np.uint8]:
    """Vertices [V, 3] as planes of low and high bytes, uint8 [2, 3, V]: they compress by a third better."""
    flat = np.ascontiguousarray(vertices.astype("<i2").T)
    return np.ascontiguousarray(flat.view(np.uint8).reshape(3, -1, 2).transpose(2, 0, 1))


def from_planes(planes: NDArray[np.uint8]) -> NDArray[np.int16]:
    """The reverse of `to_planes`."""
    low, high = planes.astype(np.uint16)
    return np.ascontiguousarray((low | high << 8).astype(np.int16).T)


def _humanoid(data: Arrays, common: _Common) -> Humanoid:
    bind = np.tile(np.eye(4), (len(JOINT_NAMES), 1, 1))
    bind[:, :3, :3], bind[:, :3, 3] = data["bind_rotation"], data["bind_position"]
    offsets = data["joint_offsets"].astype(np.float64)
    height = float(data["height_m"])
    return Humanoid(
        name=str(data["name"]),
        height_m=height,
        joint_offsets=offsets,
        inverse_bind=np.linalg.inv(bind),
        full=_skinned_mesh(data, "full", common.full),
        lod=_skinned_mesh(data, "lod", common.lod),
        region_names=common.region_names,
        capsules=tuple(
            BodyCapsule(name=name, joint=joint, start=start, end=end, radius=float(radius))
            for name, joint, start, end, radius in zip(
                common.capsule_names, common.capsule_joints, data["capsule_start"].astype(np.float64),
                data["capsule_end"].astype(np.float64), data["capsule_radius"], strict=True,
            )
        ),
        gaits=Gaits(
            legs=legs_from_offsets(offsets, data["feet"].astype(np.float64), float(data["ankle_height"])),
            height_m=height,
            walk=data["walk"].astype(np.float64),
            jog=data["jog"].astype(np.float64),
        ),
        phenotype=json.loads(str(data["phenotype"])),
    )  # fmt: skip


def legs_from_offsets(offsets: Array, feet: Array, ankle_height: float) -> Legs:
    """The measures of legs from ``joint_offsets`` [55, 3] and the ``feet`` of `Legs` [2, 3, 3] [m]."""
    return Legs(
        hips=offsets[[JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]],
        thigh=float(np.linalg.norm(offsets[JOINT_INDEX["left_knee"]])),
        shank=float(np.linalg.norm(offsets[JOINT_INDEX["left_ankle"]])),
        ankle_height=ankle_height,
        feet=feet,
    )


def _skinned_mesh(data: Arrays, prefix: str, part: _Part) -> SkinnedMesh:
    vertices = (part.mean + from_planes(data[f"{prefix}_delta"])) * np.float32(VERTEX_UNIT_M)
    colors = data["region_colors"].astype(np.uint8)
    _, shade = np.unique(colors, axis=0, return_inverse=True)
    surface = part.weld.astype(np.int64) * len(colors) + shade.ravel()[part.regions]
    return SkinnedMesh(
        mesh=Mesh(
            vertices=vertices, faces=part.faces, colors=colors[part.regions],
            normals=vertex_normals(vertices, part.faces, surface),
        ),
        joints=part.joints, weights=part.weights, regions=part.regions, weld=part.weld,
    )  # fmt: skip


def vertex_normals(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], surface: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Unit normals per vertex, float32 [V, 3]: the mean of the faces around, weighted by their areas; vertices of the same
    ``surface`` [V] are one. Up where all faces around are degenerate (a hem of no height)."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    face_normals = np.cross(b - a, c - a)
    count = int(surface.max()) + 1
    corners = surface[faces.ravel()]
    total = np.stack(
        [np.bincount(corners, np.repeat(face_normals[:, k], 3), minlength=count) for k in range(3)], axis=1
    )
    own = total[surface]
    own[np.abs(own).max(axis=1) < 1e-12] = (0, 1, 0)
    return normalized(own).astype(np.float32)
