"""Learned policies of the upper layer of rearrangement, which choose the action that a network scores highest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_kinematic.agents.skills import Action, choices
from sim_kinematic.policies.choosers.chooser_network import SkillPolicyNetwork
from sim_kinematic.policies.choosers.recurrent_chooser import RecurrentSkillPolicy
from sim_kinematic.policies.learned import naming, network_of, require, trained_for
from sim_kinematic.policies.network import Network
from sim_kinematic.policies.rearrange_observations import SENSES, observe
from sim_kinematic.policies.views import RearrangeView


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
