"""Opens any recording, an MCAP log or a dataset folder, and says what any other file is."""

from __future__ import annotations

import gzip
import os
import zlib
from typing import TYPE_CHECKING

from h3data.errors import FormatError, InputError
from h3data.recording.records import Recording
from h3data.recording.steps import Steps
from h3data.recording.storage import AnyPath, RemotePath, masked, open_binary, place

if TYPE_CHECKING:
    from h3data.recording.parquet.dataset import Dataset

_MAGIC = {
    b"\x89MCAP0\r\n": "an MCAP log",
    b"PAR1": "a Parquet file",
    b"ARROW1": "an Arrow file",
    b"RRF2": "a Rerun recording (.rrd)",
    b"\x89HDF": "an HDF5 file",
    b"glTF": "a glTF model (.glb)",
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"PK\x03\x04": "a zip archive",
    b"\x93NUMPY": "a numpy array",
}
_HEAD = 1 << 16

FOXGLOVE_SUFFIX = ".foxglove.mcap"
"""Suffix of exports for Foxglove (`h3data.export.foxglove.write`), which lie beside recordings but are none."""


def logs_in(folder: AnyPath, *, below: bool = False) -> list[AnyPath]:
    """Logs in a folder, or anywhere below it, sorted; files for Foxglove are left out."""
    paths = folder.rglob("*.mcap") if below else folder.glob("*.mcap")
    return sorted(path for path in paths if not path.name.endswith(FOXGLOVE_SUFFIX))


def open_recording(path: str | os.PathLike[str] | RemotePath) -> Recording | Dataset:
    """A `Recording` for an MCAP log or for one episode of a dataset (``ds#3``), a `Dataset` for a dataset folder.

    The path may be a URI: ``s3://bucket/ds`` (`h3data.recording.storage`).

    Raises:
        InputError: there is no such file or episode, or it cannot be read.
        FormatError: the file is something else (the message says what), or it is damaged.
    """
    path = place(path)
    try:
        exists, folder = path.exists(), path.is_dir()
    except OSError as error:
        raise InputError(f"The path cannot be read ({error.strerror or error}): {path}") from error
    root, _, number = (path.uri if isinstance(path, RemotePath) else str(path)).rpartition("#")
    if not exists and root and number.isdecimal():
        return _episode(open_recording(place(root)), int(number), masked(root))
    if not exists:
        part = path.with_name(path.name + ".part")
        hint = f" Hint: an unfinished one exists, `h3data recover {part} -o OUT`." if part.exists() else ""
        raise InputError(
            f"There is no such file or folder. Expected a recording (.mcap) or a dataset.{hint} Path: {path}"
        )
    if folder:
        from h3data.recording.parquet.dataset import Dataset

        return Dataset(path)
    kind = looks_like(path)
    if kind == "an MCAP log":
        from h3data.recording.mcap.read import read_mcap

        return read_mcap(path)
    if path.suffix == ".part":
        raise FormatError(f"An unfinished file ({kind}) with nothing to recover: {path}")
    if kind == "a gfx-replay file of Habitat":
        raise FormatError(f"This is {kind}. Hint: `h3data import {path} -o DIR` makes an MCAP log of it: {path}")
    parquet = " Hint: open the dataset folder that it belongs to." if kind == "a Parquet file" else ""
    raise FormatError(f"Expected an MCAP log or a dataset folder, this looks like {kind}.{parquet} File: {path}")


def open_steps(path: str | os.PathLike[str] | RemotePath, *, episode: int | None = None) -> Steps:
    """The steps of an MCAP log, or of one ``episode`` of a dataset, by path or URI.

    Damage in parts of a log that are not read goes unnoticed; `read_mcap` checks the whole file.

    Raises:
        InputError: there is no such file or episode.
        FormatError: the file is damaged, unfinished, of another kind, or a log without indexes.
    """
    at = place(path)
    if at.is_dir():
        from h3data.recording.parquet.dataset import Dataset
        from h3data.recording.parquet.steps import DatasetSteps

        if episode is None:
            raise InputError(f"A dataset has many episodes: pass episode=0 or another number: {at}")
        return DatasetSteps(Dataset(at), episode)
    if episode is not None:
        raise InputError(f"Only a dataset has numbered episodes, this is not one: {at}")
    from h3data.recording.mcap.steps import McapSteps

    return McapSteps(at)


def _episode(opened: Recording | Dataset, number: int, root: str) -> Recording:
    if isinstance(opened, Recording):
        raise InputError(f"Only a dataset has numbered episodes, this is a recording: {root}")
    if number >= len(opened):
        raise InputError(f"There is no episode {number}: the dataset has {len(opened)}, 0 to {len(opened) - 1}: {root}")
    return opened.recording(number)


def looks_like(path: AnyPath) -> str:
    """Kind of a file, judged by how it begins: ``an MCAP log``, ``a gfx-replay file of Habitat``, ``text``, ..."""
    try:
        with open_binary(path) as stream:
            head = stream.read(_HEAD)
    except OSError as error:
        raise InputError(f"The file cannot be read ({error.strerror or error}): {path}") from error
    if not head:
        return "an empty file"
    if head[:2] == b"\x1f\x8b":
        return _json_kind(_gunzip_head(path)) or "a gzip archive"
    for magic, kind in _MAGIC.items():
        if head.startswith(magic):
            return kind
    return _json_kind(head) or ("text" if b"\0" not in head else "binary data of an unknown kind")


def _json_kind(head: bytes) -> str | None:
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text[:1] not in (b"{", b"["):
        return None
    if b'"keyframes"' in head or b'"keyframe"' in head:
        return "a gfx-replay file of Habitat"
    return "a JSON file"


def _gunzip_head(path: AnyPath) -> bytes:
    try:
        with open_binary(path) as file, gzip.open(file) as stream:
            return stream.read(_HEAD)
    except (OSError, EOFError, zlib.error):
        return b""
