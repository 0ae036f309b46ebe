"""Single steps of long recordings, read without the rest of the file.

A log is read through its summary, chunk index and message index: reading a step decodes one chunk (up to 4 MiB). From a
dataset, the row group of the episode is read, with requested columns only.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

from numpy.typing import NDArray

from h3data.errors import InputError, suggest
from h3data.recording.records import InputEvent, Recording
from h3data.recording.schema import Layout


class Steps(ABC):
    """Reader of the steps of one stored episode.

    Close it after use, or use it as a context manager. Threads must not share one.
    """

    layout: Layout
    """Description of the columns."""

    @abstractmethod
    def __len__(self) -> int: ...

    def rows(self, start: int, stop: int, *, columns: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
        """Return columns [stop - start, ...] of the steps ``start`` to ``stop - 1``: all columns, or only ``columns``.

        Raises:
            InputError: there are no such steps or columns.
            FormatError: the part of the file that was needed is damaged.
        """
        self._require_steps(start, stop)
        names = [c.name for c in self.layout]
        unknown = sorted(set(columns or ()) - set(names))
        if unknown:
            raise InputError(
                f"No columns {unknown} in this recording.{suggest(unknown[0], names, lead='It has')}",
                code="H3-RECORDING-116",
            )
        return self._rows(start, stop, names if columns is None else [n for n in names if n in set(columns)])

    def __getitem__(self, step: int) -> dict[str, NDArray[Any]]:
        """Return all columns at one step, without the time axis; -1 is the last."""
        if not -len(self) <= step < len(self):
            raise IndexError(f"The recording has {len(self)} steps, there is no {step}.")  # also ends a for loop
        at = step % len(self)
        return {name: array[0] for name, array in self.rows(at, at + 1).items()}

    def recording(self, start: int, stop: int) -> Recording:
        """Return steps ``start`` to ``stop - 1`` as a separate recording, for example to render them.

        Steps of events and skills count from ``start``. Spans are cut to these steps; a skill that continues afterwards
        becomes ``running``. The recording has the inputs after the step before ``start``, up to the last step, so
        adjacent windows share no inputs. ``info["window"]`` holds ``start``, ``stop`` and the number of steps of the
        whole recording; ``time_ns`` and ``state_hash`` do not change.
        """
        self._require_steps(start, stop)
        whole = self._recording(start, stop)
        window = {"start": start, "stop": stop, "of": len(self)}
        return replace(
            whole,
            episode=replace(whole.episode, info={**whole.episode.info, "window": window}),
            events=tuple(replace(e, step=e.step - start) for e in whole.events if start <= e.step < stop),
            skills=tuple(
                replace(
                    s,
                    start_step=max(s.start_step, start) - start,
                    end_step=min(s.end_step, stop - 1) - start,
                    outcome=s.outcome if s.end_step < stop else "running",
                    reason=s.reason if s.end_step < stop else "",
                )
                for s in whole.skills
                if s.start_step < stop and s.end_step >= start
            ),
            inputs=self._inputs_within(whole.inputs, start, stop),
        )

    @abstractmethod
    def close(self) -> None:
        """Release files and memory; the steps cannot be read afterwards."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- private ---
    def _require_steps(self, start: int, stop: int) -> None:
        if not 0 <= start <= stop <= len(self):
            raise InputError(
                f"Steps {start} to {stop - 1}: the recording has {len(self)}, 0 to {len(self) - 1}.",
                code="H3-RECORDING-117",
            )

    def _inputs_within(self, inputs: Sequence[InputEvent], start: int, stop: int) -> tuple[InputEvent, ...]:
        """Return inputs in (time of the row before, time of the last row]; at an episode's ends also all beyond."""
        # the whole episode has them all, without reading a time
        if not inputs or (start, stop) == (0, len(self)):
            return tuple(inputs)
        if start == stop:
            return ()
        # half open at the beginning, so that windows side by side divide the inputs and share none
        before = self._time_ns(start - 1) if start else -math.inf
        last = self._time_ns(stop - 1) if stop < len(self) else math.inf
        return tuple(i for i in inputs if before < i.time_ns <= last)

    def _time_ns(self, step: int) -> int:
        return int(self._rows(step, step + 1, ["time_ns"])["time_ns"][0])

    @abstractmethod
    def _rows(self, start: int, stop: int, names: list[str]) -> dict[str, NDArray[Any]]: ...

    @abstractmethod
    def _recording(self, start: int, stop: int) -> Recording:
        """Return a recording of these rows with all records of the whole episode."""
