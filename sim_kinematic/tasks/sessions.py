"""Sessions, which are episodes for callers that control the time themselves, such as a live server or a learning algorithm.

`session` and `simulate` are `h3data.session` and `h3data.simulate`, which play one episode of a task given by names.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from h3data.bodies import Robot
from h3data.errors import InputError, suggest
from h3data.recording import Event, Recording, RecordingHeader, RecordingWriter, SkillSpan
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY
from sim_kinematic.agents.skills import Message, sentence
from sim_kinematic.policies.assignment import Assigned, AssignedPolicy, PolicyChoice, assign
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.episode import Episode, TaskSpec, with_options
from sim_kinematic.tasks.play import DecisionLoop, WorldRollout
from sim_kinematic.tasks.recorder import Recorder, Sink
from sim_kinematic.tasks.recorder import simulate as simulate_episode
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.sources import EpisodeSource, Scenes
from sim_kinematic.tasks.task import Task

if TYPE_CHECKING:
    from sim_kinematic.tasks.rearrange.episode import RearrangeSpec

    Spec = TaskSpec | RearrangeSpec
RuleValue = bool | int | float | str | tuple[float, ...] | None


@dataclass(frozen=True, kw_only=True)
class StepResult:
    """Result of one step of a session."""

    step: int
    """Number of the step that has just been played, counted from 0."""
    reward: float
    events: tuple[Event, ...]
    skills: tuple[SkillSpan, ...]
    """Skills that ended before or in this step, with outcome and reason."""
    refused: Mapping[str, str]
    """Reason, as a sentence, why a skill failed in this step, by the name of an agent controlled from outside."""
    waiting: tuple[str, ...]
    """Names of the agents that wait for a command for the next step (`Session.waiting`)."""
    ended: str
    """Reason why the episode ended; empty while it is running."""


class _Inbox(External):
    """Policy that holds the commands for one agent until it decides."""

    interrupts_only_when_close = False  # commands interrupt at any distance

    def __init__(self, external: External) -> None:
        super().__init__(interrupts_when_close=external.interrupts_when_close)
        self.pending: Any = None
        self.latest: Any = None
        """Last command that the agent has followed."""
        self.has_news = False
        """True if `pending` has not been followed yet."""
        self.is_urgent = False
        """True if `pending` interrupts a running skill."""
        self.reason = ""
        """Reason why a running skill has just been interrupted."""

    def interrupts(self, view: Any) -> str:
        self.reason = "commanded" if self.has_news and self.is_urgent else super().interrupts(view)
        return self.reason


class Session:
    """Episode that advances one step at a time, in which agents with the policy `External` follow commands.

    ```python
    session = h3data.session("rearrange", scenes="small:3", agents={"person": External(), "robot": "complement"})
    while not session.ended:
        session.act("person", choose(session.observe("person")))
        session.step()
    recording = session.close()
    ```

    Commands are set by `act`; h3data docs sessions lists those of each task.
    """

    def __init__(
        self,
        task: Task,
        episode: Episode,
        policies: Assigned | None = None,
        *,
        sink: Callable[[RecordingHeader], Sink] | None = None,
        episode_id: str = "0",
        info: Mapping[str, Any] | None = None,
    ) -> None:
        """Start an episode and its recording.

        The arguments are those of `simulate`; ``info`` is recorded from the start.
        """
        self.task, self.episode = task, episode
        self._inboxes: dict[int, _Inbox] = {}
        self.policies: list[AssignedPolicy] = []
        for number, assigned in enumerate(assign(task, episode, policies)):
            if isinstance(assigned.policy, External):
                self._inboxes[number] = _Inbox(assigned.policy)
                assigned = assigned._replace(policy=self._inboxes[number])
            self.policies.append(assigned)
        self.play = WorldRollout.of(task, episode, self.policies)
        self.recorder = Recorder.of(self.play, sink, episode_id=episode_id, info=info)
        self._numbers = {member.name: k for k, member in enumerate(episode.roster)}
        self._turns: DecisionLoop | None = None
        self._closed: Recording | None = None

    def __repr__(self) -> str:
        state = f"ended ({self.ended})" if self.play.over else "running"
        return f"Session({self.task.name}, {', '.join(self._numbers)}, {len(self.recorder)} steps, {state})"

    # --- who and what -------------------------------------------------------------------------------------------------
    def number(self, agent: str) -> int:
        """Return the number of the agent with this name; ``person`` stands for ``human``.

        Raises:
            InputError: There is no such agent.
        """
        name = agent if agent in self._numbers else agent.replace("person", "human", 1)
        if name not in self._numbers:
            raise InputError(f"Nobody is called {agent!r}.{suggest(agent, self._numbers)}", code="H3-TASK-045")
        return self._numbers[name]

    @property
    def ended(self) -> str:
        """Reason why the episode ended; empty while it is running."""
        return self.play.ended if self.play.over else ""

    @property
    def waiting(self) -> tuple[str, ...]:
        """Names of the agents controlled from outside that wait for a command, because none of their skills is running."""
        if self.play.over:
            return ()
        return tuple(self.episode.roster[k].name for k in self._inboxes if not self.task.control.is_busy(self.play, k))

    def observe(self, agent: str) -> Any:
        """Return the observation that a privileged policy of an agent would get now (`Task.view`)."""
        return self.play.view(self.number(agent))

    # --- commands -----------------------------------------------------------------------------------------------------
    def act(self, agent: str, command: Any) -> None:
        """Set the command of an agent for the next step.

        A new command interrupts a running skill. It is recorded as raw input, so that the recording can be simulated
        again from it.

        Raises:
            InputError: the agent is not controlled from outside, or the command is malformed.
        """
        number, inbox = self._controlled(agent)
        choice = self.task.control.checked(self.play, number, command)
        inbox.pending, inbox.has_news = choice, True
        inbox.is_urgent = self.task.control.interrupts(self.play, number, choice)

    def refusal(self, agent: str, command: Any) -> str | None:
        """Return, as a sentence, why an agent could not carry out a command now; None if it could.

        The command is not carried out.

        Raises:
            InputError: the agent is not controlled from outside, or the command is malformed.
        """
        number, _ = self._controlled(agent)
        return self.task.control.refusal(self.play, number, self.task.control.checked(self.play, number, command))

    def _controlled(self, agent: str) -> tuple[int, _Inbox]:
        number = self.number(agent)
        if number not in self._inboxes:
            name = self.policies[number].name
            raise InputError(
                f"{agent} follows the policy {name}. Hint: give it External() to control it.", code="H3-TASK-046"
            )
        return number, self._inboxes[number]

    def step(self) -> StepResult:
        """Play one step of the episode.

        An agent that must decide and has no new command continues with its last one, or does nothing (`Control.idle`).

        Raises:
            InputError: The episode is over.
        """
        if self.ended:
            raise InputError(
                f"The episode has ended ({self.play.ended}). Hint: session.close() gives its recording.",
                code="H3-TASK-047",
            )
        # not made before: it plays at once, and the first commands must have come
        if self._turns is None:
            self._turns = DecisionLoop(self.play)
        else:
            # only now: a command that has come since the last step may interrupt a running skill
            self._turns.go_on()
        while self._turns.asked is not None:
            number = self._turns.asked
            if number in self._inboxes:
                choice, inbox = self._choice(number), self._inboxes[number]
                # recorded even if it only repeats the last command: a replay asks for a command wherever there was one
                reason, inbox.reason = inbox.reason, ""
                self.recorder.choice(number, choice, reason)
            else:
                choice = self.recorder.decide(number)
            self._turns.answer(choice)
        events_before, skills_before = len(self.recorder.events), len(self.recorder.skills)
        self.recorder.add()
        skills = tuple(self.recorder.skills[skills_before:])
        return StepResult(
            step=len(self.recorder) - 1,
            reward=self.play.reward,
            events=tuple(self.recorder.events[events_before:]),
            skills=skills,
            refused={
                self.episode.roster[span.agent].name: sentence(span.reason)
                for span in skills
                if span.outcome == "failed" and span.agent in self._inboxes
            },
            waiting=self.waiting,
            ended=self.ended,
        )

    def close(self, info: Mapping[str, Any] | None = None) -> Recording:
        """End the session and return its recording.

        The entry ``info["ended"]`` states whether the episode was stopped before its end. The entries of the argument
        ``info``, which the caller knows only now, are recorded too.
        """
        if self._closed is None:
            # `ended` begins as max_steps, which would be wrong for a session that stops early
            if not self.play.over:
                self.play.ended = "closed"
            self._closed = self.recorder.finish(self.recorder.final_info(info))
        return self._closed

    def abort(self) -> None:
        """Leave the session without an end, so that the steps so far stay as an unfinished log (``.part``)."""
        if self._closed is None:
            self.recorder.flush()
            self.recorder.abort()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, kind: Any, *_: Any) -> None:
        if kind is None:
            self.close()
        elif self._closed is None:
            self.recorder.abort()

    # --- inside -------------------------------------------------------------------------------------------------------
    def _choice(self, number: int) -> Any:
        """Return the command of an agent for this step: a new one, or what it does without one."""
        inbox = self._inboxes[number]
        if inbox.has_news:
            inbox.has_news = False
            if not isinstance(getattr(inbox.pending, "command", None), Message):
                inbox.latest = inbox.pending  # who has said something goes on with what they did
            return inbox.pending
        return self.task.control.idle(self.play, number, inbox.latest)


# --- by names --------------------------------------------------------------------------------------------------------
def session(
    task: str | Task | type[Task],
    scenes: Scenes = "small:0",
    *,
    agents: Mapping[str, PolicyChoice | Sequence[PolicyChoice]] | None = None,
    roster: str | Sequence[str | Robot] | None = None,
    seed: int = 0,
    index: int = 0,
    spec: Spec | None = None,
    record: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    share_in: str | os.PathLike[str] | None = None,
    robot: str | Path | Robot = ROBOT_BODY,
    human: str = HUMAN_BODY,
    rules: Literal["natural", "paper"] | None = None,
    human_speed: float | None = None,
    max_steps: int | None = None,
    **overrides: RuleValue,
) -> Session:
    """Start an episode that is played one step at a time, with agents driven from outside (h3data docs sessions).

    Args:
        task: Task, its name, or ``module:Class``.
        scenes: Homes, as in `h3data.make`; ``seed`` and ``index`` choose one of them.
        agents: Policy of each agent, by agent or kind: a name, a policy, a function, or
            `sim_kinematic.policies.policy.External` for an agent that `Session.act` controls.
        roster: Agents that are present (default: the task's).
        seed: Seed of the run.
        index: Number of the episode in the run.
        spec: Rules of the task (default: the task's).
        record: MCAP file to which the running episode is written; None keeps the recording in memory.
        overwrite: True if an existing file may be replaced.
        share_in: Folder around ``record`` whose recordings share their scenes (`RecordingWriter`); None stores the scene in
            the recording.
        robot: Body of robots.
        human: Body of people.
        rules: Set of rules, ``natural`` or ``paper`` (default: those of ``spec``, else ``natural``).
        human_speed: Walking speed of people [m/s].
        max_steps: Steps after which the episode ends.
        **overrides: Single rules of the task, by the name of their field in its spec, such as ``objects=3``.

    Raises:
        InputError: there is no such task, scene, agent, policy or rule.
        SceneError: No scene has room for the episode.
    """
    changes = {"rules": rules, "human_speed": human_speed, "max_steps": max_steps, **overrides}
    found, episode = _episode(task, scenes, roster, seed, index, spec, robot, human, changes)
    return Session(found, episode, agents, sink=_sink(record, overwrite, share_in))


def simulate(
    task: str | Task | type[Task],
    scenes: Scenes = "small:0",
    *,
    agents: Mapping[str, PolicyChoice | Sequence[PolicyChoice]] | None = None,
    roster: str | Sequence[str | Robot] | None = None,
    seed: int = 0,
    index: int = 0,
    spec: Spec | None = None,
    record: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    share_in: str | os.PathLike[str] | None = None,
    robot: str | Path | Robot = ROBOT_BODY,
    human: str = HUMAN_BODY,
    rules: Literal["natural", "paper"] | None = None,
    human_speed: float | None = None,
    max_steps: int | None = None,
    sensors: Sequence[str] = (),
    **overrides: RuleValue,
) -> Recording:
    """Play one episode under policies and return its recording; the other arguments are those of `session`.

    Args:
        sensors: Sensors of robots, such as ``("lidar",)``, that are recorded with every step (h3data docs lidar).
    """
    changes = {"rules": rules, "human_speed": human_speed, "max_steps": max_steps, **overrides}
    found, episode = _episode(task, scenes, roster, seed, index, spec, robot, human, changes)
    return simulate_episode(found, episode, agents, sink=_sink(record, overwrite, share_in), sensors=sensors)


def _episode(
    task: str | Task | type[Task],
    scenes: Scenes,
    roster: str | Sequence[str | Robot] | None,
    seed: int,
    index: int,
    spec: Spec | None,
    robot: str | Path | Robot,
    human: str,
    changes: Mapping[str, Any],
) -> tuple[Task, Episode]:
    found = find_task(task)
    changed = with_options(found.Spec() if spec is None else spec, **changes)
    source = EpisodeSource(found, scenes, spec=changed, agents=roster, robot=robot, human=human)
    return found, source.sample(seed, index)


def _sink(
    record: str | os.PathLike[str] | None, overwrite: bool, share_in: str | os.PathLike[str] | None
) -> Callable[[RecordingHeader], Sink] | None:
    if record is None:
        return None
    # opened only with a header: a wrong policy or a home without room leaves no file behind
    return lambda header: RecordingWriter(Path(record), header, overwrite=overwrite, share_in=share_in)
