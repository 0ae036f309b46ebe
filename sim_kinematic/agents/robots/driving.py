"""Driving of a robot with an arm: around agents, out of narrow places, and with a held object."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.geometry import IDENTITY_POSE, Array, pose_from_matrix, pose_multiply, wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.agents.company import Company
from sim_kinematic.agents.opening.openables import ArticulatedParts
from sim_kinematic.agents.robots.arm_clearance import ArmClearance
from sim_kinematic.agents.robots.hand_reach import (
    reach_bearing,
)
from sim_kinematic.agents.skills import Objects, Skill, SkillResult
from sim_kinematic.agents.stands import (
    discs_fit,
)
from sim_kinematic.avoidance.maneuvers import heading_to, plan_maneuver
from sim_kinematic.avoidance.robot_base import carrying_base_of, footprint_of, wider_by
from sim_kinematic.avoidance.spec import AVOIDANCE, Footprint
from sim_kinematic.avoidance.velocity import base_numbers, braking_speed, keep_clear
from sim_kinematic.avoidance.yielding import NO_NEIGHBOURS, NO_PATH, Neighbours, path_around, retreat_place
from sim_kinematic.contact.frames import root_pose
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.motion.state import ROBOT, RobotState
from sim_kinematic.motion.step import drive_robots

STUCK_STEPS = 60
"""Number of steps without progress towards its destination after which a base gives up."""
ARRIVED_M = 0.04
"""Distance within which a base is at its destination [m]."""
NEARLY_M = 0.15
"""Distance within which a stalled base is at its destination [m]."""
FACING_RAD = 0.04
"""Angle within which a base faces a point [rad]."""


@dataclass(eq=False)
class RobotDriver:
    """Base class for driving of robots with an arm, which changes ``objects.state``."""

    robot: Robot
    free: FreeSpace
    """Floor for a base of the robot's size."""
    base: BaseSpec
    """Discs and limits of the base (`sim_kinematic.avoidance.robot_base.base_of`), which also cover the object that it
    carries."""
    objects: Objects
    grip_m: float
    arm_rad_s: float
    number: int = ROBOT
    """Number of the agent in its world."""
    arm_clearance: ArmClearance | None = None
    """Test of the room for the robot's arm; None: no test is made."""
    avoids: bool = True
    """True if the robot's base keeps clear of other agents (`keep_clear`) in every skill."""
    company: Company | None = None
    """Agents to which the robot gives way, with access by number; None: the robot is alone."""
    yields: bool = True
    aside: NDArray[np.float64] | None = None
    turned_away: bool = False
    hindered_by: frozenset[int] = frozenset()
    command: tuple[float, float] = (0.0, 0.0)
    """Last command of the base: forward and left turn, -1..1 of the limits."""
    arm_goal: Array = field(init=False)
    """Joint positions towards which the arm moves in every step [J]."""
    is_robot = True

    def __post_init__(self) -> None:
        self._arm = np.array(self.robot.arm_columns, np.intp)
        self.state: RobotState = self.objects.state.robots[self.number]
        """Part of the robot in the state of one world."""
        # attributes, because a step reads them thirty times, and each view takes as long as a sum
        self.xz: NDArray[np.float64] = self.state.xz[0]
        """Position on the floor [2] [m], a view."""
        self.joints: NDArray[np.float64] = self.state.joints[0]
        """Positions of the joints [J], a view."""
        # a copy: `obey` writes into it, and the resting posture is the robot's own
        self.arm_goal = self.robot.rest.copy()
        self.empty_base, self._carrying_base = self.base, carrying_base_of(self.robot, self.base)
        self._folded_m = float(np.hypot(*self._hand_in_root(self.robot.rest)[[0, 2]])) if self._arm.size else 0.0
        self.footprint: Footprint = footprint_of(self.base)
        self._target = 0.0, 0.0
        """Command to which the robot speeds up."""
        self._commands: list[tuple[float, float]] = []
        """Rest of a maneuver by which it steps aside."""
        self._posed: tuple[Any, Array] = None, IDENTITY_POSE
        """Floor, place and heading of the last `pose`, and the pose."""
        self._numbers: tuple[BaseSpec | None, tuple[Any, ...]] = None, ()
        """A base, and its numbers for the kernel of a step."""
        self._start: NDArray | None = None
        self._path: NDArray[np.floating] | Callable[[], NDArray[np.floating]] = NO_PATH
        self._goes_around = False
        """True after the robot was turned away: it takes paths around agents that stand until it makes progress."""
        self._stands: dict[tuple[FreeSpace, BaseSpec, int, bytes], Array] = {}
        """Stands found before, by floor, base, island and the point to be reached; skills look for the same ones again."""
        self._gave_up: list[NDArray] = []
        """Places [2] that the robot could not reach; next time it goes elsewhere, if possible."""
        self._planned: tuple[tuple[Any, ...], list[list[float]]] = (), []
        """Question of the last search for a maneuver, and the commands that it found."""
        self._held_up = np.full(3, np.inf), 0
        """Position at the last progress in stepping aside, and the number of steps since."""

    @property
    def agreed(self) -> bool:
        """Return whether all agents step aside on request (`sim_kinematic.avoidance.right_of_way.Walker`)."""
        return self.company is not None and self.company.agreed

    @property
    def others(self) -> Neighbours:
        """Agents of the world, and to which of them the robot gives way."""
        return NO_NEIGHBOURS if self.company is None else self.company.around(self.number)

    def meets(self) -> bool:
        """Return whether the robot touches another agent in its present posture, so that it stays where it was."""
        return self.company is not None and self.company.meets(self)

    @property
    def openables(self) -> ArticulatedParts | None:
        """Doors and drawers of the home; None: nothing opens."""
        return self.objects.openables

    @property
    def heading(self) -> float:
        """Heading of the base [rad]."""
        return self.state.heading.item(0)

    @property
    def path(self) -> NDArray[np.floating]:
        """Return the points [N, 2] [m] of the path that the robot drives, from its own place on; computed when read."""
        if callable(self._path):
            self._path = self._path()
        return self._path

    @path.setter
    def path(self, path: NDArray[np.floating]) -> None:
        self._path, self._start = path, path[0] if len(path) else None

    @property
    def path_start(self) -> NDArray | None:
        """First point [2] of the path that the robot drives; None without a path."""
        return self._start

    def _announce(self, via: NDArray, goal: NDArray) -> None:
        """Inform the others of the points by which the robot continues from here."""
        # a view of the state, which may have changed by the time that somebody reads the path
        xz = self.xz.copy()

        def path() -> NDArray[np.floating]:
            return np.vstack([xz, *(via if len(via) else self.free.path(xz, goal, max_snap_m=1.0)), goal])

        # not computed yet: in most steps nobody reads it, and each would cost a shortest path
        self._start, self._path = xz, path

    @property
    def arm(self) -> NDArray:
        """Positions of the joints that move the hand, [n] [rad or m]; a copy."""
        return self.joints[self._arm]

    @property
    def pose(self) -> Array:
        """Pose (pose7) of the agent root in the world; the same array as long as the robot stands still."""
        now = self.free, *self.xz.tolist(), self.heading
        if self._posed[0] != now:
            self._posed = now, root_pose(self.robot, self.xz, self.heading, self.free)
        return self._posed[1]

    @property
    def hand_pose(self) -> Array:
        """Pose (pose7) in the world of the grasp point of the hand."""
        frame = self.robot.link_matrices(self.pose[None], self.joints[None])[0, self.robot.hand_link]
        out = pose_from_matrix(frame)
        out[:3] += frame[:3, :3] @ self.robot.hand_position
        return out

    def _hand_in_root(self, joints: NDArray) -> Array:
        """Return the point at which the hand holds things in the agent root frame [3] at joint positions [J]."""
        frame = self.robot.link_matrices(IDENTITY_POSE[None], joints[None])[0, self.robot.hand_link]
        return frame[:3, 3] + frame[:3, :3] @ self.robot.hand_position

    def walk_on(self, free: FreeSpace) -> None:
        """Use another floor from now on, because a door or drawer of the home has moved."""
        self.free = free

    def idle(self) -> None:
        """Stand still for one step."""
        self._step(0.0, 0.0)

    def _move(self, forward: float, turn: float, steps: int) -> Skill:
        for _ in range(steps):
            # at full speed from the first step on, for the lengths of `PRIMITIVES`
            self._step(forward, turn, eases=False)
            yield
        return SkillResult("done")

    def _wait(self, steps: int) -> Skill:
        """Stand at a place that no other agent needs."""
        # agents that agree are asked to step aside when somebody comes, so they need no retreat
        goal = None if self.agreed else retreat_place(self.free, self.xz, self.others, wider_m=wider_by(self.base))
        for _ in range(steps):
            if self.aside is not None:
                self._step_aside()
            elif goal is None or float(np.hypot(*(goal - self.xz))) < AVOIDANCE.via_m:
                self._step(0.0, 0.0)
            else:
                self._drive(self._leg(goal)[1])
            yield
        return SkillResult("done")

    def _step_aside(self) -> None:
        """Go one step aside, or stand if there is no room."""
        if self.aside is None or not len(self.aside):
            self._step(0.0, 0.0)
            return
        pose = np.append(self.xz, self.heading)
        # metres and radians alike: a turn on the spot is progress too
        if np.abs(pose - self._held_up[0]).max() > AVOIDANCE.via_m:
            self._held_up, self._commands = (pose, 0), self._commands if self._held_up[1] else []
        self._held_up = self._held_up[0], self._held_up[1] + 1
        if self._held_up[1] > AVOIDANCE.maneuver_after_steps and not self._commands:
            self._commands, self._held_up = self._maneuver_to(self.aside[-1]), (pose, 0)
        if self._commands:
            self._step(*self._commands.pop(0), self.aside[0], avoid=False)
        else:
            self._drive(self.aside[0])

    def _drive(self, towards: NDArray, left_m: float = np.inf) -> None:
        """Drive one step towards a floor point [2]; ``left_m`` is the length of the path on which it brakes [m]."""
        (x, z), (to_x, to_z), limits = self.xz.tolist(), towards.tolist(), self.base
        stride_m, error = limits.max_speed_mps * STEP_S, self._error_to(towards)
        turned = limits.max_turn_rad_s * STEP_S * float(np.hypot(to_x - x, to_z - z))
        ahead, aside = max(0.0, math.cos(error)) ** 2, abs(math.sin(error))
        # slow enough to turn to a near point instead of circling it: the bearing of a point at distance d turns by
        # v sin(e) / d, at most half as fast as the base; a command of 1 covers `stride_m`, so the last step ends at the goal
        forward = min(ahead, 0.5 * turned / max(aside * stride_m, 1e-9), left_m / stride_m)
        # bases under Habitat's rules do not brake: they drive as they did, to the bit
        if limits.maneuvers:
            corner = braking_speed(AVOIDANCE.accel_mps2, math.hypot(to_x - x, to_z - z), AVOIDANCE.corner_mps)
            forward = min(forward, min(corner, braking_speed(AVOIDANCE.accel_mps2, left_m)) / limits.max_speed_mps)
        self._step(forward, self._turn(error), towards)

    def drive_to(self, goal: NDArray, *, facing: NDArray | None = None, within_m: float = ARRIVED_M) -> Skill:
        """Drive to within a distance of a floor point [2] and turn there until the hand points at ``facing`` [2].

        The base gives way, backs out of narrow places and drives around agents that stand in its path. It fails with
        ``stuck`` after `STUCK_STEPS` without progress, and with ``blocked`` where it is turned away.
        """
        reach = 0.0 if facing is None else reach_bearing(self.robot)
        bearing = None if facing is None else heading_to(goal, facing, reach)
        best, since, detours = np.inf, 0, 0
        via = self._via(goal)  # around agents that stand in the way
        tried, is_near = 0, False
        while since <= STUCK_STEPS:
            if self.turned_away:
                return SkillResult("failed", "blocked")
            if self.aside is not None:
                self._step_aside()
                yield
                # stepping aside is no stall, and leads to another place: both counts begin anew
                best, since, via = np.inf, 0, NO_PATH if self.aside is not None else self._via(goal)
                continue
            if since and since % AVOIDANCE.maneuver_after_steps == 0 and tried < AVOIDANCE.maneuvers:
                tried += 1
                if (yield from self._maneuver(goal, bearing)):
                    best, since, via, is_near = np.inf, 0, NO_PATH, self._leg(goal)[0] <= NEARLY_M
                    continue
            if since in AVOIDANCE.detour_after_steps and detours < AVOIDANCE.detours:
                # bases that maneuver consider only agents that are near
                looks = (self.others.near(self.xz) if self.base.maneuvers else self.others.heeded).any()
                detour = self._detour(goal) if looks else None
                if detour is not None:
                    via, best, detours = detour[:-1], np.inf, detours + 1
            if len(via) and np.hypot(*(via[0] - self.xz)) < AVOIDANCE.via_m:
                # the next point is farther away than the one just reached, which would count as a stall
                via, best = via[1:], np.inf
            if self.agreed:  # nobody else asks for it
                self._announce(via, goal)
            left, waypoint = self._leg(via[0] if len(via) else goal)
            stalled = since > AVOIDANCE.detour_after_steps[0]
            if not len(via) and (left <= within_m or (left <= NEARLY_M and (stalled or is_near))):
                self._goes_around = False
                if facing is None:
                    return SkillResult("done")
                error = self._error_to(facing, reach)
                if abs(error) < FACING_RAD:
                    return SkillResult("done")
                self._step(0.0, self._turn(error), goal)
                # below 0, so that turning at the end is nearer than any distance; 0.01 rad count as 1 mm
                left = 0.1 * abs(error) - 1.0
            else:
                self._drive(waypoint, left)
            yield
            best, since = (left, 0) if left < best - 1e-3 else (best, since + 1)
        return SkillResult("failed", "stuck")

    def _maneuver(self, goal: NDArray, bearing: float | None = None) -> Generator[None, None, bool]:
        """Maneuver towards a floor point [2] where the robot is stuck; return whether a whole maneuver was done."""
        # the plan holds for the others where they are now
        stood = np.where(self.others.near(self.xz)[:, None], self.others.places, np.nan)
        commands = self._maneuver_to(goal, bearing)
        for forward, turn in commands:
            if self.aside is not None or _has_come_near(self.others, stood, self.xz):
                return False
            before = self.state.xz[0].copy(), self.heading
            self._step(
                forward, turn, goal, avoid=False
            )  # the maneuver keeps clear of the others by itself, if more closely
            yield
            # the rest of the plan starts from a place that it has not got to
            if self.hindered_by and (self.state.xz[0] == before[0]).all() and self.heading == before[1]:
                return False
        return len(commands) > 0

    def _maneuver_to(self, goal: NDArray, bearing: float | None = None) -> list[tuple[float, float]]:
        """Return the commands that lead towards a floor point [2] around all agents that are near, or none."""
        if not self.base.maneuvers:
            return []
        discs = self.others.discs(self.others.near(self.xz))
        asked = self.free, self.base, self.xz.tolist(), self.heading, goal.tolist(), discs.tolist(), bearing
        # a robot that is stuck asks again from where it stands; a search that fails is the longest
        if asked != self._planned[0]:
            self._planned = (
                asked,
                plan_maneuver(*asked[:2], self.xz, self.heading, goal, discs, bearing=bearing).tolist(),
            )
        return [(forward, turn) for forward, turn in self._planned[1]]

    def _via(self, goal: NDArray) -> NDArray:
        """Return points [N, 2] by which the robot first goes to a floor point [2]: none, unless it was turned away."""
        detour = self._detour(goal) if self._goes_around else None
        return NO_PATH if detour is None else detour[:-1]

    def _detour(self, goal: NDArray) -> NDArray | None:
        return path_around(
            self.free,
            self.xz,
            goal,
            self.others,
            radius_m=self.base.disc_radius_m,
            passing_m=AVOIDANCE.robot_passing_m,
        )

    def _turn(self, error: float) -> float:
        """Return the command that removes a heading error [rad] in one step, if no limit or braking prevents it."""
        most, limit = 1.0, self.base.max_turn_rad_s
        if self.base.maneuvers:
            most = min(most, braking_speed(AVOIDANCE.turn_accel_rad_s2, abs(error)) / limit)
        return min(max(error / (limit * STEP_S), -most), most)

    def _leg(self, goal: NDArray) -> tuple[float, NDArray]:
        """Return the length of the path to a floor point [2] [m], or infinity, and the point to drive to first."""
        # nearer points are passed over: an inflated corner is an arc of points 5 cm apart
        length, waypoint = self.free.first_leg(self.xz, goal, beyond_m=self.base.disc_radius_m / 2, max_snap_m=1.0)
        return length, goal if math.isinf(length) else waypoint

    def _error_to(self, xz: NDArray, bearing: float = 0.0) -> float:
        """Return by how much the robot must turn to have a floor point [2] at a bearing to its left [rad]."""
        (x, z), (goal_x, goal_z) = self.xz.tolist(), xz.tolist()
        dx, dz = goal_x - x, goal_z - z
        return float(wrap_angle(float(np.arctan2(-dz, dx)) - bearing - self.heading))

    def _step(
        self, forward: float, turn: float, towards: NDArray | None = None, *, avoid: bool = True, eases: bool = True
    ) -> None:
        """Move base, arm and held object by one step, unless the motion would touch another agent.

        Where it avoids others it ``eases`` into commands, as far as its base does so.
        """
        before, wanted = self.command, (forward, turn)
        self._choose_base()
        state, base, free = self.state, self.base, self.free
        xz, heading, joints = state.xz.copy(), state.heading.copy(), state.joints.copy()
        if self._numbers[0] is not base:
            self._numbers = base, base_numbers(base)
        clears, aim = self.avoids and avoid, self.xz if towards is None else towards
        others = self.others if clears else NO_NEIGHBOURS, self.objects.held_by
        told = self._target if base.maneuvers else None, before if clears and eases and base.maneuvers else None
        # what the kernel does not do by itself: other ways to slide, stairs, and to refuse what is not finite
        slides = base.slide == "strict" and not free.has_stairs and math.isfinite(sum(wanted))
        target, self.command = keep_clear(free, self._numbers[1], state, wanted, aim, *others, *told, drives=slides)
        self._target = target if clears else self._target
        if not slides:
            drive_robots(state, free, np.array([self.command]), base)
        if joints.tobytes() != self.arm_goal.tobytes():  # most of the time the arm is where it is to be
            self._move_arm(joints[0])
        if self.meets():
            # first the base alone: the arm may go on where it was the driving that touched somebody
            state.xz[:], state.heading[:] = xz, heading
            if self.base.maneuvers:  # it speeds up from rest
                self.command = 0.0, 0.0
            if self.meets():
                state.joints[:] = joints
        k = self.objects.held(self.number)
        if k >= 0:
            self.objects.poses[k] = pose_multiply(self.hand_pose, self.objects.state.grip_pose[0, k])

    def _move_arm(self, joints: NDArray) -> None:
        """Move the arm from joint positions [J] by one step towards its goal."""
        most, arm = self.arm_rad_s * STEP_S, joints[self._arm]
        missing = self.arm_goal[self._arm] - arm
        far = max(map(abs, missing.tolist()), default=0.0)
        if far > 0.0:
            # all joints by the same share: the straight line between postures that `ArmClearance` has checked
            self.joints[self._arm] = self.arm_goal[self._arm] if far <= most else arm + missing * (most / far)

    def _choose_base(self) -> None:
        """Let the base also keep clear by the held object, once there is room for it."""
        # the same record: the discs of the base cover what is carried already
        if self._carrying_base is self.empty_base:
            return
        if self.objects.held(self.number) < 0:
            self.base = self.empty_base
        elif self.base is self.empty_base and discs_fit(self.free, self._carrying_base, self.xz, self.heading):
            self.base = self._carrying_base


def _has_come_near(others: Neighbours, stood: NDArray, xz: NDArray) -> bool:
    """Return whether another agent is near the robot at ``xz`` [2] that was not at ``stood`` [A, 2] before.

    Those that were too far away to be planned around stood at NaN.
    """
    moved = ~(np.hypot(*(others.places - stood).T) <= AVOIDANCE.moving_m)
    return bool((moved & others.near(xz) & (np.hypot(*(others.places - xz).T) <= AVOIDANCE.retreat_m)).any())
