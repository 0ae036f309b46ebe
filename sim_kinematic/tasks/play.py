"""Episodes under way: the protocol that the runner drives, and the play of tasks whose agents drive and walk."""

from __future__ import annotations

from collections.abc import Collection, Generator, Mapping, Sequence
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.errors import H3DataError, InputError, suggest
from h3data.geometry import Array
from h3data.moved import refuse_renamed
from h3data.recording import STEP_NS, Event, SkillSpan
from h3data.render.light.sources import LightMode
from sim_kinematic.agents.roster import AgentSpec
from sim_kinematic.contact.frames import root_pose
from sim_kinematic.motion.state import HumanState, RobotState
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.policy import GaitAction, PoseAction, RecordedPose, WaypointAction
from sim_kinematic.policies.traffic import Traffic
from sim_kinematic.policies.views import AgentView
from sim_kinematic.policies.waypoints import WaypointPolicy
from sim_kinematic.sensing.agent_pictures import picture_names
from sim_kinematic.sensing.sensor import first_point
from sim_kinematic.sensing.table import Sensor, SensorContext, sensed
from sim_kinematic.tasks.episode import Episode, StepOutcome, agent_floor
from sim_kinematic.world import (
    Command,
    DriveCommand,
    GaitCommand,
    PoseCommand,
    Posture,
    RecordedPoseCommand,
    WaypointCommand,
    World,
)

if TYPE_CHECKING:
    from sim_kinematic.sensing.eyes import PictureSize
else:
    __getattr__ = refuse_renamed(__name__)

Columns = dict[str, NDArray[Any]]


class Rollout(Protocol):
    """One episode under way. It moves everybody; who decides is asked through `turns`."""

    policies: list[AssignedPolicy]
    """One for each agent."""
    ended: str
    """Reason why the episode ended; ``max_steps`` until there is another."""
    events: list[Event]
    """Events since the recorder last took them."""
    spans: list[SkillSpan]
    """Skills that have ended, likewise."""

    @property
    def episode(self) -> Episode:
        """The episode that is played."""
        ...

    @property
    def step(self) -> int:
        """The step that is being played, from 0."""
        ...

    @property
    def over(self) -> bool:
        """Returns whether the last step has been played."""
        ...

    @property
    def reward(self) -> float:
        """Reward of the last step."""
        ...

    def turns(self) -> Generator[int | None, Any, None]:
        """Generator that plays the episode to its end.

        It yields the number of an agent that must decide and is sent the agent's choice, and yields None after each
        step.
        """
        ...

    def view(self, agent: int) -> Any:
        """Observation of an agent's policy."""
        ...

    def snapshot(self) -> Any:
        """The step just played, as `columns` takes it."""
        ...

    def columns(self, snapshots: Sequence[Any], first: int) -> Columns:
        """Columns of consecutive steps, of which the first is number ``first``."""
        ...

    def finish(self) -> None:
        """Closes what is still going on, such as running skills."""
        ...


class Rules(Protocol):
    """Methods of a task that `WorldRollout` calls; `sim_kinematic.tasks.task.Task` explains them."""

    control: ClassVar[Any]
    """Says what agents report to be doing (`sim_kinematic.tasks.control.Control`)."""
    columns: ClassVar[Mapping[str, Any]]

    @property
    def codec(self) -> Any:
        """Says whether reward and success are recorded (`sim_kinematic.tasks.codec.EpisodeCodec`)."""
        ...

    def begin(self, play: WorldRollout, rows: NDArray[np.intp]) -> Mapping[str, Any] | None:
        """Prepares the worlds ``rows`` [n], whose episodes have just begun."""

    def judge(self, play: WorldRollout) -> StepOutcome:
        """Returns reward, end and events of the step that all worlds have just made."""
        ...

    def view(self, play: WorldRollout, agent: int, world: int) -> Any:
        """Returns the observation of an agent's policy in one world."""
        ...

    def sensors(self, kind: str) -> Mapping[str, Sensor]:
        """Returns the observations of agents of a kind, beyond pictures, by name."""
        ...


