"""Dressing a rig: T-shirt, trousers, socks, shoes, hair, eyes and brows, all as smooth geometric fields in the rest pose.

Lengths are fractions of the stature where they grow with the person and metres where they do not (cloth thickness).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.skeleton import FINGERS, JOINT_INDEX
from h3data.geometry import Array, normalized
from h3data_pipelines.bake.cutting import Cloth, Dressed, Field, cut, raise_regions
from h3data_pipelines.bake.rig import Rig

REGIONS = ("skin", "shirt", "trousers", "socks", "shoes", "soles", "hair", "brows", "sclera", "iris")
SKIN, SHIRT, TROUSERS, SOCKS, SHOES, SOLES, HAIR, BROWS, SCLERA, IRIS = range(len(REGIONS))


HAIRLINES = {
    "over ears": (
        (0, 64),
        (25, 63),
        (45, 55),
        (62, 34),
        (78, 20),
        (92, 27),
        (108, 20),
        (125, -34),
        (150, -62),
        (180, -68),
    ),
    "short": ((0, 66), (25, 64), (45, 54), (60, 38), (74, 34), (90, 42), (110, 40), (124, 4), (138, -36), (180, -56)),
}
"""Azimuth [deg] and height above the eyes [mm at 1.63 m of stature] of the hairline."""


@dataclass(frozen=True, kw_only=True)
class Outfit:
    """How one body is dressed. Colours are sRGB."""

    colors: dict[str, tuple[int, int, int]]
    """One for each of `REGIONS`."""
    sleeve: float = 0.62
    """Where the sleeve ends, as a fraction of the upper arm."""
    hair_m: float = 0.022
    """Thickness of the hair on top [m]."""
    hairline: Literal["over ears", "short"] = "over ears"
    bun_m: float = 0.0
    """Radius of a bun at the back of the head [m]; 0 = none."""


def smoothstep(low: float, high: float, x: Array) -> Array:
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _weight(mesh: Cloth, names: tuple[str, ...]) -> Array:
    return mesh.weights[:, [JOINT_INDEX[n] for n in names]].sum(axis=1)


def _arm_names(side: str) -> tuple[str, ...]:
    fingers = tuple(f"{side}_{finger}{k}" for finger in FINGERS for k in (1, 2, 3))
    return (f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist", *fingers)


class Tailor:
    """The fields of one rig. Each returns metres, positive inside what its name says."""

    def __init__(self, rig: Rig, outfit: Outfit) -> None:
        self.rig, self.outfit = rig, outfit
        self.stature = float(rig.vertices[:, 1].max())
        self.eye = (rig.joint("left_eye_smplhf") + rig.joint("right_eye_smplhf")) / 2
        self.hem_y = float(rig.joint("pelvis")[1] + 0.002 * self.stature)
        ankle = float(rig.joint("left_ankle")[1])
        self.cuff_y, self.shoe_y, self.sole_y = ankle + 0.022, ankle - 0.004, 0.013
        self.head_z = float(np.mean(rig.vertices[rig.vertices[:, 1] > self.eye[1]][:, 2]))

    def is_eye(self, mesh: Cloth) -> NDArray[np.bool_]:
        """Vertices of the eyeballs."""
        return _weight(mesh, ("left_eye_smplhf", "right_eye_smplhf")) > 0.9

    def is_head(self, mesh: Cloth) -> NDArray[np.bool_]:
        return mesh.vertices[:, 1] > self.rig.joint("neck")[1]

    def bare_arm(self, mesh: Cloth) -> Array:
        """Beyond the sleeves: a plane across each upper arm."""
        result = np.full(len(mesh.vertices), -1.0)
        for side in ("left", "right"):
            shoulder, elbow = self.rig.joint(f"{side}_shoulder"), self.rig.joint(f"{side}_elbow")
            bone = elbow - shoulder
            middle = shoulder + self.outfit.sleeve * bone
            beyond = (mesh.vertices - middle) @ normalized(bone)
            result = np.where(_weight(mesh, _arm_names(side)) > 0.5, beyond, result)
        return result

    def neck(self, mesh: Cloth) -> Array:
        """Above the crew neck: a tilted plane, bent up towards the shoulders, so the border is a smooth oval."""
        base = self.rig.joint("neck") + np.array([0, -0.030, 0.0]) * self.stature
        offset = mesh.vertices - base
        return offset @ normalized(np.array([0.0, 1.0, 0.5])) - 4.0 * offset[:, 0] ** 2

    def above_hem(self, mesh: Cloth) -> Array:
        """Above the shirt's lower edge: a horizontal plane; the arms do not count."""
        arms = _weight(mesh, _arm_names("left")) + _weight(mesh, _arm_names("right")) > 0.5
        return np.where(arms, 1.0, mesh.vertices[:, 1] - self.hem_y)

    def above_cuff(self, mesh: Cloth) -> Array:
        return mesh.vertices[:, 1] - self.cuff_y

    def above_shoe(self, mesh: Cloth) -> Array:
        """Above the shoe's upper edge, which rises towards the heel."""
        z = mesh.vertices[:, 2] - self.rig.joint("left_ankle")[2]
        return mesh.vertices[:, 1] - self.shoe_y + 0.10 * z

    def above_sole(self, mesh: Cloth) -> Array:
        return mesh.vertices[:, 1] - self.sole_y

    def hair(self, mesh: Cloth) -> Array:
        """Above the hairline, whose height is a smooth function of the azimuth round the head (0 = front)."""
        from scipy.interpolate import PchipInterpolator

        x, y, z = mesh.vertices.T
        azimuth = np.degrees(np.abs(np.arctan2(x, z - self.head_z)))
        knots = np.array(HAIRLINES[self.outfit.hairline])
        line = PchipInterpolator(knots[:, 0], knots[:, 1] * 1e-3 * self.stature / 1.63)(azimuth)
        return np.where(self.is_head(mesh) & ~self.is_eye(mesh), y - self.eye[1] - line, -1.0)

    def brow(self, mesh: Cloth) -> Array:
        """Two arched bands above the eyes."""
        x, y, z = mesh.vertices.T
        side = np.abs(x) - self.eye_x
        middle = self.eye[1] + 0.0200 - 9.0 * (side - 0.004) ** 2
        taper = 0.0034 - 0.06 * np.maximum(side, 0)
        band = np.minimum(taper - np.abs(y - middle), 0.019 - np.abs(side - 0.002))
        return np.where((z > self.eye[2] - 0.02) & ~self.is_eye(mesh) & self.is_head(mesh), band, -1.0)

    @property
    def eye_x(self) -> float:
        return float(self.rig.joint("left_eye_smplhf")[0])

    def iris(self, mesh: Cloth) -> Array:
        """A disc on the front of each eyeball."""
        x, y, _ = mesh.vertices.T
        disc = 0.0062 - np.hypot(np.abs(x) - self.eye_x, y - self.eye[1])
        return np.where(self.is_eye(mesh), disc, -1.0)

    def cut_and_named(self, mesh: Cloth, *, brows: bool) -> tuple[Cloth, NDArray[np.uint8]]:
        """The mesh cut along every border, and the region of each of its faces. ``brows`` need a fine mesh."""
        fields: dict[str, Field] = {
            "arm": self.bare_arm, "neck": self.neck, "hem": self.above_hem, "cuff": self.above_cuff,
            "shoe": self.above_shoe, "sole": self.above_sole, "hair": self.hair, "iris": self.iris,
        }  # fmt: skip
        if brows:
            fields["brow"] = self.brow
        for field in fields.values():
            mesh = cut(mesh, field)
        assert mesh.sides is not None
        side = {name: mesh.sides[:, k] for k, name in enumerate(fields)}
        region = np.full(len(mesh.faces), SHIRT, np.uint8)
        for name, below in (("hem", TROUSERS), ("cuff", SOCKS), ("shoe", SHOES), ("sole", SOLES)):
            region[~side[name]] = below
        region[side["arm"] | side["neck"]] = SKIN
        region[side["hair"]] = HAIR
        if brows:
            region[side["brow"]] = BROWS
        region[self.is_eye(mesh)[mesh.faces].all(axis=1)] = SCLERA
        region[side["iris"]] = IRIS
        return mesh, region

    def thickness(self, mesh: Cloth, region: int) -> Array:
        """How far a region is lifted off the skin [m], per vertex."""
        y = mesh.vertices[:, 1]
        flat = np.zeros(len(y))
        if region == SHIRT:  # hangs looser towards the hem and the sleeve ends
            waist = smoothstep(self.hem_y + 0.14 * self.stature, self.hem_y, y)
            sleeve = smoothstep(-0.10, 0.0, self.bare_arm(mesh))
            return 0.006 + 0.008 * waist + 0.006 * sleeve * (self.bare_arm(mesh) > -0.5)
        if region == TROUSERS:  # straight cut: wider below the knee
            knee = float(self.rig.joint("left_knee")[1])
            return (
                0.005
                + 0.012 * smoothstep(knee + 0.05, self.cuff_y, y)
                + 0.002 * smoothstep(self.hem_y - 0.1, self.hem_y, y)
            )
        if region == HAIR:
            return self.outfit.hair_m * smoothstep(-0.004, 0.045, self.hair(mesh)) + 0.002
        return flat + {SOCKS: 0.001, BROWS: 0.0006}.get(region, 0.0)


