"""Mutual attention of the agents of one world: how they observe each other, give way, and touch.

Agents move one after the other. The module is used by agents with skills and by agents that wander
(`sim_kinematic.policies.traffic`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.geometry import Array
from h3data.kernels import kernel
from h3data.kernels.entries import Entries
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.roster import AgentSpec
from sim_kinematic.avoidance.right_of_way import RightOfWay
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.yielding import Neighbours
from sim_kinematic.contact import AgentContacts
from sim_kinematic.contact.body_capsules import AgentCapsules, may_touch
from sim_kinematic.contact.clearance import LYING_M, clip_reach, robot_span
from sim_kinematic.contact.frames import body_shapes, shape_frames
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.motion.step import APART_TOLERANCE_M, discs_at

AnyActor = RobotActor | PersonActor
_CALL = Entries()
_STILL = AVOIDANCE.still_steps, AVOIDANCE.still_m


class GivingWay:
    """Mutual attention of all actors of one world: their positions, their contacts, and the agents that step aside."""

    def __init__(
        self,
        roster: Sequence[AgentSpec],
        actors: Sequence[AnyActor],
        right_of_way: RightOfWay | None = None,
        *,
        agreed: bool = False,
        people_see_robot: bool = False,
        person_radius_m: float = 0.0,
        solid: bool = False,
        in_clips: bool = False,
    ) -> None:
        """Introduce actors to each other, and set this object as the ``company`` of each.

        Args:
            roster: agents of the world.
            actors: the same agents, by number.
            right_of_way: rules that send agents aside; None: no agent is asked to step aside.
            agreed: whether all agents step aside for each other when they are asked.
            people_see_robot: whether a person with one robot avoids it.
            person_radius_m: radius of a person's disc.
            solid: whether people who are driven from outside slide along the discs of other agents.
            in_clips: whether people move as in their motion clips, so that their hands stay near; `widen` tells when not.
        """
        self.actors, self.right_of_way, self.agreed, self.solid = actors, right_of_way, agreed, solid
        self.neighbours = Neighbours.of(actors)
        """All agents as they were after their last turns, which the others observe."""
        self._people_see_robot, self._person_radius_m = people_see_robot, person_radius_m
        self._avoided = [
            [(b.number, (min(a.number, b.number), max(a.number, b.number))) for b in actors if self.avoids(a, b)]
            for a in actors
        ]
        """Agents that each one avoids, each with the pair of both numbers."""
        heeded = np.array([[self.avoids(me, other) for other in actors] for me in actors])
        self._around = [self.neighbours._replace(heeded=row, agreed=agreed) for row in heeded]
        for actor in actors:
            actor.company = self
        self.touching: list[tuple[int, int]] = []
        """Pairs of agents that touched at the end of the last step."""
        self._moments = 1
        # 1024: rows that a track begins with; episodes of 750 steps never need more
        self._places = np.empty((len(actors), 1024, 2))
        """One track for each agent, of which the first `_moments` rows are filled."""
        for track, actor in zip(self._places, actors, strict=True):
            track[0] = actor.xz
        self._pairs = list(combinations(range(len(actors)), 2))
        self.bodies = [agent.body for agent in roster]
        self._capsules = [AgentCapsules(body) for body in self.bodies]
        # the gate allows for `quad_arm`; each agent has half of it, and a longer robot what it is longer
        self._reach_m = [AVOIDANCE.contact_gate_m / 2 for _ in self.bodies]
        """Distance from its place within which an agent may touch others [m]."""
        for k, body in enumerate(self.bodies):
            if isinstance(body, Robot):
                self._reach_m[k] += max(robot_span(body) - AVOIDANCE.contact_span_m, 0.0)
            elif in_clips:
                self._reach_m[k] = min(clip_reach(body), self._reach_m[k])
        self._reaches = np.array(self._reach_m)
        self._asked: dict[tuple[int, int], tuple[tuple[Any, ...], bool]] = {}
        """Postures and roots of two agents when it was last asked whether they touch, and the answer."""
        self._postures: list[Any] = [None] * len(actors)
        """Postures to which the capsules around agents were last moved."""
        self.at: list[tuple[float, float, float]] = [(0.0, 0.0, 0.0)] * len(actors)
        """Place ``(x, z, heading)`` of each agent; for the agent whose turn it is, the place before that."""
        for actor in actors:
            self.end_turn(actor.number)

    @cached_property
    def _contacts(self) -> AgentContacts:
        """Shapes of FCL, made when two agents first come near enough to need them, which is rare."""
        return AgentContacts(*(body_shapes(body) for body in self.bodies))

    def track(self, number: int) -> NDArray[np.float64]:
        """Return the positions of an agent at the start and at the end of every step, [T + 1, 2] [m]; a view."""
        return self._places[number, : self._moments]

    def nearest(self, number: int) -> int:
        """Return the agent nearest to another, -1 if it is alone."""
        if len(self.actors) < 3:
            return 1 - number if len(self.actors) == 2 else -1
        me, others = self.actors[number], [actor for actor in self.actors if actor.number != number]
        return min(others, key=lambda other: float(np.hypot(*(other.xz - me.xz)))).number

    def avoids(self, me: AnyActor, other: AnyActor) -> bool:
        """Return whether an agent avoids another; only a person with one robot under Habitat's rules avoids nobody."""
        alone = (
            len(self.actors) == 2
            and not self._people_see_robot
            and isinstance(me, PersonActor)
            and isinstance(other, RobotActor)
        )
        return other is not me and not alone

    def begin_step(self, carrying: Sequence[int] = ()) -> None:
        """Decide which agents step aside in the next step; ``carrying`` are the numbers of those with an object."""
        if self.right_of_way is not None:
            self.right_of_way.update(self.neighbours.agents, carrying)

    def around(self, number: int) -> Neighbours:
        """Return all agents as others observe them, and which of them an agent gives way to."""
        found = self._around[number]
        return found if found.agreed == self.agreed else found._replace(agreed=self.agreed)

    def end_turn(self, number: int) -> None:
        """Note where an agent is after its turn, which is what the others observe of it until its next one."""
        actor = self.actors[number]
        (x, z), heading, start = actor.xz.tolist(), actor.heading, actor.path_start
        self.at[number] = here = x, z, heading
        # NumPy's, as kernels would compute other bits; people are one disc around their middle
        turned = (float(np.cos(heading)), float(np.sin(heading))) if actor.is_robot else (1.0, 0.0)
        path = (math.nan, math.nan) if start is None else start.tolist()
        flags, steps = (bool(actor.yields), bool(actor.hindered_by)), (self._moments, AVOIDANCE.velocity_steps)
        _CALL(_turn, self.neighbours.agents, self._places, *steps, number, *here, *turned, *path, *flags)

    def meets(self, me: AnyActor) -> bool:
        """Return whether an agent in its present posture touches another that it avoids and did not touch before."""
        here = me.xz.tolist()
        # who touched before may go on touching, or the two could never part
        met = [
            other
            for other, pair in self._avoided[me.number]
            if self._is_near(me.number, here, other) and pair not in self.touching and self._touch(*pair)
        ]
        if met:
            me.hindered_by |= frozenset(met)
        return bool(met)

    def discs_of(self, number: int) -> NDArray[np.float64]:
        """Return the discs ``(x, z, radius)`` [N, 3] of an agent in its present posture, without a robot's load."""
        actor, offsets, radius = self.actors[number], (0.0,), self._person_radius_m
        if isinstance(actor, RobotActor):
            offsets, radius = actor.empty_base.disc_offsets_m, actor.empty_base.disc_radius_m
        return discs_at(actor.xz[None], np.array([actor.heading]), offsets, radius)[0]

    def discs_beside(self, number: int) -> NDArray[np.float64]:
        """Return the present discs ``(x, z, radius)`` [N, 3] [m] of all agents except one."""
        discs = [self.discs_of(other.number) for other in self.actors if other.number != number]
        return np.concatenate([np.zeros((0, 3)), *discs])

    def comes_too_near(self, me: AnyActor) -> bool:
        """Return whether a person has come nearer in this step to the discs of other agents than allowed."""
        discs, was = self.discs_beside(me.number), self.track(me.number)[-1]
        # never more than the gap that there was: whoever is too near already may stay, and leave
        least = np.minimum(self._person_radius_m + discs[:, 2], np.hypot(*(discs[:, :2] - was).T))
        return bool((np.hypot(*(discs[:, :2] - me.xz).T) < least - APART_TOLERANCE_M).any())

    def frames(self) -> list[Array]:
        """Return the present world frames of the agents: robots' links [1, L, 4, 4], people's joints [1, 55, 4, 4]."""
        return [
            actor.robot.link_matrices(actor.pose[None], actor.joints[None])
            if isinstance(actor, RobotActor)
            else actor.person.joint_matrices[None]
            for actor in self.actors
        ]

    def end_step(self) -> None:
        """Store the places of all agents after a step, and the pairs of agents that touch."""
        if self._moments == self._places.shape[1]:
            self._places = np.concatenate([self._places, np.empty_like(self._places)], axis=1)
        self._moments += 1
        near = _CALL(_note, self._places, self._moments, self.neighbours.agents, self._reaches, *_STILL)
        self.touching = []
        if near:
            self.touching = [(a, b) for a, b in self._pairs if self._is_near(a, self.at[a], b) and self._touch(a, b)]

    def widen(self, number: int, wide: bool) -> None:
        """Note whether a person in clips reaches farther than in these now, because they lie or handle something."""
        self._reach_m[number] = self._reaches[number] = clip_reach(self.bodies[number]) + LYING_M * wide

    def _is_near(self, a: int, here: Sequence[float], b: int) -> bool:
        """Return whether an agent at (x, z) could touch another with their arms stretched out."""
        there = self.at[b]
        return math.hypot(here[0] - there[0], here[1] - there[1]) <= self._reach_m[a] + self._reach_m[b]

    def _touch(self, a: int, b: int) -> bool:
        """Return whether two agents touch as they are now."""
        one, other = self.actors[a], self.actors[b]
        now, was = (_posture(one), _root(one), _posture(other), _root(other)), self._asked.get((a, b))
        # asked at the end of a step, nobody has moved since the turn of the last agent
        if was is not None and all(map(_is_same, was[0], now)):
            return was[1]
        # capsules first, at a tenth of the cost of posing the shapes; they almost always decide
        touch = may_touch(self._gated(one, now[0]), now[1], self._gated(other, now[2]), now[3])
        if touch:
            self._pose(one)
            self._pose(other)
            touch = self._contacts.collides(a, b)
        self._asked[a, b] = now, touch
        return touch

    def _gated(self, actor: AnyActor, now: Any) -> AgentCapsules:
        """Return the capsules around an agent in its present posture ``now``."""
        capsules = self._capsules[actor.number]
        if not _is_same(self._postures[actor.number], now):
            self._postures[actor.number] = now
            if isinstance(actor, RobotActor):
                capsules.pose(actor.joints)
            else:
                capsules.pose(actor.person.quats, actor.person.pelvis)
        return capsules

    def _pose(self, actor: AnyActor) -> None:
        """Bring an agent's shapes to where recordings, which are float32, put them."""
        body = self.bodies[actor.number]
        if isinstance(actor, RobotActor):
            posed = actor.robot.link_matrices(_stored(actor.pose)[None], _stored(actor.joints)[None])
        else:
            frame = actor.person.frame()
            posed = actor.person.body.joint_matrices_free(_stored(frame.root)[None], _stored(frame.joints)[None])
        self._contacts.update(actor.number, shape_frames(body, posed)[0])


