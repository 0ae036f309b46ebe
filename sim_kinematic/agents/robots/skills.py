"""The skills of a robot with an arm (paper section 4.2; spec/habitat.md 2.3, 2.4)."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.geometry import Array, pose_inverse, pose_multiply, wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.agents.manipulation import grip_objects, move_arms, robot_hands
from sim_kinematic.agents.opening.openables import ArticulatedParts, stands_clear
from sim_kinematic.agents.opening.skills import Leading, full_travel, handle_path, stands_before, why_not
from sim_kinematic.agents.robots.arm_clearance import reach_line
from sim_kinematic.agents.robots.driving import RobotDriver
from sim_kinematic.agents.robots.hand_reach import (
    HAND_REACH,
    aimed,
    hand_turn,
    is_beyond_reach,
    reach_bearing,
    reach_distances,
    reach_posture,
)
from sim_kinematic.agents.skills import CONTROL, PRIMITIVES, SEARCH, Action, LearnedSkill, Skill, SkillResult
from sim_kinematic.agents.stands import STANDS, handle_stands, island_of, nearest_stand, robot_stands
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.velocity import crowding
from sim_kinematic.avoidance.yielding import shut_off
from sim_kinematic.motion.spec import ArmSpec, BaseSpec
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.motion.step import drive_robots

TRIED, TURN_M_RAD = 24, 1.0
"""Number of nearest stands that are compared, and length of path that costs as much as turning by one radian [m]."""
ARM_OUT_M = 0.05
"""Distance of the hand from the base's middle, beyond that of the folded arm, above which a base does not drive [m]."""


def checked_command(command: ArrayLike, robot: Robot) -> Array:
    """Return a low-level command clipped to -1..1: base [2], arm [n], and grip [1].

    Raises:
        InputError: The command has another length or is not finite, or the robot has no arm.
    """
    count = len(robot.require_arm()) + 3
    try:
        action = np.asarray(command, np.float64)
    except (TypeError, ValueError):
        # of a wrong shape, so that one message refuses whatever was given
        action = np.full(0, np.nan)
    if action.shape != (count,) or not np.isfinite(action).all():
        raise InputError(
            f"Expected a command of {count} finite numbers (base 2, arm, grip 1), got {command!r}.", code="H3-SIM-018"
        )
    return np.clip(action, -1.0, 1.0)


