"""Controller of an agent with skills, which go on by themselves until they end or are interrupted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.recording import SkillSpan
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.giving_way import AnyActor
from sim_kinematic.agents.skills import (
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
from sim_kinematic.controllers.controller import Status
from sim_kinematic.world import World

IDLE_SKILLS = ("wait", CONTROL, *PRIMITIVES)
"""Skills whose end does not count as a completed task."""
CHOICES = 9
"""Number of skills ending at once that an agent may choose in one step, after which it does nothing."""


@dataclass(eq=False)
class SkillController:
    """Controller of one agent of the only world, with its running skill and what follows."""

    number: int
    """Number of the agent, as in the state and in the recording."""
    actor: AnyActor
    spans: list[SkillSpan]
    """Skills that have ended, for the recorder."""
    names: tuple[str, ...]
    joints: tuple[str, ...] = ()
    """Names of doors and drawers."""
    surfaces: tuple[str, ...] = ()
    """Names of the surfaces at which it may look, if it knows only what it has seen."""
    aim: Callable[[int, Action], str] | None = None
    """`sim_kinematic.tasks.skills.household.Household.aim`."""
    action: Action = field(default_factory=lambda: Action("wait"))
    ending: SkillResult | None = None
    skill: Skill | None = None
    begun: int = 0
    completed: int = 0
    """Number of skills that the agent has completed, without waiting and commands."""
    _driven_since: int = -1
    """First step of the commands that a driven person has followed without a skill in between; -1: they follow none."""
    _step: int = 0
    _left: int = 0
    """Choices that it may still make in this step."""
    _interrupted: bool = False

    @property
    def status(self) -> Status:
        """Return whether the agent has to choose: no skill is running, or the running one has been interrupted."""
        return "choosing" if self._interrupted or (self.skill is None and self._left > 0) else "acting"

    @property
    def is_free(self) -> bool:
        """Return whether the agent will have to choose in its next step."""
        return self.skill is None or self.action.skill == CONTROL

    def begin(self, step: int) -> None:
        """Begins a step, in which a running skill goes on."""
        self._step, self._left, self._interrupted = step, CHOICES, False

    def interrupt(self, reason: str) -> None:
        """Have the agent choose while a skill is running; one that chooses the same skill again continues it."""
        self.ending, self._interrupted = SkillResult("aborted", reason), True

    def start(self, world: World, agent: int, rows: NDArray[np.intp], action: Sequence[Action]) -> None:
        """Begins a skill; an infeasible one is a no-op that takes one step, as Habitat's."""
        del world, agent, rows
        (chosen,) = action
        if self._interrupted:
            self._interrupted = False
            if chosen == self.action:
                self.ending = None
                return
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

    def step(self, world: World, agent: int, rows: NDArray[np.intp]) -> None:
        """Moves the agent by its skill. One that ends at once takes no time: then the agent chooses again."""
        del world, agent, rows
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
        if self.skill is not None:
            self.skill.close()  # one that is interrupted folds the arm
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
        self.begun, self._driven_since = self._driven_since, -1
        self._write(step, "done", "")

    def follow(self, skill: Skill, step: int) -> None:
        """Let the agent, from ``step`` on, only continue a skill that no policy has chosen."""
        self.action, self.skill, self.ending, self.begun = Action("wait"), skill, None, step

    def finish(self, step: int, *, completed: bool) -> None:
        """Reports the skill that is still running in the last step.

        If the agent ``completed`` the task, the skill counts as done: the episode ends before the skill itself does.
        """
        if self._driven_since >= 0:
            self._end_drive(step)
        elif self.skill is not None:
            self._write(step, "done" if completed else "running", "")
        self.skill = None

    def _write(self, step: int, outcome: str, reason: str) -> None:
        """Reports the action up to ``step``."""
        names = {**dict.fromkeys(OPENING_SKILLS, self.joints), SEARCH: self.surfaces}.get(self.action.skill, self.names)
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
