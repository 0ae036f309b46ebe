"""Policies that walk or drive from one random point of the home to another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.scene import FreeSpace
from sim_kinematic.agents.skills import Skill
from sim_kinematic.agents.waypoint_walker import WaypointHuman
from sim_kinematic.avoidance.yielding import NO_PATH
from sim_kinematic.motion.spec import WalkerSpec
from sim_kinematic.policies.policy import GaitAction, PoseAction, Velocity, WaypointAction
from sim_kinematic.policies.traffic import RobotTrafficAgent, WalkingAgent
from sim_kinematic.policies.views import AgentView


class WaypointPolicy(WaypointHuman):
    """Scripted person of social navigation, who walks shortest paths to random points and avoids nobody.

    The script follows the paper (section 4.1).
    """

    def act(self, view: AgentView) -> WaypointAction | PoseAction:
        """Return the waypoint to walk to, or the next stride."""
        return self.move(np.asarray(view.xz, np.float64), view.heading)

    def move(self, xz: NDArray[np.float64], heading: float) -> WaypointAction | PoseAction:
        """Return the choice for a position ``xz`` [2] and a heading, which are all the inputs of this policy."""
        if self.spec.stride is None:
            return WaypointAction(self.target(xz))
        x, z, turned = self.stride(xz, heading)
        return PoseAction(np.array([x, z]), turned)


class WanderPolicy:
    """Robot or person that moves between random points and avoids others (`sim_kinematic.policies.traffic`)."""

    takes_agent_view = True

    def __init__(self, free: FreeSpace, seed: int, walker: WalkerSpec) -> None:
        self._goals = WaypointHuman(free, seed, walker)
        self._going: Skill | None = None

    def act(self, view: AgentView) -> GaitAction | Velocity:
        """Return a step of the gait for a person, or a velocity for a robot."""
        traffic = view.traffic()
        actor = traffic.begin_turn(view.agent, view.step)
        # largest number of goals that are tried in one step, as some of them may have been reached already
        attempts = 3
        # a goal that has been reached already takes no step, so the next one is tried at once
        if not any(self._goes_on(actor) for _ in range(attempts)):
            actor.idle()
        traffic.end_turn(view.agent)
        return actor.choice()

    def _goes_on(self, actor: RobotTrafficAgent | WalkingAgent) -> bool:
        """Make the next step to the goal, else to another goal, and return whether there was a step to make."""
        if self._going is None:
            # the path to the last goal would else be taken for the one to the next
            actor.path = NO_PATH
            self._going = actor.go_to(self._goals.next_goal(actor.xz))
        try:
            next(self._going)
        except StopIteration:
            self._going = None
        return self._going is not None
