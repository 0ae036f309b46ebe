"""Search for objects in a home: the choice of the next place to check, and planners that search while they are idle."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sim_kinematic.agents.skills import SEARCH, Action
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.sensing.sight import LOOK_STEPS


@dataclass(frozen=True)
class SearchSpec:
    """Costs and distances that determine the order in which places are searched."""

    group_m: float = 1.5
    """Distance below which places count as visible from each other's stand [m]."""
    stand_m: float = 3.0
    """Cost of a stop at a place, as an equivalent length of path [m]."""
    opening_m: float = 12.0
    """Additional cost of opening a place's door or drawer, as an equivalent length of path [m]."""
    theirs: float = 0.4
    """Weight of a place that is nearer to the other agent, who may check it as well."""
    compared: int = 8
    """Number of the best places by straight-line distance that are compared by lengths of paths."""
    avoid_steps: int = 900
    """Number of steps for which a place that could not be reached is avoided."""
    pause: int = 15
    """Number of steps that an agent waits if no places are left to check."""


SEARCHING = SearchSpec()


@dataclass
class Search:
    """Search of one agent, which checks one place after the other, starting where much becomes visible soon."""

    _place: int = -1
    _avoid: dict[int, int] = field(default_factory=dict)
    """Step until which each place is avoided."""

    def act(self, view: RearrangeView) -> Action:
        """Return the next action of the search: walking to a place, or opening the door or drawer in front of it."""
        assert view.places is not None
        looked, shut = view.places.looked, view.places.shut
        now, ended = self._place, view.last
        if now >= 0 and ended is not None and view.action is not None and is_search(view.action):
            arrived = ended.outcome == "done" and view.action.skill == SEARCH
            # it got there and still has not seen the place: it would be sent there again and again
            if ended.outcome == "failed" or (arrived and not looked[now]):
                # a door or drawer that could not be opened shuts all places behind it
                same = shut == shut[now] if shut[now] >= 0 else np.arange(len(shut)) == now
                self._avoid |= dict.fromkeys(np.flatnonzero(same).tolist(), view.step + SEARCHING.avoid_steps)
        if now < 0 or looked[now] or self._avoid.get(now, 0) > view.step:
            self._place = now = self._best(view)
        if now < 0:
            return Action("wait", steps=SEARCHING.pause)
        if shut[now] < 0:
            return Action(SEARCH, now)
        joint = int(shut[now])
        there = ended is not None and ended.outcome == "done" and view.action is not None
        at_handle = there and view.action is not None and view.action[:2] == ("nav_to_handle", joint)
        return Action("open" if at_handle else "nav_to_handle", joint)

    def is_over(self, view: RearrangeView) -> bool:
        """Return whether the agent has already seen the place to which it is going."""
        return view.places is not None and self._place >= 0 and bool(view.places.looked[self._place])

    def _best(self, view: RearrangeView) -> int:
        """Return the place from which most places are seen for the length of the path to it; -1: none is left."""
        assert view.places is not None
        points, looked, shut = view.places
        full = bool((view.held_by == view.agent).any())
        # with a full hand nothing can be opened
        left = [
            s
            for s in np.flatnonzero(~looked).tolist()
            if self._avoid.get(s, 0) <= view.step and not (full and shut[s] >= 0)
        ]
        if not left:
            return -1
        floor = points[left][:, [0, 2]]
        # places behind another door or drawer cannot be seen from there
        together = (np.hypot(*(floor[:, None] - floor).transpose(2, 0, 1)) < SEARCHING.group_m) & (
            shut[left][:, None] == shut[left]
        )
        gain = together.sum(1).astype(np.float64)
        mine = np.hypot(*(floor - view.xz).T)
        # NaN: there is no other agent, who might look at some places meanwhile
        if np.isfinite(view.other_xz).all():
            gain *= np.where(np.hypot(*(floor - view.other_xz).T) < mine, SEARCHING.theirs, 1.0)
        cost = SEARCHING.stand_m + SEARCHING.opening_m * (shut[left] >= 0)
        # paths take a search each, so only the best by straight lines are compared by them
        best = np.argsort(-gain / (mine + cost), kind="stable")[: SEARCHING.compared]
        ways = view.free.geodesic(np.broadcast_to(view.xz, (len(best), 2)), floor[best], max_snap_m=2.0)
        return left[int(best[np.argmax(gain[best] / (ways + cost[best]))])]


def is_search(action: Action) -> bool:
    """Return whether an action may be one of a search."""
    return action.skill in (SEARCH, "nav_to_handle", "open")


@dataclass
class Seeking:
    """Planner that searches while it is idle and does not know where all objects are."""

    interrupts_every = LOOK_STEPS
    """Number of steps between calls of `interrupts`, which is the interval at which agents look around."""
    policy: Any
    search: Search = field(default_factory=Search)
    _searches: bool = False
    _known: int = 0
    """Number of objects whose place the agent knew when it last chose."""

    def act(self, view: RearrangeView) -> Action:
        """Return the planner's action, or the next action of the search."""
        # the result of an action of the search would tell the planner that its own action had ended
        choice = self.policy.act(view._replace(last=None) if self._searches else view)
        left = [k for k in range(len(view.objects)) if not view.is_known(k) and view.held_by[k] == NOBODY]
        self._searches, self._known = choice.skill == "wait" and bool(left), len(view.objects) - len(left)
        return self.search.act(view) if self._searches else choice

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason to interrupt the action.

        A search ends when an object or the place has been seen; otherwise the planner determines the reason.
        """
        if view.step % LOOK_STEPS:
            return ""
        if not self._searches:
            own = getattr(self.policy, "interrupts", None)
            return own(view) if own is not None else ""
        if view.action is None or not is_search(view.action):
            return ""
        known = sum(view.is_known(k) for k in range(len(view.objects)))
        return "found" if known > self._known or (view.action.skill == SEARCH and self.search.is_over(view)) else ""
