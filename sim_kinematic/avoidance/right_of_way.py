"""Who gives way to whom, and where to: agents that are in each other's way agree on it.

Everybody says by which way it is going. Whoever goes first asks those who stand on the next metres of its way, and, once it
has been held up, those too who are going somewhere themselves, to step aside: to the nearest place off its way. Who is asked
goes before all whom the asker goes before, so a row of people in a corridor backs out together (priority inheritance:
Okumura et al., 2022, PIBT). Where there is no such place the roles are exchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.avoidance.routes import FloorRoutes, distance_to_way, first_of_way
from sim_kinematic.avoidance.yielding import NO_WAY, Body, discs_of

APART_M = (0.8, 1.1, 1.3)
"""Who has stepped aside is this far from the other's way: two people, a person and a robot, two robots;"""
CLOSE = 0.8
"""this share of it will do."""
BESIDE_M = 0.65, 0.9
"""On the way of a person or a robot are those whose discs (`giving_way.discs_of`) have their middle this near to it."""
STANDS_IDLE_M, STANDS_GOING_M = 2.5, 1.6
"""So far ahead one asks who has nothing to do, and who is going somewhere."""
KEEPS_OFF_M = 5.0
"""So much of the other's way is kept free;"""
RETURN_M = 1.5
"""one goes on when one's own next metres do not lead onto it."""
HELD_UP_STEPS = 10
"""Who has not got on for so long asks others too who are going somewhere."""
GIVES_UP_STEPS = 45
"""Who does not get on so long while stepping aside does not go on with it."""
GOT_ON_M, GOT_ON_RAD = 0.15, 0.6
LASTS_STEPS = 150
"""Nobody stands aside for longer, whatever happens."""
ROOM_M = (0.3, 0.5)
"""Distance to the nearest obstacle where a person or a robot steps aside."""
LEAST_M, FAR_M = 0.3, 10.0
"""One steps so far aside at least, and at most."""
REACHED_M = (0.02, 0.2)
"""A person and a robot are at a point of a way when they are this near."""


class Walker(Body, Protocol):
    """Somebody who moves on the floor."""

    number: int
    way: NDArray[np.floating]
    """Floor points [N, 2] by which it is going somewhere, its own place first; empty: it is not."""
    yields: bool
    """Whether it can step aside now."""
    aside: NDArray[np.float64] | None
    """The points [N, 2] by which it is to step aside, none left: it is to stand there; None: nobody has asked."""

    hindered_by: frozenset[int]
    """Whom it would have touched in its last step, had it not stopped."""


@dataclass
class _Asked:
    """Somebody who steps aside."""

    by: int
    """For whom; itself where all others step aside for it."""
    route: NDArray[np.float64]
    """Points [N, 2] that are still to go."""
    steps: int = 0