@dataclass(eq=False)
class RobotActor(RobotDriver):
    """Robot with an arm, and its skills."""

    learned: Mapping[str, LearnedSkill] = field(default_factory=dict)
    """Learned skills that replace the robot's scripted skills, by name."""

    def infeasible(self, action: Action) -> str:
        """Return the reason why an action is impossible now; empty if it is possible."""
        why = self.objects.why_not(self.number, action)
        if not why and self.openables is not None:
            why = self._barred(self.openables, action)
        # learned picks and places drive there themselves, so reach from here does not count
        if action.skill in self.learned:
            return why or self.learned[action.skill].infeasible(self, action)
        if why or action.skill not in ("pick", "place"):
            return why
        if self._posture(self._hand_target(action)) is None:
            return "out_of_reach"
        point = self.objects.poses[action.target, :3] if action.skill == "pick" else self.objects.goals[action.target]
        clearance = self.arm_clearance
        is_open = clearance is None or clearance.is_open(np.append(self.xz, self.heading), point)
        return "" if is_open else "no_room"

    def _barred(self, openables: ArticulatedParts, action: Action) -> str:
        """Return the reason why doors and drawers block an action."""
        k = action.target
        if action.skill in ("open", "close"):
            why = why_not(openables, self.number, action)
            handle = openables.handles(openables.positions)[k]
            return why or ("" if self._hold(handle) is not None else "out_of_reach")
        if action.skill in ("pick", "place") and openables.barrier_of(k, at_goal=action.skill == "place") >= 0:
            return "closed"
        return ""

    def start(self, action: Action) -> Skill:
        """Start a scripted or learned skill."""
        k = action.target
        self._goes_around |= self.turned_away
        self.turned_away = False
        if action.skill in self.learned:
            return self._reach(self.learned[action.skill].start(self, action))
        if action.skill == "nav_to_handle":
            return self._navigate_to_handle(k)
        if action.skill in ("open", "close"):
            return self._reach(self._move_part(k, opens=action.skill == "open"))
        if action.skill in PRIMITIVES:
            forward, turn, steps = PRIMITIVES[action.skill]
            return self._move(forward, turn, steps)
        if action.skill == CONTROL:
            return self._control(action.command)
        if action.skill == "wait":
            return self._wait(action.steps)
        if action.skill == SEARCH:
            return self._look_at(self.objects.destination(self.number, action))
        if action.skill.startswith("nav"):
            return self._navigate(self.objects.destination(self.number, action))
        return self._reach(self._pick(k) if action.skill == "pick" else self._place(k))

    def _control(self, command: ArrayLike) -> Skill:
        """Move one step by base velocity, arm joints and grip, without avoidance."""
        state, robot, rules = self.objects.state, self.robot, ArmSpec(grasp_m=self.grip_m)
        action = checked_command(command, robot)
        self.command = float(action[0]), float(action[1])
        self.yields = False  # whoever gives commands hears nobody ask: the others get past as past furniture
        self._choose_base()
        # base, arm, grip, in this order: the hand takes what is near it at the end of the step
        drive_robots(self.state, self.free, action[None, :2], self.base)
        move_arms(self.state, robot, action[None, 2:-1], rules)
        # every step leads the arm towards its goal, and would undo the command otherwise
        self.arm_goal = self.joints.copy()
        hand = robot_hands(self.state, robot, self.free)
        grip_objects(state, hand, action[-1:], rules, agent=self.number)
        yield
        return SkillResult("done")

    def obey(self, command: Array, towards: NDArray) -> None:
        """Move one step by the command of a learned skill.

        Args:
            command: base velocity [2] alone, or followed by arm joints [n] and grip [1], in -1..1. The base gives way to other
                agents as in every skill.
            towards: floor point [2] that the base is heading for.
        """
        rules = ArmSpec(grasp_m=self.grip_m)
        if len(command) > 2:
            self.arm_goal = self.joints.copy()
            moved = self.arm + np.asarray(command[2:-1], np.float64) * rules.joint_step
            # clipped here, because a step goes to its goal whatever the limits of the joints
            self.arm_goal[self._arm] = np.clip(moved, self.robot.lower[self._arm], self.robot.upper[self._arm])
        # as in training, where a base follows each command at once
        self._step(float(command[0]), float(command[1]), towards, eases=False)
        if len(command) > 2:
            hand = robot_hands(self.state, self.robot, self.free)
            grip_objects(self.objects.state, hand, np.asarray(command[-1:], np.float64), rules, agent=self.number)

    def step_aside(self) -> None:
        """Drive one step out of another agent's path."""
        self._step_aside()

    def open_stand(self, point: NDArray) -> Array | None:
        """Return the nearest pose ``(x, z, heading)`` [3] from which the hand reaches a world point [3] unobstructed.

        Returns None if no such pose can be reached.
        """
        stands, clearance = self.stands(point, self.empty_base), self.arm_clearance
        is_clear = None if clearance is None else partial(clearance.is_open, point=point)
        k, _ = nearest_stand(self.free, stands, self.xz, is_clear=is_clear)
        return stands[k] if k >= 0 else None

    @property
    def resting_point(self) -> Array:
        """Return the position of the hand at rest, in the world [3] [m]."""
        at = self._hand_in_root(self.robot.rest)
        return pose_multiply(self.pose, np.append(at, [0, 0, 0, 1.0]))[:3]

    def _navigate(self, point: NDArray) -> Skill:
        """Drive to where the hand reaches a world point [3], and turn to it."""
        stands = self.stands(point)
        if not len(stands):  # with what it carries it cannot turn all around anywhere there: `lift_arm` with a box
            stands = self.stands(point, self.empty_base)
        if self.openables is not None:
            ajar, base = self.openables.open_points(), self.base
            stands = stands[stands_clear(stands, ajar, base.disc_offsets_m, base.disc_radius_m)]
        k, left = self._stand_with_room(stands, point)
        if not np.isfinite(left):
            # asked without the tests of room: tells a blocked arm from a missing path
            gets_there = np.isfinite(nearest_stand(self.free, stands, self.xz)[1])
            return SkillResult("failed", "no_room" if gets_there else "no_way")
        yield from self._fold_arm()
        goal = stands[k, :2]
        ending = yield from self.drive_to(goal, facing=point[[0, 2]])
        if ending.outcome == "failed" and self.base.maneuvers:
            self._gave_up.append(goal.copy())
        return ending

    def _look_at(self, point: NDArray) -> Skill:
        """Drive to the floor before a world point [3], and turn to it."""
        goal = self.free.snap(point[[0, 2]])
        if not np.isfinite(self.free.geodesic(self.xz, goal)):
            return SkillResult("failed", "no_way")
        yield from self._fold_arm()
        # distance to the floor in front of a place at which a robot looks at the place [m]
        look_m = 0.5
        return (yield from self.drive_to(goal, facing=point[[0, 2]], within_m=look_m))

    def stands(self, point: NDArray, base: BaseSpec | None = None, free: FreeSpace | None = None) -> Array:
        """Return stands ``(x, z, heading)`` [N, 3] within driving reach from which a hand reaches a world point [3]."""
        free, base = free or self.free, base or self.base
        known = free, base, island_of(free, self.xz), point.tobytes()
        if known not in self._stands:
            self._stands[known] = robot_stands(free, self.robot, base, point, island=known[2])
        return self._stands[known]

    def stands_on(self, free: FreeSpace, point: NDArray) -> Array:
        """Return the stands on the floor ``free`` from which the hand reaches a world point [3]."""
        return self.stands(point, free=free)

    def _navigate_to_handle(self, k: int) -> Skill:
        """Drive to where the hand reaches a handle, if possible along its whole path, and turn to it."""
        assert self.openables is not None
        way = handle_path(self.openables, k, full_travel(self.openables, k))
        stands = self.stands(way[0])
        base = self.base
        stands = stands[stands_before(self.openables, k, stands, base.disc_offsets_m, base.disc_radius_m)]
        reach = reach_distances(self.robot, float(way[-1, 1] - self.free.height_at(way[-1, [0, 2]])))
        # the initial values stand for an arm that reaches nothing at this height
        least, most = float(np.min(reach, initial=np.inf)), float(np.max(reach, initial=0.0))
        ends = np.hypot(*(stands[:, :2] - way[-1, [0, 2]]).T)
        for near in (stands[(ends >= least) & (ends <= most)], stands):
            n, left = nearest_stand(self.free, near, self.xz, self._crowded(near) if len(near) else None)
            if np.isfinite(left):
                yield from self._fold_arm()
                return (yield from self.drive_to(near[n, :2], facing=way[0, [0, 2]]))
        # no stand is left with room to turn, as in a narrow hall: along the wall the hand reaches to the side
        stands = handle_stands(self.free, self.robot, base, way[0], island=island_of(self.free, self.xz))
        stands = stands[stands_before(self.openables, k, stands, base.disc_offsets_m, base.disc_radius_m)]
        n = self._straightest(stands)
        if n < 0:
            return SkillResult("failed", "no_way")
        yield from self._fold_arm()
        # `drive_to` turns to a point, so the wanted heading becomes one far away
        ahead = stands[n, 2] + reach_bearing(self.robot)
        # 1000.0: distance of a point that lies in the same direction from everywhere in a home [m]
        facing = stands[n, :2] + 1000.0 * np.array([np.cos(ahead), -np.sin(ahead)])
        return (yield from self.drive_to(stands[n, :2], facing=facing))

    def _straightest(self, stands: Array) -> int:
        """Return the index of the stand ``(x, z, heading)`` [N, 3] with the least cost of path and turning at its end.

        Stands close to other agents cost more. Returns -1 if the robot can reach none.
        """
        lengths = self.free.geodesic(np.broadcast_to(self.xz, (len(stands), 2)), stands[:, :2])
        crowded = STANDS.crowded_m * self._crowded(stands) if len(stands) else lengths
        order = np.argsort(lengths + crowded, kind="stable")
        best, least = -1, np.inf
        for n in order[np.isfinite(lengths[order])][:TRIED].tolist():
            # by the last leg it arrives; the rest of the turn has to be made where there is little room
            leg = np.diff(self.free.path(self.xz, stands[n, :2], max_snap_m=1.0)[-2:], axis=0)
            came = float(np.arctan2(-leg[-1, 1], leg[-1, 0])) if len(leg) else self.heading
            cost = lengths[n] + crowded[n] + TURN_M_RAD * abs(float(wrap_angle(stands[n, 2] - came)))
            best, least = (n, cost) if cost < least else (best, least)
        return best

    def _move_part(self, k: int, *, opens: bool) -> Skill:
        """Open or close a part: the hand takes its handle and leads it as far as the arm reaches."""
        assert self.openables is not None
        leading = Leading(self.openables, k, opens=opens)
        held = self._hold(leading.handles[0])
        assert held is not None, "checked before it starts"
        robot, posture = held
        yield from self._bring_arm(posture)
        follows = True
        for step in range(len(leading.way)):
            while not leading.advance(step):
                if leading.gave_up:
                    return SkillResult("failed", "blocked")
                self._step(0.0, 0.0, avoid=False)
                yield
            hand = self._hand_at(leading.handles[step], robot)
            if follows and not is_beyond_reach(self.robot, hand):
                # no restarts: a posture from elsewhere would swing the arm around between two steps
                answer = reach_posture(self.robot, hand, self.arm_goal, restarts=0)
                # a handle that no posture reaches is not taken again: the part goes on by itself
                follows = bool(answer.reached)
                self.arm_goal = answer.joint_pos if follows else self.arm_goal
            self._step(0.0, 0.0, avoid=False)
            yield
        return SkillResult("done")

    def _stand_with_room(self, stands: Array, point: NDArray) -> tuple[int, float]:
        """Return nearest stand, as `nearest_stand` does, from which the arm reaches a world point [3] without contact.

        If there is none, one from which at least the line to the point is open.
        """
        crowded, tests = self._crowded(stands), (None,)
        if self.arm_clearance is not None:
            tests = (
                partial(self.arm_clearance.is_clear, point=point),
                partial(self.arm_clearance.is_open, point=point),
            )
        nearest = -1, np.inf
        for test in tests:
            nearest = nearest_stand(self.free, stands, self.xz, crowded, test)
            if nearest[0] >= 0:
                break
        return nearest

    def _crowded(self, stands: Array) -> NDArray[np.integer]:
        """Rate how close the robot would be to another agent at each stand, [N].

        1 is within the margin; 2 is contact, or no path to the stand for a robot that was turned away from it before.
        """
        # who steps aside when asked takes no stand away
        crowded = crowding(self.base, stands, self.others)
        if self._goes_around:
            shut = shut_off(self.free, self.xz, stands[:, :2], self.others, radius_m=self.base.disc_radius_m)
            crowded = np.maximum(crowded, 2 * shut)
        # where it did not get to counts as close to somebody: free stands come first
        for place in self._gave_up:
            crowded = np.maximum(crowded, np.hypot(*(stands[:, :2] - place).T) < AVOIDANCE.via_m)
        return crowded

    def _reach(self, skill: Skill) -> Skill:
        """Return a skill whose arm folds while the base drives on, when the skill has ended or is interrupted.

        An arm that stayed out once stood 6 cm inside a wall for 146 steps.
        """
        try:
            return (yield from skill)
        finally:
            self.arm_goal = self.robot.rest.copy()

    def _pick(self, k: int) -> Skill:
        over, at = self._reach_line(self._hand_target(Action("pick", k)))
        yield from self._bring_hand(over, at)
        gap = float(np.linalg.norm(self.hand_pose[:3] - self.objects.poses[k, :3]))
        # another agent may have taken the object, or carried it off, while the arm moved
        if gap > self.grip_m or self.objects.held_by[k] != NOBODY:
            if self._is_instant:
                yield  # the arm has moved in this step
            return SkillResult("failed", "out_of_reach" if gap > self.grip_m else "held_by_other")
        self.objects.held_by[k] = self.number
        # as the hand found it, up to `grip_m` away: nothing snaps to the hand as in `grip_objects`
        self.objects.state.grip_pose[0, k] = pose_multiply(pose_inverse(self.hand_pose), self.objects.poses[k])
        yield from self._withdraw_hand(over)
        return SkillResult("done")

    def _place(self, k: int) -> Skill:
        over, at = self._reach_line(self._hand_target(Action("place", k)))
        yield from self._bring_hand(over, at)
        self.objects.held_by[k] = NOBODY
        yield from self._withdraw_hand(over)
        return SkillResult("done")

    def _fold_arm(self) -> Generator[None, None, None]:
        """Fold the arm and stand until the hand is nearly over the base.

        Without this, a robot drove off with its arm stretched out, and its hand got 6 cm into a wall.
        """
        farthest_m, rest = self._folded_m + ARM_OUT_M, self.robot.rest.tobytes()
        # an arm at rest is folded; most drives begin so, and its frames cost more than the comparison
        while not self._is_instant and self.joints.tobytes() != rest:
            if np.hypot(*self._hand_in_root(self.joints)[[0, 2]]) <= farthest_m:
                return
            self._step(0.0, 0.0)
            yield

    def _hand_target(self, action: Action) -> Array:
        """Return pose7 of the hand, in the agent root frame, for a pick or a place."""
        k = action.target
        there = self.objects.poses[k, :3] if action.skill == "pick" else self.objects.goals[k]
        hand = self._hand_at(there)
        if action.skill == "pick":
            return hand
        grip = self.objects.state.grip_pose[0, k]
        turned = pose_multiply(np.append(np.zeros(3), hand_turn(self.robot)), grip)
        # the object is to be at the goal, so the hand ends short of it by the grip
        return np.concatenate([hand[:3] - turned[:3], hand[3:]])

    def _hand_at(self, point: NDArray, robot: Robot | None = None) -> Array:
        """Return pose7 of the hand in the agent root frame, with its grip at a world point [3].

        The hand is turned like that of ``robot``, a version of the body that may reach to the side (`aimed`).
        """
        local = pose_multiply(pose_inverse(self.pose), np.append(point, [0, 0, 0, 1.0]))
        return np.concatenate([local[:3], hand_turn(robot or self.robot)])

    def _hold(self, handle: NDArray) -> tuple[Robot, Array] | None:
        """Return reach and posture with which the hand takes a handle at a world point [3]; None if it cannot."""
        for aside in HAND_REACH.aside_rad:
            robot = aimed(self.robot, aside)
            posture = self._posture(self._hand_at(handle, robot))
            if posture is not None:
                return robot, posture
        return None

    def _posture(self, hand: Array) -> Array | None:
        if is_beyond_reach(self.robot, hand):
            return None
        answer = reach_posture(self.robot, hand)
        return answer.joint_pos if answer.reached else None

    def _reach_line(self, hand: Array) -> tuple[Array, Array]:
        """Return the postures over the target and at it."""
        line = reach_line(self.robot, hand)
        assert line is not None, "checked before it starts"
        return line

    @property
    def _is_instant(self) -> bool:
        """Return whether the arm takes no time, as in Habitat; a pick or a place is then a single step."""
        return bool(np.isinf(self.arm_rad_s))

    def _bring_hand(self, over: Array, at: Array) -> Generator[None, None, None]:
        """Bring the hand to its target; an instant arm is there before the step ends, so that this step can use it."""
        if not self._is_instant:
            yield from self._bring_arm(over)
            yield from self._bring_arm(at)
            return
        self.arm_goal, self.yields = at, False
        self._step(0.0, 0.0, avoid=False)
        while np.any(self.joints[self._arm] != at[self._arm]):  # held up by another agent
            yield
            self._step(0.0, 0.0, avoid=False)

    def _withdraw_hand(self, over: Array) -> Generator[None, None, None]:
        """Take the hand back over the target; an instant arm ends the step where it is."""
        if self._is_instant:
            yield
        else:
            yield from self._bring_arm(over)

    def _bring_arm(self, posture: Array) -> Generator[None, None, None]:
        self.arm_goal, self.yields = posture, False
        # compared exactly, because the last step of `_move_arm` takes the goal itself
        while np.any(self.joints[self._arm] != posture[self._arm]):
            self._step(0.0, 0.0, avoid=False)
            yield
