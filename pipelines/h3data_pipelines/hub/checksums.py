"""SHA-256 of every file of a dataset in ``h3/checksums.json``, for the comparison of a copy with the original."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from h3data.errors import FormatError
from h3data.progress import progress
from h3data.recording.storage import AnyPath, open_binary

FILE = "h3/checksums.json"
PARTS = ("meta", "data", "h3", "videos")
"""Folders of a dataset whose files are compared; its card, which people edit on the Hub, is not."""
_BLOCK = 8 << 20


def files_of(root: Path) -> list[str]:
    """Return the paths of all files of a dataset relative to its root, without checksums and unfinished files."""
    found = (path for part in PARTS for path in (root / part).rglob("*") if path.is_file())
    names = (path.relative_to(root).as_posix() for path in found if path.suffix != ".part")
    return sorted(name for name in names if name != FILE)


def checksums_of(root: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the SHA-256 of files by their path relative to ``root``."""
    return {name: file_sha256(root / name) for name in progress(names, desc="checksums", unit="file", leave=False)}


def to_json(checksums: Mapping[str, str]) -> bytes:
    """Return the contents of the file `FILE` for some checksums."""
    return json.dumps({"sha256": dict(checksums)}, indent=0).encode()


def require_checksums(root: Path) -> int:
    """Compare the files of a copy with its checksums and return the number of checksums, 0 if there are none.

    Raises:
        FormatError: files are missing or damaged; the message names them.
    """
    path = root / FILE
    if not path.is_file():
        return 0
    try:
        expected = {str(name): str(digest) for name, digest in json.loads(path.read_bytes())["sha256"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FormatError(f"The checksums are damaged ({error!r}): {path}", code="H3-HUB-003") from None
    present = set(files_of(root))
    missing = sorted(expected.keys() - present)
    found = checksums_of(root, sorted(expected.keys() & present))
    damaged = [name for name, digest in found.items() if digest != expected[name]]
    more = sorted(present - expected.keys())
    faults = [
        f"{len(names)} {what} ({', '.join(names[:3])})"
        for what, names in (("missing", missing), ("damaged", damaged), ("that do not belong to it", more))
        if names
    ]
    if faults:
        raise FormatError(
            f"The copy differs from the dataset that was pushed: files {'; '.join(faults)}: {root}", code="H3-HUB-002"
        )
    return len(expected)


def file_sha256(path: AnyPath) -> str:
    """Return the SHA-256 of a local file or a file in an object store, read in blocks."""
    digest = hashlib.sha256()
    with open_binary(path) as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()
