"""Right of way: agents that block each other agree on which of them steps aside, and where to.

Every agent announces its path. In order of rank, each agent asks others that stand on the next metres of its path to
step aside to the nearest place off it; once it has been held up, it also asks agents that move to goals of their own.
An agent that was asked inherits the rank of the asker, so a row of people in a corridor backs out together (priority
inheritance: Okumura et al., 2022, PIBT). Where there is no such place, the roles are exchanged.

Where two agents stay near each other and neither makes progress (`sim_kinematic.avoidance.stand_offs`), one of them is
sent to a refuge, off the whole remaining path of the other, until the other has got past. The next time, the other
agent is sent. An agent that is held up by a person driven from outside goes to a refuge until there is a path around
them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.kernels.entries import Entries
from h3data.scene import FreeSpace
from sim_kinematic.avoidance.routes import FloorRoutes, distance_of_paths, distance_to_path, first_of_path, is_ahead
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.stand_offs import StandOffs, TaskProgress
from sim_kinematic.avoidance.yielding import NO_PATH, Body, discs_of

_CALL = Entries()
MARK = np.dtype(
    [(name, "f8") for name in ("x", "z", "heading", "beside", "extent")]
    + [(name, "i8") for name in ("stalled", "still")]
)
"""Type of an agent's progress: place [m] and heading [rad] where it last got on, distance from its path within which it is
blocked and extent of its footprint [m], and steps without progress: while it has a path, and at all."""
_COUNTS = (
    AVOIDANCE.progress_m,
    AVOIDANCE.progress_rad,
    AVOIDANCE.held_up_steps,
    AVOIDANCE.stand_off_m,
    AVOIDANCE.asks_moving_m,
    AVOIDANCE.asks_idle_m,
)
"""Constants of `count_step`."""


class Walker(Body, Protocol):
    """An agent that moves on the floor."""

    number: int
    yields: bool
    """True if the agent can step aside now."""
    aside: NDArray[np.float64] | None
    """Remaining floor points [N, 2] [m] of the path aside; empty if the agent has arrived there, None if no agent has
    asked it to step aside."""

    @property
    def path(self) -> NDArray[np.floating]:
        """Floor points [N, 2] [m] of the agent's path, its own position first; empty if it has none."""
        ...

    @property
    def path_start(self) -> NDArray[np.floating] | None:
        """First point of the agent's path [2], cheap to compute; None if it has no path."""
        ...

    turned_away: bool
    """True if an agent driven from outside blocks the path, so that the walker has to choose a new action and a new
    place to stand."""
    hindered_by: frozenset[int]
    """Agents with which the agent would have collided in its last step if it had not stopped."""


@dataclass
class _Request:
    """A request to step aside."""

    by: int
    """Agent that asked, or the asked agent itself if all others step aside for it."""
    route: NDArray[np.float64]
    """Remaining points [N, 2] of the way."""
    steps: int = 0
    stays_steps: float = 0
    """Largest number of steps for which the agent stays at a refuge; 0 if the way leads to none."""
    stayed: int = 0
    """Number of steps since the agent arrived."""
    chose_at: tuple[float, float, float] | None = None
    """Place ``(x, z, heading)`` of the other agent, which is driven from outside, when the agent last made a new
    choice."""
    seen: NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.nan))
    """Position [2] of the other agent when it was last observed."""

    def advance(self, walker: Walker) -> None:
        """Count a step, and remove the points of the route that the agent has reached."""
        self.steps += 1
        reached = AVOIDANCE.reached_m[walker.is_robot]
        while len(self.route) and np.hypot(*(self.route[0] - walker.xz)) <= reached:
            self.route = self.route[1:]


