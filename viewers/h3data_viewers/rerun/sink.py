"""Output stream for the entities of one recording in a Rerun file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.recording.records import STEP_NS

if TYPE_CHECKING:
    import rerun as rr


@dataclass(eq=False)
class DeferredStream:
    """Buffer for the calls of a Rerun stream until `release`.

    Viewers need the layout first, but its entity names are known only after everything is logged.
    """

    calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = field(default_factory=list)

    def log(self, *args: Any, **options: Any) -> None:
        """Buffer a call of `rerun.RecordingStream.log`."""
        self.calls.append(("log", args, options))

    def send_columns(self, *args: Any, **options: Any) -> None:
        """Buffer a call of `rerun.RecordingStream.send_columns`."""
        self.calls.append(("send_columns", args, options))

    def release(self, stream: rr.RecordingStream) -> None:
        """Make all buffered calls on a stream, in their order."""
        for name, args, options in self.calls:
            getattr(stream, name)(*args, **options)


Rows = NDArray[np.integer] | Sequence[int]


@dataclass(frozen=True, eq=False)
class Sink:
    """Rerun stream bound to the time column and the root entity of one recording."""

    stream: rr.RecordingStream | DeferredStream
    time_ns: NDArray[np.int64]
    """Column ``time_ns`` of the recording, shape [T]."""
    label: str = ""
    """Root entity of the recording; empty if the file holds no other recording."""

    def path(self, entity: str) -> str:
        """Return the absolute path of an entity."""
        return f"/{self.label}/{entity}" if self.label else f"/{entity}"

    def static(self, entity: str, *parts: Any) -> None:
        """Log components of an entity that never change."""
        # strict: a wrong component raises, where Rerun would only log a warning
        self.stream.log(self.path(entity), *parts, static=True, strict=True)

    def columns(self, entity: str, rows: Rows | None, columns: Iterable[rr.ComponentColumn]) -> None:
        """Log one value at each of ``rows``, or at every row if ``rows`` is None; row T is one step after the last."""
        self.stream.send_columns(self.path(entity), self._at(rows), columns, strict=True)

    def moments(self, entity: str, time_ns: NDArray[np.int64], columns: Iterable[rr.ComponentColumn]) -> None:
        """Log one value at each of ``time_ns`` [ns], which may lie between rows; the step is that of the next row."""
        import rerun as rr

        steps = np.searchsorted(self.time_ns, time_ns)
        durations = time_ns.astype("timedelta64[ns]")
        times = [rr.TimeColumn("step", sequence=steps), rr.TimeColumn("sim_time", duration=durations)]
        self.stream.send_columns(self.path(entity), times, columns, strict=True)

    def _at(self, rows: Rows | None) -> list[rr.TimeColumn]:
        import rerun as rr

        count = len(self.time_ns)
        steps = np.arange(count) if rows is None else np.asarray(rows, np.int64)
        after = self.time_ns[-1] + STEP_NS if count else 0
        durations = np.where(steps < count, self.time_ns[np.minimum(steps, count - 1)], after) if count else steps * 0
        return [
            rr.TimeColumn("step", sequence=steps),
            rr.TimeColumn("sim_time", duration=durations.astype("timedelta64[ns]")),
        ]
