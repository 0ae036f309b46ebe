"""Eighteen capsules around a dressed body: least squares on the mesh, with vertices outside costing three times as much."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bake.people.rig import Rig
from h3data.bodies.people.humanoid import BodyCapsule
from h3data.bodies.people.skeleton import FINGERS, JOINT_INDEX
from h3data.geometry import Array

OUTSIDE_COST = 3.0
TIP_COST = 0.3
"""Weight that makes the ends of the capsules meet the ends of the part; without it the fit degenerates (a 2.4 m head)."""


def capsule_parts() -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return, by capsule name, its joint and the joints whose vertices it encloses."""
    parts: dict[str, tuple[str, tuple[str, ...]]] = {
        "pelvis": ("pelvis", ("pelvis",)),
        "abdomen": ("spine1", ("spine1",)),
        "chest_low": ("spine2", ("spine2",)),
        "chest_high": ("spine3", ("spine3", "left_collar", "right_collar")),
        "neck": ("neck", ("neck",)),
        "head": ("head", ("head", "jaw", "left_eye_smplhf", "right_eye_smplhf")),
    }
    for side in ("left", "right"):
        fingers = tuple(f"{side}_{finger}{k}" for finger in FINGERS for k in (1, 2, 3))
        parts |= {
            f"{side}_upper_arm": (f"{side}_shoulder", (f"{side}_shoulder",)),
            f"{side}_forearm": (f"{side}_elbow", (f"{side}_elbow",)),
            f"{side}_hand": (f"{side}_wrist", (f"{side}_wrist", *fingers)),
            f"{side}_thigh": (f"{side}_hip", (f"{side}_hip",)),
            f"{side}_shank": (f"{side}_knee", (f"{side}_knee",)),
            f"{side}_foot": (f"{side}_ankle", (f"{side}_ankle", f"{side}_foot")),
        }
    return parts


def fit_capsules(rig: Rig, vertices: Array, faces: NDArray[np.int32], weights: Array) -> tuple[BodyCapsule, ...]:
    """Fit capsules to a dressed mesh [V, 3] with skin weights [V, 55], in the frames of the joints.

    Vertices are weighted by the area around them.
    """
    area = _vertex_areas(vertices, faces)
    dominant = np.argmax(weights, axis=1)
    capsules = []
    for name, (joint, members) in capsule_parts().items():
        chosen = np.isin(dominant, [JOINT_INDEX[m] for m in members]) & (area > 0)
        start, end, radius = _fit(vertices[chosen], area[chosen] / area[chosen].sum())
        index = JOINT_INDEX[joint]
        turn, origin = rig.rotations[index], rig.positions[index]
        capsules.append(
            BodyCapsule(
                name=name, joint=index, start=turn.T @ (start - origin), end=turn.T @ (end - origin), radius=radius
            )
        )
    return tuple(capsules)


def _vertex_areas(vertices: Array, faces: NDArray[np.int32]) -> Array:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(faces.ravel(), np.repeat(third, 3), minlength=len(vertices)).astype(np.float64)


def segment_distance(points: Array, start: Array, end: Array) -> Array:
    """Return distances [N] of points [N, 3] from the segment between two points [3]."""
    way = end - start
    t = np.clip((points - start) @ way / max(float(way @ way), 1e-12), 0, 1)
    return np.linalg.norm(points - (start + t[:, None] * way), axis=1)


def _fit(points: Array, share: Array) -> tuple[Array, Array, float]:
    from scipy.optimize import minimize

    middle = points.mean(axis=0)
    axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    along = (points - middle) @ axis
    radius = float(np.median(np.linalg.norm((points - middle) - along[:, None] * axis, axis=1)))
    low, high = np.percentile(along, [1, 99]) + np.array([radius, -radius])
    if high < low:
        low = high = (low + high) / 2
    first = np.concatenate([middle + low * axis, middle + high * axis, [np.log(radius)]])

    def cost(x: Array) -> float:
        start, end, r = x[:3], x[3:6], float(np.exp(x[6]))
        error = segment_distance(points, start, end) - r
        length = float(np.linalg.norm(end - start)) + 1e-9
        place = (points - start) @ (end - start) / length
        tips = (length + r - place.max()) ** 2 + (r + place.min()) ** 2
        return float((share * np.where(error > 0, OUTSIDE_COST, 1) * error**2).sum() + TIP_COST * tips)

    best = minimize(cost, first, method="L-BFGS-B", options={"maxiter": 80}).x
    return best[:3], best[3:6], float(np.exp(best[6]))
