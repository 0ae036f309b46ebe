"""Files that get their final name only when they are complete, and the location of caches."""

from __future__ import annotations

import os
import posixpath
import re
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from h3data.errors import InputError


def size_text(count: int) -> str:
    """Return a number of bytes as readable text: ``1.2 MB``, ``3.4 kB``."""
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.1f} kB"


def spreadsheet_cell(value: Any) -> Any:
    """Return the text of a CSV cell, changed so that no spreadsheet runs it as a formula.

    Text that starts with ``=``, ``+``, ``-``, ``@`` (also full-width, and also after blanks), a tab or a line break
    gets an apostrophe before it. Numbers and all other text are unchanged (OWASP, "CSV Injection").
    """
    if not isinstance(value, str) or not re.match(r"\s*[=+\-@\uff1d\uff0b\uff0d\uff20]|[\t\r\n]", value):
        return value
    # a number may begin with a sign and is no formula
    if re.fullmatch(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*|[+-]?(inf|nan)", value):
        return value
    return f"'{value}"


def path_inside(name: str) -> str | None:
    """Return a relative path that a file names, normalised with forward slashes; None if it leads out of the file's folder."""
    # programs on Windows write backslashes, also into files that have to be read everywhere
    clean = posixpath.normpath(name.replace("\\", "/"))
    outside = clean.startswith(("/", "../")) or clean == ".." or ":" in clean.split("/")[0]  # C:/
    return None if outside else clean


def cache_folder(kind: str) -> Path | None:
    """Return the cache folder ``kind`` below ``$H3DATA_CACHE``, ``$XDG_CACHE_HOME/h3data`` or ``~/.cache/h3data``.

    None if ``H3DATA_CACHE`` is ``off`` or there is no home folder.
    """
    setting = os.environ.get("H3DATA_CACHE")
    if setting is not None:
        return None if setting.lower() in ("", "0", "off", "no") else Path(setting) / kind
    # XDG Base Directory Specification; an empty variable counts as none
    home = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(home) if home else Path.home() / ".cache") / "h3data" / kind
    except RuntimeError:
        return None


def evict(folder: Path, room: float, *, keep: Path) -> None:
    """Delete the least recently used files of a cache folder until the remaining files fit in ``room`` bytes.

    ``keep``, the file written last, is never deleted, but its size counts. Unfinished files that killed processes left
    more than a day ago are deleted as well. A process that has a deleted file open can still read it.
    """
    files = []
    for path in folder.iterdir():
        with suppress(FileNotFoundError):  # others evict too
            status = path.stat()
            if path.suffix == ".part":
                if time.time() - status.st_mtime > 86400.0:  # nobody writes one file for a day
                    path.unlink(missing_ok=True)
            elif path != keep:
                files.append((status.st_mtime_ns, status.st_size, path))
    room -= keep.stat().st_size
    # the newest first, as long as there is room
    for _, size, path in sorted(files, reverse=True):
        room -= size
        if room < 0:
            path.unlink(missing_ok=True)


@contextmanager
def part_file(
    path: str | os.PathLike[str],
    *,
    shared: bool = False,
    kept_after: tuple[type[BaseException], ...] | type[BaseException] = (),
) -> Iterator[Path]:
    """Yield a temporary path next to ``path``, which is renamed to ``path`` on success.

    Any exception removes the temporary file, except the types in ``kept_after``. Its path is ``<path>.part``, made
    absolute because some libraries treat a relative path such as ``walk:1.mp4`` as a URI. With ``shared`` its name is
    unique, so that several processes may fill the same cache entry at once; the last one to finish wins.

    Raises:
        InputError: the folder does not exist.
    """
    final = Path(path)
    if not final.parent.is_dir():
        raise InputError(
            f"Cannot write here: the folder does not exist. Hint: create it first. Folder: {final.parent}",
            code="H3-FILE-009",
        )
    beside = final.absolute()
    part = beside.with_name(final.name + ".part")
    if shared:  # not `tempfile.mkstemp`, whose files only their owner can read
        part = beside.with_name(f"{final.name}.{os.getpid()}-{secrets.token_hex(4)}.part")
    try:
        yield part
        # within one folder, where a rename is atomic
        os.replace(part, final)
    except BaseException as error:
        if not isinstance(error, kept_after):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError) and (error.filename is None or Path(os.fsdecode(error.filename)) == part):
            # as one of the file that was asked for: of the temporary one the user knows nothing
            named = OSError(error.errno, error.strerror or str(error), str(final)) if error.errno else error
            raise named from None
        raise
