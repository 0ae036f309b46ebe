"""Catalogue of kinds of things: semantic class, mass and grasp of each, read from ``datasets/kinds/``.

A file of the catalogue also holds how the generator of homes makes each kind (`Kind.model`), which only the generator reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.builtin import builtin_root

Grasp = Literal["body", "rim", "handle", "top", "edge", "none"]
"""Part that a hand grasps: the whole thing around its middle, the rim of an open vessel, a handle, its top, a flat edge
(plates, books, boards); nothing, if it is too heavy or fixed."""
Role = Literal["thing", "furniture", "wall", "building"]


class Kind(msgspec.Struct, frozen=True, kw_only=True, eq=False, forbid_unknown_fields=True):
    """One kind of thing. Frame of its model: +Y up, front +Z, standing at y = 0; wall things have their back at z = 0."""

    name: str
    """Semantic class of the kind (`Asset.category`)."""
    semantic_id: int = msgspec.field(name="id")
    """Number in semantic images. It never changes, because recorded images contain it."""
    role: Role
    mass_kg: float
    """Typical mass of a thing of this kind."""
    grasp: Grasp = "none"
    hold_m: tuple[float, float, float] | None = None
    """Position of the handle [m]; None = the place that follows from ``grasp``."""
    generation: int = 2
    """The first generation of homes in which it occurs."""
    storeys: int = 1
    """The smallest number of storeys of the homes in which it occurs."""
    model: msgspec.Raw = msgspec.Raw()
    """Model from which the generator of homes makes it, as JSON; empty for kinds that functions of the generator make."""


KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        kind.name: kind
        for kind in sorted(
            (
                kind
                for file in sorted((builtin_root() / "kinds").glob("*.json"))
                for kind in msgspec.json.decode(file.read_bytes(), type=list[Kind])
            ),
            key=lambda kind: kind.semantic_id,
        )
    }
)
"""All kinds of things by semantic class, in the order of their ids: 1-99 the building and homes of the first
generation, 100-199 furniture, from 200 things."""
CATEGORIES: Mapping[str, int] = MappingProxyType(
    {kind.name: kind.semantic_id for kind in KINDS.values() if kind.generation == 1}
)
"""Semantic id of every class of the first generation of homes: 1-9 the building, 10-59 furniture, 60-99 small objects; 0 is
"unlabelled"."""


def grasp_point_in(grasp: Grasp, bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the point at which a hand grasps a thing with this box [2, 3] [m], +Y up.

    This is the middle of the box where a handle is not known.
    """
    low, high = bounds
    middle = (low + high) / 2
    # the front is +z in the frame of a kind: a point of the rim at its side, and the middle of the front edge
    if grasp == "rim":
        return np.array([high[0], high[1], middle[2]])
    if grasp == "edge":
        return np.array([middle[0], middle[1], high[2]])
    if grasp == "top":
        return np.array([middle[0], high[1], middle[2]])
    return middle
