"""Policies that repeat recorded choices up to a step, and then pass control to another policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import heading_from_quat
from h3data.recording import Recording, SkillSpan
from h3data.recording.log_lines import SAY
from sim_kinematic.agents.skills import (
    ALL_SKILLS,
    CONTROL,
    OPENING_SKILLS,
    SEARCH,
    SKILLS,
    Action,
    Destination,
    Message,
)
from sim_kinematic.policies.policy import RecordedPose, Velocity
from sim_kinematic.policies.rearrange import HighLevelPolicy
from sim_kinematic.policies.views import RearrangeView

COMMAND = "command"
"""Kind of the raw input event that stores a command from outside."""
RESUMED = "resumed"
"""Reason recorded for a skill that is interrupted because another policy takes over, which may continue it."""


def is_remote(policy: Any) -> bool:
    """Return whether a policy runs behind a server, which is not called again when a recording is replayed."""
    return bool(getattr(policy, "is_remote", False))


class NotRecorded(InputError):
    """Error for an episode that deviates from its recording and needs a command where none was recorded."""


class RecordedCommand(NamedTuple):
    """Command from outside that was recorded as raw input."""

    step: int
    choice: Any
    interrupts: str = ""
    """Reason for interrupting a running skill; empty if the agent had to choose anyway."""


class RecordedVelocities:
    """Policy that repeats recorded base velocities up to a step, then passes control to another policy.

    The other policy, if there is one, is called in every step from ``since`` on, and its choices are ignored until
    ``until``. So it has the same memory, and the same action between decisions, as in the recording. A remote policy
    (`is_remote`) is only called from ``until`` on.
    """

    def __init__(self, choices: Mapping[int, Any], *, until: int, own: Any, since: int = 0, sits: bool = False) -> None:
        self._choices, self._until, self._own, self.sits = choices, until, own, sits
        self.since = max(since, until) if is_remote(own) else since

    @classmethod
    def of(
        cls,
        recording: Recording,
        number: int,
        commands: Sequence[RecordedCommand] | None,
        *,
        until: int,
        own: Any,
        since: int = 0,
    ) -> RecordedVelocities:
        """Return a policy that repeats recorded commands from outside, or else the column ``agent_<i>.action``.

        Args:
            recording: the recording.
            number: number of the agent.
            commands: recorded raw input; None if the agent was not controlled from outside.
            until: step from which ``own`` decides.
            own: policy that takes over.
            since: step from which ``own`` decided in the recording (`deciding_since`).

        Raises:
            InputError: The simulator does not know a recorded command or skill.
        """
        told = {command.step: command.choice for command in commands or ()}
        sits = f"agent_{number}.motion_seat" in recording.columns
        if commands and f"agent_{number}.action" not in recording.columns:
            # a recording that was continued has commands for the steps before only
            return cls(told, until=min(until, commands[-1].step + 1), own=own, since=since, sits=sits)
        actions = recording.columns[f"agent_{number}.action"]
        if actions.shape != (len(recording), 2) or not np.isfinite(actions).all():
            raise InputError(
                f"Expected agent_{number}.action [T, 2] of finite numbers, got shape {list(actions.shape)}.",
                code="H3-POLICY-043",
            )
        names = recording.agents[number].skill_names
        codes = recording.columns.get(f"agent_{number}.skill", np.full(len(recording), -1))
        # -1 stands for no skill, also where there is no column
        strange = sorted({int(c) for c in codes if not -1 <= c < len(names)})
        if strange:
            raise InputError(
                f"Unknown skill codes {strange[:5]} in agent_{number}.skill. Expected: {', '.join(names)}.",
                code="H3-POLICY-044",
            )
        choices = {
            k: Velocity(forward, turn, names[code] if code >= 0 else "")
            for k, ((forward, turn), code) in enumerate(zip(actions[:until].tolist(), codes.tolist(), strict=False))
        }
        return cls({**choices, **told}, until=until, own=own, since=since)

    def act(self, view: Any) -> Any:
        """Return the recorded choice of this step, or that of the policy that has taken over.

        Raises:
            NotRecorded: the recording has no command for this step.
        """
        # asked before the step is decided, so that its memory is that of the recording when it takes over
        choice = self._own.act(view) if self._own is not None and view.step >= self.since else None
        if view.step >= self._until and self._own is not None:
            return choice
        if view.step not in self._choices:
            raise NotRecorded(f"The recorded raw input has no command for step {view.step}.", code="H3-POLICY-045")
        return self._choices[view.step]


class RecordedCommands:
    """Policy that repeats commands from outside in a task with skills, then passes control to another policy."""

    takes_commands = True

    def __init__(self, commands: Sequence[RecordedCommand], *, until: int, own: Any) -> None:
        self._commands = [command for command in commands if command.step < until]
        self._until, self._own, self._next = until, own, 0
        self.since = until if own is not None else 0

    def act(self, view: Any) -> Any:
        """Return the next recorded command, or the choice of the policy that has taken over.

        Raises:
            NotRecorded: the recording has no command for this step.
        """
        if view.step >= self._until and self._own is not None:
            return self._own.act(view)
        # several commands may belong to one step, so they are taken one after the other and not looked up by step
        if self._next >= len(self._commands) or self._commands[self._next].step != view.step:
            raise NotRecorded(f"The recorded raw input has no command for step {view.step}.", code="H3-POLICY-045")
        self._next += 1
        return self._commands[self._next - 1].choice

    def interrupts(self, view: Any) -> str:
        """Return the reason to abort the running skill if a command arrived while it was running; otherwise empty."""
        if view.step >= self._until and self._own is not None:
            interrupts = getattr(self._own, "interrupts", None)
            return RESUMED if view.step == self._until else interrupts(view) if interrupts is not None else ""
        waiting = self._next < len(self._commands) and self._commands[self._next].step == view.step
        return self._commands[self._next].interrupts if waiting else ""


class RecordedTrack:
    """Person who follows a recorded track, whatever other agents do."""

    def __init__(self, recording: Recording, number: int, body: Any) -> None:
        """Read the recorded track of a person.

        Args:
            recording: the recording.
            number: number of the agent.
            body: its body.

        Raises:
            InputError: The person's body was not recorded as motion clips at every step.
        """
        if not len(recording):
            raise InputError(
                "The recording has no steps, so there is no track of a person to keep.", code="H3-POLICY-046"
            )
        names = [f"agent_{number}.{n}" for n in ("base_pose", "motion_id", "motion_phase", "motion_blend")]
        lacks = [n for n in names if n not in recording.columns]
        if lacks:
            raise InputError(
                f"The person's body must be recorded as clips; the recording lacks: {', '.join(lacks)}.",
                code="H3-POLICY-047",
            )
        base, *self._motion = (recording.columns[n] for n in names)
        # recordings may lack arms and seats: then arms swing as in the clip, and nobody sits
        self._arms = recording.columns.get(f"agent_{number}.motion_arms", np.zeros((len(recording), 2), np.float32))
        if self._arms.shape != (len(recording), 2):
            raise InputError(
                f"Expected agent_{number}.motion_arms [T, 2], got shape {list(self._arms.shape)}.", code="H3-POLICY-048"
            )
        self.sits = f"agent_{number}.motion_seat" in recording.columns
        self._seats = recording.columns.get(f"agent_{number}.motion_seat", np.zeros((len(recording), 2), np.float32))
        if not all(np.isfinite(array).all() for array in (base, self._arms, self._seats, *self._motion)):
            raise InputError("The person's track must be finite at every step.", code="H3-POLICY-049")
        clips = len(body.clips)
        if ((self._motion[0] < 0) | (self._motion[0] >= clips)).any():
            raise InputError(f"agent_{number}.motion_id must be in 0..{clips - 1}.", code="H3-POLICY-050")
        self._xz = base[:, [0, 2]].astype(np.float64)
        # continuous, so that the difference of two steps is the turn between them
        self._heading = np.unwrap(heading_from_quat(base[:, 3:].astype(np.float64)))

    def track(self) -> NDArray[np.float64]:
        """Return the recorded positions of the person after each step, [T, 2] [m]."""
        return self._xz

    def act(self, view: Any) -> RecordedPose:
        """Return the recorded pose and motion clip of this step."""
        step = view.step
        clip, phase, blend = (array[step] for array in self._motion)
        (left, right), (height, share) = self._arms[step].tolist(), self._seats[step].tolist()
        return RecordedPose(
            self._xz[step],
            float(self._heading[step]),
            int(clip),
            float(phase),
            float(blend),
            (left, right),
            (height, share),
        )


@dataclass(eq=False)
class RecordedPolicy:
    """Policy that repeats one agent's recorded choices and interruptions.

    ``own`` is the policy that made the choices, if it is known. It is called at every decision of the recording, so
    that it has the same memory when it takes over.
    """

    spans: Sequence[SkillSpan]
    """Recorded skills of the agent, in chronological order."""
    objects: tuple[str, ...]
    """Names of the task's objects."""
    now: NDArray[np.integer]
    """Skill and target at each step, [T, 2], needed because a skill that was running at the end of the recording has no
    span."""
    until: int
    """Step from which on ``own`` decides instead of the recording."""
    own: HighLevelPolicy | None = None
    since: int = 0
    """Step from which on ``own`` decided in the recording; before it, another policy did."""
    joints: tuple[str, ...] = ()
    """Names of the doors and drawers of the home."""
    surfaces: tuple[str, ...] = ()
    """Names of the surfaces at which agents look for things."""
    commands: Mapping[tuple[int, int], list[Any]] = field(default_factory=dict)
    """Commands of ``wait`` that took no time (`told_in`), by step and object; each is removed when it is repeated."""
    _next: int = 0
    _running: Action = field(default_factory=lambda: Action("wait"))

    def act(self, view: RearrangeView) -> Action:
        """Return the recorded action of this decision, or the choice of the policy that has taken over."""
        choice = self.own.act(view) if self.own is not None and view.step >= self.since else None
        if view.step >= self.until and choice is not None:
            return choice
        interrupted = view.last is not None and view.last.outcome == "aborted"
        # an agent that was interrupted and chose the same action again has one span for both parts, which goes on
        if not interrupted or not self._next or self._aborted_before(view.step):
            self._running = self._recorded(view.step, choice)
        return self._running

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason why the recording interrupts the running action at this step; empty if it does not."""
        asked = self.own is not None and view.step >= self.since
        # where it took over from somebody else it had to choose, whatever was running
        # where it took over from somebody else, it chose anew whatever was running
        if asked and view.step == self.since > 0:
            return RESUMED
        interrupts = getattr(self.own, "interrupts", None)
        reason = interrupts(view) if asked and interrupts is not None else ""
        return reason or (self._aborted_before(view.step) if view.step < self.until else "")

    def _aborted_before(self, step: int) -> str:
        """Return the reason why the running skill was aborted at this step; empty: it was not."""
        span = self.spans[self._next - 1] if self._next else None
        return span.reason if span is not None and (span.outcome, span.end_step) == ("aborted", step - 1) else ""

    def _recorded(self, step: int, choice: Action | None) -> Action:
        """Return the next recorded action; ``choice`` is what ``own`` would do, which knows how long it wants to wait."""
        if self._next < len(self.spans):
            span = self.spans[self._next]
            self._next += 1
            follows = self.spans[self._next : self._next + 1]
            at_once = span.outcome == "done" and bool(follows) and follows[0].start_step == span.start_step
            lasted = span.end_step - span.start_step + 1
            # an equal action would continue the last one, so each action that was cut short has a duration of its own
            endless = len(self.now) + self._next
            steps = 0 if at_once else lasted if span.outcome == "done" else endless
            names = targets_of(span.name, self.objects, self.joints, self.surfaces)
            target = names.index(span.target) if span.target else -1
            action = Action(span.name, target, steps)
            if span.name == "wait" and self.commands.get((step, target)):
                return Action("wait", target, 0, self.commands[step, target].pop(0))
        else:
            skill, target = self.now[min(step, len(self.now) - 1)].tolist()
            action = Action(ALL_SKILLS[skill], target, len(self.now) + 1)
        return choice if choice is not None and choice[:2] == action[:2] else action


def told_in(recording: Recording, number: int, objects: tuple[str, ...]) -> dict[tuple[int, int], list[Any]]:
    """Return the goals that an agent assigned and its messages, by step and index of the object (-1: a message)."""
    told: dict[tuple[int, int], list[Any]] = {}
    for event in recording.events:
        if event.agent == number and event.kind == "aim" and event.target in objects:
            told.setdefault((event.step, objects.index(event.target)), []).append(Destination.of(event.detail))
        elif event.agent == number and event.kind == SAY:
            told.setdefault((event.step, -1), []).append(Message(event.detail, event.target))
    return told


def targets_of(
    skill: str, objects: tuple[str, ...], joints: tuple[str, ...], surfaces: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the names of the targets that a skill can have, in the order of their numbers."""
    return joints if skill in OPENING_SKILLS else surfaces if skill == SEARCH else objects


