"""Errands of people of a crowd: a path, and an activity at its end."""

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
    """Path to the place [K, 2] [m]; K < 2: there is none."""
    seconds: float = 0.0
    """Time to stay there; 0: they only pass."""
    look: tuple[float, float] | None = None
    """Point (x, z) that they face meanwhile [m]."""
    activity: str = "walk"
    """Activity there, which is a posture that they may have; those without it stand."""
    place: str = ""
    """Name of the place."""
    seat: SeatPlace | None = None
    """Seat on which they sit there."""
    refused: tuple[str, str] = ("", "")
    """Seat that they wanted and stand instead, and the sentence that says why."""


Guide = Callable[[NDArray[np.float64], NDArray[np.float64] | None, Sequence[Array]], Errand]
"""Returns the next errand of somebody at a place [2] [m], or the way from there to the goal [2] of their group. Others sit or
stay, or go to do so, at places ``(x, z, ...)``."""
