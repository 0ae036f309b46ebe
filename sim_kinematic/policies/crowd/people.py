"""Policy of people who walk from goal to goal by a model of crowds (`sim_kinematic.crowd`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.scene import FreeSpace
from sim_kinematic.agents.waypoint_walker import WaypointHuman, walking_path
from sim_kinematic.crowd.crowd import CrowdModel
from sim_kinematic.crowd.errands import Agenda, Errand, HandWork
from sim_kinematic.crowd.roles import ALONE, Role
from sim_kinematic.crowd.traits import sample_traits
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.motion.spec import WalkerSpec
from sim_kinematic.policies.crowd.crowds import CrowdMember, Crowds
from sim_kinematic.policies.policy import PoseAction
from sim_kinematic.policies.views import AgentView


class CrowdPolicy:
    """A person who walks to one random goal after another and avoids others by a model of crowds."""

    def __init__(
        self,
        model: CrowdModel,
        free: FreeSpace,
        seed: int,
        number: int,
        walker: WalkerSpec,
        role: Role = ALONE,
        routine: Agenda | None = None,
    ) -> None:
        """Create the policy of agent ``number`` in the episode with a seed, which determines the person's traits.

        A person with a routine follows it; others walk from one random goal to another.
        """
        self._routine = routine
        # a seed of their own: with the episode's, all people would walk to the same goals
        self._goals = WaypointHuman(free, episode_seed(seed, number), walker)
        traits = sample_traits(seed, number, walker.speed_mps)
        self.member = CrowdMember(
            model=model,
            free=free,
            traits=traits,
            walker=walker,
            guide=self._guide,
            role=role,
            seed=seed,
            hands=None if routine is None else routine.hands,
            daily=routine is not None,
        )

    @property
    def hands(self) -> HandWork | None:
        """State of the person's hands; None: they handle nothing."""
        return self.member.hands

    @property
    def sits(self) -> bool:
        """Return whether the person may sit down."""
        return self._routine is not None

    def act(self, view: AgentView) -> PoseAction:
        """Return the place of the person after the next step."""
        return self.move(view.crowds(), view.agent, view.step)

    def move(self, crowds: Crowds, agent: int, step: int) -> PoseAction:
        """Return the place after step number ``step``, computed by the crowds of the person's world."""
        return crowds.move(self.member, agent, step)

    def repeat(self, version: int) -> None:
        """Decide by a version of the rules (`sim_kinematic.crowd.crowd.VERSION`), as in a recording."""
        self.member = replace(self.member, version=version)
        self._routine = None if self._routine is None else self._routine.follow(version)

    @property
    def facts(self) -> dict[str, Any]:
        """Facts about the person in recordings (`CrowdMember.facts`), and the stops of their routine."""
        return self.member.facts | {"routine": [list(stop) for stop in self._routine.stops] if self._routine else []}

    def _guide(self, xz: NDArray[np.float64], goal: NDArray[np.float64] | None, taken: Sequence[Array]) -> Errand:
        if goal is None and self._routine is not None:
            stop = self._routine.next_stop(xz, taken)
            if stop is not None:
                return stop[1]._replace(path=walking_path(self.member.free, xz, stop[0], self.member.walker))
        return Errand(
            walking_path(self.member.free, xz, self._goals.next_goal(xz) if goal is None else goal, self.member.walker)
        )
