"""Division of a finished recording into chunks, each with all events, inputs and skills known at its end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.recording.records import Event, InputEvent, Recording, SkillSpan

CHUNK_S, WORTH_BYTES = 10.0, 20
"""Longest chunk [s of the episode], which a truncated or damaged file loses in addition to the missing part, and the
saving per row [bytes] above which a longer chunk is used (62 for a looping clip, 0 to 18 in simulations)."""


def slices(times_ns: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return the first row and the row after the last of each interval of 10 s, for increasing times ``times_ns`` [T] [ns].

    Without rows there is one empty interval.
    """
    if not len(times_ns):
        return [(0, 0)]
    since = times_ns.astype(np.float64) - float(times_ns[0])  # differences of int64 may overflow
    # counted from the first row: a recording cut out of another does not begin at time 0
    starts = np.flatnonzero(np.diff(since // (CHUNK_S * 1e9), prepend=-1.0))
    return list(pairwise([*starts.tolist(), len(times_ns)]))


def repeats(columns: Mapping[str, NDArray[Any]]) -> bool:
    """Return whether poses repeat bit for bit over more than 10 s, such as a looping clip in local rotations.

    Chunks cannot refer to each other, so each would store the clip again: 258 instead of 157 B per step for a clip of
    60 frames. Such a recording gets chunks of the largest size. If its file is truncated inside a chunk, the complete
    compressed blocks before the cut can still be read (`scan.take_beginning`).
    """
    import zstandard

    bounds = slices(columns["time_ns"])
    # only poses are compared: they are most of a recording, and what a clip repeats
    compared = ("object_pose", "joint_pos", "joint_quat")
    poses = [column for name, column in columns.items() if name.rpartition(".")[2] in compared and column.size]
    if len(bounds) < 2 or not poses:
        return False
    # two chunks are enough to tell: a clip that repeats does so from the beginning
    (start, middle), (_, stop) = bounds[:2]
    rows = np.concatenate([np.ascontiguousarray(c[:stop]).reshape(stop, -1).view(np.uint8) for c in poses], axis=1)
    first, second, both = (
        len(zstandard.compress(rows[a:b].tobytes(), 1)) for a, b in ((start, middle), (middle, stop), (start, stop))
    )
    return first + second - both > WORTH_BYTES * (stop - start)


class CutRecording:
    """Events, inputs and skills of a recording, which are returned step by step while it is written.

    They are returned in their recorded order, which need not be the order of time; the last chunk contains the rest.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._times: NDArray[Any] = recording.columns["time_ns"]
        self._events = self._inputs = 0
        self._open = dict(enumerate(recording.skills))

    def events(self, stop: int) -> Iterator[Event]:
        """Yield the events before step ``stop`` that were not returned yet."""
        events = self._recording.events
        while self._events < len(events) and (stop == len(self._times) or events[self._events].step < stop):
            self._events += 1
            yield events[self._events - 1]

    def inputs(self, stop: int) -> Iterator[InputEvent]:
        """Yield the inputs up to the time of step ``stop - 1`` that were not returned yet."""
        inputs = self._recording.inputs
        last = stop == len(self._times)
        while self._inputs < len(inputs) and (last or inputs[self._inputs].time_ns <= self._times[stop - 1]):
            self._inputs += 1
            yield inputs[self._inputs - 1]

    def skills(self, stop: int) -> Iterator[tuple[int, SkillSpan]]:
        """Yield the number and span of each skill that started before step ``stop``.

        Skills that were already yielded as complete are left out.

        A skill that has not ended is ``running`` up to step ``stop - 1``.
        """
        for number, span in list(self._open.items()):
            if span.end_step < stop or stop == len(self._times):
                yield number, self._open.pop(number)
            elif span.start_step < stop:
                yield number, replace(span, end_step=stop - 1, outcome="running", reason="")
