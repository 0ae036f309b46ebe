"""Controls, by which tasks define how agents choose, and the teams that carry the choices out in a rollout.

A task names one `Control` (`sim_kinematic.tasks.task.Task.control`), which defines the form of a choice, how it is
carried out, and how it is recorded and repeated. The control makes the `Team` of each rollout. With `VelocityControl`,
agents drive and walk: a choice becomes one command of `sim_kinematic.world.World.step`. With
`sim_kinematic.tasks.skills.control.SkillControl`, they have skills: they take objects, put them down, and open and
close doors and drawers.
"""

from __future__ import annotations

import math
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, ClassVar, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError
from h3data.geometry import Array
from h3data.recording import Agent, Event, Recording
from h3data.recording.records import JOINTS, agent_numbers
from h3data.scene.articulation import joints_of
from sim_kinematic.agents.roster import AgentSpec
from sim_kinematic.contact.frames import root_pose
from sim_kinematic.crowd.errands import Station
from sim_kinematic.motion.state import HumanState, RobotState
from sim_kinematic.policies.assignment import AssignedPolicy, works
from sim_kinematic.policies.crowd.crowds import Crowds, Moment
from sim_kinematic.policies.policy import GaitAction, PoseAction, RecordedPose, Still, Velocity, WaypointAction
from sim_kinematic.policies.recorded import RecordedTrack, RecordedVelocities, deciding_since, recorded_commands
from sim_kinematic.policies.traffic import Traffic
from sim_kinematic.policies.views import AgentView
from sim_kinematic.sensing.sensor import first_point
from sim_kinematic.sensing.table import STATE_OBSERVATIONS, Sensor, SensorContext, sensed
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

Columns = dict[str, NDArray[Any]]


class Team(ABC):
    """Base class of the agents of a rollout, where ``play`` is the `sim_kinematic.tasks.play.WorldRollout`."""

    def __init__(self, play: Any) -> None:
        # no circle of references: policies with open connections are freed with the last use of their rollout
        self.play: Any = weakref.proxy(play)
        self.controllers: Sequence[Any] = ()
        """A controller for each agent.

        In every step ``begin(step)`` is called first. While ``status`` is ``choosing``, a choice of the policy is given to
        ``start(choice)``. Then ``step()`` returns the command of this step, or None if the agent has been moved already or
        has to choose once more.
        """
        self.order: Sequence[int] = range(len(play.world.roster))
        """Numbers of the agents in the order in which they act."""

    @abstractmethod
    def begin(self, rows: NDArray[np.intp]) -> None:
        """Start episodes in the worlds ``rows`` [n]."""

    def begin_step(self) -> None:
        """Start a step of the only world."""
        for controller in self.controllers:
            controller.begin(self.play.step)

    def begin_turn(self, number: int) -> None:  # noqa: B027
        """Prepare an agent before it is asked for a choice or moved."""

    def end_turn(self, number: int) -> None:  # noqa: B027
        """Update the team after an agent has made its step."""

    @abstractmethod
    def move(self, commands: Sequence[Command | None]) -> None:
        """Complete a step with one command per agent; None for an agent that its controller has already moved."""

    def finish(self) -> None:  # noqa: B027
        """Close activities that are still running, such as skills."""

    @abstractmethod
    def view(self, agent: int, world: int) -> Any:
        """Return the observation of an agent's policy, for any task."""

    @abstractmethod
    def exact(
        self, agent: int, names: Sequence[str], sensors: Mapping[str, Sensor], *, beside: Sequence[Team] = ()
    ) -> dict[str, Array]:
        """Return exact values of the named observations, [W, n] each, followed by the rows of the teams ``beside``."""

    @abstractmethod
    def scenery(self, world: int) -> dict[str, Any]:
        """Return the arguments of `sim_kinematic.sensing.eyes.see` that describe the present state of a world."""

    def new_events(self) -> Sequence[Event]:
        """Return the events of agents in the first world in the last step, except those that the task reports."""
        return ()

    @abstractmethod
    def snapshot(self) -> Any:
        """Return the last step of the first world in the form that `columns` takes."""

    @abstractmethod
    def columns(self, snapshots: Sequence[Any]) -> tuple[Columns, list[Array], NDArray[np.bool_] | None]:
        """Return columns of consecutive steps, agents' places [T, 2], and whether a robot touched an obstacle [T]."""


