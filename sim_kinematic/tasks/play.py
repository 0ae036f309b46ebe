"""Rollouts of episodes in W worlds of one task, or in one world whose agents choose in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError, suggest
from h3data.geometry import Array
from h3data.recording import STEP_NS, Body, Event, SkillSpan
from h3data.render.light.sources import LightMode
from h3data.scene.articulation import joint_names
from sim_kinematic.agents.roster import AgentSpec
from sim_kinematic.crowd.errands import HandWork
from sim_kinematic.crowd.roles import routines
from sim_kinematic.policies.assignment import Assigned, AssignedPolicy, assign, works
from sim_kinematic.policies.crowd.people import CrowdPolicy
from sim_kinematic.policies.rearrange_observations import limits
from sim_kinematic.policies.waypoints import WaypointPolicy
from sim_kinematic.sensing.agent_pictures import picture_names
from sim_kinematic.sensing.table import Sensor, sensors_of
from sim_kinematic.tasks.control import Columns, resting_arm
from sim_kinematic.tasks.episode import Episode, StepOutcome
from sim_kinematic.world import (
    Command,
    World,
)

if TYPE_CHECKING:
    from sim_kinematic.sensing.eyes import PictureSize

MOST_CHOICES = 1000
"""Number of choices of an agent in one step at which an episode ends with an error."""


class WorldRollout:
    """Rollout of W worlds of a task, each with its own episode.

    A `DecisionLoop` plays a single one.
    """

    xp: ClassVar[Any] = np
    """Array namespace with which `Task.begin`, `Task.judge` and sensors also run on a torch device."""

    def __init__(
        self,
        task: Any,
        spec: Any,
        roster: Sequence[AgentSpec],
        *,
        worlds: int = 1,
        measure: bool = True,
        options: Mapping[str, Any] | None = None,
        objects: int = 0,
        scene_joints: int = 0,
    ) -> None:
        """Create worlds without episodes, which `begin` then sets.

        Args:
            task: task, which judges each step.
            spec: numbers of the rules, such as ``max_steps``.
            roster: agents of every world.
            worlds: number of worlds W.
            measure: True if rewards and collisions are computed.
            options: options of the task, for environments.
            objects: number of things that agents can take.
            scene_joints: number of doors and drawers that agents can move.

        Raises:
            InputError: W is less than 1, or the rules allow no steps.
        """
        if spec.max_steps < 1:
            raise InputError(
                f"Expected rules with at least 1 step, got max_steps={spec.max_steps}.", code="H3-TASK-004"
            )
        self.task: Any = task
        """Task of the rollout, a `sim_kinematic.tasks.task.Task`."""
        self.spec, self.measure, self.options = spec, measure, dict(options or {})
        self.world = World(
            roster,
            worlds=worlds,
            base=spec.robot,
            walker=spec.human,
            person_radius_m=spec.agent_radius_m,
            solid=getattr(spec, "solid_agents", False),
            # a household finds out itself who touches whom
            contact=not task.control.has_skills,
            objects=objects,
            scene_joints=scene_joints,
            person_contact=getattr(spec, "person_contact", "body"),
        )
        self.episodes: list[Episode] = []
        """Episode of each world; empty before the first `begin`."""
        self.steps = np.zeros(self.world.worlds, np.int64)
        """Number of steps of each world's episode so far, [W]."""
        self.memory: Any = None
        """State that the task stores between steps."""
        self.outcome = StepOutcome(
            reward=np.zeros(worlds), terminated=np.zeros(worlds, np.bool_), success=np.zeros(worlds, np.bool_)
        )
        self.policies: list[AssignedPolicy] = []
        self.things: list[Body] = []
        """Things that people bring along, in the order of the agents, each named after its owner."""
        self.ended = "max_steps"
        self.events: list[Event] = []
        self.spans: list[SkillSpan] = []
        self.team: Any = task.control.team(self)
        """Controllers of the agents (`sim_kinematic.tasks.control.Team`)."""
        self._checked, self._checks = False, measure and not task.control.has_skills
        self._judgement: dict[str, type] = {}
        """Arrays of the outcome that are recorded as metrics, with their dtypes."""
        if task.codec.records_judgement or task.control.has_skills:
            self._judgement["reward"] = np.float32
        if task.codec.records_judgement:
            self._judgement["success"] = np.bool_
        self._sensors: dict[int, AgentSensors] = {}
        """Sensors of the agents for which observations were requested."""

    @classmethod
    def of(
        cls,
        task: Any,
        episode: Episode,
        policies: Assigned | Sequence[AssignedPolicy] | None = None,
        *,
        measure: bool = True,
    ) -> WorldRollout:
        """Return a rollout of one episode of a task, ready for a `DecisionLoop`.

        Args:
            task: task to play.
            episode: episode, such as one from `sim_kinematic.tasks.task.Task.sample`.
            policies: policy of each agent, or policies by agent or kind (`sim_kinematic.policies.assignment.assign`).
            measure: False leaves out quantities that only rewards need.

        Raises:
            InputError: there is no such policy or agent, or the number of policies is not the number of agents.
        """
        if policies is None or isinstance(policies, Mapping):
            policies = assign(task, episode, policies)
        if len(policies) != len(episode.roster):
            raise InputError(
                f"Expected one policy for each of {len(episode.roster)} agents, got {len(policies)}.",
                code="H3-TASK-016",
            )
        has_skills = task.control.has_skills
        first = len(episode.moving) if has_skills else 0
        if getattr(episode.spec, "chores", False):
            policies = [
                one._replace(hands=routines().get("chores")(episode, k, one.version).hands)
                if one.takes_commands and one.kind == "human"
                else one
                for k, one in enumerate(policies)
            ]
        things = [
            replace(thing, name=f"{member.name}_{thing.name}")
            for member, policy in zip(episode.roster, policies, strict=True)
            for thing in (works(policy) or HandWork()).things
        ]
        play = cls(
            task,
            episode.spec,
            episode.roster,
            measure=measure,
            # without skills and chores nothing moves the things of a home, so they are no part of the state
            objects=first if has_skills else len(things),
            scene_joints=len(joint_names(episode.scene)) if has_skills or any(map(works, policies)) else 0,
        )
        play.policies, play.things = list(policies), [replace(thing, moving=k) for k, thing in enumerate(things, first)]
        play.begin([episode])
        return play

    # --- W worlds -----------------------------------------------------------------------------------------------------
    def begin(self, episodes: Sequence[Episode], rows: NDArray[np.intp] | None = None) -> None:
        """Start episodes in the worlds ``rows`` [n] (default: all)."""
        rows = np.arange(self.world.worlds) if rows is None else rows
        agents = len(self.world.roster)
        if other := next((len(e.roster) for e in episodes if len(e.roster) != agents), 0):
            raise InputError(
                f"Expected episodes with {agents} agents, as the worlds have; got one with {other}. Hint: a roster of {other} "
                "agents.",
                code="H3-TASK-080",
            )
        # the first call begins all worlds, so the list has its full length from then on
        if not self.episodes:
            self.episodes = list(episodes)
        for w, episode in zip(rows.tolist(), episodes, strict=True):
            self.episodes[w] = episode
        # places first: tasks measure from them when they begin
        self.world.place(np.stack([e.starts for e in episodes]), [e.free for e in episodes], rows)
        self.steps[rows] = 0
        self.team.begin(rows)
        begun = self.task.begin(self, rows)
        # at first all worlds begin; later the values of the others must stay
        if begun is not None and self.memory is None:
            self.memory = dict(begun)
        elif begun is not None:
            for name, values in begun.items():
                # a copy, as the last outcome may hold the same array
                kept = np.array(self.memory[name])
                kept[rows] = values[rows]
                self.memory[name] = kept

    def advance(self, commands: Sequence[Command | None]) -> StepOutcome:
        """Move all worlds by one step and judge it.

        Raises:
            InputError: No episode has begun, or the commands do not fit; then nothing has moved.
        """
        if not self.episodes:
            raise InputError("No episode has begun. Hint: call reset() first.", code="H3-ENV-016")
        self.team.move(commands)
        # before it is judged: tasks find the number of steps made, this one included
        self.steps += 1
        outcome = self.task.judge(self)
        # the first outcome is always checked, the others where rewards are used
        if not self._checked or self._checks:
            outcome, self._checked = self._checked_outcome(outcome), True
        self.outcome = outcome
        return outcome

    def _checked_outcome(self, outcome: Any) -> StepOutcome:
        """Return the outcome, if its arrays are [W], finite, and of the declared columns.

        Raises:
            H3DataError: The outcome has another form, which is a fault of the task; the message names it and the field.
        """
        task, worlds = self.task, self.world.worlds
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
        if strange := outcome.columns.keys() ^ task.columns:
            raise H3DataError(
                f"{who}: columns must be those that the task declares; {', '.join(sorted(strange))} differ.",
                code="H3-TASK-003",
            )
        for name, values in outcome.columns.items():
            if np.shape(values)[:1] != (worlds,):
                raise H3DataError(
                    f"{who}: column {name} must have shape [{worlds}, ...], got {list(np.shape(values))}.",
                    code="H3-TASK-008",
                )
        return outcome

    @property
    def at_goal(self) -> NDArray[np.bool_]:
        """Return which objects are at their goals and not held, [W, K]; only for agents with skills."""
        return self.team.at_goal[None]

    @property
    def open_parts(self) -> NDArray[np.bool_]:
        """Return which doors and drawers of `Rearrange.parts_of` are at least ajar, [W, M]; only with skills."""
        return self.team.open_joints[list(self.team.parts)][None]

    def extra(self, name: str) -> NDArray[Any]:
        """Return an entry of `Episode.extra` for all worlds, [W, ...]."""
        return np.array([episode.extra[name] for episode in self.episodes])

    def path_length(self, agent: int, points: Array) -> Array:
        """Return the lengths [W] [m] of the shortest paths from an agent to points [W, 2]; infinite without one."""
        xz, lengths = self.world.state.agents[agent].xz, np.zeros(self.world.worlds)
        for free, rows in self.world.groups:
            lengths[rows] = free.geodesic(xz[rows], points[rows])
        return lengths

    def events_where(
        self, flags: NDArray[np.bool_], kind: str, *, agent: int = -1, target: str = ""
    ) -> list[tuple[int, Event]]:
        """Return an event of this step for each world whose flag [W] is set, in the form of `StepOutcome.events`."""
        # the step is counted already, and events number steps from 0
        worlds = np.flatnonzero(flags).tolist()
        return [(w, Event(step=int(self.steps[w]) - 1, agent=agent, kind=kind, target=target)) for w in worlds]

    @property
    def out_of_time(self) -> NDArray[np.bool_]:
        """Return whether the episode of each world has reached the time limit, [W]."""
        return self.steps >= self.spec.max_steps

    def agent_view(self, agent: int, world: int = 0) -> Any:
        """Return an agent's observation in one world: an `AgentView`, or a `RearrangeView` if agents have skills."""
        return self.team.view(agent, world)

    def observe(
        self, agent: int, world: int, names: Sequence[str], size: PictureSize = None, light: LightMode = "flat"
    ) -> dict[str, NDArray[Any]]:
        """Return the present values of named observations of an agent in one world, without noise.

        Raises:
            InputError: the agent has no observation of such a name.
        """
        # at least one object, as limits of sensors of objects need a number
        if agent not in self._sensors:
            self._sensors[agent] = AgentSensors.of(
                self.task,
                self.world.roster[agent],
                max(self.world.state.held_by.shape[1], 1),
                getattr(self.spec, "parts", 0),
            )
        own, shown = self._sensors[agent], {}
        own.check(names)
        measured = [name for name in names if name in own.sensors]
        for name, values in self.team.exact(agent, measured, own.sensors).items():
            low, high = own.limits[name]
            shown[name] = np.minimum(np.maximum(values[world], low), high).astype(np.float32)
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
        """Return the present pictures of an agent by name, like `sim_kinematic.sensing.eyes.see`."""
        from sim_kinematic.sensing.eyes import see

        bodies, lit_as = [member.body for member in self.world.roster], self.episodes[world].scene
        return see(
            **self.team.scenery(world), bodies=bodies, names=names, agent=agent, size=size, light=light, lit_as=lit_as
        )

    # --- one world ----------------------------------------------------------------------------------------------------
    @property
    def episode(self) -> Episode:
        """Episode of the first world."""
        return self.episodes[0]

    @property
    def step(self) -> int:
        """Number of steps made so far in the first world."""
        return self.steps.item(0)

    @property
    def reward(self) -> float:
        """Reward of the first world's last step."""
        return float(self.outcome.reward[0])

    @property
    def over(self) -> bool:
        """Return whether the rules or the time limit have ended the first world's episode."""
        return bool(self.outcome.terminated[0] or self.out_of_time[0])

    def view(self, agent: int) -> Any:
        """Return the observation of an agent's policy in the first world, as the task defines it."""
        return self.task.view(self, agent, 0)

    def decide(self, agent: int) -> Any:
        """Return the choice of an agent's policy in the first world, in the form that the `Control` takes.

        Raises:
            InputError: the policy returned something else; the message names it.
        """
        given = self.policies[agent]
        choice = given.policy.act(self.view(agent))
        try:
            return self.task.control.accepted(self, agent, choice)
        except InputError as error:
            who = self.world.roster[agent].name
            raise InputError(
                f"The policy {given.name!r} of {who} returned no valid choice: {error}", code="H3-TASK-083"
            ) from error

    # --- recording ----------------------------------------------------------------------------------------------------
    def snapshot(self) -> tuple[Any, list[Any], NDArray[np.bool_]]:
        """Return the state of the first world after a step, from which `columns` makes blocks."""
        outcome, columns = self.outcome, self.outcome.columns
        judged = [*(columns[name][0] for name in self.task.columns), *(vars(outcome)[n][0] for n in self._judgement)]
        return self.team.snapshot(), judged, self.world.touching[0]

    def columns(self, snapshots: Sequence[Any], first: int) -> Columns:
        """Return the columns of a recording from snapshots of consecutive steps, of which ``first`` is the first."""
        # a row is the state after its step, so the first one is not at time 0
        result: Columns = {"time_ns": np.arange(first + 1, first + len(snapshots) + 1, dtype=np.int64) * STEP_NS}
        own, places, contact = self.team.columns([row[0] for row in snapshots])
        touched: Columns = {}
        if self.world.pairs:
            gaps = [np.hypot(*(places[b] - places[a]).T) for a, b in self.world.pairs]
            touched["metrics.dist_agents"] = np.min(gaps, axis=0).astype(np.float32)
            touched |= contact_columns([m.kind for m in self.world.roster], np.array([row[2] for row in snapshots]))
        if contact is not None:
            touched["metrics.robot_contact"] = contact
        types = {**self.task.columns, **{f"metrics.{name}": dtype for name, dtype in self._judgement.items()}}
        values = zip(types.items(), zip(*(row[1] for row in snapshots), strict=True), strict=True)
        measured = {name: np.array(rows).astype(dtype) for (name, dtype), rows in values}
        judged = {name: measured.pop(name) for name in self.task.columns}
        # in the order of earlier versions, which files keep
        parts = (own, judged, touched) if self.task.control.has_skills else (own, touched, judged)
        for part in (*parts, measured):
            result |= part
        return result


