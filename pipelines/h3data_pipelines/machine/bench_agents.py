"""Agents of the speed benchmark, which sample random actions and move in W worlds with the simulator's own kernels.

`h3data_pipelines.machine.bench_protocol` combines them into worlds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.reach import hand_points, reach_poses, reacher
from h3data.errors import InputError
from h3data.geometry import Array, quat_from_heading, quat_rotate
from h3data.scene import FreeSpace
from sim_kinematic.agents.manipulation import grip_objects, move_arms, robot_hands
from sim_kinematic.agents.person import HAND_SPEED_MPS
from sim_kinematic.agents.stands import discs_fit
from sim_kinematic.avoidance.robot_base import base_of
from sim_kinematic.contact.frames import body_frames, root_pose
from sim_kinematic.motion.gait import walk_humans
from sim_kinematic.motion.spec import HOME_BASE, STEP_S, ArmSpec, WalkerSpec
from sim_kinematic.motion.state import WorldState
from sim_kinematic.motion.step import drive_robots

Action = Literal["nav", "pick"]
HFOV_DEG = 90.0
CAPSULE_SIDES = 12
PLACES_TRIED = 1000


class RobotAgent:
    """Robot in W worlds of the speed benchmark.

    In ``nav`` it drives with random base velocities; in ``pick`` it stands, its arm moves at random, and its hand opens
    and closes.
    """

    def __init__(
        self, robot: Robot, free: FreeSpace, state: WorldState, *, number: int, is_clear: Callable[[Array], bool]
    ) -> None:
        """Connect the agent to the state of its worlds.

        Args:
            robot: body of the robot.
            free: free floor.
            state: state with the robot's joints.
            number: number of the agent, under which held objects are recorded.
            is_clear: function that returns whether the robot can start at a base pose (pose7) [7].
        """
        self.body, self.free, self.state, self.number, self._is_clear = robot, free, state, number, is_clear
        self.own, self._base = state.robots[number], base_of(robot, HOME_BASE)
        self._pose()

    def reset(self, rng: np.random.Generator) -> None:
        """Place the robot at random positions without contact of body, arm and rear, with the arm at rest."""
        for w in range(len(self.own.heading)):
            self.own.xz[w], self.own.heading[w] = self._clear_place(rng)
        self.own.joints[:] = self.body.rest
        self._pose()

    def _clear_place(self, rng: np.random.Generator) -> tuple[Array, float]:
        for _ in range(PLACES_TRIED):
            (xz,), heading = self.free.sample(rng, 1), float(rng.uniform(-np.pi, np.pi))
            fits = discs_fit(self.free, self._base, xz, heading)
            if fits and self._is_clear(root_pose(self.body, xz, heading, self.free)):
                return xz, heading
        raise InputError(
            f"Found no place for {self.body.name} in {PLACES_TRIED} tries. Hint: a larger home.", code="H3-OPTION-016"
        )

    def sample(self, rng: np.random.Generator, action: Action) -> Array:
        """Return random actions in -1..1, shape [W, n]."""
        worlds = len(self.own.heading)
        return rng.uniform(-1, 1, (worlds, 2 if action == "nav" else len(self.body.require_arm()) + 1))

    def step(self, action: Action, values: Array) -> None:
        """Move the robot and the object that it holds."""
        if action == "nav":
            drive_robots(self.own, self.free, values, self._base)
        else:
            move_arms(self.own, self.body, values[:, :-1], ArmSpec())
            hands = robot_hands(self.own, self.body, self.free)
            grip_objects(self.state, hands, values[:, -1], ArmSpec(), agent=self.number)
        self._pose()

    def _pose(self) -> None:
        """Compute the root poses [W, 7] and the frames of the links [W, L, 4, 4]."""
        self.base = root_pose(self.body, self.own.xz, self.own.heading, self.free)
        self.frames = self.body.link_matrices(self.base, self.own.joints)


class HumanAgent:
    """Person in W worlds of the speed benchmark.

    In ``nav`` they walk along shortest paths to random objects and choose a new object on each arrival (oracle
    navigation). In ``pick`` they stand, and the right hand moves towards random objects as far as it can reach.
    """

    def __init__(self, human: Humanoid, free: FreeSpace, state: WorldState, *, number: int) -> None:
        """Connect the agent to the state of its worlds; held objects are recorded under its ``number``."""
        self.body, self.free, self.state, self.number = human, free, state, number
        self.own = state.people[number - len(state.robots)]
        self.walker = WalkerSpec()
        worlds = state.worlds
        self._paths: list[NDArray[np.float64]] = [np.zeros((0, 2))] * worlds
        self._hands = np.tile(reacher(human, "right").rest, (worlds, 1))
        self._pose("nav")

    def reset(self, rng: np.random.Generator) -> None:
        """Place the people at random positions, standing, with the hand at the side."""
        own, worlds = self.own, self.state.worlds
        own.xz[:] = self.free.sample(rng, worlds)
        own.heading[:] = rng.uniform(-np.pi, np.pi, worlds)
        for array in (own.distance, own.set_off, own.blend):
            array[:] = 0
        self._paths = [np.zeros((0, 2))] * worlds
        self._hands[:] = reacher(self.body, "right").rest
        self._pose("nav")

    def sample(self, rng: np.random.Generator, action: Action) -> Array:
        """Sample target objects, and whether the hand closes (above 0) or opens, shape [W, 2]."""
        worlds, objects = self.state.held_by.shape
        return np.stack([rng.integers(objects, size=worlds), rng.uniform(-1, 1, worlds)], axis=1)

    def step(self, action: Action, values: Array) -> None:
        """Move the people one step: walk, or reach for an object and take it."""
        state, chosen = self.state, values[:, 0].astype(int)
        targets = state.object_pose[np.arange(len(chosen)), chosen, :3]
        if action == "nav":
            walk_humans(self.own, self._way_points(targets[:, [0, 2]]), self.walker)
            self._pose(action)
        else:
            away = quat_from_heading(-self.own.heading)
            origin = self.free.root_pose(self.own.xz, self.own.heading)[:, :3]
            way = quat_rotate(away, targets - origin) - self._hands
            most = HAND_SPEED_MPS * STEP_S
            self._hands += way * np.minimum(1.0, most / np.maximum(np.linalg.norm(way, axis=1), 1e-9))[:, None]
            self._pose(action)
            palms = np.tile(np.eye(4), (len(chosen), 1, 1))
            palms[:, :3, 3] = hand_points(self.frames, self.body, "right")
            grip_objects(state, palms, values[:, 1], ArmSpec(), agent=self.number)

    def _way_points(self, goals: Array) -> Array:
        """Return the next waypoints [W, 2]; agents that have arrived start towards their goal of ``goals`` [W, 2]."""
        here, points = self.own.xz, self.own.xz.copy()
        for w, goal in enumerate(goals):
            path = self._paths[w]
            while len(path) and np.hypot(*(path[0] - here[w])) <= self.walker.arrive_m:
                path = path[1:]
            if not len(path):
                path = self.free.path(here[w], self.free.snap(goal))[1:]
            self._paths[w] = path
            if len(path):
                points[w] = path[0]
        return points

    def _pose(self, action: Action) -> None:
        """Compute the root poses [W, 7] and the frames of the joints [W, 55, 4, 4]."""
        own, human = self.own, self.body
        self.base = self.free.root_pose(own.xz, own.heading)
        if action == "nav":
            self.frames = body_frames(human, own, self.free)
        else:
            reached = reach_poses(human, self._hands, "right")
            self.frames = human.joint_matrices(self.base, reached.quats, reached.pelvis)


Agent = RobotAgent | HumanAgent
