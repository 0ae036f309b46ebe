"""What the agents of rearrangement see of each other, and whether they touch."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.robot_skills import RobotActor
from sim_kinematic.agents.roster import AgentSpec
from sim_kinematic.avoidance.velocity import AVOIDANCE
from sim_kinematic.avoidance.yielding import Seen
from sim_kinematic.contact import AgentContacts
from sim_kinematic.contact.frames import body_shapes, shape_frames
from sim_kinematic.motion.spec import STEP_S

VELOCITY_STEPS = 3
"""Over so many steps one measures how fast another moves."""
CONTACT_GATE_M = 2.0
"""Bases farther apart than this on the floor cannot touch, arms stretched out."""

AnyActor = RobotActor | PersonActor


class Encounters:
    """All actors of an episode, where they have been, and who touches whom."""

    def __init__(self, cast: Sequence[AgentSpec], actors: Sequence[AnyActor]) -> None:
        self.actors = actors
        self.tracks = [[actor.xz.copy()] for actor in actors]
        """Where each was at the end of every step, and at the beginning."""
        self.touching: list[tuple[int, int]] = []
        """Pairs of agents that touched at the end of the last step."""
        self._bodies = [member.body for member in cast]
        self._contacts = AgentContacts(*(body_shapes(body) for body in self._bodies))
        self._posed: set[int] = set()
        self._settled: set[int] = set()

    def nearest(self, number: int) -> int:
        """The agent nearest to another, -1 if it is alone."""
        me = self.actors[number]
        others = [actor for actor in self.actors if actor is not me]
        return min(others, key=lambda other: float(np.hypot(*(other.xz - me.xz)))).number if others else -1

    def heeds(self, me: AnyActor, other: AnyActor) -> bool:
        """Everybody heeds everybody, but for a person with one robot: she goes on as Habitat's."""
        alone = len(self.actors) == 2 and isinstance(me, PersonActor) and isinstance(other, RobotActor)
        return other is not me and not alone

    def show(self, me: AnyActor) -> None:
        """An agent sees who else is there and how they move."""
        seen = []
        for other, track in zip(self.actors, self.tracks, strict=True):
            if not self.heeds(me, other):
                continue
            # people act first, then robots, each in the order of their numbers
            moved = (not other.is_robot and me.is_robot) or (other.is_robot == me.is_robot and other.number < me.number)
            recent = [*track[-VELOCITY_STEPS:], other.xz.copy()] if moved else track[-VELOCITY_STEPS - 1 :]
            velocity = (recent[-1] - recent[0]) / (STEP_S * max(len(recent) - 1, 1))
            steps_aside = me.agreed and other.yields and not len(other.way)
            seen.append(
                Seen(
                    other.number, recent[-1], velocity, other.number in self._settled, other.is_robot, other.heading,
                    steps_aside,
                )
            )  # fmt: skip
        me.others = tuple(sorted(seen, key=lambda other: float(np.hypot(*(other.xz - me.xz)))))

    def moved(self, number: int) -> None:
        """An agent has acted: it is somewhere else."""
        self._posed.discard(number)

    def meets(self, me: AnyActor) -> bool:
        """Whether an agent, as it is now, touches somebody whom it heeds and has not touched before."""
        near = [
            other for other in self.actors
            if self.heeds(me, other) and np.hypot(*(other.xz - me.xz)) <= CONTACT_GATE_M
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
        """Everybody has acted: note where they are and who touches whom."""
        for track, actor in zip(self.tracks, self.actors, strict=True):
            track.append(actor.xz.copy())
            long = np.array(track[-AVOIDANCE.still_steps :])
            stays = len(long) == AVOIDANCE.still_steps and float(np.ptp(long, axis=0).max()) < 0.01
            (self._settled.add if stays else self._settled.discard)(actor.number)
        near = [
            (a.number, b.number) for a, b in combinations(self.actors, 2) if np.hypot(*(a.xz - b.xz)) <= CONTACT_GATE_M
        ]
        for number in sorted({number for pair in near for number in pair}):
            self._pose(self.actors[number])
        self.touching = [pair for pair in near if self._contacts.collides(*pair)]

    def _pose(self, actor: AnyActor) -> None:
        """Bring an agent's shapes to where they are in what is recorded, in float32."""
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
    """As float32 gives it back."""
    return values.astype(np.float32).astype(np.float64)
