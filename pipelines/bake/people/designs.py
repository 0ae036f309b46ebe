"""The people that ship with the package: phenotypes, statures, faces and looks.

They are adults of different build, age and origin, older people, and children.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from bake.people.anny_shape import ShapeSpec
from h3data.bodies.people.look.colors import Color, Complexion
from h3data.bodies.people.look.dressing import Look

CALM: Mapping[str, float] = {"browInnerUp": 0.10, "mouthSmile": 0.16, "cheekSquint": 0.05}
"""Facial actions of all built-in people: relaxed brows and a slight smile."""


@dataclass(frozen=True, kw_only=True)
class BodySpec:
    """Specification of one built-in body: phenotype, stature, face and look."""

    phenotype: dict[str, float]
    """anny's parameters; ``height`` is found from the stature."""
    stature_m: float
    look: Look
    features: dict[str, float] = field(default_factory=dict)
    """Local changes of the face by MakeHuman's names (`ShapeSpec.features`)."""
    stoop_m: float = 0.0
    """Distance of head and neck ahead of where they would be upright [m]."""

    @property
    def shape(self) -> ShapeSpec:
        """Return the shape parameters for anny."""
        return ShapeSpec(phenotype=self.phenotype, stature_m=self.stature_m, features=self.features, expression=CALM)


def phenotype(
    gender: float,
    *,
    age: float = 0.67,
    muscle: float = 0.5,
    weight: float = 0.45,
    african: float = 0.0,
    asian: float = 0.0,
    proportions: float = 0.6,
) -> dict[str, float]:
    """Return the parameters of a body for anny.

    ``gender`` is 0 for male to 1 for female. ``age`` is 0.33 for a child, 0.67 for a young and 1 for an old person. The
    weights of origins sum to 1 together with Caucasian.
    """
    return {
        "gender": gender,
        "age": age,
        "muscle": muscle,
        "weight": weight,
        "proportions": proportions,
        "cupsize": 0.5,
        "firmness": 0.5,
        "african": african,
        "asian": asian,
        "caucasian": 1.0 - african - asian,
    }


def look(
    skin: Color,
    hair: Color,
    style: str,
    outfit: str = "casual",
    palette: int = 0,
    *,
    beard: bool = False,
    colors: Mapping[str, Color] | None = None,
    iris: Color = (70, 52, 40),
    **complexion: float,
) -> Look:
    """Return a look of skin, hair, clothes and colours."""
    return Look(
        complexion=Complexion(skin=skin, hair=hair, iris=iris, **complexion),
        hair=style,
        beard=beard,
        outfit=outfit,
        palette=palette,
        colors=dict(colors or {}),
    )


PATTERN = BodySpec(phenotype=phenotype(0.5), stature_m=1.70, look=look((128, 128, 128), (128, 128, 128), "crop"))
"""The body on which clothes are cut and hair is grown; on others they lie at the same anatomical places."""

_YOUNG = {
    "eye-scale-incr": 0.25,
    "cheek-volume-incr": 0.45,
    "chin-height-incr": -0.35,
    "nose-scale-vert-incr": -0.3,
    "nose-hump-incr": -0.3,
    "chin-prominent-incr": -0.2,
}
"""Round cheeks, large eyes, small nose and chin."""

