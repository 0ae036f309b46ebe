"""Stand-offs: two agents that stay close together although neither makes progress."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.yielding import Body


class TaskProgress(NamedTuple):
    """Facts about an agent's task that show whether it makes progress."""

    busy: bool
    """True if the agent has something to do."""
    leg: Hashable
    """Identifier of the current activity; another value means another path."""
    way: Callable[[], Callable[[], float]]
    """Function that notes where the agent is and goes now, and returns a function that computes the length of the path
    between the two [m], which is infinite if it has none."""
    completed: int
    """Number of tasks that the agent has completed."""
    obeys: bool = True
    """True if the agent can be sent elsewhere because it is not driven from outside."""


@dataclass
class Encounter:
    """Two agents near each other."""

    steps: int = 0
    """Number of steps for which neither agent has made progress while they were near each other."""
    rounds: int = 0
    """Number of times that one of them was sent away since the last progress."""
    waited: bool = False
    """True if one of the two has waited for the other, which is driven from outside."""
    completed: tuple[int, ...] = ()
    # progress of both agents when it was last judged
    errands: tuple[TaskProgress | None, ...] = (None, None)
    legs: dict[int, tuple[Hashable, Callable[[], float]]] = field(default_factory=dict)
    """Activity of each agent, and its remaining distance when the activity began or the agents met
    (`TaskProgress.way`)."""


class StandOffs:
    """Counters, for every pair of agents, of the steps for which neither has made progress."""

    def __init__(self, walkers: Sequence[Body], numbers: Sequence[int], errand: Callable[[int], TaskProgress]) -> None:
        self._walkers = dict(zip(numbers, walkers, strict=True))
        self._encounters = {pair: Encounter() for pair in combinations(numbers, 2)}
        self.errand = errand

    def of(self, a: int, b: int) -> Encounter:
        """Return the encounter of two agents."""
        return self._encounters[min(a, b), max(a, b)]

    def update(self, held_off: Callable[[int, int], bool], *, near: bool = True) -> list[tuple[int, int]]:
        """Count one step, and return the pairs of agents that have to be separated.

        These are agents without progress for a long time, of which at least one has something to do.

        ``held_off`` returns whether an agent is blocked by another agent that is driven from outside. ``near`` is False if
        all agents are known to be apart.
        """
        stuck = []
        for pair, encounter in self._encounters.items():
            if not near or math.dist(*[self._walkers[number].xz.tolist() for number in pair]) > AVOIDANCE.stand_off_m:
                encounter.steps, encounter.waited = 0, False
                encounter.legs.clear()
                continue
            encounter.steps += 1
            a, b = errands = self.errand(pair[0]), self.errand(pair[1])
            # by identity: in nearly all steps both are at the same, and their lengths to go are looked at now and then
            same = a is encounter.errands[0] and b is encounter.errands[1] and len(encounter.legs) > 0
            if not (same and encounter.steps % AVOIDANCE.looks_steps) and self._gets_on(encounter, errands):
                encounter.steps, encounter.rounds = 0, 0
                continue
            driven = [] if a.obeys and b.obeys else [n for n, e in zip(pair, errands, strict=True) if not e.obeys]
            long = encounter.steps > AVOIDANCE.stand_off_steps[len(driven) > 0]
            # nobody can tell who is driven from outside to give way, so the other one must not wait as long
            long |= len(driven) > 0 and any(held_off(sum(pair) - number, number) for number in driven)
            # two that have nothing to do may stand beside each other for ever
            if long and (a.busy or b.busy):
                stuck.append(pair)
        return stuck

    def _gets_on(self, encounter: Encounter, errands: tuple[TaskProgress, TaskProgress]) -> bool:
        """Return whether one of the two agents has completed something, or got nearer to its goal by ``gets_on_m``."""
        completed = errands[0].completed, errands[1].completed
        gets_on = completed != encounter.completed and len(encounter.completed) > 0
        encounter.completed, encounter.errands = completed, errands
        for number, errand in enumerate(errands):
            known = encounter.legs.get(number)
            if known is None or known[0] != errand.leg:
                encounter.legs[number] = errand.leg, errand.way()
            # the length of a path takes a search, which is too slow for every step
            elif encounter.steps % AVOIDANCE.looks_steps == 0 and math.isfinite(before := known[1]()):
                gets_on |= before - errand.way()() > AVOIDANCE.gets_on_m
        # the distance to go is measured anew from here, or one good step would count again and again
        if gets_on:
            encounter.legs.clear()
        return gets_on
