"""Shape of bent joints: all bodies, each joint bent by 90 and 130 degrees, compared with the straight joint.

``bodies.bent.<joint>.<angle>.section`` is the area of the limb's cross-section, the mesh cut at rest at the joint across the
bone, ``bodies.bent.<joint>.<angle>.volume`` the volume between the joint and the skin that moves with both bones. Both are
shares of those of the straight joint, the mean of all bodies; ``.worst`` is the body that keeps least. ``plain`` instead of
``bent`` leaves out the half joints (`h3data.bodies.people.skinning`).

    python -m benchmarks bending
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from h3data.bodies import JOINT_INDEX, Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.skeleton import PARENTS
from h3data.geometry import Array, normalized

BENDS = {
    "knee": ("ankle", (1.0, 0, 0)),
    "elbow": ("wrist", (0, -1.0, 0)),
    "hip": ("knee", (-1.0, 0, 0)),
    "shoulder": ("elbow", (0, -1.0, 0)),
}
"""Next joint after a left joint, and the axis about which it bends in a T-pose."""
ANGLES_DEG = (90, 130)


def bent(body: Humanoid, joint: str, degrees: float) -> Array:
    """Return the frames [1, 55, 4, 4] of a T-pose with one left joint bent."""
    quats, half = np.tile([0.0, 0, 0, 1], (1, 54, 1)), np.radians(degrees) / 2
    quats[0, JOINT_INDEX[f"left_{joint}"] - 1] = [*(np.sin(half) * np.array(BENDS[joint][1])), np.cos(half)]
    return body.joint_matrices_free(np.array([[0, 1.0, 0, 0, 0, 0, 1]]), quats)


def sizes(body: Humanoid, joint: str, degrees: float, *, plain: bool) -> tuple[float, float]:
    """Return the cross-section [m^2] and the volume of the skin at a bent joint [m^3]."""
    mesh, place = body.mesh, JOINT_INDEX[f"left_{joint}"]
    weights = np.zeros((len(mesh.vertices), len(PARENTS)))
    np.add.at(weights, (np.arange(len(weights))[:, None], body.full.joints), body.full.weights)
    own, above = weights[:, place], weights[:, PARENTS[place]]
    frames = bent(body, joint, degrees)
    skin = body.skin(frames, lod=False, plain=plain)[0].astype(np.float64) - frames[0, place, :3, 3]
    # triangles of this limb that the plane across the bone cuts at rest, with the shares at which it cuts their sides
    rest = np.linalg.inv(body.inverse_bind)[[place, JOINT_INDEX[f"left_{BENDS[joint][0]}"]], :3, 3]
    height = (mesh.vertices - rest[0]) @ normalized(rest[1] - rest[0])
    faces = mesh.faces[(own + above > 0.5)[mesh.faces].all(1)]
    sides = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    a, b = sides[height[sides[:, 0]] * height[sides[:, 1]] < 0].T
    share = (height[a] / (height[a] - height[b]))[:, None]
    cut = (1 - share) * skin[a] + share * skin[b]
    cut -= cut.mean(0)
    flat = cut @ np.linalg.svd(cut, full_matrices=False)[2][:2].T
    corners = skin[mesh.faces[((own > 0.02) & (above > 0.02))[mesh.faces].any(1)]]
    volume = np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) / 6
    return float(ConvexHull(flat).volume), float(volume)


def kept(body: Humanoid, joint: str, *, plain: bool) -> NDArray[np.float64]:
    """Return the shares of section and volume that are left at `ANGLES_DEG`, shape [A, 2]."""
    straight, *others = (np.array(sizes(body, joint, angle, plain=plain)) for angle in (0, *ANGLES_DEG))
    return np.array(others) / straight


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit the shares of all joints, with and without half joints."""
    for joint in BENDS:
        for name, plain in (("plain", True), ("bent", False)):
            shares = np.stack([kept(load_humanoid(body), joint, plain=plain) for body in humanoid_names()])
            for at, angle in enumerate(ANGLES_DEG):
                for k, what in enumerate(("section", "volume")):
                    emit(
                        f"bodies.{name}.{joint}.{angle}.{what}", float(shares[:, at, k].mean()), "of the straight joint"
                    )
                    emit(f"bodies.{name}.{joint}.{angle}.{what}.worst", float(shares[:, at, k].min()), "")
