"""Routines of people: a sequence of stops ``(place, activity, seconds)`` in a home.

A place is the name of a thing in the home, which the person faces during the activity. An activity (`ACTIVITIES`) is
also the name of a posture; a body without a posture of this name stands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.errors import InputError, SceneError
from h3data.geometry import Array
from h3data.scene import FreeSpace, Scene
from h3data.scene.records import instance_bounds
from sim_kinematic.crowd.crowd import VERSION
from sim_kinematic.crowd.errands import Errand, HandWork
from sim_kinematic.crowd.seating import Seats
from sim_kinematic.motion.randomness import generator


class Stop(NamedTuple):
    """Stop of a routine."""

    place: str
    """Name of the thing in the home at which the activity takes place."""
    activity: str
    seconds: float


class Activity(NamedTuple):
    """An activity that routines may have."""

    categories: tuple[str, ...]
    """Categories of the things at which the activity takes place."""
    least_s: float
    most_s: float
    """Longest duration [s]; the shortest is ``least_s``, and a duration between the two is sampled."""
    posture: str = "stand"
    """Posture of a person during the activity."""


ACTIVITIES: dict[str, Activity] = {
    "wash": Activity(("bathroom_sink",), 20.0, 60.0),
    "dress": Activity(("wardrobe", "chest_of_drawers"), 15.0, 40.0),
    "fetch": Activity(("fridge",), 5.0, 12.0),
    "cook": Activity(("kitchen_counter", "stove"), 30.0, 90.0),
    "eat": Activity(("dining_table",), 40.0, 120.0, "sit"),
    "put_on_shoes": Activity(("bed", "bench", "stool"), 10.0, 30.0, "sit"),
    "read": Activity(("sofa", "armchair", "rocking_chair"), 20.0, 60.0, "sit"),
    "work": Activity(("desk",), 40.0, 120.0, "sit"),
    "look_out": Activity(("window",), 5.0, 20.0),
    "wave": Activity(("window",), 3.0, 6.0),
    "knock": Activity(("door",), 3.0, 6.0),
    "dishes": Activity(("kitchen_counter",), 20.0, 60.0),
    "rest": Activity(("bed", "sofa"), 20.0, 60.0, "lie"),
}
"""Activities by name."""
DAYS = {
    "morning": ("wash", "dress", "put_on_shoes", "fetch", "cook", "eat", "look_out", "read", "work"),
    "evening": ("fetch", "cook", "eat", "look_out", "read", "wash", "rest"),
}
"""Order of activities in each of `sim_kinematic.crowd.roles.routines`, some of which each person leaves out."""
KEPT = 0.7
"""Share of activities that a person does not leave out."""
PERSON_M = 1.0
"""Distance from other people within which nobody stops [m]."""
BETWEEN = np.linspace(0.2, 0.9, 6)
"""Fractions of the line to a thing at which the floor must be free."""
BESIDE_M, ROOM_M, BEARINGS = 0.9, 0.33, 48
"""Largest distance of a person from a thing, smallest free radius there [m], and number of directions that are tried.
"""


def posture_of(activity: str, postures: Sequence[str] = ("stand",)) -> str:
    """Return the posture for an activity: one with the activity's name, its general posture, or ``stand``."""
    own = ACTIVITIES[activity].posture if activity in ACTIVITIES else activity
    return next((name for name in (activity, own) if name in postures), "stand")


