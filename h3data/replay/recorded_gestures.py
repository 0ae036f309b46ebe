"""Gestures of people from the events of a recording, which move the hands of a person during an activity."""

from __future__ import annotations

import numpy as np

from h3data.bodies.people.gestures import GESTURES, NAMES
from h3data.geometry import Array, smoothstep
from h3data.recording import Recording

BEGINS, ENDS = "activity", ("activity", "walks_to", "gets_up")
"""Kinds of the events that start and end a gesture; the target of the first is the name of the activity."""
RAMP_S = 0.8
"""Time in which the hands move into the gesture at its start, and back before its end [s]."""


def recorded_gestures(recording: Recording, agent: int) -> Array | None:
    """Return the gestures of an agent at all steps, [T, 3], as `h3data.bodies.people.gestures.add_gestures` takes them.

    Gestures of seated people start when they sit, and are omitted while they do not. The result is None if the agent
    has no activity with a gesture.
    """
    turns = [event for event in recording.events if event.agent == agent and event.kind in ENDS]
    if not any(event.kind == BEGINS and event.target in NAMES for event in turns):
        return None
    seconds = recording.columns["time_ns"].astype(np.float64) * 1e-9
    seats = recording.columns.get(f"agent_{agent}.motion_seat")
    out = np.zeros((len(seconds), 3))
    for k, event in enumerate(turns):
        begin = max(event.step, 0)
        end = next((after.step for after in turns[k + 1 :] if after.step > begin), len(seconds))
        if event.kind != BEGINS or event.target not in NAMES or begin >= end:
            continue
        if GESTURES[event.target].seated:
            on_seat = np.flatnonzero(seats[begin:end, 1] >= 1) if seats is not None else np.zeros(0, np.intp)
            if not len(on_seat):
                continue
            begin += int(on_seat[0])
        rows = slice(begin, end)
        since, left = seconds[rows] - seconds[begin], seconds[end - 1] - seconds[rows]
        u = np.clip(np.minimum(since, left if end < len(seconds) else np.inf) / RAMP_S, 0.0, 1.0)
        # 1.9: time between the gestures of agents with successive numbers, so that people who talk to each
        # other do not move alike [s]
        out[rows] = np.column_stack([np.full(len(u), NAMES.index(event.target)), since + 1.9 * agent, smoothstep(u)])
    return out
