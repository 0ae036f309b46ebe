"""People by a number: a build between those of two built-in bodies, and clothes, skin and hair of their own.

``random:SEED`` names such a person wherever a body has a name, also in recordings; the same seed gives the same person as long
as the built-in bodies stay as they are. All built-in bodies have one base and arrays that blend linearly; legs are solved
for their measures, so feet stay planted on any blend.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.look.colors import Color, Complexion
from h3data.bodies.people.look.dressing import Look, read_look
from h3data.bodies.people.look.wardrobe import OUTFITS

PREFIX = "random:"
BLEND = (0.15, 0.85)
"""Share of the second body: within these, nobody is a copy of a built-in one."""
BLENDED = (
    "bind_rotation", "bind_position", "joint_offsets", "capsule_start", "capsule_end", "capsule_radius", "feet",
    "ankle_height", "height_m", "walk", "jog",
)  # fmt: skip
HAIR: tuple[Color, ...] = (
    (32, 27, 26), (62, 44, 34), (98, 68, 45), (150, 114, 74), (198, 166, 116), (128, 64, 40),
)  # fmt: skip
GREY: Color = (176, 173, 170)
IRIS: tuple[Color, ...] = ((70, 52, 40), (58, 44, 36), (92, 74, 50), (84, 102, 82), (88, 110, 130))
STYLES = {
    "female": ("bob", "long", "tail", "bun", "waves", "curls", "tousled", "scarf"),
    "male": ("crop", "short", "swept", "tousled", "curls", "receding"),
}
"""Hairstyles that somebody has, by whether their phenotype is more female than male."""
OUTFIT_WEIGHTS = {"casual": 3, "smart": 2, "knit": 2, "sport": 2, "summer": 1, "dress": 2, "pyjamas": 1}

Arrays = Mapping[str, NDArray[Any]]


def is_random(name: str) -> bool:
    """Whether a body's name means a random person: ``random:`` and a whole number."""
    return name.startswith(PREFIX) and name.removeprefix(PREFIX).isdecimal()


def random_arrays(name: str, bodies: Sequence[str], read: Callable[[str], Arrays], planes: Any) -> dict[str, Any]:
    """The arrays of a baked file for ``random:SEED``.

    Args:
        name: The name.
        bodies: Names of the bodies to blend, sorted.
        read: Returns the arrays of the body with a name; called for the two that are blended.
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
    blend = (1 - share) * from_planes(one["base_delta"]) + share * from_planes(other["base_delta"])
    mixed["base_delta"] = to_planes(np.rint(blend).astype(np.int16))
    parents = [json.loads(str(body["phenotype"])) for body in (one, other)]
    traits = {key: (1 - share) * parents[0][key] + share * parents[1][key] for key in ("gender", "age")}
    looks = [read_look(str(body["look"])) for body in (one, other)]
    mixed["phenotype"] = np.array(
        json.dumps({k: (1 - share) * v + share * parents[1][k] for k, v in parents[0].items()})
    )
    mixed["look"] = np.array(_look(rng, looks, share, **traits).to_json())
    mixed["name"] = np.array(name)
    return mixed


def _look(rng: np.random.Generator, parents: Sequence[Look], share: float, *, gender: float, age: float) -> Look:
    """Skin between that of both parents; hair, face and clothes by chance, as they go with gender and age, 0..1."""
    one, other = (np.array(look.complexion.skin, np.float64) for look in parents)
    skin = np.clip((1 - share) * one + share * other + rng.normal(0, 5, 3), 40, 245)
    dark = skin.mean() < 135  # fair hair is rare above dark skin
    hair = np.array(HAIR[rng.integers(2 if dark else len(HAIR))], np.float64)
    grey = np.clip((age - 0.74) / 0.14 + rng.normal(0, 0.15), 0, 1)
    hair = (1 - grey) * hair + grey * np.array(GREY) + rng.normal(0, 4, 3)
    female = rng.random() < np.clip(1.6 * (gender - 0.5) + 0.5, 0, 1)
    styles = [s for s in STYLES["female" if female else "male"] if s != "receding" or grey > 0.25 or rng.random() < 0.2]
    outfits = {name: weight for name, weight in OUTFIT_WEIGHTS.items() if female or not OUTFITS[name].tights}
    names = sorted(outfits)
    weights = np.array([outfits[n] for n in names], np.float64)
    outfit = names[int(rng.choice(len(names), p=weights / weights.sum()))]
    style = styles[int(rng.integers(len(styles)))]
    scarf: dict[str, Color] = {}
    if style == "scarf":
        scarf["scarf"] = _rgb(np.array([90, 100, 130]) + rng.uniform(-40, 60, 3))
    palette = int(rng.integers(len(OUTFITS[outfit].colors)))
    beard = not female and rng.random() < 0.3
    stubble = 0.0 if female else float(rng.uniform(0, 0.5))
    return replace(
        parents[0],
        complexion=Complexion(
            skin=_rgb(skin), hair=_rgb(np.clip(hair, 16, 235)), iris=IRIS[rng.integers(2 if dark else len(IRIS))],
            lips=float(rng.uniform(0.35, 0.7) if female else rng.uniform(0.15, 0.35)),
            blush=float(rng.uniform(0.1, 0.2) if dark else rng.uniform(0.2, 0.45)),
            lines=float(np.clip((age - 0.74) * 2.2, 0, 0.7)), stubble=stubble,
        ),
        hair=style, beard=bool(beard), outfit=outfit, palette=palette, colors=scarf,
    )  # fmt: skip


def _rgb(values: NDArray[np.float64]) -> Color:
    red, green, blue = (int(round(v)) for v in values)
    return red, green, blue
