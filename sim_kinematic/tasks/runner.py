"""Loop over the steps of an episode, in three forms: `run`, `simulate` and `Session`.

`run` lets policies play an episode to its end, and `simulate` also records it. A `Session` is the same loop for callers
that control the time themselves, such as a live server or a learning algorithm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from h3data.errors import InputError, suggest
from h3data.recording import STEP_NS, Event, InputEvent, Recording, RecordingHeader, SkillSpan
from sim_kinematic.agents.skills import CONTROL, Action, Message, sentence
from sim_kinematic.policies.assignment import Assigned, AssignedPolicy, assign
from sim_kinematic.policies.crowd.people import CrowdPolicy
from sim_kinematic.policies.policy import External
from sim_kinematic.policies.recorded import COMMAND, is_remote
from sim_kinematic.policies.waypoints import WaypointPolicy
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.recorder import Recorder, Sink
from sim_kinematic.tasks.task import Task
from sim_kinematic.world import Command

MOST_CHOICES = 1000
"""Number of choices of an agent in one step at which an episode ends with an error."""


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


def rollout(task: Task, episode: Episode, policies: Assigned | None = None, *, measure: bool = True) -> WorldRollout:
    """Return a rollout of one episode under policies by agent or kind, ready for `run`.

    ``measure=False`` leaves out quantities that only rewards need.

    Raises:
        InputError: There is no such policy or agent.
    """
    return WorldRollout.of(task, episode, assign(task, episode, policies), measure=measure)


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
            turns.answer(_decide(play, recorder, turns.asked))
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
    play = rollout(task, episode, policies, measure=False)
    recorder = Recorder.of(play, sink, episode_id=episode_id, sensors=sensors)
    try:
        run(play, recorder, progress=progress)
        return recorder.finish(_final_info(recorder, info))
    except BaseException:
        # also when the user stops the process: the rows so far stay readable
        recorder.abort()
        raise


def _decide(play: WorldRollout, recorder: Recorder | None, number: int) -> Any:
    """Return the choice of an agent's policy, and record it as raw input if no column has it."""
    choice, policy = play.decide(number), play.policies[number].policy
    # commands of a server to an arm are in no column
    if recorder is not None and isinstance(choice, Action) and choice.skill == CONTROL and is_remote(policy):
        _record(recorder, number, choice)
    return choice


def _record(recorder: Recorder, number: int, choice: Any, reason: str = "") -> None:
    """Take down a choice as raw input; ``reason``: why it interrupted a running skill."""
    step = len(recorder)
    payload = {"agent": number, "step": step, "choice": recorder.play.task.control.to_json(choice)}
    if reason:
        payload["interrupts"] = reason
    recorder.input(
        InputEvent(time_ns=step * STEP_NS, kind=COMMAND, user=number, payload=msgspec.json.encode(payload).decode())
    )


def _final_info(recorder: Recorder, info: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return entries of a recording's info that are known only at its end: of the task, its policies and the caller.

    A policy with such entries, for example the times that a server took, returns them from ``recorded_info()``; lists of
    several policies are joined.
    """
    play, found = recorder.play, {}
    for assigned in play.policies:
        facts = getattr(assigned.policy, "recorded_info", None)
        for name, value in (facts() if facts is not None else {}).items():
            found[name] = [*found.get(name, []), *value] if isinstance(value, list) else value
    # later entries win: the caller knows better than policies, and these than the task
    measured = {} if recorder.sensors is None else {"sensors": recorder.sensors.facts}
    return {**play.task.codec.final_info(play.episode, play, play.policies), **found, **(info or {}), **measured}


# --- callers that bring their own clock -------------------------------------------------------------------------------
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
                _record(self.recorder, number, choice, reason)
            else:
                choice = _decide(self.play, self.recorder, number)
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
            self._closed = self.recorder.finish(_final_info(self.recorder, info))
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
