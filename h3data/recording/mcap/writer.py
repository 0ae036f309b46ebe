"""Writer of MCAP files, step by step while an episode runs or from a finished recording.

A file grows while the episode runs and is readable up to its last flush after a crash. An unfinished file is named
``<name>.part``; only a complete file gets its final name. ``h3data docs format`` describes the contents.
"""

from __future__ import annotations

import contextlib
import dataclasses
import mimetypes
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.recording.mcap.header import (
    PROFILE,
    TOPIC_MESSAGES,
    encode_record,
    episode_metadata,
    header_metadata,
    log_time,
    start_time,
)
from h3data.recording.mcap.part import PartFile, part_path, publish
from h3data.recording.mcap.read import read_mcap
from h3data.recording.mcap.shared_files import RECORD, share_files
from h3data.recording.mcap.wire import (
    WireLayout,
    encode_block,
    fields_to_metadata,
    step_descriptor,
    struct_descriptor,
    wire_layouts,
)
from h3data.recording.records import SCHEMA_VERSION, Event, InputEvent, Recording, RecordingHeader, SkillSpan
from h3data.recording.schema import (
    Layout,
    Topic,
    default_layout,
    layout_hash,
    layout_of,
    layout_to_json,
    struct_to_dict,
)
from h3data.recording.storage import AnyPath, RemotePath, local, open_binary, place

CHUNK_BYTES = 4 << 20
"""Largest uncompressed size of a chunk."""