def dress(rig: Rig, mesh: Cloth, outfit: Outfit, *, fine: bool = True) -> Dressed:
    """``mesh`` (the rig's, or a decimated one) cut into regions and lifted, with shoes and a bun; soles at the floor."""
    tailor = Tailor(rig, outfit)
    mesh = _merged([mesh, *(_shoe(tailor, side, 16 if fine else 9) for side in ("left", "right"))])
    mesh, regions = tailor.cut_and_named(mesh, brows=fine)
    dressed = raise_regions(mesh, regions, tailor.thickness)
    parts = [dressed]
    if outfit.bun_m > 0:
        parts.append(_bun(tailor, outfit.bun_m, rows=9 if fine else 6))
    return _joined(parts)


def _bun(tailor: Tailor, radius: float, *, rows: int) -> Dressed:
    """A knot of hair at the back of the head: an ellipsoid that moves with the head."""
    columns = 2 * rows
    v, u = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij")
    ball = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    head = tailor.rig.vertices[tailor.rig.vertices[:, 1] > tailor.eye[1]]
    center = np.array([0, tailor.eye[1] + 0.028, head[:, 2].min() - 0.45 * radius])
    vertices = center + ball * np.array([radius * 1.08, radius, radius * 0.85])
    weights = np.zeros((len(vertices), tailor.rig.weights.shape[1]))
    weights[:, JOINT_INDEX["head"]] = 1
    regions = np.full(len(vertices), HAIR, np.uint8)
    return Dressed(vertices=vertices, weights=weights, faces=_grid_faces(rows, columns), regions=regions)


