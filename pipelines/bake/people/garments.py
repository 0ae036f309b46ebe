"""Clothes, hair, eyes and brows as smooth geometric fields over a body in its rest pose.

Lengths are fractions of the stature where they grow with the person and metres where they do not (cloth thickness).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bake.people.cutting import Cloth, Field, Splits, cut
from bake.people.designs import Outfit
from bake.people.rig import Rig
from h3data.bodies.people.skeleton import FINGERS, JOINT_INDEX
from h3data.geometry import Array, normalized

REGIONS = (
    "skin", "shirt", "sleeves", "trousers", "trouser legs", "socks", "shoes", "soles", "hair", "hair sides", "brows",
    "sclera", "iris",
)  # fmt: skip
"""``sleeves`` (below the short sleeve), ``trouser legs`` (below the knee) and ``hair sides`` (over the ears) are skin on
those who wear none."""
(SKIN, SHIRT, SLEEVES, TROUSERS, LEGS, SOCKS, SHOES, SOLES, HAIR, HAIR_SIDES, BROWS, SCLERA, IRIS) = range(len(REGIONS))
RANK = (0, 7, 6, 5, 4, 2, 3, 1, 9, 8, 1, 0, 0)
"""Which of two regions lies over the other: the greater one gives a hem its colour."""

HAIRLINES = {
    "over ears": (
        (0, 66), (25, 64), (45, 54), (62, 34), (78, 20), (92, 27), (108, 20), (125, -34), (150, -62), (180, -68),
    ),
    "short": ((0, 66), (25, 64), (45, 54), (60, 38), (74, 34), (90, 42), (110, 40), (124, 4), (138, -36), (180, -56)),
}  # fmt: skip
"""Azimuth [deg] and height above the eyes [mm at 1.63 m of stature] of the hairline."""
SHORT_SLEEVE, LONG_SLEEVE = 0.62, 0.96
"""Where sleeves end: fraction of the upper arm, and of the forearm."""


def smoothstep(low: float, high: float, x: Array) -> Array:
    """0 below ``low``, 1 above ``high``, smooth between (or the reverse, for ``low`` > ``high``)."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def joint_weight(mesh: Cloth, names: tuple[str, ...]) -> Array:
    """Sum of the skin weights of some joints per vertex [V]."""
    return mesh.weights[:, [JOINT_INDEX[n] for n in names]].sum(axis=1)


