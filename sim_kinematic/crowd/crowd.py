"""People of one world who walk from goal to goal and avoid others by a crowd model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.scene import FreeSpace
from sim_kinematic.avoidance.routes import FloorRoutes, distance_to_path
from sim_kinematic.crowd.company import PASSING_M, standing_circle
from sim_kinematic.crowd.errands import Errand, Guide, Motion, Station
from sim_kinematic.crowd.reactions import REACTIONS
from sim_kinematic.crowd.roles import ALONE, Role
from sim_kinematic.crowd.step import SEATED, step_crowd
from sim_kinematic.crowd.traits import CrowdSpec, Traits
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import STEP_S, StrideSpec

CrowdModel = Literal["social_force", "orca"]
ARRIVED_M = 0.4
"""Distance within which a goal counts as reached [m]."""
ATTEMPTS = 8
"""Largest number of goals that are tried in one step, as some of them may have been reached already."""
STUCK_PATHS, AWAY_M, WAY_M = 4, 1.0, 1.5
"""Number of goals that people who are stuck compare; distance along the path at which they look for other people [m];
and length of the path ahead of them from which people who stay there move away [m]."""
CLOSE_M = 1.5
"""Distance from their destination within which people who are stuck stay where they are, because another person stands
there [m]."""
AROUND_M, LEAVES_M, OFF_M, FAR_M, WAY_ROOM_M = (PASSING_M, 0.8), 1.6, 0.9, 4.0, 0.4
"""Distances for paths around people who stand, and for backing out [m]: distances at which paths go around them, the
second of which is used if the first leaves no path; least distances of a place to back out to from everybody near, and
from their paths; distance within which people count as near; length of these paths; and distance from the path of the first of
their group that those keep who back out for them."""
VERSION = 10
"""Version of the rules by which crowds and people with routines decide, which recordings store. In version 1, that of
recordings without a version, conversations may close a passage, groups pull together through walls, and people who stay
somewhere stay there although others cannot get past. Up to version 2, people avoid others 2 s ahead, including those who
give way to them, and step aside more slowly (`CrowdSpec.of_version`). Up to version 3, paths lead through people who stand,
and nobody backs out (`Crowd._way`). Up to version 4, every place near a wall counts as narrow, and people give way later and
more slowly. Up to version 5, and still with `social_force` or routines, they also give way to people who have passed them,
and slow down for people who move away. Up to version 6, people with routines hold out what they carry also beside walls, do
chores through walls, and take longer before they sit down; version 7 is only that of people with routines. Up to version 7,
members of a walking group keep as far from each other as from anybody, and they still do with routines. Up to version 8, they
also do with `social_force`, whose forces act between them, and two people with chores may have things at one spot. Up to
version 9, people of `social_force` among whom some walk in groups are held up before passages (`CrowdSpec.frees`)."""
SEAT_M, SLOW_MPS, STEP_ROOM_M = 0.2, 0.35, 0.08
"""Conditions for sitting down: distance from the place before the seat [m], speed [m/s], and distance to others'
outlines below which people wait [m]."""


def _room_on(path: Array, others: Array) -> float:
    """Return the distance [m] of the nearest of ``others`` [N, 2] to a path [K, 2] at `AWAY_M` from its beginning."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.array([np.interp(AWAY_M, along, path[:, k]) for k in range(2)])
    return float(np.hypot(*(others - at).T).min()) if len(others) else np.inf


def _talking(guide: Guide, place: NDArray[np.float64], centre: tuple[float, float], group: str) -> Guide:
    """Return the guide of a person who goes to a place [2] and stays there, facing the centre of their company."""
    return lambda xz, goal, taken: Errand(
        guide(xz, place if goal is None else goal, taken).path, np.inf, centre, "talk", group
    )


