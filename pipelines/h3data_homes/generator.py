"""Scene generator ``home``, an entry point of the group ``h3data.scenes``."""

from __future__ import annotations

import msgspec

from h3data.scene.sources import SceneGenerator, SceneSize
from h3data_homes import HOME_NAMES, HOME_PRESETS, build_home
from h3data_homes.spec import HomeSpec, Look, Preset


class HomeTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table of a scene set that describes one procedural home by the fields of `HomeSpec`."""

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
    listed={
        name: SceneSize(area_m2=preset.area_m2, bedrooms=preset.bedrooms, bathrooms=preset.bathrooms)
        for name, options in HOME_NAMES.items()
        if not options["articulated"]
        for preset in [HOME_PRESETS[options["preset"]]]
    },
    about="Name a home as preset:seed, e.g. small:3, with any seed from 0; small2:3 is one of the second generation, and in "
    "small-open:3 furniture opens; small2-storeys:3 has two storeys, and small2-doors:3 doors between its rooms.",
)