def deciding_since(recording: Recording) -> list[int]:
    """Return, for each agent, the step from which on its present policy has decided.

    Raises:
        InputError: The info has no such step for each agent.
    """
    count = len(recording.agents)
    try:
        since = msgspec.convert(recording.episode.info.get("deciding_since", [0] * count), list[int])
    except msgspec.ValidationError:
        since = []
    if len(since) != count or min(since) < 0:
        raise InputError(
            f"Expected deciding_since in the info, a step for each of {count} agents.", code="H3-POLICY-040"
        )
    return since


def recorded_choices(
    recording: Recording,
    number: int,
    objects: tuple[str, ...],
    since: int = 0,
    *,
    joints: tuple[str, ...] = (),
    surfaces: tuple[str, ...] = (),
) -> tuple[list[SkillSpan], NDArray]:
    """Return the skill spans of an agent, and its skills and targets step by step [T, 2].

    Skills before the step ``since``, which commands from outside decided, are left out.

    Raises:
        InputError: The simulator does not know a skill or target, or there are commands of the lower layer, which are not
            recorded.
    """
    spans = [span for span in recording.skills if span.agent == number and (not since or span.end_step >= since)]
    now = np.stack([recording.columns[f"agent_{number}.{name}"] for name in ("skill", "skill_target")], axis=-1)
    # before that step commands decided, and the skills that they began are no choices
    now[:since] = SKILLS.index("wait"), -1
    known = (*SKILLS, *(OPENING_SKILLS if joints else ()), *((SEARCH,) if surfaces else ()))
    # doors, drawers and surfaces that a home does not have make their skills unknown
    codes = {k: name for k, name in enumerate(ALL_SKILLS) if name in known}
    names = {span.name for span in spans} | {codes[c] for c in now[:, 0].tolist() if c in codes}
    if CONTROL in names:
        raise InputError(
            f"agent_{number} was driven by its lower layer ({CONTROL}), whose commands are not recorded. Expected skills only.",
            code="H3-POLICY-041",
        )
    strange: set[Any] = names - set(known) | {c for c in now[:, 0].tolist() if c not in codes}
    strange |= {s.target for s in spans if s.target not in ("", *targets_of(s.name, objects, joints, surfaces))}
    for code, target in now.tolist():
        most = len(targets_of(codes.get(code, ""), objects, joints, surfaces))
        strange |= set() if -1 <= target < most else {target}
    if strange or now.ndim != 2:
        raise InputError(
            f"Unknown skills or objects of agent_{number}: {', '.join(sorted(map(str, strange))[:5])}. Expected skills: "
            f"{', '.join(name for name in known if name != CONTROL)}; objects: {', '.join((*objects, *joints))}.",
            code="H3-POLICY-042",
        )
    for span in spans:
        if span.name in (*SKILLS[:4], *OPENING_SKILLS, SEARCH) and not span.target:
            raise InputError(
                f"The skill {span.name} of agent_{number} at step {span.start_step} names no object.",
                code="H3-POLICY-051",
            )
    return spans, now


def recorded_commands(recording: Recording, decode: Callable[[Any], Any]) -> dict[int, list[RecordedCommand]]:
    """Return the recorded commands from outside by agent, each with its step.

    The commands are decoded from the raw input by ``decode``, which is `sim_kinematic.tasks.control.Control.from_json`.

    Raises:
        InputError: A command is malformed.
    """
    commands: dict[int, list[RecordedCommand]] = {}
    for event in recording.inputs:
        if event.kind != COMMAND:
            continue
        try:
            data = msgspec.json.decode(event.payload, type=dict[str, Any])
            command = RecordedCommand(int(data["step"]), decode(data["choice"]), str(data.get("interrupts", "")))
            commands.setdefault(int(data["agent"]), []).append(command)
        except (msgspec.MsgspecError, KeyError, TypeError, ValueError) as fault:
            raise InputError(f"Malformed raw input at {event.time_ns} ns: {fault!r}.", code="H3-POLICY-052") from None
    return commands
