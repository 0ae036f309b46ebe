"""Safe handling of dataset folders: their contents, their removal, and writes that finish before an interruption."""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from h3data.errors import H3DataError, InputError
from h3data.recording.storage import AnyPath, remove_tree
from h3data.terminal import counted


def unfinished_dataset(root: AnyPath) -> str:
    """Describe the dataset in a folder for `claim_folder`; empty if the folder has none."""
    from h3data.recording import Dataset
    from h3data.recording.parquet.files import is_begun

    if not ((root / "h3" / "schema.json").is_file() or is_begun(root)):
        return ""
    try:
        count = len(Dataset(root))
    except H3DataError:  # interrupted before the first commit
        count = 0
    return f"a dataset of {counted(count, 'finished episode')}" if count else "a dataset without finished episodes"


_PARTS_OF_DATASET = ("meta", "data", "h3", "videos", "mcap")


def remove_dataset(root: AnyPath) -> None:
    """Delete the dataset in a folder.

    If the folder holds anything else, nothing is deleted and an `InputError` is raised.
    """
    from h3data.recording.parquet.files import is_begun

    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return
    if not ((root / "h3" / "schema.json").is_file() or is_begun(root)):
        raise InputError(
            f"--force would delete this, but it is not an h3data dataset. Remove it yourself: {root}",
            code="H3-OPTION-006",
        )
    others = [p for p in root.iterdir() if p.name not in (*_PARTS_OF_DATASET, "README.md", "card.jpg")]
    others += [p for p in root.glob("mcap/*") if not re.fullmatch(r"\d{6,}\.mcap(\.part)?", p.name)]
    if others:
        raise InputError(
            f"--force would replace this dataset, but its folder holds {counted(len(others), 'other file')}. Move them away. "
            f"The first: {min(others)}",
            code="H3-OPTION-007",
        )
    for name in _PARTS_OF_DATASET:  # meta first: without it, nothing is committed
        remove_tree(root / name)
    for name in ("README.md", "card.jpg"):
        if (root / name).is_file():
            (root / name).unlink()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C, SIGTERM and SIGHUP until the end of the block, so that a write in progress is finished first."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    heeded = [s for s in numbers if signal.getsignal(s) is not signal.SIG_IGN]  # nohup ignores SIGHUP
    before = {s: signal.signal(s, lambda number, _: received.append(number)) for s in heeded}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in received[:1]:
            signal.raise_signal(number)
