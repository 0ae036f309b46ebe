"""Homes: what stands where, and where one can go. Everything is imported at first use (free space needs numba, shapely)."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from h3data.scene.freespace import FreeSpace

_HOMES = {
    "FreeSpace": "h3data.scene.freespace",
}

__all__ = ["FreeSpace"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'h3data.scene' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(importlib.import_module(_HOMES[name]), name)
