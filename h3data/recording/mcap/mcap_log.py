"""The session log: one episode per MCAP file, appended while it happens, readable up to the last flush after any crash.

While it is written the file is called ``<name>.part``; only a complete file gets its final name. What is in it:
``docs/format.md``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import mimetypes
import os
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.recording.mcap.mcap_header import (
    PROFILE,
    TOPIC_MESSAGES,
    encode_record,
    episode_metadata,
    header_metadata,
    log_time,
    scene_dict,
    start_time,
)
from h3data.recording.mcap.mcap_part import PartFile, part_path, publish
from h3data.recording.mcap.mcap_read import read_mcap
from h3data.recording.mcap.mcap_rows import PendingRows, native_rows
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
    Topic,
    default_layout,
    layout_hash,
    layout_of,
    layout_to_json,
    struct_to_dict,
)
from h3data.recording.storage import AnyPath, RemotePath, local, open_binary, place

CHUNK_BYTES = 4 << 20
"""Uncompressed; a free-form episode of 1500 steps takes 532 B/step, with chunks of 1 MiB 557, of 256 KiB 648."""
FLUSH_ROWS = 30
FLUSH_S = 1.0
_SLICE_ROWS = 8192


class RecordingWriter:
    """Writes one episode while it happens.

    Used as a context manager it closes the file at the end. On an exception or Ctrl-C it finishes what there is as
    ``<name>.part``, which `recover_mcap` (``h3data recover``) reads; the final name never shows an unfinished episode.
    What was appended is handed to the operating system at least every ``flush_rows`` rows or ``flush_s`` seconds.

    A log that was flushed in between consists of small chunks, which are twice the size. `close` gives it its name, reads
    it back and replaces it by the file that `write_mcap` makes of it (15 ms for 1,500 steps); not with ``compact=False``.
    Whatever happens meanwhile, there is a whole file under the name: a full disk leaves the small chunks.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        header: RecordingHeader | Recording,
        *,
        overwrite: bool = False,
        t0_unix_ns: int | None = None,
        chunk_bytes: int = CHUNK_BYTES,
        flush_rows: int = FLUSH_ROWS,
        flush_s: float = FLUSH_S,
        compact: bool = True,
    ) -> None:
        """Create ``<path>.part`` and write all that is known before the first step.

        ``header.columns`` fixes the columns if it is not empty, else the first `append` does; rows, skills, events and
        inputs of a `Recording` given as header are not written. Log times are
        ``t0_unix_ns`` (by default ``episode.info["t0_unix_ns"]``, or 0: then equal episodes make equal files) plus
        ``time_ns``.
        """
        from mcap.writer import CompressionType, Writer

        self.path = local(path)
        self.header = header
        self.closed = False
        self._t0 = start_time(header, t0_unix_ns)
        self._chunk_bytes, self._flush_rows, self._flush_s = chunk_bytes, flush_rows, flush_s
        self._compact, self._blocks = compact, 0
        self._rows: PendingRows | None = None
        self._topics: dict[Topic, tuple[int, WireLayout]] = {}
        self._spans = 0
        self._input_channel: int | None = None
        self._flushed_at = time.monotonic()
        metadata = header_metadata(header)
        scene = encode_record("h3.Scene", scene_dict(header))
        self._file = PartFile(self.path, overwrite=overwrite)
        try:
            with self._file.writing():
                self._mcap = Writer(
                    self._file.stream, chunk_size=chunk_bytes, compression=CompressionType.ZSTD, enable_data_crcs=True
                )
                self._mcap.start(profile=PROFILE, library=f"h3data schema {SCHEMA_VERSION}")
                for name, values in metadata.items():
                    self._mcap.add_metadata(name, values)
                for name, data in header.attachments.items():
                    media = mimetypes.guess_type(name)[0] or "application/octet-stream"
                    self._mcap.add_attachment(self._log_time(0), self._log_time(0), name, media, bytes(data))
                self._open_channels()
                self._mcap.add_message(self._scene_channel, self._log_time(0), scene, self._log_time(0))
                self._mcap.flush()  # a chunk of its own: whoever wants one step need not unfold a thousand for the scene
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
        """Rows appended so far."""
        return 0 if self._rows is None else self._rows.steps

    def append(self, rows: Mapping[str, ArrayLike]) -> None:
        """Write one or more steps: every column, time first, shape [n, ...]; n is the same for all."""
        self._require_open()
        arrays = native_rows(rows)
        if self._rows is None:
            self._rows = self._fix_layout({name: a[:0] if a.ndim else a for name, a in arrays.items()})
        before = self._rows.steps
        self._rows.add(arrays)
        due = self._rows.steps - self._rows.taken >= self._flush_rows
        late = time.monotonic() - self._flushed_at >= self._flush_s
        if self._rows.steps > before and (due or late):
            self.flush()

    def event(self, event: Event) -> None:
        """Write something that happened."""
        self._require_open()
        data = encode_record("h3.Event", struct_to_dict(event))
        t = self._log_time(self._time_of(event.step))
        with self._file.writing():
            self._mcap.add_message(self._event_channel, t, data, t)

    def input(self, event: InputEvent) -> None:
        """Write what a person's input device said, when it came."""
        self._require_open()
        data = encode_record("h3.Input", struct_to_dict(event))
        t = self._log_time(event.time_ns)
        with self._file.writing():
            if self._input_channel is None:  # most recordings have none
                self._input_channel = self._struct_channel("Input")
            self._mcap.add_message(self._input_channel, t, data, t)

    def skill(self, span: SkillSpan, *, replaces: int | None = None) -> int:
        """Write a high-level action and return its number.

        A skill that has just begun can be written as ``running`` and, when it ends, once more with
        ``replaces=<its number>``: readers keep the last. So a crash does not lose what was going on.
        """
        self._require_open()
        if replaces is not None and not 0 <= replaces < self._spans:
            raise InputError(f"replaces={replaces}: {self._spans} skill spans were written, numbered from 0.")
        number = self._spans if replaces is None else replaces
        data = encode_record("h3.Skill", {**struct_to_dict(span), "span": number})
        t = self._log_time(self._time_of(span.start_step if span.outcome == "running" else span.end_step))
        with self._file.writing():
            self._mcap.add_message(self._skill_channel, t, data, t)
        self._spans = max(self._spans, number + 1)
        return number

    def flush(self) -> None:
        """Hand everything appended so far to the operating system, so that it survives the end of this process."""
        self._require_open()
        with self._file.writing():
            self._write_pending()
            self._mcap.flush()
        self._flushed_at = time.monotonic()

    def close(self, *, info: Mapping[str, Any] | None = None) -> Path:
        """Finish, sync and rename the file; returns its final path. A second call does nothing.

        ``info`` adds to ``episode.info`` what is known only at the end, e.g. how the episode ended.

        Raises:
            InputError: the disk is full, ...; what was flushed stays as ``<name>.part``.
            FormatError: the storage did not keep what was written to it, as the reading back shows.
        """
        if self.closed:
            return self.path
        if self._rows is None:
            self._rows = self._fix_layout({c.name: c.empty() for c in default_layout(self.header)})
        try:
            with self._file.writing():
                self._write_pending()
                self._mcap.flush()
                if info:  # readers take the last record of a name
                    episode = dataclasses.replace(self.header.episode, info={**self.header.episode.info, **info})
                    self._mcap.add_metadata("h3.episode", episode_metadata(episode))
                self._mcap.add_metadata("h3.end", {"steps": str(self.steps), "skills": str(self._spans)})
                self._mcap.finish()
                self._file.complete()
        finally:
            self._shut()
        if self._compact and self._blocks > 1:
            _compact(self.path, t0_unix_ns=self._t0, chunk_bytes=self._chunk_bytes)
        return self.path

    def abort(self, *, keep: bool = True) -> None:
        """Stop here: what was appended stays as ``<name>.part`` for `recover_mcap`, or is deleted if not ``keep``."""
        if self.closed:
            return
        try:
            with contextlib.suppress(
                OSError, ValueError
            ):  # the disk may be full: what was flushed can still be recovered
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
            self.close()
        else:
            self.abort()

    def __repr__(self) -> str:
        state = "closed" if self.closed else "open"
        return f"RecordingWriter({str(self.path)!r}, {self.steps} steps, {state})"

    # --- inside ---
    def _shut(self) -> None:
        self.closed = True
        self._file.shut()

    def _require_open(self) -> None:
        if self.closed:
            raise InputError(f"This recording is closed; nothing can be added to it: {self.path}")

    def _open_channels(self) -> None:
        channels = [self._struct_channel(name) for name in ("Scene", "Event", "Skill")]
        self._scene_channel, self._event_channel, self._skill_channel = channels

    def _struct_channel(self, name: str) -> int:
        schema = self._mcap.register_schema(f"h3.{name}", "protobuf", struct_descriptor())
        return self._mcap.register_channel(f"/h3/{name.lower()}", "protobuf", schema)

    def _fix_layout(self, empty: Mapping[str, NDArray[Any]]) -> PendingRows:
        """Decide the columns from arrays without rows, check them against the header, announce them in the file."""
        layout = layout_of(empty)
        h = self.header
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
        """Encode the rows appended since the last flush as one block, message by message into the open chunk."""
        rows = {} if self._rows is None else self._rows.take()
        if self._rows is None or not rows:
            return
        first = self._rows.taken - len(rows["time_ns"])
        messages = []
        for channel, fields in self._topics.values():
            block = encode_block(fields, rows, first_step=first)
            messages.append((channel, block.tobytes(), block.shape[1]))
        self._blocks += 1
        add = self._mcap.add_message
        for k, time_ns in enumerate(rows["time_ns"].tolist()):
            t = self._log_time(time_ns)
            for channel, data, size in messages:
                add(channel, t, data[k * size : (k + 1) * size], t, (first + k) & 0xFFFFFFFF)

    def _time_of(self, step: int) -> int:
        return 0 if self._rows is None else self._rows.time_of(step)

    def _log_time(self, time_ns: int) -> int:
        return log_time(self._t0, time_ns)


