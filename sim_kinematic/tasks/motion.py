"""Agents that drive and walk: the form of their choices, the commands that carry them out, and their recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError
from h3data.geometry import Array
from h3data.recording import Event, Recording
from h3data.recording.records import JOINTS
from h3data.scene.articulation import joints_of
from sim_kinematic.contact.frames import root_pose
from sim_kinematic.motion.state import HumanState, RobotState
from sim_kinematic.policies.assignment import AssignedPolicy, works
from sim_kinematic.policies.crowd.crowds import Crowds, Moment
from sim_kinematic.policies.policy import GaitAction, PoseAction, RecordedPose, Still, Velocity, WaypointAction
from sim_kinematic.policies.recorded import RecordedTrack, RecordedVelocities, deciding_since, recorded_commands
from sim_kinematic.policies.traffic import Traffic
from sim_kinematic.policies.views import AgentView
from sim_kinematic.sensing.sensor import first_point
from sim_kinematic.sensing.table import Sensor, SensorContext, sensed
from sim_kinematic.tasks.control import Columns, Control, Team
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.world import (
    Command,
    DriveCommand,
    GaitCommand,
    PoseCommand,
    Posture,
    RecordedPoseCommand,
    WaypointCommand,
)


class VelocityControl(Control):
    """Control of agents that drive and walk by velocities, waypoints or places."""

    def team(self, play: Any) -> Team:
        """Return the agents of W worlds, which are moved together."""
        return MotionTeam(play)

    def checked(self, play: Any, number: int, choice: Any) -> Any:
        """Return a velocity from a pair, or from any object with ``forward`` and ``turn``.

        Raises:
            InputError: the choice is malformed.
        """
        try:
            if not hasattr(choice, "forward") and np.shape(choice) == (2,):
                choice = Velocity(float(choice[0]), float(choice[1]))
            is_finite = math.isfinite(choice.forward) and math.isfinite(choice.turn)
        except (AttributeError, TypeError, ValueError):
            raise InputError(
                f"Expected a command (forward, turn) in -1..1, got {choice!r}.", code="H3-TASK-064"
            ) from None
        if not is_finite:
            raise InputError(f"Actions must be finite, got {(choice.forward, choice.turn)}.", code="H3-TASK-065")
        return choice

    def accepted(self, play: Any, number: int, choice: Any) -> Any:
        """Return a policy's choice: a velocity (as from `checked`), a waypoint, a place, a gait or a recorded pose.

        Raises:
            InputError: the choice is malformed.
        """
        if isinstance(choice, GaitAction):
            return choice
        if not isinstance(choice, WaypointAction | PoseAction | RecordedPose):
            return self.checked(play, number, choice)
        place = np.append(choice.xz, getattr(choice, "heading", 0.0))
        if place.shape != (3,) or not np.isfinite(place).all():
            raise InputError(f"Expected a place of 2 finite numbers [m], got {choice!r}.", code="H3-TASK-082")
        return choice

    def idle(self, play: Any, number: int, last: Any) -> Any:
        """Return the choice that an agent continues with if it gets no new command."""
        return Velocity(0.0, 0.0) if last is None else last

    def to_json(self, choice: Any) -> Any:
        """Return a velocity as JSON types."""
        return {"forward": float(choice.forward), "turn": float(choice.turn), "skill": choice.skill}

    def from_json(self, data: Any) -> Any:
        """Return the velocity that `to_json` converted."""
        return Velocity(float(data["forward"]), float(data["turn"]), str(data.get("skill", "")))

    def needed_columns(self, recording: Recording) -> list[str]:
        """Return the names of the columns with the velocities of robots, and with the skills that they report."""
        robots = [k for k, agent in enumerate(recording.agents) if agent.kind == "robot"]
        names = ("action", "skill") if self.skills.get("robot") else ("action",)
        return [f"agent_{k}.{name}" for k in robots for name in names]

    def decided(self, recording: Recording, names: Sequence[str]) -> set[int]:
        """Return the numbers of the robots, and of the people who were controlled from outside."""
        commanded = recorded_commands(recording, self.from_json)
        decided = {
            k
            for k, agent in enumerate(recording.agents)
            if f"agent_{k}.action" in recording.columns and (agent.kind == "robot" or k in commanded)
        }
        # agents that wander make way for each other, so one of them can only decide again if the others do too
        wanderers = {k for k, name in enumerate(names) if name == "wander"}
        return decided if wanderers <= decided else decided - wanderers

    def still(self, episode: Episode, number: int) -> Any:
        """Return a policy that stands still."""
        return Still()

    def recorded_policies(
        self,
        recording: Recording,
        episode: Episode,
        own: Sequence[AssignedPolicy],
        *,
        until: int,
        changed: Sequence[bool] = (),
    ) -> list[AssignedPolicy]:
        """Return policies that repeat the recorded velocities.

        A scripted person has no recorded decisions, so their own policy decides again.
        """
        commands, policies = recorded_commands(recording, self.from_json), []
        for k, (member, assigned, since) in enumerate(zip(episode.roster, own, deciding_since(recording), strict=True)):
            policy = assigned.policy
            if member.kind == "robot" or k in commands:
                policy = RecordedVelocities.of(
                    recording,
                    k,
                    commands.get(k),
                    until=until,
                    own=policy,
                    # the policy that drove so far is asked about the past, to have its memory; a new one is not
                    since=until if changed and changed[k] else min(since, until),
                )
            elif policy is None:
                raise InputError(
                    f"The person's own policy {assigned.name!r} is not at hand, and {member.name} was not controlled "
                    "from outside: nothing says how they decided.",
                    code="H3-TASK-066",
                )
            policies.append(assigned._replace(policy=policy))
        return policies

    def keep_people(
        self, play: Any, recording: Recording, since: int
    ) -> tuple[dict[str, Any], Callable[[int], object] | None]:
        """Let people follow their recorded places and postures from the first step on."""
        for k, member in enumerate(play.episode.roster):
            if member.kind == "human":
                play.policies[k] = play.policies[k]._replace(policy=RecordedTrack(recording, k, member.body))
        return {}, None


class MotionController:
    """Controller of one agent of the only world, which makes a choice in every step."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.status: Literal["choosing", "acting"] = "choosing"
        self.word = ""
        """Word by which the agent reports its present activity."""
        self._choice: Any = None

    def begin(self, step: int) -> None:
        """Start a step, in which the agent has to choose."""
        self.status = "choosing"

    def start(self, choice: Any) -> None:
        """Take over the choice of a step."""
        self._choice, self.word, self.status = choice, getattr(choice, "skill", ""), "acting"

    def step(self) -> Command:
        """Return the command that carries the choice out.

        Raises:
            InputError: The choice has an unknown type.
        """
        return command_of([self._choice], self._name)