class Control:
    """Base class of controls, where ``play`` is a `sim_kinematic.tasks.play.WorldRollout` and ``number`` an agent."""

    has_skills: ClassVar[bool] = False
    """True if choices are skills that take many steps: then each rollout has one world, people are recorded joint by joint
    instead of as motion clips, and `sim_kinematic.policies.assignment.COMMON` makes no such choices."""

    observations: ClassVar[tuple[str, ...]] = STATE_OBSERVATIONS
    """Names of the sensors that are an environment's observations by default."""

    def __init__(self, skills: Mapping[str, tuple[str, ...]] | None = None) -> None:
        """Create the control.

        Args:
            skills: Names of skills that agents report, by kind; a kind without any has no skill column.
        """
        self.skills = dict(skills or {})

    def check_roster(self, roster: Sequence[AgentSpec]) -> None:
        """Raise an `InputError` if the control does not support an agent; by default it supports all."""

    def team(self, play: Any) -> Team:
        """Return the controllers of all agents of a `sim_kinematic.tasks.play.WorldRollout` that is about to start."""
        raise NotImplementedError

    # --- choices from outside -----------------------------------------------------------------------------------------
    def checked(self, play: Any, number: int, choice: Any) -> Any:
        """Return a command from outside in the form that the play takes, after checking it.

        Raises:
            InputError: the command is malformed.
        """
        raise NotImplementedError

    def accepted(self, play: Any, number: int, choice: Any) -> Any:
        """Return a policy's choice in the form that the play takes; by default as `checked` returns it.

        Raises:
            InputError: the choice is malformed.
        """
        return self.checked(play, number, choice)

    def idle(self, play: Any, number: int, last: Any) -> Any:
        """Return the choice of an agent controlled from outside without a new command; ``last`` is its latest command."""
        raise NotImplementedError

    def is_busy(self, play: Any, number: int) -> bool:
        """Return whether an agent continues an action until it ends or a command interrupts it."""
        return False

    def interrupts(self, play: Any, number: int, choice: Any) -> bool:
        """Return whether a command from outside interrupts the agent's present activity; by default it always does."""
        return True

    def refusal(self, play: Any, number: int, choice: Any) -> str | None:
        """Return, as a sentence, why a command from `checked` would be refused now; None if it would not."""
        return None

    # --- recordings ---------------------------------------------------------------------------------------------------
    def to_json(self, choice: Any) -> Any:
        """Return a choice as JSON types, for the recorded raw input."""
        raise NotImplementedError

    def from_json(self, data: Any) -> Any:
        """Return the choice that `to_json` converted."""
        raise NotImplementedError

    def recorded_agent(self, member: AgentSpec, episode: Episode, *, is_external: bool) -> Agent:
        """Return the entry of an agent in a recording, with the skills that it has in this episode."""
        body = member.body
        if isinstance(body, Robot):
            moves: dict[str, tuple[str, ...]] = {
                "joint_names": tuple(body.joint_names),
                "action_names": ("forward", "turn_left"),
            }
        else:  # people with skills are recorded joint by joint, so they have no clips to name
            moves = {"motion_names": () if self.has_skills else body.motion_names}
        return Agent(
            name=member.name,
            kind=member.kind,
            model=f"{body.model_prefix}{member.model}",
            semantic_id=body.semantic_id,
            skill_names=self.skills.get(member.kind, ()),
            **moves,
        )

    def needed_columns(self, recording: Recording) -> list[str]:
        """Return the columns that a recording needs to be simulated again."""
        raise NotImplementedError

    def decided(self, recording: Recording, names: Sequence[str]) -> set[int]:
        """Return the numbers of the agents whose decisions are all recorded, so that their policies are not needed.

        ``names`` are the names of all agents' policies.
        """
        raise NotImplementedError

    def still(self, episode: Episode, number: int) -> Any:
        """Return a policy that does nothing, for an agent whose policy is not available."""
        raise NotImplementedError

    def recorded_policies(
        self,
        recording: Recording,
        episode: Episode,
        own: Sequence[AssignedPolicy],
        *,
        until: int,
        changed: Sequence[bool] = (),
    ) -> list[AssignedPolicy]:
        """Return, for each agent, a policy that repeats its recorded decisions, then hands over to ``own``.

        The policies repeat the first ``until`` steps. ``changed`` is True for each agent whose own policy is not the
        recorded one.
        """
        raise NotImplementedError

    def keep_people(
        self, play: Any, recording: Recording, since: int
    ) -> tuple[dict[str, Any], Callable[[int], object] | None]:
        """Put people on their recorded tracks; return facts for the info, and a function to call after each step.

        ``since`` is the step from which robots follow other policies.
        """
        raise NotImplementedError


