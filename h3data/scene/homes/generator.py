"""Homes among the scenes that are found by name: an entry point of the group ``h3data.scenes``."""

from __future__ import annotations

import msgspec

from h3data.scene.homes import HOME_NAMES, build_home
from h3data.scene.homes.spec import HomeSpec, Look, Preset
from h3data.scene.sources import SceneGenerator


class HomeTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A procedural home in a scene set: the fields of `HomeSpec`."""

    id: str
    seed: int
    preset: Preset = "small"
    area_m2: float | None = None
    bedrooms: int | None = None
    bathrooms: int | None = None
    clutter: float = 1.0
    density: int = 1
    articulated: bool = False
    generation: int = 1
    style: Look | None = None
    storeys: int = 1
    doors: bool = False


HOMES = SceneGenerator(
    names=tuple(HOME_NAMES),
    named=lambda name, seed: HomeSpec(seed=seed, **HOME_NAMES[name]),
    Spec=HomeSpec,
    Table=HomeTable,
    build=build_home,
)
