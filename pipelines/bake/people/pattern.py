"""One pattern for everybody: topology, skin weights and borders are found once and only the vertices differ by body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake.people.cutting import Cloth, layered, normals, raised
from bake.people.designs import Outfit
from bake.people.garments import BROWS, HAIR, RANK, Tailor, joint_weight
from bake.people.rig import Rig
from bake.people.shaping import bun, seen_faces, shoe, smooth_skin
from h3data.bodies.people.skeleton import FINGERS
from h3data.geometry import Array

HEAD_DETAIL, NECK_DETAIL, HAND_DETAIL = 2.6, 1.5, 1.7
"""How much larger the reduction sees faces, necklines and hands, and so how much finer it keeps them."""
BROW_COLUMNS = 7
BROW_LIFT_M = 0.0035
"""Light faces lie up to 2 mm off the full ones."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reduction:
    """Vertices of a light mesh as points over the triangles of the full one."""

    corners: NDArray[np.int32]
    """Shape [N, 3]."""
    shares: Array
    """Barycentric coordinates [N, 3]."""
    height: Array
    """Above the surface [m], shape [N]."""
    faces: NDArray[np.int32]

    def points(self, vertices: Array, faces: NDArray[np.int32]) -> Array:
        """The light vertices [N, 3] over a full mesh of the same topology."""
        up = self.mixed(normals(vertices, faces))
        return self.mixed(vertices) + self.height[:, None] * up

    def mixed(self, values: Array) -> Array:
        """Values per full vertex [V, K] at the light vertices [N, K]."""
        return np.einsum("nk,nkj->nj", self.shares, values[self.corners])


def reduction(body: Cloth, count: int) -> Reduction:
    """The body by about ``count`` triangles, more of them where one looks: the eyes stay whole."""
    import fast_simplification  # pyright: ignore[reportMissingImports]

    swollen = _swollen(body)
    eye = joint_weight(body, ("left_eye_smplhf", "right_eye_smplhf")) > 0.9
    eyes, rest = body.faces[eye[body.faces].all(axis=1)], body.faces[~eye[body.faces].any(axis=1)]
    used, compact = np.unique(rest, return_inverse=True)
    points, triangles = fast_simplification.simplify(
        swollen[used].astype(np.float32), compact.reshape(-1, 3), target_count=count - len(eyes), agg=4
    )
    kept, compact = np.unique(triangles, return_inverse=True)
    corners, shares, height = _over_surface(points[kept].astype(np.float64), swollen, rest)
    eye_vertices, eye_faces = np.unique(eyes, return_inverse=True)
    whole = np.repeat(eye_vertices[:, None], 3, axis=1)
    own = np.tile([1.0, 0, 0], (len(whole), 1))
    return Reduction(
        corners=np.concatenate([corners, whole]).astype(np.int32),
        shares=np.concatenate([shares, own]),
        height=np.concatenate([height, np.zeros(len(whole))]),
        faces=np.concatenate([compact.reshape(-1, 3), eye_faces.reshape(-1, 3) + len(kept)]).astype(np.int32),
    )


def brow_ribbons(tailor: Tailor, body: Cloth) -> Reduction:
    """Both brows as ribbons on the face, for a mesh too coarse to be cut along them."""
    side = np.linspace(-0.0165, 0.0205, BROW_COLUMNS)
    middle = tailor.eye[1] + 0.0200 - 9.0 * (side - 0.004) ** 2
    half = 0.0034 - 0.06 * np.maximum(side, 0)
    rows = []
    for sign in (1.0, -1.0):
        x = sign * (side + tailor.eye_x)
        rows += [np.stack([x, middle + way * half, np.full(BROW_COLUMNS, 1.0)], axis=1) for way in (1.0, -1.0)]
    points = np.concatenate(rows)
    front = body.vertices[(body.vertices[:, 2] > tailor.eye[2] - 0.02) & tailor.is_head(body) & ~tailor.is_eye(body)]
    near = np.argmin(np.hypot(*(points[:, None, :2] - front[None, :, :2]).transpose(2, 0, 1)), axis=1)
    points[:, 2] = front[near, 2]
    eye = tailor.is_eye(body)
    corners, shares, _ = _over_surface(points, body.vertices, body.faces[~eye[body.faces].any(axis=1)])
    k = np.arange(BROW_COLUMNS - 1)
    n = BROW_COLUMNS
    left = np.concatenate([np.stack([k, k + n, k + 1], 1), np.stack([k + 1, k + n, k + n + 1], 1)])
    faces = np.concatenate([left, left[:, ::-1] + 2 * n])
    return Reduction(
        corners=corners, shares=shares, height=np.full(len(points), BROW_LIFT_M), faces=faces.astype(np.int32)
    )


def _swollen(body: Cloth) -> Array:
    """Vertices with head and hands enlarged from where they begin, smoothly by their skin weights."""
    head = joint_weight(body, ("head", "jaw"))
    vertices = body.vertices.copy()
    parts = [(head, HEAD_DETAIL), (joint_weight(body, ("neck", "left_collar", "right_collar")), NECK_DETAIL)]
    for side in ("left", "right"):
        fingers = tuple(f"{side}_{finger}{k}" for finger in FINGERS for k in (1, 2, 3))
        parts.append((joint_weight(body, (f"{side}_wrist", *fingers)), HAND_DETAIL))
    for weight, scale in parts:
        center = np.average(body.vertices, axis=0, weights=weight * (1 - weight))
        vertices += ((scale - 1) * weight)[:, None] * (body.vertices - center)
    return vertices


