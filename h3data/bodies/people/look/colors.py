"""Colors of people: skin with its makeup, hair, eyes and cloth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.look.patches import Floats, Patch

SLOTS = (
    "skin",
    "sclera",
    "iris",
    "pupil",
    "brows",
    "hair",
    "scarf",
    "top",
    "top trim",
    "shirt",
    "bottom",
    "bottom trim",
    "legs",
    "shoes",
    "soles",
    "buttons",
)
"""Parts that have a color of their own. ``shirt`` is seen under a jacket, ``legs`` are tights or socks."""
SLOT = {name: k for k, name in enumerate(SLOTS)}
PAINTS = ("lips", "blush", "lashes", "lids", "lines", "stubble", "scalp", "legs")
"""Layers of color on skin, in the order in which they are applied; each blends the color towards its own."""

Color = tuple[int, int, int]
"""Colour as sRGB values from 0 to 255."""
SCLERA, PUPIL, BUTTONS = (226, 222, 216), (18, 16, 16), (236, 232, 222)


@dataclass(frozen=True, kw_only=True)
class Complexion:
    """Colours of one person's skin, hair and eyes."""

    skin: Color
    hair: Color
    iris: Color = (70, 52, 40)
    lips: float = 0.5
    """Redness of the lips, 0..1."""
    blush: float = 0.35
    lashes: float = 0.8
    lines: float = 0.0
    """Depth of wrinkles, 0..1."""
    stubble: float = 0.0
    """Shadow of a shaved beard, 0..1."""


def _triple(*values: float) -> Floats:
    return np.array(values, np.float32)


def slot_colors(complexion: Complexion, cloth: Mapping[str, Color]) -> Floats:
    """Return the color of every slot, [`SLOTS`, 3]; cloth without a color in the outfit is a middle grey."""
    skin, hair = np.array(complexion.skin, np.float32), np.array(complexion.hair, np.float32)
    # brows of fair hair let more of the skin through
    fair = 0.58 if hair.mean() > 120 else 0.85
    own: dict[str, Any] = {
        "skin": skin,
        "sclera": SCLERA,
        "iris": complexion.iris,
        "pupil": PUPIL,
        "hair": hair,
        "buttons": BUTTONS,
        "brows": fair * 0.82 * hair + (1 - fair) * skin,
        "soles": (222, 219, 212),
    }
    return np.array([cloth.get(name, own.get(name, (128, 128, 128))) for name in SLOTS], np.float32)


def vertex_colors(
    patch: Patch, slots: Floats, complexion: Complexion, *, tights: bool, scalp: float
) -> NDArray[np.uint8]:
    """Return the colors of a patch's vertices, uint8 [V, 3].

    ``scalp`` is the degree to which hair covers the scalp.
    """
    colors = slots[patch.slots]
    if patch.paint.shape[1]:
        skin = np.array(complexion.skin, np.float32)
        hair = np.array(complexion.hair, np.float32)
        dark = skin * _triple(0.56, 0.50, 0.48)
        paints = {
            "lips": (skin * _triple(0.84, 0.56, 0.55) + _triple(6, 0, 2), complexion.lips),
            "blush": (skin * _triple(1.0, 0.79, 0.75), complexion.blush),
            "lids": (skin * _triple(0.84, 0.74, 0.71), 0.7),
            "lines": (dark, complexion.lines),
            # dark below fair hair too
            "stubble": (0.55 * skin + 0.45 * np.minimum(hair, 90), complexion.stubble),
            "scalp": (0.35 * skin + 0.65 * hair, scalp),
            "lashes": (_triple(34, 26, 24), complexion.lashes),
            "legs": (slots[SLOT["legs"]], float(tights)),
        }
        for name, (color, strength) in paints.items():
            if strength:
                share = patch.paint[:, PAINTS.index(name), None].astype(np.float32) * np.float32(strength / 255)
                colors = colors + share * (np.asarray(color, np.float32) - colors)
    # shaded last, so that paint on the skin lies in the same shadows
    return np.clip(np.rint(colors * patch.shade[:, None]), 0, 255).astype(np.uint8)
