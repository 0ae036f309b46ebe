"""Writing of MCAP logs: live while the episode runs, or a finished recording at once."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from h3data.errors import InputError
from h3data.recording.mcap.log import CHUNK_BYTES, FLUSH_ROWS, FLUSH_S, LogWriter
from h3data.recording.mcap.part import part_path, publish
from h3data.recording.mcap.read import read_mcap
from h3data.recording.records import Recording, RecordingHeader
from h3data.recording.storage import AnyPath, RemotePath, open_binary, place


class RecordingWriter(LogWriter):
    """Writer of one episode while it runs, which packs the file at the end.

    A log that was flushed along the way consists of small chunks and is twice the size it could be. `close` gives it its
    final name, reads it back and replaces it by the file `write_mcap` would make of it (`pack_mcap`). Pass ``compact=False`` to
    skip that. A whole file exists under the name throughout; a full disk leaves the small chunks.
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
        flush_rows: int = FLUSH_ROWS,
        flush_s: float = FLUSH_S,
        compact: bool = True,
    ) -> None:
        """See `LogWriter`; ``compact`` packs the finished file."""
        self._compact, self._share_in = compact, share_in
        super().__init__(
            path,
            header,
            overwrite=overwrite,
            t0_unix_ns=t0_unix_ns,
            share_in=share_in,
            chunk_bytes=chunk_bytes,
            flush_rows=flush_rows,
            flush_s=flush_s,
        )

    def close(self, *, info: Mapping[str, Any] | None = None) -> Path:
        """Finish, sync, rename and pack the file; return its final path. A second call does nothing.

        ``info`` is merged into ``episode.info``: facts known only at the end, such as how the episode ended.

        Raises:
            InputError: as of `LogWriter.close`.
            FormatError: reading back shows that the storage did not keep what was written.
        """
        # asked before the file is closed: a second call must not pack it again
        due = self._compact and not self.closed
        path = super().close(info=info)
        # a file of one block is packed already
        if due and self._blocks > 1:
            pack_mcap(path, t0_unix_ns=self._t0, share_in=self._share_in, chunk_bytes=self._chunk_bytes)
        return path


def write_mcap(
    recording: Recording,
    path: str | os.PathLike[str] | RemotePath,
    *,
    overwrite: bool = False,
    share_in: str | os.PathLike[str] | None = None,
) -> AnyPath:
    """Write a finished recording as one MCAP file and return its path; equal recordings make equal files.

    With ``share_in``, a folder around the file, attachments such as the scene are stored once for all recordings in it
    (``<share_in>/h3/files``). A file for a URI is written to a temporary folder first and uploaded whole.
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
    with LogWriter(target, recording, overwrite=overwrite, share_in=share_in) as writer:
        writer.append_recording(recording)
    return writer.path


def pack_mcap(
    path: Path,
    *,
    t0_unix_ns: int | None = None,
    share_in: str | os.PathLike[str] | None = None,
    chunk_bytes: int = CHUNK_BYTES,
) -> None:
    """Replace a finished log by an equal one with large chunks; without room for it on the disk, leave it as it is.

    A program that must not lose a tenth of a second when an episode ends writes with ``compact=False`` and does this elsewhere.
    """
    # a hidden name in the same folder, so that the rename stays within one disk
    packed = path.with_name(f".{path.name}.compact")
    try:
        recording = read_mcap(path)
        with LogWriter(
            packed, recording, overwrite=True, t0_unix_ns=t0_unix_ns, share_in=share_in, chunk_bytes=chunk_bytes
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
