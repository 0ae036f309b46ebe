"""What the agents of rearrangement see of each other, and which of them touch."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.geometry import Array
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.robot_skills import RobotActor
from sim_kinematic.agents.roster import AgentSpec
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.yielding import Seen
from sim_kinematic.contact import AgentContacts
from sim_kinematic.contact.clearance import robot_span
from sim_kinematic.contact.frames import body_shapes, shape_frames
from sim_kinematic.motion.spec import STEP_S

AnyActor = RobotActor | PersonActor


class AgentContactTracker:
    """All actors of an episode, where they have been, and which of them touch."""

    def __init__(self, roster: Sequence[AgentSpec], actors: Sequence[AnyActor]) -> None:
        self.actors = actors
        self.tracks = [[actor.xz.copy()] for actor in actors]
        """Where each agent was at the start and at the end of every step."""
        self.touching: list[tuple[int, int]] = []
        """Pairs of agents that touched at the end of the last step."""
        self._bodies = [agent.body for agent in roster]
        self._contacts = AgentContacts(*(body_shapes(body) for body in self._bodies))
        longer = [
            robot_span(body) - AVOIDANCE.contact_span_m if isinstance(body, Robot) else 0 for body in self._bodies
        ]
        self._reach_m = [AVOIDANCE.contact_gate_m / 2 + max(extra, 0.0) for extra in longer]
        self._posed: set[int] = set()
        self._settled: set[int] = set()

    def nearest(self, number: int) -> int:
        """Returns the agent nearest to another, -1 if it is alone."""
        me = self.actors[number]
        others = [actor for actor in self.actors if actor is not me]
        return min(others, key=lambda other: float(np.hypot(*(other.xz - me.xz)))).number if others else -1

    def avoids(self, me: AnyActor, other: AnyActor) -> bool:
        """Whether an agent avoids another: all do, but a person alone with one robot does not (as in Habitat)."""
        alone = len(self.actors) == 2 and isinstance(me, PersonActor) and isinstance(other, RobotActor)
        return other is not me and not alone

    def show(self, me: AnyActor) -> None:
        """Shows an agent the others: where they are and how they move."""
        seen = []
        for other, track in zip(self.actors, self.tracks, strict=True):
            if not self.avoids(me, other):
                continue
            # people act first, then robots, each in the order of their numbers
            moved = (not other.is_robot and me.is_robot) or (other.is_robot == me.is_robot and other.number < me.number)
            steps = AVOIDANCE.velocity_steps
            recent = [*track[-steps:], other.xz.copy()] if moved else track[-steps - 1 :]
            velocity = (recent[-1] - recent[0]) / (STEP_S * max(len(recent) - 1, 1))
            steps_aside = me.agreed and other.yields and not len(other.path)
            settled = other.number in self._settled
            seen.append(
                Seen(
                    other.number, recent[-1], velocity, settled, other.is_robot, other.heading, steps_aside, other.footprint
                )
            )  # fmt: skip
        me.others = tuple(sorted(seen, key=lambda other: float(np.hypot(*(other.xz - me.xz)))))

    def moved(self, number: int) -> None:
        """Notes that an agent has acted and is somewhere else."""
        self._posed.discard(number)

    def meets(self, me: AnyActor) -> bool:
        """Whether an agent in its present posture touches another that it avoids and did not touch before."""
        near = [
            other for other in self.actors
            if self.avoids(me, other) and self._is_near(me, other)
            and (min(me.number, other.number), max(me.number, other.number)) not in self.touching
        ]  # fmt: skip
        if not near:
            return False
        for actor in near:
            self._pose(actor)
        self.moved(me.number)
        self._pose(me)
        self.moved(me.number)
        met = [other.number for other in near if self._contacts.collides(*sorted((me.number, other.number)))]
        me.hindered_by |= frozenset(met)
        return bool(met)

    def end_step(self) -> None:
        """Notes where all agents are after a step, and which of them touch."""
        for track, actor in zip(self.tracks, self.actors, strict=True):
            track.append(actor.xz.copy())
            recent = np.array(track[-AVOIDANCE.still_steps :])
            stays = len(recent) == AVOIDANCE.still_steps and float(np.ptp(recent, axis=0).max()) < AVOIDANCE.still_m
            (self._settled.add if stays else self._settled.discard)(actor.number)
        near = [(a.number, b.number) for a, b in combinations(self.actors, 2) if self._is_near(a, b)]
        for number in sorted({number for pair in near for number in pair}):
            self._pose(self.actors[number])
        self.touching = [pair for pair in near if self._contacts.collides(*pair)]

    def _is_near(self, a: AnyActor, b: AnyActor) -> bool:
        """Whether two agents could touch with their arms stretched out."""
        return bool(np.hypot(*(a.xz - b.xz)) <= self._reach_m[a.number] + self._reach_m[b.number])

    def _pose(self, actor: AnyActor) -> None:
        """Brings an agent's shapes to where recordings, which are float32, put them."""
        if actor.number in self._posed:
            return
        body = self._bodies[actor.number]
        if isinstance(actor, RobotActor):
            posed = actor.robot.link_matrices(_stored(actor.pose)[None], _stored(actor.joints)[None])
        else:
            frame = actor.person.frame()
            posed = actor.person.body.joint_matrices_free(_stored(frame.root)[None], _stored(frame.joints)[None])
        self._contacts.update(actor.number, shape_frames(body, posed)[0])
        self._posed.add(actor.number)


def _stored(values: Array) -> NDArray[np.float64]:
    """Returns values as read back from float32."""
    return values.astype(np.float32).astype(np.float64)