def _posture(actor: AnyActor) -> Any:
    """Return what tells the present posture of an agent from others, wherever it is."""
    # by value of robots, whose joints are changed in place; whatever poses a person makes a new array
    return actor.joints.tobytes() if isinstance(actor, RobotActor) else actor.person.quats


def _is_same(was: Any, now: Any) -> bool:
    """Return whether a posture or a root is the one of before: whatever moves an agent makes a new array."""
    return was is now or (isinstance(now, bytes) and was == now)


def _root(actor: AnyActor) -> Array:
    """Return the pose (pose7) of an agent root [7]."""
    return actor.pose if isinstance(actor, RobotActor) else actor.person.base


@kernel(error_model="numpy")
def _turn(agents, places, moments, count, k, x, z, heading, c, s, start_x, start_z, yields, hindered):
    """Write what a turn changes of agent ``k``: place, velocity over ``count`` steps, start of its path, and two flags."""
    row, first = agents[k], max(moments - count, 0)
    seconds = STEP_S * max(moments - first, 1)
    row["x"], row["z"], row["heading"], row["cos"], row["sin"] = x, z, heading, c, s
    row["velocity_x"], row["velocity_z"] = (x - places[k, first, 0]) / seconds, (z - places[k, first, 1]) / seconds
    row["start_x"], row["start_z"], row["yields"], row["hindered"] = start_x, start_z, yields, hindered


@kernel(error_model="numpy")
def _note(places, moments, agents, reach, count, still):
    """Add where agents [N] are to their tracks [N, T, 2], and note which have been standing for ``count`` steps.

    Returns whether two of them are within the sum of their ``reach`` [N] [m].
    """
    near = False
    for n in range(len(agents)):
        settled = moments >= count
        places[n, moments - 1, 0], places[n, moments - 1, 1] = agents[n]["x"], agents[n]["z"]
        for axis in range(2):
            low = high = places[n, moments - 1, axis]
            # the oldest first: of who moves, it is the farthest away
            for t in range(max(moments - count, 0), moments):
                low, high = min(low, places[n, t, axis]), max(high, places[n, t, axis])
                if not settled or high - low >= still:
                    settled = False
                    break
        agents[n]["settled"] = settled
        for other in range(n):
            gap_x, gap_z = agents[other]["x"] - agents[n]["x"], agents[other]["z"] - agents[n]["z"]
            near |= math.hypot(gap_x, gap_z) <= reach[n] + reach[other]
    return near


def _stored(values: Array) -> NDArray[np.float64]:
    """Return values as read back from float32."""
    return values.astype(np.float32).astype(np.float64)
