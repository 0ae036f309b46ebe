"""The wardrobe of the built-in bodies: outfits and hairstyles by name, and the patches of which they consist."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.look.colors import Color
from h3data.bodies.people.look.patches import Patch, read_patch
from h3data.builtin import builtin_path

WARDROBE_FILE, WARDROBE_FORMAT = "wardrobe.npz", "h3data.wardrobe/1"
SEPARATOR = ":"

Detail = Literal["full", "lod"]


@dataclass(frozen=True, kw_only=True)
class Outfit:
    """Clothes that are worn together."""

    pieces: tuple[str, ...]
    colors: tuple[Mapping[str, Color], ...]
    """Sets of colors; each body wears one of them."""
    tights: bool = False
    """True if the legs have the color ``legs``; False if they are bare."""


def _sets(slots: tuple[str, ...], *rows: tuple[int, ...]) -> tuple[Mapping[str, Color], ...]:
    """Return the set of colors from rows that hold an sRGB triple for each of these slots."""
    return tuple({n: (row[3 * k], row[3 * k + 1], row[3 * k + 2]) for k, n in enumerate(slots)} for row in rows)


_SUIT = ("top", "top trim", "bottom", "bottom trim", "shoes")
OUTFITS: dict[str, Outfit] = {
    "casual": Outfit(
        pieces=("tshirt", "jeans", "sneakers"),
        colors=_sets(
            _SUIT,
            (72, 148, 146, 62, 132, 131, 58, 74, 112, 58, 74, 112, 226, 224, 218),
            (214, 178, 84, 198, 160, 72, 62, 66, 78, 62, 66, 78, 226, 224, 218),
            (226, 222, 214, 208, 204, 196, 84, 108, 144, 84, 108, 144, 74, 78, 86),
            (170, 74, 66, 154, 64, 58, 46, 50, 62, 46, 50, 62, 214, 212, 206),
            (96, 124, 94, 84, 110, 84, 72, 84, 110, 72, 84, 110, 190, 84, 66),
            (92, 82, 130, 82, 72, 118, 54, 58, 70, 54, 58, 70, 176, 172, 166),
        ),
    ),
    "smart": Outfit(
        pieces=("shirt", "chinos", "leather shoes"),
        colors=_sets(
            _SUIT,
            (222, 228, 236, 230, 234, 240, 158, 138, 106, 0, 0, 0, 92, 62, 42),
            (150, 176, 208, 160, 184, 214, 68, 74, 92, 0, 0, 0, 70, 48, 36),
            (232, 206, 196, 238, 214, 204, 110, 106, 98, 0, 0, 0, 60, 46, 40),
            (112, 132, 116, 122, 142, 126, 176, 160, 130, 0, 0, 0, 104, 70, 46),
            (236, 232, 222, 240, 236, 228, 58, 60, 68, 0, 0, 0, 44, 40, 40),
        ),
    ),
    "knit": Outfit(
        pieces=("pullover", "cords", "leather shoes"),
        colors=_sets(
            _SUIT,
            (146, 76, 66, 128, 66, 58, 112, 94, 68, 0, 0, 0, 84, 58, 42),
            (204, 190, 164, 188, 174, 148, 82, 66, 54, 0, 0, 0, 92, 66, 46),
            (74, 98, 124, 64, 86, 110, 128, 112, 88, 0, 0, 0, 66, 50, 42),
            (88, 108, 82, 76, 94, 72, 96, 82, 62, 0, 0, 0, 74, 54, 42),
            (136, 92, 122, 120, 80, 108, 92, 88, 86, 0, 0, 0, 60, 48, 46),
        ),
    ),
    "sport": Outfit(
        pieces=("hoodie", "joggers", "sneakers"),
        colors=_sets(
            _SUIT,
            (96, 104, 118, 84, 92, 106, 58, 60, 68, 50, 52, 60, 206, 84, 66),
            (66, 84, 112, 58, 75, 101, 92, 96, 104, 82, 86, 94, 226, 224, 218),
            (168, 84, 76, 152, 74, 67, 54, 56, 62, 48, 50, 56, 222, 220, 214),
            (116, 138, 120, 103, 124, 107, 70, 72, 76, 62, 64, 68, 70, 74, 82),
            (188, 178, 160, 172, 162, 144, 104, 98, 90, 94, 88, 80, 226, 224, 218),
        ),
    ),
    "pyjamas": Outfit(
        pieces=("pyjama", "pyjama trousers", "slippers"),
        colors=_sets(
            _SUIT,
            (122, 146, 186, 224, 228, 236, 122, 146, 186, 0, 0, 0, 112, 98, 92),
            (186, 142, 152, 236, 224, 224, 186, 142, 152, 0, 0, 0, 150, 132, 128),
            (128, 156, 138, 226, 232, 224, 128, 156, 138, 0, 0, 0, 96, 88, 80),
            (150, 140, 172, 230, 226, 236, 150, 140, 172, 0, 0, 0, 92, 88, 104),
        ),
    ),
    "dress": Outfit(
        pieces=("dress", "flats"),
        colors=_sets(
            ("top", "legs", "shoes"),
            (148, 56, 82, 58, 54, 62, 44, 40, 44),
            (62, 92, 122, 50, 52, 60, 48, 46, 52),
            (98, 120, 84, 70, 62, 56, 82, 60, 48),
            (204, 150, 74, 62, 52, 50, 96, 62, 46),
            (110, 88, 132, 52, 48, 58, 50, 44, 54),
        ),
        tights=True,
    ),
    "summer": Outfit(
        pieces=("tshirt", "shorts", "sneakers"),
        colors=_sets(
            _SUIT,
            (224, 212, 182, 206, 194, 164, 94, 106, 84, 0, 0, 0, 232, 230, 226),
            (84, 154, 180, 74, 138, 164, 190, 178, 152, 0, 0, 0, 222, 220, 214),
            (230, 226, 220, 214, 210, 204, 76, 98, 130, 0, 0, 0, 74, 78, 86),
            (214, 120, 92, 196, 108, 82, 86, 90, 100, 0, 0, 0, 226, 224, 218),
        ),
    ),
}
HAIRSTYLES = (
    "crop",
    "short",
    "swept",
    "tousled",
    "bob",
    "long",
    "tail",
    "bun",
    "curls",
    "waves",
    "receding",
    "scarf",
)
SCALP = {"receding": 0.12, "crop": 0.85}
"""Share of the hair's color in the scalp, by hair style; styles without an entry have the default share."""
SCALP_USUAL = 0.6


