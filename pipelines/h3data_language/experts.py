"""Experts for tasks in words, which know the errands of a task, and either share them or choose the nearest.

``language_expert`` is one plan for all agents who follow it, one or two. ``language_greedy`` decides for one agent, and
leaves to others the things that they hold or move towards. ``language_talk`` plans for one agent, and announces its
plans. With the rule ``observe=seen`` all of them search for things that they have not seen.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import msgspec
import numpy as np

from h3data.geometry import add_up
from h3data.policies import Action, RearrangeView
from h3data_language.episode import DETOUR, Errand
from h3data_language.evaluation.records import STATES, Evaluation
from h3data_language.grounding import FLOOR
from h3data_language.talk import Intent, Speaker, say
from sim_kinematic.agents.skills import INSIDE, PRIMITIVES, SEARCH, Destination
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.rearrange import errand as next_action
from sim_kinematic.policies.rearrange import persons_object
from sim_kinematic.policies.searching import Search, is_search

EXPERTS = ("language_expert", "language_greedy", "language_talk", "language_still")
HANDLING_M = 1.4
"""Distance from which a person handles a thing [m]; slightly less than the task allows."""
HANDLING_WAIT = 15
"""Number of steps for which a person handles a thing; slightly more than handling takes."""
PAUSE = 8
"""Number of steps after which an agent without an errand asks again."""
AVOID = 90
"""Number of steps for which an errand is avoided after failures."""
LATE = 600
"""Number of steps after which an agent without an errand takes over an errand whose thing has not been taken yet."""
PLACED = ("is_on_top", "is_inside", "is_in_room")
TRIES = 3
MOST_ORDERS = 720
"""Largest number of orders of the errands that are compared; with more errands, the nearest comes first."""
ASIDE_M = 2.0
"""Smallest distance between an agent that asks another to move and the thing to which it wants to go [m]."""
ESCAPES = tuple(
    ("turn_" + side,) * 2 + ("move_" + way,) * 4 for way in ("backward", "forward") for side in ("left", "right")
)
"""Primitives that are tried in turn by a robot that is stuck in a doorway, about 20 degrees and 1.3 m each."""
WORK_M = 4.0
"""Length of a path that takes as long as the work of an errand at its places [m]."""


class Plan:
    """Assignment of the errands of one episode to agents."""

    def __init__(self, episode: Any, kinds: Sequence[str]) -> None:
        self.errands = msgspec.convert(episode.extra["errands"], list[Errand])
        self.goals = [[t.goal, *map(np.array, episode.extra["later_goals"].get(t.name, ()))] for t in episode.targets]
        self.kinds = kinds
        self.handled: set[int] = set()
        self.brought: set[int] = set()
        """Errands whose things have been put at their goals, where they remain until an agent sees them elsewhere."""
        self.doing: dict[int, int] = {}
        """Errand of each agent."""
        self.begun: dict[int, int] = {}
        """Step at which each agent began its errand."""
        self.avoided: dict[tuple[int, int], int] = {}
        """Step until which an agent leaves an errand."""
        self.asked_at: dict[int, int] = {}
        """Step at which each agent who follows the plan was last asked."""
        self.paths: dict[tuple[float, ...], float] = {}
        self.places: dict[int, Any] = {}
        """Last known place of each agent who follows the plan."""

    def done(self, view: RearrangeView) -> set[int]:
        """Return the errands that are done, as far as an agent can see."""
        found = self.handled | {n for n in self.brought if not view.is_known(self.errands[n].thing)}
        for n, errand in enumerate(self.errands):
            if not errand.handle:
                goals = self.goals[errand.thing]
                # the nearest, as a goal in a drawer moves with it
                now = int(np.argmin(np.linalg.norm(np.array(goals) - view.goals[errand.thing], axis=1)))
                if now > errand.stage or (now == errand.stage and view.at_goal[errand.thing]):
                    found.add(n)
        return found

    def open(self, view: RearrangeView, agent: int) -> list[int]:
        """Return the errands that an agent can start now."""
        done, others = self.done(view), {self.errands[n].thing for a, n in self.doing.items() if a != agent}
        return [
            n
            for n, errand in enumerate(self.errands)
            if n not in done
            and set(errand.after) <= done
            and errand.thing not in others
            and view.is_known(errand.thing)
            and view.held_by[errand.thing] in (NOBODY, agent)
            and (self.kinds[agent] == "human" or not errand.handle)
            and (self.avoided.get((agent, n), 0) <= view.step or view.held_by[errand.thing] == agent)
        ]

    def early(self, view: RearrangeView, agent: int) -> int:
        """Return the nearest errand whose thing can be fetched while others complete its conditions; -1 if none."""
        done, theirs = self.done(view), {n for a, n in self.doing.items() if a != agent}
        things = {self.errands[n].thing for n in theirs}
        found = [
            n
            for n, errand in enumerate(self.errands)
            if not errand.handle
            and not errand.stage
            and set(errand.after) <= done | theirs
            and n not in done | theirs
            and errand.thing not in things
            and view.is_known(errand.thing)
            and view.held_by[errand.thing] in (NOBODY, agent)
            and self.avoided.get((agent, n), 0) <= view.step
        ]
        return min(found, key=lambda n: self.length(view, view.xz, n)[0], default=-1)

    def waits(self, view: RearrangeView, n: int) -> bool:
        """Return whether an errand has to wait for others."""
        return not set(self.errands[n].after) <= self.done(view)

    def rescue(self, view: RearrangeView, agent: int) -> int:
        """Return a late errand of another agent that an agent without errand takes over; -1 if there is none."""
        for other, n in self.doing.items():
            thing = self.errands[n].thing
            late = view.step - self.begun[other] > LATE and view.held_by[thing] == NOBODY and view.is_known(thing)
            if other != agent and late and (self.kinds[agent] == "human" or not self.errands[n].handle):
                del self.doing[other]
                return n
        return -1

    def length(self, view: RearrangeView, here: Any, n: int) -> tuple[float, Any]:
        """Return the length of an errand's path from a place, including its work [m], and its end point."""
        errand = self.errands[n]
        start = view.objects[errand.thing, [0, 2]]
        length = self._path(view, here, start) + WORK_M
        if errand.handle:
            return length, start
        goal = self.goals[errand.thing][errand.stage][[0, 2]]
        return length + self._path(view, start, goal), goal

    def _path(self, view: RearrangeView, start: Any, end: Any) -> float:
        """Return the length of the shortest path between two floor points [2] that may be in furniture [m]."""
        key = (*np.round(start, 2).tolist(), *np.round(end, 2).tolist())
        if key not in self.paths:
            length = float(view.free.geodesic(start, end, max_snap_m=2.0))
            self.paths[key] = length if np.isfinite(length) else DETOUR * float(np.hypot(*(end - start)))
        return self.paths[key]

    def choose(self, view: RearrangeView, agent: int) -> int:
        """Return the errand that an agent does next; -1 if there is none."""
        mine = self.open(view, agent)
        if not mine:
            return -1
        held = [n for n in mine if view.held_by[self.errands[n].thing] == agent]
        if held:
            return min(held, key=lambda n: not self.errands[n].handle)
        partners = [a for a in range(len(self.kinds)) if a != agent and (a in self.asked_at or not view.step)]
        done = self.done(view)
        left = [
            n
            for n, errand in enumerate(self.errands)
            if n not in done and n not in self.doing.values() and view.is_known(errand.thing)
        ]
        if not partners or len(left) > 6:
            return min(mine, key=lambda n: self.length(view, view.xz, n)[0])
        best, chosen = np.inf, -1
        for order in itertools.islice(itertools.permutations(left), MOST_ORDERS):
            for cut in range(len(order) + 1):
                if not cut or order[0] not in mine:
                    continue
                parts = ((agent, order[:cut]), (partners[0], order[cut:]))
                if any(self.errands[n].handle and self.kinds[a] != "human" for a, part in parts for n in part):
                    continue
                cost = max(self._duration(view, a, part) for a, part in parts)
                total = add_up(self._duration(view, a, part) for a, part in parts)
                if cost + 0.01 * total < best:
                    best, chosen = cost + 0.01 * total, order[0]
        alone = self._duration(view, partners[0], tuple(left)) if self.kinds[partners[0]] == "human" else np.inf
        return -1 if chosen < 0 or alone < best else chosen

    def _duration(self, view: RearrangeView, agent: int, part: Sequence[int]) -> float:
        here, total = (view.xz if agent == view.agent else self.places.get(agent, view.other_xz)), 0.0
        if agent != view.agent and agent in self.doing:
            part = (self.doing[agent], *part)
        for n in part:
            length, here = self.length(view, here, n)
            total += length
        return total


