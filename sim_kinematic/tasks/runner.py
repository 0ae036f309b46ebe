"""The only loop over steps. `run` lets policies play an episode to its end; a `Session` is the same loop for callers that
bring their own clock, such as a person at a keyboard or a learner; `simulate` runs and records."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from h3data.errors import InputError, did_you_mean
from h3data.recording import STEP_NS, Event, InputEvent, Recording, RecordingHeader
from sim_kinematic.policies.assignment import Assigned, AssignedPolicy
from sim_kinematic.policies.policy import External
from sim_kinematic.policies.recorded import COMMAND
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.play import Play
from sim_kinematic.tasks.recorder import Recorder, Sink, describe
from sim_kinematic.tasks.registry import reference_of
from sim_kinematic.tasks.task import Task


class Turns:
    """An episode's turns, one at a time: who must decide next, or that a step is over."""

    def __init__(self, play: Play) -> None:
        self._play = play
        self._turns: Generator[int | None, Any, None] = play.turns()
        self.over = False
        self.asked: int | None = None
        """The agent that must decide; None: a step is over, or nothing has begun."""
        self._send(None)

    def answer(self, choice: Any) -> None:
        """Takes the choice of the agent that was asked."""
        self._send(choice)

    def go_on(self) -> None:
        """Begins the next step."""
        self._send(None)

    def _send(self, value: Any) -> None:
        try:
            self.asked = self._turns.send(value)
        except StopIteration:
            self.asked, self.over = None, True


def run(
    play: Play,
    recorder: Recorder | None = None,
    *,
    steps: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> str:
    """Plays an episode to its end, or for ``steps`` at most, under the policies of ``play``; returns what ended it.

    ``progress`` is called with 1 after every step.
    """
    if steps == 0:
        return play.ended
    turns, policies, done = Turns(play), play.policies, 0
    while not turns.over:
        if turns.asked is not None:
            number = turns.asked
            turns.answer(policies[number].policy.act(play.view(number)))
            continue
        done += 1
        if recorder is not None:
            recorder.add()
        if progress is not None:
            progress(1)
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
) -> Recording:
    """Plays one episode to its end and returns its recording.

    Args:
        task: What is to be done.
        episode: From `Task.sample`.
        policies: By agent or kind (`Task.assign`).
        episode_id: Name of the episode within its dataset.
        sink: Called once with what is known before the first step; returns what receives rows and events while they
            come, such as a `RecordingWriter`. It is closed at the end and aborted on an error.
        progress: Called with 1 after every step.
        info: Entries of the recording's info that the caller knows better than the task.

    Raises:
        InputError: no such policy or agent.
    """
    assigned = task.assign(episode, policies)
    header = describe(task, episode, assigned, episode_id=episode_id, reference=reference_of(task))
    play = task.play(episode, assigned, measure=False)
    recorder = Recorder(header, play, sink(header) if sink is not None else None)
    try:
        run(play, recorder, progress=progress)
        return recorder.finish({**task.hindsight(episode, play, assigned), **(info or {})})
    except BaseException:
        recorder.abort()
        raise


# --- callers that bring their own clock -------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class StepResult:
    """What happened in one step of a session."""

    step: int
    """Number of the step that has just been played, from 0."""
    reward: float
    events: tuple[Event, ...]
    waiting: tuple[str, ...]
    """Agents controlled from outside whose next command counts now."""
    ended: str
    """What ended the episode; empty while it goes on."""


