"""Procedural homes: `build_home(HomeSpec(seed=7))` returns a furnished `Scene`; equal specs give equal scenes.

- `spec`: presets, categories, random streams; `build` runs the stages below
- plan: `zoning`, `zoning_large` (rooms), `layout` (doors and windows)
- construction: `structure` (walls, ceiling, windows), `floors`; looks: `style`, `materials`; meshes: `solids`, `primitives`
- furnishing: `rooms` (contents of each kind of room), `furnishing/` (furniture, objects, placement)
- second generation (`HomeSpec.generation`): `kinds/` (the models of kinds), `lived_in/` (styles, rooms, clutter)
- two storeys (`HomeSpec.storeys`): `storeys/`
- `check`: every room and receptacle is reachable
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data_homes.spec import HOME_NAMES, HOME_PRESETS, HomePreset, HomeSpec

if TYPE_CHECKING:
    from h3data.scene.records import Scene


def build_home(spec: HomeSpec) -> Scene:
    """Return a furnished home.

    Args:
        spec: Size, rooms, style and seed of the home.
    """
    from h3data_homes.build import build_home as build

    return build(spec)


__all__ = [
    "HOME_NAMES",
    "HOME_PRESETS",
    "HomePreset",
    "HomeSpec",
    "build_home",
]
