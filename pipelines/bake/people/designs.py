"""The people that are shipped: phenotypes, statures and clothes. Adults of different build, age, origin and dress."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Color = tuple[int, int, int]
"""sRGB, 0..255."""


@dataclass(frozen=True, kw_only=True)
class Outfit:
    """How one body is dressed."""

    skin: Color
    shirt: Color
    trousers: Color
    shoes: Color
    hair: Color
    iris: Color = (70, 52, 40)
    cap: Color | None = None
    """Colour of a knitted cap; None = bareheaded."""
    long_sleeves: bool = False
    shorts: bool = False
    hairline: Literal["over ears", "short"] = "over ears"
    hair_m: float = 0.022
    """Thickness of the hair on top [m]."""
    bun_m: float = 0.0
    """Radius of a bun at the back of the head [m]; 0 = none."""

    @property
    def colors(self) -> dict[str, Color]:
        """Colour of every region of the pattern."""
        skin, hair = self.skin, self.hair
        short = self.hairline == "short"
        brows = tuple(round(0.72 * h + 0.28 * s) for h, s in zip(hair, skin, strict=True))
        return {
            "skin": skin, "shirt": self.shirt, "sleeves": self.shirt if self.long_sleeves else skin,
            "trousers": self.trousers, "trouser legs": skin if self.shorts else self.trousers,
            "socks": (226, 226, 222), "shoes": self.shoes, "soles": (226, 223, 216), "hair": self.cap or hair,
            "hair sides": skin if short else hair, "brows": (brows[0], brows[1], brows[2]), "sclera": (238, 234, 228),
            "iris": self.iris,
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class BodySpec:
    """What one body is made from."""

    phenotype: dict[str, float]
    """anny's parameters; ``height`` is found from the stature."""
    stature_m: float
    outfit: Outfit


def phenotype(
    gender: float, *, age: float = 0.67, muscle: float = 0.5, weight: float = 0.45, african: float = 0.0,
    asian: float = 0.0, proportions: float = 0.6,
) -> dict[str, float]:  # fmt: skip
    """anny's parameters. ``gender`` 0 male to 1 female, ``age`` 0.67 young to 1 old; the origins sum to 1 with the rest
    Caucasian."""
    return {
        "gender": gender, "age": age, "muscle": muscle, "weight": weight, "proportions": proportions, "cupsize": 0.5,
        "firmness": 0.5, "african": african, "asian": asian, "caucasian": 1.0 - african - asian,
    }  # fmt: skip


_GREY: Color = (128, 128, 128)
PATTERN = BodySpec(
    phenotype=phenotype(0.5),
    stature_m=1.70,
    outfit=Outfit(skin=_GREY, shirt=_GREY, trousers=_GREY, shoes=_GREY, hair=_GREY),
)
"""The body on which the borders of the clothes are found; the others are cut at the same anatomical places."""

