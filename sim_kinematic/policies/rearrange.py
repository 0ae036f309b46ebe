"""High-level policies of social rearrangement: partners that follow a plan, populations of them, and heuristic robots.

They follow the paper (section 4.2) and habitat-lab. A policy chooses the next skill; skills
(`sim_kinematic.agents.skills`) carry it out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, suggest
from sim_kinematic.agents.skills import Action, choices
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.choosers.chooser_network import SkillPolicyNetwork
from sim_kinematic.policies.choosers.recurrent_chooser import RecurrentSkillPolicy
from sim_kinematic.policies.learned import SHIPPED_HELPERS, SHIPPED_PARTNERS, naming, network_of, require, trained_for
from sim_kinematic.policies.network import Network
from sim_kinematic.policies.rearrange_observations import SENSES, observe
from sim_kinematic.policies.views import CloseView, RearrangeView

PLANS: dict[str, tuple[int, ...]] = {"still": (), "object_1": (0,), "object_2": (1,), "both": (0, 1)}
"""Planners by name, with the objects that each rearranges."""
POPULATIONS: dict[str, tuple[str, ...]] = {
    "plan_pop_1": ("object_1",),
    "plan_pop_2": ("object_1", "object_2"),
    "plan_pop_3": ("object_1", "object_2", "both"),
    "plan_pop_4": ("still", "object_1", "object_2", "both"),
}
"""Plans from which a partner's plan is sampled in each episode (paper section 4.2, Plan-Pop)."""
ZSC = ("both", "object_1", "object_2", "still")
"""Planners of the paper's zero-shot population (appendix)."""
ZSC_TEN = (*ZSC, *SHIPPED_PARTNERS)
"""Planners and six learned partners of the paper's zero-shot population; the partners were trained here, as the paper's
were not published."""


REPLAN_STEPS, STRAIGHT_ON_STEPS, IN_REACH_M = 15, 10, 0.9
"""Number of steps after which a robot that drives to an object chooses again (1 while the person is close); number of
steps over which the person's motion is extrapolated to predict their target; and distance to an object below which the
person may be about to take it [m]."""


class HighLevelPolicy(Protocol):
    """Policy of the upper layer of rearrangement, which chooses skills.

    A policy that may abort its action also has ``interrupts(view) -> str``, which is asked in every step of an action
    and returns the reason to abort it, or an empty text. For a policy without this method, no view is computed in these
    steps.
    """

    def act(self, view: RearrangeView) -> Action:
        """Return the next action; called when the last action has ended or was interrupted."""
        ...


def errand(view: RearrangeView, k: int) -> Action:
    """Return the next action that brings object ``k`` closer to its goal.

    The action is one of the four skills or, as long as the hand is free, an action that opens the door or drawer that
    encloses the object or its goal.
    """
    done = view.action if view.last is not None and view.last.outcome == "done" else None
    # opening takes a free hand, so what shuts off the goal is opened before the object is taken
    if not (view.held_by == view.agent).any():
        for at_goal in (True, False):
            if (joint := view.barrier(k, at_goal)) >= 0:
                arrived = done is not None and done[:2] == ("nav_to_handle", joint)
                return Action("open" if arrived else "nav_to_handle", joint)
    came, handle = ("nav_to_goal", "place") if view.held_by[k] == view.agent else ("nav_to_object", "pick")
    return Action(handle if done is not None and (done.skill, done.target) == (came, k) else came, k)


