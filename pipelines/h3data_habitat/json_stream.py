"""Iteration over the elements of a long JSON array, with the memory of one element."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_QUOTE, _OPEN, _CLOSE = 1, 2, 3
_CLASS = np.zeros(256, np.uint8)
_CLASS[ord('"')] = _QUOTE
_CLASS[list(b"{[")] = _OPEN
_CLASS[list(b"}]")] = _CLOSE
_SPACE = b" \t\r\n"


class ArrayFault(Exception):
    """Error of an array that is incomplete or has an element that is too long, at byte ``at`` of the document."""

    def __init__(self, text: str, at: int) -> None:
        super().__init__(text)
        self.at = at


@dataclass
class ArrayElements:
    """Iterator over the elements of an array of objects: the text of each with its first byte.

    ``chunks`` are the text after the array's opening bracket, cut anywhere, the first at byte ``start`` of the document.
    Only brackets and strings are interpreted; the contents of an element are checked by its decoder. After the last
    element, `rest` is the text after the closing bracket in the same chunk, and `rest_at` is its first byte.

    Raises `ArrayFault` if the array does not end, a comma or an element is missing, or one is longer than ``longest`` bytes.
    """

    chunks: Iterator[bytes]
    start: int
    longest: int
    rest: bytes = b""
    rest_at: int = 0
    _depth: int = 0
    _in_string: bool = False
    _escaped: bool = False
    _open: list[bytes] = field(default_factory=list)
    """Chunks of the element that has not ended."""

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        at, first = self.start, True  # of the document: where the open element begins
        for chunk in filter(None, self.chunks):
            ends, stop = self._ends(chunk)
            done = 0
            for end in ends.tolist():
                text = b"".join([*self._open, chunk[done:end]]) if self._open else chunk[done:end]
                self._open.clear()
                yield self._trimmed(at, text, first)
                at, done, first = at + len(text), end, False
            if stop is not None:
                last = b"".join([*self._open, chunk[done:stop]])
                if last.strip(_SPACE):
                    yield self._trimmed(at, last, first)
                self.rest, self.rest_at = chunk[stop + 1 :], at + len(last) + 1
                return
            if done < len(chunk):
                self._open.append(chunk[done:])
            # only the element that is open is held, which is what limits the memory
            if sum(map(len, self._open)) > self.longest:
                raise ArrayFault(f"an element is longer than {self.longest >> 20} MiB", at)
        raise ArrayFault("truncated", at + sum(map(len, self._open)))

    @staticmethod
    def _trimmed(at: int, text: bytes, first: bool) -> tuple[int, bytes]:
        """Return the element without the one comma before it."""
        bare = text.lstrip(_SPACE)
        begins = at + len(text) - len(bare)
        if first:
            return begins, bare
        if not bare.startswith(b","):
            raise ArrayFault("a comma is missing", begins)
        bare = bare[1:].lstrip(_SPACE)
        begins = at + len(text) - len(bare)
        if not bare:
            raise ArrayFault("an element is missing", begins)
        return begins, bare

    def _ends(self, chunk: bytes) -> tuple[NDArray[np.intp], int | None]:
        """Return the end (exclusive) of the elements that end in the chunk, and of the array if it ends there."""
        # the character after a backslash at the end of the last chunk is escaped
        text = b" " + chunk[1:] if self._escaped else chunk
        if (
            b"\\" in text
        ):  # runs of backslashes pair from their left; what is left of a run escapes the character behind it
            text = text.replace(b"\\\\", b"  ").replace(b'\\"', b"  ")
        self._escaped = text.endswith(b"\\")
        kind = _CLASS[np.frombuffer(text, np.uint8)]
        marks = np.flatnonzero(kind)
        kind = kind[marks]
        quotes = np.cumsum(kind == _QUOTE) + self._in_string
        # an even number of quotes before: brackets there are structure and not text
        outside = quotes % 2 == 0
        change = ((kind == _OPEN) & outside).astype(np.int64) - ((kind == _CLOSE) & outside)
        depth = np.cumsum(change) + self._depth
        if len(marks):
            self._in_string, self._depth = bool(quotes[-1] % 2), int(depth[-1])
        closing = change < 0
        # a bracket that closes more than was opened is that of the array itself
        stops = marks[closing & (depth < 0)]
        ends = marks[closing & (depth == 0)] + 1
        return (ends[ends <= stops[0]], int(stops[0])) if len(stops) else (ends, None)
