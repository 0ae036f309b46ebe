"""Store of files that are named by the SHA-256 of their contents, stored once, and checked when they are read."""

from __future__ import annotations

import hashlib
from pathlib import Path

from h3data.errors import FormatError
from h3data.recording.parquet.files import write_atomic
from h3data.recording.storage import AnyPath

_KEPT, _KEPT_BYTES = 8, 64 << 20
"""Largest number of files, and largest total size [bytes], that a store caches in memory."""


class FileStore:
    """Folder of files named ``<sha256>.<ext>``, each of which is checked when it is first read or stored.

    The files read last are cached, because episodes of a dataset often share a home.
    """

    def __init__(self, folder: AnyPath) -> None:
        self.folder = folder
        self._sound: set[str] = set()
        self._read: dict[str, bytes] = {}
        """Contents of the files read last, the oldest first."""

    def put(self, name: str, data: bytes) -> str:
        """Store contents unless they are there already, and return the file's name; ``name`` gives its suffix.

        A damaged file of that name is replaced.
        """
        # names come from recordings of others: nothing but a few letters and digits reaches the disk
        suffix = "".join(c for c in Path(name).suffix[1:9].lower() if c.isascii() and c.isalnum())
        digest = hashlib.sha256(data).hexdigest()
        stored = f"{digest}.{suffix}" if suffix else digest
        if stored not in self._sound:
            path = self.folder / stored
            # compared once with what lies there: most homes were stored by an earlier episode
            if not path.exists() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
                write_atomic(path, bytes(data))
            self._sound.add(stored)
        return stored

    def get(self, stored: str, *, what: str, hint: str) -> bytes:
        """Return the contents of a file.

        Args:
            stored: Name of the file, as returned by `put`.
            what: Role of the file, for the start of an error message.
            hint: Advice on how to restore the file, for the error message.

        Raises:
            FormatError: the file is missing, or its contents do not match the hash in its name.
        """
        if (kept := self._read.get(stored)) is not None:
            return kept
        # the name alone: a record from elsewhere must not lead out of this folder
        path = self.folder / Path(stored).name
        try:
            data = path.read_bytes()
        except OSError as error:
            raise FormatError(
                f"{what} is missing ({error.strerror or error}). Hint: {hint}. File: {path}", code="H3-RECORDING-004"
            ) from error
        if stored not in self._sound:
            expected, actual = stored.partition(".")[0], hashlib.sha256(data).hexdigest()
            if actual != expected:
                raise FormatError(
                    f"{what} is damaged: expected the SHA-256 {expected}, got {actual}. Hint: {hint}. File: {path}",
                    code="H3-RECORDING-005",
                )
            self._sound.add(stored)
        read = {**self._read, stored: data}
        while len(read) > _KEPT or sum(map(len, read.values())) > _KEPT_BYTES:
            del read[next(iter(read))]
        self._read = read
        return data
