"""Recorder of episodes of all tasks while they run, and `simulate`, which plays and records a whole episode.

Steps become blocks of columns that go to a sink; events, skills and raw input are written between them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies import robot_digest
from h3data.bodies.names import JOIN, walk_attachments, walk_facts
from h3data.errors import InputError
from h3data.plugins import REFERENCE, own_version, trust
from h3data.recording import (
    STEP_NS,
    Body,
    Event,
    InputEvent,
    Recording,
    RecordingHeader,
    SkillSpan,
    state_hash,
)
from h3data.recording import Episode as EpisodeRecord
from h3data.recording.assets.scenes import categories_of, scene_attachment, scene_records
from h3data.recording.records import agent_numbers
from h3data.recording.scans import scan_column
from sim_kinematic.agents.roster import AgentSpec, kinds_of
from sim_kinematic.agents.skills import CONTROL, Action
from sim_kinematic.crowd.errands import HandWork
from sim_kinematic.policies.assignment import Assigned, AssignedPolicy, works
from sim_kinematic.policies.recorded import COMMAND, is_remote
from sim_kinematic.sensing.agent_pictures import LIDAR_3D
from sim_kinematic.sensing.lidar import ELEVATION_DEG, SCAN_M
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.play import AgentSensors, Columns, DecisionLoop, WorldRollout
from sim_kinematic.tasks.registry import reference_of
from sim_kinematic.tasks.task import Task

BLOCK, SHORT_M = 30, 16.0
"""Number of rows that are passed to the sink at once (one second, which a crash may lose); and largest measured length
for recording a sensor in 16 bits, which resolve 4 mm at 8 m [m]."""


class Sink(Protocol):
    """Receiver of an episode while it runs, such as `h3data.recording.RecordingWriter`."""

    def append(self, rows: dict[str, NDArray[Any]]) -> None:
        """Append steps: every column, with the same number of rows."""

    def event(self, event: Event) -> None:
        """Append an event to the recording."""

    def skill(self, span: SkillSpan) -> int:
        """Append a skill, running or ended, and return its number."""
        ...

    def input(self, event: InputEvent) -> Any:
        """Append raw input of an agent that is controlled from outside."""
        ...

    def close(self, *, info: dict[str, Any]) -> object:
        """Complete the recording with entries of its info that are known only at the end."""
        ...

    def abort(self) -> None:
        """End the recording early; the rows written so far stay readable."""


class RecordedSensors:
    """Sensors of an episode's robots that are recorded with every step."""

    def __init__(self, task: Task, roster: Sequence[AgentSpec], names: Sequence[str]) -> None:
        """Check and select the sensors by name.

        Raises:
            InputError: there is no robot, or it has no sensor with one of the names.
        """
        self._names, self._robots = tuple(names), agent_numbers(roster, "robot")
        if isinstance(names, str) or not self._robots or task.control.has_skills:
            raise InputError(
                f"Expected a list of sensors, of robots in a task whose agents drive and walk, got {names!r} of "
                f"{len(self._robots)} robots in {task.name}. Hint: leave them out.",
                code="H3-TASK-075",
            )
        self.facts: dict[str, dict[str, Any]] = {}
        """Sensor, agent, unit, frame and bounds of each column."""
        self._types: dict[str, type] = {}
        for k in self._robots:
            member = roster[k]
            known = AgentSensors.of(task, member, objects=0)
            # of all pictures only laser scans become columns
            known = known._replace(pictures=known.pictures & {LIDAR_3D})
            known.check(self._names)
            for name in self._names:
                column = scan_column(k, name)
                if name == LIDAR_3D:
                    self.facts[column] = {
                        "sensor": name,
                        "agent": k,
                        "unit": "m",
                        "frame": "lidar",
                        "low": 0.0,
                        "high": SCAN_M,
                        "elevation_deg": list(ELEVATION_DEG),
                        "height_m": float(member.body.body_height_m),  # type: ignore[union-attr]
                    }
                    self._types[column] = np.float32
                    continue
                sensor, (low, high) = known.sensors[name], known.limits[name]
                self.facts[column] = {
                    "sensor": name,
                    "agent": k,
                    "unit": _one(sensor.unit),
                    "frame": sensor.frame,
                    "low": _one(low.tolist()),
                    "high": _one(high.tolist()),
                }
                # 16 bits are fine enough for short lengths only, and halve the size of a scan of many rays
                short = {*sensor.unit} == {"m"} and low.min() >= 0 and high.max() <= SHORT_M
                self._types[column] = np.float16 if short else np.float32

    @classmethod
    def again(cls, task: Task, roster: Sequence[AgentSpec], recording: Recording) -> RecordedSensors | None:
        """Return the sensors that a recording contains, or None if it has none.

        Errors are those of the constructor.
        """
        told = recording.episode.info.get("sensors")
        # info comes from a file and may hold anything
        found = [facts for name, facts in told.items() if name in recording.columns] if isinstance(told, dict) else []
        names = dict.fromkeys(str(facts.get("sensor")) for facts in found if isinstance(facts, dict))
        return cls(task, roster, tuple(names)) if names else None

    def read(self, play: Any) -> dict[str, Any]:
        """Return the sensors' values in the last step, by column."""
        values = {}
        for k in self._robots:
            for name, shown in play.observe(k, 0, self._names).items():
                column = scan_column(k, name)
                values[column] = shown.astype(self._types[column])
        return values