class RightOfWay:
    """Says to everybody in each step whether, and by what way, to step aside."""

    def __init__(self, free: FreeSpace, walkers: Sequence[Walker]) -> None:
        self._free, self._routes = free, FloorRoutes.of(free)
        self._walkers = {walker.number: walker for walker in walkers}
        self._asked: dict[int, _Asked] = {}
        self._stood = dict.fromkeys(self._walkers, 0)
        self._place = {number: _place(walker) for number, walker in self._walkers.items()}

    def update(self, carrying: Sequence[int] = ()) -> None:
        """Set everybody's ``aside``; ``carrying`` are the numbers of those who hold something."""
        for number, walker in self._walkers.items():
            place, was = _place(walker), self._place[number]
            if np.hypot(*(place - was)[:2]) > GOT_ON_M or abs(wrap_angle(place[2] - was[2])) > GOT_ON_RAD:
                self._stood[number], self._place[number] = 0, place
            wants = len(self.way(walker)) or walker.hindered_by
            self._stood[number] = self._stood[number] + 1 if wants else 0
            if number in self._asked:
                self._walked(walker, self._asked[number])
        for number in [n for n, asked in self._asked.items() if self._is_over(self._walkers[n], asked)]:
            del self._asked[number]
        first: list[Walker] = []
        waiting = sorted(self._walkers.values(), key=lambda walker: self._rank(walker, carrying))
        while waiting:
            me = waiting.pop(0)
            first.append(me)
            blockers = [other for other in waiting if self._blocks(other, me)]
            asked = [other for other in blockers if self._ask(other, me, first)]
            waiting = asked + [other for other in waiting if other not in asked]
        for number, walker in self._walkers.items():
            walker.aside = self._asked[number].route if number in self._asked else None

    # --- who -----------------------------------------------------------------------------------------------------------
    def _rank(self, walker: Walker, carrying: Sequence[int]) -> tuple[float, ...]:
        """Who is busy goes before who is not, people before robots, who carries something before who does not, then who has the
        shorter way; who steps aside for somebody, right behind that one."""
        chain: list[int] = [walker.number]
        while chain[-1] in self._asked and self._asked[chain[-1]].by not in chain:
            chain.append(self._asked[chain[-1]].by)
        head = self._walkers[chain[-1]]
        promoted = head.number in self._asked and self._asked[head.number].by == head.number
        idle = not len(self.way(head)) and not head.hindered_by
        length = float(np.hypot(*np.diff(head.way, axis=0).T).sum())
        before = not promoted, idle, head.is_robot, head.number not in carrying, length, head.number
        return (*before, *([1] * (len(chain) - 1)))

    def way(self, walker: Walker) -> NDArray[np.floating]:
        """By which way somebody is going now, [N, 2]."""
        if walker.number in self._asked:
            route = self._asked[walker.number].route
            return np.vstack([walker.xz[None], route]) if len(route) else NO_WAY
        return walker.way

    def _blocks(self, other: Walker, me: Walker) -> bool:
        """Whether somebody should step aside for me."""
        way = self.way(me)
        if not other.yields:
            return False
        if other.number in me.hindered_by and self._stood[me.number] >= HELD_UP_STEPS:
            return True
        if not len(way):
            return False
        goes = len(self.way(other)) > 0
        if goes and self._stood[me.number] < HELD_UP_STEPS:
            return False
        ahead = first_of_way(way, STANDS_GOING_M if goes else STANDS_IDLE_M)
        body = discs_of(other)[:, :2]
        nearest = distance_to_way(body, _without_start(ahead))
        gaps = np.hypot(*(body - me.xz).T)
        return bool(np.any((nearest < BESIDE_M[me.is_robot]) & (nearest < gaps)))

    def _ask(self, other: Walker, me: Walker, first: Sequence[Walker]) -> bool:
        """Ask somebody to step aside for me; whether it does."""
        way = self.way(me)
        before = self._asked.get(other.number)
        if before is not None and len(before.route) and self._stood[other.number] < 3 * HELD_UP_STEPS:
            end = before.route[-1]
            if float(distance_to_way(end, first_of_way(way, KEEPS_OFF_M))) >= CLOSE * _apart(me, other):
                return True
        elif before is not None and len(before.route) and self._exchange(other, me, before.route, first):
            return False
        route = self._retreat(other, [(me, way)], first)
        if route is not None:
            self._asked[other.number] = _Asked(me.number, route)
            return True
        leaves = self._retreat(other, [(me, way)], [walker for walker in first if walker is not me])
        if leaves is not None:
            self._exchange(other, me, leaves, first)
        return False

    def _exchange(self, other: Walker, me: Walker, leaves: NDArray, first: Sequence[Walker]) -> bool:
        """I step aside for somebody who cannot get out of my way before; whether I can."""
        if me.number in self._asked or not me.yields:
            return False
        way = np.vstack([other.xz[None], leaves])
        back = self._retreat(me, [(other, way)], [walker for walker in first if walker is not me])
        if back is None:
            return False
        self._asked[other.number] = _Asked(other.number, leaves)
        self._asked[me.number] = _Asked(other.number, back)
        return True

    # --- how long ------------------------------------------------------------------------------------------------------
    def _walked(self, walker: Walker, asked: _Asked) -> None:
        """Points that were reached are passed."""
        asked.steps += 1
        while len(asked.route) and np.hypot(*(asked.route[0] - walker.xz)) <= REACHED_M[walker.is_robot]:
            asked.route = asked.route[1:]

    def _is_over(self, walker: Walker, asked: _Asked) -> bool:
        if asked.steps > LASTS_STEPS or not walker.yields:
            return True
        if len(asked.route) and self._stood[walker.number] > GIVES_UP_STEPS:
            return True
        if asked.by == walker.number:
            return not len(asked.route)
        other = self._walkers[asked.by]
        way = first_of_way(self.way(other), KEEPS_OFF_M)
        if not len(way):
            return walker.number not in other.hindered_by and (len(walker.way) > 0 or not len(asked.route))
        mine = walker.xz[None]
        if len(walker.way):
            mine = first_of_way(self._free.path(walker.xz, walker.way[-1], max_snap_m=1.0), RETURN_M)
            mine = np.vstack([walker.xz[None], _dots(mine)])
        return float(distance_to_way(mine, way).min()) >= CLOSE * _apart(walker, other)

    # --- where to ------------------------------------------------------------------------------------------------------
    def _retreat(
        self, walker: Walker, ways: Sequence[tuple[Walker, NDArray]], first: Sequence[Walker]
    ) -> NDArray[np.float64] | None:
        """Points [N, 2] that lead to the nearest place off some ways, and off those of all who go first; past others who can
        step aside only where it does not go otherwise."""
        others = [other for other in self._walkers.values() if other is not walker]
        firm = [other for other in others if other in first or not other.yields]
        kept = [*ways, *((other, self.way(other)) for other in first if other is not walker)]
        for share, around in ((1.0, others), (CLOSE + 0.05, others), (CLOSE + 0.05, firm)):
            discs = [(*other.xz, 0.75 * _apart(walker, other)) for other in around]
            flood = self._routes.flood(walker.xz, np.array(discs).reshape(-1, 3))
            fits = (
                (flood.distance >= LEAST_M) & (flood.distance <= FAR_M) & (self._routes.room >= ROOM_M[walker.is_robot])
            )
            cells = self._routes.centres[fits]
            good = np.ones(len(cells), np.bool_)
            for other in around:
                good &= np.hypot(*(cells - other.xz).T) >= share * _apart(walker, other)
            for other, way in kept:
                if len(way):
                    good[good] = distance_to_way(cells[good], first_of_way(way, KEEPS_OFF_M)) >= share * _apart(
                        walker, other
                    )
            fits[fits] = good
            way = flood.nearest(fits)
            if way is not None:
                return way[1:]
        return None


def _place(walker: Walker) -> NDArray[np.float64]:
    return np.append(walker.xz, walker.heading)


def _apart(a: Walker, b: Walker) -> float:
    return APART_M[a.is_robot + b.is_robot]


def _without_start(way: NDArray) -> NDArray[np.float64]:
    """A way but for its first 0.3 m: who stands beside me is not on it."""
    start = first_of_way(way, 0.3)
    return np.vstack([start[-1:], way[len(start) - 1 :]]) if len(way) > 1 else way


def _dots(way: NDArray) -> NDArray[np.float64]:
    """Points on a way, at most 0.2 m apart."""
    legs = [np.linspace(a, b, 2 + int(np.hypot(*(b - a)) / 0.2)) for a, b in pairwise(way)]
    return np.concatenate(legs) if legs else way
