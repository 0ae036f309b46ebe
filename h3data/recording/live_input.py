"""Recorded input of the players of a live session (``h3data play``), as raw messages and as columns.

``input.user_<u>.seq`` is the number of the last message from the player of agent ``u`` that had taken effect by a row
(int32, -1: none), ``input.user_<u>.rtt_ms`` the round trip that the player's page had measured by then (float32 [ms],
NaN: none yet). Neither column is part of the state.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.recording.records import InputEvent, Recording

CLIENT, CONNECTED, DISCONNECTED, SLIP = "client", "connected", "disconnected", "slip"
"""Kinds of raw input: a message as received, a player who connected or disconnected, and steps that were not simulated
in time."""
NOTHING, AWAY, STEERS = "-", "away", "steers"
"""Requests of a player at a step other than kinds of messages: none, not connected, and moving by keys or sticks."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LiveInput:
    """Input of one player."""

    user: int
    """Number of the agent that the player controlled."""
    messages: int
    asked: tuple[str, ...]
    """Last request of the player at each row: `NOTHING`, `STEERS`, `AWAY`, or the kind of a message such as
    ``pick``."""
    rtt_ms: NDArray[np.float32]
    """Round-trip time at each row, [T] [ms]; NaN where it was not measured."""

    @property
    def rtt_shares_ms(self) -> tuple[float, float] | None:
        """Median and 95th percentile of the round-trip time over rows [ms]; None if it was never measured."""
        known = self.rtt_ms[np.isfinite(self.rtt_ms)]
        return (float(np.median(known)), float(np.percentile(known, 95))) if len(known) else None


def rtt_column(user: int) -> str:
    """Return the name of the column of a player's round-trip time."""
    return f"input.user_{user}.rtt_ms"


def live_inputs(recording: Recording) -> list[LiveInput]:
    """Return the input of each player of a live session; empty for other recordings."""
    users = sorted({e.user for e in recording.inputs if e.kind in (CLIENT, CONNECTED)})
    return [_of(recording, user, [e for e in recording.inputs if e.user == user]) for user in users]


def slipped_steps(recording: Recording) -> int:
    """Return the steps of a live session that the server did not simulate in time."""
    slips = (_json(event).get("steps") for event in recording.inputs if event.kind == SLIP)
    return sum(steps for steps in slips if isinstance(steps, int))


def remark_lines(recording: Recording) -> list[str]:
    """Return lines of text with problems that players reported, and their answers to the question at the session's end."""
    hitl = recording.episode.info.get("hitl")
    lines = []
    for remark in hitl.get("remarks", ()) if isinstance(hitl, dict) else ():
        number = remark["agent"]
        name = recording.agents[number].name if 0 <= number < len(recording.agents) else f"user {number}"
        asked = f"{remark['question']} {remark['answer']}" if "question" in remark else "reports a problem"
        lines.append(f"{name}: {asked}" + (f' ("{remark["text"]}")' if remark["text"] else ""))
    return lines


def _of(recording: Recording, user: int, events: Sequence[InputEvent]) -> LiveInput:
    rows = len(recording)
    # live sessions write the time of the last row that had been played; the input acted on the next one
    at = np.searchsorted(recording.columns["time_ns"], [e.time_ns for e in events], side="right")
    asked, now, row = [NOTHING] * rows, NOTHING, 0
    for event, until in zip(events, at.tolist(), strict=True):
        asked[row:until] = [now] * (until - row)
        row, now = until, _asked(event, now)
    # the last wish holds until the episode ends
    asked[row:rows] = [now] * (rows - row)
    rtt = recording.columns.get(rtt_column(user), np.full(rows, np.nan, np.float32))
    messages = sum(event.kind == CLIENT for event in events)
    return LiveInput(user=user, messages=messages, asked=tuple(asked), rtt_ms=rtt)


def _asked(event: InputEvent, now: str) -> str:
    if event.kind in (CONNECTED, DISCONNECTED):
        return NOTHING if event.kind == CONNECTED else AWAY
    message = _json(event).get("message") if event.kind == CLIENT else None
    if not isinstance(message, dict):
        return now
    kind = message.get("k")
    # poses of hands and head stream all the time beside other messages, so they say nothing about a wish
    if not isinstance(kind, str) or kind in ("hand", "head"):
        return now
    # moving with both speeds at 0 is standing
    if kind == "move":
        return STEERS if message.get("f") or message.get("t") else NOTHING
    return NOTHING if kind == "stop" else kind


def _json(event: InputEvent) -> dict[str, Any]:
    """Return the payload of raw input; empty where it is no JSON object, which `h3data validate` reports."""
    try:
        payload = json.loads(event.payload or "{}")
    except ValueError:
        return {}
    return payload if isinstance(payload, dict) else {}