def split_outfit(name: str) -> tuple[str, str]:
    """Split a name such as ``female_0:dress`` into body and outfit; the outfit is empty if the name has none."""
    # the last colon, as random:SEED has one of its own
    body, _, outfit = name.rpartition(SEPARATOR)
    return (body, outfit) if body and outfit in OUTFITS else (name, "")


@dataclass(frozen=True, kw_only=True, eq=False)
class Wardrobe:
    """All patches of the built-in bodies."""

    data: Mapping[str, NDArray[Any]]

    def patch(self, piece: str, detail: Detail) -> Patch:
        """Read the patch of a piece of clothing from its file. The patch is not cached."""
        return read_patch(self.data, f"{piece}/{detail}")

    def hidden(self, pieces: tuple[str, ...], detail: Detail) -> NDArray[np.bool_]:
        """Return which faces of the skin are hidden below these pieces of clothing, bool [F]."""
        count = self.data[f"skin/{detail}/faces"].shape[-1]
        # a bit for each face, eight to the byte, as files hold them
        bits = np.zeros((count + 7) // 8, np.uint8)
        for piece in pieces:
            if f"{piece}/{detail}/hides" in self.data:
                bits |= self.data[f"{piece}/{detail}/hides"]
        return np.unpackbits(bits, count=count).astype(bool)


@lru_cache(maxsize=1)
def builtin_wardrobe() -> Wardrobe:
    """Return the wardrobe of the built-in bodies, which is read once."""
    with np.load(builtin_path(f"bodies/{WARDROBE_FILE}"), allow_pickle=False) as file:
        return Wardrobe(data={key: file[key] for key in file.files})
