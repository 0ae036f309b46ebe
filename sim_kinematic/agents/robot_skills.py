"""The skills of a robot with an arm (paper section 4.2; spec/habitat.md 2.3, 2.4)."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Robot, solve_ik
from h3data.errors import InputError
from h3data.geometry import Array, ground_pose, pose_from_matrix, pose_inverse, pose_multiply, wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.agents.manipulation import grip_objects, move_arms, robot_hands
from sim_kinematic.agents.robot_arm_clearance import ArmWay, reach_line
from sim_kinematic.agents.skills import CONTROL, PRIMITIVES, Action, Ending, Objects, Skill
from sim_kinematic.agents.stands import hand_turn, nearest_stand, robot_stands
from sim_kinematic.avoidance.velocity import is_crowded, keep_clear
from sim_kinematic.avoidance.yielding import NO_WAY, Seen, avoided, room_to_pass, round_others
from sim_kinematic.motion.spec import STEP_S, ArmSpec, BaseSpec
from sim_kinematic.motion.state import NOBODY, ROBOT, RobotState
from sim_kinematic.motion.step import drive_robots

STUCK_STEPS = 60
"""A base that has not come nearer to where it wants to be for so long gives up."""
LOOKS_ROUND = (10, 40)
"""After so many steps without progress it looks for a way round those who stand,"""
DETOURS = 3
"""at most so often on one way;"""
VIA_M = 0.25
"""it is at a point of it when it is this near."""
PASSING_M = (0.4, 0.1)
"""Room that it leaves beside them, the less where there is no more."""
ARRIVED_M, NEARLY_M, FACING_RAD = 0.04, 0.15, 0.04


def checked_command(command: ArrayLike, robot: Robot) -> Array:
    """A command of the lower layer in -1..1: base [2], arm [n], grip [1].

    Raises:
        InputError: it has another length or is not finite.
    """
    count = len(robot.require_arm()) + 3
    try:
        action = np.asarray(command, np.float64)
    except (TypeError, ValueError):
        action = np.full(0, np.nan)
    if action.shape != (count,) or not np.isfinite(action).all():
        raise InputError(f"Expected a command of {count} finite numbers (base 2, arm, grip 1), got {command!r}.")
    return np.clip(action, -1.0, 1.0)


@dataclass(eq=False)
class RobotActor:
    """A robot with an arm. It moves ``objects.state``."""

    robot: Robot
    free: FreeSpace
    base: BaseSpec
    objects: Objects
    grip_m: float
    arm_rad_s: float
    number: int = ROBOT
    """Of the agent."""
    room: ArmWay | None = None
    """Looks where its arm would be; None: nobody does."""
    avoids: bool = True
    """Whether its base keeps clear of the others (`keep_clear`), whatever the skill."""
    others: tuple[Seen, ...] = ()
    """Who else is there, the nearest first."""
    agreed: bool = False
    """Whether all agents step aside for each other (`sim_kinematic.avoidance.right_of_way.Walker`)."""
    meets: Callable[[], bool] = field(default=lambda: False)
    """Whether it touches somebody as it is now: then it stops where it was."""
    way: NDArray[np.floating] = field(default_factory=lambda: NO_WAY)
    yields: bool = True
    aside: NDArray[np.float64] | None = None
    hindered_by: frozenset[int] = frozenset()
    command: tuple[float, float] = (0.0, 0.0)
    """What the base was last told, -1..1 of the limits."""
    arm_goal: Array = field(init=False)

    def __post_init__(self) -> None:
        self.arm_goal = self.robot.rest.copy()
        self.hand = self.robot.hand_name
        self._arm = np.array(self.robot.require_arm())

    # --- where it is --------------------------------------------------------------------------------------------------
    @property
    def state(self) -> RobotState:
        """Its own part of the state of one world."""
        return self.objects.state.robots[self.number]

    @property
    def is_robot(self) -> bool:
        return True

    @property
    def xz(self) -> NDArray:
        return self.state.xz[0]

    @property
    def heading(self) -> float:
        return float(self.state.heading[0])

    @property
    def joints(self) -> NDArray:
        return self.state.joints[0]

    @property
    def arm(self) -> NDArray:
        """Positions of the joints that move the hand [n], a copy."""
        return self.joints[self._arm]

    @property
    def pose(self) -> Array:
        """pose7 of the agent root."""
        return ground_pose(self.xz, self.heading, self.free.floor_y)

    @property
    def hand_pose(self) -> Array:
        """pose7 of the place where the hand holds things, in the world."""
        frame = self.robot.link_matrices(self.pose[None], self.joints[None])[0, self.robot.hand_link]
        out = pose_from_matrix(frame)
        out[:3] += frame[:3, :3] @ self.robot.hand_position
        return out

    # --- skills -------------------------------------------------------------------------------------------------------
    def infeasible(self, action: Action) -> str:
        why = self.objects.why_not(self.number, action)
        if why or action.skill not in ("pick", "place"):
            return why
        if self._posture(self._hand_target(action)) is None:
            return "out_of_reach"
        point = self.objects.poses[action.target, :3] if action.skill == "pick" else self.objects.goals[action.target]
        opens = self.room is None or self.room.is_open(np.append(self.xz, self.heading), point)
        return "" if opens else "no_room"

    def start(self, action: Action) -> Skill:
        k = action.target
        if action.skill in PRIMITIVES:
            forward, turn, steps = PRIMITIVES[action.skill]
            return self._move(forward, turn, steps)
        if action.skill == CONTROL:
            return self._control(action.command)
        if action.skill == "wait":
            return self._wait(action.steps)
        if action.skill.startswith("nav"):
            return self._navigate(
                self.objects.poses[k, :3] if action.skill == "nav_to_object" else self.objects.goals[k]
            )
        return self._pick(k) if action.skill == "pick" else self._place(k)

    def idle(self) -> None:
        self._step(0.0, 0.0)

    def _move(self, forward: float, turn: float, steps: int) -> Skill:
        for _ in range(steps):
            self._step(forward, turn)
            yield
        return Ending("done")

    def _wait(self, steps: int) -> Skill:
        """Stand, out of the way of others."""
        goal = None if self.agreed else room_to_pass(self.free, self.xz, self.others)
        for _ in range(steps):
            if self.aside is not None:
                self._step_aside()
            elif goal is None or float(np.hypot(*(goal - self.xz))) < VIA_M:
                self._step(0.0, 0.0)
            else:
                self._drive(self._waypoint(goal))
            yield
        return Ending("done")

    def _step_aside(self) -> None:
        """One step of doing so, or of standing there."""
        if self.aside is not None and len(self.aside):
            self._drive(self.aside[0])
        else:
            self._step(0.0, 0.0)

    def _drive(self, towards: NDArray, most: float = 1.0) -> None:
        """One step towards a floor point [2], at most at this share of the speed."""
        error = self._error_to(towards)
        self._step(min(self._no_faster_than(towards, error), most), self._turn(error), towards)

    def _control(self, command: tuple[float, ...]) -> Skill:
        """One step by base velocity, arm joints and grip; it gives way to nobody."""
        state, robot, rules = self.objects.state, self.robot, ArmSpec(grasp_m=self.grip_m)
        action = checked_command(command, robot)
        self.command = float(action[0]), float(action[1])
        drive_robots(self.state, self.free, action[None, :2], self.base)
        move_arms(self.state, robot, action[None, 2:-1], rules)
        self.arm_goal = self.joints.copy()
        hand = robot_hands(self.state, robot, self.free.floor_y)
        grip_objects(state, hand, action[-1:], rules, agent=self.number)
        yield
        return Ending("done")

    def _navigate(self, point: NDArray) -> Skill:
        """Drive to where the hand reaches a world point [3], and turn to it."""
        stands = robot_stands(self.free, self.robot, self.base, point)
        k, left = self._stand_with_room(stands, point)
        if not np.isfinite(left):
            gets_there = np.isfinite(nearest_stand(self.free, stands, self.xz)[1])
            return Ending("failed", "no_room" if gets_there else "no_way")
        goal, best, since, detours = stands[k, :2], np.inf, 0, 0
        via = NO_WAY  # round those who stand in the way
        while since <= STUCK_STEPS:
            if self.aside is not None:
                self._step_aside()
                yield
                best, since, via = np.inf, 0, NO_WAY
                continue
            if since in LOOKS_ROUND and detours < DETOURS and self.others:
                found = round_others(self.free, self.xz, goal, self.others, self.base.disc_radius_m, PASSING_M)
                if found is not None:
                    via, best, detours = found[:-1], np.inf, detours + 1
            if len(via) and np.hypot(*(via[0] - self.xz)) < VIA_M:
                via, best = via[1:], np.inf
            self.way = np.vstack([self.xz, *(via if len(via) else self.free.path(self.xz, goal, max_snap_m=1.0)), goal])
            left = float(self.free.geodesic(self.xz, via[0] if len(via) else goal, max_snap_m=1.0))
            if not len(via) and (left <= ARRIVED_M or (left <= NEARLY_M and since > LOOKS_ROUND[0])):
                error = self._error_to(point[[0, 2]])
                if abs(error) < FACING_RAD:
                    return Ending("done")
                self._step(0.0, self._turn(error), goal)
                left = 0.1 * abs(error) - 1.0
            else:
                self._drive(self._waypoint(via[0] if len(via) else goal), left / self._stride_m)
            yield
            best, since = (left, 0) if left < best - 1e-3 else (best, since + 1)
        return Ending("failed", "stuck")

    def _stand_with_room(self, stands: Array, point: NDArray) -> tuple[int, float]:
        """The nearest stand, as `nearest_stand`, from which its arm touches nothing on the way to a world point [3]; else one
        where at least nothing is in between."""
        crowded, asks = self._crowded(stands), (None,)
        if self.room is not None:
            asks = (partial(self.room.is_clear, point=point), partial(self.room.is_open, point=point))
        found = -1, np.inf
        for asked in asks:
            found = nearest_stand(self.free, stands, self.xz, crowded, asked)
            if found[0] >= 0:
                break
        return found

    def _crowded(self, stands: Array) -> NDArray[np.integer]:
        """At which stands it would be too near to somebody, [N]: 1 within its margin, 2 where they would touch."""
        crowded = np.zeros(len(stands), np.int64)
        for other in avoided([other for other in self.others if not other.steps_aside]):
            for level, margin in ((1, other.spec.margin_m), (2, other.spec.still_margin_m)):
                near = is_crowded(self.base, stands, other.xz, replace(other.spec, margin_m=margin))
                crowded = np.maximum(crowded, near * level)
        return crowded

    @property
    def _stride_m(self) -> float:
        """The longest way of one step."""
        return self.base.max_speed_mps * STEP_S

    def _no_faster_than(self, towards: NDArray, error: float) -> float:
        """The command to drive ahead, 0..1, with a heading error [rad]: slow enough to turn to a near point, not round it."""
        ahead, aside = max(0.0, float(np.cos(error))) ** 2, abs(float(np.sin(error)))
        turned = self.base.max_turn_rad_s * STEP_S * float(np.hypot(*(towards - self.xz)))
        return min(ahead, 0.5 * turned / max(aside * self._stride_m, 1e-9))

    def _turn(self, error: float) -> float:
        """The command that removes a heading error [rad] in one step, if the limit allows."""
        return float(np.clip(error / (self.base.max_turn_rad_s * STEP_S), -1, 1))

    def _waypoint(self, goal: NDArray) -> NDArray:
        found = self.free.next_waypoint(self.xz, goal, beyond_m=self.base.disc_radius_m / 2, max_snap_m=1.0)
        return goal if np.isnan(found).any() else found

    def _pick(self, k: int) -> Skill:
        over, at = self._reach_line(self._hand_target(Action("pick", k)))
        for posture in (over, at):
            yield from self._bring_arm(posture)
        gap = float(np.linalg.norm(self.hand_pose[:3] - self.objects.poses[k, :3]))
        if gap > self.grip_m or self.objects.held_by[k] != NOBODY:
            self.arm_goal = self.robot.rest.copy()
            return Ending("failed", "out_of_reach" if gap > self.grip_m else "held_by_other")
        self.objects.held_by[k] = self.number
        self.objects.state.grip_pose[0, k] = pose_multiply(pose_inverse(self.hand_pose), self.objects.poses[k])
        yield from self._bring_arm(over)
        self.arm_goal = self.robot.rest.copy()  # carried there while it drives on
        return Ending("done")

    def _place(self, k: int) -> Skill:
        over, at = self._reach_line(self._hand_target(Action("place", k)))
        for posture in (over, at):
            yield from self._bring_arm(posture)
        self.objects.held_by[k] = NOBODY
        yield from self._bring_arm(over)
        self.arm_goal = self.robot.rest.copy()
        return Ending("done")

    # --- how ----------------------------------------------------------------------------------------------------------
    def _hand_target(self, action: Action) -> Array:
        """pose7 of the hand's place in the agent root frame for a pick or a place."""
        k = action.target
        there = self.objects.poses[k, :3] if action.skill == "pick" else self.objects.goals[k]
        local = pose_multiply(pose_inverse(self.pose), np.append(there, [0, 0, 0, 1.0]))
        if action.skill == "pick":
            return np.concatenate([local[:3], hand_turn(self.robot)])
        grip = self.objects.state.grip_pose[0, k]
        turned = pose_multiply(np.append(np.zeros(3), hand_turn(self.robot)), grip)
        return np.concatenate([local[:3] - turned[:3], hand_turn(self.robot)])

    def _posture(self, hand: Array) -> Array | None:
        answer = solve_ik(self.robot, self.hand, hand, offset=self.robot.hand_position)
        return answer.joint_pos if answer.reached else None

    def _reach_line(self, hand: Array) -> tuple[Array, Array]:
        """Postures over the target and at it."""
        line = reach_line(self.robot, hand)
        assert line is not None, "checked before it starts"
        return line

    def _bring_arm(self, posture: Array) -> Generator[None, None, None]:
        self.arm_goal, self.yields = posture, False
        while np.any(self.joints[self._arm] != posture[self._arm]):
            self._step(0.0, 0.0, heed=False)
            yield

    def _error_to(self, xz: NDArray) -> float:
        dx, dz = xz - self.xz
        return float(wrap_angle(np.arctan2(-dz, dx) - self.heading))

    def _seen(self) -> list[Seen]:
        """The others; who holds something has not settled, however long she has been standing."""
        return [o._replace(settled=o.settled and self.objects.held(o.number) < 0) for o in self.others]

    def _step(self, forward: float, turn: float, towards: NDArray | None = None, *, heed: bool = True) -> None:
        """One step of base and arm; what is held follows. Where it would touch somebody it does not get on."""
        self.command = forward, turn
        if self.avoids and heed:
            aim = self.xz if towards is None else towards
            self.command = keep_clear(
                self.free,
                self.base,
                self.xz.copy(),
                self.heading,
                self.command,
                aim,
                avoided(self._seen(), agreed=self.agreed),
            )
        state, before = self.state, self.state.copy()
        drive_robots(state, self.free, np.array([self.command]), self.base)
        most = self.arm_rad_s * STEP_S
        way = self.arm_goal[self._arm] - self.joints[self._arm]
        far = float(np.abs(way).max())
        self.joints[self._arm] = (
            self.arm_goal[self._arm] if far <= most else self.joints[self._arm] + way * (most / far)
        )
        if self.meets():
            state.xz[:], state.heading[:] = before.xz, before.heading
            if self.meets():
                state.joints[:] = before.joints
        k = self.objects.held(self.number)
        if k >= 0:
            self.objects.poses[k] = pose_multiply(self.hand_pose, self.objects.state.grip_pose[0, k])
