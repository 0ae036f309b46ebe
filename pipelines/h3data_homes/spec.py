"""Specification of a home (`HomeSpec`), its presets, and the random numbers of each stage of generation."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from h3data.errors import InputError

Preset = Literal["small", "medium", "large"]
Look = Literal["nordic", "industrial", "rustic", "mid_century", "mediterranean", "classic", "japandi", "colourful"]
"""Style of homes of the second generation."""


@dataclass(frozen=True, kw_only=True)
class HomePreset:
    """Size and rooms of one kind of home, in addition to the living room, kitchen and hall that every home has."""

    area_m2: float
    """Floor area, to the middle of inner walls and to the inner face of outer walls [m2]."""
    bedrooms: int
    bathrooms: int
    extra: tuple[str, ...] = ()
    """Kinds of other required rooms."""
    children: int = 0
    """Number of bedrooms that are furnished for children (second generation)."""
    generation: int = 1

    @property
    def bedroom_kinds(self) -> list[str]:
        """Kind of each bedroom: ``bedroom``, or ``child`` for children's rooms."""
        return ["bedroom"] * (self.bedrooms - self.children) + ["child"] * self.children


HOME_PRESETS: Mapping[str, HomePreset] = MappingProxyType(
    {
        "small": HomePreset(area_m2=68.56, bedrooms=1, bathrooms=1),
        "medium": HomePreset(area_m2=136.11, bedrooms=3, bathrooms=2),
        "large": HomePreset(area_m2=846.15, bedrooms=4, bathrooms=4, extra=("den", "office")),
    }
)
"""Presets by name: areas and rooms of the benchmark homes in the Habitat 3.0 paper (research/navigation-and-stepping.md
6)."""

MAX_AREA_M2, MAX_BEDROOMS, MAX_BATHROOMS = 1200.0, 8, 6
MAX_CLUTTER, MAX_DENSITY = 4.0, 12
GENERATIONS = 2
STOREYS = 2
HOME_NAMES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        f"{preset}{generation if generation > 1 else ''}{'-open' if opens else ''}": MappingProxyType(
            {"preset": preset, "generation": generation, "articulated": opens}
        )
        for opens in (False, True)
        for generation in range(1, GENERATIONS + 1)
        for preset in get_args(Preset)
    }
    | {
        f"{preset}2-storeys{'-open' if opens else ''}": MappingProxyType(
            {"preset": preset, "generation": 2, "articulated": opens, "storeys": STOREYS}
        )
        for opens in (False, True)
        for preset in ("small", "medium")
    }
    | {
        f"{preset}2{storeys}-doors": MappingProxyType(
            {"preset": preset, "generation": 2, "articulated": True, "doors": True}
            | ({"storeys": STOREYS} if storeys else {})
        )
        for storeys in ("", "-storeys")
        for preset in get_args(Preset)
        if not (storeys and preset == "large")
    }
)
"""Options of `HomeSpec` by the name before the colon of a home. ``small2:3`` is of the second generation; in
``small-open:3`` and ``small2-open:3`` furniture opens; ``small2-storeys:3`` has two storeys; in ``small2-doors:3``
furniture and the doors between rooms open and close."""


_LATER: Mapping[str, Any] = MappingProxyType(
    {"articulated": False, "generation": 1, "style": None, "storeys": 1, "doors": False}
)
"""Fields of `HomeSpec` that were added later, and their values in earlier homes."""


def min_area_m2(bedrooms: int, bathrooms: int) -> float:
    """Return the smallest floor area for a home with these numbers of bedrooms and bathrooms [m2]."""
    return 24.0 + 23.0 * bedrooms + 15.0 * bathrooms