def _one(values: Sequence[Any]) -> Any:
    """Return the value if all are equal, else the values as a list."""
    return values[0] if len(set(values)) == 1 else list(values)


@dataclass
class Recorder:
    """Recorder of an episode, to which each step is added."""

    header: RecordingHeader
    play: WorldRollout
    sink: Sink | None = None
    blocks: list[Columns] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    skills: list[SkillSpan] = field(default_factory=list)
    inputs: list[InputEvent] = field(default_factory=list)
    beside: dict[str, np.generic] = field(default_factory=dict)
    """Values of further columns that are written with every row. All of them have to be set before the first row, and
    their dtypes must not change. They must not be part of the state, because a recording that is simulated again does
    not have them."""
    sensors: RecordedSensors | None = None
    """Sensors that are recorded with every step; their columns are measurements, not state."""
    latest: Any = None
    """Snapshot of the last step; None before the first step."""
    _rows: list[Any] = field(default_factory=list)
    _beside: list[tuple[np.generic, ...]] = field(default_factory=list)
    _count: int = 0

    @classmethod
    def of(
        cls,
        play: WorldRollout,
        sink: Callable[[RecordingHeader], Sink] | None = None,
        *,
        episode_id: str = "0",
        info: Mapping[str, Any] | None = None,
        sensors: Sequence[str] = (),
    ) -> Recorder:
        """Return the recorder of an episode that is about to start.

        Args:
            play: Episode with its policies, before the first step.
            sink: Function that is called once with the header and returns the receiver of rows and events.
            episode_id: Name of the episode within its dataset.
            info: Entries of the recording's info that the caller knows from the start.
            sensors: Names of sensors of robots that are recorded with every step.

        Raises:
            InputError: There is no robot, or it has no sensor of such a name.
        """
        measured = RecordedSensors(play.task, play.world.roster, sensors) if sensors else None
        header = describe(play.task, play.episode, play.policies, episode_id=episode_id, things=play.things)
        if info:
            header = replace(header, episode=replace(header.episode, info={**header.episode.info, **info}))
        return cls(header, play, sink(header) if sink is not None else None, sensors=measured)

    def __len__(self) -> int:
        return self._count + len(self._rows)

    def add(self) -> None:
        """Record the last step."""
        if self.sensors is not None:
            self.beside |= self.sensors.read(self.play)
        self.latest = self.play.snapshot()
        self._rows.append(self.latest)
        self._beside.append(tuple(self.beside.values()))
        # a recording in memory loses nothing in a crash, and many rows at once take a fifth of the time of few
        if len(self._rows) == (BLOCK if self.sink is not None else 16 * BLOCK):
            self._close_block()
        self._take()

    def decide(self, number: int) -> Any:
        """Return the choice of an agent's policy, and record it as raw input if no column has it."""
        choice = self.play.decide(number)
        # commands of a server to an arm are in no column
        if isinstance(choice, Action) and choice.skill == CONTROL and is_remote(self.play.policies[number].policy):
            self.choice(number, choice)
        return choice

    def choice(self, number: int, choice: Any, reason: str = "") -> None:
        """Record a choice of an agent as raw input; ``reason`` is why it interrupted a running skill."""
        step = len(self)
        payload = {"agent": number, "step": step, "choice": self.play.task.control.to_json(choice)}
        if reason:
            payload["interrupts"] = reason
        text = msgspec.json.encode(payload).decode()
        self.input(InputEvent(time_ns=step * STEP_NS, kind=COMMAND, user=number, payload=text))

    def input(self, event: InputEvent) -> None:
        """Record raw input of an agent that is controlled from outside."""
        self.inputs.append(event)
        if self.sink is not None:
            self.sink.input(event)

    def columns(self) -> Columns:
        """Return all rows so far."""
        self._close_block()
        if not self.blocks:
            return {"time_ns": np.zeros(0, np.int64)}
        return {name: np.concatenate([b[name] for b in self.blocks]) for name in self.blocks[0]}

    def latest_columns(self) -> Columns:
        """Return the columns of the last step, one row each, without the hash of the state."""
        return self.play.columns([self.latest], len(self) - 1)

    def flush(self) -> None:
        """Pass all rows to the sink now, so that a crash loses none of them."""
        self._close_block()

    def final_info(self, info: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Return entries of the recording's info that are known only at its end: of task, policies and caller (``info``).

        A policy with such entries, for example the times that a server took, returns them from ``recorded_info()``; lists
        of several policies are joined.
        """
        play, found = self.play, {}
        for assigned in play.policies:
            facts = getattr(assigned.policy, "recorded_info", None)
            for name, value in (facts() if facts is not None else {}).items():
                found[name] = [*found.get(name, []), *value] if isinstance(value, list) else value
        # later entries win: the caller knows better than policies, and these than the task
        measured = {} if self.sensors is None else {"sensors": self.sensors.facts}
        return {**play.task.codec.final_info(play.episode, play, play.policies), **found, **(info or {}), **measured}

    def finish(self, info: Mapping[str, Any]) -> Recording:
        """Close the sink and return the whole recording, completed with entries that are known only at the end."""
        # first, as it ends running skills, whose spans are taken down below
        self.play.team.finish()
        columns = self.columns()
        self._take()
        # agents that report a skill in every step have no spans yet: their columns have all of them
        for span in () if self.skills else self._spans_in(columns):
            self._skill(span)
        recording = finished(self.header, columns, info, self.skills, self.events, self.inputs)
        if self.sink is not None:
            self.sink.close(info=dict(info))
        return recording

    def abort(self) -> None:
        """End the recording early; the rows in the sink are kept."""
        if self.sink is not None:
            self.sink.abort()

    def _take(self) -> None:
        """Write the events and skills since the last step."""
        for event in self.play.events:
            self.events.append(event)
            if self.sink is not None:
                self.sink.event(event)
        for span in self.play.spans:
            self._skill(span)
        self.play.events.clear()
        self.play.spans.clear()

    def _skill(self, span: SkillSpan) -> None:
        self.skills.append(span)
        if self.sink is not None:
            self.sink.skill(span)

    def _spans_in(self, columns: Columns) -> Sequence[SkillSpan]:
        """Return the runs of equal codes in each agent's ``skill`` column, as spans."""
        spans = []
        for index, agent in enumerate(self.header.agents):
            codes = columns.get(f"agent_{index}.skill")
            if codes is None or not len(codes):
                continue
            # a value unlike the first, so that the first row begins a run
            starts = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
            ends = np.append(starts[1:], len(codes)) - 1
            spans += [
                SkillSpan(agent=index, name=agent.skill_names[codes[a]], start_step=int(a), end_step=int(b))
                for a, b in zip(starts, ends, strict=True)
                # -1 is a step in which the agent reports no skill
                if codes[a] >= 0
            ]
        return spans

    def _close_block(self) -> None:
        if not self._rows:
            return
        block = self.play.columns(self._rows, self._count)
        block |= {
            name: np.array(values) for name, values in zip(self.beside, zip(*self._beside, strict=True), strict=True)
        }
        # each hash covers the ones before, so that the last row vouches for the whole recording
        last_hash = int(self.blocks[-1]["state_hash"][-1]) if self.blocks else 0
        block["state_hash"] = state_hash(block, previous=last_hash)
        if self.sink is not None:
            self.sink.append(block)
        self.blocks.append(block)
        self._count += len(self._rows)
        self._rows, self._beside = [], []


def finished(
    header: RecordingHeader,
    columns: Columns,
    info: Mapping[str, Any],
    skills: Sequence[SkillSpan],
    events: Sequence[Event],
    inputs: Sequence[InputEvent] = (),
) -> Recording:
    """Return a recording from its parts."""
    episode = replace(header.episode, info={**header.episode.info, **info})
    return Recording(
        episode=episode,
        assets=header.assets,
        bodies=header.bodies,
        agents=header.agents,
        columns=columns,
        skills=tuple(skills),
        events=tuple(events),
        inputs=tuple(inputs),
        attachments=header.attachments,
    )


# --- playing with a recorder ---------------------------------------------------------------------------------------------
def run(
    play: WorldRollout,
    recorder: Recorder | None = None,
    *,
    steps: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> str:
    """Play an episode for at most ``steps`` steps, and return the reason why it ended.

    The policies are those of ``play``. ``progress`` is called with 1 after every step.
    """
    # a DecisionLoop plays the first step as soon as it is made
    if steps == 0:
        return play.ended
    turns, done = DecisionLoop(play), 0
    while not turns.over:
        if turns.asked is not None:
            turns.answer(play.decide(turns.asked) if recorder is None else recorder.decide(turns.asked))
            continue
        done += 1
        if recorder is not None:
            recorder.add()
        if progress is not None:
            progress(1)
        # before go_on, which would play the next step
        if done == steps:
            break
        turns.go_on()
    return play.ended


def simulate(
    task: Task,
    episode: Episode,
    policies: Assigned | None = None,
    *,
    episode_id: str = "0",
    sink: Callable[[RecordingHeader], Sink] | None = None,
    progress: Callable[[int], object] | None = None,
    info: Mapping[str, Any] | None = None,
    sensors: Sequence[str] = (),
) -> Recording:
    """Play one episode to its end and return its recording.

    Args:
        task: Task to play.
        episode: Episode, such as one from `Task.sample`.
        policies: Policies by agent or kind (`sim_kinematic.policies.assignment.assign`).
        episode_id: Name of the episode within its dataset.
        sink: Function that is called once with the header of the recording, and returns the receiver of rows and
            events, such as a `RecordingWriter`. The receiver is closed at the end, and aborted on an error.
        progress: Function that is called with 1 after every step.
        info: Entries of the recording's info that override those of the task.
        sensors: Names of sensors of robots that are recorded with every step, as columns ``metrics.agent_<i>.<sensor>``.

    Raises:
        InputError: There is no such policy, agent or sensor, or a policy returned no valid choice.
    """
    play = WorldRollout.of(task, episode, policies, measure=False)
    recorder = Recorder.of(play, sink, episode_id=episode_id, sensors=sensors)
    try:
        run(play, recorder, progress=progress)
        return recorder.finish(recorder.final_info(info))
    except BaseException:
        # also when the user stops the process: the rows so far stay readable
        recorder.abort()
        raise


# --- the header -------------------------------------------------------------------------------------------------------
def describe(
    task: Task,
    episode: Episode,
    policies: Sequence[AssignedPolicy],
    *,
    episode_id: str = "0",
    things: Sequence[Body] = (),
) -> RecordingHeader:
    """Return the header of a recording, known before the first step: agents, bodies, scene and rules.

    ``things`` are the things that people bring along (`WorldRollout.things`).
    """
    scene = episode.scene
    (file, digest), (assets, bodies) = scene_attachment(scene), scene_records(scene)
    info = {
        **task.codec.info(episode, policies),
        "instruction": task.codec.instruction(episode),
        "scene_source": dict(scene.source),
        "scene_sha256": digest,
        "categories": categories_of(scene),
    }
    # a task that no entry point names is found by ``module:Class``
    if reference := reference_of(task):
        info["task"] = reference
    if task.profile:
        info["profile"] = task.profile
    for own in (reference, task.profile):
        if own and REFERENCE.fullmatch(own) and not own.startswith("__main__:"):
            # its code runs already, so this process may also load it by the name in the recording
            trust(own.partition(":")[0])
    models, count = [member.model for member in episode.roster], kinds_of(episode.roster).count("robot")
    robots, people = sorted(set(models[:count])), models[count:]
    if digests := {model: digest for model in robots if (digest := robot_digest(model))}:
        info["robots_sha256"] = digests
    walks: dict[str, bytes] = {}
    if any(JOIN in model for model in people):
        walks, info["motions"] = walk_attachments(people), walk_facts(people)
    if crowd := {
        member.name: policy.policy.facts if policy.hands is None else {"version": policy.version}
        for member, policy in zip(episode.roster, policies, strict=True)
        if hasattr(policy.policy, "repeat") or policy.hands is not None
    }:
        info["people"] = crowd
    external = [k for k, policy in enumerate(policies) if policy.is_external]
    if external:
        info["external"] = external
    record = EpisodeRecord(
        uid=task.codec.uid(episode, policies),
        episode_id=episode_id,
        task=task.name,
        scene=scene.name,
        seed=episode.seed,
        created_by=f"h3data {own_version()}",
        info=info,
    )
    looks = [look for policy in policies for look in (works(policy) or HandWork()).assets]
    numbers = {name: k for k, name in enumerate(episode.moving)}
    return RecordingHeader(
        episode=record,
        assets=(*assets, *{look.name: look for look in looks}.values()),
        bodies=tuple(
            replace(body, pose=episode.moving[body.name].astype(np.float32), moving=numbers[body.name])
            if body.name in numbers
            else body
            for body in bodies
        )
        + tuple(things),
        agents=tuple(
            task.control.recorded_agent(member, episode, is_external=policy.is_external)
            for member, policy in zip(episode.roster, policies, strict=True)
        ),
        attachments={"scene.glb": file, **walks},
    )
