"""People by a number: a build between those of two built-in bodies, and clothes, skin and hair of their own.

``random:SEED`` names such a person wherever a body has a name, also in recordings; the same seed gives the same person as long
as the built-in bodies stay as they are. All built-in bodies have one topology and arrays that blend linearly; legs are solved
for their measures, so feet stay planted on any blend.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

PREFIX = "random:"
BLEND = (0.15, 0.85)
"""Share of the second body: within these, nobody is a copy of a built-in one."""
BLENDED = (
    "bind_rotation", "bind_position", "joint_offsets", "capsule_start", "capsule_end", "capsule_radius", "feet",
    "ankle_height", "height_m", "walk", "jog",
)  # fmt: skip
HAIR = ((28, 22, 20), (58, 40, 30), (96, 66, 42), (148, 112, 70), (196, 164, 112), (122, 58, 36), (168, 166, 164))
IRIS = ((70, 52, 40), (58, 44, 36), (92, 74, 50), (84, 102, 82), (88, 110, 130))
SHOES = ((232, 230, 226), (44, 44, 48), (120, 84, 58), (196, 92, 72), (70, 92, 126))
CAP = 0.08
"""How often a cap covers the hair."""

Arrays = Mapping[str, NDArray[Any]]


def is_random(name: str) -> bool:
    """Whether a body's name means a random person: ``random:`` and a whole number."""
    return name.startswith(PREFIX) and name.removeprefix(PREFIX).isdecimal()


def random_arrays(
    name: str, bodies: Sequence[str], read: Callable[[str], Arrays], regions: Sequence[str], planes: Any
) -> dict[str, Any]:
    """The arrays of a baked file for ``random:SEED``.

    Args:
        name: The name.
        bodies: Names of the built-in bodies, sorted.
        read: Returns the arrays of the body with a name; called for the two that are blended.
        regions: Names of the regions that have a colour each.
        planes: The functions that store vertices as planes of bytes and read them: ``(to_planes, from_planes)``.
    """
    rng = np.random.Generator(np.random.Philox(int(name.removeprefix(PREFIX))))
    one, other = (read(bodies[int(k)]) for k in rng.choice(len(bodies), 2, replace=False))
    share = rng.uniform(*BLEND)
    to_planes, from_planes = planes
    mixed: dict[str, Any] = dict(one)
    for key in BLENDED:
        mixed[key] = (1 - share) * one[key].astype(np.float64) + share * other[key].astype(np.float64)
    u, _, v = np.linalg.svd(mixed["bind_rotation"])
    mixed["bind_rotation"] = u @ v  # the rotations next to the blended matrices
    for key in ("full_delta", "lod_delta"):
        blend = (1 - share) * from_planes(one[key]) + share * from_planes(other[key])
        mixed[key] = to_planes(np.rint(blend).astype(np.int16))
    index = {region: k for k, region in enumerate(regions)}
    skins = [body["region_colors"][index["skin"]].astype(np.float64) for body in (one, other)]
    bare = {
        region
        for region, everybody in (("sleeves", False), ("trouser legs", False), ("hair sides", True))
        if (all if everybody else any)(
            (body["region_colors"][index[region]] == skin).all() for body, skin in zip((one, other), skins, strict=True)
        )
    }  # what one of them shows bare has a hem there, which would be seen through long sleeves
    skin = (1 - share) * skins[0] + share * skins[1] + rng.normal(0, 5, 3)
    colors = _outfit(rng, np.clip(skin, 40, 245), bare)
    mixed["region_colors"] = np.array([colors[region] for region in regions], np.uint8)
    mixed["name"] = np.array(name)
    return mixed


def _outfit(rng: np.random.Generator, skin: NDArray[np.float64], bare: Collection[str]) -> dict[str, Any]:
    """Colours of the regions (sRGB, 0..255), of which some are bare."""
    shirt = _cloth(rng, saturation=(0.1, 0.55), value=(0.4, 0.85))
    trousers = _cloth(rng, saturation=(0.05, 0.4), value=(0.2, 0.6))
    hair = np.array(HAIR[rng.integers(len(HAIR))], np.float64)
    if skin.mean() < 130:  # fair hair is rare above dark skin
        hair = np.array(HAIR[rng.integers(2)], np.float64)
    cap = rng.random() < CAP
    return {
        "skin": skin,
        "shirt": shirt,
        "sleeves": skin if "sleeves" in bare else shirt,
        "trousers": trousers,
        "trouser legs": skin if "trouser legs" in bare else trousers,
        "socks": (226, 226, 222),
        "shoes": SHOES[rng.integers(len(SHOES))],
        "soles": (226, 223, 216),
        "hair": _cloth(rng, saturation=(0.2, 0.6), value=(0.3, 0.8)) if cap else hair,
        "hair sides": skin if "hair sides" in bare else hair,
        "brows": 0.72 * hair + 0.28 * skin,
        "sclera": (238, 234, 228),
        "iris": IRIS[rng.integers(len(IRIS))],
    }


def _cloth(
    rng: np.random.Generator, *, saturation: tuple[float, float], value: tuple[float, float]
) -> NDArray[np.float64]:
    color = colorsys.hsv_to_rgb(rng.random(), rng.uniform(*saturation), rng.uniform(*value))
    return 255 * np.array(color)
