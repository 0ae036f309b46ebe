"""Controller of an agent with skills, each of which continues by itself until it ends or is interrupted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from h3data.recording import SkillSpan
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.giving_way import AnyActor
from sim_kinematic.agents.skills import (
    CHORE,
    CHORES,
    CONTROL,
    OPENING_SKILLS,
    PRIMITIVES,
    SEARCH,
    Action,
    Destination,
    Message,
    Skill,
    SkillResult,
)
from sim_kinematic.avoidance.yielding import NO_PATH

IDLE_SKILLS = ("wait", CONTROL, *PRIMITIVES)
"""Skills whose end does not count as a completed task."""
CHOICES = 9
"""Number of skills without duration that an agent may choose in one step before it has to stand still."""


@dataclass(eq=False)
class SkillController:
    """Controller of one agent with skills, in the only world of a rollout."""

    number: int
    """Number of the agent, as in the state and in the recording."""
    actor: AnyActor
    spans: list[SkillSpan]
    """Skills that have ended, for the recorder to write."""
    names: tuple[str, ...]
    joints: tuple[str, ...] = ()
    """Names of the doors and drawers of the home."""
    surfaces: tuple[str, ...] = ()
    """Names of the surfaces at which the agent may search, if it knows only what it has seen."""
    aim: Callable[[int, Action], str] | None = None
    """Function ``(number, action)`` that gives an object another goal, and returns the reason if that is impossible
    (`sim_kinematic.tasks.skills.household.Household.aim`)."""
    action: Action = field(default_factory=lambda: Action("wait"))
    ending: SkillResult | None = None
    skill: Skill | None = None
    begun: int = 0
    completed: int = 0
    """Number of skills that the agent has completed, not counting waiting and commands."""
    _driven_since: int = -1
    """First step of the commands that a driven person has followed without a skill in between; -1: no command is running."""
    _step: int = 0
    _left: int = 0
    """Number of choices that the agent may still make in this step."""
    _interrupted: bool = False

    @property
    def status(self) -> Literal["choosing", "acting"]:
        """Return whether the agent has to choose: no skill is running, or the running one has been interrupted."""
        return "choosing" if self._interrupted or (self.skill is None and self._left > 0) else "acting"

    @property
    def is_free(self) -> bool:
        """Return whether the agent has to choose in its next step."""
        return self.skill is None or self.action.skill == CONTROL

    def begin(self, step: int) -> None:
        """Start a step, in which a running skill continues."""
        self._step, self._left, self._interrupted = step, CHOICES, False

    def interrupt(self, reason: str) -> None:
        """Let the agent choose while a skill is running; if it chooses the same skill again, that skill continues."""
        self.ending, self._interrupted = SkillResult("aborted", reason), True

    def start(self, chosen: Action) -> None:
        """Start a skill; an infeasible skill does nothing and takes one step, as in Habitat."""
        if self._left > 1 and isinstance(chosen.command, Message) and isinstance(self.actor, DrivenPerson):
            # people who are driven talk while they walk or a skill goes on, and choose again. A message of others is a
            # skill that takes no time, as their replays follow the spans of skills
            self._left -= 1
            assert self.aim is not None
            self.aim(self.number, chosen)
            return
        if self._interrupted:
            self._interrupted = False
            if chosen == self.action:
                self.ending = None
                return
            # the interrupted skill was last active in the step before
            self._end(self._step - 1, self.ending)
        if self._driven_since >= 0 and chosen.skill != CONTROL:
            self._end_drive(self._step - 1)
        self.action, self.begun = chosen, self._step
        why = self.actor.infeasible(chosen)
        if not why and self.aim is not None and isinstance(chosen.command, Destination | Message):
            why = self.aim(self.number, chosen)
        if why:
            self._end(self._step, SkillResult("failed", why))
            self._left = 0
            return
        self.skill, self.ending = self.actor.start(chosen), None

    def step(self) -> None:
        """Move the agent by one step of its skill.

        A skill that ends at once takes no time, and the agent chooses again.
        """
        if self._interrupted:
            return
        if self.skill is not None:
            try:
                next(self.skill)
                return
            except StopIteration as end:
                self._end(max(self._step - 1, self.begun), end.value)
                self._left -= 1
        if not self._left:
            self.actor.idle()

    def _end(self, step: int, ending: SkillResult | None) -> None:
        """End the running skill, whose last step was ``step``, and report it."""
        if self.skill is not None:
            self.skill.close()  # an interrupted skill folds the arm in its ``finally``
        assert ending is not None
        self.skill, self.ending = None, ending
        self.completed += ending.outcome == "done" and self.action.skill not in IDLE_SKILLS
        self.actor.path, self.actor.yields = NO_PATH, True
        if self.action.skill == CONTROL and isinstance(self.actor, DrivenPerson):
            # one span for a whole drive: 30 a second were 8% of the CPU of a step
            self._driven_since = self.begun if self._driven_since < 0 else self._driven_since
        else:
            self._write(step, ending.outcome, ending.reason)

    def _end_drive(self, step: int) -> None:
        """Report the commands that a driven person has followed up to ``step`` as one span."""
        self.begun, self._driven_since = self._driven_since, -1
        self._write(step, "done", "")

    def follow(self, skill: Skill, step: int) -> None:
        """Let the agent follow a skill that no policy has chosen, from ``step`` on."""
        self.action, self.skill, self.ending, self.begun = Action("wait"), skill, None, step

    def finish(self, step: int, *, completed: bool) -> None:
        """Report a skill that is still running in the last step.

        If the agent ``completed`` the task, the skill counts as done: the episode ends before the skill itself does.
        """
        if self._driven_since >= 0:
            self._end_drive(step)
        elif self.skill is not None:
            self._write(step, "done" if completed else "running", "")
        self.skill = None

    def _write(self, step: int, outcome: str, reason: str) -> None:
        """Report the action up to ``step``."""
        names = {**dict.fromkeys(OPENING_SKILLS, self.joints), SEARCH: self.surfaces, CHORE: CHORES}.get(
            self.action.skill, self.names
        )
        self.spans.append(
            SkillSpan(
                agent=self.number,
                name=self.action.skill,
                target=names[self.action.target] if self.action.target >= 0 else "",
                start_step=self.begun,
                end_step=step,
                outcome=outcome,  # type: ignore[arg-type]
                reason=reason,
            )
        )
