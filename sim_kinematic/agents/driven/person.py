"""A person driven from outside: velocity, hands and head in every step, and skills that a command starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.people.kernels.hands import lead_arm, turn_head
from h3data.bodies.people.planted_gait import on_stairs
from h3data.bodies.people.reach import Hand, reacher
from h3data.bodies.people.sitting import take_seats
from h3data.geometry import Array, pose_inverse, pose_multiply, smoothstep
from sim_kinematic.agents.arm_tuck import HANDS
from sim_kinematic.agents.driven.commands import (
    HEAD_PITCH_RAD,
    HEAD_YAW_RAD,
    STAND,
    HandTarget,
    PersonCommand,
)
from sim_kinematic.agents.driven.object_room import ObjectRoom
from sim_kinematic.agents.person import FADE_STEPS, Person
from sim_kinematic.agents.person_skills import HANDS as HANDS_TRIED
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.skills import CHORE, CONTROL, SIT, Action, Skill, SkillResult
from sim_kinematic.agents.stands import nearest_stand
from sim_kinematic.crowd.errands import Motion
from sim_kinematic.crowd.seating import SeatPlace, Seats, leave, remain
from sim_kinematic.motion.gait import drive_people
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.motion.state import HumanState


@dataclass(frozen=True)
class DrivenPersonSpec:
    """Limits of a person who is driven from outside."""

    hand_steps: int = 8
    """Number of steps in which an arm moves from its swing to its target, or back."""
    hand_mps: float = 4.0
    """Largest speed of a hand [m/s]; the palms of people who play in a headset reach 3 m/s."""
    head_rad_s: float = 6.0
    """Largest speed at which the head turns [rad/s]."""
    meeting_m: float = 0.12
    """Distance between the hands of a person and a robot at which the person hands over an object [m]."""
    draws_in_mps: float = 0.4
    """Speed at which the robot's hand closes around the object that it is given [m/s]."""
    eyes_m: float = 1.4
    """Height at which a person who is about to sit down looks ahead [m]."""


DRIVEN = DrivenPersonSpec()


