"""Files that appear under their final name only when they are complete."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from h3data.errors import InputError


@contextmanager
def part_file(path: str | os.PathLike[str], *, shared: bool = False) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to; renamed to ``path`` on success, removed on any exception.

    It is ``<path>.part``; with ``shared``, one that no other process writes at the same time, for caches: the last wins.

    Raises:
        InputError: the folder does not exist.
    """
    final = Path(path)
    if not final.parent.is_dir():
        raise InputError(f"Cannot write here: the folder does not exist. Hint: create it first. Folder: {final.parent}")
    part = final.with_name(final.name + ".part")
    if shared:
        handle, name = tempfile.mkstemp(prefix=final.name, suffix=".part", dir=final.parent)
        os.close(handle)
        part = Path(name)
    try:
        yield part
        os.replace(part, final)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