class Plan(NamedTuple):
    """Progress of the planners of W worlds in their plans, as arrays or tensors."""

    order: Any
    """Objects to bring to their goals, one after the other, int [W, K]; -1 after the last."""
    passed: Any
    """Number of objects that are done or were skipped, int [W]."""
    tries: Any
    """Number of failures of the planner at its current object, int [W]."""

    def next(
        self, asked: Any, failed: Any, held_by: Any, at_goal: Any, agent: int, *, xp: Any = np
    ) -> tuple[Any, Plan]:
        """Return the objects [W] to bring to their goals now, and the plans after this decision.

        An object is -1 if none is left or no choice is due.

        Args:
            asked: whether the planner chooses now, bool [W].
            failed: whether its last choice failed, bool [W].
            held_by: number of the agent that holds each object, int [W, K].
            at_goal: which objects are at their goals, bool [W, K].
            agent: number of the planner.
            xp: array namespace.
        """
        order, passed, tries = self
        # numbers of the places in each plan; cumsum makes them for arrays and tensors alike
        places = xp.cumsum(xp.ones_like(order), -1) - 1
        count, chosen = (order >= 0).sum(-1), xp.full_like(passed, -1)
        mine_all, free_all = held_by == agent, ~at_goal & ((held_by == agent) | (held_by == NOBODY))
        # number of failures at an object after which a planner goes on to the next
        most_tries = 3
        # each round passes one object at most; later rounds change nothing where one has been chosen
        for _ in range(order.shape[-1]):
            asked = asked & (passed < count)
            k = xp.where(places == passed[:, None], order, 0).sum(-1)
            tries = tries + (asked & failed)
            # numbers of places are numbers of objects too: a plan is as long as there are objects
            here = places == k[:, None]
            goes = asked & ((mine_all & here).any(-1) | ((free_all & here).any(-1) & (tries < most_tries)))
            chosen, asked = xp.where(goes, k, chosen), asked & ~goes
            passed, tries = passed + asked, xp.where(asked, 0, tries)
        return chosen, Plan(order, passed, tries)


@dataclass
class Planner:
    """Partner that brings its objects to their goals one after the other, then stands still.

    It plans once and never aborts, like the partners of habitat-lab. Objects that are at their goals or in the other
    agent's hands when their turn comes are skipped. An object from which others block it (`blocked`) is moved to the
    end.
    """

    objects: tuple[int, ...]
    _passed: int = 0
    """Number of objects that are done or skipped."""
    _tries: int = 0

    def act(self, view: RearrangeView) -> Action:
        """Return the next action for the first object that is not done."""
        done, rest = self.objects[: self._passed], self.objects[self._passed :]
        blocked = view.last is not None and view.last[:2] == ("failed", "blocked")
        # whoever blocks the object will go away some day; an object in the hand cannot be put off
        if rest and blocked and view.held_by[rest[0]] != view.agent:
            self.objects, self._tries = (*done, *rest[1:], rest[0]), 0
        # an object that has not been seen yet is put off; if none has, the agent waits
        if rest and not view.is_known(rest[0]):
            known = [k for k in rest if view.is_known(k)]
            self.objects, self._tries = (*done, *known, *(k for k in rest if k not in known)), 0
            if not known:
                return Action("wait", steps=5)
        # being blocked counts as no failure: whoever stands there will go away some day
        failed = view.last is not None and view.last.outcome == "failed" and view.last.reason != "blocked"
        order = np.array([(*self.objects, *(-1 for _ in range(len(view.held_by) - len(self.objects))))])
        plan = Plan(order, np.array([self._passed]), np.array([self._tries]))
        asked, hands = np.array([True]), np.asarray(view.held_by)[None]
        chosen, plan = plan.next(asked, np.array([failed]), hands, np.asarray(view.at_goal)[None], view.agent)
        k, self._passed, self._tries = chosen.item(), plan.passed.item(), plan.tries.item()
        return Action("wait") if k < 0 else errand(view, k)


