"""Agents of a rollout: their controllers, the order in which they act, their observations, and the columns of their steps."""

from __future__ import annotations

import weakref
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.geometry import Array
from h3data.recording import Event
from h3data.recording.records import JOINTS
from h3data.scene.articulation import joints_of
from sim_kinematic.contact.frames import root_pose
from sim_kinematic.controllers.motion import MotionController
from sim_kinematic.motion.state import RobotState
from sim_kinematic.policies.assignment import works
from sim_kinematic.policies.crowd.crowds import Crowds, Moment
from sim_kinematic.policies.traffic import Traffic
from sim_kinematic.policies.views import AgentView
from sim_kinematic.sensing.sensor import first_point
from sim_kinematic.sensing.table import Sensor, SensorContext, sensed
from sim_kinematic.tasks.episode import agent_floor
from sim_kinematic.world import Command, DriveCommand

Columns = dict[str, NDArray[Any]]


class Team(ABC):
    """Base class of the agents of a rollout; ``play`` is the `sim_kinematic.tasks.play.WorldRollout`."""

    def __init__(self, play: Any) -> None:
        # no circle of references: policies with open connections are freed with the last use of their rollout
        self.play: Any = weakref.proxy(play)
        self.controllers: Sequence[Any] = ()
        """A controller for each agent (`sim_kinematic.controllers`)."""
        self.order: Sequence[int] = range(len(play.world.roster))
        """Numbers of the agents in the order in which they act."""

    @abstractmethod
    def begin(self, rows: NDArray[np.intp]) -> None:
        """Begin episodes in the worlds ``rows`` [n]."""

    def begin_step(self) -> None:
        """Begin a step of the only world."""
        for controller in self.controllers:
            controller.begin(self.play.step)

    def begin_turn(self, number: int) -> None:  # noqa: B027
        """Prepare an agent before it is asked or moved."""

    def end_turn(self, number: int) -> None:  # noqa: B027
        """Update the team after an agent has made its step."""

    @abstractmethod
    def move(self, commands: Sequence[Command | None]) -> None:
        """Complete a step by one command for each agent, None for agents that their controllers have moved."""

    def finish(self) -> None:  # noqa: B027
        """Close what is still going on, such as running skills."""

    @abstractmethod
    def view(self, agent: int, world: int) -> Any:
        """Return the observation of an agent's policy, for any task."""

    @abstractmethod
    def exact(
        self, agent: int, names: Sequence[str], sensors: Mapping[str, Sensor], *, beside: Sequence[Team] = ()
    ) -> dict[str, Array]:
        """Return the named observations as they are, [W, n] each; rows of the teams ``beside`` follow this team's."""

    @abstractmethod
    def scenery(self, world: int) -> dict[str, Any]:
        """Return the arguments of `sim_kinematic.sensing.eyes.see` that describe the present state of a world."""

    def new_events(self) -> Sequence[Event]:
        """Return events of agents of the first world in the last step, beyond those that the task judges."""
        return ()

    @abstractmethod
    def snapshot(self) -> Any:
        """Return the step just played in the first world, as `columns` takes it."""

    @abstractmethod
    def columns(self, snapshots: Sequence[Any]) -> tuple[Columns, list[Array], NDArray[np.bool_] | None]:
        """Return columns of consecutive steps, the places of each agent [T, 2], and whether a robot touched an obstacle [T]."""