class WorldRollout:
    """W worlds of one task, each in an episode of its own; with W = 1 a `Rollout`."""

    xp: ClassVar[Any] = np
    """The array namespace: `Task.begin`, `Task.judge` and sensors written with it run on a torch device too."""

    def __init__(
        self,
        task: Rules,
        spec: Any,
        roster: Sequence[AgentSpec],
        *,
        worlds: int = 1,
        measure: bool = True,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Creates worlds without episodes; `begin` puts episodes into them.

        Args:
            task: rules by which each step is judged.
            spec: numbers of the rules, such as ``max_steps``.
            roster: agents of every world.
            worlds: number of worlds W.
            measure: whether rewards and collisions are computed.
            options: options of the task, for environments.

        Raises:
            InputError: W is less than 1, or the rules allow no steps.
        """
        if spec.max_steps < 1:
            raise InputError(
                f"Expected rules with at least 1 step, got max_steps={spec.max_steps}.", code="H3-TASK-004"
            )
        self.task, self.spec, self.measure, self.options = task, spec, measure, dict(options or {})
        self.world = World(
            roster,
            worlds=worlds,
            base=spec.robot,
            walker=spec.human,
            person_radius_m=spec.agent_radius_m,
            solid=getattr(spec, "solid_agents", False),
            person_contact=getattr(spec, "person_contact", "body"),
        )
        self.episodes: list[Episode] = []
        """Episode of each world; empty before the first `begin`."""
        self.steps = np.zeros(self.world.worlds, np.int64)
        """Steps of the episode so far, [W]."""
        self.memory: Any = None
        """The task's own state."""
        self.outcome = StepOutcome(
            reward=np.zeros(worlds), terminated=np.zeros(worlds, np.bool_), success=np.zeros(worlds, np.bool_)
        )
        self.policies: list[AssignedPolicy] = []
        self.ended = "max_steps"
        self.events: list[Event] = []
        self.spans: list[SkillSpan] = []
        self._commands: list[Command] = []
        self._words: list[str] = []
        self._checked, self._records_judgement = False, bool(task.codec.records_judgement)
        self._arms = [np.tile(resting_arm(member.body), (self.world.worlds, 1)) for member in self.world.roster]
        """Resting positions of the arm joints of each agent, [W, n]."""
        self._sensors: dict[int, AgentSensors] = {}
        """Sensors of the agents for which observations were requested."""
        self._traffic: dict[int, Traffic] = {}
        """Traffic of the worlds for which it was requested."""

    # --- W worlds -----------------------------------------------------------------------------------------------------
    def begin(self, episodes: Sequence[Episode], rows: NDArray[np.intp] | None = None) -> None:
        """Begins episodes in the worlds ``rows`` [n] (default: all)."""
        rows = np.arange(self.world.worlds) if rows is None else rows
        if not self.episodes:
            self.episodes = list(episodes)
        for w, episode in zip(rows.tolist(), episodes, strict=True):
            self.episodes[w] = episode
            self._traffic.pop(w, None)
        self.world.place(np.stack([e.starts for e in episodes]), [e.free for e in episodes], rows)
        self.steps[rows] = 0
        begun = self.task.begin(self, rows)
        if begun is not None and self.memory is None:
            self.memory = dict(begun)
        elif begun is not None:
            for name, values in begun.items():
                kept = np.array(self.memory[name])  # a copy: the last outcome may hold the same array
                kept[rows] = values[rows]
                self.memory[name] = kept

    def advance(self, commands: Sequence[Command]) -> StepOutcome:
        """Moves all worlds one step and judges it.

        Raises:
            InputError: no episode has begun, or the commands do not fit; then nothing has moved.
        """
        if not self.episodes:
            raise InputError("No episode has begun. Hint: call reset() first.", code="H3-ENV-016")
        self.world.step(commands)
        self._commands = list(commands)
        self.steps += 1
        outcome = self.task.judge(self)
        if not self._checked or self.measure:
            outcome, self._checked = checked_outcome(self.task, outcome, self.world.worlds), True
        self.outcome = outcome
        return outcome

    def extra(self, name: str) -> NDArray[Any]:
        """An entry of `Episode.extra` of every world, [W, ...]."""
        return np.array([episode.extra[name] for episode in self.episodes])

    def path_length(self, agent: int, points: Array) -> Array:
        """Lengths of the shortest paths from an agent to points [W, 2], [W] [m]; inf where there is none."""
        xz, lengths = self.world.state.agents[agent].xz, np.zeros(self.world.worlds)
        for free, rows in self.world.groups:
            lengths[rows] = free.geodesic(xz[rows], points[rows])
        return lengths

    def events_where(
        self, flags: NDArray[np.bool_], kind: str, *, agent: int = -1, target: str = ""
    ) -> list[tuple[int, Event]]:
        """An event of this step for each world where a flag [W] is set, as `StepOutcome.events` takes them."""
        worlds = np.flatnonzero(flags).tolist()
        return [(w, Event(step=int(self.steps[w]) - 1, agent=agent, kind=kind, target=target)) for w in worlds]

    @property
    def out_of_time(self) -> NDArray[np.bool_]:
        """Worlds whose episode has had all its steps, [W]."""
        return self.steps >= self.spec.max_steps

    def agent_view(self, agent: int, world: int = 0) -> AgentView:
        """Observation of an agent in one world, for any policy."""
        w, now, before = world, self.world.state.agents, self.world.before.agents
        episode = self.episodes[w]
        places = np.array([[*own.xz[w], own.heading[w]] for own in now])
        was = np.array([[*own.xz[w], own.heading[w]] for own in before])
        return AgentView(
            int(self.steps[w]),
            episode.seed,
            agent,
            tuple(member.kind for member in self.world.roster),
            agent_floor(episode, agent),
            places,
            was,
            self.world.bases,
            self.spec.human,
            episode.extra,
            partial(self._traffic_of, world),
            partial(self.observe, agent, world),
        )

    def sensor_context(self, agent: int) -> SensorContext:
        """Returns the input of an agent's sensors now, in all worlds."""
        world = self.world
        kinds = [member.kind for member in world.roster]
        other = next((n for n, kind in enumerate(kinds) if kind != kinds[agent]), (agent + 1) % len(kinds))
        now, before = world.state.agents, world.before.agents
        mine = [p for p, pair in enumerate(world.pairs) if agent in pair]
        return SensorContext(
            self.spec,
            world.bases[agent],
            self.memory,
            self.episodes,
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
        """The shortest paths from an agent to another: their lengths [W] [m] and their first way points [W, 2] [m]."""
        world, lengths = self.world, self.world.geodesic(agent, other)
        xz, to, begun = world.state.agents[agent].xz, world.state.agents[other].xz, world.bases[agent].disc_radius_m / 2
        ends = zip(world.floors, xz, to, lengths.tolist(), strict=True)
        return lengths, np.array([first_point(free, a, b, length, beyond_m=begun) for free, a, b, length in ends])

    def observe(
        self, agent: int, world: int, names: Sequence[str], size: PictureSize = None, light: LightMode = "flat"
    ) -> dict[str, NDArray[Any]]:
        """Named observations of an agent in one world now, exact, as environments show them.

        Raises:
            InputError: it has no observation of such a name.
        """
        if agent not in self._sensors:
            self._sensors[agent] = AgentSensors.of(self.task, self.world.roster[agent])
        own, shown = self._sensors[agent], {}
        own.check(names)
        measured = [name for name in names if name in own.sensors]
        context = self.sensor_context(agent) if measured else None
        for name in measured:
            sensor, low, high = own.sensors[name]
            values = sensed(name, sensor, context, type(self.task).__name__, own.agent)[world]
            shown[name] = np.minimum(np.maximum(values, low), high).astype(np.float32)
        if len(measured) < len(names):
            shown |= self.pictures(agent, world, [name for name in names if name in own.pictures], size, light)
        return shown

    def pictures(
        self,
        agent: int,
        world: int,
        names: Sequence[str],
        size: PictureSize,
        light: LightMode = "flat",
    ) -> dict[str, NDArray[Any]]:
        """Named pictures of an agent now, as `sim_kinematic.sensing.eyes.see`."""
        from sim_kinematic.sensing.eyes import see

        state = self.world.state.take(np.array([world]))
        bodies = [member.body for member in self.world.roster]
        floor, speed = self.world.floors[world], self.spec.human.speed_mps
        scene = self.episodes[world].scene
        return see(state, scene, bodies, names, agent=agent, size=size, floor=floor, speed_mps=speed, light=light)

    def _traffic_of(self, world: int) -> Traffic:
        if world not in self._traffic:
            floors = [agent_floor(self.episodes[world], number) for number in range(len(self.world.roster))]
            self._traffic[world] = Traffic(self.world, world, floors)
        return self._traffic[world]

    # --- one world: Rollout -------------------------------------------------------------------------------------------
    @property
    def episode(self) -> Episode:
        """Episode of the first world."""
        return self.episodes[0]

    @property
    def step(self) -> int:
        """Number of steps made in the first world."""
        return int(self.steps[0])

    @property
    def reward(self) -> float:
        """Reward of the first world's last step."""
        return float(self.outcome.reward[0])

    @property
    def over(self) -> bool:
        """Returns whether the rules or the time limit have ended the first world's episode."""
        return bool(self.outcome.terminated[0] or self.out_of_time[0])

    def view(self, agent: int) -> Any:
        """Observation of an agent's policy in the first world, as the task defines it."""
        return self.task.view(self, agent, 0)

    def turns(self) -> Generator[int | None, Any, None]:
        """Plays the first world to the end of its episode: asks every agent in turn, then makes a step."""
        agents = range(len(self.world.roster))
        for _ in range(self.spec.max_steps):
            choices = []
            for number in agents:
                policy = self.policies[number].policy
                # the script needs no view: it is asked a hundred times more often than anything else
                scripted = type(policy) is WaypointPolicy
                own = self.world.state.agents[number]
                choices.append(policy.move(own.xz[0], own.heading.item(0)) if scripted else (yield number))
            self._words = [getattr(choice, "skill", "") for choice in choices]
            outcome = self.advance([self._command(k, choice) for k, choice in enumerate(choices)])
            self.events += [event for _, event in outcome.events]
            if outcome.terminated[0]:
                self.ended = outcome.ended or ("success" if outcome.success[0] else "terminated")
                yield None
                return
            yield None

    def _command(self, number: int, choice: Any) -> Command:
        """A choice for one agent of the only world; velocities are rounded to float32, as they are recorded."""
        if isinstance(choice, WaypointAction):
            return WaypointCommand(choice.xz[None])
        if isinstance(choice, PoseAction):
            return PoseCommand(choice.xz[None], np.array([choice.heading]))
        if isinstance(choice, GaitAction):
            return GaitCommand(choice.gait)
        if isinstance(choice, RecordedPose):
            posture = Posture(
                np.array([choice.clip]), np.array([choice.phase]), np.array([choice.blend]), np.array([choice.arms])
            )
            return RecordedPoseCommand(choice.xz[None], np.array([choice.heading]), posture)
        if not hasattr(choice, "forward"):
            who = self.world.roster[number].name
            raise InputError(
                f"Expected {who} to choose a Velocity or WaypointAction, got {choice!r}.", code="H3-TASK-069"
            )
        return DriveCommand(np.array([[choice.forward, choice.turn]], np.float32).astype(np.float64))

    def finish(self) -> None:
        """Nothing goes on: the recorder reads skills off their columns."""

    # --- recording ----------------------------------------------------------------------------------------------------
    def snapshot(self) -> tuple[Any, ...]:
        """State of the first world after a step, as plain numbers; `columns` makes blocks of them."""
        numbers: list[float] = []
        state, before, skills = self.world.state, self.world.before, self.task.control.skills
        for k, (member, own) in enumerate(zip(self.world.roster, state.agents, strict=True)):
            words = skills.get(member.kind, ())
            (x, z), heading = own.xz[0].tolist(), own.heading.item(0)  # Python floats: half the time of NumPy's
            if isinstance(own, RobotState):
                command = self._commands[k]
                forward, turn = command[0][0, :2].tolist() if isinstance(command, DriveCommand) else (0.0, 0.0)
                code = words.index(self._words[k]) if self._words[k] in words else -1
                numbers += (x, z, heading, own.contact.item(0), forward, turn, code)
            else:
                was = before.agents[k]
                assert isinstance(was, HumanState)
                distance = own.distance.item(0)
                walks = distance > was.distance.item(0)
                code = words.index("walk" if walks else "turn") if words else -1
                since = distance - own.set_off.item(0)
                numbers += (x, z, heading, since, own.blend.item(0), *own.arms[0].tolist(), code)
        judged = {name: values[0] for name, values in self.outcome.columns.items()}
        if self._records_judgement:
            judged |= {"metrics.reward": self.outcome.reward[0], "metrics.success": self.outcome.success[0]}
        return (*numbers, judged, self.world.touching[0])

    def columns(self, snapshots: Sequence[Any], first: int) -> Columns:
        """Columns of a recording from the snapshots of consecutive steps, the first of which is step ``first``."""
        numbers = np.array([row[:-2] for row in snapshots], np.float64)
        steps, floor = len(snapshots), self.episode.free
        result: Columns = {"time_ns": np.arange(first + 1, first + steps + 1, dtype=np.int64) * STEP_NS}
        places, contact, at = [], [], 0
        for k, member in enumerate(self.world.roster):
            agent, body = f"agent_{k}.", member.body
            own = numbers[:, at : at + (7 if isinstance(body, Robot) else 8)].T
            at += len(own)
            xz = np.stack([own[0], own[1]], -1)
            places.append(xz)
            result[agent + "base_pose"] = root_pose(body, xz, own[2], floor).astype(np.float32)
            if isinstance(body, Robot):
                contact.append(own[3].astype(np.bool_))
                result[agent + "joint_pos"] = np.tile(body.rest.astype(np.float32), (steps, 1))
                result[agent + "action"] = np.stack([own[4], own[5]], -1).astype(np.float32)
            else:
                result |= {agent + name: values for name, values in self._motion_columns(k, body, own).items()}
            result[agent + "grasp_body"] = np.full(steps, -1, np.int32)
            if self.task.control.skills.get(member.kind):
                result[agent + "skill"] = own[-1].astype(np.int32)
        if self.world.pairs:
            gaps = [np.hypot(*(places[b] - places[a]).T) for a, b in self.world.pairs]
            result["metrics.dist_agents"] = np.min(gaps, axis=0).astype(np.float32)
            result |= contact_columns([m.kind for m in self.world.roster], np.array([row[-1] for row in snapshots]))
        if contact:
            result["metrics.robot_contact"] = np.any(contact, axis=0)
        judgement = {"metrics.reward": np.float32, "metrics.success": np.bool_} if self._records_judgement else {}
        for name, dtype in {**self.task.columns, **judgement}.items():
            result[name] = np.array([row[-2][name] for row in snapshots]).astype(dtype)
        return result

    def _motion_columns(self, k: int, body: Humanoid, own: Array) -> Columns:
        clip, walk = self.world.clips[k], body.clips[self.world.clips[k]]
        columns: Columns = {
            "motion_id": np.full(own.shape[1], clip, np.int32),
            "motion_phase": ((walk.start_phase + own[3] / walk.stride_m) % 1.0).astype(np.float32),
            "motion_blend": own[4].astype(np.float32),
        }
        if self.spec.human.arms is not None:
            columns["motion_arms"] = np.stack([own[5], own[6]], -1).astype(np.float32)
        return columns


def contact_columns(kinds: Sequence[str], touching: NDArray[np.bool_]) -> Columns:
    """Columns of who touches whom.

    ``metrics.collision`` [T] says whether any two agents touch. Where this leaves open whom the first robot touches, because
    there are more than two agents, ``metrics.collision_people`` [T, P] says it of each person, and
    ``metrics.collision_robots`` [T, R - 1] of each further robot.

    Args:
        kinds: Kind of each agent.
        touching: True where a pair of agents touches, in the order of `itertools.combinations` of their numbers [T, pairs].
    """
    columns: Columns = {"metrics.collision": np.asarray(touching.any(axis=1))}
    first = kinds.index("robot") if "robot" in kinds and len(kinds) > 2 else -1
    if first >= 0:
        mine = [(sum(pair) - first, n) for n, pair in enumerate(combinations(range(len(kinds)), 2)) if first in pair]
        for name, kind in (("people", "human"), ("robots", "robot")):
            if chosen := [n for other, n in mine if kinds[other] == kind]:
                columns[f"metrics.collision_{name}"] = touching[:, chosen]
    return columns


def checked_outcome(task: Rules, outcome: Any, worlds: int) -> StepOutcome:
    """The outcome, if its arrays are [W], finite, and of the declared columns.

    Raises:
        H3DataError: they are not: a fault of the task, which the message names with the field.
    """
    who = f"{type(task).__module__}:{type(task).__qualname__}.judge"
    if not isinstance(outcome, StepOutcome):
        raise H3DataError(f"{who} must return a StepOutcome, got {type(outcome).__name__}.", code="H3-TASK-068")
    for name in ("reward", "terminated", "success"):
        values = np.asarray(getattr(outcome, name))
        if values.shape != (worlds,):
            raise H3DataError(
                f"{who}: {name} must have shape [{worlds}], got {list(values.shape)}.", code="H3-TASK-006"
            )
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise H3DataError(
                f"{who}: {name} must be finite, got {values[~np.isfinite(values)][0]}.", code="H3-TASK-007"
            )
    strange = sorted(set(outcome.columns) ^ set(task.columns))
    if strange:
        raise H3DataError(
            f"{who}: columns must be those that the task declares; {', '.join(strange)} differ.", code="H3-TASK-003"
        )
    for name, values in outcome.columns.items():
        if np.shape(values)[:1] != (worlds,):
            raise H3DataError(
                f"{who}: column {name} must have shape [{worlds}, ...], got {list(np.shape(values))}.",
                code="H3-TASK-008",
            )
    return outcome


class AgentSensors(NamedTuple):
    """Observations that one agent can have."""

    agent: str
    sensors: Mapping[str, tuple[Sensor, Array, Array]]
    """Each with its least and greatest values."""
    pictures: frozenset[str]

    @classmethod
    def of(cls, task: Rules, member: AgentSpec) -> AgentSensors:
        """The sensors and pictures of an agent."""
        arm, sensors = len(resting_arm(member.body)), {}
        for name, sensor in task.sensors(member.kind).items():
            limits = sensor.limits(arm if sensor.times == "joints" else 1)
            sensors[name] = sensor, np.asarray(limits.low, np.float64), np.asarray(limits.high, np.float64)
        return cls(member.name, sensors, frozenset(picture_names(member.body)))

    def check(self, names: Sequence[str]) -> None:
        """Raises an `InputError` if there is no such observation; it lists what there is."""
        check_observations(names, (self.sensors, self.pictures), self.agent)


def resting_arm(body: Humanoid | Robot) -> Array:
    """Resting positions of a robot's arm joints, [n]; [0] of a person or of a robot without a hand."""
    return body.rest[list(body.arm_columns)].astype(np.float64) if isinstance(body, Robot) else np.zeros(0)


def check_observations(names: Sequence[str], known: Sequence[Collection[str]], agent: str) -> None:
    """Checks that an agent has observations of these names.

    Raises:
        InputError: it has not; the message lists what there is.
    """
    for name in names:
        if not any(name in some for some in known):
            there = [each for some in known for each in sorted(some)]
            raise InputError(f"Unknown observation {name!r} of {agent}.{suggest(name, there)}", code="H3-TASK-071")