BODIES = {
    "female_0": BodySpec(
        phenotype=phenotype(1),
        stature_m=1.63,
        outfit=Outfit(
            skin=(226, 178, 150), shirt=(72, 148, 146), trousers=(52, 60, 86), shoes=(196, 92, 72), hair=(74, 48, 34),
            iris=(70, 92, 84), bun_m=0.042,
        ),
    ),
    "female_1": BodySpec(
        phenotype=phenotype(1, muscle=0.6, weight=0.52, african=1),
        stature_m=1.74,
        outfit=Outfit(
            skin=(112, 74, 54), shirt=(222, 170, 62), trousers=(62, 66, 74), shoes=(232, 230, 226), hair=(30, 24, 22),
            iris=(52, 36, 28), hair_m=0.034, long_sleeves=True,
        ),
    ),
    "female_2": BodySpec(
        phenotype=phenotype(1, age=0.92, weight=0.62),
        stature_m=1.57,
        outfit=Outfit(
            skin=(222, 182, 160), shirt=(142, 88, 124), trousers=(120, 112, 104), shoes=(84, 62, 52),
            hair=(188, 186, 184), iris=(92, 112, 128), hair_m=0.030, long_sleeves=True,
        ),
    ),
    "female_3": BodySpec(
        phenotype=phenotype(1, weight=0.36, asian=1),
        stature_m=1.60,
        outfit=Outfit(
            skin=(230, 192, 160), shirt=(232, 228, 220), trousers=(96, 124, 160), shoes=(58, 60, 66), hair=(28, 26, 28),
            hair_m=0.020, bun_m=0.034, shorts=True,
        ),
    ),
    "male_0": BodySpec(
        phenotype=phenotype(0, muscle=0.55),
        stature_m=1.76,
        outfit=Outfit(
            skin=(214, 164, 134), shirt=(214, 196, 160), trousers=(74, 82, 66), shoes=(70, 74, 84), hair=(52, 40, 32),
            iris=(84, 66, 48), hairline="short", hair_m=0.014,
        ),
    ),
    "male_1": BodySpec(
        phenotype=phenotype(0, muscle=0.68, weight=0.52, african=1),
        stature_m=1.88,
        outfit=Outfit(
            skin=(92, 62, 48), shirt=(176, 62, 54), trousers=(44, 48, 60), shoes=(222, 220, 214), hair=(26, 22, 22),
            iris=(46, 34, 28), hairline="short", hair_m=0.008,
        ),
    ),
    "male_2": BodySpec(
        phenotype=phenotype(0, age=0.95, weight=0.68, muscle=0.4),
        stature_m=1.70,
        outfit=Outfit(
            skin=(218, 172, 148), shirt=(86, 112, 158), trousers=(126, 108, 84), shoes=(72, 52, 42),
            hair=(176, 174, 172), iris=(96, 110, 122), hairline="short", hair_m=0.010, long_sleeves=True,
        ),
    ),
    "male_3": BodySpec(
        phenotype=phenotype(0, muscle=0.5, weight=0.38, asian=1),
        stature_m=1.72,
        outfit=Outfit(
            skin=(222, 180, 146), shirt=(76, 126, 92), trousers=(52, 54, 58), shoes=(206, 204, 196), hair=(26, 24, 26),
            hair_m=0.024, long_sleeves=True,
        ),
    ),
    "neutral_0": BodySpec(
        phenotype=phenotype(0.5),
        stature_m=1.69,
        outfit=Outfit(
            skin=(198, 146, 112), shirt=(236, 150, 96), trousers=(70, 86, 110), shoes=(90, 88, 86), hair=(92, 60, 36),
            iris=(96, 80, 52), hair_m=0.026,
        ),
    ),
    "neutral_1": BodySpec(
        phenotype=phenotype(0.4, muscle=0.58, weight=0.55, african=0.5),
        stature_m=1.78,
        outfit=Outfit(
            skin=(146, 100, 74), shirt=(108, 120, 128), trousers=(150, 136, 110), shoes=(48, 50, 56), hair=(34, 26, 24),
            hair_m=0.012, cap=(176, 74, 58), long_sleeves=True,
        ),
    ),
    "neutral_2": BodySpec(
        phenotype=phenotype(0.6, age=0.8, weight=0.74, muscle=0.42),
        stature_m=1.66,
        outfit=Outfit(
            skin=(232, 190, 168), shirt=(92, 76, 132), trousers=(48, 50, 58), shoes=(160, 156, 150),
            hair=(150, 92, 52), iris=(84, 110, 92), hair_m=0.018,
        ),
    ),
    "neutral_3": BodySpec(
        phenotype=phenotype(0.55, weight=0.34, muscle=0.45, asian=0.5),
        stature_m=1.61,
        outfit=Outfit(
            skin=(190, 140, 104), shirt=(70, 160, 190), trousers=(196, 184, 160), shoes=(176, 74, 70), hair=(40, 30, 26),
            hairline="short", hair_m=0.016, shorts=True,
        ),
    ),
}  # fmt: skip
