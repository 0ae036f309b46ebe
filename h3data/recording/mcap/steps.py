"""Single steps of an MCAP log, found through its summary, chunk index and message index."""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from itertools import accumulate
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.recording.mcap.header import TOPIC_MESSAGES
from h3data.recording.mcap.read import assemble, check_kind, columns_of, lacks_records, reconstruct
from h3data.recording.mcap.scan import (
    MAGIC,
    MESSAGE,
    RECORD_HEAD,
    McapRecords,
    check_crc,
    decoding_errors,
    decompress,
    take,
)
from h3data.recording.mcap.shared_files import RECORD, shared_files
from h3data.recording.records import Recording
from h3data.recording.schema import layout_of
from h3data.recording.steps import Steps
from h3data.recording.storage import AnyPath, open_binary

_MESSAGE_OP, _MESSAGE_INDEX, _CHUNK_INDEX, _ATTACHMENT_INDEX, _STATISTICS, _METADATA_INDEX = 5, 7, 8, 10, 11, 13
_T = TypeVar("_T")


class McapSteps(Steps):
    """Random access to the steps of an MCAP log, with a cache of recently decompressed chunks."""

    once = ("/h3/scene", "/h3/skill", "/h3/event", "/h3/input")
    """Topics whose messages are written once and not at every step."""

    def __init__(self, path: AnyPath) -> None:
        self.path = path
        self._kept: dict[int, tuple[memoryview, dict[int, NDArray[np.uint64]]]] = {}
        try:
            self._file = open_binary(path)
        except OSError as error:
            raise InputError(
                f"The file cannot be read ({error.strerror or error}): {path}", code="H3-RECORDING-026"
            ) from error
        try:
            self._reported(self._open, "it")
        # also after Ctrl-C: a file that is left open would be held until the process ends
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        return self._steps

    def close(self) -> None:
        """Close the log and drop the decompressed chunks from memory."""
        self._file.close()
        self._kept.clear()

    # --- reading ---
    def _open(self) -> None:
        self._log = McapRecords(size=self._file.seek(0, 2))
        self._chunks: list[Any] = []
        self._attachments: list[int] = []
        self._metadata_records: int | None = None
        """Number of metadata records in the log, if its summary says so."""
        self._read_summary()
        self._places = {
            channel: self._places_of(channel)
            for topic in (*(f"/h3/{t}" for t in TOPIC_MESSAGES), *self.once)
            if (channel := self._log.channel_of(topic)) is not None
        }
        # only now, because what is made up for the records needs the places of the messages
        if lacks_records(self._log):
            self._reconstruct()
        if "h3.end" not in self._log.metadata:
            raise EOFError("the recording was never finished")
        if "h3.layout" not in self._log.metadata:
            raise ValueError("the record h3.layout is missing")
        self._steps = int(self._log.metadata["h3.end"]["steps"])
        self._per_step = [c for c in self._places if self._log.channels[c][0] not in self.once]
        # steps are found by counting, so a topic with another number of messages would give the rows of other
        # steps
        for channel in self._per_step:
            if (count := self._places[channel][-1]) != self._steps:
                raise ValueError(f"{self._steps} steps, but {count} on {self._log.channels[channel][0]}")
        # the columns as they come out of reading, without any row: no second rule for their shapes
        self.layout = layout_of(self._whole(0, 0, "/h3/scene").columns)

    def _rows(self, start: int, stop: int, names: list[str]) -> dict[str, NDArray[Any]]:
        if start == stop:
            return {c.name: c.empty() for c in self.layout if c.name in names}

        def read() -> dict[str, NDArray[Any]]:
            return columns_of(self._with_steps(start, stop), steps=stop - start, wanted=set(names), first=start)

        columns = self._reported(read, f"steps {start} to {stop - 1}")
        # in the order asked for, whatever the order in the log
        return {name: columns[name] for name in names}

    def _recording(self, start: int, stop: int) -> Recording:
        def read() -> Recording:
            # read only with a whole recording: the scene may be larger than all steps
            for offset in self._attachments:
                take(self._log, *self._record(offset))
            self._log.attachments |= shared_files(self._log.metadata.get(RECORD, {}), self.path)
            return self._whole(start, stop, *self.once)

        return self._reported(read, f"steps {start} to {stop - 1}")

    # --- private ---
    def _reported(self, read: Callable[[], _T], what: str) -> _T:
        """Return the result of ``read``; raise a `FormatError` if the bytes it meets are damaged."""
        try:
            return read()
        except FormatError as error:
            raise FormatError(f"{error} File: {self.path}", code=error.code) from error
        except (OSError, KeyError, *decoding_errors()) as error:
            raise FormatError(
                f"Damaged or unfinished MCAP log, {what} cannot be read ({error or type(error).__name__}). "
                f"Hint: `h3data recover {self.path} -o OUT` saves what can be saved. File: {self.path}",
                code="H3-RECORDING-041",
            ) from error

    def _bytes(self, offset: int, size: int) -> bytes:
        if offset + size > self._log.size:
            raise EOFError(f"truncated, bytes {offset} to {offset + size} are not there")
        self._file.seek(offset)
        return self._file.read(size)

    def _record(self, offset: int) -> tuple[int, memoryview]:
        opcode, length = RECORD_HEAD.unpack(self._bytes(offset, RECORD_HEAD.size))
        return opcode, memoryview(self._bytes(offset + RECORD_HEAD.size, length))

    def _read_summary(self) -> None:
        """Read schemas, channels and indexes at the end of the file, and the metadata records that these point to."""
        from mcap.data_stream import ReadDataStream
        from mcap.records import AttachmentIndex, ChunkIndex, MetadataIndex, Statistics

        log = self._log
        if self._bytes(0, len(MAGIC)) != MAGIC:
            raise FormatError("Expected an MCAP log, the file does not begin like one.", code="H3-RECORDING-038")
        take(log, *self._record(len(MAGIC)))
        # the footer is the last record, and the only one whose length is fixed
        footer = log.size - (RECORD_HEAD.size + 20 + len(MAGIC))
        if self._bytes(log.size - len(MAGIC), len(MAGIC)) != MAGIC:
            raise EOFError("the closing magic bytes are missing")
        start, _, crc = struct.unpack("<QQI", self._record(footer)[1])
        if not start:
            raise FormatError(
                "This log has no summary, so its steps cannot be found. Hint: `h3data convert` adds one.",
                code="H3-RECORDING-039",
            )
        log.readable_bytes = log.size
        summary = memoryview(self._bytes(start, footer + RECORD_HEAD.size + 16 - start))
        check_crc(crc, summary, "summary")
        metadata: list[int] = []
        for opcode, body in _records(summary[: footer - start]):
            stream = ReadDataStream(BytesIO(body))
            if opcode == _CHUNK_INDEX:
                self._chunks.append(ChunkIndex.read(stream))
            elif opcode == _METADATA_INDEX:
                metadata.append(MetadataIndex.read(stream).offset)
            elif opcode == _STATISTICS:
                self._metadata_records = Statistics.read(stream).metadata_count
            elif opcode == _ATTACHMENT_INDEX:
                self._attachments.append(AttachmentIndex.read(stream).offset)
            else:
                take(log, opcode, body)
        # a summary need not list chunks in the order of the file, and steps are counted through them
        self._chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
        # in the order of the file: of two records with one name the later one counts
        for offset in sorted(metadata):
            take(log, *self._record(offset))
        check_kind(log, self.path)

    def _reconstruct(self) -> None:
        """Add the metadata records that another program has left out; raise a `FormatError` if there are some out of reach."""
        if self._metadata_records != 0:
            raise FormatError(
                "The summary of this log does not tell where its metadata records are. Hint: `h3data convert` adds that.",
                code="H3-RECORDING-040",
            )
        state = self._log.channel_of("/h3/state")
        steps = 0 if state is None else self._places[state][-1]
        first = [] if state is None else list(self._messages(state, 0, min(steps, 2)))
        reconstruct(self._log, self.path, steps=steps, first=first)

    def _places_of(self, channel: int) -> list[int]:
        """Return the number of messages of a channel before each chunk, and in all chunks together."""
        counts = []
        for chunk in self._chunks:
            offset = chunk.message_index_offsets.get(channel)
            # the length of the index tells the number of messages, without reading or unpacking the chunk
            size = 0 if offset is None else struct.unpack("<BQHI", self._bytes(offset, 15))[3]
            # 16 bytes for each message: its log time and its offset
            counts.append(size // 16)
        return [0, *accumulate(counts)]

    def _decompressed(self, number: int) -> tuple[memoryview, dict[int, NDArray[np.uint64]]]:
        """Return the decompressed records of a chunk, and the offsets of each channel's messages in them."""
        if number not in self._kept:
            chunk = self._chunks[number]
            data = self._bytes(chunk.chunk_start_offset, chunk.chunk_length + chunk.message_index_length)
            begins: dict[int, NDArray[np.uint64]] = {}
            (_, body), *indexes = _records(memoryview(data))
            for opcode, index in indexes:
                if opcode == _MESSAGE_INDEX:
                    # after channel and length come pairs of log time and offset, of which the offset is needed
                    begins[struct.unpack_from("<H", index)[0]] = np.frombuffer(index[6:], "<u8")[1::2]
            # steps are mostly read one after the other, and a chunk may take 4 MiB
            while len(self._kept) >= 2:
                self._kept.pop(next(iter(self._kept)))
            self._kept[number] = (memoryview(decompress(body)), begins)
        return self._kept[number]

    def _messages(self, channel: int, start: int, stop: int) -> Iterator[memoryview]:
        """Yield messages ``start`` to ``stop - 1`` of a channel."""
        before = self._places[channel]
        number = bisect_right(before, start) - 1
        while start < stop:
            data, begins = self._decompressed(number)
            chunk_stop = min(stop, before[number + 1])
            in_chunk = slice(start - before[number], chunk_stop - before[number])
            for at in begins[channel][in_chunk].tolist() if chunk_stop > start else ():
                opcode, length, owner = MESSAGE.unpack_from(data, at)
                end = at + RECORD_HEAD.size + length
                if owner != channel or opcode != _MESSAGE_OP or end > len(data):
                    raise ValueError("a message index does not fit its chunk")
                # after the 22 bytes of channel, sequence, log time and publish time
                yield data[at + RECORD_HEAD.size + 22 : end]
            start, number = chunk_stop, number + 1

    def _with_steps(self, start: int, stop: int) -> McapRecords:
        """Return the log's records with only these steps."""
        return replace(self._log, messages={c: list(self._messages(c, start, stop)) for c in self._per_step})

    def _whole(self, start: int, stop: int, *topics: str) -> Recording:
        """Return these steps with all messages on some other topics."""
        log = self._with_steps(start, stop)
        for channel, before in self._places.items():
            if log.channels[channel][0] in topics:
                log.messages[channel] = list(self._messages(channel, 0, before[-1]))
        return assemble(log, self.path, steps=stop - start, wanted=None, first=start)


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and body of consecutive records; raise an `EOFError` if the last is cut off."""
    position = 0
    while position < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, position)
        end = position + RECORD_HEAD.size + length
        if end > len(data):
            raise EOFError("a record exceeds its part of the file")
        yield opcode, data[position + RECORD_HEAD.size : end]
        position = end