class MotionTeam(Team):
    """Agents of W worlds who drive and walk."""

    def __init__(self, play: Any) -> None:
        super().__init__(play)
        self.controllers = [MotionController(member.name) for member in play.world.roster]
        self._commands: Sequence[Command | None] = ()
        arms = [resting_arm(member.body) for member in play.world.roster]
        self._arms = [np.tile(arm, (play.world.worlds, 1)) for arm in arms]
        """Resting positions of the arm joints of each agent, [W, n]."""
        self._traffic: dict[int, Traffic] = {}
        """Traffic of the worlds for which it was requested."""
        self._crowds: dict[int, Crowds] = {}
        """Crowds of the worlds for which they were requested."""
        self._moment: Moment | None = None
        """Places of all agents in this step, once they were requested."""

    def begin(self, rows: NDArray[np.intp]) -> None:
        """Forget traffic and crowds of these worlds, as their agents begin at other places."""
        for w in rows.tolist():
            self._traffic.pop(w, None)
            self._crowds.pop(w, None)
        self._moment = None
        # only worlds of one episode have doors and things (`WorldRollout.of`)
        state = self.play.world.state
        if state.joint_pos.shape[1]:
            state.joint_pos[:] = joints_of(self.play.episode.scene).rest
        if state.object_pose.shape[1]:
            state.object_pose[:] = np.array([thing.pose for thing in self.play.things])

    def move(self, commands: Sequence[Command | None]) -> None:
        """Move all agents of all worlds at once."""
        self.play.world.step(commands)
        self._moment = None
        self._commands = commands

    def view(self, agent: int, world: int) -> AgentView:
        """Return the observation of an agent in one world."""
        play, w = self.play, world
        episode, (xz, heading, was_xz, was_heading) = play.episodes[w], (values[w] for values in self._where()[:4])
        places, was = np.column_stack([xz, heading]), np.column_stack([was_xz, was_heading])
        return AgentView(
            int(play.steps[w]),
            episode.seed,
            agent,
            tuple(member.kind for member in play.world.roster),
            agent_floor(episode, agent),
            places,
            was,
            play.world.bases,
            play.spec.human,
            episode.extra,
            partial(self._traffic_of, world),
            partial(self.crowds_of, world),
            partial(play.observe, agent, world),
        )

    def _traffic_of(self, world: int) -> Traffic:
        """Return the traffic of one world, made when an agent that wanders first asks for it."""
        if world not in self._traffic:
            floors = [agent_floor(self.play.episodes[world], number) for number in range(len(self.play.world.roster))]
            self._traffic[world] = Traffic(self.play.world, world, floors)
        return self._traffic[world]

    def crowds_of(self, world: int) -> Crowds:
        """Return the crowds of one world."""
        if world not in self._crowds:
            self._crowds[world] = Crowds(self.play.world, world, self._where)
        return self._crowds[world]

    def _where(self) -> Moment:
        """Return the places of all agents, put together once per step for all crowds."""
        if self._moment is None:
            self._moment = Moment.of(self.play.world)
        return self._moment

    def new_events(self) -> Sequence[Event]:
        """Return the reactions to robots and activities that people of crowds have begun."""
        return self._crowds[0].new_events if 0 in self._crowds else ()

    def exact(
        self, agent: int, names: Sequence[str], sensors: Mapping[str, Sensor], *, beside: Sequence[Team] = ()
    ) -> dict[str, Array]:
        """Return observations of an agent by name, in all worlds of this team, without noise."""
        if not names:
            return {}
        context, who = self._context(agent), (self.play.task.name, self.play.world.roster[agent].name)
        return {name: np.asarray(sensed(name, sensors[name], context, *who), np.float64) for name in names}

    def _context(self, agent: int) -> SensorContext:
        """Return the inputs of an agent's sensors in all worlds."""
        world = self.play.world
        kinds = [member.kind for member in world.roster]
        other = next((n for n, kind in enumerate(kinds) if kind != kinds[agent]), (agent + 1) % len(kinds))
        now, before = world.state.agents, world.before.agents
        mine = [p for p, pair in enumerate(world.pairs) if agent in pair]
        return SensorContext(
            self.play.spec,
            world.bases[agent],
            self.play.memory,
            self.play.episodes,
            world,
            agent,
            now[agent],
            before[agent],
            world.start.agents[agent],
            now[other],
            before[other],
            world.blocked[:, agent],
            np.asarray(world.touching[:, mine].any(1)),
            self._arms[agent],
            partial(self._path, agent, other),
        )

    def _path(self, agent: int, other: int) -> tuple[Array, Array]:
        """Return the shortest paths from an agent to another: their lengths [W] [m] and their first way points [W, 2] [m]."""
        world = self.play.world
        lengths = world.geodesic(agent, other)
        xz, to, begun = world.state.agents[agent].xz, world.state.agents[other].xz, world.bases[agent].disc_radius_m / 2
        ends = zip(world.floors, xz, to, lengths.tolist(), strict=True)
        return lengths, np.array([first_point(free, a, b, length, beyond_m=begun) for free, a, b, length in ends])

    def scenery(self, world: int) -> dict[str, Any]:
        """Return the scene as it was sampled, and people in their motion clips."""
        play = self.play
        return {
            "state": play.world.state.take(np.array([world])),
            "scene": play.episodes[world].scene,
            "floor": play.world.floors[world],
            "speed_mps": play.spec.human.speed_mps,
        }

    def snapshot(self) -> list[float]:
        """Return the place, motion, command and word of each agent, as plain numbers."""
        numbers: list[float] = []
        world, skills = self.play.world, self.play.task.control.skills
        # all people at once, and Python floats, which take half the time of NumPy's
        now, was = world.people, world.people_before.distance[:: world.worlds].tolist()
        parts = (now.xz, now.heading, now.distance, now.set_off, now.blend, now.arms, now.seat)
        people = zip(*(part[:: world.worlds].tolist() for part in parts), was, strict=True)
        for k, (member, own) in enumerate(zip(world.roster, world.state.agents, strict=True)):
            words = skills.get(member.kind, ())
            if isinstance(own, RobotState):
                (x, z), heading = own.xz[0].tolist(), own.heading.item(0)
                command, word = self._commands[k], self.controllers[k].word
                forward, turn = command[0][0, :2].tolist() if isinstance(command, DriveCommand) else (0.0, 0.0)
                code = words.index(word) if word in words else -1
                numbers += (x, z, heading, own.contact.item(0), forward, turn, code)
            else:
                (x, z), heading, distance, set_off, blend, arms, seat, before = next(people)
                code = words.index("walk" if distance > before else "turn") if words else -1
                # a walk begins anew where the person set off, so the clip's phase counts from there
                numbers += (x, z, heading, distance - set_off, blend, *arms, *seat, code)
        for k in self._handling():
            numbers += now.hands[(k - len(world.state.robots)) * world.worlds].ravel().tolist()
        return numbers + world.state.joint_pos[0].tolist() + world.state.object_pose[0].ravel().tolist()

    def _handling(self) -> list[int]:
        """Return numbers of the people who may handle things."""
        return [k for k, policy in enumerate(self.play.policies) if works(policy) is not None]

    def columns(self, snapshots: Sequence[list[float]]) -> tuple[Columns, list[Array], NDArray[np.bool_] | None]:
        """Return columns of robots that drive and of people in motion clips."""
        numbers, steps, floor = np.array(snapshots, np.float64), len(snapshots), self.play.episode.free
        result: Columns = {}
        places, contact, at = [], [], 0
        for k, member in enumerate(self.play.world.roster):
            agent, body = f"agent_{k}.", member.body
            # as many numbers as `snapshot` writes for a robot, and for a person
            own = numbers[:, at : at + (7 if isinstance(body, Robot) else 10)].T
            at += len(own)
            xz = np.stack([own[0], own[1]], -1)
            places.append(xz)
            result[agent + "base_pose"] = root_pose(body, xz, own[2], floor).astype(np.float32)
            if isinstance(body, Robot):
                contact.append(own[3].astype(np.bool_))
                # arms of robots that only drive stay at rest
                result[agent + "joint_pos"] = np.tile(body.rest.astype(np.float32), (steps, 1))
                result[agent + "action"] = np.stack([own[4], own[5]], -1).astype(np.float32)
            else:
                result |= {agent + name: values for name, values in self._motion_columns(k, body, own).items()}
            result[agent + "grasp_body"] = np.full(steps, -1, np.int32)
            if self.play.task.control.skills.get(member.kind):
                result[agent + "skill"] = own[-1].astype(np.int32)
        for k in self._handling():
            result[f"agent_{k}.motion_hands"] = numbers[:, at : at + 16].reshape(-1, 4, 4).astype(np.float32)
            at += 16
        joints = self.play.world.state.joint_pos.shape[1]
        if joints:
            result[JOINTS] = numbers[:, at : at + joints].astype(np.float32)
        if numbers.shape[1] > at + joints:
            result["object_pose"] = numbers[:, at + joints :].reshape(steps, -1, 7).astype(np.float32)
        return result, places, np.any(contact, axis=0) if contact else None

    def _motion_columns(self, k: int, body: Humanoid, own: Array) -> Columns:
        """Return the columns of a person's motion clip, of the numbers [10, T] in their snapshots."""
        clip = self.play.world.clips[k]
        walk = body.clips[clip]
        columns: Columns = {
            "motion_id": np.full(own.shape[1], clip, np.int32),
            "motion_phase": ((walk.start_phase + own[3] / walk.stride_m) % 1.0).astype(np.float32),
            "motion_blend": own[4].astype(np.float32),
        }
        if self.play.spec.human.arms is not None:
            columns["motion_arms"] = np.stack([own[5], own[6]], -1).astype(np.float32)
        if self.play.policies and getattr(self.play.policies[k].policy, "sits", False):
            columns["motion_seat"] = np.stack([own[7], own[8]], -1).astype(np.float32)
        return columns


def resting_arm(body: Humanoid | Robot) -> Array:
    """Return the resting positions of a robot's arm joints, [n]; [0] for a person or a robot without a hand."""
    return body.rest[list(body.arm_columns)].astype(np.float64) if isinstance(body, Robot) else np.zeros(0)