def command_of(choices: Sequence[Any], name: str) -> Command:
    """Return the command for an agent of W worlds, given its choices, which are all of one kind.

    Velocities are rounded to float32, as they are recorded. ``name`` is the name of the agent for error messages.

    Raises:
        InputError: A choice has an unknown type.
    """
    first = choices[0]
    if isinstance(first, WaypointAction):
        return WaypointCommand(_rows([choice.xz for choice in choices]))
    if isinstance(first, PoseAction):
        headings, seats = (
            np.array([choice.heading for choice in choices]),
            np.array([choice.seat for choice in choices]),
        )
        return PoseCommand(_rows([choice.xz for choice in choices]), headings, seats)
    if isinstance(first, GaitAction):
        if len(choices) == 1:
            return GaitCommand(first.gait)
        gait = HumanState.zeros(len(choices))
        for w, choice in enumerate(choices):
            gait.put([w], choice.gait)
        return GaitCommand(gait)
    if isinstance(first, RecordedPose):
        parts = ([getattr(choice, part) for choice in choices] for part in Posture._fields)
        posture = Posture(*map(np.array, parts))
        return RecordedPoseCommand(
            _rows([choice.xz for choice in choices]), np.array([c.heading for c in choices]), posture
        )
    if not hasattr(first, "forward"):
        raise InputError(f"Expected {name} to choose a Velocity or WaypointAction, got {first!r}.", code="H3-TASK-069")
    # rounded, so that a replay of the recorded velocities moves the agent by the same bits
    return DriveCommand(np.array([[choice.forward, choice.turn] for choice in choices], np.float32).astype(np.float64))


