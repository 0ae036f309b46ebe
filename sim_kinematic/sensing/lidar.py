"""2-D laser scanner that measures walls and furniture by the map and agents as circles, on arrays or tensors.

Robots are the discs of their bases. People are either one disc, or two circles, in which a plane at shin height cuts
their legs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from h3data.geometry import distance_to_circles

LIDAR_RAYS = 360
"""Number of rays of `scan`, one per degree."""
LIDAR_M = 12.0
"""Largest distance that `scan` measures [m]."""
LASERS, COLUMNS = 16, 360
"""Shape of a 3-D scan: number of lasers, from the lowest to the highest, and number of directions, from straight ahead
to the left."""
ELEVATION_DEG = (-15.0, 15.0)
"""Elevations of the lowest and of the highest laser [degrees]."""
SCAN_M = 30.0
"""Largest distance that a 3-D scan measures [m]."""


def scan(m: Any, *, legs: bool) -> Any:
    """Return the free distance around an agent that a laser scanner in its middle measures, [..., LIDAR_RAYS] [m].

    The first ray points straight ahead, and the others follow to the LEFT. A ray that hits nothing within `LIDAR_M`
    returns `LIDAR_M`. With ``legs``, people are two circles that move as they walk; otherwise they are one disc with
    the radius in the rules. ``m`` is a `sim_kinematic.sensing.table.Context`.
    """
    xp = m.xp
    # a plain number has neither the dtype nor the device that `arange` is given
    heading = np.asarray(m.now.heading, np.float64) if xp is np else m.now.heading
    turns = xp.arange(LIDAR_RAYS, dtype=heading.dtype, device=heading.device) * (2 * np.pi / LIDAR_RAYS)
    headings = heading[..., None] + turns
    reach = m.free_along(headings, LIDAR_M)
    circles = m.circles(legs=legs)
    # there is no minimum over nobody
    if not circles.shape[-2]:
        return reach
    return xp.minimum(reach, distance_to_circles(m.now.xz, headings, circles, xp=xp).clip(None, LIDAR_M))
