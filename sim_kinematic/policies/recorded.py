"""High-level policies of rearrangement that do again what a recording says, up to a step, then hand over to another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording import Recording, SkillSpan
from sim_kinematic.agents.skills import CONTROL, SKILLS, Action
from sim_kinematic.policies.rearrange import HighLevelPolicy, TaskView

RESUMED = "resumed"
"""Why what an agent was doing is interrupted where another policy takes over; it may choose the same and go on."""


@dataclass(eq=False)
class RecordedPolicy:
    """One agent's choices and interruptions, as recorded.

    ``own``, if it is known, is the policy that made them. It is asked whatever it was asked then, so that in the end it
    remembers what it did then.
    """

    spans: Sequence[SkillSpan]
    """Its skills, in the order of time."""
    objects: tuple[str, ...]
    """Names of the task's objects."""
    now: NDArray[np.integer]
    """Skill and target at each step, [T, 2]: of a skill that was running when the recording broke off, there is no span."""
    until: int
    """From this step on it does what it does by itself:"""
    own: HighLevelPolicy | None = None
    since: int = 0
    """the policy ``own``, which decides since this step; before it somebody else did."""
    _next: int = 0
    _running: Action = field(default_factory=lambda: Action("wait"))

    def choose(self, view: TaskView) -> Action:
        """As `HighLevelPolicy.choose`."""
        choice = self.own.choose(view) if self.own is not None and view.step >= self.since else None
        if view.step >= self.until and choice is not None:
            return choice
        interrupted = view.last is not None and view.last.outcome == "aborted"
        if not interrupted or self._aborted_before(view.step):
            self._running = self._recorded(view.step, choice)
        return self._running

    def interrupts(self, view: TaskView) -> str:
        """As `HighLevelPolicy.interrupts`."""
        asked = self.own is not None and view.step >= self.since
        if asked and view.step == self.since > 0:
            return RESUMED
        reason = self.own.interrupts(view) if asked and self.own is not None else ""
        return reason or (self._aborted_before(view.step) if view.step < self.until else "")

    def _aborted_before(self, step: int) -> str:
        """Why the running skill was aborted at this step; empty: it was not."""
        span = self.spans[self._next - 1] if self._next else None
        return span.reason if span is not None and (span.outcome, span.end_step) == ("aborted", step - 1) else ""

    def _recorded(self, step: int, choice: Action | None) -> Action:
        """The next recorded action; ``choice`` is what ``own`` would do, which knows how long it wants to wait."""
        if self._next < len(self.spans):
            span = self.spans[self._next]
            self._next += 1
            follows = self.spans[self._next : self._next + 1]
            at_once = span.outcome == "done" and bool(follows) and follows[0].start_step == span.start_step
            lasted = span.end_step - span.start_step + 1
            # of those that were cut short, each waits for another time: an equal action would go on with the last one
            endless = len(self.now) + self._next
            steps = 0 if at_once else lasted if span.outcome == "done" else endless
            action = Action(span.name, self.objects.index(span.target) if span.target else -1, steps)
        else:
            skill, target = self.now[min(step, len(self.now) - 1)].tolist()
            action = Action(SKILLS[skill], target, len(self.now) + 1)
        return choice if choice is not None and choice[:2] == action[:2] else action


def recorded_choices(recording: Recording, number: int, objects: tuple[str, ...]) -> tuple[list[SkillSpan], NDArray]:
    """Skill spans of an agent, and its skills and targets step by step [T, 2], checked.

    Raises:
        InputError: there are other skills or targets than the simulator knows, or commands of the lower layer, which are not
            recorded.
    """
    spans = [span for span in recording.skills if span.agent == number]
    now = np.stack([recording.columns[f"agent_{number}.{name}"] for name in ("skill", "skill_target")], axis=-1)
    names = {span.name for span in spans} | {SKILLS[c] for c in now[:, 0].tolist() if 0 <= c < len(SKILLS)}
    if CONTROL in names:
        raise InputError(
            f"agent_{number} was driven by its lower layer ({CONTROL}), whose commands are not recorded. Expected skills only."
        )
    targets = now[:, 1].tolist()
    strange = names - set(SKILLS) | {span.target for span in spans} - {"", *objects}
    strange |= {c for c in now[:, 0].tolist() if not 0 <= c < len(SKILLS)} | {
        k for k in targets if not -1 <= k < len(objects)
    }
    if strange or now.ndim != 2:
        raise InputError(
            f"Unknown skills or objects of agent_{number}: {', '.join(sorted(map(str, strange))[:5])}. Expected skills: "
            f"{', '.join(SKILLS[:-1])}; objects: {', '.join(objects)}."
        )
    for span in spans:
        if span.name in SKILLS[:4] and not span.target:
            raise InputError(f"The skill {span.name} of agent_{number} at step {span.start_step} names no object.")
    return spans, now
