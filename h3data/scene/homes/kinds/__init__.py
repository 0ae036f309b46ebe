"""The kinds of things that homes contain: `KINDS`, by semantic class.

- `kind`: the record and what is made from it; `parts`, `colours`: the words that the tables are written in
- things: `kitchenware`, `household`, `leisure`; furniture: `pieces`, `on_walls`
- `first`: the kinds of the first generation, whose models are functions; `building`: stairs and railings
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from h3data.scene.homes.kinds.building import BUILDING
from h3data.scene.homes.kinds.first import FIRST
from h3data.scene.homes.kinds.household import HOUSEHOLD
from h3data.scene.homes.kinds.kind import Kind
from h3data.scene.homes.kinds.kitchenware import KITCHENWARE
from h3data.scene.homes.kinds.leisure import LEISURE
from h3data.scene.homes.kinds.on_walls import ON_WALLS
from h3data.scene.homes.kinds.pieces import PIECES

KINDS: Mapping[str, Kind] = MappingProxyType(
    {**FIRST, **PIECES, **ON_WALLS, **KITCHENWARE, **HOUSEHOLD, **LEISURE, **BUILDING}
)
"""All kinds by semantic class. Their ids: 1-99 the first generation, 100-199 furniture, from 200 things."""

__all__ = ["BUILDING", "KINDS", "Kind"]