class RecordingWriter:
    """MCAP file that is open for writing.

    As a context manager it closes the file at the end. After an exception or Ctrl-C the rows so far remain in
    ``<name>.part``, which `recover_mcap` (``h3data recover``) reads. Rows reach the operating system at least every
    ``flush_rows`` rows (30 rows are one second) or ``flush_s`` seconds. Data that the disk does not accept stay in
    memory: after a disk error, `flush` and `close` can be called again when there is space, and nothing is lost.

    A file that was flushed repeatedly consists of small chunks and is twice as large as necessary. `close` gives it its
    final name, reads it back and replaces it by a compact file (`pack_mcap`), as written by `write_mcap`. Pass
    ``compact=False`` to skip that. A complete file exists under the final name at all times; if the disk is full, the
    small chunks remain.
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | RemotePath,
        header: RecordingHeader | Recording,
        *,
        overwrite: bool = False,
        t0_unix_ns: int | None = None,
        share_in: str | os.PathLike[str] | None = None,
        chunk_bytes: int = CHUNK_BYTES,
        flush_rows: int = 30,
        flush_s: float = 1.0,
        compact: bool = True,
    ) -> None:
        """Create ``<path>.part`` and write everything known before the first step.

        ``header.columns`` fixes the columns unless it is empty; then the first `append` does. Rows, skills, events and
        inputs of a `Recording` given as the header are not written. Log times are ``time_ns`` plus ``t0_unix_ns``, which
        defaults to ``episode.info["t0_unix_ns"]`` or 0, so that equal episodes make equal files. With ``share_in``, a folder
        around the log, attachments such as the scene are stored once for all its logs, in ``<share_in>/h3/files``. With
        ``compact``, the finished file is packed.

        Raises:
            InputError: the file exists and ``overwrite`` is False, or the header cannot be stored.
        """
        from mcap.writer import CompressionType, Writer

        self.path = local(path)
        self.header = header
        self.closed = self._finished = False
        self._t0 = start_time(header, t0_unix_ns)
        self._chunk_bytes, self._flush_rows, self._flush_s = chunk_bytes, flush_rows, flush_s
        self._compact, self._share_in = compact, share_in
        self._blocks = 0
        self._rows: PendingRows | None = None
        self._topics: dict[Topic, tuple[int, WireLayout]] = {}
        self._spans = 0
        self._input_channel: int | None = None
        self._flushed_at = time.monotonic()
        # made before the file is: a header that cannot be stored leaves nothing behind
        metadata = header_metadata(header)
        records = {kind: [struct_to_dict(r) for r in getattr(header, kind)] for kind in ("assets", "bodies", "agents")}
        scene = encode_record("h3.Scene", records)
        self._file = PartFile(self.path, overwrite=overwrite)
        try:
            shared = {} if share_in is None else share_files(header.attachments, local(share_in), self.path)
            with self._file.writing():
                self._mcap = Writer(
                    cast(IO[bytes], self._file.stream),
                    chunk_size=chunk_bytes,
                    compression=CompressionType.ZSTD,
                    enable_data_crcs=True,
                )
                self._mcap.start(profile=PROFILE, library=f"h3data schema {SCHEMA_VERSION}")
                for name, values in metadata.items():
                    self._mcap.add_metadata(name, values)
                if shared:
                    self._mcap.add_metadata(RECORD, shared)
                for name, data in header.attachments.items() if share_in is None else ():
                    media = mimetypes.guess_type(name)[0] or "application/octet-stream"
                    self._mcap.add_attachment(self._log_time(0), self._log_time(0), name, media, bytes(data))
                self._open_channels()
                self._mcap.add_message(self._scene_channel, self._log_time(0), scene, self._log_time(0))
                self._mcap.flush()  # a chunk of its own: reading the scene or one step does not unpack the other
            if header.columns:
                self._rows = self._fix_layout({n: np.asarray(a)[:0] for n, a in header.columns.items()})
        except BaseException:
            self._shut()
            self._file.discard()  # nothing worth recovering yet
            raise

    @property
    def part(self) -> Path:
        """Name of the file while it is written."""
        return self._file.path

    @property
    def steps(self) -> int:
        """Number of rows appended so far."""
        return 0 if self._rows is None else self._rows.steps

    def append(self, rows: Mapping[str, ArrayLike]) -> None:
        """Write one or more steps; ``rows`` has every column, with shape [n, ...] and the same n for all."""
        added = self._add(rows)
        assert self._rows is not None
        due = self._rows.steps - self._rows.taken >= self._flush_rows
        late = time.monotonic() - self._flushed_at >= self._flush_s
        # rows wait for each other, because a block is encoded at once by numpy; not long, because a crash loses
        # them
        if added and (due or late):
            self.flush()

    def append_recording(self, recording: Recording) -> None:
        """Write all steps, skills, events and inputs of a recording.

        Chunks span at most 10 s (`chunks.repeats` names the exception). Events, inputs and skills are written after the
        steps at which they become known, and a skill as ``running`` until it ends. A truncated file therefore loses
        only the chunks after the cut.
        """
        parts, long_chunks = CutRecording(recording), repeats(recording.columns)
        for start, stop in slices(recording.columns["time_ns"]):
            self._add({name: column[start:stop] for name, column in recording.columns.items()})
            with self._file.writing():
                self._write_pending()
            for event in parts.events(stop):
                self.event(event)
            for message in parts.inputs(stop):
                self.input(message)
            for number, span in parts.skills(stop):
                self._write_skill(span, number)
            if not long_chunks:
                self.flush()
        self.flush()

    def event(self, event: Event) -> None:
        """Write an event."""
        self._require_open()
        data = encode_record("h3.Event", struct_to_dict(event))
        # at the time of its step: viewers show it there, and it may be written later
        t = self._log_time(self._time_of(event.step))
        with self._file.writing():
            self._mcap.add_message(self._event_channel, t, data, t)

    def input(self, event: InputEvent) -> None:
        """Write one message of a person's input device."""
        self._require_open()
        data = encode_record("h3.Input", struct_to_dict(event))
        t = self._log_time(event.time_ns)
        with self._file.writing():
            if self._input_channel is None:  # opened on demand: most recordings have no inputs
                self._input_channel = self._struct_channel("Input")
            self._mcap.add_message(self._input_channel, t, data, t)

    def skill(self, span: SkillSpan, *, replaces: int | None = None) -> int:
        """Write a high-level action and return its number.

        A skill that has just started can be written as ``running``, and again with ``replaces=<its number>`` when it
        ends. Readers use the last version, so a crash does not lose an unfinished action.
        """
        self._require_open()
        if replaces is not None and not 0 <= replaces < self._spans:
            raise InputError(
                f"replaces={replaces}: {self._spans} skill spans were written, numbered from 0.",
                code="H3-RECORDING-011",
            )
        number = self._spans if replaces is None else replaces
        self._write_skill(span, number)
        return number

    def flush(self) -> None:
        """Pass all appended data to the operating system, so that they survive the end of this process."""
        self._require_open()
        with self._file.writing():
            self._write_pending()
            self._mcap.flush()
        self._flushed_at = time.monotonic()

    def close(self, *, info: Mapping[str, Any] | None = None) -> Path:
        """Finish, sync, rename and pack the file; return its final path. A second call does nothing.

        ``info`` holds facts known only at the end, such as the result of the episode, and is merged into
        ``episode.info``.

        Raises:
            InputError: the disk is full or fails; flushed data stay in ``<name>.part``. Call `close` again when there
                is space, or call `abort`.
            FormatError: the data read back differ from the data written.
        """
        if self.closed:
            return self.path
        if self._rows is None:
            # no step was ever written: the columns are announced all the same, so that the file can be read
            self._rows = self._fix_layout({c.name: c.empty() for c in default_layout(self.header)})
        with self._file.writing():
            if not self._finished:
                self._write_pending()
                self._mcap.flush()
                if info:  # readers keep the last metadata record of a name
                    episode = dataclasses.replace(self.header.episode, info={**self.header.episode.info, **info})
                    self._mcap.add_metadata("h3.episode", episode_metadata(episode))
                self._mcap.add_metadata("h3.end", {"steps": str(self.steps), "skills": str(self._spans)})
                self._mcap.finish()
                self._finished = True
            # apart from the records above: where only this fails, a second call must not write them again
            self._file.complete()
        self._shut()
        # a file of one block is packed already
        if self._compact and self._blocks > 1:
            pack_mcap(self.path, t0_unix_ns=self._t0, share_in=self._share_in, chunk_bytes=self._chunk_bytes)
        return self.path

    def abort(self, *, keep: bool = True) -> None:
        """Stop writing before the recording is complete.

        The rows so far stay in ``<name>.part`` for `recover_mcap`, or are deleted if ``keep`` is False.
        """
        if self.closed:
            return
        try:
            with contextlib.suppress(OSError, ValueError):  # the disk may be full; earlier flushes can be recovered
                if not self._finished:
                    self._write_pending()
                    self._mcap.finish()
                self._file.stream.flush()
        finally:
            self._shut()
            if not keep:
                self._file.discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            try:
                self.close()
            finally:
                self._shut()
        else:
            self.abort()

    def __repr__(self) -> str:
        state = "closed" if self.closed else "open"
        return f"{type(self).__name__}({str(self.path)!r}, {self.steps} steps, {state})"

    # --- private ---
    def _add(self, rows: Mapping[str, ArrayLike]) -> int:
        """Hold rows until they are written; return their number."""
        self._require_open()
        arrays = {name: np.asarray(values) for name, values in rows.items()}
        # numpy keeps the byte order of files that were read, but the wire has only one
        arrays = {n: a if a.dtype.isnative else a.astype(a.dtype.newbyteorder("=")) for n, a in arrays.items()}
        if self._rows is None:
            self._rows = self._fix_layout({name: a[:0] if a.ndim else a for name, a in arrays.items()})
        before = self._rows.steps
        self._rows.add(arrays)
        return self._rows.steps - before

    def _shut(self) -> None:
        self.closed = True
        self._file.shut()

    def _require_open(self) -> None:
        if self.closed or self._finished:
            raise InputError(
                f"This recording is closed; nothing can be added to it: {self.path}", code="H3-RECORDING-012"
            )

    def _open_channels(self) -> None:
        channels = [self._struct_channel(name) for name in ("Scene", "Event", "Skill")]
        self._scene_channel, self._event_channel, self._skill_channel = channels

    def _struct_channel(self, name: str) -> int:
        schema = self._mcap.register_schema(f"h3.{name}", "protobuf", struct_descriptor())
        return self._mcap.register_channel(f"/h3/{name.lower()}", "protobuf", schema)

    def _write_skill(self, span: SkillSpan, number: int) -> None:
        data = encode_record("h3.Skill", {**struct_to_dict(span), "span": number})
        t = self._log_time(self._time_of(span.end_step))
        with self._file.writing():
            self._mcap.add_message(self._skill_channel, t, data, t)
        # a span that is written again keeps its number
        self._spans = max(self._spans, number + 1)

    def _fix_layout(self, empty: Mapping[str, NDArray[Any]]) -> PendingRows:
        """Take the columns from arrays without rows, check them against the header and announce them in the file."""
        layout = layout_of(empty)
        h = self.header
        # only for its checks, which refuse columns that do not fit the header before anything is written
        Recording(episode=h.episode, assets=h.assets, bodies=h.bodies, agents=h.agents, columns=empty)
        with self._file.writing():
            self._mcap.add_metadata("h3.layout", {"columns": layout_to_json(layout), "hash": layout_hash(layout)})
            for topic, fields in wire_layouts(layout).items():
                message = TOPIC_MESSAGES[topic]
                descriptor = step_descriptor(message, fields)
                schema = self._mcap.register_schema(f"h3.{message}", "protobuf", descriptor)
                channel = self._mcap.register_channel(f"/h3/{topic}", "protobuf", schema, fields_to_metadata(fields))
                self._topics[topic] = (channel, fields)
        return PendingRows(layout)

    def _write_pending(self) -> None:
        """Encode the rows since the last flush as one block and add its messages to the open chunk."""
        rows = {} if self._rows is None else self._rows.take()
        if self._rows is None or not rows:
            return
        first = self._rows.taken - len(rows["time_ns"])
        messages = []
        for channel, fields in self._topics.values():
            block = encode_block(fields, rows, first_step=first)
            messages.append((channel, block.tobytes(), block.shape[1]))
        self._blocks += 1
        # looked up once: this loop runs for every step of every topic
        add = self._mcap.add_message
        for k, time_ns in enumerate(rows["time_ns"].tolist()):
            t = self._log_time(time_ns)
            for channel, data, size in messages:
                # the sequence number of MCAP has 32 bits
                add(channel, t, data[k * size : (k + 1) * size], t, (first + k) & 0xFFFFFFFF)

    def _time_of(self, step: int) -> int:
        return 0 if self._rows is None else self._rows.time_of(step)

    def _log_time(self, time_ns: int) -> int:
        return log_time(self._t0, time_ns)