@dataclass
class Chooser:
    """Robot that brings objects to their goals in the order of a preference.

    `prefer` returns the next object. The robot changes to another when the person has taken the one it is heading for.
    """

    prefer: Callable[[RearrangeView, list[int]], int | None]
    """Function that chooses one of the remaining objects; None means to wait."""
    _object: int = -1
    _avoid: dict[int, int] = field(default_factory=dict)
    """Objects at which the agent failed, and the step until which it avoids each."""

    def act(self, view: RearrangeView) -> Action:
        """Return the next action for the object in hand, or for the preferred one.

        After a failure, the robot avoids that object for 60 steps.
        """
        if view.last is not None and view.last.outcome == "failed" and self._object >= 0:
            self._avoid[self._object] = view.step + 60
        held = np.flatnonzero(view.held_by == view.agent)
        chosen = int(held[0]) if len(held) else self.prefer(view, self._left(view))
        self._object = -1 if chosen is None else chosen
        return Action("wait", steps=5) if chosen is None else errand(view, chosen)

    def may_interrupt(self, glance: CloseView) -> bool:
        """Return whether `interrupts` has to be asked: a view takes as long as a tenth of a step."""
        skill, replans = glance.action.skill, glance.close or glance.step % REPLAN_STEPS == 0
        return skill in ("nav_to_object", "pick") and (glance.held_by_other or (replans and skill != "pick"))

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason to interrupt the running action, such as ``object_taken``; empty if there is none."""
        action = view.action
        if action is None or action.skill not in ("nav_to_object", "pick"):
            return ""
        if view.held_by[action.target] not in (NOBODY, view.agent):
            return "object_taken"
        if action.skill == "nav_to_object" and (view.close or view.step % REPLAN_STEPS == 0):
            better = self.prefer(view, self._left(view))
            if better is not None and better != action.target:
                return "agents_close" if view.close else "replanned"
        return ""

    def _left(self, view: RearrangeView) -> list[int]:
        """Return the objects that are left to do, without those that the robot avoids after a failure."""
        return [k for k in view.left_to_do() if self._avoid.get(k, 0) <= view.step]


def _nearest(view: RearrangeView, left: list[int]) -> int | None:
    """Return the object with the shortest path to it; None: nothing is left."""
    if not left:
        return None
    return min(left, key=lambda k: _way(view, view.xz, k))


def _way(view: RearrangeView, start: NDArray, k: int) -> float:
    """Return the length of the path from ``start`` [2] to an object [m]."""
    # objects lie on furniture, so the end of the path is moved to the floor
    return float(view.free.geodesic(start, view.objects[k, [0, 2]], max_snap_m=2.0))


def persons_object(view: RearrangeView) -> int:
    """Return the object that the person holds, walks to (judging by their last steps) or stands at; -1 if unknown."""
    held = np.flatnonzero(np.isin(view.held_by, (NOBODY, view.agent), invert=True))
    if len(held):
        return int(held[0])
    some = range(len(view.objects))
    left = [k for k in some if not view.at_goal[k] and view.held_by[k] == NOBODY and view.is_known(k)]
    before = view.other_track[max(len(view.other_track) - STRAIGHT_ON_STEPS, 0)]
    moved = float(np.hypot(*(view.other_xz - before)))
    if not left:
        return -1
    if moved < 0.1:  # they stand: perhaps about to take what is before them
        gaps = [float(np.hypot(*(view.objects[k, [0, 2]] - view.other_xz))) for k in left]
        return left[int(np.argmin(gaps))] if min(gaps) < IN_REACH_M else -1
    # who walks straight along the path to an object has shortened it by as much as they moved
    gain = [_way(view, before, k) - _way(view, view.other_xz, k) for k in left]
    best = int(np.argmax(gain))
    return left[best] if gain[best] > 0.5 * moved else -1


def _complement(view: RearrangeView, left: list[int]) -> int | None:
    """Return the object that the person is not heading for.

    While the person's target is unknown, it is an object that is farther from the person than from the robot.
    """
    # nobody else is there, so there is nothing to complement
    if np.isnan(view.other_xz).any():
        return _nearest(view, left)
    theirs = persons_object(view)
    others = [k for k in left if k != theirs]
    if not others:
        # only theirs is left: it is taken from somebody who does not move, and left to others
        moves = float(np.ptp(view.other_track, axis=0).max()) > 0.05
        return _nearest(view, left) if theirs < 0 or (view.held_by[theirs] == NOBODY and not moves) else None
    # the nearest of the others; if the person's target is unknown, the one that is most in the robot's favour
    if theirs >= 0:
        return _nearest(view, others)
    return max(others, key=lambda k: _way(view, view.other_xz, k) - _way(view, view.xz, k))


ROBOT_POLICIES: dict[str, Callable[[], HighLevelPolicy]] = {
    "greedy_nearest": lambda: Chooser(_nearest),
    "complement": lambda: Chooser(_complement),
    "same_object": lambda: Chooser(lambda view, left: 1 if 1 in left else None),
    "still": lambda: Planner(()),
}
"""Functions that make heuristic robots, by name. ``same_object`` always rearranges the second object, as a robot learns
to do whose only partner always takes the first (paper appendix on Plan-Pop 1)."""
PARTNERS = (*POPULATIONS, *PLANS)


def population_of(partner: str) -> str:
    """Return ``zsc-pop`` for a partner of the zero-shot population, ``train-pop`` for one of planners, or empty."""
    return "zsc-pop" if partner in ZSC_TEN else "train-pop" if partner in POPULATIONS else ""


def zsc_populations(partners: Iterable[str]) -> tuple[tuple[str, ...], ...]:
    """Return the paper's zero-shot populations that can play: four planners, and these with six learned partners."""
    there = set(partners)
    return tuple(population for population in (ZSC, ZSC_TEN) if there.issuperset(population))