class DecisionLoop:
    """Loop over the turns of an episode, which pauses when an agent must decide and at the end of each step."""

    def __init__(self, play: WorldRollout) -> None:
        self._play, self._left = play, play.spec.max_steps
        self._commands: list[Command | None] = [None] * len(play.world.roster)
        self._turn = 0
        """Number of agents that have already made this step."""
        self._choices = 0
        """Number of choices that the agent whose turn it is has made in this step without moving."""
        self._begun = self._ended = False
        """True if the agent whose turn it is has observed the others; true if the rules have ended the episode."""
        self.over = False
        self.asked: int | None = None
        """Number of the agent that must decide; None if a step is over or no step has started."""
        self.go_on()

    def answer(self, choice: Any) -> None:
        """Take the choice of the agent that was asked."""
        assert self.asked is not None
        self._start(self.asked, choice)
        self._go_on()

    def go_on(self) -> None:
        """Start the next step."""
        if self._ended or not self._left:
            self.over = True
            return
        self._left, self._turn = self._left - 1, 0
        self._play.team.begin_step()
        self._go_on()

    def _go_on(self) -> None:
        """Play on until an agent must decide or the step is over."""
        play, team = self._play, self._play.team
        while self._turn < len(team.order):
            number = team.order[self._turn]
            if not self._begun:
                team.begin_turn(number)
                self._begun = True
            if team.controllers[number].status != "choosing":
                self._step(number)
                continue
            policy, own = play.policies[number].policy, play.world.state.agents[number]
            # scripts need no view: they are asked a hundred times more often than anything else
            if type(policy) is WaypointPolicy:
                self._start(number, policy.move(own.xz[0], own.heading.item(0)))
            elif type(policy) is CrowdPolicy:
                self._start(number, policy.move(team.crowds_of(0), number, play.step))
            else:
                self.asked = number
                return
        self.asked = None
        outcome = play.advance(self._commands)
        play.events += [event for _, event in outcome.events]
        play.events += team.new_events()
        if outcome.terminated[0]:
            self._ended, play.ended = True, outcome.ended or ("success" if outcome.success[0] else "terminated")

    def _start(self, number: int, choice: Any) -> None:
        self._play.team.controllers[number].start(choice)
        self._step(number)

    def _step(self, number: int) -> None:
        team = self._play.team
        controller = team.controllers[number]
        self._commands[number] = controller.step()
        if controller.status != "choosing":
            team.end_turn(number)
            self._turn, self._begun, self._choices = self._turn + 1, False, 0
            return
        self._choices += 1
        if self._choices == MOST_CHOICES:
            raise InputError(
                f"In {self._play.task.name}, {self._play.world.roster[number].name} has made {MOST_CHOICES:,} choices in "
                f"step {self._play.step}, and its {type(controller).__name__} still asks for another.",
                code="H3-TASK-091",
            )


