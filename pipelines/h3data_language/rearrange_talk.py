"""Planners of rearrangement that announce what they take and where things are, and versions without messages.

``nearest_talk`` and ``nearest_quiet`` bring the nearest remaining object, as robots and as people. ``nearest_talk``
leaves to others the objects that they have announced, and with the rule ``observe=seen`` first searches where others
have reported an object.
"""

from __future__ import annotations

from typing import Any

from h3data.policies import Action, RearrangeView
from h3data_language.talk import Intent, Speaker, say
from sim_kinematic.policies.rearrange import Chooser, robot_policy
from sim_kinematic.policies.searching import Search, Seeking

LATE = 600
"""Number of steps after which an object that another agent has announced to take, and has not taken, is free again."""


def nearest_quiet(task: Any, episode: Any, number: int) -> Any:
    """Return a planner that brings the nearest remaining object."""
    policy = robot_policy("greedy_nearest")
    return Seeking(policy) if episode.spec.observe == "seen" else policy


def nearest_talk(task: Any, episode: Any, number: int) -> Any:
    """Return a planner that also announces what it takes and sees, and uses the announcements of others."""
    return Teller(episode, number)


class Teller(Speaker):
    """Planner that chooses the nearest object that no other agent has announced to take."""

    def __init__(self, episode: Any, number: int) -> None:
        super().__init__(episode)
        nearest: Any = robot_policy("greedy_nearest")
        self._nearest, self._chooser = nearest.prefer, Chooser(self._prefer)
        self.number = number
        self._seeking = Seeking(self._chooser) if episode.spec.observe == "seen" else None
        self.policy: Any = self._seeking or self._chooser
        self._claims: dict[int, tuple[int, int]] = {}
        """For each object, the agent that has announced to take it, and when."""
        self._known: set[int] = set()
        self._hinted = False
        """True if another agent has stated the place of an unknown object, and the planner has not chosen since."""

    @property
    def interrupts_every(self) -> int:
        """Number of steps between calls of `interrupts`."""
        return getattr(self.policy, "interrupts_every", 1)

    def _choose(self, view: RearrangeView) -> Action:
        self._listen(view)
        # a search that has ended was not at the place of which somebody has told
        action = self.policy.act(view._replace(last=None) if self._hinted else view)
        self._hinted = False
        return action

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason to interrupt the running action, as the planner without messages does."""
        self._listen(view)
        return self.policy.interrupts(view)

    def _prefer(self, view: RearrangeView, left: list[int]) -> int | None:
        others = {
            k
            for k, (agent, step) in self._claims.items()
            if agent != self.number and (view.step - step <= LATE or view.held_by[k] == agent)
        }
        return self._nearest(view, [k for k in left if k not in others])

    def _tell(self, view: RearrangeView) -> None:
        """Make the messages about everything that has changed since the last ones."""
        now = self._chooser._object
        if now != self._taken:
            if now >= 0:
                self._say.append(say("i_take", self._names[now]))
            elif not view.at_goal[self._taken]:
                self._say.append(say("i_leave", self._names[self._taken]))
            self._taken = now
        if view.places is not None:
            self._known |= self._tell_places(view, self._known)

    def _listen(self, view: RearrangeView) -> None:
        """Take in the messages of others since the last time."""
        for event in view.messages[self._heard :]:
            intent = Intent.of(event.detail)
            if event.agent == self.number or intent is None or not intent.names or intent.names[0] not in self._names:
                continue
            thing = self._names.index(intent.names[0])
            if intent.kind in ("i_take", "i_leave"):
                self._claims = {k: claim for k, claim in self._claims.items() if claim[0] != event.agent}
            if intent.kind == "i_take":
                self._claims[thing] = event.agent, event.step
            wanted = not view.is_known(thing) and thing not in self._claims
            if intent.kind == "is_in" and intent.names[1] in self._surfaces and self._seeking is not None and wanted:
                self._seeking.search = Search(self._surfaces.index(intent.names[1]))  # which looks there first
                self._hinted = True
        self._heard = len(view.messages)