BODIES = {
    "female_0": BodySpec(
        phenotype=phenotype(1),
        stature_m=1.63,
        look=look((230, 186, 160), (86, 56, 40), "bun", "casual", 0, iris=(78, 104, 92), lips=0.6),
        features={"head-scale-horiz-incr": -0.35, "nose-scale-vert-incr": -0.3, "eye-scale-incr": 0.25},
    ),
    "female_1": BodySpec(
        phenotype=phenotype(1, muscle=0.6, weight=0.52, african=1),
        stature_m=1.74,
        look=look((122, 82, 60), (34, 27, 25), "curls", "casual", 1, iris=(52, 36, 28), lips=0.5, blush=0.15),
        features={"nose-point-width-incr": -0.3, "chin-width-incr": -0.3, "cheek-bones-incr": 0.4},
    ),
    "female_2": BodySpec(
        phenotype=phenotype(1, age=0.92, weight=0.62),
        stature_m=1.57,
        look=look((224, 184, 164), (192, 188, 184), "waves", "knit", 4, iris=(92, 112, 128), lines=0.45, lips=0.35),
        features={"head-age-incr": 0.25, "nose-volume-incr": 0.2, "head-fat-incr": 0.25},
    ),
    "female_3": BodySpec(
        phenotype=phenotype(1, weight=0.36, asian=1),
        stature_m=1.60,
        look=look((236, 200, 170), (34, 31, 33), "tail", "summer", 2, lips=0.55),
        features={"chin-width-incr": -0.3, "mouth-scale-horiz-incr": -0.2},
    ),
    "male_0": BodySpec(
        phenotype=phenotype(0, muscle=0.55),
        stature_m=1.76,
        look=look((218, 170, 142), (62, 46, 36), "short", "smart", 0, iris=(84, 66, 48), stubble=0.35, lips=0.25),
        features={"chin-width-incr": 0.2, "nose-hump-incr": 0.2, "eye-height2-incr": 0.2},
    ),
    "male_1": BodySpec(
        phenotype=phenotype(0, muscle=0.68, weight=0.52, african=1),
        stature_m=1.88,
        look=look((98, 67, 52), (28, 24, 24), "crop", "sport", 2, beard=True, iris=(46, 34, 28), lips=0.25, blush=0.1),
        features={"chin-bones-incr": 0.3, "eye-scale-incr": 0.15},
    ),
    "male_2": BodySpec(
        phenotype=phenotype(0, age=0.95, weight=0.68, muscle=0.4),
        stature_m=1.70,
        look=look(
            (222, 178, 156),
            (182, 180, 178),
            "receding",
            "smart",
            1,
            iris=(96, 110, 122),
            lines=0.5,
            lips=0.2,
            stubble=0.2,
        ),
        features={"head-age-incr": 0.2, "ear-scale-incr": 0.25, "mouth-angles-up": 0.4, "head-fat-incr": 0.3},
    ),
    "male_3": BodySpec(
        phenotype=phenotype(0, muscle=0.5, weight=0.38, asian=1),
        stature_m=1.72,
        look=look((226, 186, 154), (32, 29, 31), "swept", "knit", 2, lips=0.25, stubble=0.15),
        features={"head-scale-vert-incr": 0.2, "nose-scale-horiz-incr": -0.2},
    ),
    "neutral_0": BodySpec(
        phenotype=phenotype(0.5),
        stature_m=1.69,
        look=look((208, 158, 126), (104, 70, 44), "tousled", "casual", 3, iris=(96, 80, 52)),
        features={"chin-width-incr": -0.4, "nose-curve-convex": 0.2},
    ),
    "neutral_1": BodySpec(
        phenotype=phenotype(0.4, muscle=0.58, weight=0.55, african=0.5),
        stature_m=1.78,
        look=look((154, 108, 82), (36, 28, 26), "short", "sport", 0, beard=True, lips=0.3, blush=0.2),
        features={"chin-height-incr": 0.3, "chin-prominent-incr": 0.2},
    ),
    "neutral_2": BodySpec(
        phenotype=phenotype(0.6, age=0.8, weight=0.74, muscle=0.42),
        stature_m=1.66,
        look=look((236, 196, 176), (158, 96, 58), "bob", "knit", 3, iris=(84, 110, 92), lines=0.15),
        features={"head-fat-incr": 0.45, "chin-height-incr": -0.3, "nose-scale-vert-incr": -0.2},
    ),
    "neutral_3": BodySpec(
        phenotype=phenotype(0.55, weight=0.34, muscle=0.45, asian=0.5),
        stature_m=1.61,
        look=look((202, 154, 118), (50, 38, 33), "crop", "summer", 1, lips=0.35),
        features={"forehead-scale-vert-incr": -0.3, "eye-scale-incr": 0.1},
    ),
    "older_0": BodySpec(
        phenotype=phenotype(1, age=1.0, weight=0.50, muscle=0.35),
        stature_m=1.55,
        look=look(
            (226, 186, 168), (214, 210, 206), "bun", "dress", 1, iris=(98, 116, 134), lines=0.75, lips=0.25, blush=0.45
        ),
        features={"head-age-incr": 0.5, "ear-scale-incr": 0.25, "mouth-angles-up": 0.5},
        stoop_m=0.055,
    ),
    "older_1": BodySpec(
        phenotype=phenotype(0, age=1.0, weight=0.50, muscle=0.32, african=0.35),
        stature_m=1.67,
        look=look((168, 122, 96), (206, 204, 202), "crop", "knit", 0, beard=True, lines=0.6, lips=0.15, blush=0.15),
        features={"head-age-incr": 0.45, "ear-scale-incr": 0.35, "nose-volume-incr": 0.3, "mouth-angles-up": 0.5},
        stoop_m=0.050,
    ),
    "child_0": BodySpec(
        phenotype=phenotype(0.9, age=0.30, weight=0.48),
        stature_m=1.22,
        look=look((236, 194, 170), (128, 88, 56), "tail", "dress", 3, iris=(96, 112, 120), lips=0.45, blush=0.5),
        features={**_YOUNG, "eye-scale-incr": 0.35},
    ),
    "child_1": BodySpec(
        phenotype=phenotype(0.1, age=0.32, weight=0.45, african=0.7),
        stature_m=1.30,
        look=look((124, 84, 62), (32, 26, 25), "curls", "summer", 3, iris=(50, 36, 28), lips=0.3, blush=0.15),
        features=_YOUNG,
    ),
    "child_2": BodySpec(
        phenotype=phenotype(0.85, age=0.36, weight=0.42, asian=0.8),
        stature_m=1.40,
        look=look((234, 196, 166), (36, 32, 34), "bob", "casual", 5, lips=0.4, blush=0.4),
        features=_YOUNG,
    ),
    "child_3": BodySpec(
        phenotype=phenotype(0.15, age=0.31, weight=0.54),
        stature_m=1.26,
        look=look((234, 192, 166), (176, 136, 88), "tousled", "sport", 3, iris=(86, 108, 132), lips=0.35, blush=0.5),
        features={**_YOUNG, "head-fat-incr": 0.3, "ear-wing-incr": 0.3},
    ),
}