class RightOfWay:
    """Rules by which agents step aside for each other, and the paths that they take."""

    def __init__(
        self,
        free: FreeSpace,
        walkers: Sequence[Walker],
        errand: Callable[[int], TaskProgress] | None = None,
        *,
        asks: bool = True,
    ) -> None:
        """Create the rules for a group of agents, none of which block each other yet.

        ``errand`` returns the progress of an agent's task, by which stand-offs are detected and ended. If ``asks`` is
        False, agents step aside only in stand-offs.
        """
        self._free, self._routes = free, FloorRoutes.of(free)
        self._walkers = {walker.number: walker for walker in walkers}
        self._asks = asks
        numbers = [walker.number for walker in walkers]
        self._stand_offs = None if errand is None else StandOffs(walkers, numbers, errand)
        self._requests: dict[int, _Request] = {}
        self._marks = np.zeros(len(walkers), MARK)
        """Progress of each agent, `MARK` [A]."""
        for row, walker in zip(self._marks, walkers, strict=True):
            (row["x"], row["z"]), row["heading"] = walker.xz, walker.heading
            row["beside"] = AVOIDANCE.beside_m[walker.is_robot] + _size_beyond_default(walker)
            row["extent"] = walker.footprint.extent_m
        self._row = {number: row for row, number in enumerate(numbers)}
        """Row of each agent in ``_marks``, by number."""

    def walk_on(self, free: FreeSpace) -> None:
        """Use another floor from now on, because a door or a drawer has moved."""
        self._free, self._routes = free, FloorRoutes.of(free)

    def update(self, agents: NDArray[Any], carrying: Sequence[int] = ()) -> None:
        """Set ``aside`` of every agent.

        Args:
            agents: present state of the agents, `AGENT` [A], in the order of the walkers.
            carrying: numbers of the agents that hold something.
        """
        if self._requests:
            agents = agents.copy()
            for number, request in self._requests.items():
                row, start = agents[self._row[number]], (math.nan, math.nan)
                row["start_x"], row["start_z"] = (row["x"], row["z"]) if len(request.route) else start
        may_block, near = _CALL(count_step, agents, self._marks, _COUNTS)
        for number, request in self._requests.items():
            request.advance(self._walkers[number])
        for number in [n for n, request in self._requests.items() if self._is_over(self._walkers[n], request)]:
            request, may_block = self._requests.pop(number), True
            if request.chose_at is not None and self._stand_offs is not None:
                self._stand_offs.of(number, request.by).steps = 0  # time to get past
        if self._stand_offs is not None:
            for pair in self._stand_offs.update(self._is_held_off, near=near):
                self._part(self._stand_offs, pair, carrying)
        # the usual case ends here: ranks and paths cost far more than the distances that rule them out
        if not self._requests and not (self._asks and may_block):
            for walker in self._walkers.values():
                walker.aside = None
            return
        first: list[Walker] = []
        waiting = self._ranked(carrying) if self._asks else []
        while waiting:
            me = waiting.pop(0)
            first.append(me)
            blockers = [other for other in waiting if self._blocks(other, me)]
            asked = [other for other in blockers if self._ask(other, me, first)]
            # who was asked asks next, with the rank of the asker, so that a whole row backs out in one step
            waiting = asked + [other for other in waiting if other not in asked]
        for number, walker in self._walkers.items():
            walker.aside = self._requests[number].route if number in self._requests else None

    def _stalled(self, number: int) -> int:
        """Return the number of steps for which an agent with a path has made no progress."""
        return self._marks["stalled"].item(self._row[number])

    def _still(self, number: int) -> int:
        """Return the number of steps for which an agent has made no progress, with a path or without."""
        return self._marks["still"].item(self._row[number])

    def _place(self, number: int) -> tuple[float, float, float]:
        """Return the place and heading ``(x, z, heading)`` where an agent last got on."""
        mark = self._marks[self._row[number]]
        return float(mark["x"]), float(mark["z"]), float(mark["heading"])

    # --- rank ----------------------------------------------------------------------------------------------------------
    def _ranked(self, carrying: Sequence[int]) -> list[Walker]:
        """Return the agents in the order of their priority.

        Busy agents come before idle ones, people before robots, agents that carry something before others, then shorter
        paths before longer ones. An agent that steps aside comes right after the one that asked for it.
        """
        chains = {number: self._chain(number) for number in self._walkers}
        alike: dict[int, tuple[bool, ...]] = {}
        for head in {chain[-1] for chain in chains.values()}:
            walker, request = self._walkers[head], self._requests.get(head)
            # whoever was let out (`_exchange`) goes before everybody, or the two would exchange roles again in the
            # next step
            promoted = request is not None and request.by == head
            idle = self._start(walker) is None and not walker.hindered_by
            alike[head] = not promoted, idle, walker.is_robot, head not in carrying

        def key(walker: Walker) -> tuple[float, ...]:
            *asked, head = chains[walker.number]
            length = 0.0
            if list(alike.values()).count(alike[head]) > 1:  # paths cost more than all the rest
                length = float(np.hypot(*np.diff(self._walkers[head].path, axis=0).T).sum())
            # tuples that begin alike sort by length: who was asked comes right after who asked
            return (*alike[head], length, head, *([1] * len(asked)))

        return sorted(self._walkers.values(), key=key)

    def _chain(self, number: int) -> list[int]:
        """Return an agent, the one that asked it to step aside, the one that asked that one, and so on."""
        chain = [number]
        # requests may form a circle, so each agent counts once
        while chain[-1] in self._requests and self._requests[chain[-1]].by not in chain:
            chain.append(self._requests[chain[-1]].by)
        return chain

    def path(self, walker: Walker) -> NDArray[np.floating]:
        """Return the path that an agent follows now, [N, 2] [m]: its path aside if it has one, else its own."""
        if walker.number in self._requests:
            route = self._requests[walker.number].route
            return np.vstack([walker.xz[None], route]) if len(route) else NO_PATH
        return walker.path

    def _start(self, walker: Walker) -> list[float] | None:
        """Return the first point (x, z) of `path`; None: it is empty."""
        if walker.number in self._requests:
            return walker.xz.tolist() if len(self._requests[walker.number].route) else None
        start = walker.path_start
        return None if start is None else start.tolist()

    def _blocks(self, other: Walker, me: Walker) -> bool:
        """Return whether an agent should step aside for me."""
        start, moves = self._start(me), self._start(other) is not None
        held_up = self._stalled(me.number) >= AVOIDANCE.held_up_steps
        if other.yields and held_up and other.number in me.hindered_by:
            return True
        # nothing is near an empty path; with the kernel's own conditions first, which rule out most
        if start is None or not other.yields or (moves and not held_up):
            return False
        beside = float(self._marks["beside"][self._row[me.number]])
        extent = float(self._marks["extent"][self._row[other.number]])
        if not is_close(*start, *other.xz.tolist(), moves, True, held_up, beside, extent, *_COUNTS[-2:]):
            return False
        ahead_m = AVOIDANCE.asks_moving_m if len(self.path(other)) else AVOIDANCE.asks_idle_m
        # an agent that is nearer to me than to the path ahead of me is behind or beside me, and clear as I go on
        path = np.ascontiguousarray(self.path(me), np.float64)
        return is_ahead(discs_of(other), path, AVOIDANCE.skips_m, ahead_m, beside, *me.xz.tolist())

    def _ask(self, other: Walker, me: Walker, first: Sequence[Walker]) -> bool:
        """Ask an agent to step aside for me; return whether it does."""
        path = self.path(me)
        before, mine = self._requests.get(other.number), self._requests.get(me.number)
        if mine is not None and mine.stays_steps and mine.by == other.number:
            return False  # I am to get out of its way
        # it is on its way to a refuge: another request would send it back and forth between two places
        if before is not None and before.stays_steps:
            return True
        if before is not None and len(before.route) and self._stalled(other.number) < 3 * AVOIDANCE.held_up_steps:
            # its place is kept while that clears my path: the best place is another one in each step, and it
            # would waver
            end = before.route[-1]
            kept = first_of_path(path, AVOIDANCE.keeps_free_m)
            if float(distance_to_path(end, kept)) >= AVOIDANCE.aside_share * aside_distance_m(me, other):
                return True
        elif before is not None and len(before.route) and self._exchange(other, me, before.route, first):
            return False
        route = self._retreat(other, [(me, path)], first)
        if route is not None:
            self._requests[other.number] = _Request(me.number, route)
            return True
        # with no place off my path it can only come out past me, so look for one as if I were not there
        leaves = self._retreat(other, [(me, path)], [walker for walker in first if walker is not me])
        if leaves is not None:
            self._exchange(other, me, leaves, first)
        return False

    def _exchange(self, other: Walker, me: Walker, leaves: NDArray, first: Sequence[Walker]) -> bool:
        """Make me step aside for an agent that cannot clear my path otherwise; return whether I can."""
        if me.number in self._requests or not me.yields:
            return False
        path = np.vstack([other.xz[None], leaves])
        back = self._retreat(me, [(other, path)], [walker for walker in first if walker is not me])
        if back is None:
            return False
        self._requests[other.number] = _Request(other.number, leaves)
        self._requests[me.number] = _Request(other.number, back)
        # both have new goals: the one that was held up would otherwise give up before it has made a step
        self._marks["stalled"][[self._row[me.number], self._row[other.number]]] = 0
        return True

    # --- stand-offs ----------------------------------------------------------------------------------------------------
    def _part(self, stand_offs: StandOffs, pair: tuple[int, int], carrying: Sequence[int]) -> None:
        """Send one of two agents to a refuge: the idle one, one that holds nothing, a robot; the next time the other."""
        if any(self._goes_to_refuge(number, sum(pair) - number) for number in pair):
            return
        encounter, errands = stand_offs.of(*pair), {number: stand_offs.errand(number) for number in pair}
        order = sorted(pair, key=lambda n: (errands[n].busy, n in carrying, not self._walkers[n].is_robot, n))
        # in turns: to send the same one away again would end as it did before
        for number in order[:: -1 if encounter.rounds % 2 else 1]:
            me, other = self._walkers[number], self._walkers[sum(pair) - number]
            if not me.yields or not errands[number].obeys:
                continue
            driven = not errands[other.number].obeys
            waits = driven and not encounter.waited and math.dist(me.xz, other.xz) >= aside_distance_m(me, other)
            route = np.zeros((0, 2)) if waits else self._refuge(me, other)
            if route is None:
                continue
            lets_out = self._requests.get(other.number)
            if lets_out is not None and lets_out.by != number:
                del self._requests[other.number]
            stays = AVOIDANCE.waits_steps if waits else math.inf if driven else AVOIDANCE.refuge_steps
            me.turned_away, where = driven, self._place(other.number) if driven else None
            seen = other.xz.copy()
            self._requests[number] = _Request(other.number, route, stays_steps=stays, chose_at=where, seen=seen)
            self._marks["stalled"][[self._row[n] for n in pair]] = encounter.steps = 0
            encounter.rounds, encounter.waited = encounter.rounds + 1, driven
            return

    def _goes_to_refuge(self, number: int, other: int) -> bool:
        """Return whether an agent is on its way to a refuge, which is still far from the other."""
        request = self._requests.get(number)
        if request is None or not request.stays_steps or not len(request.route):
            return False
        return math.dist(request.route[-1], self._walkers[other].xz) > AVOIDANCE.stand_off_m

    def _is_held_off(self, number: int, other: int) -> bool:
        """Return whether another agent, which is driven from outside, holds an agent up that has not left its path yet."""
        request = self._requests.get(number)
        if request is not None and request.stays_steps:
            return False
        if self._stalled(number) > AVOIDANCE.held_off_steps:
            return True
        still, me = self._still(other) - AVOIDANCE.held_up_steps, self._walkers[number]
        looks = still > 0 and still % AVOIDANCE.looks_steps == 0 and me.yields and len(me.path) > 0
        return looks and not self._gets_around(me, self._walkers[other], AVOIDANCE.passing_m[-1])

    def _refuge(self, me: Walker, other: Walker) -> NDArray[np.float64] | None:
        """Return points [N, 2] that lead to the nearest place far from the other agent's path.

        If there is no such place, they lead to the one that is farthest from it.
        """
        spec = AVOIDANCE
        discs = np.array([(*other.xz, spec.squeeze_share * aside_distance_m(me, other))])
        flood = self._routes.flood(me.xz, discs)
        room = spec.room_m[me.is_robot] + _size_beyond_default(me)
        fits = np.isfinite(flood.distance) & (self._routes.room >= room)
        cells = self._routes.centres[fits]
        if not len(cells):
            return None
        apart = np.hypot(*(cells - other.xz).T)
        aside = distance_to_path(cells, other.path) >= aside_distance_m(me, other)
        # any place far away ends a stand-off better than none
        for good in (aside & (apart >= spec.refuge_m), apart >= spec.refuge_m, apart >= 0.95 * apart.max()):
            if good.any():
                fits[fits] = good
                route = flood.path_to_nearest(fits)
                return None if route is None else route[1:]
        return None

    def _leaves_refuge(self, walker: Walker, request: _Request) -> bool:
        """Return whether an agent continues from its refuge, or from the path to it."""
        other = self._walkers[request.by]
        obeys = self._stand_offs is None or self._stand_offs.errand(other.number).obeys
        if not obeys and request.steps % AVOIDANCE.looks_steps == 0:
            apart, was = math.dist(walker.xz, other.xz), math.dist(walker.xz, request.seen)
            # on the way to a refuge they first get out of each other's reach: turned around, they would meet again
            clear = apart >= (AVOIDANCE.stand_off_m if len(request.route) else aside_distance_m(walker, other))
            request.seen = other.xz.copy()
            if (
                clear
                and apart > was - AVOIDANCE.progress_m
                and self._gets_around(walker, other, AVOIDANCE.passing_m[0])
            ):
                return True
            if apart < was - AVOIDANCE.progress_m and math.isfinite(request.stays_steps):
                return True  # there is no use in waiting for somebody who comes closer
            if apart > was + AVOIDANCE.progress_m and apart >= AVOIDANCE.refuge_m:
                return True  # follow somebody who leaves
            self._go_farther(walker, other, request)
            stops = (
                self._still(other.number) > AVOIDANCE.held_up_steps and self._place(other.number) != request.chose_at
            )
            # only in the refuge: on the way there it would stop whenever somebody who follows it stops
            if stops and not len(request.route):
                walker.turned_away, request.chose_at = True, self._place(other.number)
        if len(request.route):
            return self._stalled(walker.number) > 2 * AVOIDANCE.gives_up_steps
        request.stayed += 1
        return request.stayed > request.stays_steps or (obeys and self._is_past(walker, other))

    def _go_farther(self, me: Walker, other: Walker, request: _Request) -> None:
        """Lead an agent on from a refuge near which the other, who is driven from outside, has come, if there is another."""
        apart = math.dist(request.route[-1] if len(request.route) else me.xz, other.xz)
        if math.isfinite(request.stays_steps) or apart > AVOIDANCE.stand_off_m:
            return
        route = self._refuge(me, other)
        if route is not None and len(route) and math.dist(route[-1], other.xz) > apart + AVOIDANCE.gets_on_m:
            request.route, request.stayed = route, 0

    def _gets_around(self, walker: Walker, other: Walker, gap_m: float) -> bool:
        """Return whether an agent gets to its goal around another as that one stands, or would not get there alone either."""
        if not len(walker.path):
            return False
        discs = discs_of(other) + np.array([0.0, 0.0, walker.footprint.radius_m + gap_m])
        goal = walker.path[-1]
        floods = (self._routes.flood(walker.xz, around, goal=goal) for around in (discs, discs[:0]))
        around, alone = (flood.path_to(goal) is not None for flood in floods)
        return around or not alone

    def _is_past(self, walker: Walker, other: Walker) -> bool:
        """Return whether the path of one agent leads nowhere near another, nor near the other's path."""
        if not len(walker.path):
            return False
        theirs = other.path if len(other.path) else other.xz[None]
        gap = self._gap_m(walker, AVOIDANCE.keeps_free_m, theirs, math.inf)
        return gap >= AVOIDANCE.aside_share * aside_distance_m(walker, other)

    def _gap_m(self, walker: Walker, length_m: float, theirs: NDArray, their_m: float) -> float:
        """Return the distance [m] between the beginnings of an agent's path and of another's path [N, 2], each of a length."""
        # the shortest path from here, which it will take once it is let go; its old path began elsewhere
        mine = self._free.path(walker.xz, walker.path[-1], max_snap_m=1.0) if len(walker.path) else NO_PATH
        paths = np.ascontiguousarray(mine, np.float64), length_m, np.ascontiguousarray(theirs, np.float64), their_m
        return distance_of_paths(*walker.xz.tolist(), *paths, AVOIDANCE.dots_m)

    # --- how long ------------------------------------------------------------------------------------------------------
    def _is_over(self, walker: Walker, request: _Request) -> bool:
        if not walker.yields:
            return True
        if request.stays_steps:
            return self._leaves_refuge(walker, request)
        if request.steps > AVOIDANCE.lasts_steps:
            return True
        if len(request.route) and self._stalled(walker.number) > AVOIDANCE.gives_up_steps:
            return True
        if request.by == walker.number:
            return not len(request.route)
        other = self._walkers[request.by]
        path = self.path(other)
        if not len(path):
            return walker.number not in other.hindered_by and (len(walker.path) > 0 or not len(request.route))
        gap = self._gap_m(walker, AVOIDANCE.returns_m, path, AVOIDANCE.keeps_free_m)
        return gap >= AVOIDANCE.aside_share * aside_distance_m(walker, other)

    # --- where to ------------------------------------------------------------------------------------------------------
    def _retreat(
        self, walker: Walker, paths: Sequence[tuple[Walker, NDArray]], first: Sequence[Walker]
    ) -> NDArray[np.float64] | None:
        """Return points [N, 2] that lead to the nearest place off the given paths and those of agents with a higher rank.

        The route passes agents that can step aside only if there is no other.
        """
        spec, others = AVOIDANCE, [other for other in self._walkers.values() if other is not walker]
        firm = [other for other in others if other in first or not other.yields]
        kept = [*paths, *((other, self.path(other)) for other in first if other is not walker)]
        room = spec.room_m[walker.is_robot] + _size_beyond_default(walker)
        choices = ((1.0, others), (spec.aside_share + 0.05, others), (spec.aside_share + 0.05, firm))
        # places to which it would walk towards those who come are taken only where there are no others
        for ahead, (share, around) in product((True, False), choices):
            discs = [
                (*place, spec.squeeze_share * aside_distance_m(walker, other))
                for other in around
                for place in (self._places_soon(other) if ahead and other in first else other.xz[None])
            ]
            least, farthest = spec.step_aside_m
            flood = self._routes.flood(walker.xz, np.array(discs), farthest_m=farthest)
            fits = (flood.distance >= least) & (flood.distance <= farthest) & (self._routes.room >= room)
            cells = self._routes.centres[fits]
            good = np.ones(len(cells), np.bool_)
            # distances to points first: they leave few cells for those to paths, which cost more
            for other in around:
                good &= np.hypot(*(cells - other.xz).T) >= share * aside_distance_m(walker, other)
            for other, path in kept:
                if len(path):
                    gaps = distance_to_path(cells[good], first_of_path(path, spec.keeps_free_m))
                    good[good] = gaps >= share * aside_distance_m(walker, other)
            fits[fits] = good
            route = flood.path_to_nearest(fits)
            if route is not None:
                return route[1:]
        return None

    def _places_soon(self, walker: Walker) -> NDArray[np.float64]:
        """Return where an agent is, and will be on the next metres of its path, [N, 2]."""
        path = first_of_path(self.path(walker), AVOIDANCE.asks_moving_m)
        legs = [np.linspace(a, b, 2 + int(np.hypot(*(b - a)) / AVOIDANCE.dots_m)) for a, b in pairwise(path)]
        return np.vstack([walker.xz[None], (np.concatenate(legs) if legs else path)])