@dataclass(frozen=True, kw_only=True)
class HomeSpec:
    """Complete description of a procedural home; equal specs give the same scene, byte for byte."""

    kind: ClassVar[str] = "home"

    seed: int = 0
    preset: Preset = "small"
    area_m2: float | None = None
    """Floor area [m2]; None means the area of the preset."""
    bedrooms: int | None = None
    """Number of bedrooms; None means that of the preset."""
    bathrooms: int | None = None
    """Number of bathrooms; None means that of the preset."""
    clutter: float = 1.0
    """Amount of small objects: 0 means none, and 2 about twice as many. The furniture stays the same."""
    density: int = 1
    """Number of parts into which every triangle edge is cut, as a load for renderers. There are density^2 times as many
    triangles with the same look, and the same collision shapes."""
    articulated: bool = False
    """True if fridge, cupboards, drawers and a dishwasher open. Rooms and furniture stay the same, and small objects
    also lie inside."""
    generation: int = 1
    """Generation of homes: 1 for the homes of `h3-homes`, 2 for those of `h3-homes-v2`, which have more kinds of
    objects, rooms and styles."""
    style: Look | None = None
    """Style of a home of the second generation; None means that the seed determines it."""
    storeys: int = 1
    """Number of storeys: 2 adds an upper storey next to a stairwell (second generation, ``small`` and ``medium``).
    Area, bedrooms and bathrooms are per storey."""
    doors: bool = False
    """True if doorways have doors, some of them closed (second generation). The rest of the home stays the same."""

    def __repr__(self) -> str:
        """Return the text of the specification, from which jobs and recordings derive their identity.

        It is that of a plain dataclass, without fields that were added later and have their default values.
        """
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, default in _LATER.items():
            if values[name] == default:
                del values[name]
        return f"HomeSpec({', '.join(f'{name}={value!r}' for name, value in values.items())})"

    def __post_init__(self) -> None:
        _check_whole("generation", self.generation, 1, GENERATIONS)
        if self.style is not None and (self.style not in get_args(Look) or self.generation < 2):
            raise InputError(
                f"Unknown style {self.style!r}. Available: {', '.join(get_args(Look))}, in homes with generation=2.",
                code="H3-SCENE-029",
            )
        _check_whole("storeys", self.storeys, 1, STOREYS)
        if self.storeys > 1 and (self.generation < 2 or self.preset == "large"):
            raise InputError(
                f"Homes with {self.storeys} storeys are small or medium and of generation=2, got preset={self.preset!r}, "
                f"generation={self.generation}.",
                code="H3-SCENE-030",
            )
        if self.preset not in get_args(Preset):
            raise InputError(
                f"Unknown home preset {self.preset!r}. Available: {', '.join(get_args(Preset))}.", code="H3-SCENE-031"
            )
        if isinstance(self.seed, bool) or not isinstance(self.seed, int | np.integer) or self.seed < 0:
            raise InputError(f"The seed of a home must be a whole number >= 0, got {self.seed!r}.", code="H3-SCENE-032")
        _check_whole("bedrooms", self.bedrooms, 1, MAX_BEDROOMS)
        _check_whole("bathrooms", self.bathrooms, 1, MAX_BATHROOMS)
        _check_whole("density", self.density, 1, MAX_DENSITY)
        if not isinstance(self.articulated, bool):
            raise InputError(
                f"articulated of a home must be true or false, got {self.articulated!r}.", code="H3-SCENE-033"
            )
        if not isinstance(self.doors, bool) or (self.doors and self.generation < 2):
            raise InputError(
                f"doors of a home must be true or false, true with generation=2; got {self.doors!r}.",
                code="H3-SCENE-034",
            )
        _check_number("clutter", self.clutter, 0.0, MAX_CLUTTER)
        program = self.program
        smallest = min_area_m2(program.bedrooms, program.bathrooms)
        rooms = f" for {program.bedrooms} bedrooms and {program.bathrooms} bathrooms"
        _check_number("area_m2", program.area_m2, smallest, MAX_AREA_M2, rooms)

    @property
    def program(self) -> HomePreset:
        """Preset of the home with the overrides of this spec applied."""
        preset = HOME_PRESETS[self.preset]
        area_m2 = preset.area_m2 if self.area_m2 is None else self.area_m2
        bedrooms = preset.bedrooms if self.bedrooms is None else self.bedrooms
        bathrooms = preset.bathrooms if self.bathrooms is None else self.bathrooms
        first = self.generation == 1
        return HomePreset(
            area_m2=area_m2,
            bedrooms=bedrooms,
            bathrooms=bathrooms,
            extra=preset.extra if first else _extra_rooms(area_m2, bedrooms, bathrooms),
            children=0 if first else bedrooms // 2,
            generation=self.generation,
        )

    @property
    def look(self) -> Look | None:
        """Style of the home, determined by the seed if none is given; None in the first generation."""
        if self.generation == 1:
            return None
        return self.style or seed_look(self.seed)

    @property
    def changes(self) -> dict[str, float | int | str]:
        """Options that differ from those of the preset, in a fixed order."""
        program, preset = self.program, HOME_PRESETS[self.preset]
        rooms = {name: getattr(program, name) for name in ("area_m2", "bedrooms", "bathrooms")}
        changed: dict[str, float | int | str] = {n: v for n, v in rooms.items() if v != getattr(preset, n)}
        amounts = {"clutter": float(self.clutter), "density": int(self.density)}
        changed |= {name: value for name, value in amounts.items() if value != 1}
        if self.generation > 1:
            changed["generation"] = int(self.generation)
        if self.look is not None and self.look != seed_look(self.seed):
            changed["style"] = self.look
        if self.articulated:
            changed["articulated"] = True
        if self.storeys > 1:
            changed["storeys"] = int(self.storeys)
        if self.doors:
            changed["doors"] = True
        return changed