_SHARED: WeakKeyDictionary[Any, Plan] = WeakKeyDictionary()
"""Plan of each episode that is being played, which its experts share."""


class Expert:
    """Agent that follows a plan."""

    def __init__(self, episode: Any, number: int, kinds: Sequence[str], *, greedy: bool) -> None:
        self.plan: Plan = Plan(episode, kinds)
        self.search = Search()
        self.number, self.greedy = number, greedy
        self.episode, self.failures, self.moved, self.begun = episode, 0, 0, False
        self.stuck = 0
        """Number of consecutive skills that ended because the robot could not continue."""
        self.escape: list[str] = []
        """Primitives by which a stuck robot gets free, the next one first."""

    def _begin(self, view: RearrangeView) -> None:
        """Join the plan of those who play this episode now; one of an earlier play has been asked for later steps."""
        shared, self.begun = _SHARED.get(self.episode), True
        stale = shared is None or self.number in shared.asked_at or max(shared.asked_at.values()) > view.step
        if shared is None or stale:
            _SHARED[self.episode] = self.plan
        else:
            self.plan = shared

    def act(self, view: RearrangeView) -> Action:
        """Return the next skill of the current errand, or of the next errand that the agent starts."""
        if not self.greedy and not self.begun:
            self._begin(view)
        plan = self.plan
        plan.places[self.number], plan.asked_at[self.number] = view.xz, view.step
        self._note(view)
        if self.escape:
            return Action(self.escape.pop(0))
        now = plan.doing.get(self.number, -1)
        holds = now >= 0 and view.held_by[plan.errands[now].thing] == self.number
        if now < 0 or (now not in plan.open(view, self.number) and not (holds and plan.waits(view, now))):
            plan.doing.pop(self.number, None)
            now = self._nearest(view) if self.greedy else plan.choose(view, self.number)
            now = now if now >= 0 else plan.early(view, self.number)
            now = now if now >= 0 else plan.rescue(view, self.number)
            if now < 0:
                done = plan.done(view)
                seeks = any(n not in done and not view.is_known(e.thing) for n, e in enumerate(plan.errands))
                return self.search.act(view) if seeks else Action("wait", steps=PAUSE)
            plan.doing[self.number], plan.begun[self.number] = now, view.step
        errand = plan.errands[now]
        if self.failures >= TRIES:  # with the thing in its hand
            self.failures = 0
            return self._elsewhere(errand.thing)
        action = next_action(view, errand.thing)
        if action.skill in ("nav_to_goal", "place") and plan.waits(view, now):
            return Action("wait", steps=PAUSE)
        if errand.handle and action.skill in ("pick", "place", "nav_to_goal"):
            near = self._is_near(view, errand.thing)
            return Action("wait", errand.thing, HANDLING_WAIT) if near else Action("nav_to_object", errand.thing)
        return action

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason to stop if another agent has taken the thing to which this agent is going, else empty."""
        action = view.action
        if action is not None and is_search(action) and self.number not in self.plan.doing:
            over = action.skill == SEARCH and self.search.is_over(view)
            return "found" if over or self.plan.open(view, self.number) else ""
        if action is None or action.skill not in ("nav_to_object", "pick"):
            return ""
        if self.number not in self.plan.doing:
            return "errand_taken"
        return "object_taken" if view.held_by[action.target] not in (NOBODY, self.number) else ""

    @staticmethod
    def _is_near(view: RearrangeView, thing: int) -> bool:
        far = np.hypot(*(view.objects[thing, [0, 2]] - view.xz)) > HANDLING_M
        return view.held_by[thing] == view.agent or (view.held_by[thing] == NOBODY and not far)

    def _note(self, view: RearrangeView) -> None:
        """Take in how the last skill ended."""
        now = self.plan.doing.get(self.number, -1)
        if now < 0 or view.last is None or view.action is None or view.action.skill in PRIMITIVES:
            return
        if view.last.outcome == "failed":
            self.failures += 1
            self.stuck += view.last.reason == "stuck" and self.plan.kinds[self.number] == "robot"
            turns = self.stuck // TRIES
            if self.stuck % TRIES == 0 and turns > 1:
                self.escape = list(ESCAPES[turns % len(ESCAPES)])
            if self.failures >= TRIES and view.held_by[self.plan.errands[now].thing] != self.number:
                self.plan.avoided[self.number, now] = view.step + AVOID
                self.plan.doing.pop(self.number)
                self.failures = 0
        elif view.last.outcome == "done":
            self.failures = 0
            self.stuck *= not view.action.skill.startswith("nav")  # who cannot get away can still do what is in reach
            thing = self.plan.errands[now].thing
            if view.action[:2] == ("place", thing):
                self.plan.brought.add(now)
            if view.action[:2] == ("wait", thing) and view.action.steps and self._is_near(view, thing):
                self.plan.handled.add(now)

    def _elsewhere(self, thing: int) -> Action:
        """Choose another spot, where the task allows it, for a thing that does not get to its goal."""
        name, beside, places = self.episode.targets[thing].name, False, list[str]()
        asked = [p for p in Evaluation.of(self.episode.extra).propositions if name in p.things[0]]
        low = FLOOR if any(p.function_name == "is_on_floor" for p in asked) else ""
        for p in Evaluation.of(self.episode.extra).propositions:
            if p in asked and p.function_name in PLACED:
                kind = {"is_inside": INSIDE, "is_in_room": low}.get(p.function_name, "")
                places += [f"{kind}{place}" for place in p.things[1]]
            elif any(name in names for names in p.things) and p.function_name not in STATES:
                beside = True
        if beside or name in self.episode.extra["later_goals"] or not places:
            return Action("wait", steps=PAUSE)
        self.moved += 1
        return Action("wait", thing, 0, Destination(places[self.moved % len(places)]))

    def _nearest(self, view: RearrangeView) -> int:
        theirs = persons_object(view) if np.isfinite(view.other_xz).all() else -1
        mine = self.plan.open(view, self.number)
        free = [n for n in mine if self.plan.errands[n].thing != theirs] or (mine if len(mine) == 1 else [])
        return min(free, key=lambda n: self.plan.length(view, view.xz, n)[0], default=-1)


class Talker(Speaker, Expert):
    """Agent with its own plan, which announces what it takes, leaves, handles and sees, and listens to others."""

    def __init__(self, episode: Any, number: int, kinds: Sequence[str]) -> None:
        Speaker.__init__(self, episode)
        Expert.__init__(self, episode, number, kinds, greedy=False)
        self.begun = True  # the plan is not shared
        self._finished: set[int] = set()
        """Errands that an agent has reported as done."""
        self._known: set[int] = set()
        self._in_the_way = self._steps_aside = False
        """True if another agent has asked it to move and it has not moved yet; true while it walks out of the way."""

    def _choose(self, view: RearrangeView) -> Action:
        """Return the next skill as of the other experts; who has nothing to do and is asked to move goes elsewhere."""
        # a search that has ended was not at the place of which somebody has told
        hinted = self._listen(view) and self.number not in self.plan.doing
        action = Expert.act(self, view._replace(last=None) if hinted else view)
        aside = self._aside(view) if self._in_the_way and self.number not in self.plan.doing else None
        self._in_the_way, self._steps_aside = False, aside is not None
        return aside or action

    def _aside(self, view: RearrangeView) -> Action | None:
        """Return the way to the nearest thing that is not beside the one who asks; None: there is none."""
        far = [
            k
            for k in range(len(view.objects))
            if view.is_known(k) and np.hypot(*(view.objects[k, [0, 2]] - view.other_xz)) > ASIDE_M
        ]
        near = min(far, key=lambda k: float(np.hypot(*(view.objects[k, [0, 2]] - view.xz))), default=None)
        return None if near is None else Action("nav_to_object", near)

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason to stop, as for the other experts; an agent can step aside at any time."""
        return "" if self._steps_aside else Expert.interrupts(self, view)

    def _tell(self, view: RearrangeView) -> None:
        """Make the messages about everything that has changed since the last ones."""
        now, before, plan = self.plan.doing.get(self.number, -1), self._taken, self.plan
        if now != before and now >= 0:
            self._say.append(say("i_take", self._names[plan.errands[now].thing]))
        elif now != before:
            self._say.append(say("i_leave", self._names[plan.errands[before].thing]))
        self._taken = now
        for n in sorted((plan.handled | (plan.brought & plan.done(view))) - self._finished):
            kind = "handled" if plan.errands[n].handle else "brought"
            self._say.append(say(kind, self._names[plan.errands[n].thing]))
            self._finished.add(n)
        if view.places is not None:
            self._known = self._tell_places(view, self._known)

    def _listen(self, view: RearrangeView) -> bool:
        """Take in messages of others since the last time; return whether one says where something is that is not known."""
        plan, hinted = self.plan, False
        for event in view.messages[self._heard :]:
            intent = Intent.of(event.detail)
            if event.agent == self.number or intent is None or (intent.names and intent.names[0] not in self._names):
                continue
            plan.asked_at[event.agent] = event.step
            thing = self._names.index(intent.names[0]) if intent.names else -1
            done = plan.done(view)
            errands = [n for n, errand in enumerate(plan.errands) if errand.thing == thing and n not in done]
            self._in_the_way = self._in_the_way or intent.kind == "please_move"
            if intent.kind in ("i_take", "i_leave"):
                plan.doing.pop(event.agent, None)
            if intent.kind == "i_take" and errands:
                plan.doing[event.agent], plan.begun[event.agent] = errands[0], view.step
            elif intent.kind in ("handled", "brought"):
                handles = intent.kind == "handled"
                found = {n for n in errands[: None if handles else 1] if plan.errands[n].handle == handles}
                plan.handled |= found  # done, wherever it was seen last
                self._finished |= found
            elif intent.kind == "is_in" and intent.names[1] in self._surfaces and not view.is_known(thing):
                self.search = Search(self._surfaces.index(intent.names[1]))  # which looks there first
                hinted = True
        self._heard = len(view.messages)
        return hinted


class Idle:
    """Agent that stands still."""

    def act(self, view: RearrangeView) -> Action:
        """Return the skill ``wait``."""
        return Action("wait")


def expert(name: str, episode: Any, number: int, kinds: Sequence[str]) -> Any:
    """Return a new expert for one agent of an episode; those of ``language_expert`` share a plan."""
    if name == "language_still":
        return Idle()
    if name == "language_talk":
        return Talker(episode, number, kinds)
    return Expert(episode, number, kinds, greedy=name == "language_greedy")
