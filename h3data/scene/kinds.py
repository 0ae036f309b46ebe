"""Catalogue of kinds of objects with their semantic class, mass and grasp, read from ``datasets/kinds/``.

The files also hold a model of each kind (`Kind.model`), which only the generator of homes reads.
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
"""Part that a hand grasps: the whole object around its middle, the rim of an open vessel, a handle, its top, a flat
edge (plates, books, boards), or nothing if the object is too heavy or fixed."""
Role = Literal["thing", "furniture", "wall", "building"]


class Kind(msgspec.Struct, frozen=True, kw_only=True, eq=False, forbid_unknown_fields=True):
    """Kind of object.

    In the frame of its model, +Y is up, the front faces +Z, and the object stands at y = 0; objects on walls have their
    back at z = 0.
    """

    name: str
    """Semantic class of the kind (`Asset.category`)."""
    semantic_id: int = msgspec.field(name="id")
    """Number in semantic images. It never changes, because recorded images contain it."""
    role: Role
    mass_kg: float
    """Typical mass of an object of this kind [kg]."""
    grasp: Grasp = "none"
    hold_m: tuple[float, float, float] | None = None
    """Position of the handle [m]; None for the position that follows from ``grasp``."""
    generation: int = 2
    """The first generation of homes in which the kind occurs."""
    storeys: int = 1
    """The smallest number of storeys of the homes in which the kind occurs."""
    model: msgspec.Raw = msgspec.Raw()
    """Model from which the generator of homes makes it, as JSON; empty for kinds that functions of the generator
    build."""


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
"""All kinds of objects by semantic class, in the order of their ids: 1-99 the building and kinds of the first
generation, 100-199 further furniture, from 200 further small objects."""
CATEGORIES: Mapping[str, int] = MappingProxyType(
    {kind.name: kind.semantic_id for kind in KINDS.values() if kind.generation == 1}
)
"""Semantic id of every class of the first generation of homes: 1-9 the building, 10-59 furniture, 60-99 small objects; 0 is
"unlabelled"."""


def grasp_point_in(grasp: Grasp, bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the point [3] [m] at which a hand grasps an object with a bounding box [2, 3] [m], +Y up.

    If no handle is known, this is the middle of the box.
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
