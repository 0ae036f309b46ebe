"""Eight styles of homes: tables of colours and materials, from which the palette of one home is sampled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from h3data_homes.layout import Layout
from h3data_homes.materials import Finish
from h3data_homes.solids import Color, shade, vary
from h3data_homes.spec import Look
from h3data_homes.style import Style

Colors = Sequence[tuple[int, int, int]]


@dataclass(frozen=True, kw_only=True)
class Palette:
    """Materials and colours of a style, from which those of one home are sampled."""

    paints: Colors
    feature: tuple[str, Colors]
    """Material and colours of the walls of one or two rooms."""
    floors: Colors
    floor: str = "boards"
    """Material of the floor of living rooms; bedrooms have boards or carpet."""
    carpet: bool = False
    tiles: Colors
    wall_tiles: Colors
    woods: Colors
    fabrics: Colors
    accents: Colors
    fronts: Colors
    front_material: str = ""
    worktops: Colors
    worktop: str = "stone"
    metals: Colors
    facade: str
    facades: Colors
    trim: tuple[int, int, int] = (244, 243, 239)
    linen: tuple[int, int, int] = (240, 238, 232)
    lampshade: tuple[int, int, int] = (244, 232, 204)
    shade_material: str = "weave"


LOOKS: Mapping[Look, Palette] = {
    "nordic": Palette(
        paints=((240, 239, 235), (232, 235, 234), (236, 232, 224)),
        feature=("plaster", ((176, 192, 196), (190, 200, 186), (206, 196, 186))),
        floors=((214, 186, 146), (222, 200, 166)),
        tiles=((226, 226, 222), (196, 200, 200)),
        wall_tiles=((240, 242, 242), (226, 232, 232)),
        woods=((218, 190, 150), (226, 202, 166)),
        fabrics=((156, 164, 168), (198, 196, 190), (128, 144, 150), (176, 186, 176)),
        accents=((226, 176, 92), (122, 156, 160), (206, 140, 120)),
        fronts=((242, 241, 238), (214, 220, 218)),
        worktops=((206, 178, 138), (228, 226, 222)),
        metals=((196, 198, 200),),
        facade="render",
        facades=((232, 230, 224), (168, 60, 48)),
    ),
    "industrial": Palette(
        paints=((214, 210, 204), (196, 194, 190), (222, 218, 210)),
        feature=("brick", ((168, 98, 76), (152, 88, 70), (190, 186, 180))),
        floors=((150, 148, 144), (136, 134, 130)),
        floor="concrete",
        tiles=((118, 118, 118), (92, 94, 96)),
        wall_tiles=((238, 238, 234), (72, 74, 78)),
        woods=((142, 96, 60), (124, 84, 54)),
        fabrics=((104, 72, 50), (84, 86, 90), (120, 108, 94), (64, 70, 78)),
        accents=((196, 122, 52), (166, 60, 46), (70, 104, 112)),
        fronts=((58, 60, 64), (86, 88, 90)),
        worktops=((138, 102, 68), (108, 108, 108)),
        worktop="concrete",
        metals=((54, 55, 58), (70, 72, 76)),
        facade="brick",
        facades=((150, 86, 66), (128, 74, 60)),
        trim=(78, 78, 80),
        lampshade=(84, 84, 86),
        shade_material="",
    ),
    "rustic": Palette(
        paints=((238, 228, 206), (232, 220, 196), (226, 216, 200)),
        feature=("stone", ((196, 184, 164), (178, 166, 150))),
        floors=((150, 100, 60), (134, 88, 54), (168, 118, 74)),
        tiles=((186, 122, 88), (168, 110, 82)),
        wall_tiles=((232, 218, 190), (206, 176, 140)),
        woods=((142, 92, 52), (120, 74, 42), (164, 112, 68)),
        fabrics=((150, 68, 54), (112, 122, 84), (186, 164, 128), (124, 94, 72)),
        accents=((178, 58, 46), (96, 116, 70), (206, 158, 76)),
        fronts=((176, 130, 82), (206, 196, 168), (128, 142, 116)),
        front_material="wood",
        worktops=((156, 108, 64), (122, 116, 108)),
        metals=((92, 82, 72), (120, 104, 84)),
        facade="render",
        facades=((234, 222, 196), (214, 198, 168)),
        trim=(214, 198, 168),
        linen=(236, 226, 206),
    ),
    "mid_century": Palette(
        paints=((234, 228, 212), (226, 222, 206), (238, 232, 220)),
        feature=("plaster", ((88, 124, 122), (204, 150, 74), (120, 134, 88), (178, 96, 66))),
        floors=((162, 104, 62), (148, 96, 58)),
        tiles=((206, 200, 186), (150, 166, 158)),
        wall_tiles=((162, 190, 184), (232, 214, 160)),
        woods=((150, 92, 52), (136, 80, 46)),
        fabrics=((84, 118, 116), (196, 138, 60), (118, 126, 82), (168, 84, 58)),
        accents=((226, 164, 56), (204, 92, 54), (64, 116, 118)),
        fronts=((158, 102, 60), (232, 226, 210)),
        front_material="wood",
        worktops=((236, 232, 222), (96, 92, 86)),
        metals=((190, 160, 96), (176, 178, 180)),
        facade="render",
        facades=((206, 194, 170), (178, 150, 116)),
    ),
    "mediterranean": Palette(
        paints=((246, 240, 228), (248, 244, 238), (240, 228, 206)),
        feature=("plaster", ((222, 160, 112), (120, 168, 190), (236, 206, 138))),
        floors=((196, 120, 82), (206, 136, 96)),
        floor="tiles",
        tiles=((206, 132, 94), (222, 206, 176)),
        wall_tiles=((76, 132, 170), (96, 156, 176), (230, 196, 120)),
        woods=((172, 126, 80), (150, 106, 66)),
        fabrics=((236, 226, 206), (86, 130, 160), (206, 164, 116), (176, 92, 66)),
        accents=((44, 110, 158), (226, 140, 60), (206, 74, 58)),
        fronts=((240, 236, 226), (96, 144, 168), (178, 130, 84)),
        worktops=((232, 220, 198), (196, 120, 84)),
        metals=((72, 66, 62), (150, 122, 80)),
        facade="render",
        facades=((248, 244, 234), (236, 206, 160)),
        linen=(248, 244, 234),
    ),
    "classic": Palette(
        paints=((228, 222, 210), (212, 218, 208), (220, 210, 200)),
        feature=("plaster", ((84, 102, 92), (70, 84, 110), (126, 60, 60), (150, 140, 116))),
        floors=((120, 78, 50), (104, 66, 42)),
        carpet=True,
        tiles=((232, 230, 226), (60, 62, 66)),
        wall_tiles=((236, 234, 230), (206, 212, 206)),
        woods=((106, 62, 38), (90, 52, 34)),
        fabrics=((112, 44, 48), (66, 86, 74), (58, 72, 104), (186, 170, 140)),
        accents=((176, 142, 70), (128, 46, 52), (58, 82, 110)),
        fronts=((232, 228, 218), (78, 96, 88)),
        worktops=((232, 230, 228), (54, 54, 56)),
        metals=((196, 162, 88), (182, 150, 84)),
        facade="brick",
        facades=((166, 96, 74), (190, 160, 130)),
        lampshade=(240, 222, 184),
    ),
    "japandi": Palette(
        paints=((232, 226, 216), (224, 218, 208), (236, 232, 224)),
        feature=("plaster", ((186, 172, 154), (150, 152, 138), (206, 194, 178))),
        floors=((190, 156, 114), (176, 144, 106)),
        tiles=((192, 186, 176), (150, 146, 138)),
        wall_tiles=((222, 216, 206), (120, 128, 118)),
        woods=((176, 138, 98), (92, 70, 54), (196, 162, 122)),
        fabrics=((206, 196, 180), (140, 138, 128), (170, 156, 138), (104, 108, 98)),
        accents=((120, 92, 70), (132, 140, 112), (62, 62, 62)),
        fronts=((196, 162, 122), (70, 66, 62)),
        front_material="wood",
        worktops=((84, 80, 76), (214, 206, 194)),
        metals=((52, 50, 48), (84, 78, 70)),
        facade="render",
        facades=((204, 196, 182), (92, 86, 80)),
        lampshade=(248, 242, 226),
    ),
    "colourful": Palette(
        paints=((244, 240, 230), (238, 226, 226), (226, 236, 238), (240, 236, 214)),
        feature=("plaster", ((226, 124, 104), (92, 170, 160), (244, 196, 84), (150, 120, 178), (98, 148, 204))),
        floors=((196, 154, 104), (222, 192, 150)),
        tiles=((126, 178, 182), (236, 196, 178), (232, 230, 224)),
        wall_tiles=((244, 180, 160), (150, 208, 196), (246, 214, 120)),
        woods=((206, 164, 112), (232, 228, 220), (176, 120, 74)),
        fabrics=((226, 96, 92), (54, 136, 146), (236, 176, 60), (124, 92, 160), (72, 116, 186)),
        accents=((244, 150, 50), (220, 70, 110), (60, 160, 130), (80, 110, 200)),
        fronts=((110, 174, 168), (244, 200, 96), (238, 150, 130), (246, 244, 238)),
        worktops=((244, 242, 236), (206, 164, 112)),
        metals=((198, 200, 202), (206, 168, 90)),
        facade="render",
        facades=((246, 206, 120), (150, 196, 206), (236, 160, 140)),
    ),
}

_OPEN = ("living", "hall", "kitchen", "dining")
_WET = ("kitchen", "pantry", "bathroom", "laundry")


@cache
def thing_style(look: Look) -> Style:
    """Return the palette for small objects, which all homes of a style share."""
    seed = np.frombuffer(look.encode().ljust(16, b"\0")[:16], "<u8").astype(np.uint64)
    nowhere = Layout(width=1.0, depth=1.0, rooms=(), openings=())
    return sample_look(np.random.Generator(np.random.Philox(key=seed)), nowhere, look)


def sample_look(rng: np.random.Generator, layout: Layout, look: Look) -> Style:
    """Return the palette of one home in a style, which uses the same random numbers for every style."""
    palette = LOOKS[look]

    def pick(colors: Colors, material: str = "", amount: float = 0.03) -> Color:
        color = vary(rng, colors[int(rng.random() * len(colors))], amount)
        return Finish(color, material) if material else color

    base = pick(palette.paints, "plaster", 0.015)
    material, colors = palette.feature
    feature = pick(colors, material, 0.02)
    paint = {r.name: base if r.category in _OPEN else pick(palette.paints, "plaster", 0.015) for r in layout.rooms}
    featured = [
        r.name for r in layout.rooms if r.category in ("living", "bedroom", "office", "den", "dining", "library")
    ]
    order = rng.permutation(len(featured)).tolist()
    paint |= {featured[k]: feature for k in order[: max(1, len(featured) // 3)]}
    children = pick(((244, 214, 206), (206, 226, 240), (244, 234, 190), (214, 234, 206)), "plaster", 0.02)
    paint |= {r.name: children for r in layout.rooms if r.category == "child"}
    outdoors = Finish(vary(rng, palette.facades[0], 0.02), palette.facade)
    paint |= {r.name: outdoors for r in layout.rooms if r.category == "balcony"}
    paint |= {r.name: Finish((206, 204, 200), "concrete") for r in layout.rooms if r.category == "garage"}
    first, second = (int(k) for k in rng.permutation(len(palette.fabrics))[:2])
    wood = pick(palette.woods, "wood")
    floor, kitchen, wet = (
        pick(palette.floors, palette.floor),
        pick(palette.tiles, "tiles"),
        pick(palette.tiles, "tiles"),
    )
    floors = dict.fromkeys(_WET, wet) | {"kitchen": kitchen, "pantry": kitchen}
    floors |= {"garage": Finish((146, 145, 142), "concrete"), "balcony": Finish((150, 132, 112), "tiles")}
    if palette.floor != "boards":
        floors |= dict.fromkeys(("living", "hall", "dining", "den", "library", "office", "kitchen"), floor)
    if palette.carpet:
        floors |= dict.fromkeys(
            ("bedroom", "child", "library"), Finish(shade(vary(rng, (178, 164, 144)), 1.0), "carpet")
        )
    boards = Finish(vary(rng, (190, 148, 100)), "boards") if palette.floor != "boards" else floor
    return Style(
        paint=paint,
        floor_wood=boards,
        floor_tile=floors,
        wall_tile=pick(palette.wall_tiles, "tiles", 0.02),
        wood=wood,
        wood_dark=shade(wood, 0.72),
        fabric=Finish(vary(rng, palette.fabrics[first]), "weave"),
        fabric_2=Finish(vary(rng, palette.fabrics[second]), "weave"),
        accent=pick(palette.accents),
        front=pick(palette.fronts, palette.front_material),
        worktop=pick(palette.worktops, palette.worktop),
        front_door=pick(palette.accents),
        facade=outdoors,
        linen=Finish(palette.linen, "weave"),
        lampshade=Finish(palette.lampshade, palette.shade_material) if palette.shade_material else palette.lampshade,
        trim=palette.trim,
        metal=pick(palette.metals, "", 0.02),
    )