def _merged(parts: list[Cloth]) -> Cloth:
    starts = np.cumsum([0, *(len(p.vertices) for p in parts)])
    return Cloth(
        vertices=np.concatenate([p.vertices for p in parts]),
        weights=np.concatenate([p.weights for p in parts]),
        faces=np.concatenate([p.faces + int(s) for p, s in zip(parts, starts[:-1], strict=True)]).astype(np.int32),
    )


def _joined(parts: list[Dressed]) -> Dressed:
    starts = np.cumsum([0, *(len(p.vertices) for p in parts)])
    return Dressed(
        vertices=np.concatenate([p.vertices for p in parts]),
        weights=np.concatenate([p.weights for p in parts]),
        faces=np.concatenate([p.faces + int(s) for p, s in zip(parts, starts[:-1], strict=True)]).astype(np.int32),
        regions=np.concatenate([p.regions for p in parts]),
    )


# --- the shape below the cloth ----------------------------------------------------------------------------------------
def shaped(rig: Rig, outfit: Outfit) -> Cloth:
    """The rig's mesh made ready for clothes: feet turned into shoes, muscles and creases under cloth smoothed away."""
    mesh = Cloth(vertices=rig.vertices, weights=rig.weights, faces=rig.faces)
    mesh = _without_tongue(mesh, rig)
    tailor = Tailor(rig, outfit)
    covered = smoothstep(0.0, 0.03, -tailor.bare_arm(mesh)) * smoothstep(0.0, 0.04, -tailor.neck(mesh))
    covered *= smoothstep(tailor.cuff_y - 0.02, tailor.cuff_y + 0.03, mesh.vertices[:, 1])
    vertices = _smoothed(mesh, covered, 12)
    hairy = smoothstep(0.0, 0.02, tailor.hair(mesh))
    vertices = _smoothed(Cloth(vertices=vertices, weights=mesh.weights, faces=mesh.faces), hairy, 10)
    in_shoe = tailor.above_shoe(mesh) < -0.02
    return Cloth(vertices=vertices, weights=mesh.weights, faces=mesh.faces[~in_shoe[mesh.faces].all(axis=1)])