@dataclass(eq=False)
class DrivenPerson(PersonActor):
    """Person that follows `PersonCommand`s; until the first command, the person has the skills of a `PersonActor`."""

    object_room: ObjectRoom | None = None
    """Test of where an object can be put down; None: every place is allowed."""
    radius_m: float = 0.25
    """Radius of the disc that keeps clear of obstacles [m]."""
    command: tuple[float, float] = (0.0, 0.0)
    """Forward and left turn of the last step, -1..1; zero while a skill runs."""
    seats: Seats | None = None
    """Seats of the home; None: the person cannot sit down."""
    seat: SeatPlace | None = None
    """Seat on which the person sits down, sits, or from which they get up."""
    chores: Any = None
    """Work of the hands with things that the person brought along, which also has the methods of a `LearnedSkill` for the
    skill `CHORE`; None: there is no such thing."""
    leaving: Motion | None = None
    """Rest of a motion that was interrupted, or the motion of getting up, which is shown before a command is followed."""
    _tables: Any = None
    """Tables of the feet before they went to the seat."""
    _seated: tuple[Array, float] = field(default_factory=lambda: (np.zeros(3), 0.0))
    """Last place ``(x, z, heading)`` before the seat, and share of sitting."""
    _shares: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    """Progress of the left and the right arm towards their targets, 0..1."""
    _targets: list[HandTarget] = field(default_factory=lambda: [HandTarget((0.0, 0.0, 0.0))] * 2)
    _points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 3)))
    """Points to which the palms are led now, [2, 3] [m]: the targets, but no faster than a hand moves."""
    _head: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    _drives: bool = False

    @property
    def _is_solid(self) -> bool:
        """Return whether the person slides along the discs of the others under commands."""
        return self.company is not None and self.company.solid

    def meets(self) -> bool:
        """Return whether the person touches another agent now, or is nearer to a solid one than allowed."""
        return super().meets() or (self._is_solid and self.company.comes_too_near(self))  # type: ignore[union-attr]

    # --- what it can do -----------------------------------------------------------------------------------------------
    def infeasible(self, action: Action) -> str:
        """Return the reason why an action is impossible now, empty if it is possible; direct control always is."""
        k, skill = action.target, action.skill
        if self.chores is not None and (why := self.chores.infeasible(self, action)):
            return why
        if skill in (CONTROL, CHORE):
            return "no_chore" if skill == CHORE and self.chores is None else ""
        if skill == SIT:
            return "hand_full" if self.person.held else "" if self._nearest_seat(action) is not None else "no_seat"
        # a place without a point of its own is one at the task's goal, as of other people
        if skill in ("drop", "hand_over") or (skill == "place" and action.command):
            held = self.objects.held(self.number)
            if held < 0 or held != k:
                return "not_held"
            if skill == "drop":
                return ""
            if skill == "place" and self.openables is not None and self.openables.barrier_for(k, _point(action)) >= 0:
                return "closed"
            return self._cannot_give(action) if skill == "hand_over" else self._cannot_place(k, _point(action))
        return super().infeasible(action)

    def refusal(self, action: Action) -> str:
        """Return the reason why an action would fail if it started now, as far as known; empty if it would succeed."""
        why = self.infeasible(action)
        if why or action.skill not in ("pick", "place") or action.command:
            return why
        k = action.target
        return self._cannot_reach(self.objects.poses[k, :3] if action.skill == "pick" else self.objects.goals[k], k)

    def stand_for(self, point: ArrayLike) -> Array | None:
        """Return the nearest pose ``(x, z, heading)`` [3] with room from which a hand reaches a world point [3] [m].

        Returns None if there is none. The search may take 50 ms.
        """
        point, held = np.asarray(point, np.float64), self.objects.held(self.number)
        hands: tuple[Hand, ...] = HANDS_TRIED if held < 0 else self._hands(held)
        for hand in hands:
            stands = self._clear_of_open(self.stands(point, hand))
            k, _ = nearest_stand(self.free, stands, self.xz, None, partial(self._has_room, point=point, hand=hand))
            if k >= 0:
                return stands[k]
        return None

    def _cannot_reach(self, point: NDArray, k: int) -> str:
        stand = np.append(self.xz, self.heading)
        near: list[Hand] = [hand for hand in self._hands(k) if self._reaches(stand, point, hand)]
        if not near:
            return "out_of_reach"
        return "" if any(self._has_room(stand, point, hand) for hand in near) else "no_room"

    def _cannot_place(self, k: int, point: NDArray) -> str:
        if self.object_room is not None:
            why = self.object_room.refusal(k, self._upright(k, point), self.objects.poses)
            if why:
                return why
        return self._cannot_reach(point, k)

    def _cannot_give(self, action: Action) -> str:
        robot = self._robot(action)
        if robot is None:
            return "not_a_robot"
        # an arm at work does not yield: its hand is busy although it is empty yet
        if self.objects.held(robot.number) >= 0 or not robot.yields:
            return "robot_busy"
        return self._cannot_reach(self._meeting_point(robot), action.target)

    def _robot(self, action: Action) -> RobotActor | None:
        number, actors = int(action.command[0]), () if self.company is None else self.company.actors
        robot = actors[number] if 0 <= number < len(actors) else None
        return robot if isinstance(robot, RobotActor) else None

    # --- skills -------------------------------------------------------------------------------------------------------
    def start(self, action: Action) -> Skill:
        """Start a skill; one step of direct control counts as a skill too."""
        if action.skill == CONTROL:
            assert isinstance(action.command, PersonCommand)
            return self._control(action.command)
        return self._after_standing(action)

    def idle(self) -> None:
        """Stand still for one step, with planted feet if the person is under direct control."""
        if self._stirs:
            self._drive(STAND)
        else:
            self.command = 0.0, 0.0
            super().idle()

    def _control(self, command: PersonCommand) -> Skill:
        self._drive(command)
        yield
        return SkillResult("done")

    def _after_standing(self, action: Action) -> Skill:
        """Run a skill once the person stands still, with arms and head in the posture that skills expect."""
        self.command = 0.0, 0.0
        while self._stirs:
            self._drive(STAND)
            yield
        self._drives = False
        own: dict[str, Callable[[], Skill]] = {
            "drop": lambda: self._drop(action.target),
            SIT: lambda: self._sit(action),
            "hand_over": lambda: self._give(action),
            CHORE: lambda: self.chores.start(self, action),
        }
        if action.skill in own:
            return (yield from own[action.skill]())
        if action.skill == "place" and action.command:
            return (yield from self._handle(action.target, _point(action)))
        return (yield from super().start(action))

    @property
    def _stirs(self) -> bool:
        """Return whether something of the last commands is still to be seen: a step, a turn, a hand, the head."""
        person = self.person
        moves = self._gait.blend[0] > 0 or not person.walk.stands or person.transition.left > 0
        return self._drives and bool(moves or self.leaving is not None or self._shares.any() or self._head.any())

    def _nearest_seat(self, action: Action) -> SeatPlace | None:
        """Return the nearest seat that the person can use; None: there is none within 3 m."""
        # only people who are driven have this field
        others = () if self.company is None else self.company.actors
        taken = [other.seat.taken for other in others if getattr(other, "seat", None) is not None]
        return self.seats and self.seats.nearest(self.xz, taken, lies=bool(action.command))

    def _sit(self, action: Action) -> Skill:
        """Walk before the nearest seat, sit or lie down and remain there; whatever is asked next gets up first."""
        place = self._nearest_seat(action)
        if place is None:
            return SkillResult("failed", "no_seat")
        x, z, heading = place.before.tolist()
        ahead = np.array([x + math.cos(heading), self.person.base[1] + DRIVEN.eyes_m, z - math.sin(heading)])
        walked = yield from self.walk_to_stand(place.before, ahead)
        self.person.look_at = None
        if walked.outcome != "done":
            return walked
        # sitting down begins with feet that stand
        yield from self.person.settle()
        walk = self.person.walk
        # feet that keep out of furniture would be pushed away from the seat that they stand close to
        self._tables, walk.tables = walk.tables, on_stairs(self.person.body.gait_tables, walk.tables.heights)
        self.seat = place
        try:
            return (yield from self.perform(remain(np.append(self.xz, self.heading), place)))
        finally:
            # also where another command closes this generator: getting up begins from wherever they are
            self.leaving = leave(*self._seated, place)

    def perform(self, motion: Motion) -> Skill:
        """Show a motion from step to step; what an interruption leaves of it is shown before the next command is followed."""
        self.leaving = motion
        while self._go_on():
            yield
        return SkillResult("done")

    def _go_on(self) -> bool:
        """Make one step of `leaving`; False: it is over."""
        moved = None if self.leaving is None else next(self.leaving, None)
        if moved is None:
            self.leaving = None
            if self.seat is not None:
                # not before they are off the seat: feet that keep out of furniture would be pushed away from it
                self.seat, self.person.walk.tables = None, self._tables
            return False
        self._drives, self.command, self._seated = True, (0.0, 0.0), moved
        show_seated(self.person, self.seat, *moved)
        self._follow()
        return True

    def _drop(self, k: int) -> Skill:
        person, name = self.person, self.objects.names[k]
        hand = self._hands(k)[0]
        # before the hand opens: the grip knows how the object stood
        pose = self._upright(k, person.objects[name][:3])
        del person.held[hand]
        person.objects[name] = pose if self.object_room is None else self.object_room.fallen(k, pose)
        # blended, as the arm goes from carrying to hanging in this step
        person.leave()
        for _ in range(FADE_STEPS):
            self._drive(STAND)
            yield
        return SkillResult("done")

    def _give(self, action: Action) -> Skill:
        """Bring the hand near the robot's; there the object changes hands, and the robot draws it into its own.

        The robot needs to keep still for it.
        """
        robot, k = self._robot(action), action.target
        assert robot is not None, "checked before it starts"
        hand, name, point = self._hands(k)[0], self.objects.names[k], self._meeting_point(robot)
        motion = self._careful(self.person.place(point, hand))
        grip, apart = self.objects.state.grip_pose[0, k], np.zeros(3)
        self.yields, given = False, False
        while True:
            near = float(np.linalg.norm(robot.hand_pose[:3] - point)) <= robot.grip_m
            if not given and (not near or self.objects.held(robot.number) >= 0 or not robot.yields):
                return SkillResult("failed", "robot_moved" if not near else "robot_busy")
            try:
                next(motion)
            except StopIteration as end:
                return SkillResult("done") if given else SkillResult("failed", end.value.reason or "out_of_reach")
            if not given and hand not in self.person.held:
                given = True
                self.objects.held_by[k] = robot.number
                grip[:] = pose_multiply(pose_inverse(robot.hand_pose), self.objects.poses[k])
                apart = grip[:3].copy()
            elif given:
                left = float(np.linalg.norm(grip[:3]))
                grip[:3] = apart * (max(left - DRIVEN.draws_in_mps * STEP_S, 0.0) / float(np.linalg.norm(apart)))
                self.objects.poses[k] = pose_multiply(robot.hand_pose, grip)
            if given:
                self.person.objects[name] = self.objects.poses[k].copy()
            yield

    def _meeting_point(self, robot: RobotActor) -> Array:
        """Return the point at which the hand gives, beside the robot's on the person's side, in the world [3]."""
        hand = robot.hand_pose[:3]
        towards = np.array([self.xz[0] - hand[0], 0.0, self.xz[1] - hand[2]])
        # no farther than the person, who may stand nearer than that
        return hand + towards * (DRIVEN.meeting_m / max(float(np.linalg.norm(towards)), DRIVEN.meeting_m))

    def _upright(self, k: int, point: NDArray) -> Array:
        """Return pose7 of what is held, put down at a point as it stood when it was taken."""
        return np.concatenate([point, self.person.upright(self.person.held[self._hands(k)[0]])])

    # --- one step under a command -------------------------------------------------------------------------------------
    def _drive(self, command: PersonCommand) -> None:
        """Move the person by one step of direct control.

        A motion that would touch an agent that the person avoids is not made. Where other agents are solid, contact is
        decided by their discs at the places where the player's page shows them.
        """
        if self._go_on():
            return
        self._drives, self.person.look_at = True, None
        gait, before = self._gait_here(), self._posture()
        # once for both attempts: arms and head go on where the step is not made
        self._lead(command)
        stopped = gait.copy()
        for velocity in ((command.forward, command.turn), (0.0, 0.0)):
            self.command = velocity
            others = self.company.discs_beside(self.number)[None] if self._is_solid and self.company else None
            drive_people(
                gait, self.free, np.array([velocity]), self.spec, radius_m=self.radius_m, backwards=True, others=others
            )
            self._show(gait)
            if others is not None or not self.meets():
                break
            self._gait = gait = stopped.copy()
            self._take(before)
        self._follow()

    def _lead(self, command: PersonCommand) -> None:
        """Bring arms and head on by one step."""
        for k, target in enumerate((command.left, command.right)):
            rate = 1 / DRIVEN.hand_steps
            tilts, hand = target is not None and target.rotation is not None, HANDS[k]
            self.person.tilts[hand] += min(max(float(tilts) - self.person.tilts[hand], -rate), rate)
            if target is None:
                self._shares[k] = max(self._shares[k] - rate, 0.0)
                continue
            way = np.array(target.position) - self._points[k]
            # an arm that hangs has no point to come from: it takes the target and blends over to it
            most = DRIVEN.hand_mps * STEP_S / max(float(np.linalg.norm(way)), 1e-9) if self._shares[k] else 1.0
            self._points[k] += min(most, 1.0) * way
            self._targets[k], self._shares[k] = target, min(self._shares[k] + rate, 1.0)
        most = DRIVEN.head_rad_s * STEP_S
        aim = np.zeros(2) if command.head is None else np.array(command.head)
        aim = np.clip(aim, (-HEAD_YAW_RAD, -HEAD_PITCH_RAD), (HEAD_YAW_RAD, HEAD_PITCH_RAD))
        self._head += np.clip(aim - self._head, -most, most)

    def _show(self, gait: HumanState) -> None:
        """Take the pose of a gait, with arms and head led to their targets."""
        person, body = self.person, self.person.body
        person.base = person.root_at(gait)
        person.walk.step(person.base)
        quats, pelvis = person.walk.pose()
        quats = person.with_arms(quats)
        for k, hand in enumerate(HANDS):
            if self._shares[k] > 0:
                target, share, solver = self._targets[k], self._shares[k], reacher(body, hand)
                # the kernel takes an array in either case, and the flag below says whether it counts
                turn = np.array([0.0, 0.0, 0.0, 1.0]) if target.rotation is None else np.array(target.rotation)
                lead_arm(
                    solver.body,
                    solver.table.values,
                    solver.table.low,
                    solver.table.step,
                    quats,
                    pelvis,
                    self._points[k],
                    turn,
                    target.rotation is not None,
                    smoothstep(share),
                )
        if self._head.any():
            turn_head(quats, *self._head)
        person.show("walk", quats, pelvis)


def _point(action: Action) -> Array:
    return np.array(action.command, np.float64)


def show_seated(person: Person, place: SeatPlace | None, at: Array, share: float) -> None:
    """Pose a person at a place ``(x, z, heading)`` [3], between standing (share 0, or no seat) and sitting (1)."""
    gait = HumanState.zeros(1)
    gait.xz[0], gait.heading[0] = at[:2], at[2]
    person.base = person.root_at(gait)
    quats, pelvis = person.walk.stride(person.base, person.heading)
    quats = person.with_arms(quats)
    if place is not None:
        take_seats(person.body, quats[None], pelvis[None], [(place.seat.height_m, share)])
    person.show("walk", quats, pelvis)
