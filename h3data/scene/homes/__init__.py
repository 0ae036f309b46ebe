"""Procedural homes: `build_home(HomeSpec(seed=7))` returns a furnished `Scene`, identical for identical specs.

- `spec`: presets, categories, random streams; `build` runs the stages below
- plan: `zoning`, `zoning_large` (rooms), `layout` (doors and windows)
- construction: `structure` (walls, ceiling, windows), `floors`; looks: `style`, `materials`; meshes: `solids`, `primitives`
- furnishing: `rooms` (contents of each kind of room), `furnishing/` (furniture, objects, placement)
- second generation (`HomeSpec.generation`): `kinds/` (what things are), `lived_in/` (styles, rooms, clutter)
- two storeys (`HomeSpec.storeys`): `storeys/`
- `check`: every room and receptacle is reachable
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.scene.homes.spec import CATEGORIES, HOME_NAMES, HOME_PRESETS, OBJECT_CATEGORIES, HomePreset, HomeSpec

if TYPE_CHECKING:
    from h3data.scene.records import Scene


def build_home(spec: HomeSpec) -> Scene:
    """A furnished home; see `h3data.scene.homes.build.build_home`, which is imported at the first call."""
    from h3data.scene.homes.build import build_home as build

    return build(spec)


def categories_of(scene: Scene) -> list[str]:
    """Names of semantic classes of a generated home, in the order of their ids.

    They are those of the first generation or, for homes of the second, all; those of stairs only if the home has
    stairs.
    """
    if scene.source.get("kind") != "home" or scene.source.get("generation", 1) == 1:
        return list(CATEGORIES)
    from h3data.scene.homes.kinds import BUILDING, KINDS

    if scene.source.get("storeys", 1) > 1:
        return sorted(KINDS, key=lambda name: KINDS[name].semantic_id)
    return [name for name in KINDS if name not in BUILDING]


__all__ = [
    "CATEGORIES",
    "HOME_NAMES",
    "HOME_PRESETS",
    "OBJECT_CATEGORIES",
    "HomePreset",
    "HomeSpec",
    "build_home",
    "categories_of",
]