def write_mcap(
    recording: Recording,
    path: str | os.PathLike[str] | RemotePath,
    *,
    overwrite: bool = False,
    share_in: str | os.PathLike[str] | None = None,
) -> AnyPath:
    """Write a finished recording as one MCAP file and return its path; equal recordings make equal files.

    With ``share_in``, a folder around the file, attachments such as the scene are stored once for all recordings in it
    (``<share_in>/h3/files``). If the path is a URI, the file is written to a temporary folder and then uploaded.
    """
    target = place(path)
    if isinstance(target, RemotePath):
        if share_in is not None:
            raise InputError(
                f"Files can be shared by recordings in a local folder only, not by: {target}", code="H3-RECORDING-046"
            )
        if target.exists() and not overwrite:
            raise InputError(f"The file exists; pass overwrite=True to replace it: {target}", code="H3-RECORDING-047")
        with tempfile.TemporaryDirectory(prefix="h3data-") as folder:
            # locally first: a log grows record by record, and an object store takes a file as a whole
            written = write_mcap(recording, Path(folder) / target.name)
            with open_binary(written) as stream:
                target.put(stream)
        return target
    with RecordingWriter(target, recording, overwrite=overwrite, share_in=share_in, compact=False) as writer:
        writer.append_recording(recording)
    return writer.path


