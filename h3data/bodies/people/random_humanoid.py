"""People that are generated from a seed, with random shapes between those of the built-in bodies, clothes, skin and hair.

``random:SEED`` names such a person wherever a body has a name, also in recordings; the same seed gives the same person
as long as the built-in bodies and ``shape_space.toml`` stay as they are. All built-in bodies have one base and arrays
that may be combined linearly; legs are solved for the measures of each body, so feet stay planted on all of them.

The space has the mean of all bodies and `DIRECTIONS` principal directions of shape, as SMPL-X has its shape parameters;
a person has a standard normal number for each. Shapes that are not adult, or far from all built-in bodies, are sampled
again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.look.colors import Color, Complexion
from h3data.bodies.people.look.dressing import Look, read_look
from h3data.bodies.people.look.wardrobe import OUTFITS
from h3data.builtin import builtin_path
from h3data.geometry import add_up

PREFIX = "random:"
SHAPE_SPACE = "bodies/shape_space.toml"
DIRECTIONS = 10
ADULT_HEIGHT_M = (1.5, 1.95)


def is_random(name: str) -> bool:
    """Return whether a body's name means a random person: ``random:`` and a whole number."""
    return name.startswith(PREFIX) and name.removeprefix(PREFIX).isdecimal()


class _ShapeSpace(msgspec.Struct, frozen=True):
    """Space of body shapes, as written by ``python -m bake.people.shape_space``."""

    bodies: tuple[str, ...]
    directions: tuple[tuple[float, ...], ...]
    """A row of weights of the bodies for each direction; a step of 1 is a standard deviation."""


@lru_cache(maxsize=1)
def _shape_space() -> _ShapeSpace:
    return msgspec.toml.decode(builtin_path(SHAPE_SPACE).read_bytes(), type=_ShapeSpace)


def random_arrays(name: str, read: Callable[[str], Mapping[str, NDArray[Any]]], planes: Any) -> dict[str, Any]:
    """Return the arrays of a baked file for ``random:SEED``.

    Args:
        name: The name ``random:SEED``.
        read: Function that returns the arrays of the body with a name; it is called for all built-in bodies.
        planes: The functions that store vertices as planes of bytes and read them: ``(to_planes, from_planes)``.
    """
    # named, because NumPy may change its default generator, and seeds have to keep their meaning
    rng = np.random.Generator(np.random.Philox(int(name.removeprefix(PREFIX))))
    bodies = [read(body) for body in _shape_space().bodies]
    phenotypes = [json.loads(str(body["phenotype"])) for body in bodies]
    weights = _weights(rng, [p["age"] for p in phenotypes], [float(body["height_m"]) for body in bodies])
    to_planes, from_planes = planes
    nearest = int(np.argmax(weights))
    # what cannot be combined, such as names of joints, is that of the nearest body
    mixed: dict[str, Any] = dict(bodies[nearest])
    combined = (
        "bind_rotation",
        "bind_position",
        "joint_offsets",
        "capsule_start",
        "capsule_end",
        "capsule_radius",
        "feet",
        "ankle_height",
        "height_m",
        "walk",
        "jog",
    )
    for key in combined:
        mixed[key] = _combined(weights, [body[key] for body in bodies])
    u, _, v = np.linalg.svd(mixed["bind_rotation"])
    mixed["bind_rotation"] = u @ v  # the rotations next to the combined matrices
    shape = _combined(weights, [from_planes(body["base_delta"]) for body in bodies])
    mixed["base_delta"] = to_planes(np.rint(shape).astype(np.int16))
    # weights may be negative, so that a sum of shares may lie outside 0..1
    traits = {
        key: min(max(add_up(w * p[key] for w, p in zip(weights, phenotypes, strict=True)), 0.0), 1.0)
        for key in phenotypes[0]
    }
    mixed["phenotype"] = np.array(json.dumps(traits))
    skins = [read_look(str(body["look"])).complexion.skin for body in bodies]
    skin = np.clip(_combined(weights, [np.array(skin) for skin in skins]), 40, 245)
    look = read_look(str(bodies[nearest]["look"]))
    mixed["look"] = np.array(_look(rng, look, skin, gender=traits["gender"], age=traits["age"]).to_json())
    mixed["name"] = np.array(name)
    return mixed