def _without_tongue(mesh: Cloth, rig: Rig) -> Cloth:
    """The tongue and what else is a small part of its own inside the mouth is never seen: leave it out."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    f = mesh.faces
    edges = (np.ones(2 * len(f)), (np.r_[f[:, 0], f[:, 1]], np.r_[f[:, 1], f[:, 2]]))
    count, part = connected_components(coo_matrix(edges, shape=(len(mesh.vertices),) * 2), directed=False)
    eye = np.bincount(part, Tailor(rig, Outfit(colors={})).is_eye(mesh), minlength=count) > 0
    keep = eye | (np.bincount(part, minlength=count) == np.bincount(part).max())
    kept = keep[part]
    index = np.cumsum(kept) - 1
    return Cloth(
        vertices=mesh.vertices[kept], weights=mesh.weights[kept], faces=index[f[kept[f].all(axis=1)]].astype(np.int32)
    )


def _smoothed(mesh: Cloth, amount: Array, rounds: int) -> Array:
    """Vertices after Laplacian smoothing where ``amount`` [V] is 1; each round is undone by half (Taubin) to keep volume."""
    from scipy.sparse import coo_matrix, diags

    f = mesh.faces
    i, j = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]).T
    graph = coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(len(mesh.vertices),) * 2).tocsr()
    graph.data[:] = 1
    mean: Callable[[Array], Array] = (diags(1 / np.maximum(np.asarray(graph.sum(1)).ravel(), 1)) @ graph).dot
    vertices = mesh.vertices.copy()
    for _ in range(rounds):
        for step in (0.6, -0.3):
            vertices += step * amount[:, None] * (mean(vertices) - vertices)
    return vertices


SHOE_LEATHER_M = 0.005
TOE_BOX_M = 0.012
"""How much higher than the toes a shoe is there."""


def _shoe(tailor: Tailor, side: str, rows: int) -> Cloth:
    """A shoe: the convex hull of the foot below its upper edge, raised over the toes, as a grid of ``rows`` rings."""
    from scipy.spatial import ConvexHull, KDTree

    rig = tailor.rig
    body = Cloth(vertices=rig.vertices, weights=rig.weights, faces=rig.faces)
    ankle, ball = rig.joint(f"{side}_ankle"), rig.joint(f"{side}_foot")
    foot = (_weight(body, (f"{side}_ankle", f"{side}_foot")) > 0.5) & (tailor.above_shoe(body) < -SHOE_LEATHER_M)
    points = rig.vertices[foot]
    toe_box = points[points[:, 2] > ball[2]] + np.array([0, TOE_BOX_M, 0])
    hull = ConvexHull(np.concatenate([points, toe_box]))
    columns = 2 * rows
    v, u = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij")
    # rings across the foot's long axis; the sideways axis is squeezed so that the rings are even on the long hull
    ball_grid = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    axis = normalized((ball - ankle) * np.array([1, 0, 1]))
    side_axis = np.cross(np.array([0, 1.0, 0]), axis)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    middle[1] = 0.026
    # an ellipsoid inside the foot gives start points and directions: normals of the ellipsoid spread well
    half = np.array([0.012, 0.008, 0.36 * float(np.ptp(points @ axis))])
    frame = np.stack([side_axis, np.array([0, 1.0, 0]), axis])
    origin = middle + (ball_grid * half) @ frame
    direction = normalized((ball_grid / half) @ frame)
    normal, level = hull.equations[:, :3], hull.equations[:, 3] - SHOE_LEATHER_M
    speed = direction @ normal.T
    reach = np.where(speed > 1e-6, -(origin @ normal.T + level) / np.where(speed > 1e-6, speed, 1), np.inf).min(axis=1)
    vertices = origin + reach[:, None] * direction
    vertices[:, 1] = np.maximum(vertices[:, 1], 0)
    distance, nearest = KDTree(points).query(vertices, k=8)
    share = 1 / (distance + 0.01)
    share /= share.sum(axis=1, keepdims=True)
    weights = np.einsum("vk,vkj->vj", share, rig.weights[foot][nearest])
    return Cloth(vertices=vertices, weights=weights, faces=_grid_faces(rows, columns))


def _grid_faces(rows: int, columns: int) -> NDArray[np.int32]:
    """Triangles of a closed grid of rings, counter-clockwise from outside where (right, up, axis) is right-handed."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    quads = np.stack([np.stack([a, d, b], -1), np.stack([a, c, d], -1)])
    return quads.reshape(-1, 3).astype(np.int32)
