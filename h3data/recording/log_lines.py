"""Events and skills of a recording as lines of text for the logs of viewers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from h3data.recording.records import Event, Recording

SAY = "say"
"""Kind of the event of a message: its agent is the sender, its target the receiver (empty: all), its detail the text."""


@dataclass(frozen=True)
class LogLine:
    """A line of text about one step."""

    source: Literal["events", "skills"]
    step: int
    text: str
    warning: bool = False


def speech(event: Event, names: Sequence[str]) -> str:
    """Return the text of a message between agents, with their names.

    The text of the message was written by a person or a model and is not checked.
    """
    who = names[event.agent] if 0 <= event.agent < len(names) else "somebody"
    return f'{who} says{f" to {event.target}" if event.target else ""}: "{event.detail}"'


def log_lines(recording: Recording) -> list[LogLine]:
    """Return a line for each event, for the start of each skill, and for the end of each failed one; sorted by step."""
    names = [agent.name for agent in recording.agents]
    lines = []
    for e in recording.events:
        agent = names[e.agent] if 0 <= e.agent < len(names) else ""
        text = " ".join(part for part in (agent, e.kind, e.target, f"({e.detail})" if e.detail else "") if part)
        text = speech(e, names) if e.kind == SAY else text
        lines.append(LogLine("events", e.step, text, "collision" in e.kind or "fail" in e.kind))
    for s in recording.skills:
        agent = names[s.agent] if 0 <= s.agent < len(names) else "?"
        skill = f"{agent}: {s.name}({s.target})"
        lines.append(LogLine("skills", s.start_step, skill))
        if s.outcome in ("failed", "aborted"):
            reason = f": {s.reason}" if s.reason else ""
            lines.append(LogLine("skills", s.end_step, f"{skill} {s.outcome}{reason}", warning=True))
    return sorted(lines, key=lambda line: line.step)