# --- agents that drive and walk ---------------------------------------------------------------------------------------
class VelocityControl(Control):
    """Control of agents that drive and walk by velocities, waypoints or places."""

    def team(self, play: Any) -> Team:
        """Return the agents of W worlds, which are moved together."""
        return MotionTeam(play)

    def checked(self, play: Any, number: int, choice: Any) -> Any:
        """Return a velocity from a pair, or from any object with ``forward`` and ``turn``, or the `PoseAction` of a person.

        Raises:
            InputError: the choice is malformed.
        """
        try:
            if (type(choice), play.world.roster[number].kind) == (PoseAction, "human"):
                return self.accepted(play, number, choice._replace(xz=np.asarray(choice.xz, np.float64)))
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
        walks = play.world.roster[number].kind == "human"
        if walks and isinstance(choice, GaitAction):
            return choice
        if not (walks and isinstance(choice, WaypointAction | PoseAction | RecordedPose)):
            return self.checked(play, number, choice)
        place = np.hstack([choice.xz, getattr(choice, "heading", 0.0), getattr(choice, "seat", (0.0, 0.0))])
        if place.shape != (5,) or not np.isfinite(place).all():
            raise InputError(f"Expected a place of 2 finite numbers [m], got {choice!r}.", code="H3-TASK-082")
        return choice

    def idle(self, play: Any, number: int, last: Any) -> Any:
        """Return the choice that an agent continues with if it gets no new command."""
        return Velocity(0.0, 0.0) if last is None else last

    def to_json(self, choice: Any) -> Any:
        """Return a velocity, or the pose of a person, as JSON types."""
        if isinstance(choice, PoseAction):
            return {"pose": [float(x) for x in (*choice.xz, choice.heading, *choice.seat)]}
        return {"forward": float(choice.forward), "turn": float(choice.turn), "skill": choice.skill}

    def from_json(self, data: Any) -> Any:
        """Return the choice that `to_json` converted."""
        if "pose" in data:
            x, z, heading, height, share = map(float, data["pose"])
            return PoseAction(np.array([x, z]), heading, (height, share))
        return Velocity(float(data["forward"]), float(data["turn"]), str(data.get("skill", "")))

    def needed_columns(self, recording: Recording) -> list[str]:
        """Return the names of the columns with the velocities of robots, and with the skills that they report."""
        robots = agent_numbers(recording.agents, "robot")
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
    if hasattr(first, "forward"):
        # rounded, so that a replay of the recorded velocities moves the agent by the same bits
        return DriveCommand(np.array([[c.forward, c.turn] for c in choices], np.float32).astype(np.float64))
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
    raise InputError(f"Expected {name} to choose a Velocity or WaypointAction, got {first!r}.", code="H3-TASK-069")


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
        self._words = [""] * len(self.controllers)
        """Word that each agent reported in the last step."""

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

    @property
    def stations(self) -> Mapping[Any, Station]:
        """Seats and other stations in use in the first world, by the person who uses them."""
        return self._crowds[0].stations if 0 in self._crowds else {}

    def _where(self) -> Moment:
        """Return the places of all agents, put together once per step for all crowds."""
        if self._moment is None:
            self._moment = Moment.of(self.play.world)
        return self._moment

    def new_events(self) -> Sequence[Event]:
        """Return the events of people of crowds who started a reaction or an activity, and of people whose word changed."""
        before, self._words = self._words, [controller.word for controller in self.controllers]
        words = enumerate(zip(self.play.world.roster, before, self._words, strict=True))
        return [
            *(self._crowds[0].new_events if 0 in self._crowds else ()),
            *(
                Event(step=self.play.step - 1, agent=k, kind="activity", target=word or "stand")
                for k, (member, was, word) in words
                if member.kind == "human" and word != was
            ),
        ]

    def exact(
        self, agent: int, names: Sequence[str], sensors: Mapping[str, Sensor], *, beside: Sequence[Team] = ()
    ) -> dict[str, Array]:
        """Return observations of an agent by name, in all worlds of this team, without noise."""
        if not names:
            return {}
        context, who = self._context(agent), (self.play.task.name, self.play.world.roster[agent].name)
        exact: dict[str, Array] = {n: np.asarray(sensed(n, sensors[n], context, *who), np.float64) for n in names}
        for name, values in exact.items():
            if values.shape[:1] != (self.play.world.worlds,):
                raise InputError(
                    f"The sensor {name!r} of {who[1]} must return an array [{self.play.world.worlds}, ...], one row for each "
                    f"world of {who[0]}, got shape {list(values.shape)}.",
                    code="H3-TASK-092",
                )
        return exact

    def _context(self, agent: int) -> SensorContext:
        """Return the inputs of an agent's sensors in all worlds."""
        world = self.play.world
        (other, mine), now, before = self._beside[agent], world.state.agents, world.before.agents
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

    @cached_property
    def _beside(self) -> list[tuple[int, list[int]]]:
        """Return, for each agent, the other one that its sensors are about, and the pairs in which it is."""
        kinds, pairs = [member.kind for member in self.play.world.roster], list(enumerate(self.play.world.pairs))
        return [
            (
                next((n for n, other in enumerate(kinds) if other != kind), (agent + 1) % len(kinds)),
                [p for p, pair in pairs if agent in pair],
            )
            for agent, kind in enumerate(kinds)
        ]

    def _path(self, agent: int, other: int, points: Array | None = None) -> tuple[Array, Array]:
        """Return the shortest paths from an agent to another, or to points [W, 2] [m].

        They are lengths [W] [m] and first waypoints [W, 2] [m].
        """
        world = self.play.world
        lengths = world.geodesic(agent, other) if points is None else self.play.path_length(agent, points)
        xz, to = world.state.agents[agent].xz, world.state.agents[other].xz if points is None else points
        ends = zip(world.floors, xz, to, lengths.tolist(), strict=True)
        return lengths, np.array([first_point(*end, beyond_m=world.bases[agent].disc_radius_m / 2) for end in ends])

    def scenery(self, world: int) -> dict[str, Any]:
        """Return the scene as it was sampled, with people posed by their motion clips."""
        play = self.play
        return {
            "state": play.world.state.take(np.array([world])),
            "scene": play.episodes[world].scene,
            "floor": play.world.floors[world],
            "speed_mps": play.spec.human.speed_mps,
        }

    def snapshot(self) -> tuple[NDArray[np.uint8], list[float]]:
        """Return the agents' state as bytes, followed by the robots' motions and words and the people's last distances."""
        world, skills, values = self.play.world, self.play.task.control.skills, []
        for member, own, command, controller in zip(
            world.roster, world.before.agents, self._commands, self.controllers, strict=True
        ):
            if isinstance(own, RobotState):
                words, word = skills.get(member.kind, ()), controller.word
                values += command[0][0, :2].tolist() if isinstance(command, DriveCommand) else (0.0, 0.0)
                values.append(words.index(word) if word in words else -1)
            else:
                values.append(own.distance.item(0))
        return world.now.first(), values

    def _handling(self) -> list[int]:
        """Return numbers of the people who may handle things."""
        return [k for k, policy in enumerate(self.play.policies) if works(policy) is not None]

    def columns(
        self, snapshots: Sequence[tuple[NDArray[np.uint8], list[float]]]
    ) -> tuple[Columns, list[Array], NDArray[np.bool_] | None]:
        """Return the columns of robots that drive and of people in motion clips."""
        past, values = self.play.world.now.past([block for block, _ in snapshots]), [row for _, row in snapshots]
        extra = iter(np.array(values, np.float64).T)
        steps, floor, skills = len(snapshots), self.play.episode.free, self.play.task.control.skills
        result: Columns = {}
        for k, (member, own) in enumerate(zip(self.play.world.roster, past.agents, strict=True)):
            agent, body = f"agent_{k}.", member.body
            result[agent + "base_pose"] = root_pose(body, own.xz, own.heading, floor).astype(np.float32)
            if isinstance(own, RobotState):
                # arms of robots that only drive stay at rest
                result[agent + "joint_pos"] = np.tile(body.rest.astype(np.float32), (steps, 1))  # type: ignore[union-attr]
                result[agent + "action"] = np.stack([next(extra), next(extra)], -1).astype(np.float32)
                code = next(extra)
            else:
                result |= {agent + name: values for name, values in self._motion_columns(k, body, own).items()}
                words = skills.get(member.kind, ())
                code = [
                    words.index("walk" if walks else "turn") if words else -1 for walks in own.distance > next(extra)
                ]
            result[agent + "grasp_body"] = np.full(steps, -1, np.int32)
            if skills.get(member.kind):
                result[agent + "skill"] = np.asarray(code).astype(np.int32)
        for k in self._handling():
            result[f"agent_{k}.motion_hands"] = past.agents[k].hands.astype(np.float32)  # type: ignore[union-attr]
        if past.joint_pos.size:
            result[JOINTS] = past.joint_pos.astype(np.float32)
        if past.object_pose.size:
            result["object_pose"] = past.object_pose.astype(np.float32)
        contact = [own.contact for own in past.robots]
        return result, [own.xz for own in past.agents], np.any(contact, axis=0) if contact else None

    def _motion_columns(self, k: int, body: Humanoid, own: HumanState) -> Columns:
        """Return the columns of a person's motion clip, of their states at T moments."""
        clip = self.play.world.clips[k]
        walk = body.clips[clip]
        columns: Columns = {
            "motion_id": np.full(len(own.blend), clip, np.int32),
            # a walk begins anew where the person set off, so the clip's phase counts from there
            "motion_phase": ((walk.start_phase + (own.distance - own.set_off) / walk.stride_m) % 1.0).astype(
                np.float32
            ),
            "motion_blend": own.blend.astype(np.float32),
        }
        if self.play.spec.human.arms is not None:
            columns["motion_arms"] = own.arms.astype(np.float32)
        if self.play.policies and getattr(self.play.policies[k].policy, "sits", False):
            columns["motion_seat"] = own.seat.astype(np.float32)
        return columns


def resting_arm(body: Humanoid | Robot) -> Array:
    """Return the resting positions of a robot's arm joints, [n] [rad or m]; empty [0] for other bodies."""
    return body.rest[list(body.arm_columns)].astype(np.float64)
