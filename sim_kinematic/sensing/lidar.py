"""2-D laser scanner that measures walls and furniture by the map and agents as circles, with arrays or tensors.

Robots are the discs of their bases. People are one disc, or two legs, the circles in which a plane at shin height cuts them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from h3data.geometry import distance_to_circles

LIDAR_RAYS = 360
"""Number of rays of `scan`, one each degree."""
LIDAR_M = 12.0
"""Largest distance that `scan` measures [m]."""
LASERS, COLUMNS = 16, 360
"""Shape of a 3-D scan: lasers from the lowest to the highest, directions from straight ahead to the left."""
ELEVATION_DEG = (-15.0, 15.0)
"""Elevation of the lowest and of the highest laser."""
SCAN_M = 30.0
"""Largest distance that a 3-D scan measures [m]."""


def scan(m: Any, *, legs: bool) -> Any:
    """Return the free distance around an agent as a laser scanner in its middle measures it, [..., LIDAR_RAYS] [m].

    The first ray is straight ahead, the others follow to the LEFT. Without anything within `LIDAR_M`, a ray measures that.
    With ``legs``, people are two circles that move as they walk, else one disc of the radius that the rules give them.
    ``m`` is a `sim_kinematic.sensing.table.Context`.
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
