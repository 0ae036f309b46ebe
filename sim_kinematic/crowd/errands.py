"""Errands of people of a crowd: paths with activities at their ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from sim_kinematic.crowd.seating import SeatPlace


class Errand(NamedTuple):
    """Errand of a person: a path to a place, and the time that they stay there."""

    path: NDArray[np.float64]
    """Path to the place [K, 2] [m]; with K < 2 there is no path."""
    seconds: float = 0.0
    """Time to stay at the place [s]; 0: the person passes it."""
    look: tuple[float, float] | None = None
    """Point (x, z) that the person faces meanwhile [m]."""
    activity: str = "walk"
    """Activity at the place, the name of a posture. A body that has no such posture stands."""
    place: str = ""
    """Name of the place."""
    seat: SeatPlace | None = None
    """Seat on which the person sits there; None: they stand."""
    refused: tuple[str, str] = ("", "")
    """Name of a seat that the person wanted and cannot use, and the reason in a sentence."""


Guide = Callable[[NDArray[np.float64], NDArray[np.float64] | None, Sequence[Array]], Errand]
"""Function ``(xz, goal, taken)`` that returns the next errand of a person at a place [2] [m], or the path from there to the
goal [2] of their group. Others sit or stay, or go to do so, at the places ``taken`` ``(x, z, ...)``."""