_SPARE_FOR = (("office", 13.0), ("laundry", 5.0), ("garage", 26.0), ("den", 40.0))
"""Rooms that a home of the second generation gets, in this order, with the area that each must leave spare [m2]."""


def _extra_rooms(area_m2: float, bedrooms: int, bathrooms: int) -> tuple[str, ...]:
    spare = area_m2 - 24.0 - 24.0 * bedrooms - 10.0 * bathrooms
    found = []
    for room, area in _SPARE_FOR:
        if spare < area:
            break
        spare -= area
        found.append(room)
    return tuple(found)


def seed_look(seed: int) -> Look:
    """Return the style that a seed determines."""
    digest = hashlib.sha256(f"h3data.homes/look/{int(seed)}".encode()).digest()
    return get_args(Look)[digest[0] % len(get_args(Look))]


def _check_number(name: str, value: object, low: float, high: float, why: str = "") -> None:
    fine = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not fine or not low <= value <= high:  # type: ignore[operator]
        raise InputError(
            f"{name} of a home must be a number from {low:g} to {high:g}{why}, got {value!r}.", code="H3-SCENE-027"
        )


def _check_whole(name: str, value: object, low: int, high: int) -> None:
    if value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
        raise InputError(
            f"{name} of a home must be a whole number from {low} to {high}, got {value!r}.", code="H3-SCENE-028"
        )


def stage_rng(spec: HomeSpec, stage: str, attempt: int = 0) -> np.random.Generator:
    """Return the random generator of one stage, with a key of seed, preset, rooms, stage and attempt.

    Stages are independent: if one samples more or fewer numbers, the others stay the same. `HomeSpec.clutter`,
    ``density``, ``style``, ``articulated`` and ``doors`` are not part of the key, because they leave rooms and
    furniture unchanged.
    """
    apart = ("clutter", "density", "style", "articulated", "doors")
    rooms = "".join(f"{k}={v!r}/" for k, v in spec.changes.items() if k not in apart)
    text = f"h3data.homes/1/{spec.preset}/{rooms}{int(spec.seed)}/{stage}/{attempt}"
    key = np.frombuffer(hashlib.sha256(text.encode()).digest()[:16], "<u8").astype(np.uint64)
    return np.random.Generator(np.random.Philox(key=key))