class Crowd:
    """Crowd of M people on one floor who follow the same model.

    Positions are passed in at each step. The crowd stores goals, paths and chosen velocities between steps.
    """

    def __init__(
        self,
        free: FreeSpace,
        traits: Sequence[Traits],
        guides: Sequence[Guide],
        model: CrowdModel,
        *,
        roles: Sequence[Role] | None = None,
        seed: int = 0,
        spec: CrowdSpec | None = None,
        stride: StrideSpec | None = None,
        places: dict[Any, Station] | None = None,
        version: int = VERSION,
        daily: bool = False,
    ) -> None:
        """Create a crowd that stands still and has no goals yet.

        Args:
            free: Floor on which all people of the crowd walk.
            traits: Traits of each person [M].
            guides: For each person, the function that returns their next errand [M].
            model: ``orca`` (reciprocal avoidance) or ``social_force``.
            roles: Reaction, company and routine of each person [M].
            seed: Seed of the episode, which determines the places of conversations.
            spec: Constants of avoidance.
            stride: Limits of walking.
            places: Stations that people of all crowds of a world use, by crowd and number; this crowd adds its own.
            version: Version of the rules (`VERSION`); an earlier one repeats older recordings.
            daily: True if anybody has a routine.
        """
        people = len(traits)
        self._free, self._seed, self._version = free, seed, version
        self._grid = free.sdf, free.origin, free.cell_m
        self._traits, self._guides = np.array(traits, np.float64).reshape(people, 6), list(guides)
        # with the shorter horizons of version 3, people block the way of walking groups and get too near to what they fear
        self._reacts = any(role.reaction != "regular" for role in roles or ())
        wary = self._reacts or any(role.group for role in roles or ())
        # with the smaller distances of version 6, people of social force touch, and people with routines
        self._forces = model == "social_force"
        rules = spec or CrowdSpec.of_version(
            version,
            wary=wary,
            early=daily or (self._forces and not (wary and version > 8)),
            # five people who only talk would not all reach their circle by the rules for passages
            frees=self._forces and any(role.group.startswith("walk") for role in roles or ()),
        )
        self._rules, self._limits = rules.numbers, (stride or StrideSpec()).limits
        self._paths, self._lengths = np.zeros((people, 2, 2)), np.zeros((people, 2))
        self._counts = np.zeros(people, np.int64)
        self._along, self._best = np.zeros(people), np.zeros((people, 2))
        self._claims, self._body = np.zeros((people, 6)), np.zeros((people, 4))
        self._chosen, self._began = np.zeros((people, 2)), False
        self._roles = list(roles or [ALONE] * people)
        self._errands = [Errand(np.zeros((0, 2)))] * people
        self._until = np.full(people, -1.0)
        """Step until which each person stays where they are; -1 if they walk."""
        self.seats = np.zeros((people, 2))
        """Height of the seat on which each person sits [m], and share of the path from standing to sitting, [M, 2]."""
        self._taken: dict[Any, Station] = {} if places is None else places
        self._busy: dict[int, tuple[Station, Motion]] = {}
        """Station and motion of people who use a station, such as those who sit down, sit or get up."""
        self._waits: dict[int, tuple[Array, float]] = {}
        """Next place and share of sitting of people who wait at a station because another person is in the way."""
        self._stays, self._looks, self._moods = (np.zeros((people, 3)) for _ in range(3))
        self._moods[:, 0] = [list(REACTIONS).index(role.reaction) for role in self._roles]
        self._moods[:, 1] = -1.0
        words = [role.group for role in self._roles]
        self._company = np.array([words.index(w) if w.startswith("walk") else -1 for w in words], np.int64)
        self._pace = self._traits[:, 0].copy()
        # a group walks as fast as its slowest member
        for first in set(self._company.tolist()) - {-1}:
            self._pace[self._company == first] = self._pace[self._company == first].min()
        self.new_events: list[tuple[int, str, str, str]] = []
        """Events of the last step, each as number of the person, kind, target and detail."""

    @property
    def goals(self) -> Array:
        """Goal of each person [M, 2] [m]."""
        return self._paths[np.arange(len(self._counts)), np.maximum(self._counts - 1, 0)]

    def step(
        self, places: Array, before: Array, heading: Array, radii: Array, robots: Array, of_robots: int, step: int
    ) -> tuple[Array, Array]:
        """Return positions [M, 2] [m] and headings [M] [rad] after one more step.

        Args:
            places: Present positions of the people, the discs of robots, and people of other crowds [N, 2] [m].
            before: Their positions one step ago [N, 2] [m].
            heading: Headings of the people now [M] [rad].
            radii: Radii of the discs [N] [m]; those of the people are overwritten by their traits.
            robots: Places and headings of robots (x, z, heading) [R, 3].
            of_robots: Number of discs that belong to robots.
            step: Number of the step.
        """
        people, moved, self.new_events = len(heading), places.copy(), []
        if not self._began:
            self._body[:, 3] = heading
            self._meet(places[:people])
            self._began = True
        # before the step: whoever differs after it has begun or ended a reaction
        reacted = self._moods[:, 2].copy() if self._reacts else self._moods[:, 2]
        now = moved, places, before, heading, radii
        # in most steps nobody decides or is at a station, and one call of the kernel is all
        decides, done = self._call(now, robots, of_robots, step, asks=True, moves=not self._busy)
        if decides:
            self._choose_goals(places[:people], step, places)
        if not done:
            for m in list(self._busy):
                self._move_busy(m, moved, radii, step)
            self._call(now, robots, of_robots, step, asks=False, moves=True)
        for m in np.flatnonzero(self._moods[:, 2] != reacted).tolist() if self._reacts else ():
            self.new_events.append((m, "reacts" if self._moods[m, 2] else "reaction_over", self._roles[m].reaction, ""))
        return moved[:people], self._body[:, 0].copy()

    def _call(
        self, now: tuple[Array, ...], robots: Array, of_robots: int, step: int, *, asks: bool, moves: bool
    ) -> tuple[bool, bool]:
        return self._free.entries(
            step_crowd,
            *self._grid,
            *now,
            self._paths,
            self._counts,
            self._lengths,
            self._along,
            self._best,
            self._until,
            self._claims,
            self._body,
            self._chosen,
            self._stays,
            self._company,
            self._moods,
            self._looks,
            robots,
            of_robots,
            self._pace,
            self._traits,
            self._forces,
            self._rules,
            self._limits,
            step,
            STEP_S,
            ARRIVED_M + 1e-9,
            asks,
            moves,
        )

    def _move_busy(self, m: int, places: Array, radii: Array, step: int) -> None:
        """Move a person who is at a station by one step in ``places`` [N, 2], unless another agent is in the way."""
        was, share = places[m].copy(), self.seats[m, 1]
        station, motion = self._busy[m]
        moved = self._waits.pop(m, None) or next(motion, None)
        if moved is None:
            del self._busy[m]
            self._until[m] = step
            return
        (x, z, heading), now = moved[0].tolist(), moved[1]
        gaps = np.hypot(*(places - (x, z)).T) - radii - radii[m]
        # only those to whom the step leads: somebody who is too near already must not keep the person from leaving
        closer = np.hypot(*(places - (x, z)).T) < np.hypot(*(places - was).T)
        closer[m] = False
        if (closer & (gaps < STEP_ROOM_M)).any():
            self._waits[m] = moved
            return
        places[m] = x, z
        self._body[m] = heading, 0.0, 0.0, heading
        self.seats[m] = station.height_m, now
        self.new_events += [
            (m, kind, station.name, "")
            for kind, begins in (("sits_down", share == 0 < now), ("gets_up", share == 1 > now))
            if begins
        ]

    def _meet(self, xz: Array) -> None:
        """Choose places for the groups that stand and talk, from the initial positions ``xz`` [M, 2]."""
        for word in sorted({role.group for role in self._roles if role.group.startswith("talk")}):
            members = [m for m, role in enumerate(self._roles) if role.group == word]
            number = int(word.removeprefix("talk") or 0)
            places, (x, z) = standing_circle(
                self._free,
                xz[members],
                generator(self._seed, "conversation", world=number),
                leaves_way=self._version > 1,
            )
            for m, place in zip(members, places, strict=True):
                self._guides[m] = _talking(self._guides[m], np.asarray(place, np.float64), (float(x), float(z)), word)

    def _choose_goals(self, xz: Array, step: int, places: Array) -> None:
        """Give an errand to people who have arrived, are stuck or have stayed long enough, and to their company."""
        left = np.hypot(*(self.goals - xz).T)
        stays = self._until >= 0
        arrived = ~stays & (left < ARRIVED_M)
        stuck = ~stays & ((step - self._best[:, 1]) * STEP_S > self._traits[:, 5])
        left[self._stays[:, 2] < 0] = np.inf
        for m in np.flatnonzero(arrived & np.isinf(left)).tolist():
            # they have backed out, and go on to where they wanted
            path, self._best[m] = self._free.path(xz[m], self._errands[m].path[-1]), (0.0, step)
            self._set_path(m, self._way(m, path, places) if len(path) > 1 else self._errands[m].path)
            arrived[m] = stuck[m] = False
        for m in np.flatnonzero((arrived | stuck & (left < CLOSE_M)) & (self._counts > 1)).tolist():
            errand = self._errands[m]
            if errand.station is not None:
                arrived[m] &= left[m] < SEAT_M and self._body[m, 2] < SLOW_MPS
                if not arrived[m]:
                    continue
                here = np.append(xz[m], self._body[m, 0])
                self._busy[m] = errand.station, errand.station.motion(here, errand.seconds)
            if errand.seconds > 0:
                if not arrived[m]:
                    self._set_path(m, np.array([xz[m], xz[m]], np.float64))
                self._until[m] = step + (np.inf if errand.station is not None else errand.seconds / STEP_S)
                self._stays[m] = (*errand.look, 2.0) if errand.look is not None else (0.0, 0.0, 1.0)
                self._stays[m, 2] = SEATED if errand.station is not None else self._stays[m, 2]
                self.new_events.append((m, "activity", errand.activity, errand.place))
                arrived[m] = stuck[m] = False
        if self._version > 1:
            self._make_room(xz, np.flatnonzero(stuck & ~arrived & (left >= CLOSE_M)), step)
        done = stays & (self._until <= step)
        self._until[done], self._stays[done, 2] = -1.0, 0.0
        chooses = arrived | stuck | done | (self._counts < 2)
        chooses |= (self._company >= 0) & np.isin(self._company, self._company[chooses])
        stuck |= (self._version > 3) & (self._company >= 0) & np.isin(self._company, self._company[stuck])
        for m in np.flatnonzero(chooses).tolist():
            self._taken.pop((id(self), m), None)
            if self._company[m] not in (-1, m):
                goal = np.asarray(self.goals[self._company[m]], np.float64)
                errands = [self._guides[m](xz[m], goal, self._taken_from(m))]
            else:
                compares = stuck[m] and self._errands[m].seconds == 0
                errands = self._errands_from(m, xz[m], STUCK_PATHS if compares else 1)
            errands = [errand for errand in errands if len(errand.path) > 1]
            if errands:
                # people who are stuck turn to where the others are not
                others = np.delete(xz, m, axis=0)
                chosen = max(errands, key=lambda e: _room_on(e.path, others)) if len(errands) > 1 else errands[0]
                self._errands[m] = chosen
                self._set_path(
                    m, self._way(m, chosen.path, places, stuck=stuck.item(m)) if self._version > 3 else chosen.path
                )
                if chosen.station is not None:
                    self._taken[id(self), m] = chosen.station
                if chosen.refused[0]:
                    self.new_events.append((m, "refused", *chosen.refused))
                x, z = chosen.path[-1].tolist()
                self.new_events.append((m, "walks_to", chosen.place, f"({x:.2f}, {z:.2f})"))
            elif self._counts[m] < 2:
                # a path of two equal points: people without any goal stand where they are
                self._set_path(m, np.array([xz[m], xz[m]], np.float64))
            self._best[m] = 0.0, step

    def _make_room(self, xz: Array, stuck: NDArray[np.intp], step: int) -> None:
        """End the stay of all people who have stopped on the path of people who are ``stuck``."""
        standing = np.flatnonzero((self._until > step) & np.isfinite(self._until))
        for m in stuck.tolist() if len(standing) else ():
            near = np.hypot(*(xz[standing, None] - self._ahead(m, WAY_M)).transpose(2, 0, 1)).min(1) < PASSING_M
            self._until[standing[near]] = step

    def _ahead(self, m: int, length_m: float) -> Array:
        """Return places [N, 2] on the path of a person, up to ``length_m`` ahead of them."""
        count, ahead = self._counts[m], self._along[m] + np.arange(0.0, length_m, PASSING_M / 4)
        return np.stack([np.interp(ahead, self._lengths[m, :count], self._paths[m, :count, k]) for k in range(2)], 1)

    def _way(self, m: int, path: NDArray[np.float64], places: Array, *, stuck: bool = False) -> NDArray[np.float64]:
        """Return a path [K, 2] to the end of a given one that goes around people who stay somewhere, by `VERSION` 4.

        If the person is ``stuck``, it goes around everybody near in ``places`` [N, 2]. Where that is not possible, it leads to
        the nearest place away from all of them and from their paths: the person backs out.
        """
        people, grid, self._stays[m, 2] = len(self._counts), FloorRoutes.of(self._free), 0.0
        here = stuck & (np.hypot(*(places - places[m]).T) < FAR_M)
        # of their own group only those who go first, and only for who cannot follow them
        others = (self._company < 0) | (self._company != self._company[m]) | stuck & (np.arange(people) < m)
        here[:people] = (here[:people] | (self._until >= 0)) & others
        here[m] = False
        if not here.any() or distance_to_path(places[here], path).min() > PASSING_M:
            return path
        # by version 8, who is beside the first of their group before a passage does not squeeze past, but lets them go
        own = (self._company == self._company[m]) & (self._company >= 0) & (self._version > (8 if self._forces else 7))
        for around in AROUND_M[: 1 if here[:people][own].any() else 2]:
            found = grid.flood(places[m], np.insert(places[here], 2, around, axis=1), goal=path[-1]).path_to(path[-1])
            if found is not None:
                return found
        ways = {j: self._ahead(j, FAR_M) for j in np.flatnonzero(here[:people] & (self._until < 0)).tolist()}
        # not through the passage that the first of the group wants
        discs = (np.insert(way, 2, WAY_ROOM_M, axis=1) for j, way in ways.items() if own[j])
        # 5.0: distance along the floor up to which people back out [m]
        reached = grid.flood(
            places[m],
            np.concatenate([np.insert(places[here], 2, AROUND_M[-1], axis=1), *discs]),
            farthest_m=5.0 * stuck,
        )
        fits = np.isfinite(reached.distance)
        gaps = np.hypot(
            *(grid.centres[fits][:, None] - np.concatenate([places[here], *ways.values()])).transpose(2, 0, 1)
        )
        away = gaps > np.where(np.arange(gaps.shape[1]) < here.sum(), LEAVES_M, OFF_M)
        for count in (gaps.shape[1], here.sum()) if stuck else ():
            fits[np.isfinite(reached.distance)] = away[:, :count].all(-1)
            found = reached.path_to_nearest(fits)
            if found is not None:
                self._stays[m, 2] = -1.0
                return found
        return path

    def _errands_from(self, m: int, xz: Array, most: int) -> list[Errand]:
        """Return up to ``most`` errands of a person to goals that they have not reached already."""
        errands: list[Errand] = []
        for _ in range(ATTEMPTS):
            errand = self._guides[m](np.asarray(xz, np.float64), None, self._taken_from(m))
            if len(errand.path) > 1 and (errand.seconds > 0 or np.hypot(*(errand.path[-1] - xz)) >= ARRIVED_M):
                errands.append(errand)
            if len(errands) == most:
                break
        return errands

    def _taken_from(self, m: int) -> list[Array]:
        """Return places [2 or 3] where others sit or stay, or go to do so; those of seats from all crowds of the world."""
        return [place.taken for who, place in self._taken.items() if who != (id(self), m)] + [
            errand.path[-1] for j, errand in enumerate(self._errands) if errand.seconds > 0 and j != m
        ]

    def _set_path(self, m: int, path: NDArray[np.float64]) -> None:
        """Give a person a path [K, 2] to walk from its beginning."""
        if len(path) > self._paths.shape[1]:
            more = 2 * len(path) - self._paths.shape[1]
            self._paths = np.pad(self._paths, ((0, 0), (0, more), (0, 0)))
            self._lengths = np.pad(self._lengths, ((0, 0), (0, more)))
        count = len(path)
        self._paths[m, :count], self._counts[m] = path, count
        self._lengths[m, :count] = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        self._along[m] = self._claims[m, 0] = 0.0
