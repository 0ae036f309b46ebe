"""What kind of home is wanted: presets, the table of categories, and the random numbers of each stage."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np

from h3data.errors import InputError

Preset = Literal["small", "medium"]


@dataclass(frozen=True, kw_only=True)
class HomePreset:
    """Size and rooms of one kind of home; every home has a living room, a kitchen and a hall besides."""

    area_m2: float
    """Floor area, to the middle of inner walls and to the inner face of outer walls [m2]."""
    bedrooms: int
    bathrooms: int


HOME_PRESETS: Mapping[str, HomePreset] = MappingProxyType(
    {
        "small": HomePreset(area_m2=68.56, bedrooms=1, bathrooms=1),
        "medium": HomePreset(area_m2=136.11, bedrooms=3, bathrooms=2),
    }
)
"""Areas and rooms of the Habitat 3.0 paper's benchmark homes (research/navigation-and-stepping.md 6)."""


@dataclass(frozen=True, kw_only=True)
class HomeSpec:
    """Everything that decides a procedural home: the same spec gives the same scene, byte for byte."""

    seed: int = 0
    preset: Preset = "small"

    def __post_init__(self) -> None:
        if self.preset not in get_args(Preset):
            raise InputError(f"Unknown home preset {self.preset!r}. There are: {', '.join(get_args(Preset))}.")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int | np.integer) or self.seed < 0:
            raise InputError(f"The seed of a home must be a whole number >= 0, got {self.seed!r}.")


_STRUCTURE = ("wall", "floor", "ceiling", "door", "window", "trim")
_FURNITURE = (
    "sofa", "armchair", "coffee_table", "tv_stand", "tv", "shelf", "dining_table", "chair", "kitchen_counter",
    "stove", "fridge", "kitchen_cabinet", "bed", "nightstand", "wardrobe", "desk", "toilet", "bathroom_sink",
    "bathtub", "shower", "rug", "floor_lamp", "plant", "picture", "mirror", "ceiling_lamp", "console"
)  # fmt: skip
_OBJECTS = ("can", "mug", "bowl", "box", "bottle", "book", "apple", "orange")

OBJECT_CATEGORIES: tuple[str, ...] = _OBJECTS
"""Small things that stand on receptacles and may be carried away (``motion="kinematic"``)."""

CATEGORIES: Mapping[str, int] = MappingProxyType(
    {
        **{name: 1 + i for i, name in enumerate(_STRUCTURE)},
        **{name: 10 + i for i, name in enumerate(_FURNITURE)},
        **{name: 60 + i for i, name in enumerate(_OBJECTS)},
    }
)
"""Semantic id of every category: 1-9 the building, 10-59 furniture, 60-99 small objects; 0 stays "unlabelled".

Stable: append to a block, never reorder, because recorded pictures refer to these numbers.
"""


def stage_rng(spec: HomeSpec, stage: str, attempt: int = 0) -> np.random.Generator:
    """Random numbers of one stage, keyed by (seed, preset, stage, attempt): a change in one stage leaves the others."""
    text = f"h3data.homes/1/{spec.preset}/{int(spec.seed)}/{stage}/{attempt}"
    key = np.frombuffer(hashlib.sha256(text.encode()).digest()[:16], "<u8").astype(np.uint64)
    return np.random.Generator(np.random.Philox(key=key))
