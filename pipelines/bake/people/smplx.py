"""A body file from the user's own SMPL-X model file (SMPLX_NEUTRAL.npz, ...); nothing of it ships, no smplx package needed.

The model's joints have our names and order, its zero pose is our T-pose, and it is Y-up and faces +Z as our body frame is.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake.people.capsules import capsule_parts
from bake.people.humanoid import body_arrays, digest, mesh_arrays, write_npz
from bake.people.rig import Rig
from h3data.bodies.people.humanoid_file import VERTEX_UNIT_M, to_planes
from h3data.bodies.people.skeleton import JOINT_COUNT, JOINT_INDEX, JOINT_NAMES, PARENTS
from h3data.errors import FormatError, InputError
from h3data.geometry import Array

LIGHT_FACES = 6000
KEYS = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")


def read_smplx(path: Path, betas: Sequence[float] = ()) -> Rig:
    """Return the shape with these coefficients in its T-pose, standing on y = 0.

    Raises:
        FormatError: the file is no SMPL-X model, or its skeleton is another one (SMPL and SMPL-H have fewer joints).
        InputError: more coefficients than the model has.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            missing = [key for key in KEYS if key not in file.files]
            data: dict[str, NDArray[Any]] = {key: np.asarray(file[key]) for key in KEYS if key not in missing}
    except FileNotFoundError:
        raise InputError(f"Expected an SMPL-X model file (.npz), found none there: {path}") from None
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise FormatError(f"Expected an SMPL-X model file (.npz), could not read this one: {path}") from error
    if missing:
        raise FormatError(f"Expected an SMPL-X model file, this one lacks {', '.join(missing)}: {path}")
    parents = data["kintree_table"][0].astype(np.int64)
    if len(parents) != JOINT_COUNT or tuple(parents[1:]) != PARENTS[1:]:
        raise FormatError(f"Expected the {JOINT_COUNT} joints of SMPL-X, this model has {len(parents)} others: {path}")
    directions = data["shapedirs"]
    if len(betas) > directions.shape[2]:
        raise InputError(f"The model has {directions.shape[2]} shape coefficients, got {len(betas)}: {path}")
    vertices = data["v_template"].astype(np.float64)
    vertices = vertices + directions[:, :, : len(betas)].astype(np.float64) @ np.asarray(betas, np.float64)
    joints = data["J_regressor"].astype(np.float64) @ vertices
    floor = np.array([0.0, vertices[:, 1].min(), 0.0])
    weights = data["weights"].astype(np.float64)
    return Rig(
        vertices=vertices - floor,
        faces=data["f"].astype(np.int32),
        weights=weights / weights.sum(axis=1, keepdims=True),
        positions=joints - floor,
        rotations=np.tile(np.eye(3), (JOINT_COUNT, 1, 1)),
    )


def bake_smplx(path: Path, target: Path, *, betas: Sequence[float] = (), color: tuple[int, int, int]) -> None:
    """Write the body file of a shape: one colour, light mesh, capsules and gait as the built-in bodies have."""
    rig = read_smplx(path, betas)
    light = _light(rig)
    meshes = {"full": (rig.vertices, rig.faces, rig.weights), "lod": light}
    parts = capsule_parts()
    arrays: dict[str, NDArray[Any]] = {
        "joint_names": np.array(JOINT_NAMES),
        "region_names": np.array(["skin"]),
        "capsule_names": np.array(list(parts)),
        "capsule_joints": np.array([JOINT_INDEX[joint] for joint, _ in parts.values()], np.uint8),
    }
    for name, (vertices, faces, weights) in meshes.items():
        whole = np.round(vertices / VERTEX_UNIT_M).astype(np.int16)
        own = np.arange(len(vertices))
        arrays |= mesh_arrays(name, whole, faces, weights, 0 * own, own)
        arrays[f"{name}_delta"] = to_planes(0 * whole)
    arrays["common"] = np.array(digest(arrays))
    arrays |= body_arrays(target.stem, rig, rig.vertices, rig.faces, rig.weights)
    arrays["source"] = np.array("SMPL-X (under its own licence: do not pass this file on)")
    arrays["phenotype"] = np.array(json.dumps({f"beta_{k}": float(beta) for k, beta in enumerate(betas)}))
    arrays["height_m"] = np.array(float(np.ptp(rig.vertices[:, 1])))
    arrays["region_colors"] = np.array([color], np.uint8)
    write_npz(target, arrays)


def _light(rig: Rig) -> tuple[Array, NDArray[np.int32], Array]:
    """Return vertices, faces and weights of a reduced mesh.

    The weights are those of the three nearest old vertices, by inverse distance.
    """
    if len(rig.faces) <= LIGHT_FACES:
        return rig.vertices, rig.faces, rig.weights
    from scipy.spatial import KDTree

    try:
        import fast_simplification  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise InputError("Reducing the mesh needs fast_simplification. Hint: pip install 'h3data[bodies]'.") from None
    points, faces = fast_simplification.simplify(rig.vertices.astype(np.float32), rig.faces, target_count=LIGHT_FACES)
    distance, nearest = KDTree(rig.vertices).query(points, k=3)
    share: Array = 1 / (distance + 1e-6)
    share /= share.sum(axis=1, keepdims=True)
    return points.astype(np.float64), faces.astype(np.int32), np.einsum("vk,vkj->vj", share, rig.weights[nearest])
