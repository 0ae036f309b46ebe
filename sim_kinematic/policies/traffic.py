"""Agents that wander in one world and make way for each other.

Paths, right of way, maneuvers and the test for contact are those of rearrangement (`RobotActor`, `PersonActor`, `GivingWay`).
The agents act on a copy of the world's state, one after the other; the world then makes the same step.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.gestures import lead_hands
from h3data.bodies.people.sitting import take_seats
from h3data.geometry import Array, pose_multiply
from h3data.scene import FreeSpace
from sim_kinematic.agents.arm_tuck import draw_arms
from sim_kinematic.agents.giving_way import GivingWay
from sim_kinematic.agents.person import Frame, MotionResult, Person
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.skills import Objects, Skill, SkillResult
from sim_kinematic.avoidance.right_of_way import RightOfWay
from sim_kinematic.contact.frames import root_pose, walking_phase
from sim_kinematic.motion.spec import ArmRoomSpec
from sim_kinematic.motion.state import HumanState, WorldState
from sim_kinematic.policies.policy import GaitAction, Velocity
from sim_kinematic.world import World


class RobotTrafficAgent(RobotActor):
    """Robot that drives from goal to goal."""

    def go_to(self, goal: NDArray[np.float64]) -> Skill:
        """Drive to a floor point [2]."""
        # A robot that wanders has reached its goal within this distance
        arrived_m = 0.3
        return self.drive_to(goal, within_m=arrived_m)

    def follow(self, state: WorldState) -> None:
        """Do nothing, because the actor's arrays are views of the copied state, which already has the robot's pose."""

    def choice(self) -> Velocity:
        """Return the step that the robot has just made."""
        return Velocity(0.0, 0.0) if self.hindered_by else Velocity(*self.command)


class WalkingAgent(PersonActor):
    """Person who walks about, posed by the motion clip that the world plays."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.figure = cast("ClipBody", self.person)

    @property
    def xz(self) -> NDArray:
        """Position on the floor [2] [m]."""
        return self.figure.gait.xz[0].copy()

    @property
    def heading(self) -> float:
        """Heading of the person [rad]."""
        return self.figure.gait.heading.item(0)

    def go_to(self, goal: NDArray[np.float64]) -> Skill:
        """Walk to a floor point [2], or give up where another agent blocks the path."""
        yield from self._walk(goal)
        return SkillResult("done")

    def follow(self, state: WorldState) -> None:
        """Take over the place of the person, and their phase in the walking cycle, from the world."""
        own = state.agents[self.number]
        assert isinstance(own, HumanState)
        self._gait = self.figure.gait = own.copy()

    def choice(self) -> GaitAction:
        """Return the step that the person has just made."""
        return GaitAction(self.figure.gait)

    def _go_aside(self, towards: NDArray) -> None:
        """Walk one step towards a floor point [2], after turning to it: in clips people walk ahead only."""
        self._pace(towards)

    def _posture(self) -> Any:
        return self.figure.gait.copy()

    def _take(self, posture: Any) -> None:
        self.figure.gait = posture