def pack_mcap(
    path: Path,
    *,
    t0_unix_ns: int | None = None,
    share_in: str | os.PathLike[str] | None = None,
    chunk_bytes: int = CHUNK_BYTES,
) -> None:
    """Replace a finished log by an equal one with large chunks, unless the disk lacks space for it.

    As packing takes about 0.1 s, a real-time program should write with ``compact=False`` and pack the log in another
    process.
    """
    # a hidden name in the same folder, so that the rename stays within one disk
    packed = path.with_name(f".{path.name}.compact")
    try:
        recording = read_mcap(path)
        with RecordingWriter(
            packed,
            recording,
            overwrite=True,
            t0_unix_ns=t0_unix_ns,
            share_in=share_in,
            chunk_bytes=chunk_bytes,
            compact=False,
        ) as writer:
            writer.append_recording(recording)
        publish(packed, path)
    except BaseException as error:
        for leftover in (packed, part_path(packed)):
            leftover.unlink(missing_ok=True)
        # the finished log is whole, so packing may fail for lack of room without any loss
        no_room = isinstance(error, OSError | MemoryError) or isinstance(error.__cause__, OSError)
        if not no_room:
            raise


class PendingRows:
    """Buffer of rows between `RecordingWriter.append` and the file, which are checked and then encoded together."""

    def __init__(self, layout: Layout) -> None:
        self.steps = 0
        """Number of rows added so far."""
        self.taken = 0
        """Number of rows returned by `take` so far."""
        self._kinds = {c.name: (np.dtype(c.dtype), c.shape) for c in layout}
        self._pending: list[dict[str, NDArray[Any]]] = []
        self._times: list[NDArray[np.int64]] = []
        self._last_time: int | None = None

    def add(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Add a copy of n rows to the buffer; ``rows`` has every column with shape [n, ...].

        Raises:
            InputError: columns are missing or have another dtype or shape, or time does not increase.
        """
        count = self._check(arrays)
        if not count:
            return
        self._pending.append({name: a.copy() for name, a in arrays.items()})  # callers reuse their buffers
        self._last_time = int(arrays["time_ns"][-1])
        self.steps += count

    def take(self) -> dict[str, NDArray[Any]]:
        """Remove all rows from the buffer and return them joined; {} if there are none."""
        pending, self._pending = self._pending, []
        if not pending:
            return {}
        rows = pending[0] if len(pending) == 1 else {n: np.concatenate([p[n] for p in pending]) for n in pending[0]}
        self._times.append(rows["time_ns"])
        self.taken += len(rows["time_ns"])
        return rows

    def time_of(self, step: int) -> int:
        """Return ``time_ns`` of an added row; for any other step, that of the nearest row."""
        step = min(step, self.steps - 1)
        if step >= self.taken:
            return self._last_time or 0  # at most one flush interval off
        if not self._times:
            return 0
        if len(self._times) > 1:
            # joined when somebody asks, not at each flush, which would copy all times again and again
            self._times = [np.concatenate(self._times)]
        return int(self._times[0][max(step, 0)])

    def _check(self, arrays: dict[str, NDArray[Any]]) -> int:
        """Return the number of rows; an `InputError` unless all columns have it, with the dtype and shape of the layout."""
        times = arrays.get("time_ns")
        count = len(times) if times is not None and times.ndim else 0
        faults = []
        for name, array in arrays.items():
            kind = self._kinds.get(name)
            if kind is None:
                faults.append(f"{name} is not one of the columns")
            elif array.dtype != kind[0] or array.shape != (count, *kind[1]):
                faults.append(f"{name} must be {kind[0]} {[count, *kind[1]]}, is {array.dtype} {list(array.shape)}")
        if len(arrays) - len(faults) < len(self._kinds):
            faults += [f"{name} is missing" for name in self._kinds if name not in arrays]
        if faults:
            raise InputError(f"Rows do not fit this recording: {'; '.join(faults[:8])}.", code="H3-RECORDING-033")
        first_is_late = self._last_time is None or count == 0 or int(arrays["time_ns"][0]) > self._last_time
        if not first_is_late or (count > 1 and np.any(np.diff(arrays["time_ns"]) <= 0)):
            raise InputError(
                "time_ns must increase strictly from row to row, also from one append to the next.",
                code="H3-RECORDING-034",
            )
        return count


# --- cutting a finished recording into chunks -------------------------------------------------------------------------
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
