"""Execution of tool calls as sequences of skills, each with a sentence about the result.

Each task is a generator that yields an `Action`, receives the next view by ``send``, and returns the sentence.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from typing import Any

import numpy as np

from h3data.policies import Action, Message, RearrangeView
from h3data_language.experts import HANDLING_M, HANDLING_WAIT
from h3data_language.grounding import FLOOR
from h3data_language.templates import HANDLING
from h3data_llm.tools import PREFIXES, Call
from h3data_llm.world_text import WorldText
from sim_kinematic.agents.skills import INSIDE, SEARCH, Destination, sentence
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.rearrange import errand

Work = Generator[Action, RearrangeView, str]
TRIES = 3
"""Number of failures after which a task is given up."""
SPOTS = 5
"""Number of attempts to find a free spot at a place."""
LONG = 300
"""Duration of one ``wait`` of an agent without a task [steps]."""


class Worker:
    """Executor of tool calls for one agent."""

    def __init__(self, text: WorldText, number: int, uses: list[tuple[str, bool]]) -> None:
        """Prepare for an episode.

        Args:
            text: Names and texts of the home.
            number: Number of the agent.
            uses: State and value that each thing has after it is handled, by thing.
        """
        self._text, self._number, self._uses = text, number, uses
        self.handled: set[str] = set()
        """Things that the agent has handled."""
        self.reason = ""
        """Reason to interrupt the present work as soon as it applies: ``message``, ``found`` or empty."""

    def begin(self, call: Call, view: RearrangeView) -> Work:
        """Return the generator that carries out a call."""
        self.reason = ""
        given = call.arguments
        thing = self._text.names.things.index(given["thing"]) if "thing" in given else -1
        works: Mapping[str, Any] = {
            "bring": lambda: self._bring(view, thing, self._destination(given)),
            "pick": lambda: self._pick(view, thing),
            "place": lambda: self._place(view, self._destination(given)),
            "handle": lambda: self._handle(view, thing, given["do"]),
            "open": lambda: self._turn(view, given["name"], "open"),
            "close": lambda: self._turn(view, given["name"], "close"),
            "explore": lambda: self._explore(view, given.get("room", "")),
            "say": lambda: self._say(given["text"]),
            "wait": lambda: self._wait(view, round(given["seconds"] / STEP_S)),
            "done": lambda: self.rest(view),
        }
        return works[call.tool]()

    @staticmethod
    def _destination(given: Mapping[str, Any]) -> Destination | None:
        if "place" not in given:
            return None
        return Destination(PREFIXES.get(given.get("how", ""), "") + given["place"], given.get("next_to", ""))

    # --- pieces of work -----------------------------------------------------------------------------------------------
    def _bring(self, view: RearrangeView, k: int, where: Destination | None) -> Work:
        held = self._held(view)
        if held not in (NOBODY, k):
            return f"Your hand holds {self._name(held)}. Put that down first."
        failures = 0
        if where is not None and not self._text.has_place(where.place):
            return f"There is no {where.place!r} where things can be put."
        if where is not None and not self._is_goal(view, k, where):
            view = yield from self._aim(k, where)
            if why := self._failure(view):
                return why
        while failures < TRIES:
            if why := self._taken(view, k):
                return why
            action = errand(view, k)
            view = yield action
            if action.skill == "place" and not self._failure(view):
                return f"{self._name(k)} is {self._text.place_of(view.objects[k])} now."
            if self._failure(view):
                failures += 1
                if action.skill in ("place", "nav_to_goal") and where is not None and failures < TRIES:
                    view = yield from self._aim(k, where)  # another spot
        return self._failure(view) or "It did not work."

    def _is_goal(self, view: RearrangeView, k: int, where: Destination) -> bool:
        """Return whether a thing's goal is at a place already: then it keeps the one that the task has found for it."""
        on, inside = self._text.surface_of(view.goals[k])
        if where.place.startswith(FLOOR):
            return not on and not where.next_to and self._text.is_in(view.goals[k], where.place.removeprefix(FLOOR))
        asked = where.place.removeprefix(INSIDE)
        same = inside == where.place.startswith(INSIDE) and bool(on)
        return same and not where.next_to and (on == asked or self._text.is_in(view.goals[k], asked))

    @staticmethod
    def _aim(k: int, where: Destination) -> Generator[Action, RearrangeView, RearrangeView]:
        """Give a thing a goal at a place; spots are random, so that a small surface may take several attempts."""
        for _ in range(SPOTS - 1):
            view = yield Action("wait", k, 0, where)
            if Worker._failure(view) != sentence("no_space"):
                return view
        return (yield Action("wait", k, 0, where))

    def _place(self, view: RearrangeView, where: Destination | None) -> Work:
        held = self._held(view)
        if held == NOBODY:
            return "Your hand is empty."
        return (yield from self._bring(view, held, where))

    def _pick(self, view: RearrangeView, k: int) -> Work:
        held, failures = self._held(view), 0
        if held not in (NOBODY, k):
            return f"Your hand holds {self._name(held)}. Put that down first."
        while failures < TRIES and self._held(view) != k:
            if why := self._taken(view, k):
                return why
            joint = view.barrier(k, False)
            if joint >= 0:
                view = yield self._at_handle(view, joint, "open")
            else:
                view = yield Action("pick" if self._arrived(view, "nav_to_object", k) else "nav_to_object", k)
            failures += bool(self._failure(view))
        return f"You hold {self._name(k)}." if self._held(view) == k else self._failure(view) or "It did not work."

    def _handle(self, view: RearrangeView, k: int, do: str) -> Work:
        name, failures = self._name(k), 0
        if not self._uses[k][0]:
            return f"There is nothing to do to {name} in this task."
        if (*HANDLING[do],) != (*self._uses[k],):
            return f"{name} is not there to {do}."
        while failures < TRIES:
            if why := self._taken(view, k):
                return why
            near = np.hypot(*(view.objects[k, [0, 2]] - view.xz)) <= HANDLING_M
            joint = view.barrier(k, False)
            if view.held_by[k] == self._number or (near and joint < 0):
                view = yield Action("wait", k, HANDLING_WAIT)
                if not self._failure(view):
                    self.handled.add(name)
                    return f"{name}: {do} is done."
            elif joint >= 0:
                view = yield self._at_handle(view, joint, "open")
            else:
                view = yield Action("nav_to_object", k)
            failures += bool(self._failure(view))
        return self._failure(view) or "It did not work."

    def _turn(self, view: RearrangeView, name: str, skill: str) -> Work:
        if self._held(view) != NOBODY:
            return f"Your hand holds {self._name(self._held(view))}. Put that down first."
        joint = self._text.names.openings.index(name)
        for _ in range(2 * TRIES):
            action = self._at_handle(view, joint, skill)
            view = yield action
            if action.skill == skill and not self._failure(view):
                return f"{name} is {'open' if skill == 'open' else 'closed'} now."
            if action.skill == skill:
                break
        return self._failure(view) or "It did not work."

    def _explore(self, view: RearrangeView, room: str) -> Work:
        known, tried = self.known(view), set[int]()
        while self.known(view) <= known:
            assert view.places is not None
            points, looked, shut = view.places
            left = [
                s
                for s in np.flatnonzero(~looked).tolist()
                if s not in tried and (not room or self._text.is_in(points[s], room))
            ]
            left = [s for s in left if shut[s] < 0 or self._held(view) == NOBODY]
            if not left:
                return f"There is nothing new{f' in {room}' if room else ''}: you have looked everywhere."
            now = min(left, key=lambda s: float(np.hypot(*(points[s, [0, 2]] - view.xz))))
            action = Action(SEARCH, now) if shut[now] < 0 else self._at_handle(view, int(shut[now]), "open")
            self.reason = "found"
            view = yield action
            if self._failure(view) or action.skill == SEARCH:
                tried.add(now)
        new = [name for k, name in enumerate(self._text.names.things) if view.is_known(k)]
        return f"You have seen something new. You know where these are: {', '.join(new)}."

    def _say(self, text: str) -> Work:
        view = yield Message(text).action
        return self._failure(view) or "They have heard it."

    def _wait(self, view: RearrangeView, steps: int) -> Work:
        self.reason, heard = "message", self.heard(view)
        view = yield Action("wait", steps=steps)
        return "Somebody has said something." if self.heard(view) > heard else "You have waited."

    def rest(self, view: RearrangeView, *, for_good: bool = False) -> Work:
        """Wait until another agent sends a message, or until the episode ends if ``for_good``."""
        heard, steps = self.heard(view), LONG
        while for_good or self.heard(view) <= heard:
            self.reason = "" if for_good else "message"
            view = yield Action("wait", steps=steps)
            steps = 2 * LONG - steps + 1  # an equal choice after an interruption would go on with the last one
        return "Somebody has said something."

    # --- what has happened --------------------------------------------------------------------------------------------
    def heard(self, view: RearrangeView) -> int:
        """Return the number of messages that other agents have sent so far."""
        return sum(event.agent != self._number for event in view.messages)

    def known(self, view: RearrangeView) -> int:
        """Return the number of things whose position the agent knows."""
        return sum(view.is_known(k) for k in range(len(view.objects)))

    def _held(self, view: RearrangeView) -> int:
        mine = np.flatnonzero(view.held_by == self._number)
        return int(mine[0]) if len(mine) else NOBODY

    def _name(self, k: int) -> str:
        return self._text.names.things[k]

    def _taken(self, view: RearrangeView, k: int) -> str:
        holder = int(view.held_by[k])
        if holder not in (NOBODY, self._number):
            return f"Somebody else holds {self._name(k)}."
        return "" if view.is_known(k) else f"You have not seen where {self._name(k)} is."

    @staticmethod
    def _failure(view: RearrangeView) -> str:
        last = view.last
        return sentence(last.reason) if last is not None and last.outcome == "failed" else ""

    @staticmethod
    def _arrived(view: RearrangeView, skill: str, target: int) -> bool:
        last, action = view.last, view.action
        return last is not None and action is not None and last.outcome == "done" and action[:2] == (skill, target)

    def _at_handle(self, view: RearrangeView, joint: int, skill: str) -> Action:
        return Action(skill if self._arrived(view, "nav_to_handle", joint) else "nav_to_handle", joint)
