"""Attachments that the logs of a folder share, stored once in ``<folder>/h3/files`` and named in each log by their hash."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from h3data.errors import FormatError, InputError
from h3data.recording.file_store import FileStore
from h3data.recording.storage import AnyPath

RECORD = "h3.files"
"""Name of the metadata record of a log that lists its shared attachments, each with the name of its file."""
_BELOW = Path("h3") / "files"
_LEVELS = 8
_RESTORE = (
    "copy the folder h3/files along with the recordings (into their folder or one above it), or the file of this name from a "
    "backup; `h3data recover` saves the recording without it"
)


def share_files(attachments: Mapping[str, bytes], folder: Path, log: Path) -> dict[str, str]:
    """Store attachments in ``<folder>/h3/files`` and return the record that names them.

    Raises:
        InputError: ``log`` is not inside ``folder``, where readers search.
    """
    # readers search upwards from the log, so a folder elsewhere would never be found again
    if folder.absolute() not in log.absolute().parents[:_LEVELS]:
        raise InputError(
            f"Expected a recording in the folder of the shared files, {folder}, got: {log}", code="H3-RECORDING-036"
        )
    store = FileStore(folder / _BELOW)
    return {name: store.put(name, bytes(data)) for name, data in attachments.items()}


def shared_files(record: Mapping[str, str], log: AnyPath) -> dict[str, bytes]:
    """Return the attachments named in a log's record, from ``h3/files`` in the log's folder or in a folder above it.

    Raises:
        FormatError: an attachment is missing or damaged.
    """
    # absolute, because the parents of a relative path end at the working directory
    at = log.absolute() if isinstance(log, Path) else log
    folders = [folder / _BELOW for folder in [*at.parents][:_LEVELS]]
    files = {}
    for name, stored in record.items():
        what = f"The file {name} of the recording {log.name}"
        # the name alone: a log from elsewhere must not lead out of the folder of shared files
        digest = Path(stored).name
        path = next((folder / digest for folder in folders if (folder / digest).is_file()), None)
        if path is None:
            raise FormatError(
                f"{what} is missing: expected it as h3/files/{digest}. Hint: {_RESTORE}. Recording: {log}",
                code="H3-RECORDING-037",
            )
        if isinstance(path, Path):
            status = path.stat()
            files[name] = _cached(path, status.st_size, status.st_mtime_ns)
        else:
            files[name] = FileStore(path.parent).get(digest, what=what, hint=_RESTORE)
    return files


@lru_cache(maxsize=2)
def _cached(path: Path, size: int, mtime_ns: int) -> bytes:
    """Return the contents of a file, which is read again when it changes.

    The recordings of a folder are usually read one after the other.
    """
    return FileStore(path.parent).get(path.name, what="A file shared by recordings", hint=_RESTORE)