def _over_surface(points: Array, vertices: Array, faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], Array, Array]:
    """The nearest of the surface's triangles: corners [N, 3], barycentric coordinates [N, 3], height above it [N]."""
    from scipy.spatial import KDTree

    a, b, c = (vertices[faces[:, k]] for k in range(3))
    _, near = KDTree((a + b + c) / 3).query(points, k=24)
    p, e0, e1 = points[:, None] - a[near], (b - a)[near], (c - a)[near]
    d00, d01, d11 = (np.sum(x * y, -1) for x, y in ((e0, e0), (e0, e1), (e1, e1)))
    d20, d21 = np.sum(p * e0, -1), np.sum(p * e1, -1)
    area = np.maximum(d00 * d11 - d01**2, 1e-18)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    share = np.maximum(np.stack([1 - v - w, v, w], -1), 0)
    share /= share.sum(-1, keepdims=True)
    off = points[:, None] - np.einsum("nkc,nkcj->nkj", share, vertices[faces[near]])
    best = np.argmin(np.sum(off**2, -1), axis=1)
    rows = np.arange(len(points))
    face, share, off = np.asarray(near)[rows, best], share[rows, best], off[rows, best]
    up = np.einsum("nc,ncj->nj", share, normals(vertices, faces)[faces[face]])
    return faces[face], share, np.sum(off * up, axis=-1)


class Pattern:
    """What one mesh (full or light) of all bodies has in common. `fitted` gives the vertices of one body."""

    def __init__(self, rig: Rig, outfit: Outfit, *, light_faces: int | None) -> None:
        """From the pattern body; ``light_faces`` reduces it to about that many triangles before it is cut."""
        self._seen = seen_faces(rig)
        self._rows = (16, 9) if light_faces is None else (9, 6)  # rings of a shoe, of a bun
        self._tailor = tailor = Tailor(rig)
        skin = Cloth(vertices=smooth_skin(rig, outfit), weights=rig.weights, faces=self._seen)
        self._light = self._brows = None
        body = skin
        if light_faces is not None:
            self._light, self._brows = reduction(skin, light_faces), brow_ribbons(tailor, skin)
            body = _reduced(self._light, skin)
        shoes = [shoe(rig, side, self._rows[0]) for side in ("left", "right")]
        self._cut, self._splits, face_regions = tailor.cut_and_named(_merged([body, *shoes]), brows=light_faces is None)
        self._layers = layers = layered(self._cut, face_regions, RANK, hems=light_faces is None)
        extras = [(HAIR, bun(rig, 0.04, self._rows[1]))]
        if self._brows is not None:
            extras.append((BROWS, _reduced(self._brows, skin)))
        dressed = Cloth(vertices=self._cut.vertices[layers.source], weights=self._cut.weights[layers.source],
                        faces=layers.faces)  # fmt: skip
        whole = _merged([dressed, *(part for _, part in extras)])
        self.faces: NDArray[np.int32] = whole.faces
        self.weights: Array = whole.weights
        parts = [np.full(len(part.vertices), region, np.uint8) for region, part in extras]
        self.regions: NDArray[np.uint8] = np.concatenate([layers.regions, *parts])
        apart = layers.weld.max() + 1 + np.arange(sum(len(p) for p in parts))
        self.weld: NDArray[np.int64] = np.unique(np.concatenate([layers.weld, apart]), return_inverse=True)[1]

    def fitted(self, rig: Rig, outfit: Outfit) -> Array:
        """The vertices [V, 3] of a body in these clothes."""
        skin = vertices = smooth_skin(rig, outfit)
        if self._light is not None:
            vertices = self._light.points(skin, self._seen)
        shoes = [shoe(rig, side, self._rows[0]).vertices for side in ("left", "right")]
        vertices = np.concatenate([vertices, *shoes])
        for splits in self._splits:
            vertices = splits.extend(vertices)
        body = Cloth(vertices=vertices, weights=self._cut.weights, faces=self._cut.faces)
        parts = [raised(self._layers, body, self._tailor.heights(self._cut, outfit))]
        parts.append(bun(rig, outfit.bun_m, self._rows[1]).vertices)
        if self._brows is not None:
            parts.append(self._brows.points(skin, self._seen))
        return np.concatenate(parts)


def _reduced(light: Reduction, skin: Cloth) -> Cloth:
    return Cloth(vertices=light.points(skin.vertices, skin.faces), weights=light.mixed(skin.weights), faces=light.faces)


def _merged(parts: list[Cloth]) -> Cloth:
    starts = np.cumsum([0, *(len(p.vertices) for p in parts)])
    return Cloth(
        vertices=np.concatenate([p.vertices for p in parts]),
        weights=np.concatenate([p.weights for p in parts]),
        faces=np.concatenate([p.faces + int(s) for p, s in zip(parts, starts[:-1], strict=True)]).astype(np.int32),
    )
