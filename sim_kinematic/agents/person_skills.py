"""The skills of a person (paper sections 3.1 and 4.2; spec/habitat.md 2.3, 2.4)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.reach import HANDS, Hand, reacher
from h3data.geometry import Array
from h3data.scene import FreeSpace
from sim_kinematic.agents.company import Company
from sim_kinematic.agents.opening.openables import ArticulatedParts, stands_clear
from sim_kinematic.agents.opening.skills import Leading, full_travel, handle_path, stands_before, why_not
from sim_kinematic.agents.person import MotionResult, Person, Transition, seen_from
from sim_kinematic.agents.person import Skill as Motion
from sim_kinematic.agents.person_clearance import BodyClearance
from sim_kinematic.agents.skills import CONTROL, PRIMITIVES, SEARCH, Action, Objects, Skill, SkillResult
from sim_kinematic.agents.stands import island_of, nearest_stand, person_stands
from sim_kinematic.agents.waypoint_walker import walking_path
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.yielding import (
    NO_NEIGHBOURS,
    NO_PATH,
    Neighbours,
    crowds,
    in_the_way,
    path_around,
    shut_off,
    waits,
)
from sim_kinematic.motion.gait import move_people, walk_humans
from sim_kinematic.motion.spec import STEP_S, WalkerSpec
from sim_kinematic.motion.state import HUMAN, NOBODY, HumanState
from sim_kinematic.motion.stride import CREEP_MPS, Strider

BACK_AFTER_STEPS, BACK_STEPS = 20, 15
"""Number of steps after which a person who cannot step aside without contact goes back, and number of steps that they
go back."""
SHUFFLE_MPS, AWAY_MPS = 0.4, 0.6
"""Speeds of people who step sideways or back without turning, and who turn into their direction of motion meanwhile
[m/s]."""
ASIDE_LEG_M = 0.05
"""Least distance between points of a path aside [m]: people would brake at every point of a rounded corner."""
HALT_STEPS, TURN_PATIENCE_STEPS = 30, 10
"""Number of steps in which a walking person who has to turn comes to a stand, and number of steps for which they then
wait for room to turn on the spot before they turn while walking."""


class _Posture(NamedTuple):
    """Posture of a person, and what they carry."""

    base: Array
    quats: Array
    pelvis: Array
    feet: Array
    """State of the feet, `h3data.bodies.people.planted_gait.PlantedWalk.state`."""
    transition: Transition
    bare: Array
    """``quats`` without what fingers, head and eyes add."""
    curl: Array
    gaze: Array
    objects: dict[str, Array]


@dataclass(eq=False)
class PersonActor:
    """Person with skills, who uses the right hand, or the left one where the right one does not reach.

    The person gives way to the heeded agents of ``others``. There are none for a person alone with one robot, as people in
    Habitat do not give way to robots.
    """

    person: Person
    free: FreeSpace
    spec: WalkerSpec
    objects: Objects
    number: int = HUMAN
    """Index of the agent."""
    room: BodyClearance | None = None
    """Test of the room for the body; None: no test is made."""
    company: Company | None = None
    """Agents to which the person gives way, with access by number; None: the person is alone."""
    yields: bool = True
    aside: NDArray[np.float64] | None = None
    turned_away: bool = False
    hindered_by: frozenset[int] = frozenset()
    is_robot = False
    footprint = AVOIDANCE.person
    """Discs on the floor that other agents keep clear of."""

    def __post_init__(self) -> None:
        self._gait = HumanState.zeros(1)
        self._announced: NDArray[np.floating] | partial[NDArray[np.floating]] = NO_PATH
        self._stands: dict[tuple[FreeSpace, Hand, int, bytes], Array] = {}
        """Stands found before, by floor, hand, island and the point to be reached; skills look for the same ones again."""
        self._trail: deque[Any] = deque(maxlen=BACK_STEPS)
        """Postures before the last steps of a walk."""
        self._held_up = 0
        """Steps since the last one that was not stopped by others."""
        self._goes_around = False
        """True after the person was turned away: they take paths around people who stand until they make progress."""

    @property
    def others(self) -> Neighbours:
        """Agents of the world, and to which of them the person gives way."""
        return NO_NEIGHBOURS if self.company is None else self.company.around(self.number)

    def meets(self) -> bool:
        """Return whether the person touches an agent now, in which case both stay where they were."""
        return self.company is not None and self.company.meets(self)

    @property
    def openables(self) -> ArticulatedParts | None:
        """Doors and drawers of the home; None: nothing opens."""
        return self.objects.openables

    @property
    def path(self) -> NDArray[np.floating]:
        """Points [N, 2] [m] of the path that the person walks, from their own place on; computed when it is read."""
        if isinstance(self._announced, partial):
            self._announced = self._announced()
        return self._announced

    @path.setter
    def path(self, path: NDArray[np.floating] | partial[NDArray[np.floating]]) -> None:
        self._announced = path

    @property
    def path_start(self) -> NDArray | None:
        """First point [2] of the path that the person walks; None without a path."""
        if isinstance(self._announced, partial):
            # the first argument of `_joined` is the person's place, so nothing is joined for it
            return self._announced.args[0]
        return self._announced[0] if len(self._announced) else None

    @property
    def xz(self) -> NDArray:
        """Position on the floor [2] [m], a view."""
        return self.person.spot

    @property
    def heading(self) -> float:
        """Heading of the person [rad]."""
        return self.person.state.heading.item(0)

    @property
    def hand_pose(self) -> Array:
        """Return the pose (pose7) in the world of the palm that holds an object, or of the right palm."""
        holding = tuple(self.person.held)
        return self.person.palm(holding[0] if holding else "right")

    @property
    def arm(self) -> NDArray:
        """Positions of the arm's driven joints: none for people, [0]."""
        return np.zeros(0)

    def infeasible(self, action: Action) -> str:
        """Return the reason why an action is impossible now; empty if it is possible."""
        if action.skill in (*PRIMITIVES, CONTROL):
            return "not_of_a_person"
        why = self.objects.why_not(self.number, action)
        if why or self.openables is None:
            return why
        if action.skill in ("open", "close"):
            return why_not(self.openables, self.number, action) or self._cannot_hold(action.target)
        if (
            action.skill in ("pick", "place")
            and self.openables.barrier_of(action.target, at_goal=action.skill == "place") >= 0
        ):
            return "closed"
        return ""

    def _cannot_hold(self, k: int) -> str:
        """Return the reason why no hand can reach a handle from here."""
        assert self.openables is not None
        handle = self.openables.handles(self.openables.positions)[k]
        stand = np.append(self.xz, self.heading)
        return "" if any(self._reaches(stand, handle, hand) for hand in HANDS) else "out_of_reach"

    def start(self, action: Action) -> Skill:
        """Start a skill."""
        k = action.target
        # before it is cleared: the next walk has to know that the last one was turned away
        self._goes_around |= self.turned_away
        self.turned_away = False
        self._trail.clear()
        # who has come to an object keeps looking at it for the pick or the place that follows
        if action.skill not in ("pick", "place"):
            self.person.look_at = None
        if action.skill == "wait":
            return self._wait(action.steps)
        if action.skill == "nav_to_handle":
            return self._navigate_to_handle(k)
        if action.skill in ("open", "close"):
            return self._move_part(k, opens=action.skill == "open")
        if action.skill.startswith("nav"):
            point = self.objects.destination(self.number, action)
            return self._look_at(point) if action.skill == SEARCH else self._navigate(point, self._hands(k))
        return self._handle(k, None if action.skill == "pick" else self.objects.goals[k])

    def idle(self) -> None:
        """Stand still for one step."""
        self._stand()

    def _wait(self, steps: int) -> Skill:
        for _ in range(steps):
            self._stand()
            yield
        return SkillResult("done")

    def _hands(self, k: int) -> tuple[Hand, ...]:
        """Return the hand that holds an object, else both hands in the order in which they are tried."""
        holding: list[Hand] = [hand for hand, held in self.person.held.items() if held.name == self.objects.names[k]]
        return tuple(holding) or HANDS

    def _navigate(self, point: NDArray, hands: tuple[Hand, ...]) -> Skill:
        """Walk to where the first of these hands that can reaches a world point [3], and turn to it."""
        gets_there = False
        for hand in hands:
            stands = self._clear_of_open(self.stands(point, hand))
            # where all are crowded `nearest_stand` would choose one of them; the others may leave meanwhile
            for _ in range(AVOIDANCE.patience_steps):
                if not len(stands) or not crowds(stands, self.others).all():
                    break
                self._stand()
                yield
            crowded = crowds(stands, self.others)
            if self._goes_around:
                # turned away, they must not choose a stand behind whoever blocked them
                crowded |= shut_off(self.free, self.xz, stands[:, :2], self.others)
            k, left = nearest_stand(
                self.free, stands, self.xz, crowded, partial(self._has_room, point=point, hand=hand)
            )
            if np.isfinite(left):
                break
            # asked without the tests of room: tells a place without room for the body from one without a path
            gets_there |= bool(np.isfinite(nearest_stand(self.free, stands, self.xz)[1]))
        else:
            return SkillResult("failed", "no_room" if gets_there else "no_way")
        return (yield from self.walk_to_stand(stands[k], point))

    def _look_at(self, point: NDArray) -> Skill:
        """Walk to the floor before a world point [3], and turn to it."""
        goal = self.free.snap(point[[0, 2]])
        if not np.isfinite(self.free.geodesic(self.xz, goal)):
            return SkillResult("failed", "no_way")
        # heading 0 faces +x and positive turns left, so forward is (cos h, -sin h) in (x, z)
        x, z = point[[0, 2]] - goal
        return (yield from self.walk_to_stand(np.append(goal, np.arctan2(-z, x)), point))

    def stands(self, point: NDArray, hand: Hand, free: FreeSpace | None = None) -> Array:
        """Return stands ``(x, z, heading)`` [N, 3] within walking reach from which a hand reaches a world point [3]."""
        free = free or self.free
        # the floor is a part of the key, as a door that opens replaces it (`walk_on`)
        known = free, hand, island_of(free, self.xz), point.tobytes()
        if known not in self._stands:
            self._stands[known] = person_stands(free, self.person.body, point, hand, island=known[2])
        return self._stands[known]

    def stands_on(self, free: FreeSpace, point: NDArray) -> Array:
        """Return the stands on the floor ``free`` from which either hand reaches a world point [3]."""
        return np.concatenate([self.stands(point, hand, free) for hand in HANDS])

    def walk_on(self, free: FreeSpace) -> None:
        """Use another floor from now on, because a door or drawer of the home has moved."""
        self.free = self.person.free = free

    def _clear_of_open(self, stands: Array) -> Array:
        """Return the stands that are clear of open doors and drawers."""
        if self.openables is None:
            return stands
        return stands[stands_clear(stands, self.openables.open_points(), (0.0,), AVOIDANCE.person.radius_m)]

    def _navigate_to_handle(self, k: int) -> Skill:
        """Walk to where a hand reaches a handle, if possible along its whole way, and turn to it."""
        assert self.openables is not None
        way = handle_path(self.openables, k, full_travel(self.openables, k))
        for hand in HANDS:
            stands = self.stands(way[0], hand)
            stands = stands[stands_before(self.openables, k, stands, (0.0,), AVOIDANCE.person.radius_m)]
            # rather the whole way than a half: where the arm ends the part goes on by itself
            for last in (len(way) - 1, len(way) // 2, 0):
                near = stands[[self._reaches(stand, way[last], hand) for stand in stands]] if len(stands) else stands
                n, left = nearest_stand(self.free, near, self.xz, crowds(near, self.others) if len(near) else None)
                if np.isfinite(left):
                    return (yield from self.walk_to_stand(near[n], way[0]))
        return SkillResult("failed", "no_way")

    def walk_to_stand(self, stand: Array, point: Array) -> Skill:
        """Walk to a stand ``(x, z, heading)`` [3] and look at a world point [3] there."""
        waited = yield from self._walk(stand[:2], facing=float(stand[2]))
        # turned away in mid-walk: the skill ends at a stand and not in the middle of a step
        for _ in range(HALT_STEPS):
            stands = self._gait.blend[0] == 0 and self.person.walk.stands
            if not self.turned_away or stands or (self.aside is not None and len(self.aside)):
                break
            self._pace(None)
            yield
        if np.hypot(*(self.xz - stand[:2])) > 2 * self.spec.arrive_m:
            return SkillResult(
                "failed", "blocked" if self.turned_away or waited > AVOIDANCE.patience_steps else "stuck"
            )
        self.person.look_at = point.copy()
        self._goes_around = False
        # a reach that follows settles the feet itself (`Person._move`)
        yield from self._careful(self.person.turn(float(stand[2]), settles=False))
        return SkillResult("done")

    def _move_part(self, k: int, *, opens: bool) -> Skill:
        """Open or close a part, the hand at its handle."""
        assert self.openables is not None
        leading = Leading(self.openables, k, opens=opens)
        stand = np.append(self.xz, self.heading)
        reached: list[Hand] = [hand for hand in HANDS if self._reaches(stand, leading.handles[0], hand)]
        # where no hand reaches, `lead` refuses and says why
        motion = self._careful(self.person.lead(leading.handles, leading.advance, (reached or [HANDS[0]])[0]))
        # whoever holds a handle cannot step aside for anybody
        self.yields = False
        while True:
            try:
                next(motion)
            except StopIteration as end:
                result = end.value
                return SkillResult("done") if result.success else SkillResult("failed", result.reason or "out_of_reach")
            if leading.gave_up:
                return SkillResult("failed", "blocked")
            yield

    def _walk(self, goal: NDArray, *, facing: float | None = None) -> Generator[None, None, int]:
        """Walk to a floor point [2] without stopping.

        The person turns on the spot at corners (paper 3.1), or walks curves as `WalkerSpec.stride` says, which end at
        the heading ``facing`` [rad]. Returns the number of steps for which they waited for other agents at the end.
        """
        if self.spec.stride is not None:
            return (yield from self._walk_curves(goal, facing))
        path = self._path(goal)
        if path is None:
            return 0
        if len(path):
            dx, dz = path[0] - self.xz
            turn = self.person.turn(float(np.arctan2(-dz, dx)), settles=False)
            yield from self._careful(turn, TURN_PATIENCE_STEPS)
        # the turn has moved the root alone: the gait still has the old heading
        if self._gait.blend[0] == 0:
            self._gait = self._set_off()
        k, waited, left, floor = 0, 0, False, self.free
        while k < len(path) and waited <= AVOIDANCE.patience_steps and not self.turned_away:
            left |= self.aside is not None
            if (left and self.aside is None) or floor is not self.free:  # back from where they had stepped aside to
                path, k, waited, left, floor = self._path(goal), 0, 0, False, self.free
                if path is None:  # something has opened there
                    return 0
                continue
            self.path = partial(_joined, self.xz.copy(), path[k:])
            if left:
                self._stand()
                yield
                continue
            blocker = in_the_way(self.xz, path[k], self.others)
            # in the first step of waiting and every tenth: each look floods the floor around all who stand
            if blocker >= 0 and waited % 10 == 0 and not waits(self.number, self.others, blocker):
                detour = path_around(self.free, self.xz, goal, self.others)
                path, k, blocker = (path, k, blocker) if detour is None else (detour, 0, -1)
            waited = 0 if blocker < 0 else waited + 1
            self._pace(path[k] if blocker < 0 else None)
            yield
            there = np.hypot(*(path[k] - self.xz)) <= self.spec.arrive_m
            # the last point counts once they have come to a stand there
            k += there and (k + 1 < len(path) or self._gait.blend[0] == 0)
        return waited

    def _walk_curves(self, goal: NDArray, facing: float | None) -> Generator[None, None, int]:
        """Walk to a floor point like `_walk`, but brake where the person has to wait."""
        strider = Strider(self.free, self.spec, halts=True)
        path, waited, left = self._path(goal), 0, False
        if path is None:
            return 0
        strider.begin(np.vstack([self.xz[None], path]), facing=facing)
        while not strider.arrived and waited <= AVOIDANCE.patience_steps and not self.turned_away:
            left |= self.aside is not None
            if (
                left and self.aside is None
            ) or strider.free is not self.free:  # back from where they had stepped aside to
                strider.walk_on(self.free)
                path = self._path(goal)
                if path is None:  # something has opened there
                    return waited
                strider.begin(np.vstack([self.xz[None], path]), facing=facing)
                waited, left = 0, False
                continue
            ahead = strider.ahead
            self.path = partial(_joined, self.xz.copy(), ahead)
            if left:
                # stepping aside has a speed of its own, so they set off from rest afterwards
                strider.halt()
                self._stand()
                yield
                continue
            blocker = in_the_way(self.xz, ahead[0], self.others)
            if blocker >= 0 and waited % 10 == 0 and not waits(self.number, self.others, blocker):
                detour = path_around(self.free, self.xz, goal, self.others)
                if detour is not None:
                    strider.begin(np.vstack([self.xz[None], detour]), facing=facing)
                    blocker = -1
            waited = 0 if blocker < 0 else waited + 1
            self._stride(strider, goes=blocker < 0)
            yield
        return waited

    def _stride(self, strider: Strider, *, goes: bool) -> None:
        """Make one step along a path; stop where it would touch another agent."""
        gait, before = self._gait_here(), self._posture()
        was = strider.walk(gait, goes=goes)
        self.person.stride(gait)
        if self.meets():
            # the gait has moved in place, and a step that touches somebody is taken back
            gait.xz[0], gait.heading[0], gait.distance[0], gait.set_off[0], gait.blend[0] = was[:2], *was[2:]
            strider.halt()
            self._take(before)
            self._pace(None)
            return
        self._walked(before)
        self._follow()

    def _path(self, goal: NDArray) -> NDArray[np.float64] | None:
        """Return the waypoints [N, 2] to a floor point [2]; None: there is no path."""
        if self._goes_around:
            around = path_around(self.free, self.xz, goal, self.others)
            if around is not None:
                return around
        points = walking_path(self.free, self.xz, goal, self.spec)
        # without their own place, as the points of `path_around`
        return points[1:] if len(points) else None

    def _stand(self) -> None:
        """Make one step of standing, or of stepping aside."""
        if self.aside is not None and len(self.aside):
            # after backing out the straight line to it may lead through furniture
            towards = self.free.first_leg(self.xz, self.aside[0], beyond_m=ASIDE_LEG_M, max_snap_m=1.0)[1]
            if self._backs_out() or self._shuffles(towards):
                return
            if np.isnan(towards[0]) or in_the_way(self.xz, towards, self.others) >= 0:
                self._pace(None)
            else:
                self._go_aside(towards)
        elif self._gait.blend[0] > 0 or not self.person.walk.stands:
            self._pace(None)
        else:
            self._breathe()

    def _go_aside(self, towards: NDArray) -> None:
        """Make one step towards a floor point [2] to step aside, and turn to it meanwhile.

        People who first turned on the spot would block the other agent for another 1.3 s.
        """
        gait, before = self._gait_here(), self._posture()
        stopped, leg = gait.copy(), towards - self.xz
        left, bearing = float(np.hypot(*leg)), math.remainder(math.atan2(-leg[1], leg[0]) - self.heading, math.tau)
        most = self.spec.turn_rad_s * STEP_S
        # the turn alone may touch somebody: then the same step is made without it
        for turn in (min(max(bearing, -most), most), 0.0):
            step = min(self._speed_aside(towards, bearing - turn) * STEP_S / max(left, 1e-9), 1.0)
            move_people(gait, (self.xz + step * leg)[None], gait.heading + turn, self.spec)
            self.person.stride(gait)
            if not self.meets():
                self._walked(before)
                self._follow()
                return
            self._gait = gait = stopped.copy()
            self._take(before)
        self._held_up += 1
        self._pace(None)

    def _speed_aside(self, towards: NDArray, bearing: float) -> float:
        """Return the speed [m/s] towards a floor point [2] at an angle to the heading; steps aside are always slow.

        They set off gradually, and brake before the next corner of the path aside.
        """
        most, stride, leg = self.spec.speed_mps, self.spec.stride, towards - self.xz
        # the square of the cosine, as people on a path slow down where it is not ahead (`stride_step`)
        speed = max(most * max(math.cos(bearing), 0.0) ** 2, AWAY_MPS)
        if stride is None:
            return min(speed, most)
        assert self.aside is not None
        left = math.hypot(*leg.tolist())
        corner_mps = 0.0  # the path ends there
        for x, z in (self.aside - towards).tolist():
            if math.hypot(x, z) > ASIDE_LEG_M:
                straight = (leg[0] * x + leg[1] * z) / max(left * math.hypot(x, z), 1e-9)
                corner_mps = max(most * max(straight, 0.0) ** 2, AWAY_MPS)
                break
        # v^2 = v_end^2 + 2 a s: the speed from which they can still brake before the corner
        braked = math.sqrt(corner_mps**2 + 2 * stride.decel_mps2 * left)
        return max(min(speed, braked, self.person.walk.speed_mps + stride.accel_mps2 * STEP_S), CREEP_MPS)

    def _backs_out(self) -> bool:
        """Go one step back if others have blocked stepping aside for a long time; return whether it did."""
        if self._held_up < BACK_AFTER_STEPS or not self._trail:
            return False
        now = self._posture()
        self._take(self._trail.pop())
        if self.meets():
            self._take(now)
            # somebody stands behind them now, and all earlier postures lie beyond that place
            self._trail.clear()
        # all of it is used up, so they try to step aside again first
        if not self._trail:
            self._held_up = 0
        self._follow()
        return True

    def _shuffles(self, towards: NDArray) -> bool:
        """Step towards a floor point [2] without turning, if turning has been blocked for a long time.

        Otherwise two people next to each other in a corridor could neither turn nor walk. Returns whether the person
        moved.
        """
        gait, before = self._gait_here(), self._posture()
        stopped, leg = gait.copy(), towards - self.xz
        left = float(np.hypot(*leg))
        if self._held_up < BACK_AFTER_STEPS or not left > 0.0:
            return False
        move_people(gait, (self.xz + leg * min(SHUFFLE_MPS * STEP_S / left, 1.0))[None], gait.heading, self.spec)
        self.person.stride(gait)
        if self.meets():
            self._gait = stopped
            self._take(before)
            return False
        # no `_walked`: it would reset the count, and they would try to turn again in the next step
        self._follow()
        return True

    def _walked(self, before: Any) -> None:
        """Record a step of walking that was not stopped, and the posture before it."""
        self._trail.append(before)
        self._held_up = 0

    def _breathe(self) -> None:
        """Make one step of standing still, in which nobody is newly touched."""
        before = self._posture()
        self.person.stride()
        if self.meets():
            self._take(before)
        self._follow()

    def _pace(self, towards: NDArray | None) -> None:
        """Walk one step towards a floor point [2], or slow down to a stand.

        A step that would touch another agent is not made.
        """
        person, gait, before = self.person, self._gait_here(), self._posture()
        stopped, spec = gait.copy(), self.spec if towards is None else self._setting_off(towards)
        for target in (gait.xz[0].copy() if towards is None else towards, gait.xz[0].copy()):
            walk_humans(gait, target[None], spec)
            person.stride(gait)
            if not self.meets():
                # a step of coming to rest covers no ground, and is nothing to go back by
                if gait.xz[0].tolist() != stopped.xz[0].tolist():
                    self._walked(before)
                break
            self._held_up += 1
            self._gait = gait = stopped.copy()
            self._take(before)
        self._follow()

    def _setting_off(self, towards: NDArray) -> WalkerSpec:
        """Return the walker of one step towards a floor point [2], who sets off and brakes by `StrideSpec`."""
        stride, speed = self.spec.stride, self.person.walk.speed_mps
        if stride is None:
            return self.spec
        left = float(np.hypot(*(towards - self.xz)))
        speed = min(speed + stride.accel_mps2 * STEP_S, math.sqrt(2 * stride.decel_mps2 * left))
        return replace(self.spec, speed_mps=min(max(speed, CREEP_MPS), self.spec.speed_mps))

    def _careful(self, motion: Motion, patience: int = AVOIDANCE.patience_steps) -> Generator[None, None, MotionResult]:
        """Carry out a motion, waiting at each step until no other agent is in the way.

        After ``patience`` steps of waiting the motion is reversed and fails, unless it has changed what the hands hold.
        """
        before, done, holding = self._posture(), [], tuple(self.person.held)
        # a motion leads to other postures, from which the steps of an earlier walk are no way back
        self._trail.clear()
        while True:
            try:
                next(motion)
            except StopIteration as end:
                return end.value
            after, blocked = self._posture(), 0
            while self.meets():
                self._take(before)
                blocked += 1
                if blocked > patience and tuple(self.person.held) == holding:
                    yield from self._back_through(done)
                    return MotionResult(success=False, reason="blocked")
                self._follow()
                yield
                # the same posture again: a generator cannot be asked for its last step twice
                self._take(after)
            self._follow()
            yield
            done.append(before)
            before = after

    def _back_through(self, done: list[_Posture]) -> Generator[None, None, None]:
        """Take postures again, the last first."""
        now = self._posture()
        while done:
            self._take(done[-1])
            if self.meets():
                # waits in the last posture that was free
                self._take(now)
            else:
                now = done.pop()
            self._follow()
            yield

    def _gait_here(self) -> HumanState:
        """Return the gait so far, or that of standing if the person has been moved by something else since."""
        gait = self._gait
        # headings of a gait are never wrapped, those from the root's quaternion are
        turned = math.remainder(gait.heading.item(0) - self.heading, math.tau)
        if gait.xz[0].tolist() != self.xz.tolist() or abs(turned) > 1e-6:
            self._gait = gait = self._set_off()
        return gait

    def _set_off(self) -> HumanState:
        """Return the gait of standing at the same place."""
        gait = HumanState.zeros(1)
        gait.xz[0], gait.heading[0] = self.xz, self.heading
        return gait

    def _posture(self) -> _Posture:
        person = self.person
        return _Posture(  # arrays that a step replaces are not copied, those that it changes are
            person.base,
            person.quats,
            person.pelvis.copy(),
            person.walk.state.copy(),
            person.transition,
            person.bare,
            person.curl.copy(),
            person.gaze.copy(),
            dict(person.objects),
        )

    def _take(self, posture: _Posture) -> None:
        self.person.set_pose(posture.quats, posture.pelvis, posture.base)
        # after `set_pose`, which resets transition, fingers and gaze, and moves what the hands hold
        self.person.walk.state[:] = posture.feet
        self.person.transition = posture.transition
        self.person.bare = posture.bare
        self.person.curl[:], self.person.gaze[:] = posture.curl, posture.gaze
        self.person.objects |= posture.objects

    def _handle(self, k: int, goal: NDArray | None) -> Skill:
        """Pick an object, or place it at a world point [3]; it changes hands in the step in which the hand is there."""
        name, picks = self.objects.names[k], goal is None
        point = self.objects.poses[k, :3] if goal is None else goal
        stand = np.append(self.xz, self.heading)
        hands = self._hands(k)
        near: list[Hand] = [hand for hand in hands if self._reaches(stand, point, hand)]
        able: list[Hand] = [hand for hand in near if self._has_room(stand, point, hand)]
        if near and not able:
            return SkillResult("failed", "no_room")
        # out of reach of every hand, the motion itself refuses and says why
        hand = able[0] if able else hands[0]
        # the person's own entry may be old: others may have carried it since
        self.person.objects[name] = self.objects.poses[k].copy()
        motion = self._careful(self.person.pick(name, hand) if picks else self.person.place(point, hand))
        result = MotionResult(success=False)
        self.yields = False
        while True:
            try:
                next(motion)
            except StopIteration as end:
                result = end.value
                break
            if picks and hand not in self.person.held:  # it may go away under the hand
                self.person.objects[name] = self.objects.poses[k].copy()
            yield
        return SkillResult("done") if result.success else SkillResult("failed", result.reason or "out_of_reach")

    def _reaches(self, stand: NDArray, point: NDArray, hand: Hand) -> bool:
        seen = seen_from(self.free.root_pose(stand[:2], float(stand[2])), point)
        return bool(reacher(self.person.body, hand).reachable(seen[None])[0])

    def _has_room(self, stand: NDArray, point: NDArray, hand: Hand) -> bool:
        """Return whether the body stays clear of the home while a hand reaches for a point from a stand.

        It is True where bodies are not checked, and where the hand does not reach the point anyway.
        """
        return self.room is None or not self._reaches(stand, point, hand) or self.room.is_clear(stand, point, hand)

    def _follow(self) -> None:
        """Tell the others what the hand holds."""
        # one at a time, as `why_not` refuses a second object, though a body has two hands
        held = next(iter(self.person.held.values()), None)
        for k, name in enumerate(self.objects.names):
            if held is not None and held.name == name:
                self.objects.held_by[k] = self.number
                self.objects.poses[k] = self.person.objects[name]
            # let go in this step: it stays where the hand left it
            elif self.objects.held_by[k] == self.number:
                self.objects.held_by[k] = NOBODY
                self.objects.poses[k] = self.person.objects[name]


def _joined(xz: NDArray, ahead: NDArray) -> NDArray[np.floating]:
    return np.vstack([xz[None], ahead])
