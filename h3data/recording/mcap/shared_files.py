"""Attachments that the logs of a folder share: stored once in ``<folder>/h3/files``, named in each log by their hash."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from h3data.errors import FormatError, InputError
from h3data.recording.file_store import FileStore
from h3data.recording.storage import AnyPath

RECORD = "h3.files"
"""Metadata record of a log: the names of its shared attachments, each with the name of its file."""
_BELOW = Path("h3") / "files"
_LEVELS = 8
_RESTORE = (
    "copy the folder h3/files along with the recordings (into their folder or one above it), or the file of this name from a "
    "backup; `h3data recover` saves the recording without it"
)


def share_files(attachments: Mapping[str, bytes], folder: Path, log: Path) -> dict[str, str]:
    """Stores attachments in ``<folder>/h3/files`` and returns the record that names them.

    Raises:
        InputError: ``log`` does not lie in ``folder``, where its readers search.
    """
    # readers search upwards from the log, so a folder elsewhere would never be found again
    if folder.absolute() not in log.absolute().parents[:_LEVELS]:
        raise InputError(
            f"Expected a recording in the folder of the shared files, {folder}, got: {log}", code="H3-RECORDING-036"
        )
    store = FileStore(folder / _BELOW)
    return {name: store.put(name, bytes(data)) for name, data in attachments.items()}


def shared_files(record: Mapping[str, str], log: AnyPath) -> dict[str, bytes]:
    """The attachments named in a log's record, from ``h3/files`` beside the log or in a folder above it.

    Raises:
        FormatError: one of them is missing or damaged.
    """
    return {name: _read(stored, f"The file {name} of the recording {log.name}", log) for name, stored in record.items()}


def _read(stored: str, what: str, log: AnyPath) -> bytes:
    folders = [folder / _BELOW for folder in [*_absolute(log).parents][:_LEVELS]]
    # the name alone: a log from elsewhere must not lead out of the folder of shared files
    name = Path(stored).name
    path = next((folder / name for folder in folders if (folder / name).is_file()), None)
    if path is None:
        raise FormatError(
            f"{what} is missing: expected it as h3/files/{name}. Hint: {_RESTORE}. Recording: {log}",
            code="H3-RECORDING-037",
        )
    if isinstance(path, Path):
        status = path.stat()
        return _cached(path, status.st_size, status.st_mtime_ns)
    return FileStore(path.parent).get(name, what=what, hint=_RESTORE)


@lru_cache(maxsize=2)
def _cached(path: Path, size: int, mtime_ns: int) -> bytes:
    """Contents of a file, checked again when it changes: the recordings of a folder are usually read one after the other."""
    return FileStore(path.parent).get(path.name, what="A file shared by recordings", hint=_RESTORE)


def _absolute(path: AnyPath) -> AnyPath:
    return path.absolute() if isinstance(path, Path) else path
