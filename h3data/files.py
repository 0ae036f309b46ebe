"""Files that appear under their final name only when they are complete; where caches lie."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from h3data.errors import InputError


def cache_folder(kind: str) -> Path | None:
    """Where things of a kind are cached: below ``$H3DATA_CACHE``, ``$XDG_CACHE_HOME/h3data`` or ``~/.cache/h3data``.

    None when ``H3DATA_CACHE`` is ``off``, or where there is no home folder.
    """
    wanted = os.environ.get("H3DATA_CACHE")
    if wanted is not None:
        return None if wanted.lower() in ("", "0", "off", "no") else Path(wanted) / kind
    home = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(home) if home else Path.home() / ".cache") / "h3data" / kind
    except RuntimeError:
        return None


@contextmanager
def part_file(
    path: str | os.PathLike[str],
    *,
    shared: bool = False,
    kept_after: tuple[type[BaseException], ...] | type[BaseException] = (),
) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to; renamed to ``path`` on success, removed on any exception but those
    of ``kept_after``.

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
    except BaseException as error:
        if not isinstance(error, kept_after):
            part.unlink(missing_ok=True)
        raise
