"""Errands of people of a crowd: paths with activities at their ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.recording import AssetRef, Body
from h3data.scene import FreeSpace
from sim_kinematic.motion.spec import WalkerSpec

Motion = Iterator[tuple[Array, float]]
"""Place ``(x, z, heading)`` [3] of a person and their posture after each step: 0 is standing, 1 sitting and 2 lying."""


class Station(NamedTuple):
    """Place at which a person moves by a special motion, such as a seat."""

    name: str
    """Name of the station in events."""
    height_m: float
    """Height of the seat above the floor [m]; 0 without a seat."""
    taken: Array
    """Place ``(x, z, heading)`` of the person who is there, and the distance that others keep from it [m], [4]."""
    motion: Callable[[Array, float], Motion]
    """Function that returns the motion of a person who arrives at a place [3] and stays for some seconds."""


@dataclass
class HandWork:
    """State of the hands of a person of a crowd, which the motions at stations change."""

    things: tuple[Body, ...] = ()
    """Things that the person takes or carries, beyond the things of the home; a pose of NaN means absent."""
    assets: tuple[AssetRef, ...] = ()
    """Assets that define the appearance of the things."""
    lead: Array = field(default_factory=lambda: np.zeros((4, 4)))
    """Places to which the hands move (`h3data.bodies.people.gestures.lead_hands`) [4, 4]."""
    held: dict[int, Array] = field(default_factory=dict)
    """Poses (pose7), in the agent root frame, of the things in the hands, by number."""
    joints: dict[int, float] = field(default_factory=dict)
    """New positions of joints of the home, by number."""
    events: list[tuple[str, str, str]] = field(default_factory=list)
    """New events: kind, name of the thing, and detail."""

    def beside(
        self, free: FreeSpace, place: Array, heading: float, walker: WalkerSpec, arms: Array
    ) -> tuple[Array, dict[int, Array]]:
        """Return ``lead`` and ``held`` after a step to a place [2], with folded ``arms`` [2], as the room there allows."""
        return self.lead, self.held


class Errand(NamedTuple):
    """Errand of a person: a path to a place, and the time that they stay there."""

    path: NDArray[np.float64]
    """Path to the place [K, 2] [m]; if K < 2, there is no path."""
    seconds: float = 0.0
    """Time to stay at the place [s]; 0 if the person passes it without stopping."""
    look: tuple[float, float] | None = None
    """Point (x, z) that the person faces during the stay [m]."""
    activity: str = "walk"
    """Activity at the place, given as the name of a posture; a body without that posture stands."""
    place: str = ""
    """Name of the place."""
    station: Station | None = None
    """Station at which the person moves by a special motion, such as a seat; None: they stand."""
    refused: tuple[str, str] = ("", "")
    """Name of a place that the person wanted but cannot use, and the reason as a sentence."""


Guide = Callable[[NDArray[np.float64], NDArray[np.float64] | None, Sequence[Array]], Errand]
"""Function ``(xz, goal, taken)`` that returns the next errand of a person at a place [2] [m], or the path from there to
the goal [2] of their group. The places ``(x, z, ...)`` that other people use, or go to, are ``taken``."""


class Agenda(Protocol):
    """Stops of one person, such as those of a morning at home; `roles.routines` finds more in packages."""

    hands: HandWork | None
    """State of the person's hands; None: they handle nothing."""

    def follow(self, version: int) -> Agenda:
        """Follow a version of the rules of people (`sim_kinematic.crowd.crowd.VERSION`) from now on; return itself.

        Before the first call, the newest version is followed.
        """
        ...

    @property
    def stops(self) -> Sequence[tuple[str, str, float]]:
        """Return the place, activity and duration [s] of each stop, which recordings store."""
        ...

    def next_stop(
        self, xz: NDArray[np.float64], taken: Sequence[Array] = ()
    ) -> tuple[NDArray[np.float64], Errand] | None:
        """Return the place [2] of the next stop that a person at a place [2] can walk to, and its errand without a path.

        The places ``(x, z, ...)`` that other people use are ``taken``. Returns None if no stop can be reached.
        """