class Session:
    """One episode, one step at a time. Agents whose policy is `External` are told what to do by `act`.

    ```python
    session = h3data.session("rearrange", scenes="small:3", agents={"person": External(), "robot": "complement"})
    while not session.ended:
        session.act("person", choose(session.observe("person")))
        session.step()
    recording = session.close()
    ```
    """

    def __init__(
        self,
        task: Task,
        episode: Episode,
        policies: Assigned | None = None,
        *,
        sink: Callable[[RecordingHeader], Sink] | None = None,
        episode_id: str = "0",
    ) -> None:
        """As `simulate`."""
        self.task, self.episode = task, episode
        self.policies: list[AssignedPolicy] = task.assign(episode, policies)
        self.play = task.play(episode, self.policies)
        header = describe(task, episode, self.policies, episode_id=episode_id, reference=reference_of(task))
        self.recorder = Recorder(header, self.play, sink(header) if sink is not None else None)
        self._numbers = {member.name: k for k, member in enumerate(episode.roster)}
        self._pending: dict[int, Any] = {}
        self._latest: dict[int, Any] = {}
        self._turns = Turns(self.play)
        self._closed: Recording | None = None
        self._settle()

    # --- who and what -------------------------------------------------------------------------------------------------
    def number(self, agent: str) -> int:
        """Number of the agent with this name; ``person`` is ``human``.

        Raises:
            InputError: there is none.
        """
        name = agent if agent in self._numbers else agent.replace("person", "human", 1)
        if name not in self._numbers:
            near = did_you_mean(agent, self._numbers)
            raise InputError(f"Nobody is called {agent!r}.{near} Expected one of: {', '.join(self._numbers)}.")
        return self._numbers[name]

    @property
    def ended(self) -> str:
        """What ended the episode; empty while it goes on."""
        return self.play.ended if self._turns.over else ""

    @property
    def waiting(self) -> tuple[str, ...]:
        """Agents controlled from outside that must be told what to do before the next step can be played."""
        return () if self._turns.asked is None else (self.episode.roster[self._turns.asked].name,)

    def observe(self, agent: str) -> Any:
        """What a privileged policy of this agent would be shown now (`Task.view`)."""
        return self.play.view(self.number(agent))

    # --- commands -----------------------------------------------------------------------------------------------------
    def act(self, agent: str, command: Any) -> None:
        """Tells an agent what to do when it must next decide. It is recorded as raw input, so that the recording can be
        simulated again from it.

        Raises:
            InputError: the agent is not controlled from outside, or the command is malformed.
        """
        number = self.number(agent)
        if not isinstance(self.policies[number].policy, External):
            name = self.policies[number].name
            raise InputError(f"{agent} follows the policy {name}. Hint: give it External() to control it.")
        self._pending[number] = self.task.checked_choice(self.play, number, command)

    def step(self) -> StepResult:
        """Plays one step. An agent that must decide and was told nothing new goes on with its last command, or does
        nothing (`Task.idle_choice`).

        Raises:
            InputError: the episode is over.
        """
        if self._turns.over:
            raise InputError(f"The episode has ended ({self.play.ended}). Hint: session.close() gives its recording.")
        while self._turns.asked is not None:
            number = self._turns.asked
            policy = self.policies[number].policy
            if isinstance(policy, External):
                choice = self._choice(number)
                self._record(number, choice)
            else:
                choice = policy.act(self.play.view(number))
            self._turns.answer(choice)
        if self._turns.over:
            return self._result(())
        self.recorder.add()
        events = tuple(e for e in self.recorder.events if e.step == len(self.recorder) - 1)
        self._turns.go_on()
        self._settle()
        return self._result(events)

    def close(self) -> Recording:
        """Ends the session and returns its recording; one that has not ended says so in ``info["ended"]``."""
        if self._closed is None:
            if not self._turns.over:
                self.play.ended = "closed"
            info = self.task.hindsight(self.episode, self.play, self.policies)
            self._closed = self.recorder.finish(info)
        return self._closed

    def __enter__(self) -> Session:
        return self

    def __exit__(self, kind: Any, *_: Any) -> None:
        if kind is None:
            self.close()
        elif self._closed is None:
            self.recorder.abort()

    # --- inside -------------------------------------------------------------------------------------------------------
    def _settle(self) -> None:
        """Lets policies that are here decide until somebody outside is asked or the step can be played."""
        while self._turns.asked is not None:
            policy = self.policies[self._turns.asked].policy
            if isinstance(policy, External):
                return
            number = self._turns.asked
            self._turns.answer(policy.act(self.play.view(number)))

    def _choice(self, number: int) -> Any:
        if number in self._pending:
            self._latest[number] = self._pending.pop(number)
            return self._latest[number]
        return self.task.idle_choice(self.play, number, self._latest.get(number))

    def _record(self, number: int, choice: Any) -> None:
        step = len(self.recorder)
        payload = {"agent": number, "step": step, "choice": self.task.choice_to_json(choice)}
        self.recorder.input(
            InputEvent(time_ns=step * STEP_NS, kind=COMMAND, user=number, payload=msgspec.json.encode(payload).decode())
        )

    def _result(self, events: Sequence[Event]) -> StepResult:
        return StepResult(
            step=len(self.recorder) - 1,
            reward=self.task.last_reward(self.play),
            events=tuple(events),
            waiting=self.waiting,
            ended=self.ended,
        )