def contact_columns(kinds: Sequence[str], touching: NDArray[np.bool_]) -> Columns:
    """Return the columns that record which agents touch each other.

    ``metrics.collision`` [T] is true where any two agents touch. With more than two agents,
    ``metrics.collision_people`` [T, P] is true for each person that the first robot touches, and
    ``metrics.collision_robots`` [T, R - 1] for each further robot that it touches.

    Args:
        kinds: Kind of each agent.
        touching: True where a pair of agents touches, in the order of `itertools.combinations` of their numbers [T, pairs].
    """
    columns: Columns = {"metrics.collision": np.asarray(touching.any(axis=1))}
    first = kinds.index("robot") if "robot" in kinds and len(kinds) > 2 else -1
    if first >= 0:
        # the sum of a pair less one of its numbers is the other number
        mine = [(sum(pair) - first, n) for n, pair in enumerate(combinations(range(len(kinds)), 2)) if first in pair]
        for name, kind in (("people", "human"), ("robots", "robot")):
            if chosen := [n for other, n in mine if kinds[other] == kind]:
                columns[f"metrics.collision_{name}"] = touching[:, chosen]
    return columns


class AgentSensors(NamedTuple):
    """Observations that one agent can have."""

    agent: str
    sensors: Mapping[str, Sensor]
    limits: Mapping[str, tuple[Array, Array]]
    """Least and largest values of each sensor."""
    pictures: frozenset[str]

    @classmethod
    def of(cls, task: Any, member: AgentSpec, objects: int, parts: int = 0) -> AgentSensors:
        """Return the sensors and pictures of an agent, given the numbers of objects and of parts that open."""
        sensors = sensors_of(member.kind, task.sensors)
        spaces = limits(sensors, objects=objects, arm=len(resting_arm(member.body)), parts=parts)
        exact = {name: (np.asarray(s.low, np.float64), np.asarray(s.high, np.float64)) for name, s in spaces.items()}
        return cls(member.name, {name: sensors[name] for name in exact}, exact, frozenset(picture_names(member.body)))

    def check(self, names: Sequence[str]) -> None:
        """Raise an `InputError` that lists the existing observations if one of ``names`` does not exist."""
        for name in names:
            if name not in self.sensors and name not in self.pictures:
                there = [*sorted(self.sensors), *sorted(self.pictures)]
                raise InputError(
                    f"Unknown observation {name!r} of {self.agent}.{suggest(name, there)}", code="H3-TASK-071"
                )
