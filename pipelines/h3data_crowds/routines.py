"""Routines of people: a sequence of stops ``(place, activity, seconds)`` in a home.

A place is the name of a thing in the home, which the person faces during the activity. An activity (`ACTIVITIES`) is
also the name of a posture; a body without a posture of this name stands. The names in `Humanoid.acts` are activities too:
the person plays that motion, as often as it fits into the time, where the floor is free below all of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.bodies.people.gestures import GESTURES
from h3data.errors import InputError, SceneError
from h3data.geometry import Array
from h3data.scene import FreeSpace, Scene
from h3data.scene.records import instance_bounds
from sim_kinematic.crowd.crowd import VERSION
from sim_kinematic.crowd.errands import Errand, HandWork, Motion, Station
from sim_kinematic.crowd.seating import SETTLE_S, Seats, steps_between
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import STEP_S


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

CLIP_GAPS = (0.5, 0.6, 0.75, BESIDE_M, 1.1, 1.3, 1.6, 2.0)
"""Distances from a thing at which people play captured motions, of which the nearest with room is taken [m]."""
INTO_M = 0.02
"""Greatest depth of the body in what stands on the floor during a captured motion [m]."""


def posture_of(activity: str, postures: Sequence[str] = ("stand",)) -> str:
    """Return the posture for an activity: one with the activity's name, its general posture, or ``stand``."""
    own = ACTIVITIES[activity].posture if activity in ACTIVITIES else activity
    return next((name for name in (activity, own) if name in postures), "stand")


def place_beside(
    scene: Scene,
    free: FreeSpace,
    name: str,
    near: NDArray[np.float64],
    outline: Array | None = None,
    taken: Sequence[Array] = (),
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the nearest reachable place (x, z) [2] [m] next to a thing and the point [2] of it to face, or None.

    Args:
        scene: The home.
        free: Free floor of the home.
        name: Name of the thing.
        near: Position (x, z) [2] [m] from which the person comes.
        outline: Circles ``(ahead, right, radius)`` [N, 3] [m] of a person who faces the thing, for which there must be
            free floor; None: any person who stands.
        taken: Places ``(x, z, ...)`` of others, from which the circles must be 0.3 m away.
    """
    thing = next(instance for instance in scene.instances if instance.name == name)
    low, high = instance_bounds(scene, thing)[:, [0, 2]]
    angles = 2 * np.pi * np.arange(BEARINGS) / BEARINGS
    away = np.stack([np.cos(angles), np.sin(angles)], 1)
    edge = np.clip((low + high) / 2 + away * np.hypot(*(high - low)), low, high)
    gaps = (0.5, 0.6, 0.75, BESIDE_M) if outline is None else CLIP_GAPS
    at = np.concatenate([edge + gap * away for gap in gaps])
    faced = np.tile(edge, (len(gaps), 1))
    far = free.geodesic(np.broadcast_to(near, at.shape), at)
    fits = np.isfinite(far) & (free.signed_distance(at) >= ROOM_M) & no_wall_between(free, at, faced)
    fits = np.flatnonzero(fits)
    if outline is not None:
        ahead = faced[fits] - at[fits]
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        right = np.stack([-ahead[:, 1], ahead[:, 0]], 1)
        points = at[fits, None] + outline[:, :1] * ahead[:, None] + outline[:, 1:2] * right[:, None]
        room = free.signed_distance(points.reshape(-1, 2)).reshape(points.shape[:2])
        for other in taken:
            room = np.minimum(room, np.linalg.norm(points - other[:2], axis=2) - 0.3)
        fits = fits[np.all(room >= outline[:, 2] - INTO_M, axis=1)]
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
            InputError: There are no stops, a stop names nothing in the home or has no finite duration, a captured motion
                has the name of another activity, or lasts longer than its stop.
        """
        names = {instance.name for instance in scene.instances}
        wrong = [stop for stop in stops if stop.place not in names or not 0 < stop.seconds < math.inf]
        if wrong or not stops:
            raise InputError(
                f"Expected stops (place, activity, seconds) at things of {scene.name}, of more than 0 s, got "
                f"{tuple(wrong[0]) if wrong else 'none'}.",
                code="H3-SIM-063",
            )
        self.stops, self.acts = tuple(stops), {} if body is None else body.acts
        """Stops, and the captured motions of the person by name."""
        for name in sorted({*self.acts} & {*ACTIVITIES, *GESTURES, "take", "lift", "put"}):
            raise InputError(
                f"A captured motion has the name of the activity {name!r}. Hint: give it another name.",
                code="H3-TASK-094",
            )
        for stop in self.stops:
            if stop.activity in self.acts and self.acts[stop.activity].seconds > stop.seconds:
                raise InputError(
                    f"The motion {stop.activity!r} lasts {self.acts[stop.activity].seconds:.1f} s, longer than its stop "
                    f"{tuple(stop)}. Hint: give the stop more time, or cut the motion.",
                    code="H3-TASK-096",
                )
        self.hands: HandWork | None = HandWork() if self.acts else None
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
        if stop.activity in self.acts:
            own = self.acts[stop.activity]
            found = place_beside(self._scene, self._free, stop.place, xz, own.outline, taken)
            if found is not None:
                (x, z), look = found[0].tolist(), found[1]
                place = np.array([x, z, np.arctan2(z - look[1], look[0] - x)])
                keeps = PERSON_M + float(np.hypot(*own.outline[:, :2].T).max())
                station = Station(stop.place, 0.0, np.append(place, keeps), partial(self._perform, stop, place))
                errand = Errand(np.zeros((0, 2)), stop.seconds, None, stop.activity, stop.place, station)
                return (found[0], errand), refused
            fault = InputError(
                f"There is no free floor for {stop.activity!r} within {CLIP_GAPS[-1]} m of {stop.place}.",
                code="H3-TASK-095",
            )
            refused = stop.place, f"{fault.code}: {fault}"
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

    def _perform(self, stop: Stop, place: Array, here: Array, seconds: float) -> Motion:
        """Yield the motion of a person who steps to a place [3], plays the motion of a stop, and stands there until its end.

        The hands are led to where the motion has them, so that contact finds the arms there.
        """
        assert self.hands is not None
        act, work = self.acts[stop.activity], self.hands
        yield from steps_between(here, place)
        for _ in range(round(SETTLE_S / STEP_S)):
            yield place, 0.0
        times = int(seconds / act.seconds + 1e-6)
        work.events.append((act.event, stop.activity, str(times)))
        for lead in np.tile(act.leads, (times, 1, 1)):
            work.lead[:] = lead
            yield place, 0.0
        work.lead[:] = 0.0
        for _ in range(round((seconds - times * act.seconds) / STEP_S) + 1):
            yield place, 0.0


def _daily(name: str, episode: Any, number: int) -> Routine:
    stops = make_routine(episode.scene, episode.seed, number, name)
    return Routine(episode.scene, episode.free, stops, episode.roster[number].body)


morning, evening = partial(_daily, "morning"), partial(_daily, "evening")
"""Functions that return routines of agents, sampled from the seed (`sim_kinematic.crowd.roles.routines`)."""
