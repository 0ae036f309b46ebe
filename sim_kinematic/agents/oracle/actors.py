"""Robots and people with the oracle skills of `sim_kinematic.motion.spec.OracleSpec`.

Their rules (`sim_kinematic.agents.oracle.rules`) are shared with worlds on a device, `h3data_training.torch.rearrange`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.reach import reacher
from h3data.geometry import IDENTITY_POSE, Array, pose_inverse, pose_multiply, wrap_angle
from sim_kinematic.agents.giving_way import AnyActor, GivingWay
from sim_kinematic.agents.oracle.rules import AIMED_RAD, VIA_M, gets_on, is_there, left_to_do, reaches
from sim_kinematic.agents.oracle.ways import NONE, PathTable
from sim_kinematic.agents.person import CARRY, Held
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.robots.driving import FACING_RAD, STUCK_STEPS
from sim_kinematic.agents.robots.hand_reach import reach_bearing
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.skills import CONTROL, OPENING_SKILLS, PRIMITIVES, Action, Skill, SkillResult
from sim_kinematic.motion.gait import move_people
from sim_kinematic.motion.spec import STEP_S, OracleSpec
from sim_kinematic.motion.state import NOBODY


class SubGoal(NamedTuple):
    """Place to which a skill with an object, a door or a drawer leads."""

    ways: PathTable
    """Shortest paths to the places from which the agent reaches the sub-goal."""
    point: Array
    """Place of the sub-goal [3] [m]."""


@dataclass(eq=False)
class SubGoals:
    """Sub-goals of one agent: paths to the initial place and the goal of each object."""

    oracle: OracleSpec
    to_start: Sequence[PathTable]
    """Paths to the initial place of each object; ``to_goal`` has the paths to its goal."""
    to_goal: Sequence[PathTable]
    starts: Array
    """Initial positions of the objects [K, 3] [m]."""
    goals: Array
    to_part: Mapping[int, SubGoal]
    """Sub-goals at the handles of the doors and drawers that the agent may open, by joint, with these parts at rest."""

    def of(self, action: Action, poses: Array) -> SubGoal:
        """Return the sub-goal of a skill with an object or at a handle, given the poses [K, 7] of all objects."""
        k = action.target
        if action.skill in OPENING_SKILLS:
            return self.to_part[k]
        # exactly, because an oracle agent puts an object at its goal to the bit
        moved = action.skill in ("nav_to_goal", "place") or bool((poses[k, :3] == self.goals[k]).all())
        return SubGoal((self.to_goal if moved else self.to_start)[k], (self.goals if moved else self.starts)[k])

    def reaches(self, errand: SubGoal, xz: Array, error_rad: float) -> bool:
        """Return whether an agent at floor point ``xz`` [2] has arrived; ``error_rad`` is the angle to its target."""
        return bool(reaches(self.oracle, errand.ways.ends - xz, error_rad))


def carry_point(body: Robot | Humanoid) -> Array:
    """Return the position of a held object in its agent's root frame [3] [m]: in the hand, or before the chest."""
    if isinstance(body, Robot):
        frame = body.link_matrices(IDENTITY_POSE[None], body.rest[None])[0, body.hand_link]
        return frame[:3, 3] + frame[:3, :3] @ body.hand_position
    return np.array(CARRY) * reacher(body, "right").body.scale


def _way(errand: SubGoal, number: int, xz: Array, within_m: float) -> tuple[int, float]:
    """Return the point to go to now, and how far it is: the next one where a corner has been reached."""
    ways = errand.ways
    away = float(np.hypot(*(ways.points[number] - xz)))
    if number < ways.corners and away <= within_m:
        number = int(ways.after[number])
        away = float(np.hypot(*(ways.points[number] - xz)))
    return number, away