def place_beside(
    scene: Scene, free: FreeSpace, name: str, near: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the nearest reachable place (x, z) [2] [m] next to a thing and the point [2] of it to face, or None.

    Args:
        scene: The home.
        free: Free floor of the home.
        name: Name of the thing.
        near: Position (x, z) [2] [m] from which the person comes.
    """
    thing = next(instance for instance in scene.instances if instance.name == name)
    low, high = instance_bounds(scene, thing)[:, [0, 2]]
    angles = 2 * np.pi * np.arange(BEARINGS) / BEARINGS
    away = np.stack([np.cos(angles), np.sin(angles)], 1)
    edge = np.clip((low + high) / 2 + away * np.hypot(*(high - low)), low, high)
    at = np.concatenate([edge + gap * away for gap in (0.5, 0.6, 0.75, BESIDE_M)])
    faced = np.tile(edge, (4, 1))
    far = free.geodesic(np.broadcast_to(near, at.shape), at)
    fits = np.isfinite(far) & (free.signed_distance(at) >= ROOM_M) & no_wall_between(free, at, faced)
    fits = np.flatnonzero(fits)
    if not len(fits):
        return None
    best = fits[np.argmin(np.hypot(*(at[fits] - faced[fits]).T) + 1e-3 * far[fits])]
    return at[best], faced[best]


def no_wall_between(free: FreeSpace, at: Array, faced: Array) -> NDArray[np.bool_]:
    """Return whether the floor between places [N, 2] and the points [N, 2] of things that people face there is free."""
    between = at[:, None] + BETWEEN[:, None] * (faced - at)[:, None]
    return np.all(free.signed_distance(between) > 0, axis=1)


def make_routine(scene: Scene, seed: int, number: int, name: str = "morning") -> tuple[Stop, ...]:
    """Return the routine with a name from `DAYS` for an agent and a seed, made from the things of the home.

    Raises:
        SceneError: The home has no things for any activity.
    """
    rng = generator(seed, name, world=number)
    things: dict[str, list[str]] = {}
    for instance in scene.instances:
        things.setdefault(scene.assets[instance.asset].category, []).append(instance.name)
    stops = []
    for doing in DAYS[name]:
        activity = ACTIVITIES[doing]
        places = [place for category in activity.categories for place in things.get(category, ())]
        place, seconds = int(rng.integers(1 << 30)), float(rng.uniform(activity.least_s, activity.most_s))
        if places and rng.random() < KEPT:
            stops.append(Stop(places[place % len(places)], doing, round(seconds, 1)))
    if not stops:
        kinds = ", ".join(sorted({category for a in ACTIVITIES.values() for category in a.categories}))
        raise SceneError(f"Nobody can spend the {name} in {scene.name}: it has none of {kinds}.", code="H3-SIM-062")
    return tuple(stops)


class Routine:
    """Routine of one person, which gives one errand after another and starts again after the last."""

    def __init__(self, scene: Scene, free: FreeSpace, stops: Sequence[Stop], body: Humanoid | None = None) -> None:
        """Create a routine and check its stops; without a ``body`` the person always stands.

        Raises:
            InputError: There are no stops, or a stop names nothing in the home or has no finite duration.
        """
        names = {instance.name for instance in scene.instances}
        wrong = [stop for stop in stops if stop.place not in names or not 0 < stop.seconds < math.inf]
        if wrong or not stops:
            raise InputError(
                f"Expected stops (place, activity, seconds) at things of {scene.name}, of more than 0 s, got "
                f"{tuple(wrong[0]) if wrong else 'none'}.",
                code="H3-SIM-063",
            )
        self.stops = tuple(stops)
        self.hands: HandWork | None = None
        """Work of the person's hands; None: they handle nothing."""
        self.version = VERSION
        """Version of the rules of the person (`follow`)."""
        self._scene, self._free, self._next = scene, free, 0
        self._seats = None if body is None else Seats(scene, free, body)

    def follow(self, version: int) -> Routine:
        """Follow a version of the rules of people (`sim_kinematic.crowd.crowd.VERSION`) from now on; return itself."""
        self.version = version
        return self

    def next_stop(
        self, xz: NDArray[np.float64], taken: Sequence[Array] = ()
    ) -> tuple[NDArray[np.float64], Errand] | None:
        """Return the position (x, z) [2] [m] of the next stop that a person can walk to, and its errand without a path.

        The person sits if the activity is done sitting and the place has a seat for them. A stop at one of the
        positions ``taken`` by others (x, z, ...) is skipped until its next turn. None means that no stop can be
        reached.
        """
        refused = "", ""
        for _ in self.stops:
            k = self._next % len(self.stops)
            self._next += 1
            found, why = self.errand_at(k, xz, taken)
            refused = refused if refused[0] else why
            if found is not None:
                return found[0], found[1]._replace(refused=refused)
        return None

    def errand_at(
        self, k: int, xz: NDArray[np.float64], taken: Sequence[Array]
    ) -> tuple[tuple[NDArray[np.float64], Errand] | None, tuple[str, str]]:
        """Return the place and errand of stop ``k`` as `next_stop` does, or a refused errand (`Errand.refused`)."""
        stop, refused = self.stops[k], ("", "")
        posture = posture_of(stop.activity, ("stand", "sit", "lie"))
        if self._seats is not None and posture != "stand":
            seats = self._seats.at(stop.place)
            # who finds no place to lie sits
            for seat, lies in [
                *((seat, True) for seat in seats if posture == "lie"),
                *((seat, False) for seat in seats),
            ]:
                try:
                    place = self._seats.place(seat, taken)
                    place = self._seats.to_lie(place, taken) if lies else place
                except InputError as fault:
                    refused = refused if refused[0] else (seat.name, f"{fault.code}: {fault}")
                    continue
                if np.isfinite(self._free.geodesic(xz, place.before[:2])):
                    at = np.asarray(place.before[:2], np.float64)
                    errand = Errand(
                        np.zeros((0, 2)),
                        stop.seconds,
                        None,
                        stop.activity,
                        stop.place,
                        place.station(brisk=self.version > 6),
                    )
                    return (at, errand), refused
        beside = place_beside(self._scene, self._free, stop.place, xz)
        if beside is not None and all(np.hypot(*(beside[0] - other[:2])) >= PERSON_M for other in taken):
            at, (x, z) = beside
            look = float(x), float(z)
            return (at, Errand(np.zeros((0, 2)), stop.seconds, look, stop.activity, stop.place)), refused
        return None, refused


def _daily(name: str, episode: Any, number: int) -> Routine:
    stops = make_routine(episode.scene, episode.seed, number, name)
    return Routine(episode.scene, episode.free, stops, episode.roster[number].body)


morning, evening = partial(_daily, "morning"), partial(_daily, "evening")
"""Functions that return routines of agents, sampled from the seed (`sim_kinematic.crowd.roles.routines`)."""