def _weights(rng: np.random.Generator, ages: Sequence[float], heights_m: Sequence[float]) -> list[float]:
    """Return the weight of each built-in body in a person; they sum to 1, and some are negative."""
    directions = _shape_space().directions
    # range of the age of an adult phenotype; children are below it, and 1 is the oldest
    adult_age = (0.6, 1.0)
    while True:
        steps = rng.standard_normal(len(directions)).tolist()
        weights = [
            1 / len(ages) + add_up(step * row[k] for step, row in zip(steps, directions, strict=True))
            for k in range(len(ages))
        ]
        age, height = (add_up(w * v for w, v in zip(weights, of, strict=True)) for of in (ages, heights_m))
        of_adult = adult_age[0] <= age <= adult_age[1] and ADULT_HEIGHT_M[0] <= height <= ADULT_HEIGHT_M[1]
        # 2.2: largest sum of the absolute weights of all bodies, which themselves sum to 1: a combination is
        # nearer to the built-in ones the smaller it is
        if of_adult and add_up(map(abs, weights)) <= 2.2:
            return weights


def _combined(weights: Sequence[float], arrays: Sequence[NDArray[Any]]) -> NDArray[np.float64]:
    """Return the values summed body by body, in this order, so that the numbers are the same on every machine."""
    total = np.zeros(np.shape(arrays[0]))
    for weight, array in zip(weights, arrays, strict=True):
        total += weight * np.asarray(array, np.float64)
    return total


def _look(rng: np.random.Generator, like: Look, skin: NDArray[np.float64], *, gender: float, age: float) -> Look:
    """Return random hair, face and clothes that go with gender, age and skin, 0..1."""
    # the order of the random numbers is part of what a seed means: new ones go last
    skin = np.clip(skin + rng.normal(0, 5, 3), 40, 245)
    dark = skin.mean() < 135  # fair hair is rare above dark skin
    hair_colors: tuple[Color, ...] = (
        (32, 27, 26),
        (62, 44, 34),
        (98, 68, 45),
        (150, 114, 74),
        (198, 166, 116),
        (128, 64, 40),
    )
    hair = np.array(hair_colors[rng.integers(2 if dark else len(hair_colors))], np.float64)
    grey = np.clip((age - 0.74) / 0.14 + rng.normal(0, 0.15), 0, 1)
    greyed: Color = (176, 173, 170)
    hair = (1 - grey) * hair + grey * np.array(greyed) + rng.normal(0, 4, 3)
    female = rng.random() < np.clip(1.6 * (gender - 0.5) + 0.5, 0, 1)
    # hair styles by whether the person's phenotype is more female than male
    hairstyles = {
        "female": ("bob", "long", "tail", "bun", "waves", "curls", "tousled", "scarf"),
        "male": ("crop", "short", "swept", "tousled", "curls", "receding"),
    }
    styles = [
        s for s in hairstyles["female" if female else "male"] if s != "receding" or grey > 0.25 or rng.random() < 0.2
    ]
    shares = {"casual": 3, "smart": 2, "knit": 2, "sport": 2, "summer": 1, "dress": 2, "pyjamas": 1}
    outfits = {name: weight for name, weight in shares.items() if female or not OUTFITS[name].tights}
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
    irises: tuple[Color, ...] = ((70, 52, 40), (58, 44, 36), (92, 74, 50), (84, 102, 82), (88, 110, 130))
    return replace(
        like,
        complexion=Complexion(
            skin=_rgb(skin),
            hair=_rgb(np.clip(hair, 16, 235)),
            iris=irises[rng.integers(2 if dark else len(irises))],
            lips=float(rng.uniform(0.35, 0.7) if female else rng.uniform(0.15, 0.35)),
            blush=float(rng.uniform(0.1, 0.2) if dark else rng.uniform(0.2, 0.45)),
            lines=float(np.clip((age - 0.74) * 2.2, 0, 0.7)),
            stubble=stubble,
        ),
        hair=style,
        beard=bool(beard),
        outfit=outfit,
        palette=palette,
        colors=scarf,
    )


def _rgb(values: NDArray[np.float64]) -> Color:
    red, green, blue = (int(round(v)) for v in values)
    return red, green, blue
