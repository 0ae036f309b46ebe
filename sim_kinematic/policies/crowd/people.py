"""Policy of people who walk from goal to goal by a model of crowds (`sim_kinematic.crowd`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.scene import FreeSpace
from sim_kinematic.agents.waypoint_walker import WaypointHuman, walking_path
from sim_kinematic.crowd.crowd import CrowdModel
from sim_kinematic.crowd.traits import Traits
from sim_kinematic.motion.spec import WalkerSpec
from sim_kinematic.policies.crowd.crowds import CrowdMember, Crowds
from sim_kinematic.policies.policy import PoseAction
from sim_kinematic.policies.views import AgentView


class CrowdPolicy:
    """A person who walks to one random goal after another and avoids others by a model of crowds."""

    def __init__(self, model: CrowdModel, free: FreeSpace, seed: int, traits: Traits, walker: WalkerSpec) -> None:
        self._goals = WaypointHuman(free, seed, walker)
        self.member = CrowdMember(model=model, free=free, traits=traits, walker=walker, find_path=self._find_path)

    def act(self, view: AgentView) -> PoseAction:
        """Place after the next step."""
        return self.move(view.crowds(), view.agent, view.step)

    def move(self, crowds: Crowds, agent: int, step: int) -> PoseAction:
        """Place after step number ``step``, which the crowds of the person's world know: all that this policy needs."""
        return crowds.move(self.member, agent, step)

    def _find_path(self, xz: NDArray[np.float64]) -> NDArray[np.float64]:
        return walking_path(self.member.free, xz, self._goals.next_goal(xz), self.member.walker)
