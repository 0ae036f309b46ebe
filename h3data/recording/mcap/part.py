"""File that is named ``<name>.part`` until it is complete and synced to the disk."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from h3data.errors import InputError


def part_path(path: Path) -> Path:
    """Return the name of a file while it is being written."""
    return path.with_name(path.name + ".part")


def open_part(part: Path, *, overwrite: bool) -> IO[bytes]:
    """Return a new file under its temporary name, without a buffer; tests replace this by disks that fill up."""
    # without a buffer, because `Backlog` has to know which bytes the disk took
    return open(part, "wb" if overwrite else "xb", buffering=0)  # type: ignore[return-value]


class Backlog:
    """Stream to a file that buffers bytes which the disk does not accept.

    `write` never fails. `flush` writes what is in the buffer, and continues where it stopped when it is called again.
    The file always holds the first part of the bytes written to the stream.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._left, self._end = file, bytearray(), 0

    def write(self, data: bytes) -> int:
        """Append bytes to the buffer, write the buffer to the file once it is large, and return the number of bytes."""
        self._left += data
        self._end += len(data)
        # not left to the next flush where the disk takes it: without one for long, all of it would gather in
        # memory
        # number of bytes that may wait for a `Backlog.flush` while the disk accepts data
        if len(self._left) >= 1 << 20:
            with contextlib.suppress(OSError):  # `flush` says so
                self._hand_over()
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written to the stream, including those still in the buffer."""
        return self._end

    def flush(self) -> None:
        """Write the whole buffer to the file.

        Raises:
            OSError: the disk is full or fails.
        """
        self._hand_over()
        self._file.flush()

    def fileno(self) -> int:
        """Return the file descriptor of the underlying file."""
        return self._file.fileno()

    def close(self) -> None:
        """Close the underlying file; bytes still in the buffer are lost."""
        self._file.close()

    @property
    def closed(self) -> bool:
        """Return whether the underlying file is closed."""
        return self._file.closed

    def _hand_over(self) -> None:
        while self._left:
            # a disk that fills up takes a part; the rest stays for the next call
            taken = self._file.write(self._left)
            del self._left[:taken]


def publish(part: Path, final: Path) -> None:
    """Give a finished, synced file its final name; the rename itself is synced too."""
    os.replace(part, final)
    # the name is in the folder, which has to reach the disk as well: else the file is there and cannot be found
    folder = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


class PartFile:
    """File of a log, which gets its final name when it is complete."""

    def __init__(self, final: Path, *, overwrite: bool) -> None:
        """Create ``<final>.part``.

        Raises:
            InputError: either file exists and ``overwrite`` is False, or the file cannot be created.
        """
        self.final, self.path = final, part_path(final)
        with self.writing():
            self._refuse_existing(overwrite=overwrite)
        # apart from `writing`, whose message promises that something can be recovered
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"The folder cannot be created ({error.strerror or error}): {final.parent}", code="H3-RECORDING-015"
            ) from None
        with self.writing():
            self.stream = Backlog(open_part(self.path, overwrite=overwrite))

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Convert I/O errors within the block to an `InputError` that states which part can be recovered."""
        try:
            yield
        except FileExistsError:
            raise InputError(f"Another process is writing this file: {self.path}", code="H3-RECORDING-016") from None
        except OSError as error:
            raise InputError(
                f"Could not write the recording: {error.strerror or error}. What was flushed before stays "
                f"(`h3data recover`): {self.path}",
                code="H3-RECORDING-017",
            ) from error

    def complete(self) -> None:
        """Sync everything to the disk and give the file its final name. After an `OSError` it can be called again."""
        # a second call after a failed rename must not write to a closed file
        if not self.stream.closed:
            self.stream.flush()
            os.fsync(self.stream.fileno())
            self.stream.close()
        publish(self.path, self.final)

    def shut(self) -> None:
        """Close the file without renaming it."""
        with contextlib.suppress(OSError):  # closing flushes; a full disk was reported before
            self.stream.close()

    def discard(self) -> None:
        """Delete the unfinished file."""
        self.path.unlink(missing_ok=True)

    def _refuse_existing(self, *, overwrite: bool) -> None:
        if overwrite:
            return
        if self.final.exists():
            raise InputError(
                f"The file exists; choose another name or pass overwrite=True: {self.final}", code="H3-RECORDING-013"
            )
        if self.path.exists():
            raise InputError(
                "An unfinished recording of this name exists. Save it with `h3data recover`, delete it, or pass "
                f"overwrite=True: {self.path}",
                code="H3-RECORDING-014",
            )
