"""Colours and materials of one home, sampled once so that its rooms and furniture match."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from h3data_homes.layout import Layout
from h3data_homes.materials import Finish
from h3data_homes.solids import Color, shade, vary

_LINEN = Finish((240, 238, 232), "weave")
_LAMPSHADE = Finish((244, 232, 204), "weave")
_WALL_TOP = Finish((120, 118, 115), "concrete")
_CEILING = Finish((246, 246, 243), "plaster")


@dataclass(frozen=True, kw_only=True)
class Style:
    """Palette of a home: sRGB colours, some of which are a `Finish` with a material."""

    paint: Mapping[str, Color]
    """Wall paint by room name."""
    floor_wood: Color
    floor_tile: Mapping[str, Color]
    """Floor tiles by room category; other rooms have boards."""
    wall_tile: Color
    wood: Color
    wood_dark: Color
    fabric: Color
    fabric_2: Color
    accent: Color
    front: Color
    """Colour of the fronts of kitchen cabinets and wardrobes."""
    worktop: Color
    front_door: Color
    facade: Color
    linen: Color = _LINEN
    lampshade: Color = _LAMPSHADE
    trim: Color = (244, 243, 239)
    wall_top: Color = _WALL_TOP
    ceiling: Color = _CEILING
    glass: Color = (186, 214, 235)
    metal: Color = (176, 180, 184)
    white: Color = (245, 245, 243)
    black: Color = (38, 38, 42)


_PAINTS = [(236, 231, 220), (222, 228, 224), (229, 222, 211), (214, 224, 231), (235, 226, 214), (225, 229, 215)]
_FLOORS = [(178, 132, 86), (154, 108, 68), (196, 158, 112), (132, 92, 62), (186, 148, 108)]
_TILES = [(206, 202, 194), (178, 184, 188), (222, 214, 200), (150, 156, 160)]
_WOODS = [(186, 140, 92), (150, 100, 60), (206, 172, 128), (120, 78, 50), (224, 218, 208)]
_FABRICS = [(98, 112, 128), (142, 126, 108), (84, 108, 96), (156, 92, 78), (176, 168, 156), (70, 84, 118)]
_ACCENTS = [(204, 120, 62), (62, 122, 142), (192, 160, 70), (150, 66, 74), (96, 138, 92)]
_FRONTS = [(238, 236, 230), (120, 138, 128), (92, 106, 124), (208, 196, 176), (214, 218, 220)]
_FACADES = [
    Finish((222, 214, 200), "render"),
    Finish((206, 196, 178), "render"),
    Finish((172, 104, 82), "brick"),
    Finish((198, 168, 138), "brick"),
    Finish((224, 222, 216), "render"),
]
_WORKTOPS = [(86, 84, 82), (200, 194, 184), (140, 104, 70), (58, 60, 64)]
_OPEN = ("living", "hall", "kitchen", "dining")
"""Rooms that open into each other and share one paint."""


def _floor_tiles(kitchen: Color, bathroom: Color) -> dict[str, Color]:
    return {"kitchen": kitchen, "pantry": kitchen, "bathroom": bathroom, "laundry": bathroom}


def sample_style(rng: np.random.Generator, layout: Layout) -> Style:
    """Return a random, matching set of colours for a home."""

    def pick(colors: Sequence[Color], material: str = "", amount: float = 0.04) -> Color:
        color = vary(rng, colors[int(rng.integers(len(colors)))], amount)
        return Finish(color, material) if material else color

    base = pick(_PAINTS, "plaster", 0.02)
    paint = {r.name: base if r.category in _OPEN else pick(_PAINTS, "plaster", 0.02) for r in layout.rooms}
    fabric, second = (_FABRICS[i] for i in rng.permutation(len(_FABRICS))[:2].tolist())
    wood = pick(_WOODS, "wood")
    return Style(
        paint=paint,
        floor_wood=pick(_FLOORS, "boards"),
        floor_tile=_floor_tiles(pick(_TILES, "tiles"), pick(_TILES, "tiles")),
        wall_tile=pick([(226, 232, 234), (206, 220, 224), (232, 228, 218)], "tiles", 0.02),
        wood=wood,
        wood_dark=shade(wood, 0.72),
        fabric=Finish(vary(rng, fabric), "weave"),
        fabric_2=Finish(vary(rng, second), "weave"),
        accent=pick(_ACCENTS),
        front=pick(_FRONTS),
        worktop=pick(_WORKTOPS, "stone"),
        front_door=pick([(112, 70, 46), (60, 84, 96), (120, 48, 44), (74, 92, 76)]),
        facade=pick(_FACADES),
    )
