"""The shape below the cloth: feet turned into shoes, muscles and creases under cloth smoothed away, a bun of hair."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bake.people.cutting import Cloth
from bake.people.designs import Outfit
from bake.people.garments import Tailor, joint_weight, smoothstep
from bake.people.rig import Rig
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array, normalized

SHOE_LEATHER_M = 0.005
TOE_BOX_M = 0.012
"""How much higher than the toes a shoe is there."""


def seen_faces(rig: Rig) -> NDArray[np.int32]:
    """The faces [F, 3] without those inside the shoes, and without the tongue and what else is a small part of its own
    inside the mouth."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    f, body, tailor = rig.faces, Cloth(vertices=rig.vertices, weights=rig.weights, faces=rig.faces), Tailor(rig)
    edges = (np.ones(2 * len(f)), (np.r_[f[:, 0], f[:, 1]], np.r_[f[:, 1], f[:, 2]]))
    count, part = connected_components(coo_matrix(edges, shape=(len(rig.vertices),) * 2), directed=False)
    eye = np.bincount(part, tailor.is_eye(body), minlength=count) > 0
    keep = (eye | (np.bincount(part, minlength=count) == np.bincount(part).max()))[part]
    in_shoe = tailor.above_shoe(body) < -0.02
    return f[keep[f].all(axis=1) & ~in_shoe[f].all(axis=1)]


def smooth_skin(rig: Rig, outfit: Outfit) -> Array:
    """The vertices [V, 3], smoothed where cloth and hair lie over them."""
    body, tailor = Cloth(vertices=rig.vertices, weights=rig.weights, faces=rig.faces), Tailor(rig)
    sleeve_end = tailor.hand(body) if outfit.long_sleeves else tailor.lower_arm(body)
    leg_end = tailor.knee_y if outfit.shorts else tailor.cuff_y
    covered = smoothstep(0.0, 0.03, -sleeve_end) * smoothstep(0.0, 0.04, -tailor.neck(body))
    covered *= smoothstep(leg_end - 0.02, leg_end + 0.03, body.vertices[:, 1])
    vertices = _smoothed(rig.faces, body.vertices, covered, 12)
    return _smoothed(rig.faces, vertices, smoothstep(0.0, 0.02, tailor.hair(body, outfit.hairline)), 10)


def _smoothed(faces: NDArray[np.int32], vertices: Array, amount: Array, rounds: int) -> Array:
    """Vertices after Laplacian smoothing where ``amount`` [V] is 1; each round is undone by half (Taubin) to keep volume."""
    from scipy.sparse import coo_matrix, diags

    i, j = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    graph = coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(len(vertices),) * 2).tocsr()
    graph.data[:] = 1
    mean: Callable[[Array], Array] = (diags(1 / np.maximum(np.asarray(graph.sum(1)).ravel(), 1)) @ graph).dot
    vertices = vertices.copy()
    for _ in range(rounds):
        for step in (0.6, -0.3):
            vertices += step * amount[:, None] * (mean(vertices) - vertices)
    return vertices


def shoe(rig: Rig, side: str, rows: int) -> Cloth:
    """A shoe: the convex hull of the foot below its upper edge, raised over the toes, as a grid of ``rows`` rings."""
    from scipy.spatial import ConvexHull, KDTree

    body = Cloth(vertices=rig.vertices, weights=rig.weights, faces=rig.faces)
    ankle, ball = rig.joint(f"{side}_ankle"), rig.joint(f"{side}_foot")
    foot = joint_weight(body, (f"{side}_ankle", f"{side}_foot")) > 0.5
    foot &= Tailor(rig).above_shoe(body) < -SHOE_LEATHER_M
    points = rig.vertices[foot]
    toe_box = points[points[:, 2] > ball[2]] + np.array([0, TOE_BOX_M, 0])
    hull = ConvexHull(np.concatenate([points, toe_box]))
    # rings across the foot's long axis; the sideways axis is squeezed so that the rings are even on the long hull
    grid = sphere_grid(rows)
    axis = normalized((ball - ankle) * np.array([1, 0, 1]))
    frame = np.stack([np.cross(np.array([0, 1.0, 0]), axis), np.array([0, 1.0, 0]), axis])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    middle[1] = 0.026
    # an ellipsoid inside the foot gives start points and directions: normals of the ellipsoid spread well
    half = np.array([0.012, 0.008, 0.36 * float(np.ptp(points @ axis))])
    origin = middle + (grid * half) @ frame
    direction = normalized((grid / half) @ frame)
    normal, level = hull.equations[:, :3], hull.equations[:, 3] - SHOE_LEATHER_M
    speed = direction @ normal.T
    reach = np.where(speed > 1e-6, -(origin @ normal.T + level) / np.where(speed > 1e-6, speed, 1), np.inf).min(axis=1)
    vertices = origin + reach[:, None] * direction
    vertices[:, 1] = np.maximum(vertices[:, 1], 0)
    distance, nearest = KDTree(points).query(vertices, k=8)
    share = 1 / (distance + 0.01)
    share /= share.sum(axis=1, keepdims=True)
    weights = np.einsum("vk,vkj->vj", share, rig.weights[foot][nearest])
    return Cloth(vertices=vertices, weights=weights, faces=grid_faces(rows))


def bun(rig: Rig, radius: float, rows: int) -> Cloth:
    """A knot of hair at the back of the head: an ellipsoid that moves with the head; a point inside it for radius 0."""
    eye = (rig.joint("left_eye_smplhf") + rig.joint("right_eye_smplhf")) / 2
    head = rig.vertices[rig.vertices[:, 1] > eye[1]]
    center = np.array([0, eye[1] + 0.028, head[:, 2].min() - 0.45 * radius + (0.05 if radius == 0 else 0.0)])
    vertices = center + sphere_grid(rows) * np.array([radius * 1.08, radius, radius * 0.85])
    weights = np.zeros((len(vertices), rig.weights.shape[1]))
    weights[:, JOINT_INDEX["head"]] = 1
    return Cloth(vertices=vertices, weights=weights, faces=grid_faces(rows))


def sphere_grid(rows: int) -> Array:
    """Points of a unit sphere [2 rows^2, 3]: ``rows`` rings of 2 ``rows`` points, from +z to -z."""
    angle = np.linspace(0, 2 * np.pi, 2 * rows, endpoint=False)
    v, u = np.meshgrid(np.linspace(0, np.pi, rows), angle, indexing="ij")
    return np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)


def grid_faces(rows: int) -> NDArray[np.int32]:
    """Triangles of `sphere_grid`, counter-clockwise from outside."""
    columns = 2 * rows
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    quads = np.stack([np.stack([a, d, b], -1), np.stack([a, c, d], -1)])
    return quads.reshape(-1, 3).astype(np.int32)
