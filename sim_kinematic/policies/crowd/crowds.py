"""Crowds of one world, which the policies of their people share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from h3data.geometry import Array, pose_multiply
from h3data.recording import Event
from h3data.scene import FreeSpace
from sim_kinematic.contact.frames import root_pose
from sim_kinematic.crowd.crowd import VERSION, Crowd, CrowdModel
from sim_kinematic.crowd.errands import Guide, HandWork, Station
from sim_kinematic.crowd.roles import Role
from sim_kinematic.crowd.seating import APART_M, LIES_APART_M
from sim_kinematic.crowd.traits import Traits
from sim_kinematic.motion.spec import WalkerSpec
from sim_kinematic.motion.step import discs_at
from sim_kinematic.policies.policy import PoseAction
from sim_kinematic.world import World


@dataclass(frozen=True, kw_only=True, eq=False)
class CrowdMember:
    """Person of a crowd: their model, place, role and next activity."""

    model: CrowdModel
    free: FreeSpace
    traits: Traits
    walker: WalkerSpec
    guide: Guide
    role: Role
    seed: int
    """Seed of the episode."""
    version: int = VERSION
    """Version of the rules of the person."""
    hands: HandWork | None = None
    """State of the person's hands; None: they handle nothing."""
    daily: bool = False
    """True if the person follows a routine."""

    @property
    def facts(self) -> dict[str, Any]:
        """Facts about the person in recordings: model, version, traits and role."""
        return {"model": self.model, "version": self.version, **self.traits._asdict(), **self.role._asdict()}


class Moment(NamedTuple):
    """Places of all agents of W worlds, now and one step ago."""

    xz: Array
    """Present positions [W, A, 2] [m]."""
    heading: Array
    """Present headings [W, A] [rad]."""
    was_xz: Array
    """Positions one step ago [W, A, 2] [m]."""
    was_heading: Array
    """Headings one step ago [W, A] [rad]."""
    places: Array
    """Present places of all people, then of the discs of all robots [W, P + D, 2] [m]."""
    before: Array
    """Places of all people and discs one step ago [W, P + D, 2] [m]."""
    radii: Array
    """Radii of the discs of robots, and of people whose policies are not those of crowds [P + D] [m]."""
    robots: Array
    """Places and headings of robots (x, z, heading) [W, R, 3]."""

    @classmethod
    def of(cls, world: World) -> Moment:
        """Return the places of all agents now and one step ago."""
        moments = (values for at in (world.now, world.was) for values in (at.xz, at.heading))
        xz, heading, was_xz, was_heading = (np.ascontiguousarray(np.swapaxes(values, 0, 1)) for values in moments)
        discs, count = [np.zeros((2, len(xz), 0, 3))], len(world.state.robots)
        for k, base in enumerate(world.bases[:count]):
            moments = np.concatenate([xz[:, k], was_xz[:, k]]), np.concatenate([heading[:, k], was_heading[:, k]])
            discs.append(discs_at(*moments, tuple(base.disc_offsets_m), base.disc_radius_m).reshape(2, len(xz), -1, 3))
        now, was = np.concatenate(discs, axis=2)
        places, before = (np.concatenate([own[:, count:], n[..., :2]], 1) for own, n in ((xz, now), (was_xz, was)))
        return cls(
            xz,
            heading,
            was_xz,
            was_heading,
            places,
            before,
            # 0.3: radius of people who follow another policy [m]
            radii=np.concatenate([np.full(xz.shape[1] - count, 0.3), now[0, :, 2]]),
            robots=np.concatenate([xz[:, :count], heading[:, :count, None]], axis=2),
        )