def robot_policy(name: str) -> HighLevelPolicy:
    """Return a new robot policy by name; raise an `InputError` that lists the names if there is none."""
    if name not in ROBOT_POLICIES:
        there = (*ROBOT_POLICIES, *SHIPPED_HELPERS)
        raise InputError(
            f"Unknown policy {name!r}.{suggest(name, there, more=', or weights:FILE')}", code="H3-POLICY-038"
        )
    return ROBOT_POLICIES[name]()


def partner_plan(name: str, seed: int) -> str:
    """Return the plan of a partner in the episode with this seed, a name in `PLANS`."""
    if name in PLANS:
        return name
    if name not in POPULATIONS:
        there = (*PARTNERS, *SHIPPED_PARTNERS)
        raise InputError(
            f"Unknown partner {name!r}.{suggest(name, there, more=', or weights:FILE')}", code="H3-POLICY-039"
        )
    plans = POPULATIONS[name]
    return plans[int(generator(seed, f"partner/{name}").integers(len(plans)))]


def partner_policy(name: str, seed: int, objects: int = 2) -> HighLevelPolicy:
    """Return a new partner policy for the episode with this seed."""
    return planner(partner_plan(name, seed), seed, objects)


def planner(plan: str, seed: int, objects: int = 2) -> Planner:
    """Return the planner of a plan, where the seed determines the order of objects for ``both``."""
    wanted = list(range(objects)) if plan == "both" else [k for k in PLANS[plan] if k < objects]
    if len(wanted) > 1:
        wanted = generator(seed, "plan_order").permutation(wanted).tolist()
    return Planner(tuple(wanted))


class LearnedSkillPolicy:
    """Policy that chooses the action with the highest output of a network.

    If ``interrupted`` is among its observations, it chooses at every step while the other agent is close, and continues
    what it is doing by choosing the same action.
    """

    def __init__(self, network: Network, objects: int = 2, *, robot: bool = True) -> None:
        """Check that the network fits the agent.

        Args:
            network: the policy.
            objects: number of objects of the task.
            robot: whether the agent is a robot; otherwise it is a person.

        Raises:
            FormatError: the network is for a different number of objects or for the other agent.
        """
        self.choices = choices(objects, robot=robot)
        require(network, SENSES, outputs=len(self.choices))
        self.network = network

    def act(self, view: RearrangeView) -> Action:
        """Return the next action, the one with the highest output of the network."""
        scores = self.network(chooser_input(view, self.network.observations))
        return self.choices[int(np.argmax(scores))]

    interrupts_only_when_close = True
    """True if `interrupts` returns a reason only if ``view.close`` is true, so that it is called only then, with a
    `CloseView`."""

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason to interrupt the running action and choose again; empty if there is none."""
        return "agents_close" if view.close and "interrupted" in self.network.observations else ""


def learned_chooser(policy: str, task: str, objects: int, *, robot: bool) -> LearnedSkillPolicy | RecurrentSkillPolicy:
    """Return the chooser for ``weights:FILE`` or for the name of a trained policy, which has to be for a task.

    Raises:
        InputError: the file does not exist, is not a file of weights, or its network does not fit.
    """
    network = network_of(policy)
    with naming(policy):
        fitting = trained_for(network, task, Network, SkillPolicyNetwork)
        player = RecurrentSkillPolicy if isinstance(fitting, SkillPolicyNetwork) else LearnedSkillPolicy
        return player(fitting, objects, robot=robot)  # type: ignore[arg-type]


def chooser_input(view: RearrangeView, names: Sequence[str]) -> NDArray[np.float32]:
    """Return the named observations at this moment, concatenated to one float32 vector [in]."""
    return np.concatenate(list(observe(view, names).values()))
