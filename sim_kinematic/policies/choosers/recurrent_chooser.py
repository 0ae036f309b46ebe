"""Policy that plays a `SkillPolicyNetwork`, with allowed actions, times of choices, and sampling."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.geometry import Array
from sim_kinematic.agents.skills import Action, choices
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.choosers.chooser_network import SkillPolicyNetwork, encoded
from sim_kinematic.policies.rearrange_observations import SENSES, observe
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.policies.visual_policy import PolicyCard

ALERT_M, ALERT_STEPS = 4.0, 5
"""Distance of the other agent below which a policy chooses again during a walk [m], and number of steps between these
choices. At 2.5 m/s each, two agents that are 4 m apart meet after 0.8 s."""


class RecurrentSkillPolicy:
    """Policy that samples among the `allowed` actions by their scores, as in training.

    Random numbers follow from the episode's seed, and the temperature from the network's card. Taking the best action
    would be worse: a greedy policy can turn left and right forever. The policy holds a recurrent state, so each episode
    needs a policy of its own.

    While the agent walks or drives, the network is evaluated every second, six times a second while the other agent is
    within 4 m, and at once when the other has taken the object it is heading for. The agent continues if the same
    action is sampled. A policy with a camera does not know what the other has taken, and is not interrupted then.
    """

    def __init__(self, network: SkillPolicyNetwork, objects: int = 2, *, robot: bool = True) -> None:
        """Check that the network fits the agent, and start with an empty memory.

        Args:
            network: the policy.
            objects: number of objects of the task.
            robot: whether the agent is a robot; otherwise it is a person.

        Raises:
            FormatError: The network is for a different number of objects or for the other agent.
        """
        card, agent = network.card, "robot" if robot else "human"
        if card.agent != agent:
            raise FormatError(f"Expected weights for a {agent}, these are for a {card.agent}.", code="H3-POLICY-009")
        if card.objects != objects:
            raise FormatError(
                f"These weights know {card.objects} objects, the episode has {objects}.", code="H3-POLICY-010"
            )
        self.network = network
        self.choices = choices(objects, robot=robot)
        self.state = network.start()
        self.seed = 0
        """Seed of the episode."""
        self.shown: dict[str, NDArray[np.float32]] = {}
        """Observations of the last decision."""
        self._thought, self._times = 0, 0
        self._placed = np.zeros(objects, np.bool_)
        """True for each object that this agent itself has brought to its goal, [K]."""

    def require_body(self, body: str) -> None:
        """Check that the robot is the one that the network was trained with.

        Raises:
            FormatError: The robot is another one.
        """
        if body != self.network.card.robot:
            raise FormatError(
                f"These weights drive the robot {self.network.card.robot}, the episode has {body}.",
                code="H3-POLICY-011",
            )

    def act(self, view: RearrangeView) -> Action:
        """Return the next action, sampled by the scores of the network."""
        card = self.network.card
        shown = observed(view, card)
        each, rest = encoded(shown, agent=card.agent, objects=card.objects, observations=card.observations)
        scores, state = self.network(each, rest, self.state, shown)
        # several choices may be made in one step, and each needs random numbers of its own
        self._times = self._times + 1 if view.step == self._thought else 0
        self._remember(view)
        may = allowed(view, self.choices, placed=self._placed if self.network.sees else None) & self.network.offered
        self.shown = shown
        number = self.choose(view, each, rest, np.where(may, scores, -np.inf))
        self.state, self._thought = state, view.step
        return self.choices[number]

    def _remember(self, view: RearrangeView) -> None:
        """Take in what the action that has just ended did with its object."""
        done = view.last is not None and view.last.outcome == "done"
        if done and view.action is not None and view.action.skill in ("pick", "place"):
            self._placed[view.action.target] = view.action.skill == "place"

    def choose(self, view: RearrangeView, each: Array, rest: Array, scores: Array) -> int:
        """Return the number of a choice, given the network's inputs and scores; forbidden choices score minus infinity."""
        # Gumbel noise (Gumbel 1954): the largest sum is a sample of the softmax of the scores
        rng = generator(self.seed, f"choices/{view.agent}", world=self._times, step=view.step)
        return int(np.argmax(scores / self.network.card.temperature + rng.gumbel(size=len(scores))))

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason to interrupt the running action and choose again; empty if there is none."""
        action = view.action
        if action is None or action.skill not in ("nav_to_object", "nav_to_goal"):
            return ""
        taken = view.held_by[action.target] not in (NOBODY, view.agent)
        if action.skill == "nav_to_object" and taken and not self.network.sees:
            return "object_taken"
        since = view.step - self._thought
        # of no other agent the place is NaN, which is never below
        if since >= ALERT_STEPS and np.hypot(*(view.other_xz - view.xz)) < ALERT_M:
            return "agents_close"
        return "replanned" if since >= self.network.card.hold else ""


def observed(view: RearrangeView, card: PolicyCard) -> dict[str, NDArray[np.float32]]:
    """Return the observations of a chooser by name: numbers [n], and pictures of its camera.

    Raises:
        InputError: The network observes pictures, and the view takes none.
    """
    shown = observe(view, [name for name in card.observations if name in SENSES])
    taken = [name for name in card.observations if name not in SENSES]
    if taken and view.observe is None:
        raise InputError("This policy sees, and nobody takes pictures here.", code="H3-POLICY-066")
    return shown | view.observe(taken, size=card.picture_size) if taken and view.observe else shown


def allowed(
    view: RearrangeView, known: Sequence[Action], *, placed: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Return which actions are useful in a state, as bool [C].

    With an empty hand these are the actions on objects that lie about and are not at their goals; with an object in
    hand, those that bring it to its goal. Where the agent has just arrived, it may pick or place but not navigate
    again; it may always continue the action that it has begun, or take one without an object. An agent with a camera,
    for which ``placed`` [K] is given, knows only its own hand and the objects that it has itself brought to their
    goals. It does not know whether the others are free to take.
    """
    held, empty = view.held_by, not (view.held_by == view.agent).any()
    free = (held == NOBODY) & ~view.at_goal if placed is None else (held != view.agent) & ~placed
    done = view.action if view.last is not None and view.last.outcome == "done" else None
    begun = view.action if view.last is not None and view.last.outcome == "aborted" else None
    found = np.ones(len(known), np.bool_)
    for number, (skill, k, *_) in enumerate(known):
        if k < 0:
            continue
        # each handling skill belongs to the navigation that leads to it
        came = {"pick": "nav_to_object", "place": "nav_to_goal"}.get(skill, skill)
        arrived = done is not None and (done.skill, done.target) == (came, k)
        going_on = begun is not None and (begun.skill, begun.target) == (skill, k)
        may = empty and free[k] if came == "nav_to_object" else held[k] == view.agent
        found[number] = may and (arrived != (skill == came) or going_on)
    return found
