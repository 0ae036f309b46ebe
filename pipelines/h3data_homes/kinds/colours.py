"""Colours of parts by name: those of a home's style, palettes, and shades of both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields

import numpy as np

from h3data_homes.kinds.parts import Paint
from h3data_homes.materials import Finish
from h3data_homes.solids import Color, shade, vary
from h3data_homes.style import Style

_OF_STYLE = frozenset(f.name for f in fields(Style)) - {"paint", "floor_tile"}

PALETTES: Mapping[str, tuple[Color, ...]] = {
    "bright": (
        (198, 58, 48),
        (222, 160, 52),
        (64, 122, 74),
        (52, 96, 160),
        (230, 226, 214),
        (132, 78, 140),
        (40, 150, 150),
    ),
    "toy": ((214, 52, 44), (244, 190, 42), (56, 148, 80), (40, 104, 190), (240, 126, 40), (150, 84, 160)),
    "pastel": ((238, 198, 196), (198, 220, 232), (216, 228, 196), (242, 228, 180), (220, 206, 232)),
    "ceramic": ((244, 242, 236), (226, 230, 230), (202, 214, 216), (186, 198, 184), (232, 218, 196), (92, 108, 128)),
    "cloth": (
        Finish((188, 74, 64), "weave"),
        Finish((70, 96, 136), "weave"),
        Finish((196, 174, 130), "weave"),
        Finish((96, 128, 104), "weave"),
        Finish((222, 218, 208), "weave"),
        Finish((92, 88, 94), "weave"),
    ),
    "denim": (Finish((66, 88, 128), "weave"), Finish((44, 58, 88), "weave"), Finish((120, 142, 170), "weave")),
    "leather": ((112, 70, 44), (60, 46, 40), (38, 36, 38), (158, 108, 66)),
    "rattan": (Finish((196, 158, 104), "weave"), Finish((170, 128, 80), "weave")),
    "clay": ((196, 112, 76), (226, 222, 214), (88, 92, 96), (168, 150, 128)),
    "green": ((70, 122, 62), (94, 140, 74), (60, 104, 80), (112, 148, 84)),
    "flower": ((214, 92, 112), (240, 206, 92), (236, 232, 226), (168, 108, 176), (228, 132, 74)),
    "cardboard": ((186, 148, 104), (172, 134, 92)),
    "paper": ((240, 236, 224), (246, 244, 238)),
    "plastic": ((236, 236, 234), (58, 62, 68), (120, 132, 144), (206, 84, 66), (72, 116, 160)),
    "device": ((36, 38, 42), (214, 216, 220), (84, 88, 94)),
    "rubber": ((40, 40, 42), (52, 52, 54)),
    "steel": ((190, 194, 198), (168, 172, 178)),
    "tool": ((204, 56, 42), (232, 176, 40), (40, 92, 150), (58, 110, 70)),
    "brass": ((198, 164, 92), (176, 138, 78)),
    "fur": ((176, 128, 84), (206, 172, 132), (120, 88, 66), (226, 214, 198)),
}
"""Colours by name; ``bright2`` is sampled independently of ``bright``, ``bright*0.8`` is a darker shade of it."""


def colours_of(rng: np.random.Generator, style: Style) -> Callable[[Paint], Color]:
    """Return a function from names to the colours of one object, in which a name has the same colour in all parts."""
    chosen: dict[str, Color] = {}

    def of(paint: Paint) -> Color:
        if not isinstance(paint, str):
            return paint
        name, _, factor = paint.partition("*")
        if name not in chosen:
            if name in _OF_STYLE:
                chosen[name] = getattr(style, name)
            else:
                palette = PALETTES[name.rstrip("0123456789")]
                chosen[name] = vary(rng, palette[int(rng.integers(len(palette)))], 0.06)
        return shade(chosen[name], float(factor)) if factor else chosen[name]

    return of
