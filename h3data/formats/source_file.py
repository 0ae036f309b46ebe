"""Access to files of other programs, which are unpacked within limits and read once for detection and import."""

from __future__ import annotations

import gzip
import os
import zlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from h3data.errors import FormatError, InputError

CHUNK_BYTES = 1 << 20
UNPACKED_BYTES = 64 << 20
UNPACKED_RATIO = 200
"""Largest ratio of unpacked to packed size of gzip data above `UNPACKED_BYTES` (JSON of recordings: 5 to 30)."""

BYTE_ORDER_MARK = b"\xef\xbb\xbf"


class SourceFile(os.PathLike[str]):
    """File of another program, whose start is read to detect its format and not read again by its reader.

    Gzip data is unpacked. Every member raises `InputError` if there is no such file, `FormatError` if it is damaged.
    """

    def __init__(self, path: str | os.PathLike[str], *, chunk_bytes: int = CHUNK_BYTES) -> None:
        self.path = Path(path)
        self._size = chunk_bytes
        self._rest: Iterator[bytes] | None = None

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> SourceFile:
        """Return a path as a source file; an existing source file is returned unchanged and not read again."""
        return path if isinstance(path, SourceFile) else cls(path)

    def __fspath__(self) -> str:
        return str(self.path)

    @cached_property
    def head(self) -> bytes:
        """First chunk of the content."""
        self._rest = byte_chunks(self.path, self._size)
        return next(self._rest, b"")

    @cached_property
    def data(self) -> bytes:
        """Whole content, held in memory."""
        return b"".join(self.chunks())

    def chunks(self) -> Iterator[bytes]:
        """Yield the content in pieces, without storing the whole content in memory."""
        if "data" in self.__dict__:
            yield self.data
            return
        head, rest = self.head, self._rest
        self._rest = None  # a second caller reads the file again
        if head:
            yield head
        if rest is None:
            rest = byte_chunks(self.path, self._size)
            next(rest, b"")
        yield from rest


def byte_chunks(path: Path, size: int = CHUNK_BYTES) -> Iterator[bytes]:
    """Yield the content of a file, unpacked if it is gzip, in pieces of at most ``size`` bytes.

    Raises:
        InputError: there is no such file, or it cannot be read.
        FormatError: the gzip data is damaged, or unpacks to more than `UNPACKED_BYTES` and `UNPACKED_RATIO` times its size.
    """
    try:
        with path.open("rb") as raw:
            # by content, not by suffix: downloads often lose it
            packed = raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            if packed:
                yield from _unpacked(raw, path, size)
            else:
                while chunk := raw.read(size):
                    yield chunk
    except FileNotFoundError:
        raise InputError(f"There is no such file: {path}", code="H3-FORMAT-013") from None
    except IsADirectoryError:
        raise InputError(f"Expected a file, this is a folder: {path}", code="H3-FORMAT-014") from None
    except OSError as error:
        raise InputError(f"The file cannot be read ({error.strerror}): {path}", code="H3-FORMAT-015") from None


def _unpacked(raw: BinaryIO, path: Path, size: int) -> Iterator[bytes]:
    packed = raw.seek(0, os.SEEK_END)
    raw.seek(0)
    # checked while it unpacks: the size that gzip notes at its end can be forged
    limit, total = max(UNPACKED_RATIO * packed, UNPACKED_BYTES), 0
    with gzip.GzipFile(fileobj=raw) as stream:
        while True:
            try:
                chunk = stream.read(size)
            except (OSError, EOFError, zlib.error) as fault:
                raise FormatError(
                    f"The gzip data is damaged or cut off ({fault}). Hint: copy the file again. {path}",
                    code="H3-FORMAT-017",
                ) from None
            total += len(chunk)
            if total > limit:
                raise FormatError(
                    f"The {packed} bytes of gzip data unpack to more than {limit >> 20} MiB and are refused as a possible "
                    f"bomb. Hint: if the size is right, unpack the file first. {path}",
                    code="H3-FORMAT-016",
                )
            if not chunk:
                return
            yield chunk


def decode_json(data: bytes, kind: Any = Any) -> Any:
    """Decode a JSON document as ``kind``, skipping a byte order mark.

    All faults raise a `msgspec.DecodeError`.
    """
    try:
        return msgspec.json.decode(data.removeprefix(BYTE_ORDER_MARK), type=kind)
    # brackets a hundred thousand deep fit into a small file
    except RecursionError:
        raise msgspec.DecodeError("JSON is malformed: brackets are nested too deep") from None
    except UnicodeDecodeError as fault:
        raise msgspec.DecodeError(f"JSON is malformed: a text is not UTF-8 ({fault.reason})") from None