def write_mcap(recording: Recording, path: str | os.PathLike[str] | RemotePath, *, overwrite: bool = False) -> AnyPath:
    """Write a finished recording as one MCAP file and return its path; equal recordings make equal files.

    To a URI it is written in a temporary folder first and then put there whole.
    """
    target = place(path)
    if isinstance(target, RemotePath):
        if target.exists() and not overwrite:
            raise InputError(f"The file exists; pass overwrite=True (--force) to replace it: {target}")
        with tempfile.TemporaryDirectory(prefix="h3data-") as folder:
            written = write_mcap(recording, Path(folder) / target.name)
            with open_binary(written) as stream:
                target.put(stream)
        return target
    with RecordingWriter(target, recording, overwrite=overwrite, compact=False) as writer:
        _write_all(writer, recording)
    return writer.path


def _write_all(writer: RecordingWriter, recording: Recording) -> None:
    for start in range(0, max(len(recording), 1), _SLICE_ROWS):  # each append copies what it is given
        writer.append({name: column[start : start + _SLICE_ROWS] for name, column in recording.columns.items()})
    writer.flush()
    for span in recording.skills:
        writer.skill(span)
    for event in recording.events:
        writer.event(event)
    for given in recording.inputs:
        writer.input(given)


def _compact(path: Path, *, t0_unix_ns: int, chunk_bytes: int) -> None:
    """Replace a finished log by the same in large chunks; if there is no room for it, it stays as it is."""
    tight = path.with_name(f".{path.name}.compact")
    try:
        recording = read_mcap(path)
        with RecordingWriter(
            tight, recording, overwrite=True, t0_unix_ns=t0_unix_ns, chunk_bytes=chunk_bytes, compact=False
        ) as writer:
            _write_all(writer, recording)
        publish(tight, path)
    except BaseException as error:
        for leftover in (tight, part_path(tight)):
            leftover.unlink(missing_ok=True)
        no_room = isinstance(error, OSError | MemoryError) or isinstance(error.__cause__, OSError)
        if not no_room:
            raise
