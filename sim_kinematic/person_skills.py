"""The skills of a person (paper sections 3.1 and 4.2; spec/habitat.md 2.3, 2.4)."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.reach import Hand, reacher
from h3data.geometry import Array, ground_pose, heading_from_quat
from h3data.scene import FreeSpace
from sim_kinematic.giving_way import PATIENCE_STEPS, Seen, crowds, in_the_way, round_somebody, waits
from sim_kinematic.person import Person, SkillResult
from sim_kinematic.reach_room import ReachRoom
from sim_kinematic.skills import CONTROL, PRIMITIVES, Action, Ending, Objects, Skill
from sim_kinematic.spec import WalkerSpec
from sim_kinematic.stands import nearest_stand, person_stands
from sim_kinematic.state import HUMAN, NOBODY, HumanState
from sim_kinematic.step import walk_humans
from sim_kinematic.waypoint_human import sharp_corners

HANDS: tuple[Hand, ...] = ("right", "left")
"""In the order in which she tries them."""


@dataclass(eq=False)
class PersonActor:
    """A person with two hands; the left one is for what the right one cannot. She does not give way to robots (as Habitat's
    planners), but lets other people pass."""

    person: Person
    free: FreeSpace
    spec: WalkerSpec
    objects: Objects
    number: int = HUMAN
    """Of the agent."""
    room: ReachRoom | None = None
    """Looks where her body would be; None: nobody does."""
    others: tuple[Seen, ...] = ()
    """Other people, the nearest first."""

    @property
    def xz(self) -> NDArray:
        return self.person.base[[0, 2]]

    @property
    def heading(self) -> float:
        return float(heading_from_quat(self.person.base[3:]))

    @property
    def hand_pose(self) -> Array:
        """pose7 of the palm that holds something in the world, else of the right one."""
        holding = tuple(self.person.held)
        return self.person.palm(holding[0] if holding else "right")

    @property
    def arm(self) -> NDArray:
        """She has no joints that could be driven, [0]."""
        return np.zeros(0)

    def infeasible(self, action: Action) -> str:
        if action.skill in (*PRIMITIVES, CONTROL):
            return "not_of_a_person"
        return self.objects.why_not(self.number, action)

    def start(self, action: Action) -> Skill:
        k = action.target
        if action.skill == "wait":
            return self._wait(action.steps)
        if action.skill.startswith("nav"):
            to_goal = action.skill == "nav_to_goal"
            return self._navigate(self.objects.goals[k] if to_goal else self.objects.poses[k, :3], self._hands(k))
        return self._handle(action.skill == "pick", k)

    def idle(self) -> None:
        pass

    def _wait(self, steps: int) -> Skill:
        for _ in range(steps):
            yield
        return Ending("done")

    def _hands(self, k: int) -> tuple[Hand, ...]:
        """The hand that holds an object, else both in the order in which she tries them."""
        holding: list[Hand] = [hand for hand, held in self.person.held.items() if held.name == self.objects.names[k]]
        return tuple(holding) or HANDS

    def _navigate(self, point: NDArray, hands: tuple[Hand, ...]) -> Skill:
        """Walk to where the first of these hands that can reaches a world point [3], and turn to it."""
        gets_there = False
        for hand in hands:
            stands = person_stands(self.free, self.person.body, point, hand)
            for _ in range(PATIENCE_STEPS):
                if not len(stands) or not crowds(stands, self.others).all():
                    break
                yield
            crowded = crowds(stands, self.others)
            k, left = nearest_stand(
                self.free, stands, self.xz, crowded, partial(self._has_room, point=point, hand=hand)
            )
            if np.isfinite(left):
                break
            gets_there |= bool(np.isfinite(nearest_stand(self.free, stands, self.xz)[1]))
        else:
            return Ending("failed", "no_room" if gets_there else "no_way")
        for _ in self._walk(sharp_corners(self.free, self.free.path(self.xz, stands[k, :2]))[1:]):
            self._follow()
            yield
        if np.hypot(*(self.xz - stands[k, :2])) > 2 * self.spec.arrive_m:
            return Ending("failed", "stuck")
        for _ in self.person.turn(float(stands[k, 2])):
            self._follow()
            yield
        return Ending("done")

    def _walk(self, path: NDArray) -> Generator[object, None, None]:
        """Walk along floor points [N, 2] without stopping at them, turning on the spot where they turn (paper 3.1)."""
        person, state = self.person, HumanState.zeros(1)
        if len(path):
            dx, dz = path[0] - self.xz
            yield from person.turn(float(np.arctan2(-dz, dx)))
        state.xz[0], state.heading[0] = self.xz, self.heading
        clip = person.body.clip_for_speed(self.spec.speed_mps)
        walk, k, waited = person.body.clips[clip], 0, 0
        while k < len(path) and waited <= PATIENCE_STEPS:
            blocker = in_the_way(self.xz, path[k], self.others)
            if blocker is not None and not waits(self.number, blocker) and waited % 10 == 0:
                detour = round_somebody(self.free, self.xz, path[-1], blocker)
                path, k, blocker = (path, k, blocker) if detour is None else (detour, 0, None)
            waited = 0 if blocker is None else waited + 1
            walk_humans(state, (path[k] if blocker is None else state.xz[0])[None], self.spec)
            person.base = ground_pose(state.xz[0], state.heading[0], self.free.floor_y)
            phase = walk.start_phase + (state.distance[0] - state.set_off[0]) / walk.stride_m
            person.play(clip, float(phase), float(state.blend[0]))
            yield
            there = np.hypot(*(path[k] - state.xz[0])) <= self.spec.arrive_m
            k += there and (k + 1 < len(path) or state.blend[0] == 0)

    def _handle(self, picks: bool, k: int) -> Skill:
        """Pick or place; objects change hands in the step in which the hand is there."""
        name = self.objects.names[k]
        point = self.objects.poses[k, :3] if picks else self.objects.goals[k]
        stand = np.append(self.xz, self.heading)
        hands = self._hands(k)
        near: list[Hand] = [hand for hand in hands if self._reaches(stand, point, hand)]
        able: list[Hand] = [hand for hand in near if self._has_room(stand, point, hand)]
        if near and not able:
            return Ending("failed", "no_room")
        hand = able[0] if able else hands[0]
        self.person.objects[name] = self.objects.poses[k].copy()
        skill = self.person.pick(name, hand) if picks else self.person.place(point, hand)
        result = SkillResult(success=False)
        while True:
            try:
                next(skill)
            except StopIteration as end:
                result = end.value
                break
            self._follow()
            if picks and hand not in self.person.held:  # it may go away under her hand
                self.person.objects[name] = self.objects.poses[k].copy()
            yield
        return Ending("done") if result.success else Ending("failed", result.reason or "out_of_reach")

    def _reaches(self, stand: NDArray, point: NDArray, hand: Hand) -> bool:
        seen = Person(self.person.body, ground_pose(stand[:2], float(stand[2]), self.free.floor_y)).seen(point)
        return bool(reacher(self.person.body, hand).reachable(seen[None])[0])

    def _has_room(self, stand: NDArray, point: NDArray, hand: Hand) -> bool:
        """Whether her body keeps out of the home when a hand reaches for a point from a stand; yes where nobody looks, and
        where it does not get there anyway."""
        return self.room is None or not self._reaches(stand, point, hand) or self.room.is_clear(stand, point, hand)

    def _follow(self) -> None:
        """Tell the others what the hand holds."""
        held = next(iter(self.person.held.values()), None)
        for k, name in enumerate(self.objects.names):
            if held is not None and held.name == name:
                self.objects.held_by[k] = self.number
                self.objects.poses[k] = self.person.objects[name]
            elif self.objects.held_by[k] == self.number:
                self.objects.held_by[k] = NOBODY
                self.objects.poses[k] = self.person.objects[name]
