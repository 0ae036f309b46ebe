"""Chores of people who are driven from outside: each is started by a command, and done as people with routines do it.

The routine of such a person (`chores`) has one of each chore that the home allows, so that a carton, a tray and a phone
are there from the first step on. `DrivenHands` finds the chore that is possible where the person stands, lets them walk
to its place, and shows the motion of `ChoreRoutine`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from h3data.errors import InputError
from h3data.geometry import Array, heading_from_quat, pose_multiply
from h3data.recording import Event
from h3data.scene.records import instance_bounds
from h3data_crowds.chores import (
    BREAKFAST,
    CHORES,
    SETTLES_S,
    CarryingHands,
    Chore,
    ChoreRoutine,
    chosen_stops,
    minimum_jerk,
    planned,
)
from h3data_crowds.routines import Stop
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.skills import CHORE, CONTROL, Action, Skill, SkillResult
from sim_kinematic.agents.skills import CHORES as NUMBERED
from sim_kinematic.crowd.crowd import VERSION
from sim_kinematic.crowd.errands import Motion
from sim_kinematic.motion.spec import STEP_S

PARTS = (
    BREAKFAST[0],
    (
        ("lift", ("kitchen_counter", "dining_table", "sideboard", "desk", "chest_of_drawers"), 8.5),
        ("put", ("dining_table", "kitchen_counter", "sideboard", "desk", "chest_of_drawers"), 9.0),
    ),
    (("phone", ("window", "bookshelf", "plant"), 10.0),),
)
"""Parts of the routine of a driven person, as those of `BREAKFAST`; none is left out where it is possible."""
NEAR_M, BESIDE_M = 1.6, 1.3
"""Largest distances of a driven person from the place of a chore, and from furniture on which they put something [m]."""
SPOTS, APART_M = 3, 0.3
"""Number of spots on one piece of furniture that are tried, and least distance of what is put down from other things
[m]."""
PHONE_S = 0.8
"""Time in which the hand moves to where a phone is looked at, or back [s]."""
AJAR = 0.05
"""Angle up to which a door counts as closed [rad]."""


class DrivenHands(CarryingHands):
    """Hands of a person who is driven from outside, with the chores that commands start."""

    def __init__(self, routine: ChoreRoutine, scene: Any, free: Any, body: Any, start: Array, number: int) -> None:
        """Take over the things of a routine; the other arguments are those of `ChoreRoutine`."""
        assert routine.hands is not None
        super().__init__(routine.hands.things, routine.hands.assets, body)
        self.routine, self.number = routine, number
        self.poses = np.array([thing.pose for thing in self.things], np.float64).reshape(-1, 7)
        """Pose (pose7) of each thing in the world, NaN where it is absent, [T, 7]."""
        self.phone = next((n for n, thing in enumerate(self.things) if thing.name == "phone"), -1)
        self.plans: dict[int, Chore] = {
            n: plan for k, n in routine.own.items() if isinstance(plan := routine.plans[k], Chore)
        }
        """Chore by which each thing that lies somewhere is taken."""
        self._home, self._known = (scene, free, body, start), dict[tuple[str, bool, int], Chore | None]()
        self._tops = [
            (each.name, instance_bounds(scene, each)[:, [0, 2]])
            for each in scene.instances
            if "/" not in each.name and scene.assets[each.asset].receptacles
        ]

    # --- what a `DrivenPerson` asks ---------------------------------------------------------------------------------------
    def infeasible(self, actor: DrivenPerson, action: Action) -> str:
        """Return the reason why an action is impossible now: the hands are full, or no such chore is near."""
        if action.skill == CHORE and NUMBERED[action.target] == "perform":
            return "hand_full" if self.full or actor.person.held else self._unfit(actor, self._act(actor, action)[1])
        if action.skill == CHORE:
            found = self._found(actor, NUMBERED[action.target])
            return found if isinstance(found, str) else ""
        return "hand_full" if self.full and action.skill not in (CONTROL, "wait") else ""

    def start(self, actor: DrivenPerson, action: Action) -> Skill:
        """Walk to the place of a chore and do it."""
        name = NUMBERED[action.target]
        if name == "perform":
            return (yield from self._perform(actor, *self._act(actor, action)))
        found = self._found(actor, name)
        if isinstance(found, str):
            return SkillResult("failed", found)
        number, plan = found
        if plan is None:
            return (yield from actor.perform(self._phone(np.append(actor.xz, actor.heading))))
        place = np.append(plan.root[[0, 2]], heading_from_quat(plan.root[3:]))
        walked = yield from actor.walk_to_stand(place, plan.spot)
        actor.person.look_at = None
        if walked.outcome != "done":
            return walked
        yield from actor.person.settle()
        return (yield from actor.perform(self._handle(number, plan, place)))

    @property
    def full(self) -> bool:
        """Return whether the hands hold a thing."""
        return self.routine.holds is not None

    @property
    def shows_phone(self) -> bool:
        """Return whether the phone is in the hand."""
        return self.routine.holds == (self.phone, 1)

    def offers(self, actor: DrivenPerson) -> list[tuple[str, str]]:
        """Return the chores that seem possible from where somebody stands, each with the kind of its thing.

        Whether there is room to put something down is known only for furniture that was tried before.
        """
        holds = self.routine.holds
        if actor.person.held:
            return []
        if self.shows_phone:
            return [("phone", "phone")]
        if holds is not None:
            known = [self._known.get((name, holds[1] == 2, 0), True) for name, _ in self._beside(actor)]
            return [("put", self._kind(holds[0]))] if any(known) else []
        found = [(name, self._found(actor, name)) for name in ("take", "lift")]
        return [(name, self._kind(each[0])) for name, each in found if not isinstance(each, str)]

    def _kind(self, number: int) -> str:
        return self.things[number].name.partition("_")[0]

    def _beside(self, actor: DrivenPerson) -> list[tuple[str, Array]]:
        """Return the furniture with surfaces beside somebody, each with its bounds on the floor [2, 2]."""
        return [top for top in self._tops if np.hypot(*(np.clip(actor.xz, *top[1]) - actor.xz)) < BESIDE_M]

    def follow(self, play: Any) -> None:
        """Move doors and things by what the hands have done in a step of a rollout, and report it as events."""
        team, name = play.team, play.episode.roster[self.number].name
        for k, position in self.joints.items():
            team.openables.move(k, position)
        self.joints.clear()
        for n, pose in self.held.items():
            self.poses[n] = pose_multiply(team.actors[self.number].person.base, pose)
        play.events += [
            Event(step=play.step, agent=self.number, kind=kind, target=f"{name}_{thing}", detail=detail)
            for kind, thing, detail in self.events
        ]
        self.events.clear()

    # --- captured motions -----------------------------------------------------------------------------------------------
    def _act(self, actor: DrivenPerson, action: Action) -> tuple[str, Any]:
        """Return the name of the motion that an action names, and the motion; empty and None if the body has no such motion."""
        acts = list(actor.person.body.acts.items())
        number = int(action.command[0]) if action.command else 0
        return acts[number] if 0 <= number < len(acts) else ("", None)

    def _unfit(self, actor: DrivenPerson, act: Any) -> str:
        """Return the reason why a motion is impossible where somebody stands; empty if it is possible."""
        if act is None:
            return "no_chore"
        others = np.zeros((0, 3)) if actor.company is None else actor.company.discs_beside(self.number)
        return "" if act.fits(actor.free, actor.xz, actor.heading, others) else "no_room"

    def _perform(self, actor: DrivenPerson, name: str, act: Any) -> Skill:
        """Play a motion once; another command ends it in the time in which the person goes back to standing."""
        yield from actor.person.settle()
        place, moment = np.append(actor.xz, actor.heading), [0.0, act.seconds]
        self.events.append((act.event, name, "1"))
        try:
            return (yield from actor.perform(self._shown(actor.person, act, place, moment)))
        finally:
            # also where a command closes this generator
            moment[1] = min(moment[1], moment[0] + act.blend_s)
            actor.leaving = self._shown(actor.person, act, place, moment)

    def _shown(self, person: Any, act: Any, place: Array, moment: list[float]) -> Motion:
        """Yield the motion of somebody at a place [3] who plays a motion, from one time [s] of ``moment`` to the other."""
        while moment[0] < moment[1] - STEP_S / 2:
            moment[0] += STEP_S
            since, left = np.array(moment[:1]), np.array([moment[1] - moment[0]])
            person.plays = partial(act.perform, since=since, times=1, left=left)
            yield place, 0.0
        person.plays = None

    # --- chores -------------------------------------------------------------------------------------------------------
    def _found(self, actor: DrivenPerson, name: str) -> tuple[int, Chore | None] | str:
        """Return the thing and the plan of a chore that is possible from where somebody stands, or the reason why none is."""
        holds = self.routine.holds
        if actor.person.held:
            return "hand_full"
        if name == "put":
            if holds is None or holds[0] == self.phone:
                return "not_held"
            spot = self._spot(actor, holds[0], wide=holds[1] == 2)
            return "no_space" if spot is None else (holds[0], spot)
        if holds is not None and (name != "phone" or holds[0] != self.phone):
            return "hand_full"
        if name == "phone":
            return "no_chore" if self.phone < 0 else (self.phone, None)
        near = {n: self._far(actor, plan) for n, plan in self.plans.items() if plan.name == name}
        n = min(near, key=lambda n: near[n], default=-1)
        if n < 0 or near[n] > NEAR_M:
            return "no_chore"
        plan, parts = self.plans[n], actor.openables
        if plan.joint >= 0 and parts is not None:
            if abs(parts.positions[plan.joint] - parts.joints.closed[plan.joint]) > AJAR:
                return "already_open"
            swept = np.linspace(parts.joints.closed[plan.joint], parts.joints.opened[plan.joint], 12)
            if parts.hits_agent(plan.joint, swept) not in (-1, self.number):
                return "blocked"
        return n, plan

    def _spot(self, actor: DrivenPerson, number: int, *, wide: bool) -> Chore | None:
        """Return how to put down thing ``number`` on furniture beside somebody; None: there is no free spot."""
        people = () if actor.company is None else actor.company.actors
        hands = [each.chores for each in people if isinstance(each, DrivenPerson) and each.chores not in (None, self)]
        poses = [actor.objects.poses, np.delete(self.poses, number, 0), *(each.poses for each in hands)]
        others = np.concatenate(poses)[:, :3]
        best: Chore | None = None
        for name, _ in self._beside(actor):
            for n in range(SPOTS):
                plan = self._planned(name, wide, n)
                if plan is None:
                    break
                beside = np.linalg.norm(np.nan_to_num(others, nan=np.inf) - plan.spot, axis=1) >= APART_M
                if beside.all() and self._far(actor, plan) <= min(NEAR_M, self._far(actor, best) if best else np.inf):
                    best = plan
        return best

    def _planned(self, name: str, wide: bool, n: int) -> Chore | None:
        key = name, wide, n
        if key not in self._known:
            scene, free, body, start = self._home
            try:
                stop = Stop(name, "put", CHORES["put"] + SETTLES_S)
                self._known[key] = planned(scene, free, body, stop, start, n, tray=wide, walls=self.routine.version > 6)
            except InputError:
                self._known[key] = None
        return self._known[key]

    @staticmethod
    def _far(actor: DrivenPerson, plan: Chore) -> float:
        return float(np.hypot(*(plan.root[[0, 2]] - actor.xz)))

    def _handle(self, number: int, plan: Chore, place: Array) -> Motion:
        """Yield the motion of a chore, and keep by which chore the thing can be taken again."""
        self.plans.pop(number, None)
        yield from self.routine.handle(plan, number, place, CHORES[plan.name] + SETTLES_S)
        if plan.name == "put":
            self.plans[number] = plan._replace(name="lift")

    def _phone(self, place: Array) -> Motion:
        """Yield the motion of taking out the phone, or of putting it away if it is in the hand."""
        out = self.routine.holds is None
        shares = minimum_jerk(np.arange(round(PHONE_S / STEP_S) + 1) * STEP_S / PHONE_S)
        yield from self.routine.show_phone(self.phone, shares if out else shares[::-1], place, iter(()))
        self.routine.holds = (self.phone, 1) if out else None
        if not out:
            del self.held[self.phone]


def chores(episode: Any, number: int, version: int = VERSION) -> ChoreRoutine:
    """Return a routine with one of each chore that the home allows, whose hands also follow commands from outside.

    Looking at a phone is possible in every home. The ``version`` of the rules is that of `ChoreRoutine.follow`.
    """
    scene, free, member = episode.scene, episode.free, episode.roster[number]

    def stops(version: int) -> list[Stop]:
        chosen = chosen_stops(episode, number, PARTS, "chores", 1.0, version)
        # a phone needs no special thing: it is looked at beside any
        return chosen + [Stop(scene.instances[0].name, "phone", 10.0)] * all(
            stop.activity != "phone" for stop in chosen
        )

    start = episode.starts[number, :2]
    routine = ChoreRoutine(scene, free, stops, member.body, start=start, number=number, version=version)
    routine.use(DrivenHands(routine, scene, free, member.body, start, number))
    return routine