class Crowds:
    """Crowds of one world, with one crowd for each model that people follow.

    People join in their first step, in which they stand still. From the next step on, the first person whose place is
    requested causes all people to move.
    """

    def __init__(self, world: World, row: int, moment: Callable[[], Moment], new_events: list[Event]) -> None:
        """Create crowds without people for world number ``row``.

        ``moment`` returns the places of all agents; ``new_events`` are those of the first step.
        """
        self._world, self._row, self._step, self._moment = world, row, -1, moment
        self._members: dict[CrowdModel, dict[int, CrowdMember]] = {}
        self._crowds: dict[CrowdModel, Crowd] = {}
        self._order: dict[CrowdModel, tuple[Any, Any, list[tuple[int, CrowdMember, HandWork]]]] = {}
        """Rows of `Moment.places` as each crowd takes them: its people, discs of robots, all others; and the first of these;
        and those of its people whose hands work."""
        self._moved: dict[int, PoseAction] = {}
        self.stations: dict[Any, Station] = {}
        """Stations in use, by the person who uses them; of people who are in none of the crowds by their number."""
        self.new_events = new_events
        """Reactions to robots and activities that people of the crowds began in the last step, and refusals."""

    def move(self, member: CrowdMember, number: int, step: int) -> PoseAction:
        """Return the place of an agent after step number ``step``."""
        members = self._members.setdefault(member.model, {})
        # another member of the same number is that of a new episode
        if members.get(number) is not member:
            members[number] = member
            # a crowd has a fixed number of people: it is made anew with this one in its next step
            self._crowds.pop(member.model, None)
            own = self._world.state.agents[number]
            return PoseAction(own.xz[self._row].copy(), own.heading.item(self._row))
        if step != self._step:
            self._step, self._moved, self.new_events = step, {}, []
        if number not in self._moved:
            self._move_all(member.model)
        return self._moved[number]

    def _move_all(self, model: CrowdModel) -> None:
        """Move all people who follow one model by one step."""
        w, members, moment = self._row, self._members[model], self._moment()
        robots, all_people = len(self._world.state.robots), len(self._world.state.people)
        if model not in self._crowds:
            # people of one world share home, seed and walker, so the first one's stand for all
            people = list(members.values())
            self._crowds[model] = Crowd(
                people[0].free,
                [person.traits for person in people],
                [person.guide for person in people],
                model,
                roles=[person.role for person in people],
                seed=people[0].seed,
                stride=people[0].walker.stride,
                # one for all crowds, so that people of two models do not sit down on one seat
                places=self.stations,
                version=min(person.version for person in people),
                daily=any(person.daily for person in people),
            )
            # people of other models and policies are obstacles that move
            own, discs = [number - robots for number in members], range(len(moment.radii))
            order = own + sorted(set(discs) - set(own), key=lambda k: (k < all_people, k))
            # where all people follow one model, views: sorting the rows takes longer than looking at them
            every = slice(None), slice(0, len(own))
            workers = [(n, member, member.hands) for n, member in members.items() if member.hands is not None]
            rows, first = every if order == list(discs) else (np.array(order), np.array(own))
            self._order[model] = rows, first, workers
            # those who are in none of the crowds
            self._others = sorted({*range(robots, robots + all_people)}.difference(*self._members.values()))
        for k in self._others:
            own = self._world.state.people[k - robots]
            self.stations.pop(k, None)
            if own.seat[w, 1] > 0.0:
                taken = np.array([*own.xz[w], own.heading[w], APART_M if own.seat[w, 1] <= 1.0 else LIES_APART_M])
                self.stations[k] = Station("", 0.0, taken, lambda *_: iter(()))
        crowd, (order, own, workers) = self._crowds[model], self._order[model]
        places, headings = crowd.step(
            moment.places[w, order],
            moment.before[w, order],
            moment.heading[w, robots:][own],
            moment.radii[order].copy(),
            moment.robots[w],
            len(moment.radii) - all_people,
            self._step,
        )
        self.new_events += [
            Event(step=self._step, agent=list(members)[m], kind=kind, target=target, detail=detail)
            for m, kind, target, detail in crowd.new_events
        ]
        for number, place, angle, (height, share) in zip(
            members, places, headings.tolist(), crowd.seats.tolist(), strict=True
        ):
            self._moved[number] = PoseAction(place, angle, (height, share))
        for number, member, work in workers:
            self._handle(number, member, work, self._moved[number].xz, self._moved[number].heading)

    def _handle(self, number: int, member: CrowdMember, work: HandWork, place: Array, heading: float) -> None:
        """Move hands, doors and things by what a person does who is at a place [2] with a heading after this step."""
        state, w, body = self._world.state, self._row, self._world.roster[number].body
        person, root = state.people[number - len(state.robots)], root_pose(body, place, heading, member.free)
        where = member.free, place, heading, member.walker, person.arms[w]
        person.hands[w], held = work.beside(*where) if member.version > 6 else (work.lead, work.held)
        # worlds that learners step hold neither doors nor things
        for k, position in work.joints.items() if state.joint_pos.shape[1] else ():
            state.joint_pos[w, k] = position
        work.joints.clear()
        members = [pair for crowd in self._members.values() for pair in crowd.items()]
        first = sum(len(member.hands.things) for n, member in members if n < number and member.hands is not None)
        for k, pose in held.items() if state.object_pose.shape[1] else ():
            state.object_pose[w, first + k] = pose_multiply(root, pose)
        self.new_events += [
            Event(
                step=self._step,
                agent=number,
                kind=kind,
                target=f"{self._world.roster[number].name}_{thing}",
                detail=detail,
            )
            for kind, thing, detail in work.events
        ]
        work.events.clear()