@dataclass(eq=False)
class OracleRobot(RobotActor):
    """A robot with oracle skills."""

    errands: SubGoals = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        # oracle agents heed nobody, which is simple enough for a device to repeat
        self.avoids = False

    def infeasible(self, action: Action) -> str:
        """Return the reason why an action is impossible now; empty if it is possible."""
        return _refusal(self, action)

    def start(self, action: Action) -> Skill:
        """Begin a primitive motion, direct control, waiting, or an oracle skill."""
        if action.skill in PRIMITIVES:
            return self._move(*PRIMITIVES[action.skill])
        if action.skill == CONTROL:
            return self._control(action.command)
        if action.skill == "wait":
            return self._move(0.0, 0.0, max(action.steps, 1))
        errand = self.errands.of(action, self.objects.poses)
        if action.skill.startswith("nav"):
            return self._go(errand)
        return _handling(self, action, errand, partial(self._step, 0.0, 0.0), self.errands.oracle.robot_steps)

    def facing_error(self, errand: SubGoal) -> float:
        """Return the angle by which the robot must turn to have its target in its reach direction [rad]."""
        return self._error_to(errand.point[[0, 2]], reach_bearing(self.robot))

    def _go(self, errand: SubGoal) -> Skill:
        """Drive along a path, and at its end turn until the hand points at its target."""
        ways, (number, best, since) = errand.ways, (errand.ways.start(self.xz), np.inf, 0)
        while since <= STUCK_STEPS:
            before = number
            number, away = _way(errand, number, self.xz, VIA_M)
            # the next corner is farther away than the one just reached, which would count as a stall
            best = best if number == before else np.inf
            is_end, error = number >= ways.corners, self.facing_error(errand)
            on_the_way, turning = left_to_do(away, error)
            turns = is_there(away, is_end, best, since)
            if turns:
                self._step(0.0, self._turn(error))
            else:
                self._drive(ways.points[number], away if is_end else np.inf)
            left = turning if turns else on_the_way
            best, since = (left, 0) if gets_on(left, best) else (best, since + 1)
            yield
            away = float(np.hypot(*(ways.points[number] - self.xz)))
            if is_there(away, is_end, best, since) and abs(self.facing_error(errand)) < FACING_RAD:
                return SkillResult("done")
        return SkillResult("failed", "stuck")

    def take(self, k: int) -> None:
        """Take an object into the hand, in which it keeps its orientation in the world."""
        hand, pose = self.hand_pose, self.objects.poses[k]
        turn = pose_multiply(pose_inverse(hand), np.append(hand[:3], pose[3:]))
        self.objects.state.grip_pose[0, k] = turn
        self.objects.poses[k] = pose_multiply(hand, turn)

    def release(self) -> None:
        """Note that the agent no longer holds anything."""


@dataclass(eq=False)
class OraclePerson(PersonActor):
    """Person with oracle skills, who holds objects in front of their chest."""

    errands: SubGoals = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._carry = np.append(carry_point(self.person.body), (0.0, 0.0, 0.0, 1.0))

    def infeasible(self, action: Action) -> str:
        """Return the reason why an action is impossible now; empty if it is possible."""
        if action.skill in (*PRIMITIVES, CONTROL):
            return "not_of_a_person"
        return _refusal(self, action)

    def start(self, action: Action) -> Skill:
        """Begin waiting or an oracle skill."""
        if action.skill == "wait":
            return self._wait(max(action.steps, 1))
        errand = self.errands.of(action, self.objects.poses)
        if action.skill.startswith("nav"):
            return self._go(errand)
        return _handling(self, action, errand, self._stand, self.errands.oracle.person_steps)

    def facing_error(self, errand: SubGoal) -> float:
        """Return the angle by which the person must turn to face their target [rad]."""
        dx, dz = errand.point[[0, 2]] - self.xz
        return float(wrap_angle(np.arctan2(-dz, dx) - self.heading))

    def _go(self, errand: SubGoal) -> Skill:
        """Walk straight from corner to corner, turning on the spot at each, and turn to the target at the end."""
        ways, number, within = errand.ways, errand.ways.start(self.xz), self.spec.arrive_m
        # no count of stalled steps as for robots: nobody is in their way, and the legs of the path are free
        while True:
            number, away = _way(errand, number, self.xz, within)
            if number >= ways.corners and away <= within:
                self._turn_by(self.facing_error(errand))
            else:
                self._pace(ways.points[number])
            yield
            arrived = number >= ways.corners and np.hypot(*(ways.points[number] - self.xz)) <= within
            if arrived and abs(self.facing_error(errand)) < AIMED_RAD:
                return SkillResult("done")

    def _turn_by(self, error_rad: float) -> None:
        gait, most = self._gait_here(), self.spec.turn_rad_s * STEP_S
        move_people(gait, gait.xz.copy(), gait.heading + min(max(error_rad, -most), most), self.spec)
        self.person.stride(gait)
        self._follow()

    def take(self, k: int) -> None:
        """Place an object in front of the chest, in its present orientation, with the right arm posed to hold it."""
        name, pose = self.objects.names[k], self.objects.poses[k]
        stood = pose_multiply(pose_inverse(self.person.base), pose)[3:]
        # relative to the root, so that the object turns with the person
        self._carry[3:] = stood
        self.person.objects[name] = pose.copy()
        # for the arm, which carries something now; where the object is `_follow` says
        self.person.held = {"right": Held(name, np.array([0, 0, 0, 0, 0, 0, 1.0]), stood)}
        self._follow()

    def release(self) -> None:
        """Let go of the object in the person's hand."""
        self.person.held = {}

    def _follow(self) -> None:
        k = self.objects.held(self.number)
        if k >= 0:
            self.objects.poses[k] = pose_multiply(self.person.base, self._carry)


