"""Occupancy grids: the map of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.scene import FreeSpace

CELL_M = 0.05
"""Side of the cells of exported maps [m]."""
UNSEEN_M = 0.25
"""Cells farther than this behind the outline of the floor are unknown, as in the map of a robot that has never seen them."""
FREE, OCCUPIED, UNKNOWN = 0, 100, -1


@dataclass(frozen=True, kw_only=True, eq=False)
class OccupancyMap:
    """A grid in the frame ``map``, whose x axis is the world's and whose y axis is the world's -z."""

    cells: NDArray[np.int8]
    """`FREE`, `OCCUPIED` or `UNKNOWN` [rows, columns]; rows go along y from the origin, columns along x."""
    resolution: float
    """Side of a cell [m]."""
    origin: tuple[float, float]
    """Corner of the first cell in the frame ``map`` [m]."""


def map_of(free: FreeSpace, *, resolution: float = CELL_M) -> OccupancyMap:
    """Return the map of a floor: a cell is free if its middle is, before the floor is narrowed by the radius of agents."""
    low = free.origin
    high = low + np.array(free.sdf.shape) * free.cell_m
    x0, y0 = np.floor(low[0] / resolution) * resolution, np.floor(-high[1] / resolution) * resolution
    columns = int(np.ceil((high[0] - x0) / resolution))
    rows = int(np.ceil((-low[1] - y0) / resolution))
    x, y = np.meshgrid(x0 + (np.arange(columns) + 0.5) * resolution, y0 + (np.arange(rows) + 0.5) * resolution)
    distance = free.signed_distance(np.stack([x, -y], axis=-1))
    cells = np.where(distance > 0, FREE, np.where(distance < -UNSEEN_M, UNKNOWN, OCCUPIED)).astype(np.int8)
    return OccupancyMap(cells=cells, resolution=resolution, origin=(float(x0), float(y0)))
