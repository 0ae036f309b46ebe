"""Single steps of long recordings: what is asked for is read, the rest is not.

A log is read by its summary, chunk index and message index: one chunk (up to 4 MiB) for a step. A dataset is read by the
row group of the episode, only the columns that are asked for.
"""

from __future__ import annotations

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from numpy.typing import NDArray

from h3data.errors import InputError, did_you_mean
from h3data.recording.records import Event, InputEvent, Recording, SkillSpan
from h3data.recording.schema import Layout
from h3data.recording.storage import RemotePath, place

if TYPE_CHECKING:
    import pyarrow as pa

    from h3data.recording.parquet.dataset import Dataset


class Steps(ABC):
    """The steps of one stored episode. Close it, or use it as a context manager. Not for use by several threads at once."""

    layout: Layout
    """The columns."""

    @abstractmethod
    def __len__(self) -> int: ...

    def rows(self, start: int, stop: int, *, columns: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
        """Columns [stop - start, ...] of the steps ``start`` to ``stop - 1``, all or those that are named.

        Raises:
            InputError: there are no such steps or columns.
            FormatError: the part of the file that was needed is damaged.
        """
        self._require_steps(start, stop)
        known = [c.name for c in self.layout]
        unknown = sorted(set(columns or ()) - set(known))
        if unknown:
            raise InputError(
                f"No columns {unknown} in this recording.{did_you_mean(unknown[0], known)} It has: {', '.join(known)}."
            )
        return self._rows(start, stop, known if columns is None else [n for n in known if n in set(columns)])

    def __getitem__(self, step: int) -> dict[str, NDArray[Any]]:
        """All columns at one step, without the time axis; -1 is the last."""
        if not -len(self) <= step < len(self):
            raise IndexError(f"The recording has {len(self)} steps, there is no {step}.")  # also ends a for loop
        at = step % len(self)
        return {name: array[0] for name, array in self.rows(at, at + 1).items()}

    def recording(self, start: int, stop: int) -> Recording:
        """The steps ``start`` to ``stop - 1`` as a recording of their own, e.g. to draw them with `h3data.replay.Replay`.

        Steps of events and skills count from ``start``; spans are cut to these steps, one that goes on afterwards is
        ``running``. Inputs are those that came after the step before and until the last one, so that windows side by
        side share them out. ``info["window"]`` says what it was cut from; ``time_ns`` and ``state_hash`` stay as they were.
        """
        self._require_steps(start, stop)
        whole = self._recording(start, stop)
        window = {"start": start, "stop": stop, "of": len(self)}
        return replace(
            whole,
            episode=replace(whole.episode, info={**whole.episode.info, "window": window}),
            events=_events_within(whole.events, start, stop),
            skills=_skills_within(whole.skills, start, stop),
            inputs=self._inputs_within(whole.inputs, start, stop),
        )

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- inside ---
    def _require_steps(self, start: int, stop: int) -> None:
        if not 0 <= start <= stop <= len(self):
            raise InputError(f"Steps {start} to {stop - 1}: the recording has {len(self)}, 0 to {len(self) - 1}.")

    def _inputs_within(self, inputs: Sequence[InputEvent], start: int, stop: int) -> tuple[InputEvent, ...]:
        """What came in (time of the row before, time of the last row]; at the ends of the episode also all beyond."""
        if not inputs or (start, stop) == (0, len(self)):
            return tuple(inputs)
        if start == stop:
            return ()
        before = self._time_ns(start - 1) if start else -math.inf
        last = self._time_ns(stop - 1) if stop < len(self) else math.inf
        return tuple(i for i in inputs if before < i.time_ns <= last)

    def _time_ns(self, step: int) -> int:
        return int(self._rows(step, step + 1, ["time_ns"])["time_ns"][0])

    @abstractmethod
    def _rows(self, start: int, stop: int, names: list[str]) -> dict[str, NDArray[Any]]: ...

    @abstractmethod
    def _recording(self, start: int, stop: int) -> Recording:
        """These rows with everything else of the episode."""


def open_steps(path: str | os.PathLike[str] | RemotePath, *, episode: int | None = None) -> Steps:
    """The steps of an MCAP log, or of one ``episode`` of a dataset; path or URI.

    Damage in parts of a log that are not asked for is not noticed: `read_mcap` checks all of it.

    Raises:
        InputError: there is no such file or episode.
        FormatError: it is damaged, unfinished, of another kind, or a log without indexes.
    """
    at = place(path)
    if at.is_dir():
        from h3data.recording.parquet.dataset import Dataset

        if episode is None:
            raise InputError(f"A dataset has many episodes: pass episode=0 or another number: {at}")
        return DatasetSteps(Dataset(at), episode)
    if episode is not None:
        raise InputError(f"Only a dataset has numbered episodes, this is not one: {at}")
    from h3data.recording.mcap.mcap_steps import McapSteps

    return McapSteps(at)


class DatasetSteps(Steps):
    """The steps of one episode of a dataset; columns that were read once are kept as Arrow has them."""

    def __init__(self, dataset: Dataset, index: int) -> None:
        self.dataset, self.index = dataset, index
        self.layout = dataset.layout(index)  # refuses numbers that are not there
        self._length: int = dataset.rows[index]["length"]
        self._kept: dict[str, pa.ChunkedArray] = {}

    def __len__(self) -> int:
        return self._length

    def close(self) -> None:
        self._kept.clear()

    def _rows(self, start: int, stop: int, names: list[str]) -> dict[str, NDArray[Any]]:
        if start == stop:
            return {c.name: c.empty() for c in self.layout if c.name in names}
        wanted = [c.name for c in self.layout if c.width and c.name in names and c.name not in self._kept]
        if wanted:
            table = self.dataset.read_group([self.index], wanted)
            self._kept |= {name: table[name] for name in wanted}
        kept = {name: array.slice(start, stop - start) for name, array in self._kept.items() if name in names}
        found = self.dataset.to_numpy(self.index, kept, stop - start)
        return {name: found[name] for name in names}

    def _recording(self, start: int, stop: int) -> Recording:
        return self.dataset.with_columns(self.index, self._rows(start, stop, [c.name for c in self.layout]))


def _events_within(events: Sequence[Event], start: int, stop: int) -> tuple[Event, ...]:
    return tuple(replace(e, step=e.step - start) for e in events if start <= e.step < stop)


def _skills_within(skills: Sequence[SkillSpan], start: int, stop: int) -> tuple[SkillSpan, ...]:
    return tuple(
        replace(
            s,
            start_step=max(s.start_step, start) - start,
            end_step=min(s.end_step, stop - 1) - start,
            outcome=s.outcome if s.end_step < stop else "running",
            reason=s.reason if s.end_step < stop else "",
        )
        for s in skills
        if s.start_step < stop and s.end_step >= start
    )