class ClipBody:
    """Body with the part of `Person`'s interface that walking needs, posed by a motion clip."""

    look_at = None

    def __init__(self, body: Humanoid, clip: int, free: FreeSpace, arms: ArmRoomSpec | None) -> None:
        self.body, self._clip, self._free, self._arms = body, clip, free, arms
        self.gait, self.held = HumanState.zeros(1), {}
        self.stands, self.walk = True, self
        self._posed: tuple[HumanState, Array, Array] | None = None

    @property
    def base(self) -> Array:
        """Pose (pose7) of the agent root [7]."""
        return root_pose(self.body, self.gait.xz[0], self.gait.heading.item(0), self._free)

    @property
    def quats(self) -> Array:
        """Local rotations of the joints (quaternions xyzw), [55, 4]."""
        return self._pose()[0]

    @property
    def pelvis(self) -> Array:
        """Position of the pelvis in the agent root frame [3] [m]."""
        return self._pose()[1]

    @property
    def speed_mps(self) -> float:
        """Infinite speed [m/s], with which people who step aside set off at once, because the clip is blended."""
        return np.inf

    def stride(self, gait: HumanState | None = None) -> None:
        """Move the body by one step of its walk."""
        if gait is not None:
            self.gait = gait.copy()
            draw_arms(self.gait, self._free, self.body, self._arms)

    def turn(self, heading: float, *, settles: bool = True) -> Generator[None, None, MotionResult]:
        """Do nothing: `sim_kinematic.motion.gait.walk_humans` turns people before they walk."""
        yield from ()
        return MotionResult(success=True)

    def frame(self) -> Frame:
        """Return the state of the body in this step."""
        root = pose_multiply(self.base, np.concatenate([self.pelvis, self.quats[0]]))
        return Frame(self.base, root, self.quats[1:], {})

    def _pose(self) -> tuple[Array, Array]:
        """Return local rotations [55, 4] and the pelvis [3], computed only when an agent is near enough to need them."""
        # compared by identity: every step makes another gait, and comparing arrays costs more
        if self._posed is None or self._posed[0] is not self.gait:
            phase = walking_phase(self.body, self._clip, self.gait)
            quats, pelvis = self.body.clip_pose([self._clip], phase, self.gait.blend, arms=self.gait.arms)
            # as the world poses people of crowds, who sit and handle things: a leg that leans is elsewhere
            take_seats(self.body, quats, pelvis, self.gait.seat)
            lead_hands(self.body, quats, pelvis, self.gait.hands)
            self._posed = self.gait, quats[0], pelvis[0]
        return self._posed[1:]


class Traffic:
    """All agents of one world; the agents that wander choose their steps here."""

    def __init__(self, world: World, row: int, floors: Sequence[FreeSpace]) -> None:
        """Create the traffic of world number ``row``, whose agents find their paths on ``floors``."""
        self._world, self._row, self._step = world, row, -1
        # a list of rows copies: by a slice, the agents would move in the world itself
        self._state = world.state.take([row])
        self._objects = Objects((), np.zeros((0, 3)), self._state)
        self.actors = [self._actor(number, floor) for number, floor in enumerate(floors)]
        for actor in self.actors:
            actor.follow(self._state)
        several = len(self.actors) > 1
        rule = RightOfWay(world.floors[row], self.actors) if several else None
        self._company = GivingWay(world.roster, self.actors, rule, agreed=several, people_see_robot=True, in_clips=True)
        for actor in self.actors:
            # until it takes its first turn: an agent that follows another policy makes way for nobody
            actor.yields = False
            self._company.end_turn(actor.number)

    def _actor(self, number: int, floor: FreeSpace) -> RobotTrafficAgent | WalkingAgent:
        world, body = self._world, self._world.roster[number].body
        if isinstance(body, Robot):
            # arms stay folded: the hand reaches nothing, and whatever has unfolded them, they fold at 8 rad/s
            return RobotTrafficAgent(body, floor, world.bases[number], self._objects, 0.0, 8.0, number)
        figure = ClipBody(body, world.clips[number], floor, world.walker.arms)
        return WalkingAgent(cast(Person, figure), floor, world.walker, self._objects, number)

    def begin_turn(self, number: int, step: int) -> RobotTrafficAgent | WalkingAgent:
        """Return an agent in its present state, with its observations of the others."""
        if step != self._step:
            self._begin_step(step)
        actor = self.actors[number]
        actor.yields = True
        actor.hindered_by = frozenset()
        return actor

    def end_turn(self, number: int) -> None:
        """Note that an agent has made its step, so that others observe its new place."""
        self._company.end_turn(number)

    def _begin_step(self, step: int) -> None:
        """Copy the state that the world has reached, and decide who steps aside in the step that begins."""
        # the world has moved everybody, agents of other policies included
        for mine, theirs in zip(self._state.arrays(), self._world.state.arrays(), strict=True):
            # in place: the actors' arrays are views of these
            mine[0] = theirs[self._row]
        for actor in self.actors:
            actor.follow(self._state)
            if isinstance(own := self._state.agents[actor.number], HumanState):
                self._company.widen(actor.number, bool(own.seat[0, 1] > 1 or own.hands[0, :, 3].any()))
            self._company.end_turn(actor.number)
        if self._step >= 0:
            self._company.end_step()
        self._step = step
        self._company.begin_step()
