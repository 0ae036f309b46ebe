"""Opening of any supported recording, an MCAP log or a dataset folder; errors name the kind of any other file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from h3data.errors import FormatError, InputError
from h3data.formats import Format, SourceFile, detect, format_by_beginning
from h3data.recording.records import Recording
from h3data.recording.steps import Steps
from h3data.recording.storage import AnyPath, RemotePath, masked, open_binary, place

if TYPE_CHECKING:
    from h3data.recording.parquet.dataset import Dataset

FOXGLOVE_SUFFIX = ".foxglove.mcap"
"""Suffix of exports for Foxglove (`h3data_exporters.foxglove.foxglove_file`), which may lie beside recordings."""


def logs_in(folder: AnyPath, *, below: bool = False) -> list[AnyPath]:
    """Return the logs in a folder and below it, sorted; files for Foxglove are left out."""
    paths = folder.rglob("*.mcap") if below else folder.glob("*.mcap")
    return sorted(path for path in paths if not path.name.endswith(FOXGLOVE_SUFFIX))


def open_recording(path: str | os.PathLike[str] | RemotePath) -> Recording | Dataset:
    """Open an MCAP log or an episode of a dataset (``ds#3``) as a `Recording`, or a dataset folder as a `Dataset`.

    The path may be a URI: ``s3://bucket/ds`` (`h3data.recording.storage`).

    Raises:
        InputError: there is no such file or episode, or it cannot be read.
        FormatError: the file has another format, which the message names, or is damaged.
    """
    path = place(path)
    try:
        exists, folder = path.exists(), path.is_dir()
    except OSError as error:
        raise InputError(
            f"The path cannot be read ({error.strerror or error}): {path}", code="H3-RECORDING-054"
        ) from error
    root, _, number = (path.uri if isinstance(path, RemotePath) else str(path)).rpartition("#")
    # only where there is no such file, because a name may hold a # itself
    if not exists and root and number.isdecimal():
        return _episode(open_recording(place(root)), int(number), masked(root))
    if not exists:
        # a crash leaves the log under its temporary name, where nobody looks for it
        part = path.with_name(path.name + ".part")
        hint = f" Hint: an unfinished one exists, `h3data recover {part} -o OUT`." if part.exists() else ""
        raise InputError(
            f"There is no such file or folder. Expected a recording (.mcap) or a dataset.{hint} Path: {path}",
            code="H3-RECORDING-049",
        )
    if folder:
        from h3data.recording.parquet.dataset import Dataset

        return Dataset(path)
    form = _format_of(path)
    if form.name == "mcap":
        from h3data.recording.mcap.read import read_mcap

        return read_mcap(path)
    if path.suffix == ".part":
        raise FormatError(f"An unfinished file ({form.title}) with nothing to recover: {path}", code="H3-RECORDING-050")
    hint = form.hint or (f"`h3data import {path} -o DIR` makes an MCAP log of it" if form.read else "")
    raise FormatError(
        f"Expected an MCAP log or a dataset folder, this looks like {form.title}.{hint and f' Hint: {hint}.'} File: {path}",
        code="H3-RECORDING-048",
    )


def open_steps(path: str | os.PathLike[str] | RemotePath, *, episode: int | None = None) -> Steps:
    """Open an MCAP log, or one ``episode`` of a dataset, by path or URI for reading single steps.

    Damage in parts of a log that are not read goes unnoticed; `read_mcap` checks the whole file.

    Raises:
        InputError: there is no such file or episode.
        FormatError: the file is damaged, unfinished, of another kind, or a log without indexes.
    """
    at = place(path)
    if at.is_dir():
        from h3data.recording.parquet.dataset import Dataset, DatasetSteps

        if episode is None:
            raise InputError(
                f"A dataset has many episodes: pass episode=0 or another number: {at}", code="H3-RECORDING-055"
            )
        return DatasetSteps(Dataset(at), episode)
    if episode is not None:
        raise InputError(f"Only a dataset has numbered episodes, this is not one: {at}", code="H3-RECORDING-051")
    from h3data.recording.mcap.steps import McapSteps

    return McapSteps(at)


def _episode(opened: Recording | Dataset, number: int, root: str) -> Recording:
    if isinstance(opened, Recording):
        raise InputError(f"Only a dataset has numbered episodes, this is a recording: {root}", code="H3-RECORDING-052")
    if number >= len(opened):
        raise InputError(
            f"There is no episode {number}: the dataset has {len(opened)}, 0 to {len(opened) - 1}: {root}",
            code="H3-RECORDING-053",
        )
    return opened.recording(number)


def _format_of(path: AnyPath) -> Format:
    """Return the format of a file; of one in a remote store only the beginning is read."""
    head_bytes = 1 << 16
    if isinstance(path, Path):
        return detect(SourceFile(path, chunk_bytes=head_bytes))
    try:
        with open_binary(path) as stream:
            return format_by_beginning(stream.read(head_bytes))
    except OSError as error:
        raise InputError(
            f"The file cannot be read ({error.strerror or error}): {path}", code="H3-RECORDING-026"
        ) from error
