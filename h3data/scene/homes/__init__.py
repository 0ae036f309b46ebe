"""Procedural homes: `build_home(HomeSpec(seed=7))` gives a furnished `Scene`, the same for the same spec.

``zoning``, ``zoning_large`` and ``layout`` plan rooms, doors and windows; ``structure`` builds them; ``furniture*`` and
``objects`` are the parametric things; ``place``, ``search``, ``groups`` and ``rooms`` put them in; ``check`` proves that
one can walk; ``build`` drives it all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.scene.homes.spec import CATEGORIES, HOME_PRESETS, OBJECT_CATEGORIES, HomePreset, HomeSpec

if TYPE_CHECKING:
    from h3data.scene.records import Scene


def build_home(spec: HomeSpec) -> Scene:
    """A furnished home; see `h3data.scene.homes.build.build_home` (imported at the first call, for light imports)."""
    from h3data.scene.homes.build import build_home as build

    return build(spec)


__all__ = ["CATEGORIES", "HOME_PRESETS", "OBJECT_CATEGORIES", "HomePreset", "HomeSpec", "build_home"]
