"""Geometry of the free floor as it is built and stored; `FreeSpace` answers queries about it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon

from h3data.scene.floor_heights import LEVEL
from h3data.scene.freespace._visibility import Graph


@dataclass(frozen=True, kw_only=True, eq=False)
class FloorMap:
    """Free floor for a disc of one radius: polygons, distances to obstacles, and visibility graph."""

    key: str
    """SHA-256 of the geometry and the parameters from which it was built; empty if it was not built from a scene."""
    floor_y: float
    """Height of the floor [m]; if there are several storeys, of the lowest one."""
    radius_m: float
    height_m: float
    """Height above the floor up to which objects are obstacles; lower objects up to ``max_climb_m`` are not [m]."""
    max_climb_m: float
    cell_m: float
    """Side of a cell of ``sdf`` [m]."""
    origin: NDArray[np.float64]
    """Lower corner (x, z) [m] of cell [0, 0]; the centre of cell [i, j] is ``origin + (i + 0.5, j + 0.5) * cell_m``."""
    sdf: NDArray[np.float32]
    """Distance from cell centres to the nearest obstacle or border of the floor, not inflated: an agent fits where it is
    at least ``radius_m``; negative in obstacles and off the floor. Shape [nx, nz] [m]."""
    polygon: MultiPolygon
    """Area in which an agent's centre may be: floor minus obstacles, shrunk by the radius. Its polygons are the islands,
    largest first."""
    graph: Graph
    """Visibility graph over the corners of ``polygon``, with all shortest paths."""
    heights: NDArray[np.float64] = field(default_factory=LEVEL.copy)
    """Table of floor heights if stairs join storeys (`h3data.scene.floor_heights`), shape [K, 10]; K = 0 if the floor
    is at ``floor_y`` everywhere."""