def _arm_names(side: str) -> tuple[str, ...]:
    fingers = tuple(f"{side}_{finger}{k}" for finger in FINGERS for k in (1, 2, 3))
    return (f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist", *fingers)


class Tailor:
    """The fields of one rig. Each returns metres, positive inside what its name says."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.stature = float(rig.vertices[:, 1].max())
        self.eye = (rig.joint("left_eye_smplhf") + rig.joint("right_eye_smplhf")) / 2
        self.hem_y = float(rig.joint("pelvis")[1] + 0.002 * self.stature)
        self.knee_y = float(rig.joint("left_knee")[1] + 0.030 * self.stature)
        ankle = float(rig.joint("left_ankle")[1])
        self.cuff_y, self.shoe_y, self.sole_y = ankle + 0.022, ankle - 0.004, 0.013
        self.head_z = float(np.mean(rig.vertices[rig.vertices[:, 1] > self.eye[1]][:, 2]))

    def is_eye(self, mesh: Cloth) -> NDArray[np.bool_]:
        """Vertices of the eyeballs."""
        return joint_weight(mesh, ("left_eye_smplhf", "right_eye_smplhf")) > 0.9

    def is_head(self, mesh: Cloth) -> NDArray[np.bool_]:
        return mesh.vertices[:, 1] > self.rig.joint("neck")[1]

    def beyond_sleeve(self, mesh: Cloth, start: str, end: str, share: float) -> Array:
        """Beyond a plane across the bone from joint ``start`` to ``end`` of each arm."""
        result = np.full(len(mesh.vertices), -1.0)
        for side in ("left", "right"):
            near, far = self.rig.joint(f"{side}_{start}"), self.rig.joint(f"{side}_{end}")
            beyond = (mesh.vertices - near - share * (far - near)) @ normalized(far - near)
            result = np.where(joint_weight(mesh, _arm_names(side)) > 0.5, beyond, result)
        return result

    def lower_arm(self, mesh: Cloth) -> Array:
        return self.beyond_sleeve(mesh, "shoulder", "elbow", SHORT_SLEEVE)

    def hand(self, mesh: Cloth) -> Array:
        return self.beyond_sleeve(mesh, "elbow", "wrist", LONG_SLEEVE)

    def neck(self, mesh: Cloth) -> Array:
        """Above the crew neck: a tilted plane, bent up towards the shoulders, so the border is a smooth oval."""
        base = self.rig.joint("neck") + np.array([0, -0.030, 0.0]) * self.stature
        offset = mesh.vertices - base
        return offset @ normalized(np.array([0.0, 1.0, 0.5])) - 4.0 * offset[:, 0] ** 2

    def above_hem(self, mesh: Cloth) -> Array:
        """Above the shirt's lower edge: a horizontal plane; the arms do not count."""
        arms = joint_weight(mesh, _arm_names("left")) + joint_weight(mesh, _arm_names("right")) > 0.5
        return np.where(arms, 1.0, mesh.vertices[:, 1] - self.hem_y)

    def above_knee(self, mesh: Cloth) -> Array:
        return mesh.vertices[:, 1] - self.knee_y

    def above_cuff(self, mesh: Cloth) -> Array:
        return mesh.vertices[:, 1] - self.cuff_y

    def above_shoe(self, mesh: Cloth) -> Array:
        """Above the shoe's upper edge, which rises towards the heel."""
        z = mesh.vertices[:, 2] - self.rig.joint("left_ankle")[2]
        return mesh.vertices[:, 1] - self.shoe_y + 0.10 * z

    def above_sole(self, mesh: Cloth) -> Array:
        return mesh.vertices[:, 1] - self.sole_y

    def hair(self, mesh: Cloth, hairline: str) -> Array:
        """Above the hairline, whose height is a smooth function of the azimuth round the head (0 = front)."""
        from scipy.interpolate import PchipInterpolator

        x, y, z = mesh.vertices.T
        azimuth = np.degrees(np.abs(np.arctan2(x, z - self.head_z)))
        knots = np.array(HAIRLINES[hairline])
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

    def fields(self) -> dict[str, Field]:
        """What the pattern is cut along, in order."""
        return {
            "lower arm": self.lower_arm, "hand": self.hand, "neck": self.neck, "hem": self.above_hem,
            "knee": self.above_knee, "cuff": self.above_cuff, "shoe": self.above_shoe, "sole": self.above_sole,
            "hair": lambda mesh: self.hair(mesh, "short"), "hair sides": lambda mesh: self.hair(mesh, "over ears"),
            "iris": self.iris, "brow": self.brow,
        }  # fmt: skip

    def cut_and_named(self, mesh: Cloth, *, brows: bool) -> tuple[Cloth, list[Splits], NDArray[np.uint8]]:
        """The mesh cut along every border, the cuts in their order, and the region of each face.

        ``brows`` need a mesh finer than they are."""
        splits = []
        fields = self.fields()
        if not brows:
            del fields["brow"]
        for field in fields.values():
            mesh, added = cut(mesh, field)
            splits.append(added)
        assert mesh.sides is not None
        side = {name: mesh.sides[:, k] for k, name in enumerate(fields)}
        region = np.full(len(mesh.faces), SHIRT, np.uint8)
        levels = (("hem", TROUSERS), ("knee", LEGS), ("cuff", SOCKS), ("shoe", SHOES), ("sole", SOLES))
        for name, below in levels:
            region[~side[name]] = below
        region[side["lower arm"]] = SLEEVES
        region[side["hand"] | side["neck"]] = SKIN
        for name, inside in (("hair sides", HAIR_SIDES), ("hair", HAIR), ("brow", BROWS)):
            if name in side:
                region[side[name]] = inside
        region[self.is_eye(mesh)[mesh.faces].all(axis=1)] = SCLERA
        region[side["iris"]] = IRIS
        return mesh, splits, region

    def heights(self, mesh: Cloth, outfit: Outfit) -> Array:
        """How far each region is lifted off the skin [m], shape [R, V]; at the cut pattern, for anybody's clothes."""
        y = mesh.vertices[:, 1]
        out = np.zeros((len(REGIONS), len(y)))
        lower_arm, hand = self.lower_arm(mesh), self.hand(mesh)
        waist = smoothstep(self.hem_y + 0.14 * self.stature, self.hem_y, y)  # looser towards the hem
        out[SHIRT] = 0.006 + 0.008 * waist
        if outfit.long_sleeves:
            out[SHIRT] += 0.003 * smoothstep(-0.16, 0.0, lower_arm)
            out[SLEEVES] = 0.009 - 0.002 * smoothstep(-0.05, 0.0, hand)
        else:
            out[SHIRT] += 0.006 * smoothstep(-0.10, 0.0, lower_arm) * (lower_arm > -0.5)
        knee = float(self.rig.joint("left_knee")[1])
        if outfit.shorts:
            out[TROUSERS] = 0.005 + 0.012 * smoothstep(self.knee_y + 0.20, self.knee_y, y)
        else:  # straight cut: wider below the knee
            out[TROUSERS] = 0.005 + 0.012 * smoothstep(knee + 0.05, self.cuff_y, y)
            out[LEGS] = out[TROUSERS]
        out[TROUSERS] += 0.002 * smoothstep(self.hem_y - 0.1, self.hem_y, y)
        short, over = self.hair(mesh, "short"), self.hair(mesh, "over ears")
        if outfit.hairline == "over ears":
            out[HAIR_SIDES] = outfit.hair_m * smoothstep(-0.004, 0.045, over) + 0.002
            out[HAIR] = out[HAIR_SIDES]
        else:
            out[HAIR] = outfit.hair_m * smoothstep(-0.004, 0.045, short) + 0.002
        if outfit.cap is not None:
            out[HAIR] = np.maximum(out[HAIR], 0.003) + 0.006 * smoothstep(-0.004, 0.004, short)
        out[SOCKS], out[BROWS] = 0.001, 0.0006
        return out
