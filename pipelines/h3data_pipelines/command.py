"""What every command of the command line shares: its result, its switches, and care with output folders."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol

import tyro

from h3data.errors import InputError

JsonFlag = Annotated[bool, tyro.conf.arg(help="Print one JSON object on stdout instead of text.")]
ForceFlag = Annotated[bool, tyro.conf.arg(help="Overwrite what is already there.")]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a command has done: text for people, data for machines."""

    text: str
    data: dict[str, Any] = field(default_factory=dict)
    exit_code: int = 0
    """0 done, 1 done with failures that are listed."""


class Command(Protocol):
    """A command is a dataclass of its options that can run."""

    @property
    def json(self) -> bool: ...

    def run(self) -> Outcome: ...


def claim_folder(folder: Path, *, force: bool) -> Path:
    """Make an output folder; refuse one that already holds something unless ``force``."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"The output folder is a file. Choose another with -o: {folder}")
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise InputError(f"The output folder is not empty. Use --force to overwrite, or another -o: {folder}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make the output folder ({error.strerror}): {folder}") from None
    return folder


def claim_file(path: Path, *, force: bool) -> Path:
    """A path to write to; refuse an existing file unless ``force``."""
    if path.is_dir():
        raise InputError(f"Expected a file name, this is a folder: {path}")
    if path.exists() and not force:
        raise InputError(f"The output file exists. Use --force to overwrite, or another -o: {path}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make the folder of the output file ({error.strerror}): {path}") from None
    return path


def remove_dataset(root: Path) -> None:
    """Delete a dataset folder of ours; anything else is left alone with an error."""
    if not root.exists():
        return
    if not root.is_dir() or (any(root.iterdir()) and not any((root / n).exists() for n in ("meta", "_commits", "h3"))):
        raise InputError(f"--force would delete this, but it is not an h3data dataset. Remove it yourself: {root}")
    shutil.rmtree(root)


def require_file(path: Path, what: str) -> Path:
    """``path`` if it exists; an `InputError` that says what was expected otherwise."""
    if not path.exists():
        raise InputError(f"There is no such file. Expected {what}: {path}")
    return path
