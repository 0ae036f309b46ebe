"""Names of the files in a dataset folder as in LeRobot v3.0, and atomic writing of small files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import overload

from h3data.files import part_file
from h3data.recording.storage import AnyPath, RemotePath

FILES_PER_CHUNK = 1000
"""Number of files per folder ``chunk-000``, ``chunk-001``, ...: LeRobot's ``chunks_size``."""


@overload
def shard_path(root: Path, kind: str, shard: int) -> Path: ...
@overload
def shard_path(root: AnyPath, kind: str, shard: int) -> AnyPath: ...
def shard_path(root: AnyPath, kind: str, shard: int) -> AnyPath:
    """Return the path of file number ``shard`` of a kind (``data``, ``meta/episodes``, ``h3/bodies``, ...)."""
    return root / kind / f"chunk-{shard // FILES_PER_CHUNK:03d}" / f"file-{shard % FILES_PER_CHUNK:03d}.parquet"


def shard_files(root: AnyPath, kind: str) -> list[AnyPath]:
    """Return all complete files of a kind, in order."""
    # by number: chunk-1000 comes before chunk-999 as text; temporary names, _file-*, do not match
    return sorted((root / kind).glob("chunk-*/file-*.parquet"), key=shard_number)


def shard_number(path: AnyPath) -> int:
    """Return the number of a file from its path: the inverse of `shard_path`."""
    return int(path.parent.name.split("-")[1]) * FILES_PER_CHUNK + int(path.stem.split("-")[1])


def is_dataset(root: AnyPath) -> bool:
    """Return whether a folder holds a dataset: LeRobot's info.json or h3data's schema."""
    return (root / "meta" / "info.json").is_file() or (root / "h3" / "schema.json").is_file()


def is_begun(root: AnyPath) -> bool:
    """Return whether a process was killed in this folder before its dataset had a schema.

    Such a folder has a subfolder ``h3`` without any complete file.
    """
    here = list(root.iterdir()) if root.is_dir() else []
    if [path.name for path in here] != ["h3"] or not here[0].is_dir():
        return False
    return all(path.name.startswith("schema.json.") and path.name.endswith(".part") for path in here[0].iterdir())


def write_atomic(path: AnyPath, data: bytes) -> None:
    """Write a small file atomically: it appears with its complete contents, synced to the disk.

    Several processes may write the same file at once.
    """
    if isinstance(path, RemotePath):
        path.put(data)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with part_file(path, shared=True) as part, part.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