def _rows(values: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return vectors [2] of W worlds as rows [W, 2]."""
    # for one world a view takes a tenth of the time
    return values[0][None] if len(values) == 1 else np.array(values)


class MotionTeam(Team):
    """Agents of W worlds that drive and walk."""

    def __init__(self, play: Any) -> None:
        super().__init__(play)
        self.controllers = [MotionController(member.name) for member in play.world.roster]
        self._commands: Sequence[Command | None] = ()
        arms = [resting_arm(member.body) for member in play.world.roster]
        self._arms = [np.tile(arm, (play.world.worlds, 1)) for arm in arms]
        """Resting positions of the arm joints of each agent, [W, n] [rad or m]."""
        self._traffic: dict[int, Traffic] = {}
        """Traffic of the worlds for which it was requested."""
        self._crowds: dict[int, Crowds] = {}
        """Crowds of the worlds for which they were requested."""
        self._moment: Moment | None = None
        """Places of all agents in this step, once they were requested."""

    def begin(self, rows: NDArray[np.intp]) -> None:
        """Remove the traffic and crowds of these worlds, because their agents start at other places."""
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
            episode.floor(agent),
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
            floors = [self.play.episodes[world].floor(number) for number in range(len(self.play.world.roster))]
            self._traffic[world] = Traffic(self.play.world, world, floors)
        return self._traffic[world]

    def crowds_of(self, world: int) -> Crowds:
        """Return the crowds of one world."""
        if world not in self._crowds:
            self._crowds[world] = Crowds(self.play.world, world, self._where, [] if world else self._kept_out())
        return self._crowds[world]

    def _kept_out(self) -> list[Event]:
        """Return an event ``refused`` for each person of the first world for whom no way to some rooms is wide enough."""
        episode, free = self.play.episodes[0], self.play.episodes[0].free
        islands = np.maximum(free.island(episode.starts[:, :2]), 0).tolist()
        closed = {
            # with less than 0.1 m2 of floor they can only look in, or the room is on a storey that the map does not cover
            n: ", ".join(
                room.name
                for room in episode.scene.rooms
                if (free.has_stairs or abs(room.floor_y - free.floor_y) <= 0.5)
                and shapely.area(free.polygon.geoms[n].intersection(shapely.box(*room.rectangles.T))).sum() < 0.1
            )
            for n in set(islands)
        }
        return [
            Event(
                step=0,
                agent=k,
                kind="refused",
                detail=f"{member.name} is {2 * free.radius_m:.2f} m broad, and no free way of that width leads to {closed[n]}.",
            )
            for k, (member, n) in enumerate(zip(episode.roster, islands, strict=True))
            if member.kind == "human" and closed[n]
        ]

    def _where(self) -> Moment:
        """Return the places of all agents, put together once per step for all crowds."""
        if self._moment is None:
            self._moment = Moment.of(self.play.world)
        return self._moment

    def new_events(self) -> Sequence[Event]:
        """Return the events of people of crowds who started a reaction to a robot or an activity."""
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
        """Return the shortest paths from an agent to another: their lengths [W] [m] and their first waypoints [W, 2] [m]."""
        world = self.play.world
        lengths = world.geodesic(agent, other)
        xz, to, begun = world.state.agents[agent].xz, world.state.agents[other].xz, world.bases[agent].disc_radius_m / 2
        ends = zip(world.floors, xz, to, lengths.tolist(), strict=True)
        return lengths, np.array([first_point(free, a, b, length, beyond_m=begun) for free, a, b, length in ends])

    def scenery(self, world: int) -> dict[str, Any]:
        """Return the scene as it was sampled, with people posed by their motion clips."""
        play = self.play
        return {
            "state": play.world.state.take(np.array([world])),
            "scene": play.episodes[world].scene,
            "floor": play.world.floors[world],
            "speed_mps": play.spec.human.speed_mps,
        }

    def snapshot(self) -> list[Sequence[float]]:
        """Return the agents' places, motions, commands and words, hands, joints and things as plain numbers."""
        parts: list[Sequence[float]] = []
        world, skills = self.play.world, self.play.task.control.skills
        # all people at once, and Python floats, which take half the time of NumPy's
        now, was = world.people, world.people_before.distance[:: world.worlds].tolist()
        pose = (now.xz, now.heading, now.distance, now.set_off, now.blend, now.arms, now.seat)
        people = zip(*(values[:: world.worlds].tolist() for values in pose), was, strict=True)
        for k, (member, own) in enumerate(zip(world.roster, world.state.agents, strict=True)):
            words = skills.get(member.kind, ())
            if isinstance(own, RobotState):
                (x, z), heading = own.xz[0].tolist(), own.heading.item(0)
                command, word = self._commands[k], self.controllers[k].word
                forward, turn = command[0][0, :2].tolist() if isinstance(command, DriveCommand) else (0.0, 0.0)
                code = words.index(word) if word in words else -1
                parts.append((x, z, heading, own.contact.item(0), forward, turn, code))
            else:
                (x, z), heading, distance, set_off, blend, arms, seat, before = next(people)
                code = words.index("walk" if distance > before else "turn") if words else -1
                # a walk begins anew where the person set off, so the clip's phase counts from there
                parts.append((x, z, heading, distance - set_off, blend, *arms, *seat, code))
        hands = [now.hands[(k - len(world.state.robots)) * world.worlds].ravel().tolist() for k in self._handling()]
        return [*parts, *hands, world.state.joint_pos[0].tolist(), world.state.object_pose[0].ravel().tolist()]

    def _handling(self) -> list[int]:
        """Return numbers of the people who may handle things."""
        return [k for k, policy in enumerate(self.play.policies) if works(policy) is not None]

    def columns(
        self, snapshots: Sequence[list[Sequence[float]]]
    ) -> tuple[Columns, list[Array], NDArray[np.bool_] | None]:
        """Return the columns of robots that drive and of people in motion clips."""
        # as `snapshot` writes them, [T, n] each
        parts = [np.array(part, np.float64) for part in zip(*snapshots, strict=True)]
        steps, floor = len(snapshots), self.play.episode.free
        result: Columns = {}
        places, contact = [], []
        for k, member in enumerate(self.play.world.roster):
            agent, body = f"agent_{k}.", member.body
            own = parts[k].T
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
        *hands, joints, things = parts[len(places) :]
        for k, part in zip(self._handling(), hands, strict=True):
            result[f"agent_{k}.motion_hands"] = part.reshape(-1, 4, 4).astype(np.float32)
        if joints.size:
            result[JOINTS] = joints.astype(np.float32)
        if things.size:
            result["object_pose"] = things.reshape(steps, -1, 7).astype(np.float32)
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
    """Return the resting positions of a robot's arm joints, [n] [rad or m]; empty [0] for other bodies."""
    return body.rest[list(body.arm_columns)].astype(np.float64) if isinstance(body, Robot) else np.zeros(0)