def aside_distance_m(a: Body, b: Body) -> float:
    """Return the distance between an agent and another agent's path from which on it counts as aside [m]."""
    return AVOIDANCE.aside_m[a.is_robot + b.is_robot] + _size_beyond_default(a) + _size_beyond_default(b)


def _size_beyond_default(body: Body) -> float:
    """Return by how much a robot extends farther from its origin than ``quad_arm``, the reference of distances [m]."""
    return body.footprint.extent_m - AVOIDANCE.robot.extent_m if body.is_robot else 0.0


@kernel(error_model="numpy")
def is_close(x, z, other_x, other_z, moves, yields, held_up, beside, extent, moving_m, idle_m):
    """Return whether an agent could have to step aside for one whose path begins at (x, z), a cheap bound of `_blocks`."""
    # without a path (x, z) is NaN, and nothing is near it
    reach = (moving_m if moves else idle_m) + beside + extent
    return yields and (held_up or not moves) and math.hypot(other_x - x, other_z - z) <= reach


@kernel(error_model="numpy")
def count_step(agents, marks, rules):
    """Count a step of all agents, and return whether one may block another, and whether two are near each other.

    Args:
        agents: agents before the step, `AGENT` [A].
        marks: `MARK` [A], which is changed in place.
        rules: movement [m] and turn [rad] above which an agent gets on, steps after which it is held up, distance of
            stand-offs [m], and distances [m] within which agents that move, and idle ones, may be asked to step aside.
    """
    progress_m, progress_rad, held_up_steps, stand_off_m, moving_m, idle_m = rules
    for n in range(len(agents)):
        mark, agent = marks[n], agents[n]
        x, z, heading = agent["x"], agent["z"], agent["heading"]
        # measured from where it last got on, not from step to step: an agent that sways on the spot makes no progress
        gone = math.hypot(x - mark["x"], z - mark["z"])
        # as `h3data.geometry.wrap_angle`, in any bit: ten steps of a person's turn are as much as the limit
        turned = (heading - mark["heading"] + math.pi) % (2 * math.pi) - math.pi
        if gone > progress_m or abs(turned) > progress_rad:
            mark["stalled"] = mark["still"] = 0
            mark["x"], mark["z"], mark["heading"] = x, z, heading
        mark["still"] += 1
        mark["stalled"] = mark["stalled"] + 1 if not math.isnan(agent["start_x"]) or agent["hindered"] else 0
    may_block = near = False
    for me in range(len(agents)):
        mine, held_up = agents[me], marks[me]["stalled"] >= held_up_steps
        for n in range(len(agents)):
            if n == me:
                continue
            other, moves = agents[n], not math.isnan(agents[n]["start_x"])
            x, z, yields = other["x"], other["z"], other["yields"]
            near |= math.hypot(x - mine["x"], z - mine["z"]) <= stand_off_m
            may_block |= yields and held_up and mine["hindered"]
            reach = marks[me]["beside"], marks[n]["extent"]
            may_block |= is_close(
                mine["start_x"], mine["start_z"], x, z, moves, yields, held_up, *reach, moving_m, idle_m
            )
    return may_block, near