def _refusal(actor: OracleRobot | OraclePerson, action: Action) -> str:
    """Return the reason why a skill cannot start now; an empty text if it can."""
    why = actor.objects.why_not(actor.number, action)
    # without an object there is no place to be at
    if why or action.target < 0:
        return why
    if action.skill in OPENING_SKILLS and action.target not in actor.errands.to_part:
        return "no_way"
    errand = actor.errands.of(action, actor.objects.poses)
    if action.skill.startswith("nav"):
        return "no_way" if errand.ways.start(actor.xz) == NONE else ""
    return "" if actor.errands.reaches(errand, actor.xz, actor.facing_error(errand)) else "out_of_reach"


def _handling(
    actor: OracleRobot | OraclePerson,
    action: Action,
    errand: SubGoal,
    stands: Callable[[], None],
    steps: tuple[int, int],
) -> Skill:
    """Stand still for a pick or a place, in the course of which the object changes hands, or until a part opens or closes."""
    changes, ends = steps
    for step in range(1, ends + 1):
        stands()
        # the attempt takes this step, also where it fails
        why = _hand_over(actor, action, errand) if step == changes else ""
        yield
        if why:
            return SkillResult("failed", why)
    return SkillResult("done")


def _hand_over(actor: OracleRobot | OraclePerson, action: Action, errand: SubGoal) -> str:
    """Take an object or put it down, open or close a part; return why that fails."""
    objects, k = actor.objects, action.target
    if action.skill in OPENING_SKILLS:
        objects.openables.move(
            k, getattr(objects.openables.joints, "opened" if action.skill == "open" else "closed")[k]
        )
        return ""
    if action.skill == "place":
        objects.held_by[k] = NOBODY
        objects.poses[k, :3] = errand.point
        actor.release()
        return ""
    if objects.held_by[k] != NOBODY:
        return "held_by_other"
    # the errand is from the beginning of the skill; the object may have been carried away since
    if (objects.poses[k, :3] != errand.point).any():
        return "missed"
    objects.held_by[k] = actor.number
    actor.take(k)
    return ""


class DiscContacts(GivingWay):
    """Contact rule of agents that do not give way and that touch if their discs overlap."""

    def avoids(self, me: AnyActor, other: AnyActor) -> bool:
        """Return False: with oracle skills no agent gives way to another."""
        return False

    def _touch(self, a: int, b: int) -> bool:
        one, other = self.discs_of(a), self.discs_of(b)
        gap = one[:, None, :2] - other[None, :, :2]
        return bool((np.hypot(gap[..., 0], gap[..., 1]) < one[:, None, 2] + other[None, :, 2]).any())
